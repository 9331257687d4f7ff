"""The pieces of the generated solver: roll-out, derivatives, backward pass, line search, iteration (see `ddp`).

Each builder returns a CasADi function. Small ones are expanded to scalar operations; they are called in chains over the
stages, so that the C code of a stage exists once. Conditionals evaluate one branch only.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import casadi as ca

from safeswitch.expert.box_qp import box_qp_function, solve_spd
from safeswitch.expert.graph import bounded_while, expanded, symmetric

if TYPE_CHECKING:
    from safeswitch.expert.ddp import Problem

MU_MIN, MU_MAX, MU_FACTOR = 1e-6, 1e10, 1.6  # regularisation schedule of Tassa 2012, section II-F
MU_CONVERGED = 1e-5  # a plan only counts as converged below this regularisation
TRIALS = 11  # line search: alpha = 10^0, 10^-0.3, ... 10^-3
ARMIJO = 1e-4  # smallest accepted ratio of actual to expected decrease


def rollout_function(problem: Problem) -> ca.Function:
    """(x0, plan, k, gains, alpha, p) -> (plan, cost): u = clip(u_plan + alpha k + K (x - x_plan))."""
    nx, nu, horizon = problem.nx, problem.nu, problem.horizon
    x, cost, row = ca.MX.sym("x", nx), ca.MX.sym("cost"), ca.MX.sym("row", nx + nu)
    k, gain, alpha, p = ca.MX.sym("k", nu), ca.MX.sym("K", nu * nx), ca.MX.sym("alpha"), ca.MX.sym("p", problem.np)
    u = row[nx:] + alpha * k + ca.reshape(gain, nu, nx) @ (x - row[:nx])
    u = ca.fmin(ca.fmax(u, ca.DM(problem.u_lo)), ca.DM(problem.u_hi))
    stage = expanded(
        f"{problem.name}_rollout_stage",
        [x, cost, row, k, gain, alpha, p],
        [problem.dynamics(x, u, p), cost + 0.5 * ca.sumsqr(problem.residual(x, u, p)), ca.vertcat(x, u)],
    )
    terminal = expanded(
        f"{problem.name}_rollout_end",
        [x, cost, p],
        [cost + 0.5 * ca.sumsqr(problem.terminal_residual(x, p)), ca.vertcat(x, ca.MX.zeros(nu))],
    )

    x0, plan = ca.MX.sym("x0", nx), ca.MX.sym("plan", nx + nu, horizon + 1)
    ks, gains = ca.MX.sym("ks", nu, horizon), ca.MX.sym("gains", nu * nx, horizon)
    rows_in, ks_in, gains_in = ca.horzsplit(plan), ca.horzsplit(ks), ca.horzsplit(gains)
    state, total, rows = x0, ca.MX(0), []
    for i in range(horizon):
        state, total, out = stage(state, total, rows_in[i], ks_in[i], gains_in[i], alpha, p)
        rows.append(out)
    total, out = terminal(state, total, p)
    name = f"{problem.name}_rollout"
    return ca.Function(name, [x0, plan, ks, gains, alpha, p], [ca.horzcat(*rows, out), total])


def expansion_function(problem: Problem) -> ca.Function:
    """(Vx, Vxx, row, p, mu) -> (Qx, Qu, Qxx, Qux, Quu, Qux_mu, Quu_mu, lo - u, hi - u) of one stage.

    V is the value of the next stage. mu penalises deviations of the next state (Tassa 2012, equations 10a, 10b).
    """
    nx, nu = problem.nx, problem.nu
    row, p, mu = ca.MX.sym("row", nx + nu), ca.MX.sym("p", problem.np), ca.MX.sym("mu")
    Vx, Vxx = ca.MX.sym("Vx", nx), ca.MX.sym("Vxx", nx, nx)
    x, u = ca.MX.sym("x", nx), ca.MX.sym("u", nu)
    f, r = problem.dynamics(x, u, p), problem.residual(x, u, p)
    A, B, rx, ru = ca.jacobian(f, x), ca.jacobian(f, u), ca.jacobian(r, x), ca.jacobian(r, u)
    Qx, Qu = rx.T @ r + A.T @ Vx, ru.T @ r + B.T @ Vx
    Qxx, Qux, Quu = (rx.T @ rx + A.T @ Vxx @ A, ru.T @ rx + B.T @ Vxx @ A, ru.T @ ru + B.T @ Vxx @ B)
    if problem.second_order:
        slope_x, slope_u = A.T @ Vx, B.T @ Vx
        Qxx, Qux, Quu = Qxx + ca.jacobian(slope_x, x), Qux + ca.jacobian(slope_u, x), Quu + ca.jacobian(slope_u, u)
    outputs = [Qx, Qu, symmetric(Qxx), Qux, symmetric(Quu), Qux + mu * (B.T @ A), Quu + mu * (B.T @ B)]
    outputs += [ca.DM(problem.u_lo) - u, ca.DM(problem.u_hi) - u]
    inner = ca.Function("expansion", [Vx, Vxx, x, u, p, mu], outputs)
    outputs = inner(Vx, symmetric(Vxx), row[:nx], row[nx:], p, mu)
    return expanded(f"{problem.name}_expansion", [Vx, Vxx, row, p, mu], list(outputs))


def gains_function(problem: Problem) -> ca.Function:
    """(k, free, Qx, Qu, Qxx, Qux, Quu, Qux_mu, Quu_mu, sums) -> (carry, vec(K)): gains and the value of this stage.

    Rows of K are zero where a bound holds the control (Tassa 2014, section III-C). The carry is
    [Vx, vec(Vxx), sum k'Qu, sum 0.5 k'Quu k, failed].
    """
    nx, nu = problem.nx, problem.nu
    k, free, Qx, Qu = ca.MX.sym("k", nu), ca.MX.sym("free", nu), ca.MX.sym("Qx", nx), ca.MX.sym("Qu", nu)
    Qxx, Qux, Quu = ca.MX.sym("Qxx", nx, nx), ca.MX.sym("Qux", nu, nx), ca.MX.sym("Quu", nu, nu)
    Qux_mu, Quu_mu, sums = ca.MX.sym("Qux_mu", nu, nx), ca.MX.sym("Quu_mu", nu, nu), ca.MX.sym("sums", 3)
    mask = ca.diag(free)
    inverse, smallest = solve_spd(mask @ Quu_mu @ mask + ca.diag(1 - free), mask @ Qux_mu)
    _, pivot = solve_spd(Quu_mu, Qux_mu)
    K = -inverse
    Vx = Qx + K.T @ (Quu @ k + Qu) + Qux.T @ k
    Vxx = Qxx + K.T @ Quu @ K + K.T @ Qux + Qux.T @ K
    failed = ca.logic_not(pivot > 0)  # true for a NaN too
    linear, quadratic = ca.dot(k, Qu), 0.5 * ca.dot(k, Quu @ k)
    carry = ca.vertcat(Vx, ca.vec(symmetric(Vxx)), sums + ca.vertcat(linear, quadratic, failed))
    inputs = [k, free, Qx, Qu, Qxx, Qux, Quu, Qux_mu, Quu_mu, sums]
    return expanded(f"{problem.name}_gains", inputs, [carry, ca.vec(K)])


def backward_function(problem: Problem) -> ca.Function:
    """(plan, p, mu) -> (k (nu, N), gains (nu * nx, N), sums (3,)): one backward pass along the plan."""
    nx, nu, horizon = problem.nx, problem.nu, problem.horizon
    size = nx + nx * nx
    carry, row = ca.MX.sym("carry", size + 3), ca.MX.sym("row", nx + nu)
    p, mu = ca.MX.sym("p", problem.np), ca.MX.sym("mu")

    Vxx = ca.reshape(carry[nx:size], nx, nx)
    Q = expansion_function(problem)(carry[:nx], Vxx, row, p, mu)
    k, free = box_qp_function(f"{problem.name}_box_qp", nu)(Q[6], Q[1], Q[7], Q[8])
    carry_out, gain = gains_function(problem)(k, free, *Q[:7], carry[size:])
    name, inputs, outputs = f"{problem.name}_backward_stage", [carry, row, p, mu], [carry_out, k, gain]
    # One control has a closed form and is expanded; the QP of several is a loop that must stay one.
    stage = expanded(name, inputs, outputs) if nu == 1 else ca.Function(name, inputs, outputs)

    x = ca.MX.sym("x", nx)
    r = problem.terminal_residual(x, p)
    rx = ca.jacobian(r, x)
    value = ca.Function("end", [x, p], [ca.vertcat(rx.T @ r, ca.vec(rx.T @ rx), ca.MX.zeros(3))])
    terminal = expanded(f"{problem.name}_backward_end", [row, p], [value(row[:nx], p)])

    plan = ca.MX.sym("plan", nx + nu, horizon + 1)
    rows = ca.horzsplit(plan)
    value_carry = terminal(rows[horizon], p)
    ks: list[ca.MX] = [ca.MX()] * horizon
    gains: list[ca.MX] = [ca.MX()] * horizon
    for i in reversed(range(horizon)):
        value_carry, ks[i], gains[i] = stage(value_carry, rows[i], p, mu)
    outputs = [ca.horzcat(*ks), ca.horzcat(*gains), value_carry[size:]]
    return ca.Function(f"{problem.name}_backward", [plan, p, mu], outputs)


def line_search_function(problem: Problem, rollout: ca.Function) -> ca.Function:
    """(search, plan, old plan, x0, k, gains, p, target) -> (search, plan): backtracking until the cost falls enough.

    search = [running, alpha, cost, accepted], target = [old cost, sum k'Qu, sum 0.5 k'Quu k]. After TRIALS failures a
    last roll-out with alpha = 0 gives the old plan back.
    """
    nx, nu, horizon = problem.nx, problem.nu, problem.horizon
    search, target, cost = ca.MX.sym("search", 4), ca.MX.sym("target", 3), ca.MX.sym("cost")
    alpha = search[1]
    expected = -alpha * (target[1] + alpha * target[2])
    accepted = ca.logic_and(target[0] - cost > ARMIJO * expected, alpha > 0)
    running = ca.logic_and(ca.logic_not(accepted), alpha > 0)
    shorter = ca.if_else(alpha > 10 ** (-0.3 * (TRIALS - 1.5)), alpha * 10**-0.3, 0.0)
    kept = ca.if_else(accepted, cost, target[0])
    verdict = ca.vertcat(running, ca.if_else(accepted, alpha, shorter), kept, accepted)
    judge = expanded(f"{problem.name}_judge", [search, target, cost], [verdict])

    shape = (nx + nu, horizon + 1)
    candidate, plan = ca.MX.sym("candidate", *shape), ca.MX.sym("plan", *shape)
    ks, gains, p = ca.MX.sym("ks", nu, horizon), ca.MX.sym("gains", nu * nx, horizon), ca.MX.sym("p", problem.np)
    rolled, rolled_cost = rollout(plan[:nx, 0], plan, ks, gains, search[1], p)
    inputs = [search, candidate, plan, ks, gains, p, target]
    body = ca.Function(f"{problem.name}_trial", inputs, [judge(search, target, rolled_cost), rolled])
    return bounded_while(body, TRIALS + 1)


def iteration_function(problem: Problem, rollout: ca.Function) -> ca.Function:
    """(state, plan, gains, p, limits) -> (state, plan, gains): backward pass, line search, regularisation.

    state = [running, cost, mu, delta, iterations, converged], limits = [most iterations, tolerance].
    """
    nx, nu, horizon = problem.nx, problem.nu, problem.horizon
    state, limits, p = ca.MX.sym("state", 6), ca.MX.sym("limits", 2), ca.MX.sym("p", problem.np)
    plan, gains = ca.MX.sym("plan", nx + nu, horizon + 1), ca.MX.sym("gains", nu * nx, horizon)

    before, after = schedule_functions(problem.name)
    ks, new_gains, sums = backward_function(problem)(plan, p, state[2])
    search, flags = before(state, sums, limits)
    target = ca.vertcat(state[1], sums[:2])
    search, new_plan = line_search_function(problem, rollout)(search, plan, plan, ks, new_gains, p, target)
    # A failed backward pass may have left infinities in its gains: keep the previous ones.
    other = ca.MX.sym("other", nu * nx, horizon)
    keep = ca.Function("keep", [gains, other], [gains])
    take = ca.Function("take", [gains, other], [other])
    gains_out = ca.Function.if_else(f"{problem.name}_choose", keep, take)(flags[0], gains, new_gains)
    inputs, outputs = [state, plan, gains, p, limits], [after(state, search, flags, limits), new_plan, gains_out]
    return ca.Function(f"{problem.name}_iteration", inputs, outputs)


def schedule_functions(name: str) -> tuple[ca.Function, ca.Function]:
    """The decisions around a line search, on a handful of scalars (Tassa 2012, section II-F).

    before: (state, sums, limits) -> (search, flags = [backward pass failed, converged]);
    after: (state, search, flags, limits) -> state.
    """
    state, sums, limits = ca.MX.sym("state", 6), ca.MX.sym("sums", 3), ca.MX.sym("limits", 2)
    cost, mu, delta = state[1], state[2], state[3]
    scale = limits[1] * (1 + cost)
    decrease = -(sums[0] + sums[1])
    failed = ca.logic_not(ca.logic_and(sums[2] == 0, decrease >= 0))  # true for a NaN too
    failed = ca.if_else(ca.logic_and(sums[2] == 0, ca.fabs(decrease) <= 1e-14 * (1 + cost)), 0, failed)
    converged = ca.logic_and(ca.logic_not(failed), ca.logic_and(decrease <= scale, mu <= MU_CONVERGED))
    searching = ca.logic_not(ca.logic_or(failed, converged))
    search, flags = ca.vertcat(searching, 1, cost, 0), ca.vertcat(failed, converged)
    before = expanded(f"{name}_before", [state, sums, limits], [search, flags])

    search, flags = ca.MX.sym("search", 4), ca.MX.sym("flags", 2)
    accepted, small = search[3], cost - search[2] <= scale
    full_step = search[1] == 1
    done = ca.logic_or(flags[1], accepted * full_step * ca.logic_and(small, mu <= MU_CONVERGED))
    up = ca.fmax(MU_FACTOR, delta * MU_FACTOR)
    down = ca.fmin(1 / MU_FACTOR, delta / MU_FACTOR)
    mu_down = ca.if_else(mu * down >= MU_MIN, mu * down, 0)
    new_mu = ca.if_else(accepted, mu_down, ca.fmax(MU_MIN, mu * up))
    count = state[4] + 1
    running = ca.logic_and(ca.logic_not(done), ca.logic_and(count < limits[0], new_mu <= MU_MAX))
    outcome = ca.vertcat(running, search[2], ca.if_else(done, mu, new_mu), ca.if_else(accepted, down, up), count, done)
    return before, expanded(f"{name}_after", [state, search, flags, limits], [outcome])
