"""Rows that are accelerations by a common inertia, as the torques that they balance.

Where ``f = W b`` with a regular matrix W(α) of mobilities (1/(kg m²)), f is zero exactly where b
is; of b, the torques, intervals are far tighter. W is read from the equations themselves, as their
slope in constant torques on the axes. Its entries are then found among the intermediate results of
the rows and replaced by symbols; that the rows are W times one vector is checked on the expressions
before it is used, and W is checked to be regular over the box by whoever relies on it.
"""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca


def torques(
    rows: Sequence[ca.SX], moments: Sequence[ca.SX], symbols: ca.SX
) -> tuple[list[ca.SX], ca.SX | None]:
    """Two rows of coupled accelerations as torques, and W (2, 2); unchanged and None otherwise.

    Parameters
    ----------
    rows : (n,) sequence of scalars
    moments : sequence of symbols
        Torques on the axes.
    symbols : (m, 1)
        All symbols of the rows.
    """
    if len(moments) != 2 or len(rows) < 2:
        return list(rows), None
    torque = ca.vertcat(*moments)
    mobility = ca.cse(ca.jacobian(ca.vertcat(*rows), torque))
    pushed = [i for i in range(len(rows)) if mobility[i, :].nnz() == 2]
    if len(pushed) != 2 or ca.depends_on(mobility, torque):
        return list(rows), None
    square = ca.densify(mobility[pushed, :])
    balance = _balance([rows[i] for i in pushed], square, symbols)
    if balance is None:
        return list(rows), None
    after = [balance[pushed.index(i)] if i in pushed else row for i, row in enumerate(rows)]
    return after, square


def _balance(rows: list[ca.SX], square: ca.SX, symbols: ca.SX) -> list[ca.SX] | None:
    """b of ``rows = square @ b``, or None where the rows are not seen to be that."""
    count = len(rows)
    whole = ca.cse(ca.vertcat(*rows, ca.vec(square)))
    program = ca.Function("program", [symbols], [whole])
    made = _makers(program)
    if any(count + k not in made for k in range(4)):
        return None
    places = [made[count + k] for k in range(4)]
    entries = {place: ca.SX.sym(f"mobility_{place}") for place, _ in places}
    replaced = _run(program, symbols, entries)[:count]
    own = ca.vertcat(*entries.values())
    matrix = [[sign * entries[place] for place, sign in places[i::2]] for i in range(2)]
    found = []
    for place, sign in places[::2]:
        share = sign * ca.jacobian(replaced[0], entries[place])
        if ca.depends_on(share, own):
            return None
        found.append(share)
    # rows − W b must vanish: linear in the entries, with these factors, and nothing else.
    for i in range(2):
        difference = replaced[i] - matrix[i][0] * found[0] - matrix[i][1] * found[1]
        slopes = ca.cse(ca.jacobian(difference, own))
        at_zero = ca.cse(ca.substitute(replaced[i], own, ca.SX.zeros(own.numel())))
        if not _vanishes(slopes) or not _vanishes(at_zero):
            return None
    return found


def _vanishes(expression: ca.SX) -> bool:
    return all(e.is_zero() for e in ca.vertsplit(ca.vec(ca.densify(expression))))


def _makers(program: ca.Function) -> dict[int, tuple[int, int]]:
    """Which instruction makes each output, up to a sign."""
    writer: dict[int, tuple[int, int]] = {}
    made: dict[int, tuple[int, int]] = {}
    rows = program.sparsity_out(0).row()
    for k in range(program.n_instructions()):
        operation = program.instruction_id(k)
        into, given = program.instruction_output(k), program.instruction_input(k)
        if operation == ca.OP_OUTPUT:
            made[rows[into[1]]] = writer[given[0]]
        elif operation == ca.OP_NEG:
            place, sign = writer[given[0]]
            writer[into[0]] = place, -sign
        else:
            writer[into[0]] = k, 1
    return made


def _run(program: ca.Function, symbols: ca.SX, instead: dict[int, ca.SX]) -> list[ca.SX]:
    """The outputs, with the results of some instructions replaced."""
    work: dict[int, ca.SX] = {}
    outputs = [ca.SX(0)] * program.size1_out(0)
    rows = program.sparsity_out(0).row()
    for k in range(program.n_instructions()):
        operation = program.instruction_id(k)
        into, given = program.instruction_output(k), program.instruction_input(k)
        if operation == ca.OP_OUTPUT:
            outputs[rows[into[1]]] = work[given[0]]
        elif k in instead:
            work[into[0]] = instead[k]
        elif operation == ca.OP_CONST:
            work[into[0]] = ca.SX(program.instruction_constant(k))
        elif operation == ca.OP_INPUT:
            work[into[0]] = symbols[given[1]]
        elif len(given) == 1:
            work[into[0]] = ca.SX.unary(operation, work[given[0]])
        else:
            work[into[0]] = ca.SX.binary(operation, work[given[0]], work[given[1]])
    return outputs
