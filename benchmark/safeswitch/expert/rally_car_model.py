"""The rally car's expert: where the track bends ahead, first plans around an obstacle, and `make_rally_car_expert`.

The model and its cost are in `safeswitch.expert.bicycle`. The action is the absolute steering angle of a converged
plan, a function of the car's pose and motion and not of where its wheels stand: a learner can tell it from one image.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from safeswitch.expert import bicycle
from safeswitch.expert.bicycle import CONTEXT, KNOT_SPACING, KNOTS, PARAMETERS, STEERING_LIMIT, Car
from safeswitch.expert.ddp import Problem, make_solver
from safeswitch.expert.mpc import MPC, MPCConfig, Policy, StationaryGain
from safeswitch.names import unknown

if TYPE_CHECKING:
    from safeswitch.tasks.track import Track

Array = NDArray[np.float64]

HORIZON = 40
BIAS, SPEED = PARAMETERS.index("steering_bias"), len(PARAMETERS)
OBSTACLE = slice(PARAMETERS.index("obstacle_s"), len(PARAMETERS))
SPACING = SPEED + CONTEXT.index("spacing")
STRAIGHT_FROM = SPEED + CONTEXT.index("first_s")
NOWHERE = -1e4  # [m] s of an obstacle that is not there
SLOWEST = 1.0  # [m/s] at which the steering is planned: a parked car plans as if it moved
SHY = 0.05  # [m] by which first plans pass an obstacle further off than its cost asks for


class CurvatureWindow:
    """Piecewise linear curvature on a fixed grid of the lap, of which `KNOTS` knots are shown at a time.

    The grid does not move with the car, so the curvature at a place does not depend on the window.
    """

    def __init__(self, track: Track) -> None:
        count = round(track.length / KNOT_SPACING)
        self.length = float(track.length)
        self.spacing = self.length / count
        curvature = np.asarray(track.curvature(self.spacing * np.arange(count)), dtype=np.float64)
        slope = (np.roll(curvature, -1) - curvature) / self.spacing
        bend = slope - np.roll(slope, 1)
        self._rows = np.zeros((count, 1 + KNOTS))  # of each first knot: its curvature, and the bends
        for first in range(count):
            at = (first + np.arange(1, KNOTS)) % count
            self._rows[first, 0], self._rows[first, 1], self._rows[first, 2:] = curvature[first], slope[first], bend[at]
            self._rows[first, -1] = -slope[(first + KNOTS - 2) % count]  # constant beyond the last knot
        self._curvature = np.append(curvature, curvature[0])

    def write(self, s: float, out: Array) -> None:
        """Write spacing, first_s, first_curvature and bends (3 + KNOTS,) of the window that begins around s [m]."""
        first = math.floor(s / self.spacing)
        out[0], out[1] = self.spacing, first * self.spacing
        out[2:] = self._rows[first % len(self._rows)]

    def curvature(self, s: Array) -> Array:
        """Curvature [1/m] at s [m], any shape."""
        at = np.mod(s, self.length)
        return np.interp(at, self.spacing * np.arange(len(self._curvature)), self._curvature)


class LaneCandidates:
    """First plans of a cold start: lane keeping under LQR feedback, straight on and, if there is an obstacle in reach,
    left and right of it.
    """

    def __init__(
        self,
        problem: Problem,
        control_dt: float,
        half_width: float,
        car: Car,
        window: CurvatureWindow,
        compiled: bool = True,
    ) -> None:
        self._gain = StationaryGain(problem, compiled=compiled)
        self._window, self._dt, self._car = window, control_dt, car
        self._nx, self._nu, self._horizon = problem.nx, problem.nu, problem.horizon
        self._lane = half_width - car.circle_radius - bicycle.BORDER_MARGIN

    def __call__(self, state: Array, parameters: Array) -> list[Policy]:
        """Policies for the solver's state (nx,) and parameters (np,)."""
        p = dict(zip(PARAMETERS + CONTEXT, parameters.tolist(), strict=True))
        v_x = max(float(state[6]) if self._nx == 7 else p["speed"], SLOWEST)
        reach = v_x * self._dt * np.arange(self._horizon + 1)
        kappa = self._window.curvature(state[0] + reach)
        u, x = np.zeros((self._horizon, self._nu)), np.zeros((self._horizon + 1, self._nx))
        x[:, 2], x[:, 3], x[:, 4] = -p["l_r"] * kappa, p["l_r"] * kappa * v_x, kappa * v_x
        bend = np.arctan((p["l_f"] + p["l_r"]) * kappa)
        u[:, 0] = bend[:-1] - p["steering_bias"]
        if self._nx == 7:
            x[:, 5], x[:, 6] = bend, p["speed"]
        K = self._lane_keeping(parameters, p["speed"])
        policies = [Policy(u=u, x=x, K=K)]
        if not -1.0 < p["obstacle_s"] - state[0] < reach[-1] + 1.0:
            return policies
        aside = p["obstacle_radius"] + self._car.circle_radius + bicycle.OBSTACLE_MARGIN + SHY
        for side in (1.0, -1.0):
            past = x.copy()
            past[:, 1] = min(max(p["obstacle_e"] + side * aside, -self._lane), self._lane)
            policies.append(Policy(u=u, x=past, K=K))
        return policies

    def _lane_keeping(self, parameters: Array, speed: float) -> Array:
        """LQR gain (nu, nx) on a straight and empty track."""
        straight = parameters.copy()
        straight[STRAIGHT_FROM:] = 0.0
        straight[OBSTACLE] = NOWHERE, 0.0, 0.0
        straight[BIAS], straight[SPEED] = 0.0, speed
        x, u = np.zeros(self._nx), np.zeros(self._nu)
        if self._nx == 7:
            x[6] = speed
        return self._gain(x, u, straight)


