"""The cart-pole obeys its equations of motion, its success criterion and its documentation."""

from __future__ import annotations

import copy
import math
import pickle
from dataclasses import asdict
from functools import cache

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

import safeswitch
from safeswitch.tasks import cart_pole, models
from safeswitch.tasks.cart_pole import CartPoleConfig, CartPoleEnv, wrap

GRAVITY = 9.81
DYNAMIC = (None, "cart-mass", "pole-length", "joint-friction", "motor-gain")


def accelerations(state: NDArray, action: float, parameters: NDArray) -> NDArray:
    """(x_ddot, theta_ddot) of the equations in the docstring of `CartPoleEnv`."""
    M, m, length, inertia, b, c, limit = parameters
    _, x_dot, theta, theta_dot = state
    mass = np.array([[M + m, m * length * math.cos(theta)], [m * length * math.cos(theta), inertia + m * length**2]])
    force = np.array(
        [
            limit * action - b * x_dot + m * length * math.sin(theta) * theta_dot**2,
            m * GRAVITY * length * math.sin(theta) - c * theta_dot,
        ]
    )
    return np.linalg.solve(mass, force)


@cache
def cached(disturbance: str | None = None, severity: int = 3) -> CartPoleEnv:
    """One environment for many examples: making it takes longer than an episode."""
    return CartPoleEnv(disturbance, severity)


states = st.tuples(st.floats(-1.9, 1.9), st.floats(-5, 5), st.floats(-7, 7), st.floats(-12, 12)).map(np.array)


@pytest.mark.parametrize("disturbance", DYNAMIC)
@given(state=states, action=st.floats(-1, 1), severity=st.integers(1, 5))
def test_acceleration_is_the_analytic_one(
    disturbance: str | None, state: NDArray, action: float, severity: int
) -> None:
    env = cached(disturbance, severity)
    env.reset(seed=0, options={"initial_state": state, "onset": 0})
    simulator = env.simulator
    simulator.data.ctrl[:] = action
    mujoco.mj_forward(simulator.model, simulator.data)
    expected = accelerations(env.state, action, env.parameters)
    np.testing.assert_allclose(simulator.data.qacc, expected, rtol=1e-9, atol=1e-9)


def test_trajectory_is_that_of_the_equations() -> None:
    """One second under varying force, against RK4 on the docstring's equations with the same time step."""
    env = CartPoleEnv("cart-mass", 3)
    env.reset(seed=0, options={"initial_state": [0.1, 0.2, 2.5, -0.3], "onset": 0})
    parameters, dt = env.parameters, env.config.timestep
    state = env.state

    def rate(s: NDArray, action: float) -> NDArray:
        x_ddot, theta_ddot = accelerations(s, action, parameters)
        return np.array([s[1], x_ddot, s[3], theta_ddot])

    for step in range(17):
        action = 0.3 * math.sin(1.7 * step)
        env.advance([action])
        for _ in range(3):
            k1 = rate(state, action)
            k2 = rate(state + 0.5 * dt * k1, action)
            k3 = rate(state + 0.5 * dt * k2, action)
            k4 = rate(state + dt * k3, action)
            state = state + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        np.testing.assert_allclose(env.state, state, rtol=0, atol=1e-10)


def test_energy_is_kept_without_friction() -> None:
    env = CartPoleEnv(cart_damping=0.0, pole_damping=0.0)
    env.reset(seed=0, options={"initial_state": [0.0, 0.1, 2.0, 0.0]})
    M, m, length, inertia, *_ = env.parameters

    def energy() -> float:
        _, v, theta, w = env.state
        kinetic = 0.5 * (M + m) * v**2 + m * length * math.cos(theta) * v * w + 0.5 * (inertia + m * length**2) * w**2
        return kinetic + m * GRAVITY * length * math.cos(theta)

    before = energy()
    for _ in range(50):
        env.advance([0.0])
    assert energy() == pytest.approx(before, abs=2e-5)


def test_time_step_is_fine_enough() -> None:
    ends = []
    for timestep in (0.02, 0.001):
        env = CartPoleEnv(timestep=timestep)
        env.reset(seed=0, options={"initial_state": [0.0, 0.0, 2.0, 0.0]})
        for _ in range(17):
            env.advance([0.0])
        ends.append(env.state)
    np.testing.assert_allclose(*ends, rtol=0, atol=1e-5)


