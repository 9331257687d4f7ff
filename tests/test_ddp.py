"""The solver against what is known exactly: Riccati, finite differences, bounded least squares, brute force."""

from __future__ import annotations

from functools import cache
from itertools import product

import casadi as ca
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.optimize import lsq_linear

from safeswitch.expert import cart_pole_model as cart_pole
from safeswitch.expert import ddp_parts as parts
from safeswitch.expert.box_qp import box_qp_function
from safeswitch.expert.ddp import MAX_ITERATIONS, DDPSolver, Problem, make_solver

Array = NDArray[np.float64]

# Of the cart-pole [SI units]; with a cost of this file, which does not move when the task is tuned.
PARAMETERS = np.array([1.0, 0.1, 0.5, 1e-4, 0.05, 0.001, 10.0])
HANGING = np.array([0.0, 0.0, np.pi, 0.0])


class Linear:
    """x' = A x + B u, cost 0.5 (x'Qx + u'Ru) per stage and 0.5 x'Sx at the end; random, unstable, `nu` controls."""

    def __init__(self, nx: int, nu: int, horizon: int, bound: float, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        self.nx, self.nu, self.horizon, self.bound = nx, nu, horizon, bound
        self.A = np.eye(nx) + 0.2 * rng.normal(size=(nx, nx))
        self.B = rng.normal(size=(nx, nu))
        self.rx, self.ru, self.rN = (np.triu(rng.normal(size=(n, n))) + 2 * np.eye(n) for n in (nx, nu, nx))
        self.x0 = rng.normal(size=nx)

    def solver(self, compiled: bool = True) -> DDPSolver:
        x, u, p = ca.MX.sym("x", self.nx), ca.MX.sym("u", self.nu), ca.MX.sym("p", 1)
        return make_solver(
            f"linear{self.nu}",
            ca.Function("f", [x, u, p], [self.A @ x + p * (self.B @ u)]),
            ca.Function("r", [x, u, p], [ca.vertcat(self.rx @ x, self.ru @ u)]),
            ca.Function("rN", [x, p], [self.rN @ x]),
            self.horizon,
            [-self.bound] * self.nu,
            [self.bound] * self.nu,
            compiled=compiled,
        )

    def riccati(self) -> tuple[Array, float]:
        """Gains (N, nu, nx), du = K dx, and the optimal cost from x0."""
        Q, R, P = self.rx.T @ self.rx, self.ru.T @ self.ru, self.rN.T @ self.rN
        gains = np.zeros((self.horizon, self.nu, self.nx))
        for i in reversed(range(self.horizon)):
            K = -np.linalg.solve(R + self.B.T @ P @ self.B, self.B.T @ P @ self.A)
            P = Q + self.A.T @ P @ (self.A + self.B @ K)
            gains[i] = K
        return gains, float(0.5 * self.x0 @ P @ self.x0)

    def bounded_least_squares(self) -> tuple[Array, float]:
        """Optimal controls (N, nu) within the bounds, by condensing to 0.5 |G U + h|^2, and their cost."""
        powers = [np.linalg.matrix_power(self.A, i) for i in range(self.horizon + 1)]
        G, h = [], []
        for i in range(self.horizon + 1):
            row = [powers[i - 1 - j] @ self.B if j < i else np.zeros_like(self.B) for j in range(self.horizon)]
            weight = self.rx if i < self.horizon else self.rN
            G.append(weight @ np.hstack(row))
            h.append(weight @ powers[i] @ self.x0)
        G.append(block_diag(*[self.ru] * self.horizon))
        h.append(np.zeros(self.nu * self.horizon))
        answer = lsq_linear(np.vstack(G), -np.concatenate(h), (-self.bound, self.bound), method="bvls", tol=1e-14)
        return answer.x.reshape(self.horizon, self.nu), float(answer.cost)


def swing_up_residuals() -> tuple[ca.Function, ca.Function]:
    x, u, p = ca.MX.sym("x", 4), ca.MX.sym("u"), ca.MX.sym("p", len(PARAMETERS))
    over = ca.fmax(ca.fabs(x[0]) - 1.6, 0)
    r = ca.vertcat(x[0], 0.3 * x[1], 2.2 * ca.sin(x[2]), 2.2 * (1 - ca.cos(x[2])), 0.3 * x[3], 14.0 * over)
    return ca.Function("r", [x, u, p], [ca.vertcat(r, 0.07 * u)]), ca.Function("rN", [x, p], [3.0 * r])


@cache
def swing_up(second_order: bool = False, compiled: bool = True) -> DDPSolver:
    stage, terminal = swing_up_residuals()
    name = "swing_up_exact" if second_order else "swing_up"
    f = cart_pole.dynamics(0.06)
    return make_solver(name, f, stage, terminal, 34, -1.0, 1.0, second_order=second_order, compiled=compiled)


@pytest.mark.parametrize("nu", [1, 2])
def test_one_iteration_solves_a_linear_problem(nu: int) -> None:
    problem = Linear(3, nu, 12, bound=1e6)
    gains, cost = problem.riccati()
    solution = problem.solver().solve(problem.x0, [1.0], iterations=1)
    np.testing.assert_allclose(solution.K, gains, rtol=1e-9, atol=1e-10)
    assert solution.cost == pytest.approx(cost, rel=1e-10)
    np.testing.assert_allclose(solution.u, np.einsum("nux,nx->nu", gains, solution.x[:-1]), rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize(("nu", "bound"), [(1, 0.05), (1, 0.3), (2, 0.05), (2, 0.3)])
def test_active_bounds_agree_with_bounded_least_squares(nu: int, bound: float) -> None:
    problem = Linear(3, nu, 12, bound, seed=3)
    controls, cost = problem.bounded_least_squares()
    solution = problem.solver().solve(problem.x0, [1.0], iterations=100, tolerance=1e-14)
    at_bound = np.abs(controls) > bound - 1e-9
    assert 0 < at_bound.sum()
    assert solution.converged
    assert solution.cost == pytest.approx(cost, rel=1e-9)
    np.testing.assert_allclose(solution.u, controls, atol=1e-5)
    np.testing.assert_array_equal(solution.K[np.abs(solution.u) == bound], 0.0)  # a held control has no feedback
    assert np.abs(solution.u).max() <= bound


def test_parameters_are_inputs() -> None:
    problem = Linear(3, 1, 12, bound=1e6)
    solver = problem.solver()
    problem.B = 0.3 * problem.B
    gains, cost = problem.riccati()
    solution = solver.solve(problem.x0, [0.3], iterations=2)
    np.testing.assert_allclose(solution.K, gains, rtol=1e-9, atol=1e-10)
    assert solution.cost == pytest.approx(cost, rel=1e-10)


@pytest.mark.parametrize("nu", [1, 2, 3])
def test_box_qp_agrees_with_enumeration(nu: int) -> None:
    box_qp = box_qp_function(f"qp{nu}", nu)
    rng = np.random.default_rng(nu)
    for _ in range(300):
        root = rng.normal(size=(nu, nu))
        H, q = root @ root.T + 0.05 * np.eye(nu), 3 * rng.normal(size=nu)
        lo, hi = -rng.uniform(0.0, 1.0, nu), rng.uniform(0.0, 1.0, nu)
        k, free = (np.array(value).ravel() for value in box_qp(H, q, lo, hi))
        np.testing.assert_allclose(k, enumerated(H, q, lo, hi), atol=1e-9)
        np.testing.assert_array_equal(free, (k > lo) & (k < hi))


def enumerated(H: Array, q: Array, lo: Array, hi: Array) -> Array:
    """Minimiser of 0.5 k'Hk + q'k within [lo, hi]: the best feasible point over all active sets."""
    best, value = lo, np.inf
    for active in product((-1, 0, 1), repeat=len(q)):
        side = np.array(active)
        k, free = np.where(side < 0, lo, hi), side == 0
        if free.any():
            rest = q[free] + H[np.ix_(free, ~free)] @ k[~free]
            k[free] = -np.linalg.solve(H[np.ix_(free, free)], rest)
        if (k >= lo - 1e-12).all() and (k <= hi + 1e-12).all() and 0.5 * k @ H @ k + q @ k < value:
            best, value = k, 0.5 * k @ H @ k + q @ k
    return best


def expansion(second_order: bool, row: Array, Vx: Array, Vxx: Array) -> list[Array]:
    problem = swing_up(second_order).problem
    return [np.array(value) for value in parts.expansion_function(problem)(Vx, Vxx, row, PARAMETERS, 0.0)]


def test_expansion_agrees_with_finite_differences() -> None:
    rng = np.random.default_rng(5)
    problem = swing_up().problem
    f, r = problem.dynamics, problem.residual
    root = rng.normal(size=(4, 4))
    Vx, Vxx = rng.normal(size=4), root @ root.T

    def q_value(z: Array, x_next: Array) -> float:
        """Q with the value expanded about `x_next`, the nominal next state."""
        dx = np.array(f(z[:4], z[4:], PARAMETERS)).ravel() - x_next
        residual = np.array(r(z[:4], z[4:], PARAMETERS)).ravel()
        return float(0.5 * residual @ residual + Vx @ dx + 0.5 * dx @ Vxx @ dx)

    for _ in range(5):
        row = np.append(rng.uniform(-1, 1, 4) * [1.9, 2, 3, 5], 0.3)
        x_next = np.array(f(row[:4], row[4:], PARAMETERS)).ravel()
        Qx, Qu, *_ = expansion(False, row, Vx, Vxx)
        eye = 1e-6 * np.eye(5)
        numeric = np.array([(q_value(row + e, x_next) - q_value(row - e, x_next)) / 2e-6 for e in eye])
        np.testing.assert_allclose(np.append(Qx, Qu), numeric, rtol=1e-6, atol=1e-6)


def test_hessians_agree_with_finite_differences() -> None:
    """Gauss-Newton plus dynamics' curvature: f'Vxx f + Vx.f_zz + r_z'r_z, the last two differenced numerically."""
    rng = np.random.default_rng(6)
    f, r = swing_up().problem.dynamics, swing_up().problem.residual
    root = rng.normal(size=(4, 4))
    Vx, Vxx = rng.normal(size=4), root @ root.T

    def slopes(z: Array) -> tuple[Array, Array]:
        """Jacobians of f and r by central differences."""
        plus, minus = ([z + sign * e for e in 1e-5 * np.eye(5)] for sign in (1, -1))
        columns = [
            [
                (g(a[:4], a[4:], PARAMETERS) - g(b[:4], b[4:], PARAMETERS)).full() / 2e-5
                for a, b in zip(plus, minus, strict=True)
            ]
            for g in (f, r)
        ]
        return np.hstack(columns[0]), np.hstack(columns[1])

    for exact in (False, True):
        row = np.append(rng.uniform(-1, 1, 4) * [1.9, 2, 3, 5], -0.4)
        F, J = slopes(row)
        want = F.T @ Vxx @ F + J.T @ J
        if exact:
            step = 1e-4 * np.eye(5)
            want = want + np.array([(Vx @ slopes(row + e)[0] - Vx @ slopes(row - e)[0]) / 2e-4 for e in step])
        _, _, Qxx, Qux, Quu, *_ = expansion(exact, row, Vx, Vxx)
        np.testing.assert_allclose(np.block([[Qxx, Qux.T], [Qux, Quu]]), want, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("second_order", [False, True])
def test_cost_never_rises_over_iterations(second_order: bool) -> None:
    solver = swing_up(second_order)
    start = np.full((34, 1), 0.1)
    costs = [solver.solve(HANGING, PARAMETERS, start, iterations=i).cost for i in range(60)]
    assert (np.diff(costs) <= 0).all()
    assert costs[-1] < 0.6 * costs[0]


def test_solution_is_a_trajectory_with_its_cost() -> None:
    solver = swing_up()
    solution = solver.solve(HANGING, PARAMETERS, np.full((34, 1), 0.1), iterations=200)
    problem, total = solver.problem, 0.0
    for i in range(34):
        x, u = solution.x[i], solution.u[i]
        total += 0.5 * float(ca.sumsqr(problem.residual(x, u, PARAMETERS)))
        np.testing.assert_allclose(problem.dynamics(x, u, PARAMETERS).full().ravel(), solution.x[i + 1], atol=1e-12)
    total += 0.5 * float(ca.sumsqr(problem.terminal_residual(solution.x[-1], PARAMETERS)))
    assert solution.converged and solution.is_finite
    assert solution.cost == pytest.approx(total, rel=1e-12)
    assert np.abs(solution.u).max() <= 1.0


def test_second_order_terms_find_the_same_optimum() -> None:
    start = np.full((34, 1), 0.1)
    plans = [
        swing_up(exact).solve(HANGING, PARAMETERS, start, iterations=250, tolerance=1e-13) for exact in (False, True)
    ]
    polished = swing_up(True).solve(HANGING, PARAMETERS, plans[0].u, iterations=250, tolerance=1e-13)
    assert polished.cost == pytest.approx(plans[0].cost, rel=1e-7)
    np.testing.assert_allclose(polished.u, plans[0].u, atol=1e-3)


@pytest.mark.parametrize("iterations", [1, 7, 200])
def test_virtual_machine_equals_compiled_code(iterations: int) -> None:
    start = np.full((34, 1), 0.1)
    compiled, interpreted = (
        swing_up(compiled=c).solve(HANGING, PARAMETERS, start, iterations=iterations) for c in (True, False)
    )
    assert compiled.iterations == interpreted.iterations
    for name in ("x", "u", "K"):
        np.testing.assert_allclose(getattr(compiled, name), getattr(interpreted, name), rtol=1e-9, atol=1e-9)


def test_two_controls_are_the_same_on_the_virtual_machine() -> None:
    problem = Linear(3, 2, 12, bound=0.3, seed=3)
    one, two = (problem.solver(compiled=c).solve(problem.x0, [1.0]) for c in (True, False))
    np.testing.assert_allclose(one.u, two.u, rtol=1e-9, atol=1e-9)


def test_starting_policy_is_rolled_out_with_its_gains() -> None:
    """Without iterations the plan is the roll-out of u_init + K (x - x_init), clipped."""
    solver, rng = swing_up(), np.random.default_rng(0)
    x_init, u_init, K = rng.normal(size=(35, 4)), rng.normal(size=(34, 1)), rng.normal(size=(34, 1, 4))
    solution = solver.solve(HANGING, PARAMETERS, u_init, x_init, K, iterations=0)
    want = np.clip(u_init + np.einsum("nux,nx->nu", K, solution.x[:-1] - x_init[:-1]), -1, 1)
    np.testing.assert_allclose(solution.u, want, atol=1e-12)
    np.testing.assert_allclose(solution.K, K, atol=0)
    assert solution.iterations == 0 and not solution.converged


@pytest.mark.parametrize("state", [[1e200, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1e4], [np.nan, 0.0, 0.0, 0.0]])
def test_a_diverging_start_is_reported_not_hidden(state: list[float]) -> None:
    solution = swing_up().solve(state, PARAMETERS)
    assert not solution.is_finite and not solution.converged and solution.iterations == 0


@pytest.mark.parametrize("state", [[1e6, 0, 0, 0], [0, 0, 1e6, 30], [0, 1e4, 3, -20], [-3, 0, 0, 0]])
def test_absurd_states_give_finite_bounded_plans(state: list[float]) -> None:
    solution = swing_up().solve(state, PARAMETERS)
    assert solution.is_finite and np.isfinite(solution.K).all()
    assert np.abs(solution.u).max() <= 1.0
    assert solution.cost <= solution.initial_cost


def test_wrong_problems_are_refused() -> None:
    problem = swing_up().problem
    f, r, rN = problem.dynamics, problem.residual, problem.terminal_residual
    with pytest.raises(ValueError, match="horizon must be at least 1"):
        Problem("p", f, r, rN, 0, (-1.0,), (1.0,))
    with pytest.raises(ValueError, match="bounds need 1 numbers each, got 2 and 1"):
        Problem("p", f, r, rN, 5, (-1.0, -1.0), (1.0,))
    with pytest.raises(ValueError, match="below its upper bound"):
        Problem("p", f, r, rN, 5, (1.0,), (1.0,))
    with pytest.raises(ValueError, match=rf"0\.\.{MAX_ITERATIONS}, got 1000"):
        swing_up().solve(HANGING, PARAMETERS, iterations=1000)
