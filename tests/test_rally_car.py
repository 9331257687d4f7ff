"""Laws of the rally car: masses, turning like a bicycle, speed, success, snapshots and its twin."""

from __future__ import annotations

import math
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
import pytest

import safeswitch  # noqa: F401
from safeswitch.handover.episode import NeverSwitch, run_episode
from safeswitch.tasks import car_geometry, rally_car
from safeswitch.tasks.base import TaskEnv
from safeswitch.tasks.car_geometry import FRONT, GAUGE, REAR, WHEELS, bicycle_angle, front_angles
from safeswitch.tasks.rally_car_config import RallyCarConfig

IMAGE, STATE = "SafeSwitch/RallyCarImage-v0", "SafeSwitch/RallyCar-v0"


def make(env_id: str = IMAGE, **kwargs: Any) -> TaskEnv:
    return gym.make(env_id, **kwargs).unwrapped  # type: ignore[return-value]


def lane_keeping(env: TaskEnv) -> np.ndarray:
    """A driver that knows the state: feed-forward of the curvature, and feedback of offset and heading."""
    s, e_y, e_psi, v_x = env.state[:4]
    delta = math.atan((FRONT + REAR) * float(env.track.curvature(s + 0.4))) - 0.35 * e_y - 0.9 * e_psi
    action = np.clip([delta / rally_car.STEERING_LIMIT, 4.0 - v_x], -1.0, 1.0)
    return action[: env.action_space.shape[0]]


def drive(env: TaskEnv, seed: int, **options: Any) -> TaskEnv:
    env.reset(seed=seed, **options)
    while not env.done:
        env.advance(lane_keeping(env))
    return env


# ------------------------------------------------------------------------------------------------------------- model


def test_masses_and_lengths_are_those_of_autorally() -> None:
    env = make()
    env.reset(seed=0)
    model = env.simulator.nominal
    masses = {name: float(model.body(name).mass[0]) for name in ("car", *WHEELS)}
    assert masses == {"car": 20.5, "front_left": 0.82, "front_right": 0.82, "rear_left": 0.89, "rear_right": 0.89}
    parameters = dict(zip(env.parameter_names, env.parameters, strict=True))
    assert parameters["mass"] == pytest.approx(20.5 + 2 * 0.82 + 2 * 0.89)
    assert parameters["l_r"] == pytest.approx(0.23, abs=1e-4)
    assert parameters["l_f"] + parameters["l_r"] == pytest.approx(0.57)
    assert parameters["friction"] == 1.0
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    centre = data.subtree_com[model.body("car").id]
    np.testing.assert_allclose(centre, (0.0, 0.0, 0.12), atol=1e-4)  # the frame of the car is its centre of mass
    tyre = model.geom("tyre_front_left")
    assert 2 * tyre.size[0] == 0.19 and 2 * tyre.size[1] == 0.073


def test_yaw_inertia_is_that_of_the_compiled_car() -> None:
    env = make()
    env.reset(seed=0)
    model = env.simulator.nominal
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    full = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, full, data.qM) if hasattr(data, "qM") else mujoco.mj_fullM(model, data, full)
    # The free joint turns everything about its origin, which is the centre of mass to 0.1 mm.
    assert env.parameters[1] == pytest.approx(full[5, 5], rel=1e-4)


@pytest.mark.parametrize("delta", [-0.4, -0.1, 0.0, 0.2, 0.4])
def test_ackermann_there_and_back(delta: float) -> None:
    left, right = front_angles(delta)
    assert bicycle_angle(left, right) == pytest.approx(delta, abs=1e-12)
    if delta:  # both front axles point at one centre of turn, on the line of the rear axle
        radius = (FRONT + REAR) / math.tan(delta)
        assert (FRONT + REAR) / math.tan(left) == pytest.approx(radius - GAUGE / 2)
        assert (FRONT + REAR) / math.tan(right) == pytest.approx(radius + GAUGE / 2)


@pytest.mark.parametrize(("action", "speed"), [(0.1, 4.0), (-0.3, 4.0), (0.45, 4.0), (-0.6, 3.0), (0.4, 5.0)])
def test_it_turns_like_a_bicycle(action: float, speed: float) -> None:
    env = make(horizon=60, speed=speed)
    env.reset(seed=0, options={"initial_state": [0, 0, 0, speed, 0, 0, 0]})
    env._on_track = lambda: True  # type: ignore[attr-defined]  # free, flat ground
    for _ in range(50):
        env.advance([action])
    v_x, yaw_rate, delta = env.state[3], env.state[5], env.state[6]
    assert abs(yaw_rate * v_x) < 7.0
    assert yaw_rate == pytest.approx(v_x * math.tan(delta) / (FRONT + REAR), rel=0.03)
    assert delta == pytest.approx(rally_car.STEERING_LIMIT * action, rel=0.03)


def test_a_finer_time_step_changes_nothing_that_matters() -> None:
    ends = [drive(make(timestep=timestep, horizon=60), seed=3).state for timestep in (0.005, 0.0025)]
    assert np.abs(ends[0] - ends[1])[[0, 1]].max() < 0.03