def test_signs() -> None:
    """Theta > 0 leans to +x and falls there; a positive action pushes to +x."""
    env = CartPoleEnv()
    env.reset(seed=0, options={"initial_state": [0.0, 0.0, 0.1, 0.0]})
    env.simulator.update_kinematics(env.simulator.model)
    x, _, z = env.simulator.data.xipos[env.simulator.model.body("pole").id]
    hinge = env.simulator.data.xpos[env.simulator.model.body("pole").id]
    np.testing.assert_allclose([x - hinge[0], z - hinge[2]], 0.5 * np.array([math.sin(0.1), math.cos(0.1)]))
    env.advance([0.0])
    assert env.state[2] > 0.1
    env.reset(seed=0, options={"initial_state": [0.0, 0.0, math.pi, 0.0]})
    env.advance([1.0])
    assert env.state[0] > 0


def test_parameters_are_those_of_the_configuration() -> None:
    config = CartPoleConfig()
    env = CartPoleEnv()
    env.reset(seed=0)
    np.testing.assert_array_equal(env.parameters, [getattr(config, name) for name in env.parameter_names])
    changed = CartPoleEnv(cart_mass=1.3, pole_length=0.41, force_limit=7.7, pole_damping=0.0123)
    changed.reset(seed=0)
    np.testing.assert_array_equal(changed.parameters, [1.3, 0.1, 0.41, config.pole_inertia, 0.05, 0.0123, 7.7])


def test_xml_states_the_nominal_numbers() -> None:
    """The file that readers open says what is simulated."""
    plain = models.compile_model(models.compose("cart_pole/cart_pole.xml"))
    composed = models.cart_pole(CartPoleConfig())
    for name in ("body_mass", "body_inertia", "body_ipos", "dof_damping", "actuator_gear", "geom_pos", "geom_size"):
        np.testing.assert_allclose(getattr(plain, name), getattr(composed, name), rtol=1e-12, err_msg=name)
    assert plain.opt.timestep == composed.opt.timestep
    np.testing.assert_array_equal(composed.opt.gravity, [0, 0, -GRAVITY])


def test_nothing_collides() -> None:
    model = models.cart_pole(CartPoleConfig())
    assert not model.geom_contype.any() and not model.geom_conaffinity.any()
    assert model.njnt == 2 and not model.jnt_limited.any()


def test_parameter_names_are_those_of_the_expert() -> None:
    from safeswitch.expert.cart_pole_model import PARAMETERS

    assert CartPoleEnv.parameter_names == PARAMETERS


def test_success_needs_the_last_second() -> None:
    env = CartPoleEnv(cart_damping=0.0, pole_damping=0.0)
    env.reset(seed=0, options={"initial_state": [0.0, 0.0, 0.0, 0.0]})
    assert env.success_steps == math.ceil(1.0 / env.control_dt) == 17
    for step in range(1, 17):  # the start is the first good state
        assert not env.is_success, step
        env.advance([0.0])
    assert env.is_success
    while env.is_success:  # nothing balances it once the pole is pushed over
        env.advance([1.0])
    assert abs(wrap(env.state[2])) >= cart_pole.SUCCESS_ANGLE


def test_a_whole_turn_is_upright_again() -> None:
    env = CartPoleEnv()
    for turns in (-1, 0, 1, 2):
        env.reset(seed=0, options={"initial_state": [0.0, 0.0, turns * math.tau, 0.0]})
        for _ in range(16):
            env.advance([0.0])
        assert env.is_success
        assert env.observe()[2] == pytest.approx(0.0, abs=1e-6)
        assert env.state[2] == pytest.approx(turns * math.tau, abs=1e-6)


def test_leaving_the_rail_is_failure() -> None:
    env = CartPoleEnv()
    env.reset(seed=0, options={"initial_state": [1.4, 1.0, 0.0, 0.0]})
    terminated = truncated = False
    while not (terminated or truncated):
        observation, reward, terminated, truncated, info = env.step(np.array([1.0], np.float32))
    assert terminated and not truncated and env.done and env.terminated
    assert observation[0] > env.config.rail and reward == 0.0 and not info["is_success"]
    with pytest.raises(RuntimeError, match="reset"):
        env.step(np.zeros(1, np.float32))


