"""Laws of the rally car's disturbances: what is seen when, what is touched, and what stays as it is."""

from __future__ import annotations

import math
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from safeswitch.tasks.disturbances import DISTURBANCES, SEVERITIES, offered
from safeswitch.tasks.placing import LATEST, MET
from safeswitch.tasks.rally_disturbances import Obstacle, ObstacleHeldOut, Placed
from safeswitch.tasks.sight import surface_points
from test_rally_car import IMAGE, STATE, drive, lane_keeping, make

PLACED = [name for name in offered("rally-car-image") if DISTURBANCES[name].placed]
SEEN = [name for name in offered("rally-car-image") if DISTURBANCES[name].only_seen]


# ------------------------------------------------------------------------------------------------------------- sight


@pytest.mark.rendering
@pytest.mark.parametrize("name", PLACED)
@pytest.mark.parametrize("track", ["ridge", "hollow"])
def test_first_sight_is_the_first_picture_that_differs(name: str, track: str) -> None:
    """Geometry against rendering: the disturbed model is drawn at every step, whether it is thought visible or not."""
    env = make(disturbance=name, track=track, image_noise=0.0, severity=4)
    for seed in range(3):
        env.reset(seed=seed)
        shows = []
        while not env.disturbed and not env.done:
            env.advance(lane_keeping(env))
            differ = np.any(env._observe(env.disturbance) != env.observe(clean=True), axis=-1)
            shows.append(bool(differ.any()))
        # A pixel may need one more step to be covered; before t0 nothing shows (one step of rounding at an edge).
        for _ in range(3):
            env.advance(lane_keeping(env))
            shows.append(bool(np.any(env.observe() != env.observe(clean=True))))
        first = 1 + shows.index(True)
        flat = env.disturbance.body == "patch_round"  # seen at a grazing angle
        assert abs(first - env.onset) <= (3 if flat else 1), (name, track, seed)
    env.close()


@pytest.mark.parametrize("severity", [1, 3, 5])
@pytest.mark.parametrize("track", ["ridge", "hollow"])
def test_obstacles_are_placed_out_of_view_and_met_on_the_way(track: str, severity: int) -> None:
    env = make(disturbance="obstacle", severity=severity, track=track)
    onsets, distances = [], []
    for seed in range(25):
        env.reset(seed=seed)
        ahead = (env.disturbance.s - env.state[0]) % env.track.length
        assert MET[0] * 0.2 - 1e-6 <= ahead <= LATEST * 0.2
        assert abs(env.disturbance.lateral) <= Obstacle.OFFSET[severity - 1]
        while not env.disturbed:
            env.advance(lane_keeping(env))
        onsets.append(env.onset)
        distances.append((env.disturbance.s - env.state[0]) % env.track.length)
    in_view = np.array(onsets) == 0  # at some starts no place that is met in time is hidden
    assert in_view.mean() <= (0.2 if track == "ridge" else 0.0) and max(onsets) < 80
    hidden = np.array(distances)[~in_view]
    assert min(hidden) > 5.0 and np.median(hidden) < 10.5


def test_a_severe_obstacle_comes_into_view_later() -> None:
    medians = []
    for severity in (1, 5):
        env = make(disturbance="obstacle", severity=severity)
        distances = []
        for seed in range(25):
            env.reset(seed=seed)
            while not env.disturbed:
                env.advance(lane_keeping(env))
            distances.append((env.disturbance.s - env.state[0]) % env.track.length)
        medians.append(np.median(distances))
    assert medians[1] < medians[0] - 0.5


def test_a_bank_hides_what_is_behind_it() -> None:
    env = make(disturbance="obstacle")
    env.reset(seed=0)
    sight = env._eye_of()
    s = 20.0
    x, y = env.track.point(s, -1.2)
    left = float(env.track.heading(s)) + math.pi / 2
    quaternion = np.array([math.cos(left / 2), 0.0, 0.0, math.sin(left / 2)])
    eye = np.array([x, y, 0.12])
    for e_y, height, expected in ((1.3, 0.1, True), (2.9, 0.4, False), (2.9, 0.95, True)):
        post = np.array([[*env.track.point(s, e_y), low] for low in (height - 0.1, height)])
        assert sight.sees(eye, quaternion, post) == expected, (e_y, height)
    behind = np.array([[*env.track.point(s, -1.45), low] for low in (0.1, 0.4)])
    assert not sight.sees(eye, quaternion, behind)


