"""How fast the expert plans, beside crocoddyl's SolverBoxDDP on the same problem in the same run.

Both minimise the same generated cost over the same generated dynamics with Gauss-Newton Hessians; crocoddyl's action
model is C++ (`perf_crocoddyl.cpp`) that calls generated C, compiled with the flags of the expert's own code. Its
library is used as pip installs it, on one thread. Timings of the two alternate, so that a busy machine slows both.

* *us per iteration*: both solve the swing-up from the same first trajectory, for a fixed number of iterations.
* *us per warm step*: both start from the same shifted plans along an episode, and stop at the first iteration whose
  cost is within 1e-6 of the optimum. Steps where one of them ends in another local minimum are left out and counted.

Run ``python -m safeswitch.perf``. crocoddyl and Eigen's headers come from ``pip install crocoddyl cmeel-eigen``.
"""

from __future__ import annotations

import ctypes
import importlib.metadata
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from safeswitch.expert.cart_pole_model import PARAMETERS as PARAMETER_NAMES
from safeswitch.expert.cart_pole_model import SWINGS, SwingCandidates, dynamics, make_cart_pole_expert, residuals
from safeswitch.expert.codegen import FLAGS, find_compiler, source
from safeswitch.expert.ddp import DDPSolver, Problem, Solution, make_solver
from safeswitch.expert.graph import expanded
from safeswitch.perf_handover import handover_benchmark
from safeswitch.perf_rendering import decision_benchmark, rendering_benchmark
from safeswitch.tasks.cart_pole import CartPoleConfig

Array = NDArray[np.float64]

TASK = CartPoleConfig()
PARAMETERS = np.array([getattr(TASK, name) for name in PARAMETER_NAMES])
HANGING = np.array([0.0, 0.0, np.pi - 0.05, 0.0])
EQUAL_COST = 1e-6  # relative
ITERATIONS = 15  # of a timed swing-up; neither solver has converged by then
WARM_STEPS = 60
NEVER = 1e-300  # crocoddyl wants a positive stopping threshold
INSTALL = "pip install crocoddyl==3.2.1 cmeel-eigen"


class UnavailableError(RuntimeError):
    """The comparison cannot run here; the message says what to install."""


def expert_benchmark(horizon: int = 50, repeats: int = 40) -> dict[str, Any]:
    """Time the expert, and crocoddyl beside it where it is installed.

    Args:
        horizon: controls of the swing-up on which iterations are timed.
        repeats: timings of each; medians are returned.

    Returns:
        Plain numbers and strings. ``skipped`` says why the comparison is missing; its keys are then absent.
    """
    results: dict[str, Any] = {"horizon": horizon, **expert_steps(repeats)}
    solver = swing_up_solver(horizon)
    results["compiled"] = solver.is_compiled
    start = first_plan(solver)
    ours = _timer(lambda: solve(solver, *start, ITERATIONS, 0.0))
    results["us_per_iteration"] = median(ours() for _ in range(repeats)) / ITERATIONS
    try:
        results.update(compare(solver, repeats))
    except UnavailableError as reason:
        results["skipped"] = str(reason)
    return results


def expert_steps(repeats: int) -> dict[str, float]:
    """Microseconds of a whole `MPC.action` call in Python: cold, and warm along an episode (model = plant)."""
    mpc = make_cart_pole_expert(TASK.control_dt, rail=TASK.rail)
    cold: list[float] = []
    warm: list[float] = []
    for episode in range(repeats):
        mpc.reset()
        state = HANGING
        for i in range(WARM_STEPS if episode < 3 else 1):
            begin = time.perf_counter()
            mpc.action(state, PARAMETERS)
            (warm if i else cold).append(1e6 * (time.perf_counter() - begin))
            state = mpc.plan_x[1]
    return {"us_per_cold_start": median(cold), "us_per_warm_action": median(warm)}


def swing_up_solver(horizon: int) -> DDPSolver:
    """The expert's solver for `horizon` controls."""
    stage, terminal = residuals(TASK.rail)
    return make_solver("cart_pole", dynamics(TASK.control_dt), stage, terminal, horizon, -1.0, 1.0)


def first_plan(solver: DDPSolver) -> tuple[Array, Array]:
    """Feasible states and controls from which the swing-up is timed: the roll-out of an energy-shaping swing.

    From here both solvers end in the same optimum; from arbitrary controls each may find its own.
    """
    swing = SwingCandidates(solver.problem, TASK.control_dt)(HANGING, PARAMETERS)[-len(SWINGS)]
    plan = solver.solve(HANGING, PARAMETERS, swing.u, iterations=0)
    return plan.x, plan.u


def solve(solver: DDPSolver, x: Array, u: Array, iterations: int, tolerance: float) -> None:
    """Our solver from the trajectory x (N + 1, nx), u (N, nu), without feedback gains, as crocoddyl's `solve`."""
    problem, inputs = solver.problem, solver.kernel.inputs
    inputs["x0"][:], inputs["p"][:], inputs["gains_init"][:] = x[0], PARAMETERS, 0.0
    inputs["plan_init"][:, : problem.nx] = x
    inputs["plan_init"][:-1, problem.nx :] = u
    solver.run(iterations, tolerance)


