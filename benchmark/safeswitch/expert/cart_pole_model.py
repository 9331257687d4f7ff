r"""Cart-pole for the expert: dynamics and swing-up cost in CasADi, and `make_cart_pole_expert`.

State ``[x, x_dot, theta, theta_dot]`` ([m], [m/s], [rad], [rad/s]); theta = 0 is upright and theta > 0 leans towards
+x: the bob is at (x + l sin theta, l cos theta). Action in [-1, 1], force = force_limit * action
[N]. From the Lagrangian,

.. math::
    (m_c + m_p) \ddot x + m_p l \cos\theta\, \ddot\theta &= F - d_x \dot x + m_p l \sin\theta\, \dot\theta^2, \\
    m_p l \cos\theta\, \ddot x + (I + m_p l^2) \ddot\theta &= m_p g l \sin\theta - d_\theta \dot\theta.

MuJoCo's model is the same; integrated by Runge-Kutta 4 with the same steps the two agree to rounding (see the tests).
"""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from safeswitch.expert.codegen import Kernel, build
from safeswitch.expert.ddp import Problem, make_solver
from safeswitch.expert.graph import expanded
from safeswitch.expert.mpc import MPC, MPCConfig, Policy, StationaryGain

Array = NDArray[np.float64]

PARAMETERS: tuple[str, ...] = (
    "cart_mass",  # [kg]
    "pole_mass",  # [kg]
    "pole_length",  # hinge to centre of mass [m]
    "pole_inertia",  # about the centre of mass [kg m^2]
    "cart_damping",  # [N s/m]
    "pole_damping",  # [N m s/rad]
    "force_limit",  # [N] per unit of action
)
GRAVITY = 9.81  # [m/s^2]

WEIGHT_X, WEIGHT_X_DOT, WEIGHT_ANGLE, WEIGHT_THETA_DOT, WEIGHT_ACTION = 1.0, 0.1, 5.0, 0.1, 10.0
WEIGHT_RAIL, RAIL_SHARE = 200.0, 0.8  # squared hinge beyond this share of the rail: plans stay on it
WEIGHT_TERMINAL = 1.0  # of the state's cost, at the end of the horizon

# Swings of a cold start: largest action, gain on the energy, gain on the cart's position [1/m], first side. Chosen
# greedily among 26 candidates (40 restarts beside them) by the cost of the best plan over 240 states.
SWINGS = ((1.0, 10.0, 0.5, 1.0), (1.0, 2.0, 0.3, -1.0), (0.6, 1.0, 0.3, -1.0))
CATCH_ANGLE, CATCH_SPEED = 0.5, 4.0  # [rad], [rad/s]: where a swing hands over to the LQR gain


def acceleration(x: ca.MX, u: ca.MX, p: ca.MX) -> tuple[ca.MX, ca.MX]:
    """(x_ddot [m/s^2], theta_ddot [rad/s^2]) at state x (4,), action u (1,), parameters p (7,)."""
    cart_mass, pole_mass, length, inertia, cart_damping, pole_damping, force_limit = ca.vertsplit(p)
    _, x_dot, theta, theta_dot = ca.vertsplit(x)
    sin, cos, moment = ca.sin(theta), ca.cos(theta), pole_mass * length
    m11, m12, m22 = cart_mass + pole_mass, moment * cos, inertia + moment * length
    force = force_limit * u[0] - cart_damping * x_dot + moment * sin * theta_dot**2
    torque = GRAVITY * moment * sin - pole_damping * theta_dot
    inverse = 1 / (m11 * m22 - m12**2)  # of the determinant; once, because divisions are slow
    return (m22 * force - m12 * torque) * inverse, (m11 * torque - m12 * force) * inverse


def dynamics(control_dt: float, substeps: int = 1) -> ca.Function:
    """(x, u, p) -> x after `control_dt` [s] of constant action: `substeps` Runge-Kutta 4 steps."""
    x, u, p = ca.MX.sym("x", 4), ca.MX.sym("u", 1), ca.MX.sym("p", len(PARAMETERS))
    x_ddot, theta_ddot = acceleration(x, u, p)
    rate = ca.Function("cart_pole_rate", [x, u, p], [ca.vertcat(x[1], x_ddot, x[3], theta_ddot)])
    h, end = control_dt / substeps, x
    for _ in range(substeps):
        k1 = rate(end, u, p)
        k2 = rate(end + h / 2 * k1, u, p)
        k3 = rate(end + h / 2 * k2, u, p)
        k4 = rate(end + h * k3, u, p)
        end = end + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return ca.Function("cart_pole_dynamics", [x, u, p], [end], ["x", "u", "p"], ["x_next"])


def state_residual(x: ca.MX, rail: float) -> ca.MX:
    """Residual of the state's cost, 0.5 |r|^2. The angle enters as (sin, 1 - cos): |.|^2 = 2 (1 - cos theta)."""
    over = ca.fmax(ca.fabs(x[0]) - RAIL_SHARE * rail, 0)
    return ca.vertcat(
        ca.sqrt(WEIGHT_X) * x[0],
        ca.sqrt(WEIGHT_X_DOT) * x[1],
        ca.sqrt(WEIGHT_ANGLE) * ca.sin(x[2]),
        ca.sqrt(WEIGHT_ANGLE) * (1 - ca.cos(x[2])),
        ca.sqrt(WEIGHT_THETA_DOT) * x[3],
        ca.sqrt(WEIGHT_RAIL) * over,
    )


