"""The equations of rest of a model as a square system, in blocks that are solved one by one.

Three identities take out of them what can be taken out exactly: states that follow linearly from
others (:func:`reduce`), inertias that two accelerations have in common (:func:`torques`), and
factors that are nowhere zero (:func:`without_factors`). What is left are a few equations
``g(z, v) = 0`` in unknowns z, given the inputs and constant torques v. A matching of equations to
unknowns tells what the structure allows:

- A state that no equation determines is *free*: a yaw that nothing pulls back rests anywhere.
- An equation that no state can meet asks for an input instead, which is *released*: without a
  cable the tail rotor has to balance yaw exactly, so that u_h follows from u_v.
- An angle can be *held*: it is given, and an input is released for it.

The strongly connected components of the matched system are blocks in an order in which each needs
only what was solved before (Duff & Reid 1978, ACM Trans. Math. Softw. 4; Dulmage & Mendelsohn).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from trms_cli.core.arrays import BoolArray
from trms_cli.core.errors import ModelError
from trms_cli.models.model import Model, Signal, index_of, names
from trms_cli.models.rest import rest_equations, static_motor_command
from trms_cli.stability.local.linear import Linear


@dataclass(frozen=True)
class EquationBlock:
    """Equations that are solved together, after the blocks before."""

    rows: tuple[int, ...]  #: Positions in g and in z, equally many
    unknowns: tuple[int, ...]  #: Positions in g and in z, equally many


@dataclass(frozen=True)
class RestSystem:
    """``g(z, v) = 0``."""

    model: Model
    unknowns: tuple[Signal, ...]  #: z: states and released inputs
    #: v: all inputs, then all disturbances; what is released or without effect is not read
    knowns: tuple[Signal, ...]
    blocks: tuple[EquationBlock, ...]  #: In the order in which they are solved
    free: tuple[str, ...]  #: States that nothing determines; they stay as in :meth:`Model.rest`
    released: tuple[str, ...]  #: Inputs among the unknowns
    idle: tuple[str, ...]  #: Inputs that rest does not depend on
    held_angles: Mapping[str, float]  #: Angles that are given, rad
    residual: ca.Function  #: ``(z, v, p) → g``, rates or torques
    #: ``(z, v, p) → x, u, reached``: the whole state, all commands, what reaches the motors
    point: ca.Function
    #: ``(z, v, p)`` → what the rows were divided by, (k, 1): g stands for f where none is zero
    nonzero: ca.Function

    @property
    def n(self) -> int:
        return len(self.unknowns)

    @cached_property
    def linear(self) -> Linear:
        """Slopes of the model."""
        return Linear(self.model)

    def known_index(self, name: str) -> int:
        return names(self.knowns).index(name)


def rest_system(
    model: Model,
    varied: Collection[str] = (),
    held_angles: Mapping[str, float] | None = None,
    torques_too: bool = False,
) -> RestSystem:
    """The equations of rest of a model, its input path with them, but no impulses and sensors.

    ``varied``: inputs that are to stay given. ``held_angles``: angles that are given (rad), each in
    exchange for an input. ``torques_too``: whether constant torques act; without them equations
    fall apart into smaller blocks. Raises ModelError if no inputs are left to be released for what
    has to be held.
    """
    held_angles = dict(held_angles or {})
    s, u, p, w = model.symbols()
    equations = rest_equations(model)
    s = ca.SX.sym("s", len(equations.unknowns))
    own = [model.states[i] for i in equations.unknowns]
    residual = equations.residual(s, static_motor_command(model, u, p), p, w)
    for name, value in held_angles.items():
        residual = ca.substitute(residual, s[names(own).index(name)], ca.SX(value))
    # What an effect remembers (a cable's z) stays too: it is free, not the angle that it acts on.
    angles = {axis.angle for axis in model.axes.values()} | set(model.controlled)
    lasting = [i for i, s_i in enumerate(own) if s_i.name in angles or "." in s_i.name]
    reduced, nonzero = _reduced(model, residual, s, (u, p, w), lasting, torques_too)
    resting = model.rest()[list(equations.unknowns)]

    rows = ca.vertcat(*reduced.rows) if reduced.rows else ca.SX.zeros(0)
    columns = [i for i in reduced.positions if own[i].name not in held_angles]
    symbols = ca.vertcat(*(s[i] for i in columns), u)
    candidates = [own[i] for i in columns] + list(model.inputs)
    pattern = _pattern(rows, symbols)
    worth = [_worth(signal.name, model, varied) for signal in candidates]
    matched = _matched(pattern, worth)
    missing = rows.numel() - len(matched)
    if missing:
        fixed = ", ".join([*varied, *held_angles])
        raise ModelError(
            f"rest of model {model.name!r} asks for {missing} more "
            f"{'input' if missing == 1 else 'inputs'} than may follow from the others"
            + (f" with {fixed} given" if fixed else ""),
            where="study.at" if held_angles else "model",
            remedy="hold fewer angles" if held_angles else "vary fewer inputs",
        )
    unknown_columns = [matched[row] for row in range(rows.numel())]
    z = ca.SX.sym("z", len(unknown_columns))
    v = ca.SX.sym("v", model.n_u + model.n_w)
    free = [i for k, i in enumerate(columns) if k not in unknown_columns]

    # What is unknown becomes z, the inputs that stay given v, what is free rests where it rests.
    inputs, unknowns = names(model.inputs), tuple(candidates[column] for column in unknown_columns)
    released = tuple(signal.name for signal in unknowns if signal.name in inputs)
    placed = [(s[i], float(resting[i])) for i in free]
    placed += [(s[names(own).index(name)], float(value)) for name, value in held_angles.items()]
    placed += [(symbols[column], z[k]) for k, column in enumerate(unknown_columns)]
    placed += [(u[i], v[i]) for i, name in enumerate(inputs) if name not in released]
    placed += [(w[i], v[model.n_u + i]) for i in range(model.n_w)]
    old, new = (ca.vertcat(*side) for side in zip(*placed, strict=True))
    everything = ca.cse(ca.substitute(ca.vertcat(rows, reduced.state, u, *nonzero), old, new))
    ends = np.cumsum([0, len(unknown_columns), len(own), model.n_u, len(nonzero)]).tolist()
    g, state, commands, factors = ca.vertsplit(everything, ends)
    reached = static_motor_command(model, commands, p)
    whole = equations.state(state, reached)
    return RestSystem(
        model=model,
        unknowns=unknowns,
        knowns=(*model.inputs, *model.disturbances),
        blocks=_blocks(_pattern(g, z)),
        free=tuple(own[i].name for i in free),
        released=released,
        idle=tuple(
            name
            for i, name in enumerate(inputs)
            if name not in released and not ca.depends_on(ca.vertcat(g, state), v[i])
        ),
        held_angles=held_angles,
        residual=ca.Function("rest", [z, v, p], [g]),
        point=ca.Function("point", [z, v, p], [whole, commands, reached]),
        nonzero=ca.Function("nonzero", [z, v, p], [factors]),
    )


def _reduced(
    model: Model,
    residual: ca.SX,
    s: ca.SX,
    others: tuple[ca.SX, ca.SX, ca.SX],
    lasting: list[int],
    torques_too: bool,
) -> tuple[ReducedEquations, list[ca.SX]]:
    """The equations that are left, and what must not be zero for them."""
    u, p, w = others
    variables, everything = ca.vertcat(s, u, w), ca.vertcat(s, u, p, w)
    values = ca.DM(model.parameters.values)
    reduced = reduce(residual, s, ca.vertcat(u, w), p, values, lasting)
    places = [index_of(model.disturbances, a.moment, "a torque") for a in model.axes.values()]
    balances, mobility = torques(reduced.rows, [w[i] for i in places], everything)
    nonzero: list[ca.SX] = []
    if mobility is not None:
        nonzero.append(ca.det(mobility))
        reduced = replace(reduced, rows=balances)
    if not torques_too:
        whole = residual if mobility is None else ca.vertcat(*reduced.rows, reduced.state)
        quiet = ca.cse(ca.substitute(whole, w, ca.SX.zeros(w.numel())))
        if mobility is None:
            rows, nonzero = _stripped(ca.vertsplit(quiet), variables)
            reduced = reduce(ca.vertcat(*rows), s, u, p, values, lasting)
        else:
            count = len(reduced.rows)
            rows = ca.vertsplit(quiet[:count]) if count else []
            reduced = replace(reduced, rows=rows, state=quiet[count:])
    rows, factors = _stripped(reduced.rows, variables)
    return replace(reduced, rows=rows), [*nonzero, *factors]


def _stripped(rows: list[ca.SX], variables: ca.SX) -> tuple[list[ca.SX], list[ca.SX]]:
    parts = [without_factors(row, variables) for row in rows]
    return [row for row, _ in parts], [factor for _, factors in parts for factor in factors]


def _worth(name: str, model: Model, varied: Collection[str]) -> float:
    """How gladly an equation is matched to an unknown: as many states as can be, then inputs."""
    if name in varied:
        return 0.0
    if name in names(model.inputs):
        return 1.0
    # The states of an effect (what a cable remembers) are free rather than the model's own.
    return 100.0 if "." in name else 1e4


def _pattern(rows: ca.SX, symbols: ca.SX) -> BoolArray:
    if rows.numel() == 0:
        return np.zeros((0, symbols.numel()), dtype=bool)
    slopes = ca.jacobian(rows, symbols)
    return np.array(ca.DM(slopes.sparsity(), 1).full(), dtype=bool)


def _matched(pattern: BoolArray, worth: list[float]) -> dict[int, int]:
    """Column by row: a matching of the greatest worth."""
    gain = np.where(pattern, np.asarray(worth)[None, :], 0.0)
    rows, columns = linear_sum_assignment(gain, maximize=True)
    return {
        int(r): int(c) for r, c in zip(rows, columns, strict=True) if pattern[r, c] and worth[c] > 0
    }


def _blocks(pattern: BoolArray) -> tuple[EquationBlock, ...]:
    """Strongly connected components, each after those that it needs; row i belongs to unknown i."""
    n = len(pattern)
    if n == 0:
        return ()
    count, label = connected_components(csr_array(pattern), directed=True, connection="strong")
    members = [tuple(np.flatnonzero(label == k).tolist()) for k in range(count)]
    ordered_labels: set[int] = set()
    ordered: list[EquationBlock] = []
    while len(ordered) < count:
        for k, own in enumerate(members):
            prerequisites = {int(label[j]) for i in own for j in np.flatnonzero(pattern[i])} - {k}
            if k not in ordered_labels and prerequisites <= ordered_labels:
                ordered_labels.add(k)
                ordered.append(EquationBlock(own, own))
                break
    return tuple(ordered)


@dataclass(frozen=True)
class ReducedEquations:
    """Equations after elimination."""

    rows: list[ca.SX]  #: What must be zero, one expression each
    positions: list[int]  #: Positions of the symbols that are left as unknowns
    state: ca.SX  #: All symbols by those that are left, (n, 1)


def reduce(
    f: ca.SX, x: ca.SX, others: ca.SX, p: ca.SX, values: ca.DM, keep: Collection[int]
) -> ReducedEquations:
    """Solve linear equations of ``f(x, others, p) = 0`` for symbols of x, one after the other.

    A factor must not depend on x or the others, nor be zero at the values of p; positions in x to
    ``keep`` stay unknowns.
    """
    rows = ca.vertsplit(ca.cse(f))
    state, candidates = x, [j for j in range(x.numel()) if j not in keep]
    variables = ca.vertcat(x, others)
    while True:
        linear = _linear(rows, x, variables, p, values, candidates)
        if linear is None:
            break
        i, j, factor = linear
        rest = ca.substitute(rows[i], x[j], ca.SX(0))
        # A division by one would stay in the expression, and keep it from cancelling.
        value = rest if factor.is_minus_one() else -rest if factor.is_one() else -rest / factor
        rows = [row for k, row in enumerate(rows) if k != i]
        whole = ca.cse(ca.substitute(ca.vertcat(state, *rows), x[j], value))
        state, rows = whole[: x.numel()], ca.vertsplit(whole[x.numel() :]) if rows else []
        candidates.remove(j)
    unknowns = [j for j in range(x.numel()) if j in keep or j in candidates]
    # A row that has become identically zero asks for nothing.
    rows = [row for row in rows if not (row.is_constant() and float(row) == 0.0)]
    return ReducedEquations(rows, unknowns, state)


def _linear(
    rows: list[ca.SX], x: ca.SX, variables: ca.SX, p: ca.SX, values: ca.DM, candidates: list[int]
) -> tuple[int, int, ca.SX] | None:
    """Row, symbol and factor of a linear occurrence, in a row of as few symbols as there is.

    A factor of one comes first: ``S`` by the rate, and not a rotor's speed by ``S``.
    """
    if not rows or not candidates:
        return None
    slopes = ca.cse(ca.jacobian(ca.vertcat(*rows), x))
    filled = np.array(ca.DM(slopes.sparsity(), 1).full(), dtype=bool)
    for i in np.argsort(filled.sum(axis=1), kind="stable"):
        factors = {j: slopes[int(i), j] for j in candidates if filled[i, j]}
        others = {j: not (f.is_one() or f.is_minus_one()) for j, f in factors.items()}
        for j in sorted(factors, key=others.__getitem__):
            factor = factors[j]
            if ca.depends_on(factor, variables):
                continue
            size = float(ca.evalf(ca.substitute(factor, p, values))) if p.numel() else float(factor)
            if np.isfinite(size) and size != 0.0:
                return int(i), j, factor
    return None


def torques(
    rows: Sequence[ca.SX], moments: Sequence[ca.SX], symbols: ca.SX
) -> tuple[list[ca.SX], ca.SX | None]:
    """Two rows of coupled accelerations as torques, and W (2, 2); unchanged and None otherwise.

    ``moments``: symbols of the torques on the axes; ``symbols``: all symbols of the rows.
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
    makers = _makers(program)
    if any(count + k not in makers for k in range(4)):
        return None
    places = [makers[count + k] for k in range(4)]
    entries = {place: ca.SX.sym(f"mobility_{place}") for place, _ in places}
    replaced = _run(program, symbols, entries)[:count]
    own = ca.vertcat(*entries.values())
    matrix = [[sign * entries[place] for place, sign in places[i::2]] for i in range(2)]
    torques = []
    for place, sign in places[::2]:
        share = sign * ca.jacobian(replaced[0], entries[place])
        if ca.depends_on(share, own):
            return None
        torques.append(share)
    # rows − W b must vanish: linear in the entries, with these factors, and nothing else.
    for i in range(2):
        difference = replaced[i] - matrix[i][0] * torques[0] - matrix[i][1] * torques[1]
        slopes = ca.cse(ca.jacobian(difference, own))
        at_zero = ca.cse(ca.substitute(replaced[i], own, ca.SX.zeros(own.numel())))
        if not _vanishes(slopes) or not _vanishes(at_zero):
            return None
    return torques