@pytest.mark.parametrize("body", [*Obstacle.bodies, *ObstacleHeldOut.bodies])
def test_surface_points_lie_on_the_surface(body: str) -> None:
    env = make()
    env.reset(seed=0)
    points = surface_points(env.simulator.nominal, body)
    assert points[:, 2].min() > -0.1 and 0.4 < points[:, 2].max() < 1.0
    assert 0.4 < np.ptp(points[:, 0]) + np.ptp(points[:, 1]) < 1.5
    geom = env.simulator.nominal.body(body).geomadr[0]
    reach = np.linalg.norm(points - env.simulator.nominal.geom_pos[geom], axis=1).max()
    assert reach <= env.simulator.nominal.geom_rbound[geom] + 1e-9


# ---------------------------------------------------------------------------------------------------------- obstacle


def test_held_out_obstacles_share_neither_shape_nor_colour() -> None:
    assert not set(Obstacle.bodies) & set(ObstacleHeldOut.bodies)
    assert not set(Obstacle.COLOURS) & set(ObstacleHeldOut.COLOURS)


@pytest.mark.parametrize("env_id", [IMAGE, STATE])
def test_a_car_that_keeps_its_lane_hits_it_mostly(env_id: str) -> None:
    env = make(env_id, disturbance="obstacle")
    touched = [drive(env, seed)._touched for seed in range(20)]  # type: ignore[attr-defined]
    assert np.mean(touched) >= 0.8


@pytest.mark.parametrize("body", [*Obstacle.bodies, *ObstacleHeldOut.bodies])
def test_touching_it_is_a_failure_at_first_contact(body: str) -> None:
    env = make(disturbance="obstacle" if body in Obstacle.bodies else "obstacle-held-out")
    seed = next(seed for seed in range(60) if env.reset(seed=seed) and env.disturbance.body == body)
    drive(env, seed)
    s, e_y, radius = env.parameters[6:9]
    if env._touched:  # type: ignore[attr-defined]
        assert env.terminated and not env.is_success
        gap = (s - env.state[0]) % env.track.length
        assert gap < 0.505 + radius + 0.25 and abs(e_y - env.state[1]) < 0.3 + radius
    # A car that drives where it is not does not touch it.
    env.reset(seed=seed)
    side = -math.copysign(1.2, env.disturbance.lateral)
    if abs(env.disturbance.lateral - side) > 0.2265 + radius + 0.05:
        env.reset(seed=seed, options={"initial_state": [s - 1.5, side, 0, 4, 0, 0, 0]})
        while not env.done and env.state[0] < s + 0.6:
            env.advance([0.5 * float(env.track.curvature(s))])
            assert not env._touched  # type: ignore[attr-defined]


def test_the_expert_is_told_at_first_sight_and_of_a_circle_that_covers_it() -> None:
    env = make(disturbance="obstacle", severity=2)
    for seed in range(6):
        env.reset(seed=seed)
        assert not env.parameters[6:9].any()
        while not env.disturbed:
            env.advance(lane_keeping(env))
        s, e_y, radius = env.parameters[6:9]
        assert 0.25 < radius < 0.45
        assert np.hypot(*(env.disturbance.points[:, :2] - env.track.point(s, e_y)).T).max() <= radius + 1e-6


# -------------------------------------------------------------------------------------------------------- the others


@pytest.mark.parametrize("name", SEEN)
def test_what_is_only_seen_does_not_move_the_car(name: str) -> None:
    env, twin = make(disturbance=name, severity=5), make()
    for seed in range(2):
        env.reset(seed=seed)
        twin.reset(seed=seed)
        while not env.done:
            action = lane_keeping(env)
            env.advance(action)
            twin.advance(action)
            np.testing.assert_array_equal(env.state, twin.state)
            np.testing.assert_array_equal(env.parameters[:6], twin.parameters[:6])
            assert not env.parameters[6:9].any()


