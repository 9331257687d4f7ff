"""How fast the expert plans, beside crocoddyl's SolverBoxDDP on the same problem in the same run.

Both minimise the same generated cost over the same generated dynamics with Gauss-Newton Hessians; crocoddyl's action
model is C++ (`perf_crocoddyl.cpp`) that calls generated C, compiled with the flags of the expert's own code. Its
library is used as pip installs it, on one thread. Timings of the two alternate, so that a busy machine slows both.

* *us per iteration*: both solve the swing-up (the swerve) from the same first trajectory, for some iterations.
* *us per warm step*: both start from the same shifted plans along an episode, and stop at the first iteration whose
  cost is within 1e-6 of the optimum. Steps where one of them ends in another local minimum are left out and counted.

Run ``python -m safeswitch.perf``. crocoddyl and Eigen's headers come from ``pip install crocoddyl cmeel-eigen``.
"""

from __future__ import annotations

import importlib.metadata
import time
from collections.abc import Callable
from dataclasses import dataclass
from statistics import median
from typing import Any

import numpy as np
from numpy.typing import NDArray

from safeswitch.expert.cart_pole_model import PARAMETERS as PARAMETER_NAMES
from safeswitch.expert.cart_pole_model import SWINGS, SwingCandidates, dynamics, make_cart_pole_expert, residuals
from safeswitch.expert.ddp import DDPSolver, Solution, make_solver
from safeswitch.expert.rally_car_model import RallyCarExpert, make_rally_car_expert
from safeswitch.perf_crocoddyl import Crocoddyl, UnavailableError
from safeswitch.perf_handover import handover_benchmark
from safeswitch.perf_rendering import decision_benchmark, rendering_benchmark
from safeswitch.tasks.cart_pole import CartPoleConfig

Array = NDArray[np.float64]

TASK = CartPoleConfig()
PARAMETERS = np.array([getattr(TASK, name) for name in PARAMETER_NAMES])
HANGING = np.array([0.0, 0.0, np.pi - 0.05, 0.0])
RALLY_S = 50.0  # [m]
RALLY = np.array([23.9, 1.9, 0.34, 0.23, 1.0, 0.0, RALLY_S + 4.5, -0.3, 0.3])  # an obstacle ahead
EQUAL_COST = 1e-6  # relative
WARM_STEPS = 60
NEVER = 1e-300  # crocoddyl wants a positive stopping threshold


@dataclass(frozen=True)
class Setting:
    """A problem that both solvers solve.

    Attributes:
        solver: the expert's.
        parameters: (np,) of the model.
        x: (N + 1, nx), u: (N, nu), feasible trajectory that both start from, and end in the same optimum.
        noise: (nx,) standard deviation of the states of an episode of warm steps.
        iterations: of a timed solve; neither solver has converged by then.
    """

    solver: DDPSolver
    parameters: Array
    x: Array
    u: Array
    noise: tuple[float, ...]
    iterations: int


def expert_benchmark(horizon: int = 50, repeats: int = 40) -> dict[str, Any]:
    """Time the cart-pole's expert, and crocoddyl beside it where it is installed.

    Args:
        horizon: controls of the swing-up on which iterations are timed.
        repeats: timings of each; medians are returned.

    Returns:
        Plain numbers and strings. ``skipped`` says why the comparison is missing; its keys are then absent.
    """
    mpc = make_cart_pole_expert(TASK.control_dt, rail=TASK.rail)
    steps = expert_steps(mpc.reset, lambda state: (mpc.action(state, PARAMETERS), mpc.plan_x[1])[1], HANGING, repeats)
    return {"horizon": horizon, **steps, **solver_benchmark(swing_up(horizon), repeats)}


def rally_car_benchmark(repeats: int = 40) -> dict[str, Any]:
    """The same for the rally car's expert: steering around an obstacle 4 m ahead at 4 m/s."""
    expert = make_rally_car_expert()
    mpc, state = expert.mpc, np.array([RALLY_S, 0.0, 0.0, 4.0, 0.0, 0.0, 0.0])

    def step(state: Array) -> Array:
        expert.action(state, RALLY)
        s, e_y, e_psi, v_y, r = mpc.plan_x[1]
        return np.array([s, e_y, e_psi, 4.0, v_y, r, 0.0])

    steps = expert_steps(expert.reset, step, state, repeats)
    expert.reset()
    expert.action(state, RALLY)  # shows the solver the track and the obstacle
    return {"horizon": mpc.solver.problem.horizon, **steps, **solver_benchmark(swerve(expert), repeats)}


def solver_benchmark(setting: Setting, repeats: int) -> dict[str, Any]:
    """Microseconds of an iteration of the solver, and crocoddyl's beside it."""
    results: dict[str, Any] = {"compiled": setting.solver.is_compiled}
    ours = iteration_timer(setting)
    results["us_per_iteration"] = median(ours() for _ in range(repeats))
    try:
        results.update(compare(setting, repeats))
    except UnavailableError as reason:
        results["skipped"] = str(reason)
    return results


def expert_steps(
    reset: Callable[[], None], step: Callable[[Array], Array], start: Array, repeats: int
) -> dict[str, float]:
    """Microseconds of a whole step in Python: cold, and warm along an episode (model = plant).

    Args:
        reset: makes the next step a cold start.
        step: state -> planned next state.
        start: first state of each episode.
        repeats: cold starts; the first three go on for an episode.
    """
    cold: list[float] = []
    warm: list[float] = []
    for episode in range(repeats):
        reset()
        state = start
        for i in range(WARM_STEPS if episode < 3 else 1):
            begin = time.perf_counter()
            state = step(state)
            (warm if i else cold).append(1e6 * (time.perf_counter() - begin))
    return {"us_per_cold_start": median(cold), "us_per_warm_action": median(warm)}


