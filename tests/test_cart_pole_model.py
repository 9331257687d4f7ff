"""The expert's model of the cart-pole against MuJoCo, energy, and the LQR gain it is caught with."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from numpy.typing import NDArray

from safeswitch.expert import cart_pole_model as model
from safeswitch.expert.ddp import Problem
from safeswitch.expert.mpc import StationaryGain
from safeswitch.seeding import stream
from safeswitch.tasks.cart_pole import CartPoleEnv

Array = NDArray[np.float64]

NOMINAL = np.array([1.0, 0.1, 0.5, 1e-4, 0.05, 0.001, 10.0])


def problem(control_dt: float = 0.06) -> Problem:
    stage, terminal = model.residuals(2.0)
    return Problem("cart_pole", model.dynamics(control_dt), stage, terminal, 34, (-1.0,), (1.0,))


def test_parameters_are_those_of_the_task() -> None:
    assert model.PARAMETERS == CartPoleEnv.parameter_names


@pytest.mark.parametrize(
    "design",
    [{}, {"cart_mass": 0.2}, {"pole_length": 0.8, "pole_inertia": 0.01}, {"cart_damping": 2.0, "force_limit": 6.0}],
)
def test_model_agrees_with_mujoco_over_a_second(design: dict[str, float]) -> None:
    env = CartPoleEnv(**{"rail": 20.0, **design})
    config = env.config
    f = model.dynamics(config.control_dt, round(config.control_dt / config.timestep))
    for seed in range(5):
        env.reset(seed=seed)
        rng, x = stream(seed, "actions"), env.state
        for _ in range(round(1.0 / config.control_dt)):
            u = rng.uniform(-1, 1, 1)
            env.advance(u)
            x = f(x, u, env.parameters).full().ravel()
        np.testing.assert_allclose(x, env.state, rtol=1e-8, atol=1e-8)


def test_model_follows_a_mass_change() -> None:
    env = CartPoleEnv(disturbance="cart-mass", severity=3)
    f = model.dynamics(env.config.control_dt, 3)
    env.reset(seed=1, options={"onset": 5})
    rng, x = stream(1, "actions"), env.state
    for _ in range(15):
        u = rng.uniform(-0.3, 0.3, 1)
        parameters = env.parameters
        env.advance(u)
        x = f(x, u, parameters).full().ravel()
    assert env.parameters[0] == pytest.approx(0.2)
    np.testing.assert_allclose(x, env.state, rtol=1e-8, atol=1e-8)


def test_planning_step_is_accurate_enough() -> None:
    """One Runge-Kutta step per action, as the expert plans, against many: under a milliradian in a fast swing."""
    coarse, fine = model.dynamics(0.06), model.dynamics(0.06, 20)
    x, u = [0.3, -1.0, 2.5, 7.0], [0.7]
    error = coarse(x, u, NOMINAL).full() - fine(x, u, NOMINAL).full()
    assert np.abs(error).max() < 2e-3


def test_energy_is_conserved_without_friction_and_force() -> None:
    mass, pole, length, inertia = NOMINAL[:4]
    p = NOMINAL.copy()
    p[4:] = 0.0
    f, x = model.dynamics(0.01), np.array([0.0, 1.0, 2.0, 3.0])

    def energy(x: Array) -> float:
        _, v, theta, omega = x
        bob_x, bob_z = v + length * np.cos(theta) * omega, -length * np.sin(theta) * omega
        kinetic = 0.5 * mass * v**2 + 0.5 * pole * (bob_x**2 + bob_z**2) + 0.5 * inertia * omega**2
        return float(kinetic + pole * model.GRAVITY * length * np.cos(theta))

    start = energy(x)
    for _ in range(200):
        x = f(x, [0.0], p).full().ravel()
    assert energy(x) == pytest.approx(start, abs=1e-6)


def test_cost_is_the_documented_one() -> None:
    stage, _ = model.residuals(2.0)
    x, u = np.array([1.9, 0.4, 2.0, -3.0]), np.array([0.6])
    want = model.WEIGHT_X * 1.9**2 + model.WEIGHT_X_DOT * 0.4**2 + model.WEIGHT_ANGLE * 2 * (1 - np.cos(2.0))
    want += model.WEIGHT_THETA_DOT * 9.0 + model.WEIGHT_ACTION * 0.36
    want += model.WEIGHT_RAIL * (1.9 - model.RAIL_SHARE * 2.0) ** 2
    assert float(ca.sumsqr(stage(x, u, NOMINAL))) == pytest.approx(want)


@pytest.mark.parametrize("cart_mass", [1.0, 0.4, 0.2, 0.1])
def test_stationary_gain_solves_riccati_and_stabilises(cart_mass: float) -> None:
    from scipy.linalg import solve_discrete_are

    p = NOMINAL.copy()
    p[0] = cart_mass
    setup = problem()
    x, u = ca.MX.sym("x", 4), ca.MX.sym("u")
    f, r = setup.dynamics(x, u, p), setup.residual(x, u, p)
    jacobians = ca.Function("J", [x, u], [ca.jacobian(f, x), ca.jacobian(f, u), ca.jacobian(r, x), ca.jacobian(r, u)])
    A, B, rx, ru = (np.array(j) for j in jacobians(np.zeros(4), 0.0))
    P = solve_discrete_are(A, B, rx.T @ rx, ru.T @ ru)
    K = StationaryGain(setup)(np.zeros(4), np.zeros(1), p)
    np.testing.assert_allclose(K, -np.linalg.solve(ru.T @ ru + B.T @ P @ B, B.T @ P @ A), rtol=1e-5)
    assert np.abs(np.linalg.eigvals(A + B @ K)).max() < 1.0


def test_swings_pump_energy_from_hanging() -> None:
    swing = model.swing_function(0.06, 34)
    f = model.dynamics(0.06)
    K = StationaryGain(problem())(np.zeros(4), np.zeros(1), NOMINAL)
    controls = swing([0.0, 0.0, np.pi - 0.05, 0.0], NOMINAL, K).full()
    assert controls.shape == (len(model.SWINGS), 34) and np.abs(controls).max() <= 1.0
    for row in controls:
        x, highest = np.array([0.0, 0.0, np.pi - 0.05, 0.0]), -1.0
        for u in row:
            x = f(x, u, NOMINAL).full().ravel()
            highest = max(highest, np.cos(x[2]))
        assert highest > -0.5
