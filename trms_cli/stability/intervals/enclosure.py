"""A CasADi function evaluated on boxes: bounds that hold for every point of a box.

The very expressions of a model are evaluated, operation by operation, in interval arithmetic:
there is no second copy of an equation. A switch by sign (a coefficient for each direction) gives
the hull of its two branches where a box lies on both sides.

The natural extension (Moore et al. 2009, ch. 5) is wide where a variable occurs often; on small
boxes the mean value form

    f(x) ∈ f(c) + f'(box) (box − c)

is tighter. :meth:`Enclosure.mean_value` intersects the two.
"""

from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca
import numpy as np

from trms_cli.core.errors import ModelError
from trms_cli.stability.intervals.interval import Interval


@dataclass(frozen=True)
class _Branch:
    """What an ``if`` without ``else`` gave: to be joined with its other half."""

    condition: int
    holds: bool
    value: Interval


class Enclosure:
    """Interval extension of a CasADi function of scalars and vectors.

    It is made of SX expressions; its inputs are column vectors, its outputs may be matrices. Raises
    ModelError if an operation in it is unknown here.
    """

    def __init__(self, function: ca.Function) -> None:
        self.function = function
        self._program = [
            (
                function.instruction_id(k),
                function.instruction_output(k),
                function.instruction_input(k),
                function.instruction_constant(k)
                if function.instruction_id(k) == ca.OP_CONST
                else 0,
            )
            for k in range(function.n_instructions())
        ]
        supported_operations = {*_UNARY, *_BINARY, *_SPECIAL}
        for operation, *_ in self._program:
            if operation not in supported_operations:
                named = [n for n in dir(ca) if n[:3] == "OP_" and getattr(ca, n) == operation]
                name = named[0] if named else str(operation)
                raise ModelError(
                    f"function {function.name()!r} has operation {name}, of which no bounds are "
                    "known",
                    remedy="statements by intervals are not possible for this model",
                )
        # Row and column of each nonzero of the outputs, in CasADi's order.
        triplets = (function.sparsity_out(i).get_triplet() for i in range(function.n_out()))
        self._rows = [list(zip(*triplet, strict=True)) for triplet in triplets]
        self._slope: Enclosure | None = None

    def __call__(self, *arguments: Interval) -> list[Interval]:
        """Bounds of all outputs: (n_boxes, rows) of a column, (n_boxes, rows, columns) of a matrix.

        Arguments are one an input, (n_boxes, size), or (size,) for one that all boxes share.
        """
        results = self.matrices(*arguments)
        return [r[:, :, 0] if r.lower.shape[2] == 1 else r for r in results]

    def matrices(self, *arguments: Interval) -> list[Interval]:
        """The same, of a column too (n_boxes, rows, 1)."""
        count = max((len(a.lower) for a in arguments if a.lower.ndim == 2), default=1)
        sizes = [(count, *self.function.size_out(i)) for i in range(self.function.n_out())]
        results = [Interval(np.zeros(size), np.zeros(size)) for size in sizes]
        work: dict[int, Interval] = {}
        # Which condition a register holds, and whether negated; which half of a switch.
        conditions: dict[int, tuple[int, bool] | None] = {}
        branches: dict[int, _Branch | None] = {}
        for number, (operation, outputs, inputs, constant) in enumerate(self._program):
            if operation == ca.OP_OUTPUT:
                row, column = self._rows[outputs[0]][outputs[1]]
                target, value = results[outputs[0]], work[inputs[0]]
                target.lower[:, row, column] = value.lower
                target.upper[:, row, column] = value.upper
                continue
            condition: tuple[int, bool] | None = None
            branch: _Branch | None = None
            if operation == ca.OP_CONST:
                value = Interval.point(np.array([constant]))  # shared by all boxes, as p may be
            elif operation == ca.OP_INPUT:
                argument = arguments[inputs[0]][..., inputs[1]]
                value = Interval(np.atleast_1d(argument.lower), np.atleast_1d(argument.upper))
            elif operation in _COMPARISONS:
                value = _COMPARISONS[operation](work[inputs[0]], work[inputs[1]])
                condition = (number, True)
            elif operation == ca.OP_NOT:
                a = work[inputs[0]]
                value = Interval(1.0 - a.upper, 1.0 - a.lower)
                if (negated := conditions.get(inputs[0])) is not None:
                    condition = (negated[0], not negated[1])
            elif operation == ca.OP_IF_ELSE_ZERO:
                value, branch = _half(work[inputs[0]], work[inputs[1]], conditions.get(inputs[0]))
            elif operation == ca.OP_ADD and (hull := _other_half(branches, inputs)) is not None:
                # The sum where the switch is decided; both bounds hold everywhere.
                value = (work[inputs[0]] + work[inputs[1]]).intersection(hull)
            elif operation in _UNARY:
                value = _UNARY[operation](work[inputs[0]])
            else:
                value = _BINARY[operation](work[inputs[0]], work[inputs[1]])
            work[outputs[0]] = value
            conditions[outputs[0]], branches[outputs[0]] = condition, branch
        return results

    def mean_value(self, box: Interval, *others: Interval) -> Interval:
        """Bounds (n_boxes, rows) of the first output, by the mean value form in the first input.

        Of a box (n_boxes, n); the other inputs as in a call. Never wider than the natural
        extension.
        """
        if self._slope is None:
            arguments = self.function.sx_in()
            outputs = self.function.call(arguments)
            slope = ca.densify(ca.jacobian(outputs[0], arguments[0]))
            self._slope = Enclosure(ca.Function("slope", arguments, [slope]))
        natural = self(box, *others)[0]
        centre = box.middle
        at_centre = self(Interval.point(centre), *others)[0]
        slope = self._slope.matrices(box, *others)[0]
        away = Interval(box.lower - centre, box.upper - centre)
        away = Interval(np.nextafter(away.lower, -np.inf), np.nextafter(away.upper, np.inf))
        total = at_centre
        for j in range(centre.shape[1]):
            total = total + slope[:, :, j] * away[:, None, j]
        return natural.intersection(total)


