"""The pieces of the generated solver: derivatives, backward pass, box QP, line search, iteration (see `ddp`).

Each builder returns a CasADi function. Small ones are expanded to scalar operations; they are called in chains over the
stages, so that the C code of a stage exists once. Conditionals evaluate one branch only.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import casadi as ca

if TYPE_CHECKING:
    from safeswitch.expert.ddp import Problem

MU_MIN, MU_MAX, MU_FACTOR = 1e-6, 1e10, 1.6  # regularisation schedule of Tassa 2012, section II-F
MU_CONVERGED = 1e-5  # a plan only counts as converged below this regularisation
TRIALS = 11  # line search: alpha = 10^0, 10^-0.3, ... 10^-3
ARMIJO = 1e-4  # smallest accepted ratio of actual to expected decrease
QP_ITERATIONS = 32  # projected Newton, two or more controls
QP_STEPS = (1.0, 0.3, 0.1)


def expanded(name: str, inputs: list[ca.MX], outputs: list[ca.MX]) -> ca.Function:
    """Function of scalar operations where possible (interpolants, for one, cannot be expanded)."""
    function = ca.Function(name, inputs, [ca.densify(output) for output in outputs], {"cse": True})
    try:
        return with_reciprocals(function.expand(name, {"cse": True}))
    except RuntimeError:
        return function


def with_reciprocals(function: ca.Function) -> ca.Function:
    """The same scalar function with a / b as a * (1 / b), each 1 / b computed once.

    Derivatives of a quotient divide by the same denominator over and over, and a division costs several products.
    """
    simplified = ca.GlobalOptions.getSimplificationOnTheFly()
    ca.GlobalOptions.setSimplificationOnTheFly(False)  # it would turn a * (1 / b) back into a / b
    try:
        inputs, outputs = _rebuilt(function)
        return ca.Function(function.name(), inputs, outputs, function.name_in(), function.name_out())
    finally:
        ca.GlobalOptions.setSimplificationOnTheFly(simplified)


def _rebuilt(function: ca.Function) -> tuple[list[ca.SX], list[ca.SX]]:
    """Inputs and outputs of a scalar function, rebuilt operation by operation with shared reciprocals."""
    inputs = [ca.SX.sym(f"i{i}", function.sparsity_in(i)) for i in range(function.n_in())]
    outputs = [ca.SX(function.sparsity_out(i)) for i in range(function.n_out())]
    work: list[ca.SX] = [ca.SX(0)] * function.sz_w()
    reciprocals: dict[int, ca.SX] = {}
    for step in range(function.n_instructions()):
        operation, source = function.instruction_id(step), function.instruction_input(step)
        target = function.instruction_output(step)
        if operation == ca.OP_CONST:
            work[target[0]] = ca.SX(function.instruction_constant(step))
        elif operation == ca.OP_INPUT:
            work[target[0]] = inputs[source[0]].nz[source[1]]
        elif operation == ca.OP_OUTPUT:
            outputs[target[0]].nz[target[1]] = work[source[0]]
        elif operation == ca.OP_DIV:
            below = work[source[1]]
            work[target[0]] = work[source[0]] * reciprocals.setdefault(below.element_hash(), 1 / below)
        elif len(source) == 2:
            work[target[0]] = ca.SX.binary(operation, work[source[0]], work[source[1]])
        else:
            work[target[0]] = ca.SX.unary(operation, work[source[0]])
    return inputs, outputs


def bounded_while(body: ca.Function, most: int) -> ca.Function:
    """Repeat ``carry = body(carry, constants)`` while the first element of the first carry is 1, at most `most` times.

    CasADi has no loop node. Doubling gives one: W_0 = if running: body; W_j+1 = if running: W_j(W_j(.)). An early exit
    skips what is left in log2(most) tests, and `body` appears once in the C code. `most` is rounded up to a power of 2.
    """
    carries = body.n_out()
    arguments = [ca.MX.sym(f"a{i}", body.sparsity_in(i)) for i in range(body.n_in())]
    skip = ca.Function(f"{body.name()}_skip", arguments, arguments[:carries])

    def if_running(name: str, function: ca.Function) -> ca.Function:
        guarded = ca.Function.if_else(f"{name}_if", function, skip)
        return ca.Function(name, arguments, guarded.call([arguments[0][0], *arguments]))

    loop = if_running(f"{body.name()}_1", body)
    for level in range(1, (most - 1).bit_length() + 1):
        once = loop.call(arguments)
        twice = loop.call([*once, *arguments[carries:]])
        pair = ca.Function(f"{body.name()}_pair{level}", arguments, twice)
        loop = if_running(f"{body.name()}_{2**level}", pair)
    return loop


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


def symmetric(matrix: ca.MX) -> ca.MX:
    """The symmetric matrix with the upper triangle of `matrix`: half the work, and no drift."""
    return ca.triu2symm(ca.triu(matrix))


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
