"""Receding-horizon control with a generated DDP solver (`safeswitch.expert.ddp`).

*Warm start*: the last plan is shifted by a step and rolled out **with its feedback gains** from the measured state;
open loop it would diverge about an unstable equilibrium. *Cold start*: several initial policies are optimised and
the best plan is kept; it is a function of state and parameters alone. At least one candidate should be under
stabilising feedback, otherwise the planner drops a balanced pole and swings it up again.

The answer is always finite and within the bounds: when the solver fails, the last good plan is followed open loop and
`MPC.fallbacks` is increased.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from safeswitch.expert import ddp_parts as parts
from safeswitch.expert.codegen import Kernel, build
from safeswitch.expert.ddp import DDPSolver, Problem
from safeswitch.expert.graph import expanded

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Policy:
    """An initial policy u_i = u[i] + K[i] (x_i - x[i]), clipped to the bounds.

    Attributes:
        u: (N, nu) or broadcastable to it.
        x: (N + 1, nx) or broadcastable to it.
        K: (N, nu, nx) or broadcastable to it.
    """

    u: Array | float = 0.0
    x: Array | float = 0.0
    K: Array | float = 0.0


Candidates = Callable[[Array, Array], Sequence[Policy]]
"""(state (nx,), parameters (np,)) -> initial policies of a cold start."""


@dataclass(frozen=True)
class MPCConfig:
    """Effort of the receding-horizon loop.

    Attributes:
        warm_iterations: most DDP iterations at a warm step.
        cold_iterations: iterations spent on every candidate of a cold start.
        polish_iterations: further iterations on the best candidate.
        tolerance: relative expected decrease at which a plan counts as converged.
        angles: indexes of the state's components that are angles [rad]; they may arrive wrapped or unwrapped.
        surprise: a warm plan is challenged by a cold start when its cost exceeds the last one's by this factor and
        surprise_margin: by this much.
        following: indexes of the parameters that follow the state along, such as the bends of the road ahead. Where any
            other parameter changes, the warm plan is challenged by a cold start.
    """

    warm_iterations: int = 10
    cold_iterations: int = 20
    polish_iterations: int = 100
    tolerance: float = 1e-5
    angles: tuple[int, ...] = ()
    surprise: float = 1.2
    surprise_margin: float = 1.0
    following: tuple[int, ...] = ()


class MPC:
    """Model-predictive expert (`safeswitch.protocols.Expert`).

    Attributes:
        solver: the generated DDP solver.
        candidates: initial policies of a cold start.
        fallbacks: how often an action came from an old plan because the solver failed, since construction.
        cold_starts: plans made from scratch, since construction.
        iterations: DDP iterations, since construction.
    """

    def __init__(self, solver: DDPSolver, candidates: Candidates, config: MPCConfig | None = None) -> None:
        problem = solver.problem
        self.solver = solver
        self.config = config or MPCConfig()
        self.fallbacks = 0
        self.cold_starts = 0
        self.iterations = 0
        self.candidates = candidates
        self._nx, self._nu, self._np = problem.nx, problem.nu, problem.np
        self._lo, self._hi = np.array(problem.u_lo), np.array(problem.u_hi)
        self._angles = list(self.config.angles)
        # Views on the solver's buffers, made once: a warm step then allocates nearly nothing.
        given, made = solver.kernel.inputs, solver.kernel.outputs
        self._x0, self._p, self._plan_in, self._gains_in = (
            given["x0"], given["p"], given["plan_init"], given["gains_init"],
        )  # fmt: skip
        self._plan_out, self._gains_out, self._info = made["plan"], made["gains"], made["info"]
        self._plan = np.zeros_like(self._plan_out)
        self._gains = np.zeros_like(self._gains_out)
        self._parameters = np.zeros(self._np)
        self._model = np.setdiff1d(np.arange(self._np), self.config.following)
        self._cost = np.inf
        self._age = -1  # steps since the plan in `_plan` was made; -1: no plan

    def reset(self) -> None:
        """Forget the plan: the next action comes from a cold start, a function of state and parameters alone."""
        self._age = -1
        self._cost = np.inf

    def action(self, state: Array, parameters: Array) -> Array:
        """Action (nu,) within the bounds for the state (nx,) under the model parameters (np,), SI units.

        Raises:
            ValueError: state or parameters of the wrong shape. Non-finite ones are answered from the last plan.
        """
        state, parameters = self._checked(state, parameters)
        finite = all(map(math.isfinite, state.tolist())) and all(map(math.isfinite, parameters.tolist()))
        if not (finite and self._replan(state, parameters)):
            return self._fall_back()
        return self._plan[0, self._nx :].copy()  # within the bounds: the roll-out clips every control

    @property
    def plan_x(self) -> Array:
        """(N + 1, nx) states of the current plan, from the last measured state."""
        return self._plan[:, : self._nx].copy()

    @property
    def plan_u(self) -> Array:
        """(N, nu) controls of the current plan."""
        return self._plan[:-1, self._nx :].copy()

    @property
    def cost(self) -> float:
        """Objective of the current plan."""
        return float(self._cost)

    def _checked(self, state: Array, parameters: Array) -> tuple[Array, Array]:
        state, parameters = np.asarray(state, dtype=np.float64), np.asarray(parameters, dtype=np.float64)
        if state.shape != (self._nx,):
            raise ValueError(f"state must have shape ({self._nx},), got {state.shape}")
        if parameters.shape != (self._np,):
            raise ValueError(f"parameters must have shape ({self._np},), got {parameters.shape}")
        return state, parameters

    def _replan(self, state: Array, parameters: Array) -> bool:
        """Make a plan from `state`: warm if there is one to start from. False when no finite plan was found."""
        if self._age < 0:
            return self._cold(state, parameters)
        expected, changed = self._cost, bool((parameters != self._parameters)[self._model].any())
        good = self._warm(state, parameters)
        # Another model, or a cost that jumped (a push): the shifted plan may sit in a poor local minimum.
        if not good or changed or self._cost > self.config.surprise * expected + self.config.surprise_margin:
            good = self._cold(state, parameters, challenge=good)
        return good

    def _warm(self, state: Array, parameters: Array) -> bool:
        """Shift the plan by a step (and by the steps missed since), roll it out with its gains, optimise."""
        plan, gains = self._plan_in, self._gains_in
        shift = min(self._age + 1, gains.shape[0])
        plan[:-shift] = self._plan[shift:]
        plan[-shift:] = self._plan[-1]
        gains[:-shift] = self._gains[shift:]
        gains[-shift:] = self._gains[-1]
        plan[-shift - 1 :, self._nx :] = self._plan[-2, self._nx :]  # the last row of a plan holds no control
        self._x0[:] = state
        for i in self._angles:  # the plan may live some turns away from the measured angle
            self._x0[i] = plan[0, i] + _wrapped(state[i] - plan[0, i])
        self._p[:] = parameters
        return self._run(self.config.warm_iterations) and self._keep()

    def _cold(self, state: Array, parameters: Array, challenge: bool = False) -> bool:
        """Optimise every candidate, keep the best; with `challenge` only if it beats the current plan."""
        config, horizon = self.config, self.solver.problem.horizon
        self.cold_starts += 1
        self._x0[:] = state
        for i in self._angles:
            self._x0[i] = _wrapped(state[i])
        self._p[:] = parameters
        best, best_plan, best_gains = np.inf, None, None
        for policy in self.candidates(self._x0.copy(), parameters):
            self._plan_in[:, : self._nx] = policy.x
            self._plan_in[:horizon, self._nx :] = policy.u
            self._gains_in.reshape(horizon, self._nx, self._nu)[:] = np.swapaxes(
                np.broadcast_to(policy.K, (horizon, self._nu, self._nx)), 1, 2
            )
            if self._run(config.cold_iterations) and self._info[0] < best:
                best, best_plan, best_gains = self._info[0], self._plan_out.copy(), self._gains_out.copy()
        if best_plan is None or (challenge and best >= self._cost):
            return challenge
        self._plan_in[:], self._gains_in[:] = best_plan, best_gains
        return self._run(config.polish_iterations) and self._keep()

    def _run(self, iterations: int) -> bool:
        self.solver.run(iterations, self.config.tolerance)
        self.iterations += int(self._info[1])
        return bool(np.isfinite(self._info[0]) and np.isfinite(self._plan_out).all())

    def _keep(self) -> bool:
        self._plan[:] = self._plan_out
        self._gains[:] = self._gains_out
        self._parameters[:] = self._p
        self._cost = float(self._info[0])
        self._age = 0
        return True

    def _fall_back(self) -> Array:
        """Next control of the last good plan; the bounds' middle when there is none."""
        self.fallbacks += 1
        if self._age < 0:
            return 0.5 * (self._lo + self._hi)
        self._age = min(self._age + 1, self._gains.shape[0] - 1)
        return self._plan[self._age, self._nx :].copy()


