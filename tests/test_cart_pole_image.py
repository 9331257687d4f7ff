"""The cart-pole from images: what is seen changes, what happens does not."""

from __future__ import annotations

from functools import cache
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from numpy.typing import NDArray

from safeswitch.tasks import visual
from safeswitch.tasks.cart_pole import CartPoleEnv
from safeswitch.tasks.cart_pole_image import RAIL, CartPoleImageEnv
from safeswitch.tasks.disturbances import DISTURBANCES, SEVERITIES, offered

pytestmark = pytest.mark.rendering

VISUAL = [name for name in offered("cart-pole-image") if issubclass(DISTURBANCES[name], visual.Visual)]
OBJECTS = ["object", "object-held-out", "object-passing", "object-far"]
ONSET = 12


@cache
def make(name: str | None, severity: int = 3) -> CartPoleImageEnv:
    """One environment per cell."""
    return CartPoleImageEnv(name, severity)


def reset(name: str | None, seed: int, severity: int = 3, onset: int = ONSET) -> CartPoleImageEnv:
    """An environment at step 0 of an episode with a known onset."""
    env = make(name, severity)
    env.reset(seed=seed, options={} if name is None else {"onset": onset})
    return env


def frame_at(env: CartPoleImageEnv, step: int) -> NDArray[Any]:
    """The frame after `step` steps without force."""
    while env.step_index < step:
        env.advance([0.0])
    return env.observe()


def changed(one: NDArray[Any], other: NDArray[Any], by: int = 0) -> NDArray[np.bool_]:
    """Pixels (64, 64) in which two frames differ by more than `by`."""
    return (np.abs(one.astype(int) - other.astype(int)) > by).any(axis=2)


def test_visual_disturbances_are_those_of_the_issue() -> None:
    assert set(VISUAL) == {
        *OBJECTS, "occlusion", "lighting", "camera-shift", "pixel-noise", "background"
    }  # fmt: skip
    assert {"cart-mass", "push"} < set(offered("cart-pole-image"))
    assert "sensor-noise" not in offered("cart-pole-image")
    assert [name for name in VISUAL if DISTURBANCES[name].benign] == ["object-far"]


@pytest.mark.parametrize("name", VISUAL)
@pytest.mark.parametrize("severity", [1, 5])
def test_what_is_only_seen_never_touches_the_physics(name: str, severity: int) -> None:
    twin, env = reset(None, 5), reset(name, 5, severity)
    rng = np.random.default_rng(0)
    while not twin.done:
        action = rng.uniform(-0.6, 0.6, 1)
        twin.advance(action)
        env.step(action)  # observed on one side only: drawing leaves no trace either
        np.testing.assert_array_equal(env.snapshot(), twin.snapshot())
        np.testing.assert_array_equal(env.parameters, twin.parameters)
    assert env.done and env.disturbed


@pytest.mark.parametrize("name", VISUAL)
def test_it_shows_from_the_onset_on_and_never_in_the_clean_view(name: str) -> None:
    seen = []
    for seed in range(4):
        twin, env = reset(None, seed), reset(name, seed)
        for step in range(ONSET + 12):
            clean = frame_at(twin, step)
            np.testing.assert_array_equal(frame_at(env, step) if step < ONSET else env.observe(clean=True), clean)
            if step >= ONSET:
                frame_at(env, step)
                np.testing.assert_array_equal(env.observe(clean=True), clean)
                seen.append(changed(env.observe(), clean).any())
            twin.advance([0.0])
            if step >= ONSET - 1:
                env.advance([0.0])
    assert np.mean(seen) > 0.7  # an object may hide behind the rail, and a passing one enters first


@pytest.mark.parametrize("name", [*VISUAL, "cart-mass"])
def test_a_restored_episode_shows_the_same_frames(name: str) -> None:
    env = reset(name, 3)
    snapshots, frames = [], []
    while env.step_index < ONSET + 10:
        snapshots.append(env.snapshot())
        frames.append(env.observe())
        env.advance([-0.1])
    for index in (20, 3, 15, 11, 12):
        env.restore(snapshots[index])
        np.testing.assert_array_equal(env.observe(), frames[index])


def test_the_frame_shows_cart_and_pole_where_they_are() -> None:
    env = make(None)
    for x, theta in ((0.0, 0.0), (-0.8, 0.0), (0.8, 3.1), (0.4, 1.57), (-0.4, -1.57)):
        env.reset(seed=0, options={"initial_state": [x, 0.0, theta, 0.0]})
        frame = env.observe().astype(int)
        bob = np.argwhere((frame[..., 0] > frame[..., 1] + 60) & (frame[..., 1] < 75))
        scale = 64 / 2.2  # pixels per metre in the plane of the pole; the camera is as high as the hinge
        row = 32 - scale * 0.5 * np.cos(theta)
        column = 32 + scale * (x + 0.5 * np.sin(theta))
        assert len(bob) >= 6  # large enough to be read
        np.testing.assert_allclose(bob.mean(axis=0) + 0.5, (row, column), atol=1.2)


def test_a_frame_says_nothing_of_velocities() -> None:
    env = make(None)
    frames = []
    for velocity in (-1.0, 1.0):
        env.reset(seed=0, options={"initial_state": [0.1, velocity, 2.0, 3 * velocity]})
        frames.append(env.observe())
    np.testing.assert_array_equal(*frames)


def test_two_angles_a_few_degrees_apart_look_different() -> None:
    env = make(None)
    for theta in (0.0, 0.8, 1.57, 3.0):
        frames = []
        for offset in (0.0, 0.05):
            env.reset(seed=0, options={"initial_state": [0.2, 0.0, theta + offset, 0.0]})
            frames.append(env.observe())
        assert changed(*frames, by=8).sum() >= 2