def test_horizon_truncates() -> None:
    env = CartPoleEnv()
    env.reset(seed=1)
    flags = [env.step(np.zeros(1, np.float32))[2:4] for _ in range(env.horizon)]
    assert flags == [(False, False)] * (env.horizon - 1) + [(False, True)]
    assert env.step_index == env.horizon


@given(x=st.floats(-2, 2), theta=st.floats(-10, 10))
def test_reward(x: float, theta: float) -> None:
    env = cached()
    env.reset(seed=0, options={"initial_state": [x, 0.0, theta, 0.0]})
    expected = max((1 + math.cos(theta)) / 2 * (1 - (x / env.config.rail) ** 2), 0.0)
    assert env._reward() == pytest.approx(expected, abs=1e-12)


@given(theta=st.floats(-50, 50))
def test_wrap(theta: float) -> None:
    wrapped = wrap(theta)
    assert -math.pi <= wrapped <= math.pi
    assert math.cos(wrapped) == pytest.approx(math.cos(theta), abs=1e-9)
    assert math.sin(wrapped) == pytest.approx(math.sin(theta), abs=1e-9)


def test_starts_hang_beside_the_middle() -> None:
    env = CartPoleEnv()
    starts = np.array([env.reset(seed=seed)[1]["state"] for seed in range(300)]) - [0.5, 0, math.pi, 0]
    spread = np.array(cart_pole.INITIAL_SPREAD)
    assert (np.abs(starts) <= spread + 1e-12).all()
    assert (np.abs(starts).max(axis=0) > 0.95 * spread).all()
    assert (np.abs(starts.mean(axis=0)) < 0.15 * spread).all()


def test_wrong_arguments() -> None:
    with pytest.raises(ValueError, match=r"'forcelimit'.*nearest first: force_limit"):
        CartPoleEnv(forcelimit=3.0)
    with pytest.raises(ValueError, match=r"cart_mass must be finite and > 0, got 0"):
        CartPoleEnv(cart_mass=0.0)
    with pytest.raises(ValueError, match="multiple of the time step"):
        CartPoleEnv(control_dt=0.05)
    with pytest.raises(ValueError, match=r"render_mode 'human'.*rgb_array"):
        CartPoleEnv(render_mode="human")
    env = CartPoleEnv("push")
    with pytest.raises(ValueError, match="nearest first: initial_state, onset"):
        env.reset(seed=0, options={"state": [0, 0, 0, 0]})
    with pytest.raises(ValueError, match="initial_state must be"):
        env.reset(seed=0, options={"initial_state": [0, 0, math.nan, 0]})
    with pytest.raises(ValueError, match="step from 0 to 79, got 100"):
        env.reset(seed=0, options={"onset": 100})


def test_configuration_goes_through_gymnasium() -> None:
    env = gym.make("SafeSwitch/CartPole-v0", control_dt=0.04, horizon=150, rail=2.5)
    again = gym.make(gym.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    assert asdict(again.unwrapped.config) == asdict(CartPoleConfig(control_dt=0.04, horizon=150, rail=2.5))
    assert again.unwrapped.metadata["render_fps"] == 25 and again.unwrapped.horizon == 150
    assert CartPoleEnv.metadata["render_fps"] == 17


def test_models_are_not_shared() -> None:
    first, second = CartPoleEnv("cart-mass"), CartPoleEnv("cart-mass")
    first.simulator.nominal.body_mass[:] = 7.0
    second.reset(seed=0)
    assert second.parameters[0] == 1.0
    assert CartPoleEnv().parameters[0] == 1.0


@pytest.mark.parametrize("clone", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_copies_continue_the_episode(clone) -> None:
    env = gym.make(safeswitch.__name__ + ":SafeSwitch/CartPole-v0", disturbance="pole-length").unwrapped
    env.reset(seed=5, options={"onset": 7})
    for _ in range(9):
        env.advance([0.1])
    twin = clone(env)
    assert twin.spec == env.spec and twin.onset == 7
    for _ in range(10):
        env.advance([-0.05])
        twin.advance([-0.05])
    np.testing.assert_array_equal(env.snapshot(), twin.snapshot())
    assert env.reset()[1]["state"].tolist() == twin.reset()[1]["state"].tolist()