def _half(
    truth: Interval, value: Interval, condition: tuple[int, bool] | None
) -> tuple[Interval, _Branch | None]:
    """``value`` if the condition holds, else 0."""
    never, always = truth.upper < 0.5, truth.lower > 0.5
    zero = np.zeros(1)
    hull = value.hull(Interval(zero, zero))
    half = Interval(
        np.where(never, 0.0, np.where(always, value.lower, hull.lower)),
        np.where(never, 0.0, np.where(always, value.upper, hull.upper)),
    )
    return half, None if condition is None else _Branch(*condition, value)


def _other_half(branches: dict[int, _Branch | None], inputs: list[int]) -> Interval | None:
    """The hull of both branches of a switch, where its halves are what is added."""
    first, second = branches.get(inputs[0]), branches.get(inputs[1])
    if first is None or second is None:
        return None
    belong = first.condition == second.condition and first.holds != second.holds
    return first.value.hull(second.value) if belong else None


def _compare(
    always: Callable[[Interval, Interval], np.ndarray],
    never: Callable[[Interval, Interval], np.ndarray],
) -> Callable[[Interval, Interval], Interval]:
    def truth(a: Interval, b: Interval) -> Interval:
        return Interval(always(a, b).astype(float), 1.0 - never(a, b).astype(float))

    return truth


def _same(a: Interval, b: Interval) -> np.ndarray:
    return (a.lower == a.upper) & (b.lower == b.upper) & (a.lower == b.lower)


def _apart(a: Interval, b: Interval) -> np.ndarray:
    return ~a.meets(b)


_COMPARISONS = {
    ca.OP_LT: _compare(lambda a, b: a.upper < b.lower, lambda a, b: a.lower >= b.upper),
    ca.OP_LE: _compare(lambda a, b: a.upper <= b.lower, lambda a, b: a.lower > b.upper),
    ca.OP_EQ: _compare(_same, _apart),
    ca.OP_NE: _compare(_apart, _same),
}


def _to_the_power(a: Interval, b: Interval) -> Interval:
    exponent = b.lower.flat[0] if b.lower.size else 0.0
    constant = bool(np.all(b.lower == exponent) and np.all(b.upper == exponent))
    if constant and exponent == round(exponent) and abs(exponent) <= 64:
        integer_power = a.power(int(abs(exponent)))
        return integer_power if exponent >= 0 else integer_power.reciprocal()
    # a^b = exp(b log a), for a > 0
    return (b * a.rising(np.log)).rising(np.exp)


_UNARY: dict[int, Callable[[Interval], Interval]] = {
    ca.OP_ASSIGN: lambda a: a,
    ca.OP_NEG: lambda a: -a,
    ca.OP_TWICE: lambda a: a + a,
    ca.OP_SQ: Interval.square,
    ca.OP_SQRT: Interval.square_root,
    ca.OP_INV: Interval.reciprocal,
    ca.OP_FABS: Interval.absolute,
    ca.OP_SIGN: lambda a: Interval(np.sign(a.lower), np.sign(a.upper)),
    ca.OP_SIN: Interval.sine,
    ca.OP_COS: Interval.cosine,
    ca.OP_TAN: lambda a: a.sine() / a.cosine(),
    ca.OP_EXP: lambda a: a.rising(np.exp),
    ca.OP_EXPM1: lambda a: a.rising(np.expm1),
    ca.OP_LOG: lambda a: a.rising(np.log),
    ca.OP_LOG1P: lambda a: a.rising(np.log1p),
    ca.OP_ATAN: lambda a: a.rising(np.arctan),
    ca.OP_SINH: lambda a: a.rising(np.sinh),
    ca.OP_TANH: lambda a: a.rising(np.tanh),
    ca.OP_FLOOR: lambda a: Interval(np.floor(a.lower), np.floor(a.upper)),
    ca.OP_CEIL: lambda a: Interval(np.ceil(a.lower), np.ceil(a.upper)),
}
_BINARY: dict[int, Callable[[Interval, Interval], Interval]] = {
    ca.OP_ADD: Interval.__add__,
    ca.OP_SUB: Interval.__sub__,
    ca.OP_MUL: Interval.__mul__,
    ca.OP_DIV: Interval.__truediv__,
    ca.OP_FMIN: lambda a, b: Interval(np.minimum(a.lower, b.lower), np.minimum(a.upper, b.upper)),
    ca.OP_FMAX: lambda a, b: Interval(np.maximum(a.lower, b.lower), np.maximum(a.upper, b.upper)),
    ca.OP_POW: _to_the_power,
    ca.OP_CONSTPOW: _to_the_power,
    ca.OP_AND: lambda a, b: Interval(np.minimum(a.lower, b.lower), np.minimum(a.upper, b.upper)),
    ca.OP_OR: lambda a, b: Interval(np.maximum(a.lower, b.lower), np.maximum(a.upper, b.upper)),
}
_SPECIAL = {ca.OP_CONST, ca.OP_INPUT, ca.OP_OUTPUT, ca.OP_NOT, ca.OP_IF_ELSE_ZERO, *_COMPARISONS}