@pytest.mark.rendering
@pytest.mark.parametrize("name", offered("rally-car-image"))
def test_the_picture_changes_where_it_should(name: str) -> None:
    """The share of the picture that changes grows with the severity (for what covers or dims), and is never all."""
    changed = []
    for severity in (1, 5):
        env = make(disturbance=name, severity=severity)
        env.reset(seed=3)
        while not env.disturbed or (env.disturbance.placed and env.step_index < env.onset + 12):
            env.advance(lane_keeping(env))
        difference = np.abs(env.observe().astype(float) - env.observe(clean=True))
        changed.append(difference.mean())
        env.close()
    if name == "steering-bias":
        assert changed == [0.0, 0.0]
    else:
        assert min(changed) > 0.0
    if name in ("dusk", "camera-dirt", "pixel-noise", "camera-pitch"):
        assert changed[1] > 2.0 * changed[0]


def test_mud_is_slippery_where_it_lies() -> None:
    env, twin = make(disturbance="mud", severity=5), make()
    env.reset(seed=0)
    twin.reset(seed=0)
    frictions, inside = [], []
    while not env.done:
        frictions.append(env.parameters[4])
        inside.append(np.hypot(*(env.simulator.data.qpos[:2] - env.disturbance.position[:2])) < 0.4)
        action = lane_keeping(env)
        env.advance(action)
        if not twin.done:
            twin.advance(action)
        if min(frictions) == 1.0:  # up to the patch, nothing is different
            np.testing.assert_array_equal(env.state, twin.state)
    assert frictions[0] == 1.0 and any(inside)
    assert all(friction == pytest.approx(0.15) for friction, here in zip(frictions, inside, strict=True) if here)
    assert not np.array_equal(env.state, twin.state)
    assert (env.simulator.nominal.geom_friction[env._tyres, 0] == 1.0).all()  # type: ignore[attr-defined]


def test_steering_bias_is_added_from_the_onset_on() -> None:
    env = make(disturbance="steering-bias", severity=3)
    env.reset(seed=1, options={"onset": 5})
    for _ in range(5):
        assert env.parameters[5] == 0.0
        env.advance([0.0])
    assert abs(env.parameters[5]) == pytest.approx(0.10)
    for _ in range(6):
        env.advance([0.0])
    assert env.state[6] == pytest.approx(env.parameters[5], rel=0.1)


def test_localisation_bias_is_observed_and_not_real() -> None:
    env = make(STATE, disturbance="localisation-bias", severity=2)
    env.reset(seed=1, options={"onset": 0})
    assert abs(env.observe()[1] - env.state[1]) == pytest.approx(0.4, abs=1e-6)
    np.testing.assert_allclose(env.observe(clean=True)[:7], env.state, atol=1e-5)


def test_a_later_episode_keeps_nothing_of_an_earlier_one() -> None:
    env = make(disturbance="obstacle")
    env.reset(seed=1)
    model = env.simulator.disturbed
    before = model.body_pos.copy(), model.geom_rgba.copy()
    for seed in range(2, 6):
        env.reset(seed=seed)
    assert (model.geom_rgba[:, 3] != env.simulator.nominal.geom_rgba[:, 3]).sum() == 1
    env.reset(seed=1)
    np.testing.assert_array_equal(model.body_pos, before[0])
    np.testing.assert_array_equal(model.geom_rgba, before[1])
    parked = [env.simulator.nominal.body(name).pos[2] for name in (*Obstacle.bodies, *ObstacleHeldOut.bodies)]
    assert set(parked) == {-5.0}


def test_the_onset_of_a_placed_disturbance_cannot_be_given() -> None:
    for name in PLACED:
        with pytest.raises(ValueError, match="cannot be given"):
            make(disturbance=name).reset(seed=0, options={"onset": 10})


@pytest.mark.parametrize("name", sorted({*offered("rally-car-image"), *offered("rally-car")}))
def test_severities_are_ordered(name: str) -> None:
    cls = DISTURBANCES[name]
    rising = sorted(set(cls.levels))
    assert len(rising) == len(SEVERITIES) and list(cls.levels) in (rising, rising[::-1])
    assert str(cls.levels[0]) in cls.describe(1) or f"{cls.levels[0]:g}" in cls.describe(1)


def test_placed_disturbances_are_of_one_base_class() -> None:
    assert {name for name, cls in DISTURBANCES.items() if cls.placed} == {
        name for name, cls in DISTURBANCES.items() if issubclass(cls, Placed)
    }
    kwargs: dict[str, Any] = {"disturbance": "obstacle", "severity": 1}
    assert gym.make(IMAGE, **kwargs).unwrapped.disturbance.placed
