r"""Box-constrained differential dynamic programming, generated as one C function.

Tassa, Erez & Todorov (2012), "Synthesis and stabilization of complex behaviors through online trajectory
optimization", https://doi.org/10.1109/IROS.2012.6386025, and Tassa, Mansard & Todorov (2014), "Control-limited
differential dynamic programming", https://doi.org/10.1109/ICRA.2014.6907001. The problem is

.. math::
    \min_{u_0..u_{N-1}} \tfrac12 |r_N(x_N, p)|^2 + \sum_i \tfrac12 |r(x_i, u_i, p)|^2,
    \quad x_{i+1} = f(x_i, u_i, p), \quad u_{lo} \le u_i \le u_{hi}.

Costs are squared residuals, and their Hessians are Gauss-Newton's, J^T J, hence never negative. Second derivatives of f
are an option. Model parameters p are an input, so that a changed mass needs no new solver.

Everything (backward passes, regularisation, line search, early exits) is one CasADi function: see `_solve_function`,
which reads top-down. What is compiled and what CasADi's virtual machine runs is therefore the same expression graph.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from safeswitch.expert import ddp_parts as parts
from safeswitch.expert.codegen import Kernel, build, is_compiled
from safeswitch.expert.graph import bounded_while

Array = NDArray[np.float64]

MAX_ITERATIONS = 256  # size of the generated loop; the limit of a call is an input
INFO = ("cost", "iterations", "converged", "regularisation", "initial_cost")


@dataclass(frozen=True)
class Solution:
    """A plan and how it was found.

    Attributes:
        x: (N + 1, nx) states.
        u: (N, nu) controls, within their bounds.
        K: (N, nu, nx) feedback gains, du = K dx; zero rows where a control is at its bound.
        cost: objective of the plan.
        initial_cost: objective of the first roll-out.
        iterations: backward passes made.
        converged: whether the expected decrease fell below the tolerance.
        regularisation: mu at the end.
    """

    x: Array
    u: Array
    K: Array
    cost: float
    initial_cost: float
    iterations: int
    converged: bool
    regularisation: float

    @property
    def is_finite(self) -> bool:
        """Whether every number of the plan is finite."""
        return bool(np.isfinite(self.cost) and np.isfinite(self.x).all() and np.isfinite(self.u).all())


@dataclass(frozen=True)
class Problem:
    """An optimal control problem in CasADi.

    Attributes:
        name: prefix of the generated symbols (a C identifier).
        dynamics: (x, u, p) -> next x.
        residual: (x, u, p) -> r, a column; stage cost 0.5 |r|^2.
        terminal_residual: (x, p) -> r_N, a column; terminal cost 0.5 |r_N|^2.
        horizon: N, number of controls.
        u_lo: (nu,) lower bounds of the controls.
        u_hi: (nu,) upper bounds.
        second_order: add the dynamics' second derivatives (full DDP instead of iLQR).
    """

    name: str
    dynamics: ca.Function
    residual: ca.Function
    terminal_residual: ca.Function
    horizon: int
    u_lo: tuple[float, ...]
    u_hi: tuple[float, ...]
    second_order: bool = False

    def __post_init__(self) -> None:
        if self.horizon < 1:
            raise ValueError(f"horizon must be at least 1 control, got {self.horizon}")
        if not len(self.u_lo) == len(self.u_hi) == self.nu:
            raise ValueError(f"bounds need {self.nu} numbers each, got {len(self.u_lo)} and {len(self.u_hi)}")
        if not all(lo < hi for lo, hi in zip(self.u_lo, self.u_hi, strict=True)):
            raise ValueError(f"every lower bound must be below its upper bound, got {self.u_lo} and {self.u_hi}")
        if self.dynamics.size1_out(0) != self.nx:
            raise ValueError(f"dynamics must return {self.nx} states, got {self.dynamics.size1_out(0)}")

    @property
    def nx(self) -> int:
        """Number of states."""
        return int(self.dynamics.size1_in(0))

    @property
    def nu(self) -> int:
        """Number of controls."""
        return int(self.dynamics.size1_in(1))

    @property
    def np(self) -> int:
        """Number of model parameters."""
        return int(self.dynamics.size1_in(2))


class DDPSolver:
    """A generated solver of one `Problem`.

    `solve` is the convenient call. The receding-horizon loop writes into `kernel.inputs` and calls `run`:
    ``x0 (nx,)``, ``p (np,)``, ``plan_init (N + 1, nx + nu)`` with a state and a control per row (the last control is
    ignored), ``gains_init (N, nx * nu)``, each row K in column-major order, and ``limits (2,)`` = most iterations and
    tolerance. Outputs are ``plan``, ``gains`` and ``info``.
    """

    def __init__(self, problem: Problem, compiled: bool = True) -> None:
        self.problem = problem
        function = solve_function(problem)
        self.kernel = Kernel(build(function) if compiled else function)

    @property
    def is_compiled(self) -> bool:
        """Whether the solver is machine code rather than CasADi's virtual machine."""
        return is_compiled(self.kernel.function)

    def run(self, iterations: int, tolerance: float) -> None:
        """Solve what stands in `kernel.inputs`; the result is in `kernel.outputs`."""
        limits = self.kernel.inputs["limits"]
        limits[0] = iterations
        limits[1] = tolerance
        self.kernel()

    def solve(
        self,
        x0: ArrayLike,
        parameters: ArrayLike,
        u_init: ArrayLike | None = None,
        x_init: ArrayLike | None = None,
        K_init: ArrayLike | None = None,
        iterations: int = 100,
        tolerance: float = 1e-9,
    ) -> Solution:
        """Solve from x0 (nx,) with model parameters (np,), first rolling out the policy u_init + K_init (x - x_init).

        Args:
            x0: (nx,) initial state.
            parameters: (np,) model parameters.
            u_init: (N, nu) controls, zero by default.
            x_init: (N + 1, nx) states that K_init refers to, zero by default.
            K_init: (N, nu, nx) feedback gains, zero by default.
            iterations: most backward passes, up to MAX_ITERATIONS.
            tolerance: stop when the expected decrease is below tolerance * (1 + cost).
        """
        problem, inputs = self.problem, self.kernel.inputs
        nx, nu, horizon = problem.nx, problem.nu, problem.horizon
        if not 0 <= iterations <= MAX_ITERATIONS:
            raise ValueError(f"iterations must lie in 0..{MAX_ITERATIONS}, got {iterations}")
        inputs["x0"][:] = x0
        inputs["p"][:] = parameters
        inputs["plan_init"][:, :nx] = 0.0 if x_init is None else x_init
        inputs["plan_init"][:horizon, nx:] = 0.0 if u_init is None else u_init
        inputs["gains_init"].reshape(horizon, nx, nu)[:] = 0.0 if K_init is None else np.swapaxes(K_init, 1, 2)
        self.run(iterations, tolerance)
        return self.solution()

    def solution(self) -> Solution:
        """Copy of the kernel's current outputs."""
        problem, out = self.problem, self.kernel.outputs
        nx, nu, horizon = problem.nx, problem.nu, problem.horizon
        cost, iterations, converged, regularisation, initial_cost = out["info"].tolist()
        return Solution(
            x=out["plan"][:, :nx].copy(),
            u=out["plan"][:horizon, nx:].copy(),
            K=np.ascontiguousarray(out["gains"].reshape(horizon, nx, nu).swapaxes(1, 2)),
            cost=cost,
            initial_cost=initial_cost,
            iterations=int(iterations),
            converged=bool(converged),
            regularisation=regularisation,
        )