def test_throttle_is_a_force() -> None:
    env = make(STATE)
    env.reset(seed=0, options={"initial_state": [0, 0, 0, 3.0, 0, 0, 0]})
    before = env.state[3]
    for _ in range(4):
        env.advance([0.0, 0.5])
    spin = sum(float(env.simulator.nominal.body(name).inertia[1]) for name in WHEELS) / car_geometry.TYRE_RADIUS**2
    force = 0.5 * 4 * 2.4 / car_geometry.TYRE_RADIUS
    assert (env.state[3] - before) / 0.2 == pytest.approx(force / (env.parameters[0] + spin), rel=0.05)


# -------------------------------------------------------------------------------------------------------------- task


@pytest.mark.parametrize("track", ["ridge", "hollow"])
def test_two_laps_at_constant_speed(track: str) -> None:
    env = make(track=track, horizon=680)
    env.reset(seed=1)
    speeds, offsets = [], []
    while not env.done:
        env.advance(lane_keeping(env))
        speeds.append(env.state[3])
        offsets.append(abs(env.state[1]))
    assert env.is_success and max(offsets) < 0.4
    assert min(speeds[20:]) > 0.96 * 4.0 and max(speeds[20:]) < 1.01 * 4.0


def test_episodes_start_anywhere_along_the_lap_near_the_middle() -> None:
    env = make()
    states = np.array([env.reset(seed=seed)[1]["state"] for seed in range(200)])
    counts, _ = np.histogram(states[:, 0], bins=8, range=(0, env.track.length))
    assert counts.min() > 8
    assert np.abs(states[:, 1]).max() <= 0.25 + 1e-6 and np.abs(states[:, 2]).max() <= 0.1 + 1e-3
    assert np.abs(states[:, 3] - 4.0).max() <= 0.2 + 1e-9


def test_the_initial_state_is_the_state() -> None:
    env = make(STATE)
    wanted = np.array([12.3, -0.4, 0.2, 3.5, 0.1, 0.4, -0.15])
    env.reset(seed=0, options={"initial_state": wanted})
    np.testing.assert_allclose(env.state, wanted, atol=1e-6)


def test_it_starts_with_settled_suspension_and_rolling_wheels() -> None:
    env = make(STATE)
    env.reset(seed=0, options={"initial_state": [0, 0, 0, 4.0, 0, 0, 0]})
    heights, speeds = [], []
    for _ in range(10):
        env.advance([0.0, 0.0])
        heights.append(env.simulator.data.qpos[2])
        speeds.append(env.state[3])
    assert np.ptp(heights) < 1e-3 and np.ptp(speeds) < 0.01
    assert heights[0] == pytest.approx(0.12, abs=2e-3)


@pytest.mark.parametrize("e_y", [-1.4, -1.2, 0.0, 1.2, 1.4])
def test_the_whole_car_has_to_be_on_the_track(e_y: float) -> None:
    env = make()
    env.reset(seed=0, options={"initial_state": [0, e_y, 0, 4.0, 0, 0, 0]})
    assert env.terminated == (abs(e_y) + car_geometry.FOOTPRINT[2] > 1.5)  # the bend adds 2 cm at most
    env.reset(seed=0, options={"initial_state": [0, 1.2 * np.sign(e_y), 1.2, 4.0, 0, 0, 0]})
    assert env.terminated == bool(e_y)  # at an angle, a corner is over the edge


def test_success_takes_all_steps() -> None:
    env = make(horizon=40)
    env.reset(seed=2)
    while not env.done:
        assert not env.is_success
        env.advance(lane_keeping(env))
    assert env.is_success and env.step_index == 40
    env.reset(seed=2)
    while not env.done:
        env.advance([1.0])
    assert env.terminated and not env.is_success and env.step_index < 40


def test_a_car_on_its_roof_has_failed() -> None:
    env = make()
    env.reset(seed=0)
    env.simulator.data.qpos[3:7] = (0.0, 1.0, 0.0, 0.0)
    env.advance([0.0])
    assert env.terminated


@pytest.mark.parametrize("track", ["ridge", "hollow"])
def test_the_observation_is_the_state_and_what_is_ahead(track: str) -> None:
    env = make(STATE, track=track)
    observation, info = env.reset(seed=4)
    np.testing.assert_allclose(observation[:7], info["state"], rtol=1e-6, atol=1e-6)
    ahead = [float(env.track.curvature(info["state"][0] + distance)) for distance in rally_car.PREVIEW]
    np.testing.assert_allclose(observation[7:], ahead, atol=1e-6)


@pytest.mark.rendering
def test_image_noise_is_a_function_of_episode_and_step() -> None:
    noisy, clean = make(), make(image_noise=0.0)
    first, plain = noisy.reset(seed=5)[0], clean.reset(seed=5)[0]
    difference = first.astype(float) - plain
    assert difference.std() == pytest.approx(255 * 0.009, rel=0.1) and abs(difference.mean()) < 0.1
    np.testing.assert_array_equal(first, noisy.observe())
    noisy.advance([0.0])
    clean.advance([0.0])
    other = noisy.observe().astype(float) - clean.observe()
    assert abs(np.corrcoef(other.ravel(), difference.ravel())[0, 1]) < 0.05
    noisy.close()
    clean.close()