@pytest.mark.parametrize("name", OBJECTS)
def test_objects_grow_with_the_severity(name: str) -> None:
    step = ONSET + (12 if name == "object-passing" else 1)
    areas = [
        np.mean([changed(frame_at(env := reset(name, seed, severity), step), env.observe(clean=True)).sum()
                 for seed in range(12)])
        for severity in SEVERITIES
    ]  # fmt: skip
    assert areas == sorted(areas) and areas[-1] > 2 * areas[0]


@pytest.mark.parametrize("name", [name for name in VISUAL if name not in OBJECTS])
def test_the_picture_differs_more_with_the_severity(name: str) -> None:
    levels = []
    for severity in SEVERITIES:
        env = reset(name, 2, severity)
        frame = frame_at(env, ONSET).astype(float)
        levels.append(np.abs(frame - env.observe(clean=True)).mean())
    assert levels == sorted(levels) and levels[-1] > 1.5 * levels[0] > 0


def test_a_far_object_never_touches_what_matters() -> None:
    for seed in range(12):
        env = reset("object-far", seed, 5)
        frame = frame_at(env, ONSET)
        rows, columns = np.nonzero(changed(frame, env.observe(clean=True)))
        # The pole reaches up to 0.6 m above the hinge: row 14. The object stays above, in a corner.
        assert rows.max() < 14
        assert columns.max() < 20 or columns.min() > 43


def test_a_passing_object_enters_and_leaves() -> None:
    env = reset("object-passing", 4, 5)
    seen = []
    for step in range(ONSET, ONSET + 45):
        frame = frame_at(env, step)
        seen.append(bool(changed(frame, env.observe(clean=True)).any()))
    first, last = seen.index(True), len(seen) - seen[::-1].index(True)
    assert first <= 5 and 10 <= last - first <= visual.ObjectPassing.STEPS[1] and not any(seen[last:])


def test_calibration_and_held_out_kinds_share_nothing() -> None:
    ordinary, held_out = (
        {prop for props in kinds.values() for prop in props} for kinds in (visual.KINDS, visual.HELD_OUT)
    )
    assert not ordinary & held_out
    for name, props in (("object", ordinary), ("object-held-out", held_out), ("object-passing", ordinary)):
        used = set()
        for seed in range(40):
            env = reset(name, seed)
            model = env.simulator.disturbed
            used |= {model.geom(i).name for i in range(model.ngeom) if model.geom(i).name.startswith("prop_")
                     and model.geom_rgba[i, 3] > 0}  # fmt: skip
        assert used == props


def test_an_object_does_not_stay_for_the_next_episode() -> None:
    env = CartPoleImageEnv("object", 5)
    for seed in range(8):
        env.reset(seed=seed, options={"onset": 1})
        frame_at(env, 3)
    fresh = CartPoleImageEnv("object", 5)
    for one in (env, fresh):
        one.reset(seed=3, options={"onset": 1})
    np.testing.assert_array_equal(frame_at(env, 3), frame_at(fresh, 3))


def test_pixel_noise_has_the_stated_size_and_is_new_in_every_frame() -> None:
    env = reset("pixel-noise", 1, 3)
    residuals = []
    for step in range(ONSET, ONSET + 5):
        frame = frame_at(env, step).astype(float)
        clean = env.observe(clean=True).astype(float)
        inside = (clean > 70) & (clean < 150)  # far from where clipping would show
        residuals.append((frame - clean)[inside])
    assert np.concatenate(residuals).std() == pytest.approx(255 * 0.08, rel=0.1)
    assert abs(np.concatenate(residuals).mean()) < 2.0


def test_the_dynamics_are_those_of_the_cart_pole_on_a_shorter_rail() -> None:
    image, state = CartPoleImageEnv(), CartPoleEnv(rail=RAIL)
    for env in (image, state):
        env.reset(seed=9)
    for _ in range(20):
        for env in (image, state):
            env.advance([-0.1])
        np.testing.assert_array_equal(image.state, state.state)
    assert image.config.rail == RAIL and CartPoleEnv().config.rail != RAIL
    assert CartPoleImageEnv(rail=1.0).config.rail == 1.0


def test_expert_continuations_draw_nothing() -> None:
    env = CartPoleImageEnv("object")
    env.reset(seed=0)
    env.close()
    expert = env.make_expert()
    expert.reset()
    while not env.done:
        env.advance(expert.action(env.state, env.parameters))
    assert env.is_success and env._eye is None


def test_render_shows_the_disturbed_scene() -> None:
    env = CartPoleImageEnv("object", 5, render_mode="rgb_array")
    env.reset(seed=0, options={"onset": 2})
    frame_at(env, 1)
    before = env.render()
    env.advance([0.0])
    after = env.render()
    assert before is not None and after is not None and before.shape == (480, 480, 3)
    assert changed(before, after, by=40).sum() > 500
    env.close()


@pytest.mark.parametrize("mode", ["sync", "async"])
def test_vector_environments_see_the_same(mode: str) -> None:
    kwargs = {"context": "spawn"} if mode == "async" else {}
    envs = gym.make_vec("SafeSwitch/CartPoleImage-v0", 2, mode, vector_kwargs=kwargs, disturbance="object")
    observations, _ = envs.reset(seed=[3, 4])
    alone = make("object")
    for seed, observation in zip((3, 4), observations, strict=True):
        np.testing.assert_array_equal(alone.reset(seed=seed)[0], observation)
    observations, *_ = envs.step(np.zeros((2, 1), np.float32))
    np.testing.assert_array_equal(alone.step(np.zeros(1, np.float32))[0], observations[1])
    envs.close()