def make_solver(
    name: str,
    dynamics: ca.Function,
    residual: ca.Function,
    terminal_residual: ca.Function,
    horizon: int,
    u_lo: ArrayLike,
    u_hi: ArrayLike,
    second_order: bool = False,
    compiled: bool = True,
) -> DDPSolver:
    """Generate, compile (or find in the cache) and bind the solver of a `Problem` given by its parts."""
    lo, hi = (tuple(float(v) for v in np.atleast_1d(np.asarray(bound, dtype=np.float64))) for bound in (u_lo, u_hi))
    problem = Problem(name, dynamics, residual, terminal_residual, horizon, lo, hi, second_order)
    return DDPSolver(problem, compiled)


def solve_function(problem: Problem) -> ca.Function:
    """The whole solve: (x0, p, plan, gains, limits) -> (plan, gains, info)."""
    nx, nu, horizon = problem.nx, problem.nu, problem.horizon
    x0, p, limits = ca.MX.sym("x0", nx), ca.MX.sym("p", problem.np), ca.MX.sym("limits", 2)
    plan, gains = ca.MX.sym("plan", nx + nu, horizon + 1), ca.MX.sym("gains", nu * nx, horizon)

    rollout = parts.rollout_function(problem)
    loop = bounded_while(parts.iteration_function(problem, rollout), MAX_ITERATIONS)

    no_feedforward = ca.MX.zeros(nu, horizon)
    trajectory, cost = rollout(x0, plan, no_feedforward, gains, 1.0, p)
    # state of the loop: running, cost, mu, delta, iterations, converged
    running = ca.logic_and(ca.fabs(cost) < 1e300, limits[0] >= 1)
    state = ca.vertcat(running, cost, 0.0, 1.0, 0.0, 0.0)
    state, trajectory, gains_out = loop(state, trajectory, gains, p, limits)
    info = ca.vertcat(state[1], state[4], state[5], state[2], cost)
    return ca.Function(
        f"{problem.name}_ddp",
        [x0, p, plan, gains, limits],
        [trajectory, gains_out, info],
        ["x0", "p", "plan_init", "gains_init", "limits"],
        ["plan", "gains", "info"],
    )
