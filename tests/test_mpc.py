"""The expert in closed loop: it swings up, never drops a balanced pole, survives a new mass, and never misbehaves."""

from __future__ import annotations

import warnings
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from safeswitch.expert.cart_pole_model import make_cart_pole_expert
from safeswitch.expert.mpc import MPC
from safeswitch.protocols import Expert
from safeswitch.seeding import stream
from safeswitch.tasks.cart_pole import CartPoleEnv

Array = NDArray[np.float64]

NOMINAL = CartPoleEnv().parameters
LIGHT = np.array([0.2, *NOMINAL[1:]])
HANGING = np.array([0.1, 0.0, np.pi - 0.1, 0.0])


@cache
def expert() -> MPC:
    return new_expert()


def new_expert() -> MPC:
    mpc = CartPoleEnv().make_expert()
    assert isinstance(mpc, MPC)
    return mpc


@pytest.fixture
def fresh() -> MPC:
    mpc = expert()
    mpc.reset()
    mpc.fallbacks = mpc.cold_starts = 0
    return mpc


def drive(env: CartPoleEnv, mpc: MPC) -> bool:
    """The expert to the end of the episode; whether it succeeds."""
    mpc.reset()
    while not env.done:
        env.advance(mpc.action(env.state, env.parameters))
    return env.is_success


def handovers(seeds: range, every: int) -> list[bool]:
    """Outcome of a cold handover at every few steps of episodes driven by the expert with noise in its actions."""
    env, driver, mpc, outcomes = CartPoleEnv(), new_expert(), expert(), []
    for seed in seeds:
        env.reset(seed=seed)
        driver.reset()
        noise, snapshots = stream(seed, "noise"), []
        while not env.done:
            if env.step_index % every == 0:
                snapshots.append(env.snapshot())
            env.advance(driver.action(env.state, env.parameters) + noise.normal(scale=0.15, size=1))
        for snapshot in snapshots:
            env.restore(snapshot)
            outcomes.append(drive(env, mpc))
    return outcomes


def mass_changes(seeds: range) -> list[bool]:
    env, outcomes = CartPoleEnv(disturbance="cart-mass", severity=3), []
    for seed in seeds:
        env.reset(seed=seed)
        outcomes.append(drive(env, expert()))
    return outcomes


def swing_ups(seeds: range, **design: float) -> list[bool]:
    env, outcomes = CartPoleEnv(**design), []
    for seed in seeds:
        env.reset(seed=seed)
        outcomes.append(drive(env, expert()))
    return outcomes


def test_swings_up_and_balances() -> None:
    assert all(swing_ups(range(8)))
    assert all(swing_ups(range(8), cart_mass=0.2))


def test_survives_a_mass_change_while_driving() -> None:
    assert all(mass_changes(range(8)))


def test_handovers_succeed() -> None:
    assert all(handovers(range(2), 10))


@pytest.mark.slow
def test_200_swing_ups() -> None:
    assert np.mean(swing_ups(range(200))) >= 0.99


@pytest.mark.slow
def test_200_mass_changes() -> None:
    assert np.mean(mass_changes(range(200))) >= 0.99


@pytest.mark.slow
def test_first_gate_handover_at_every_fifth_step() -> None:
    outcomes = handovers(range(200), 5)
    assert len(outcomes) == 200 * CartPoleEnv().horizon // 5
    assert np.mean(outcomes) >= 0.995


@pytest.mark.parametrize("parameters", [NOMINAL, LIGHT], ids=["nominal", "light"])
def test_a_balanced_pole_is_not_dropped_at_a_cold_start(fresh: MPC, parameters: Array) -> None:
    """Whatever the turn the angle is counted in, and off the middle of the rail."""
    env = CartPoleEnv(cart_mass=parameters[0])
    for seed in range(10):
        start = stream(seed, "start").uniform(-1, 1, 4) * [1.0, 0.5, 0.15, 0.5] + [0, 0, 2 * np.pi * (seed % 3 - 1), 0]
        env.reset(seed=seed, options={"initial_state": start})
        fresh.reset()
        while not env.done:
            env.advance(fresh.action(env.state, env.parameters))
            assert abs(np.sin(env.state[2] / 2)) < np.sin(0.5 / 2)
        assert env.is_success


def test_a_cold_plan_is_a_function_of_state_and_parameters(fresh: MPC) -> None:
    first = fresh.action(HANGING, NOMINAL)
    plan = fresh.plan_u
    for t in range(5):  # a history of other states and parameters
        fresh.action(HANGING + 0.1 * t, LIGHT)
    fresh.reset()
    assert fresh.action(HANGING, NOMINAL) == first
    np.testing.assert_array_equal(fresh.plan_u, plan)
    np.testing.assert_array_equal(new_expert().action(HANGING, NOMINAL), first)