def _wrapped(angle: float) -> float:
    """The same angle in [-pi, pi]."""
    return math.remainder(angle, math.tau)


def gain_function(problem: Problem, steps: int) -> ca.Function:
    """(x, u, p) -> K (nu, nx): infinite-horizon LQR gain about the fixed point (x, u), by `steps` Riccati recursions.

    The linear-quadratic problem is that of the expert: linearised dynamics, Gauss-Newton cost.
    """
    nx, nu = problem.nx, problem.nu
    x, u, p = ca.MX.sym("x", nx), ca.MX.sym("u", nu), ca.MX.sym("p", problem.np)
    size = nx + nx * nx
    carry, row = ca.MX.sym("carry", size + 3), ca.MX.sym("row", nx + nu)
    # Without its gradient the value is quadratic, and without bounds the recursion is Riccati's.
    Q = parts.expansion_function(problem)(ca.MX.zeros(nx), ca.reshape(carry[nx:size], nx, nx), row, p, 0.0)
    zero, one = ca.MX.zeros(nu), ca.MX.ones(nu)
    value, gain = parts.gains_function(problem)(zero, one, *Q[:7], ca.MX.zeros(3))
    recursion = expanded(f"{problem.name}_riccati", [carry, row, p], [value, gain])
    value, gain = ca.MX.zeros(size + 3), ca.MX.zeros(nu * nx)
    for _ in range(steps):
        value, gain = recursion(value, ca.vertcat(x, u), p)
    return ca.Function(f"{problem.name}_lqr", [x, u, p], [ca.reshape(gain, nu, nx)], ["x", "u", "p"], ["K"])


class StationaryGain:
    """Compiled `gain_function`: ``gain(x, u, p)`` is the LQR feedback K (nu, nx) about the fixed point, du = K dx."""

    def __init__(self, problem: Problem, steps: int = 200, compiled: bool = True) -> None:
        function = gain_function(problem, steps)
        self._kernel = Kernel(build(function) if compiled else function)
        self._shape = (problem.nu, problem.nx)

    def __call__(self, x: Array, u: Array, parameters: Array) -> Array:
        """K (nu, nx) at the fixed point x (nx,), u (nu,)."""
        inputs = self._kernel.inputs
        inputs["x"][:], inputs["u"][:], inputs["p"][:] = x, u, parameters
        self._kernel()
        # Kernels hold transposes, and a single-row K comes as (nx, 1).
        return self._kernel.outputs["K"].reshape(self._shape[::-1]).T.copy()
