r"""The acrobot's expert: dynamics and swing-up cost in CasADi, solved by `safeswitch.expert` in a receding horizon.

State [q1, q2, q1_dot, q2_dot]: q1 is the upper link's angle from upright, q2 the lower link's angle from the upper one
[rad]. With the absolute angle of the lower link a = q1 + q2, from the Lagrangian (Spong 1995, doi 10.1109/37.341864):

    M11 = I1 + I2 + m1 c1^2 + m2 (l^2 + c2^2 + 2 l c2 cos q2)
    M12 = I2 + m2 (c2^2 + l c2 cos q2),   M22 = I2 + m2 c2^2,   h = m2 l c2 sin q2
    M q'' = [ (m1 c1 + m2 l) g sin q1 + m2 c2 g sin a + h (2 q1' + q2') q2' - d1 q1',
              u + m2 c2 g sin a - h q1'^2 - d2 q2' ]
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from safeswitch.expert.ddp import make_solver
from safeswitch.expert.mpc import MPC, MPCConfig, Policy, StationaryGain

PARAMETERS = (
    "upper_mass",  # m1 [kg]
    "lower_mass",  # m2 [kg]
    "upper_com",  # c1, from the shoulder [m]
    "lower_com",  # c2, from the elbow [m]
    "upper_inertia",  # I1, about its centre of mass [kg m^2]
    "lower_inertia",  # I2 [kg m^2]
    "length",  # l, shoulder to elbow [m]
    "shoulder_damping",  # d1 [N m s/rad]
    "elbow_damping",  # d2 [N m s/rad]
    "torque_limit",  # [N m] per unit of action
)
GRAVITY = 9.81  # [m/s^2]
WEIGHT_ANGLE, WEIGHT_SPEED, WEIGHT_ACTION = (5.0, 5.0), (0.4, 0.4), 2.0
WEIGHT_TERMINAL = 10.0
HORIZON = 40
SWINGS = (2.0, 3.0, 4.0, 5.5)
"""Frequencies of the first guesses of a cold start [rad/s]; each is tried to both sides."""


def dynamics(control_dt: float, substeps: int = 2) -> ca.Function:
    """(x, u, p) -> x after `control_dt` [s] of constant action, by Runge-Kutta 4."""
    x, u, p = ca.MX.sym("x", 4), ca.MX.sym("u", 1), ca.MX.sym("p", len(PARAMETERS))
    m1, m2, c1, c2, i1, i2, length, d1, d2, limit = ca.vertsplit(p)
    q1, q2, v1, v2 = ca.vertsplit(x)
    coupling = m2 * length * c2
    m11 = i1 + i2 + m1 * c1**2 + m2 * (length**2 + c2**2) + 2 * coupling * ca.cos(q2)
    m12, m22 = i2 + m2 * c2**2 + coupling * ca.cos(q2), i2 + m2 * c2**2
    h, lower = coupling * ca.sin(q2), m2 * c2 * GRAVITY * ca.sin(q1 + q2)
    f1 = (m1 * c1 + m2 * length) * GRAVITY * ca.sin(q1) + lower + h * (2 * v1 + v2) * v2 - d1 * v1
    f2 = limit * u[0] + lower - h * v1**2 - d2 * v2
    inverse = 1 / (m11 * m22 - m12**2)
    rates = ca.vertcat(v1, v2, (m22 * f1 - m12 * f2) * inverse, (m11 * f2 - m12 * f1) * inverse)
    rate = ca.Function("acrobot_rate", [x, u, p], [rates])
    step, end = control_dt / substeps, x
    for _ in range(substeps):
        k1 = rate(end, u, p)
        k2 = rate(end + step / 2 * k1, u, p)
        k3 = rate(end + step / 2 * k2, u, p)
        k4 = rate(end + step * k3, u, p)
        end = end + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return ca.Function("acrobot_dynamics", [x, u, p], [end], ["x", "u", "p"], ["x_next"])


def residuals() -> tuple[ca.Function, ca.Function]:
    """Stage residual (x, u, p) -> r and terminal residual (x, p) -> r_N; the cost is 0.5 |r|^2."""
    x, u, p = ca.MX.sym("x", 4), ca.MX.sym("u", 1), ca.MX.sym("p", len(PARAMETERS))
    rows = []
    for angle, weight in zip((x[0], x[0] + x[1]), WEIGHT_ANGLE, strict=True):
        rows += [np.sqrt(weight) * ca.sin(angle), np.sqrt(weight) * (1 - ca.cos(angle))]
    rows += [np.sqrt(weight) * speed for speed, weight in zip((x[2], x[3]), WEIGHT_SPEED, strict=True)]
    state = ca.vertcat(*rows)
    stage = ca.Function("acrobot_residual", [x, u, p], [ca.vertcat(state, np.sqrt(WEIGHT_ACTION) * u)])
    return stage, ca.Function("acrobot_terminal", [x, p], [np.sqrt(WEIGHT_TERMINAL) * state])


def make_acrobot_expert(control_dt: float, compiled: bool = True) -> MPC:
    """Model-predictive expert (`safeswitch.protocols.Expert`); `compiled=False` needs no C compiler."""
    stage, terminal = residuals()
    solver = make_solver("acrobot", dynamics(control_dt), stage, terminal, HORIZON, -1.0, 1.0, compiled=compiled)
    gain = StationaryGain(solver.problem, compiled=compiled)
    time = control_dt * np.arange(HORIZON)
    swings = [Policy(u=side * np.sin(rate * time)[:, None]) for rate in SWINGS for side in (1.0, -1.0)]

    def candidates(state: np.ndarray, parameters: np.ndarray) -> list[Policy]:
        # Without the stabilising feedback the planner would drop a balanced acrobot and swing it up again.
        turns = 2 * np.pi * np.round(state[:2] / (2 * np.pi))
        upright = np.array([*turns, 0.0, 0.0])
        return [Policy(x=upright, K=gain(upright, np.zeros(1), parameters)), Policy(), *swings]

    return MPC(solver, candidates, MPCConfig(angles=(0, 1)))
