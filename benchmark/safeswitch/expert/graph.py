"""CasADi expressions that make good C code: scalar expansion, shared reciprocals, and a loop with an early exit."""

from __future__ import annotations

import casadi as ca


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


def symmetric(matrix: ca.MX) -> ca.MX:
    """The symmetric matrix with the upper triangle of `matrix`: half the work, and no drift."""
    return ca.triu2symm(ca.triu(matrix))