def compare(solver: DDPSolver, repeats: int) -> dict[str, Any]:
    """Numbers of crocoddyl, and the ratios of ours to them."""
    rival = Crocoddyl(solver.problem)
    x, u = first_plan(solver)
    solve(solver, x, u, 200, 1e-13)
    our_cost = float(solver.kernel.outputs["info"][0])
    rival_cost = rival.solve(x, u, 500, 1e-15)[0]

    ours, theirs = _timer(lambda: solve(solver, x, u, ITERATIONS, 0.0)), []
    times = []
    for _ in range(repeats):
        times.append(ours() / ITERATIONS)
        _, iterations, seconds = rival.solve(x, u, ITERATIONS, NEVER)
        theirs.append(1e6 * seconds / iterations)
    warm_ours, warm_theirs = warm_steps(solver, rival, max(repeats // 8, 3))
    return {
        "crocoddyl": importlib.metadata.version("crocoddyl"),
        "cost": our_cost,
        "crocoddyl_cost": rival_cost,
        "equal_cost": abs(our_cost - rival_cost) <= EQUAL_COST * abs(rival_cost),
        "us_per_iteration": median(times),
        "crocoddyl_us_per_iteration": median(theirs),
        "ratio_per_iteration": median(a / b for a, b in zip(times, theirs, strict=True)),
        "us_per_warm_step": median(warm_ours),
        "crocoddyl_us_per_warm_step": median(warm_theirs),
        "ratio_per_warm_step": sum(warm_ours) / sum(warm_theirs),
        "warm_steps_compared": f"{len(warm_ours)} of {WARM_STEPS}",
    }


def warm_steps(solver: DDPSolver, rival: Crocoddyl, repeats: int) -> tuple[list[float], list[float]]:
    """Microseconds of each solver at each warm step, from the same shifted plan to the same cost."""
    horizon = solver.problem.horizon
    x, u = first_plan(solver)
    best = solver.solve(x[0], PARAMETERS, u, iterations=200)
    noise = np.random.default_rng(0)
    ours, theirs = [], []
    for _ in range(WARM_STEPS):
        # The next state is disturbed; the shifted plan is rolled out from it with its gains, once for both.
        state = best.x[1] + noise.normal(size=4) * [0.01, 0.05, 0.01, 0.05]
        shift = np.minimum(np.arange(1, horizon + 1), horizon - 1)
        x_init = best.x[np.minimum(np.arange(1, horizon + 2), horizon)]
        start = solver.solve(state, PARAMETERS, best.u[shift], x_init, best.K[shift], iterations=0)
        best = solver.solve(state, PARAMETERS, start.u, start.x, iterations=200, tolerance=1e-12)
        times = equal_cost_times(solver, rival, start, best.cost * (1 + EQUAL_COST) + 1e-9, repeats)
        if times is not None:
            ours.append(times[0])
            theirs.append(times[1])
    return ours, theirs


def equal_cost_times(
    solver: DDPSolver, rival: Crocoddyl, start: Solution, goal: float, repeats: int
) -> tuple[float, float] | None:
    """Microseconds of each until the cost `goal`; None if one of them ended in another local minimum."""
    needed = _first(lambda n: _our_cost(solver, start.x, start.u, n), goal)
    rival_needed = _first(lambda n: rival.solve(start.x, start.u, n, NEVER)[0], goal)
    if needed == 0 or rival_needed == 0:
        return None
    timer = _timer(lambda: solve(solver, start.x, start.u, needed, 0.0))
    pairs = [(timer(), 1e6 * rival.solve(start.x, start.u, rival_needed, NEVER)[2]) for _ in range(repeats)]
    return median(pair[0] for pair in pairs), median(pair[1] for pair in pairs)


def _our_cost(solver: DDPSolver, x: Array, u: Array, iterations: int) -> float:
    solve(solver, x, u, iterations, 0.0)
    return float(solver.kernel.outputs["info"][0])


def _first(cost: Callable[[int], float], goal: float, most: int = 60) -> int:
    """Smallest number of iterations that reaches the cost `goal`; 0 if `most` do not."""
    return next((n for n in range(1, most + 1) if cost(n) <= goal), 0)


def _timer(call: Callable[[], object]) -> Callable[[], float]:
    """A function that makes the call and returns its microseconds."""

    def timed() -> float:
        begin = time.perf_counter()
        call()
        return 1e6 * (time.perf_counter() - begin)

    return timed


class Crocoddyl:
    """crocoddyl's SolverBoxDDP of a `Problem`, through `perf_crocoddyl.cpp`."""

    def __init__(self, problem: Problem) -> None:
        self._nx, self._nu = problem.nx, problem.nu
        with tempfile.TemporaryDirectory(prefix="safeswitch-perf-") as folder:  # a loaded library needs no file
            self._library = ctypes.CDLL(str(compile_rival(problem, Path(folder))))
        self._library.croco_make.restype = ctypes.c_void_p
        lo, hi = np.array(problem.u_lo), np.array(problem.u_hi)
        self._handle = ctypes.c_void_p(
            self._library.croco_make(problem.nx, problem.nu, problem.np, problem.horizon, _pointer(lo), _pointer(hi))
        )

    def solve(self, x: Array, u: Array, iterations: int, stop: float) -> tuple[float, int, float]:
        """(cost, iterations made, seconds) from the feasible trajectory x (N + 1, nx), u (N, nu)."""
        x, u, info = x.copy(), u.copy(), np.zeros(3)
        arguments = (_pointer(PARAMETERS), _pointer(x), _pointer(u))
        self._library.croco_solve(self._handle, *arguments, iterations, ctypes.c_double(stop), _pointer(info))
        return float(info[0]), int(info[1]), float(info[2])

    def __del__(self) -> None:
        if hasattr(self, "_handle"):
            self._library.croco_free(self._handle)


def _pointer(array: Array) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)


def compile_rival(problem: Problem, folder: Path) -> Path:
    """Compile the C++ program with the generated C code into a library in `folder`."""
    compiler, plain = shutil.which("g++"), find_compiler()
    if compiler is None or plain is None:
        raise UnavailableError("no g++ on the PATH (on Debian or Ubuntu: apt-get install -y g++)")
    prefix = crocoddyl_prefix()
    flags = [flag for flag in FLAGS if flag != "-shared"]
    objects = []
    for function in action_functions(problem):
        c_file, built = folder / f"{function.name()}.c", folder / f"{function.name()}.o"
        c_file.write_text(source(function))
        _compile([plain, *flags, "-c", str(c_file), "-o", str(built)])
        objects.append(str(built))
    # The wheel is built for the plain architecture, and Eigen's allocator depends on it: with -march=native here,
    # matrices would be allocated one way and freed the other. This file only passes pointers on;
    # the arithmetic is in `objects`.
    cpp = [compiler, "-std=c++17", "-O3", "-DNDEBUG", "-fPIC", "-shared"]
    cpp += [f"-I{prefix / 'include'}", f"-I{prefix / 'include' / 'eigen3'}"]
    library = folder / "libperf_crocoddyl.so"
    program = Path(__file__).with_name("perf_crocoddyl.cpp")
    link = [f"-L{prefix / 'lib'}", "-lcrocoddyl", f"-Wl,--disable-new-dtags,-rpath,{prefix / 'lib'}"]
    _compile([*cpp, str(program), *objects, *link, "-o", str(library)])
    return library


def crocoddyl_prefix() -> Path:
    """Where pip put crocoddyl's and Eigen's headers and libraries."""
    try:
        distribution = importlib.metadata.distribution("libcrocoddyl")
    except importlib.metadata.PackageNotFoundError:
        raise UnavailableError(f"crocoddyl is not installed ({INSTALL})") from None
    prefix = Path(str(distribution.locate_file("cmeel.prefix")))
    if not (prefix / "include" / "eigen3" / "Eigen" / "Core").is_file():
        raise UnavailableError(f"Eigen's headers are not installed ({INSTALL})")
    return prefix


def _compile(command: list[str]) -> None:
    answer = subprocess.run(command, capture_output=True, text=True, check=False)
    if answer.returncode != 0:
        raise UnavailableError(f"{command[0]} failed: {answer.stderr.strip()[-800:]}")


def action_functions(problem: Problem) -> list[ca.Function]:
    """What crocoddyl's action model calls: dynamics, cost, and their derivatives (Gauss-Newton Hessians)."""
    x, u, p = ca.MX.sym("x", problem.nx), ca.MX.sym("u", problem.nu), ca.MX.sym("p", problem.np)
    f, r, end = problem.dynamics(x, u, p), problem.residual(x, u, p), problem.terminal_residual(x, p)
    rx, ru, end_x = ca.jacobian(r, x), ca.jacobian(r, u), ca.jacobian(end, x)
    slopes = [ca.jacobian(f, x), ca.jacobian(f, u), rx.T @ r, ru.T @ r]
    return [
        expanded("perf_calc", [x, u, p], [f, 0.5 * ca.sumsqr(r)]),
        expanded("perf_diff", [x, u, p], [*slopes, rx.T @ rx, ru.T @ ru, rx.T @ ru]),
        expanded("perf_end_calc", [x, p], [0.5 * ca.sumsqr(end)]),
        expanded("perf_end_diff", [x, p], [end_x.T @ end, end_x.T @ end_x]),
    ]


def main() -> None:
    """Print every benchmark."""
    benchmarks: dict[str, Callable[[], dict[str, Any]]] = {
        "expert": expert_benchmark,
        "rendering": rendering_benchmark,
        "decision": decision_benchmark,
        "handover table": handover_benchmark,
    }
    for title, benchmark in benchmarks.items():
        results = benchmark()
        print(f"--- {title}")
        for name, value in results.items():
            print(f"{name:28s} {value:.6g}" if isinstance(value, float) else f"{name:28s} {value}")


if __name__ == "__main__":
    main()