def _vanishes(expression: ca.SX) -> bool:
    return all(e.is_zero() for e in ca.vertsplit(ca.vec(ca.densify(expression))))


def _makers(program: ca.Function) -> dict[int, tuple[int, int]]:
    """Which instruction makes each output, up to a sign."""
    writer: dict[int, tuple[int, int]] = {}
    makers: dict[int, tuple[int, int]] = {}
    rows = program.sparsity_out(0).row()
    for k in range(program.n_instructions()):
        operation = program.instruction_id(k)
        into, operands = program.instruction_output(k), program.instruction_input(k)
        if operation == ca.OP_OUTPUT:
            makers[rows[into[1]]] = writer[operands[0]]
        elif operation == ca.OP_NEG:
            place, sign = writer[operands[0]]
            writer[into[0]] = place, -sign
        else:
            writer[into[0]] = k, 1
    return makers


def _run(program: ca.Function, symbols: ca.SX, instead: dict[int, ca.SX]) -> list[ca.SX]:
    """The outputs, with the results of some instructions replaced."""
    work: dict[int, ca.SX] = {}
    outputs = [ca.SX(0)] * program.size1_out(0)
    rows = program.sparsity_out(0).row()
    for k in range(program.n_instructions()):
        operation = program.instruction_id(k)
        into, operands = program.instruction_output(k), program.instruction_input(k)
        if operation == ca.OP_OUTPUT:
            outputs[rows[into[1]]] = work[operands[0]]
        elif k in instead:
            work[into[0]] = instead[k]
        elif operation == ca.OP_CONST:
            work[into[0]] = ca.SX(program.instruction_constant(k))
        elif operation == ca.OP_INPUT:
            work[into[0]] = symbols[operands[1]]
        elif len(operands) == 1:
            work[into[0]] = ca.SX.unary(operation, work[operands[0]])
        else:
            work[into[0]] = ca.SX.binary(operation, work[operands[0]], work[operands[1]])
    return outputs


def without_factors(row: ca.SX, variables: ca.SX) -> tuple[ca.SX, list[ca.SX]]:
    """A row without cosines, factors of parameters alone and its divisor; and what they were."""
    factors: list[ca.SX] = []
    while True:
        if row.is_op(ca.OP_NEG):
            row = row.dep(0)
        elif row.is_op(ca.OP_DIV):
            factors.append(row.dep(1))
            row = row.dep(0)
        elif row.is_op(ca.OP_MUL):
            both = row.dep(0), row.dep(1)
            own = [f.is_op(ca.OP_COS) or not ca.depends_on(f, variables) for f in both]
            if not any(own):
                return row, factors
            factors.append(both[own.index(True)])
            row = both[1 - own.index(True)]
        else:
            return row, factors