class RallyCarExpert:
    """Model-predictive expert of the rally car (`safeswitch.protocols.Expert`): the environment's full state and
    parameters in, action out.

    Attributes:
        mpc: plans in the solver's terms: s grows from lap to lap, and the parameters show the bends ahead.
    """

    def __init__(self, mpc: MPC, window: CurvatureWindow, speed: float | None = None) -> None:
        """`speed` [m/s] is the wished speed where the throttle is a control, None where the speed is measured."""
        self.mpc = mpc
        self._window = window
        self._speed = speed
        self._columns = [0, 1, 2, 4, 5] if speed is None else [0, 1, 2, 4, 5, 6, 3]
        self._units = np.array([STEERING_LIMIT, 1.0][: mpc.solver.problem.nu])
        self._parameters = np.zeros(mpc.solver.problem.np)
        self._s: float | None = None

    def reset(self) -> None:
        """Forget the plan: the next action is a function of state and parameters alone."""
        self.mpc.reset()
        self._s = None

    def action(self, state: Array, parameters: Array) -> Array:
        """Action (nu,) in [-1, 1] for the state (7,) [s, e_y, e_psi, v_x, v_y, yaw_rate, delta] and parameters (9,)."""
        state, parameters = np.asarray(state, dtype=np.float64), np.asarray(parameters, dtype=np.float64)
        if state.shape != (7,):
            raise ValueError(f"state must have shape (7,), got {state.shape}")
        if parameters.shape != (len(PARAMETERS),):
            raise ValueError(f"parameters must have shape ({len(PARAMETERS)},), got {parameters.shape}")
        x, p = state[self._columns], self._parameters
        p[: len(PARAMETERS)] = parameters
        if math.isfinite(x[0]):
            length = self._window.length
            lap = math.fmod(x[0], length) if self._s is None else x[0] + length * round((self._s - x[0]) / length)
            self._s = x[0] = lap
            self._window.write(lap, p[SPACING:])
            p[SPEED] = max(state[3], SLOWEST) if self._speed is None else self._speed
            obstacle_s, _, radius = parameters[OBSTACLE].tolist()
            if radius == 0.0:
                p[OBSTACLE] = NOWHERE, 0.0, 0.0
            elif math.isfinite(obstacle_s):
                # Exactly the same number at every step of a passage: a change would mean a new obstacle.
                p[OBSTACLE.start] = obstacle_s + length * round((lap - obstacle_s) / length)
        return self.mpc.action(x, p) / self._units


def make_rally_car_expert(
    track_name: str = "ridge",
    steering_only: bool = True,
    control_dt: float = 0.05,
    speed: float = 4.0,
    compiled: bool = True,
    car: Car | None = None,
) -> RallyCarExpert:
    """The rally car's expert.

    Args:
        track_name: "ridge" or "hollow".
        steering_only: True: action = steering, for a car whose speed is held by a controller of its own; False: action
            = steering and throttle.
        control_dt: [s] duration of an action.
        speed: [m/s] held where the throttle is an action.
        compiled: False runs CasADi's virtual machine even where there is a compiler.
        car: constants of the model; the default is the MuJoCo car.
    """
    from safeswitch.tasks.track import TRACKS

    if track_name not in TRACKS:
        raise unknown("track", track_name, TRACKS)
    track, car = TRACKS[track_name], car or Car()
    stage, terminal = bicycle.residuals(control_dt, steering_only, track.half_width, car)
    bounds = np.array([STEERING_LIMIT] if steering_only else [STEERING_LIMIT, 1.0])
    name = "rally_car" if steering_only else "rally_car_throttle"
    model = bicycle.dynamics(control_dt, steering_only, car)
    solver = make_solver(name, model, stage, terminal, HORIZON, -bounds, bounds, compiled=compiled)
    window = CurvatureWindow(track)
    candidates = LaneCandidates(solver.problem, control_dt, track.half_width, car, window, compiled)
    config = MPCConfig(
        warm_iterations=4,
        cold_iterations=12,
        polish_iterations=40,
        angles=(2,),
        following=tuple(range(SPEED, solver.problem.np)),
    )
    return RallyCarExpert(MPC(solver, candidates, config), window, None if steering_only else speed)