def swing_up(horizon: int) -> Setting:
    """The cart-pole's swing-up from the roll-out of an energy-shaping swing.

    From here both solvers end in the same optimum; from arbitrary controls each may find its own.
    """
    stage, terminal = residuals(TASK.rail)
    solver = make_solver("cart_pole", dynamics(TASK.control_dt), stage, terminal, horizon, -1.0, 1.0)
    swing = SwingCandidates(solver.problem, TASK.control_dt)(HANGING, PARAMETERS)[-len(SWINGS)]
    plan = solver.solve(HANGING, PARAMETERS, swing.u, iterations=0)
    return Setting(solver, PARAMETERS, plan.x, plan.u, (0.01, 0.05, 0.01, 0.05), 15)


def swerve(expert: RallyCarExpert) -> Setting:
    """The rally car's way around an obstacle, from the roll-out of a first plan that passes it on the left."""
    solver, inputs = expert.mpc.solver, expert.mpc.solver.kernel.inputs
    x0, parameters = inputs["x0"].copy(), inputs["p"].copy()
    first = expert.mpc.candidates(x0, parameters)[1]
    K = np.broadcast_to(first.K, (solver.problem.horizon, solver.problem.nu, solver.problem.nx))
    plan = solver.solve(x0, parameters, first.u, first.x, K, iterations=0)
    return Setting(solver, parameters, plan.x, plan.u, (0.0, 0.01, 0.01, 0.02, 0.05), 8)


def solve(setting: Setting, x: Array, u: Array, iterations: int, tolerance: float) -> None:
    """Our solver from the trajectory x (N + 1, nx), u (N, nu), without feedback gains, as crocoddyl's `solve`."""
    solver, inputs = setting.solver, setting.solver.kernel.inputs
    nx = solver.problem.nx
    inputs["x0"][:], inputs["p"][:], inputs["gains_init"][:] = x[0], setting.parameters, 0.0
    inputs["plan_init"][:, :nx] = x
    inputs["plan_init"][:-1, nx:] = u
    solver.run(iterations, tolerance)


def iteration_timer(setting: Setting) -> Callable[[], float]:
    """A function that solves and returns the microseconds of an iteration."""
    timer = _timer(lambda: solve(setting, setting.x, setting.u, setting.iterations, 0.0))
    return lambda: timer() / float(setting.solver.kernel.outputs["info"][1])


def compare(setting: Setting, repeats: int) -> dict[str, Any]:
    """Numbers of crocoddyl, and the ratios of ours to them."""
    solver, parameters, x, u = setting.solver, setting.parameters, setting.x, setting.u
    rival = Crocoddyl(solver.problem)
    solve(setting, x, u, 200, 1e-13)
    our_cost = float(solver.kernel.outputs["info"][0])
    rival_cost = rival.solve(parameters, x, u, 500, 1e-15)[0]

    ours, times, theirs = iteration_timer(setting), [], []
    for _ in range(repeats):
        times.append(ours())
        _, iterations, seconds = rival.solve(parameters, x, u, setting.iterations, NEVER)
        theirs.append(1e6 * seconds / iterations)
    warm_ours, warm_theirs = warm_steps(setting, rival, max(repeats // 8, 3))
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


def warm_steps(setting: Setting, rival: Crocoddyl, repeats: int) -> tuple[list[float], list[float]]:
    """Microseconds of each solver at each warm step, from the same shifted plan to the same cost."""
    solver, parameters, horizon = setting.solver, setting.parameters, setting.solver.problem.horizon
    best = solver.solve(setting.x[0], parameters, setting.u, iterations=200)
    noise = np.random.default_rng(0)
    ours, theirs = [], []
    for _ in range(WARM_STEPS):
        # The next state is disturbed; the shifted plan is rolled out from it with its gains, once for both.
        state = best.x[1] + noise.normal(size=len(setting.noise)) * setting.noise
        shift = np.minimum(np.arange(1, horizon + 1), horizon - 1)
        x_init = best.x[np.minimum(np.arange(1, horizon + 2), horizon)]
        start = solver.solve(state, parameters, best.u[shift], x_init, best.K[shift], iterations=0)
        best = solver.solve(state, parameters, start.u, start.x, iterations=200, tolerance=1e-12)
        times = equal_cost_times(setting, rival, start, best.cost * (1 + EQUAL_COST) + 1e-9, repeats)
        if times is not None:
            ours.append(times[0])
            theirs.append(times[1])
    return ours, theirs


def equal_cost_times(
    setting: Setting, rival: Crocoddyl, start: Solution, goal: float, repeats: int
) -> tuple[float, float] | None:
    """Microseconds of each until the cost `goal`; None if one of them ended in another local minimum."""

    def theirs(iterations: int) -> tuple[float, int, float]:
        return rival.solve(setting.parameters, start.x, start.u, iterations, NEVER)

    needed = _first(lambda n: _our_cost(setting, start.x, start.u, n), goal)
    rival_needed = _first(lambda n: theirs(n)[0], goal)
    if needed == 0 or rival_needed == 0:
        return None
    timer = _timer(lambda: solve(setting, start.x, start.u, needed, 0.0))
    pairs = [(timer(), 1e6 * theirs(rival_needed)[2]) for _ in range(repeats)]
    return median(pair[0] for pair in pairs), median(pair[1] for pair in pairs)


def _our_cost(setting: Setting, x: Array, u: Array, iterations: int) -> float:
    solve(setting, x, u, iterations, 0.0)
    return float(setting.solver.kernel.outputs["info"][0])


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


def main() -> None:
    """Print every benchmark."""
    benchmarks: dict[str, Callable[[], dict[str, Any]]] = {
        "expert": expert_benchmark,
        "expert of the rally car": rally_car_benchmark,
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