def test_angles_may_be_wrapped_or_not(fresh: MPC) -> None:
    """A plan that passes +-pi goes on when the measured angle jumps by a turn."""
    results = []
    for wrap in (False, True):
        env = CartPoleEnv()
        env.reset(seed=3)
        fresh.reset()
        controls = []
        for _ in range(25):
            state = env.state
            if wrap:
                state[2] = np.remainder(state[2] + np.pi, 2 * np.pi) - np.pi
            controls.append(fresh.action(state, env.parameters))
            env.advance(controls[-1])
        results.append(np.array(controls))
    np.testing.assert_allclose(results[0], results[1], atol=1e-6)


def test_warm_steps_start_from_the_shifted_plan(fresh: MPC) -> None:
    """Where the model is right, the second plan costs what is left of the first, and takes an iteration or two."""
    fresh.action(HANGING, NOMINAL)
    cost, following, count = fresh.cost, fresh.plan_x[1], fresh.iterations
    fresh.action(following, NOMINAL)
    assert fresh.cold_starts == 1
    assert fresh.cost < cost
    assert fresh.iterations - count <= 10
    np.testing.assert_array_equal(fresh.plan_x[0], following)


def test_new_parameters_are_challenged_by_a_cold_start(fresh: MPC) -> None:
    fresh.action(HANGING, NOMINAL)
    fresh.action(fresh.plan_x[1], LIGHT)
    assert fresh.cold_starts == 2
    warm = fresh.cost
    state = fresh.plan_x[0]
    fresh.reset()
    fresh.action(state, LIGHT)
    assert warm <= fresh.cost * (1 + 1e-9)


def test_non_finite_states_are_answered_from_the_last_plan(fresh: MPC) -> None:
    fresh.action(HANGING, NOMINAL)
    plan, states = fresh.plan_u, fresh.plan_x
    for i in (1, 2, 3):
        np.testing.assert_array_equal(fresh.action(np.full(4, np.nan), NOMINAL), plan[i])
    np.testing.assert_array_equal(fresh.action(states[4], np.full(7, np.inf)), plan[4])
    assert fresh.fallbacks == 4
    fresh.action(states[5], NOMINAL)  # sight regained: warm from the same plan, five steps on
    assert fresh.cold_starts == 1
    np.testing.assert_array_equal(fresh.plan_x[0], states[5])
    assert fresh.fallbacks == 4
    for _ in range(60):  # longer than the plan
        assert np.abs(fresh.action(np.full(4, np.nan), NOMINAL)).max() <= 1.0


def test_without_any_plan_the_fallback_is_no_force(fresh: MPC) -> None:
    np.testing.assert_array_equal(fresh.action(np.full(4, np.nan), NOMINAL), [0.0])
    np.testing.assert_array_equal(fresh.action(np.array([0, 0, 0, 1e300]), NOMINAL), [0.0])
    assert fresh.fallbacks == 2


def test_absurd_states_get_finite_actions_within_bounds(fresh: MPC) -> None:
    rng = np.random.default_rng(0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for i in range(60):
            state = rng.normal(size=4) * 10.0 ** rng.uniform(-2, 12, 4)
            parameters = NOMINAL * 10.0 ** rng.uniform(-3, 3, 7)
            if i % 3 == 0:
                fresh.reset()
            action = fresh.action(state, parameters)
            assert action.shape == (1,) and np.isfinite(action).all() and np.abs(action).max() <= 1.0


def test_the_answer_is_a_copy(fresh: MPC) -> None:
    action = fresh.action(HANGING, NOMINAL)
    value = float(action[0])
    action[:] = 99.0
    assert fresh.plan_u[0, 0] == value


def test_wrong_shapes_are_refused(fresh: MPC) -> None:
    with pytest.raises(ValueError, match=r"state must have shape \(4,\), got \(5,\)"):
        fresh.action(np.zeros(5), NOMINAL)
    with pytest.raises(ValueError, match=r"parameters must have shape \(7,\), got \(3,\)"):
        fresh.action(HANGING, np.zeros(3))


def test_satisfies_the_protocol() -> None:
    assert isinstance(expert(), Expert)
    assert isinstance(CartPoleEnv().make_expert(), Expert)


def test_virtual_machine_gives_the_same_actions(fresh: MPC) -> None:
    interpreted = make_cart_pole_expert(CartPoleEnv().control_dt, rail=CartPoleEnv().config.rail, compiled=False)
    env = CartPoleEnv()
    env.reset(seed=0)
    for _ in range(4):
        action = fresh.action(env.state, env.parameters)
        np.testing.assert_allclose(interpreted.action(env.state, env.parameters), action, atol=1e-9)
        env.advance(action)