@pytest.mark.parametrize("design", [{"speed": 0.0}, {"horizon": 1.5}, {"control_dt": 0.012}, {"sped": 4.0}])
def test_bad_numbers_are_refused(design: dict[str, float]) -> None:
    with pytest.raises(ValueError):
        make(**design)
    with pytest.raises(ValueError, match="ridge"):
        make(track="ridg")


def test_the_configuration_is_what_the_environment_uses() -> None:
    env = make(speed=3.0, horizon=30)
    assert env.config == RallyCarConfig.of(speed=3.0, horizon=30) and env.horizon == 30
    assert env.reset(seed=0)[1]["state"][3] == pytest.approx(3.0, abs=0.21)


# ------------------------------------------------------------------------------------------------ snapshots and onset


@pytest.mark.parametrize("env_id", [IMAGE, STATE])
@pytest.mark.parametrize("disturbance", [None, "obstacle", "mud", "steering-bias"])
def test_restored_episodes_continue_bit_for_bit(env_id: str, disturbance: str | None) -> None:
    env, other = make(env_id, disturbance=disturbance), make(env_id, disturbance=disturbance)
    env.reset(seed=0)
    snapshots, onsets = [env.snapshot()], [env.onset]
    actions = []
    while not env.done:
        actions.append(lane_keeping(env))
        env.advance(actions[-1])
        snapshots.append(env.snapshot())
        onsets.append(env.onset)
    other.reset(seed=0)
    for step in np.random.default_rng(0).permutation(len(actions))[:6]:  # before and after t0, in any order
        other.restore(snapshots[step])
        assert other.onset == onsets[step] and other.step_index == step
        for later in range(step, len(actions)):
            other.advance(actions[later])
            np.testing.assert_array_equal(other.snapshot(), snapshots[later + 1])
        assert other.onset == env.onset and other.is_success == env.is_success


@pytest.mark.parametrize("env_id", [IMAGE, STATE])
@pytest.mark.parametrize("disturbance", ["obstacle", "mud", "roadside", "puddle-paint"])
def test_the_twin_is_identical_until_the_onset(env_id: str, disturbance: str) -> None:
    env, twin = make(env_id, disturbance=disturbance), make(env_id)
    for seed in range(4):
        env.reset(seed=seed)
        twin.reset(seed=seed)
        assert env.onset == env.horizon or env.onset == 0
        while not env.disturbed and not env.done:
            np.testing.assert_array_equal(env.snapshot()[:4], twin.snapshot()[:4])
            np.testing.assert_array_equal(env.snapshot()[5:], twin.snapshot()[5:])
            np.testing.assert_array_equal(env.parameters, twin.parameters)
            action = lane_keeping(env)
            env.advance(action)
            twin.advance(action)
        assert env.onset == env.step_index < env.horizon
        assert disturbance != "obstacle" or env.parameters[8] > 0.2 and twin.parameters[8] == 0.0


class Blind:
    """A learner whose mean is lane keeping: it reads the state of the environment and never sees an obstacle."""

    def __init__(self, env: TaskEnv):
        self.env = env

    def reset(self, seed: int) -> None:
        pass

    def predict(self, observation: np.ndarray, step: int) -> Any:
        from safeswitch.protocols import Prediction

        action = lane_keeping(self.env)
        return Prediction(action, np.zeros_like(action), np.zeros_like(action))


class Never(NeverSwitch):
    """Remembers when it was armed."""

    def reset(self, seed: int) -> None:
        self.armed = -1

    def arm(self, step: int) -> Any:
        self.armed = step
        return super().arm(step)


def test_the_control_loop_arms_at_first_sight() -> None:
    env = make(STATE, disturbance="obstacle")
    rule = Never()
    episode = run_episode(env, Blind(env), [], rule, None, seed=0, arming="onset", record_snapshots=True)
    assert 0 < episode.onset < episode.horizon and rule.armed == episode.arming_step == episode.onset
    assert not episode.success and episode.length < episode.horizon  # it drove into the obstacle
    # An obstacle that never comes into view: the episode is disturbed, and never armed.
    short = make(STATE, disturbance="obstacle", horizon=int(episode.onset) - 1)
    episode = run_episode(short, Blind(short), [], rule, None, seed=0, arming="onset")
    assert episode.onset == episode.arming_step == episode.horizon == short.horizon and rule.armed == -1
    assert episode.success


def test_a_snapshot_of_the_twin_is_valid_before_and_after_first_sight() -> None:
    env, twin = make(disturbance="roadside"), make()
    env.reset(seed=1)
    drive(env, seed=1)
    onset = env.onset
    twin.reset(seed=1)
    while twin.step_index < onset + 3:
        env.restore(np.array(twin.snapshot()))
        assert env.disturbed == (twin.step_index >= onset)
        twin.advance(lane_keeping(twin))
