"""Small box-constrained quadratic programs inside the backward pass.

Tassa, Mansard & Todorov (2014), section III, https://doi.org/10.1109/ICRA.2014.6907001, after Bertsekas (1982).
"""

from __future__ import annotations

import casadi as ca

from safeswitch.expert.graph import bounded_while, expanded

QP_ITERATIONS = 32  # projected Newton, two or more controls
QP_STEPS = (1.0, 0.3, 0.1)


def solve_spd(H: ca.MX, R: ca.MX) -> tuple[ca.MX, ca.MX]:
    """(H^-1 R, smallest pivot) by an unrolled LDL^T factorisation; meaningful where the smallest pivot is positive."""
    n = H.shape[0]
    L = [[ca.MX(1.0 if i == j else 0.0) for j in range(n)] for i in range(n)]
    D: list[ca.MX] = []
    for j in range(n):
        D.append(H[j, j] - sum((L[j][m] ** 2 * D[m] for m in range(j)), ca.MX(0)))
        for i in range(j + 1, n):
            L[i][j] = (H[i, j] - sum((L[i][m] * L[j][m] * D[m] for m in range(j)), ca.MX(0))) / D[j]
    rows = [R[i, :] for i in range(n)]
    for i in range(n):
        for m in range(i):
            rows[i] = rows[i] - L[i][m] * rows[m]
    rows = [rows[i] / D[i] for i in range(n)]
    for i in reversed(range(n)):
        for m in range(i + 1, n):
            rows[i] = rows[i] - L[m][i] * rows[m]
    smallest = D[0]
    for pivot in D[1:]:
        smallest = ca.fmin(smallest, pivot)
    return ca.vertcat(*rows), smallest


def box_qp_function(name: str, nu: int) -> ca.Function:
    """(H, q, lo, hi) -> (k, free): minimiser of 0.5 k'Hk + q'k within [lo, hi], and 1 where k is not held by a bound.

    One control: exact. More: projected Newton (Tassa 2014, section III; Bertsekas 1982), at most QP_ITERATIONS steps.
    """
    H, q = ca.MX.sym("H", nu, nu), ca.MX.sym("q", nu)
    lo, hi = ca.MX.sym("lo", nu), ca.MX.sym("hi", nu)
    if nu == 1:
        newton = -q / H
        free = ca.logic_and(newton > lo, newton < hi)
        return expanded(name, [H, q, lo, hi], [ca.fmin(ca.fmax(newton, lo), hi), free])

    state, k = ca.MX.sym("state", 2), ca.MX.sym("k", nu)  # state: running, tolerance of the gradient
    free = box_free(H, q, lo, hi, k)
    mask = ca.diag(free)
    step, _ = solve_spd(mask @ H @ mask + ca.diag(1 - free), -free * (q + H @ k))
    best, value = k, ca.dot(q + 0.5 * H @ k, k)
    for alpha in QP_STEPS:
        trial = ca.fmin(ca.fmax(k + alpha * step, lo), hi)
        trial_value = ca.dot(q + 0.5 * H @ trial, trial)
        best, value = ca.if_else(trial_value < value, trial, best), ca.fmin(value, trial_value)
    # A clipped Newton step need not descend. One sweep of exact coordinate minimisation always does, and finds the
    # active bounds; with them Newton's step is exact.
    for i in range(nu):
        moved = best[i] - (q[i] + H[i, :] @ best) / H[i, i]
        best = ca.vertcat(best[:i], ca.fmin(ca.fmax(moved, lo[i]), hi[i]), best[i + 1 :])
    running = ca.mmax(ca.fabs(box_free(H, q, lo, hi, best) * (q + H @ best))) > state[1]
    body = expanded(f"{name}_newton", [state, k, H, q, lo, hi], [ca.vertcat(running, state[1]), best])
    loop = bounded_while(body, QP_ITERATIONS)

    finish = expanded(f"{name}_free", [H, q, lo, hi, k], [box_free(H, q, lo, hi, k)])
    start = ca.vertcat(1, 1e-11 * (1 + ca.mmax(ca.fabs(q))))
    _, solution = loop(start, ca.fmin(ca.fmax(ca.MX.zeros(nu), lo), hi), H, q, lo, hi)
    return ca.Function(name, [H, q, lo, hi], [solution, finish(H, q, lo, hi, solution)])


def box_free(H: ca.MX, q: ca.MX, lo: ca.MX, hi: ca.MX, k: ca.MX) -> ca.MX:
    """1 where k is not held by a bound, 0 where the gradient pushes it into one."""
    gradient = q + H @ k
    held = ca.logic_or(ca.logic_and(k <= lo, gradient > 0), ca.logic_and(k >= hi, gradient < 0))
    return 1 - held