def residuals(rail: float) -> tuple[ca.Function, ca.Function]:
    """Stage residual (x, u, p) -> r and terminal residual (x, p) -> r_N."""
    x, u, p = ca.MX.sym("x", 4), ca.MX.sym("u", 1), ca.MX.sym("p", len(PARAMETERS))
    stage = ca.vertcat(state_residual(x, rail), ca.sqrt(WEIGHT_ACTION) * u)
    terminal = ca.sqrt(WEIGHT_TERMINAL) * state_residual(x, rail)
    return (
        ca.Function("cart_pole_residual", [x, u, p], [stage], ["x", "u", "p"], ["r"]),
        ca.Function("cart_pole_terminal", [x, p], [terminal], ["x", "p"], ["r"]),
    )


def swing_function(control_dt: float, horizon: int) -> ca.Function:
    """(x, p, K) -> u (len(SWINGS), N): controls of roll-outs that pump energy and catch the pole with the LQR gain K.

    Energy shaping (Astrom & Furuta 2000, https://doi.org/10.1016/S0005-1098(99)00140-5): push against
    theta_dot cos(theta), in proportion to the energy that is missing, and pull the cart back to the middle.
    """
    x, p, K = ca.MX.sym("x", 4), ca.MX.sym("p", len(PARAMETERS)), ca.MX.sym("K", 1, 4)
    setting = ca.MX.sym("setting", len(SWINGS[0]))
    most, energy_gain, centre_gain, side = ca.vertsplit(setting)
    sin, cos = ca.sin(x[2]), ca.cos(x[2])
    # Energy above that of the resting upright pole, over m g l: 0 upright, -2 hanging.
    energy = 0.5 * x[3] ** 2 * (p[2] + p[3] / (p[1] * p[2])) / GRAVITY - (1 - cos)
    direction = ca.if_else(ca.fabs(x[3] * cos) > 0.01, ca.sign(x[3] * cos), side)
    pump = ca.fmax(ca.fmin(energy_gain * energy * direction, most), -most)
    angle = ca.atan2(sin, cos)
    catch = K @ ca.vertcat(x[0], x[1], angle, x[3])
    near = ca.logic_and(ca.fabs(angle) < CATCH_ANGLE, ca.fabs(x[3]) < CATCH_SPEED)
    u = ca.if_else(near, catch, pump - centre_gain * (x[0] + 0.3 * x[1]))
    u = ca.fmax(ca.fmin(u, 1), -1)
    step = expanded("cart_pole_swing_step", [x, p, K, setting], [dynamics(control_dt)(x, u, p), u])

    rows = []
    for values in SWINGS:
        state, controls = x, []
        for _ in range(horizon):
            state, control = step(state, p, K, ca.DM(values))
            controls.append(control)
        rows.append(ca.horzcat(*controls))
    return ca.Function("cart_pole_swing", [x, p, K], [ca.vertcat(*rows)], ["x", "p", "K"], ["u"])


class SwingCandidates:
    """Initial policies of a cold start: energy-shaping swings, and LQR about the nearest upright and its neighbours.

    Under the LQR candidate a balanced pole stays balanced; without it the planner drops the pole and swings it up anew.
    """

    def __init__(self, problem: Problem, control_dt: float, compiled: bool = True) -> None:
        self._gain = StationaryGain(problem, compiled=compiled)
        swing = swing_function(control_dt, problem.horizon)
        self._swing = Kernel(build(swing) if compiled else swing)

    def __call__(self, state: Array, parameters: Array) -> list[Policy]:
        """Policies for the state (4,) under the model parameters (7,)."""
        turn = 2 * np.pi
        uprights = [np.array([0.0, 0.0, turn * (np.round(state[2] / turn) + i), 0.0]) for i in (0, -1, 1)]
        K = self._gain(uprights[0], np.zeros(1), parameters)
        inputs = self._swing.inputs
        inputs["x"][:], inputs["p"][:] = state, parameters
        inputs["K"][:, 0] = K[0]
        self._swing()
        swings = [Policy(u=u[:, None]) for u in self._swing.outputs["u"].T.copy()]
        return [*(Policy(x=upright, K=K) for upright in uprights), *swings]


def make_cart_pole_expert(control_dt: float = 0.06, horizon: int = 34, rail: float = 1.5, compiled: bool = True) -> MPC:
    """The cart-pole's expert.

    Args:
        control_dt: [s] duration of an action.
        horizon: number of actions planned ahead; about 2 s are needed for a swing-up.
        rail: [m] the cart must stay within |x| <= rail; leaving it is failure.
        compiled: False runs CasADi's virtual machine even where there is a compiler.
    """
    stage, terminal = residuals(rail)
    solver = make_solver("cart_pole", dynamics(control_dt), stage, terminal, horizon, -1.0, 1.0, compiled=compiled)
    candidates = SwingCandidates(solver.problem, control_dt, compiled)
    return MPC(solver, candidates, MPCConfig(angles=(2,)))
