"""Proofs that a function is negative everywhere in a set, by interval branch and bound.

The set is a box, less an open part around an equilibrium, and as far as constraints hold::

    g(x) < 0   for all x in the box, outside `exclude`, with h(x) <= 0

Every box is bounded with outward rounding, by the natural extension and by the mean value form,
and is done with once g < 0 or h > 0 on it; else it is halved where that helps most. So *proved*
is a theorem about the expressions given, parameters being the numbers that they hold. At the
middle of every box the claim is tested as well, with the same bounds: a *counterexample* is one
without doubt. With the budget of boxes used up, the claim is *undecided* on the boxes left.

After Neumaier, "Complete search in continuous global optimization" (Acta Numerica 2004), ch. 11.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import casadi as ca
import numpy as np
import numpy.typing as npt

from trms_cli.stability.intervals.enclosure import Enclosure
from trms_cli.stability.intervals.interval import Interval

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
Status = Literal["proved", "counterexample", "undecided"]

#: Boxes bounded at once: enough for NumPy's loops to be long, little enough to stay in the cache.
CHUNK = 2048
#: A box narrower than this share of the first one is not halved any more.
NARROWEST = 1e-9
#: Operations with a jump. With one of them the mean value form says nothing.
_JUMPS = {ca.OP_SIGN, ca.OP_FLOOR, ca.OP_CEIL}


@dataclass(frozen=True)
class Proof:
    """What became of a claim."""

    status: Status
    point: FloatArray | None  #: (n,) array or None; where it does not hold, if that was found
    value: float | None  #: The largest row of g there
    examined: int  #: Boxes bounded
    left: Interval  #: (m, n), boxes on which nothing is known yet; none when proved

    @property
    def holds(self) -> bool:
        return self.status == "proved"


def prove_negative(
    function: ca.Function,
    lower: npt.ArrayLike,
    upper: npt.ArrayLike,
    *,
    given: Sequence[npt.ArrayLike] = (),
    inside: ca.Function | None = None,
    exclude: tuple[npt.ArrayLike, npt.ArrayLike] | None = None,
    budget: int = 100_000,
    continuous: bool = True,
) -> Proof:
    """Prove g(x) < 0, in all rows, over a box.

    Parameters
    ----------
    function : casadi.Function
        ``(x, *given) → g``, columns of SX.
    lower, upper : (n,)
        The box.
    given : sequence of arrays
        Values of the other inputs, the same for `function` and `inside`: parameters, a level.
    inside : casadi.Function or None
        ``(x, *given) → h``: only states with h(x) <= 0 in all rows count (``V − c``).
    exclude : (lower, upper) or None
        A box whose interior does not count: a neighbourhood of the equilibrium, where g is zero.
    budget : int
        Boxes to bound at most.
    continuous : bool
        Whether g and h are continuous, which the mean value form needs. A coefficient that
        changes with the sign of the very quantity it multiplies is continuous.

    Returns
    -------
    Proof
    """
    claim = _Bounded(function, continuous)
    constraint = None if inside is None else _Bounded(inside, continuous)
    others = [Interval.point(np.atleast_1d(np.asarray(value, dtype=float))) for value in given]
    low, high = (np.asarray(side, dtype=float).ravel() for side in (lower, upper))
    narrowest = NARROWEST * (high - low)
    waiting = _around(low, high, exclude)
    stuck: list[Interval] = []
    examined = 0
    while len(waiting.lower) and examined < budget:
        size = min(CHUNK, budget - examined)
        boxes, waiting = waiting[:size], waiting[size:]
        examined += len(boxes.lower)
        if constraint is not None:
            bounds, reach = constraint(boxes, others)
            outside = (bounds.lower > 0.0).any(axis=1)
            boxes, reach = boxes[~outside], reach[~outside]
            undecided = (bounds.upper[~outside] > 0.0).any(axis=1)
            reach[~undecided] = 0.0
        else:
            reach = np.zeros(boxes.lower.shape)
        bounds, smear = claim(boxes, others)
        open_ = ~(bounds.upper < 0.0).all(axis=1)
        boxes, reach, smear = boxes[open_], reach[open_], smear[open_]
        found = _counterexample(claim, constraint, boxes, others, exclude)
        if found is not None:
            return Proof("counterexample", *found, examined, _none(len(low)))
        # A step is worth what it narrows in either: each is measured by its own largest share.
        gain = _share(smear) + _share(reach)
        relative = boxes.width / np.where(high > low, high - low, 1.0)
        gain = np.where(gain.max(axis=1, keepdims=True) > 0.0, gain, relative)
        gain = np.where(boxes.width > narrowest, gain, -1.0)
        finished = (gain < 0.0).all(axis=1)
        if finished.any():
            stuck.append(boxes[finished])
        waiting = joined(waiting, halved(boxes[~finished], gain[~finished].argmax(axis=1)))
    left = joined(waiting, *stuck)
    return Proof("undecided" if len(left.lower) else "proved", None, None, examined, left)


class _Bounded:
    """Bounds of a column of functions on boxes, and what each variable adds to their width."""

    def __init__(self, function: ca.Function, continuous: bool) -> None:
        self._natural = Enclosure(function)
        operations = {function.instruction_id(k) for k in range(function.n_instructions())}
        self._mean_value = continuous and not operations & _JUMPS
        arguments = function.sx_in()
        value = function.call(arguments)[0]
        # One column, so that one form serves one row and many.
        slope = ca.vec(ca.densify(ca.jacobian(value, arguments[0])))
        self._slope = Enclosure(ca.Function("slope", arguments, [slope]))
        self._shape = (arguments[0].numel(), value.numel())

    def at(self, points: FloatArray, others: Sequence[Interval]) -> Interval:
        """Bounds at points (m, n), no wider than rounding: (m, rows)."""
        return self._natural(Interval.point(points), *others)[0]

    def __call__(self, boxes: Interval, others: Sequence[Interval]) -> tuple[Interval, FloatArray]:
        """Bounds (m, rows), and (m, n) how much of the widest row each variable makes."""
        count = len(boxes.lower)
        n, rows = self._shape
        value = self._natural(boxes, *others)[0]
        flat = self._slope(boxes, *others)[0]
        slope = Interval(
            flat.lower.reshape(count, n, rows).swapaxes(1, 2),
            flat.upper.reshape(count, n, rows).swapaxes(1, 2),
        )
        if self._mean_value:
            centre = boxes.middle
            total = self.at(centre, others)
            away = Interval.point(boxes.upper) - Interval.point(centre)
            back = Interval.point(boxes.lower) - Interval.point(centre)
            away = away.hull(back)
            for j in range(n):
                total = total + slope[:, :, j] * away[:, None, j]
            value = value.intersection(total)
        with np.errstate(invalid="ignore"):
            smear = slope.magnitude * boxes.width[:, None, :]
        smear = np.nan_to_num(smear, nan=0.0, posinf=1e300)
        return value, smear.max(axis=1, initial=0.0)


def _counterexample(
    claim: _Bounded,
    constraint: _Bounded | None,
    boxes: Interval,
    others: Sequence[Interval],
    exclude: tuple[npt.ArrayLike, npt.ArrayLike] | None,
) -> tuple[FloatArray, float] | None:
    """A middle of a box where the claim fails beyond rounding, the worst one."""
    if not len(boxes.lower):
        return None
    points = boxes.middle
    values = claim.at(points, others).lower.max(axis=1)
    fails = values >= 0.0
    if constraint is not None:
        fails &= (constraint.at(points, others).upper <= 0.0).all(axis=1)
    if exclude is not None:
        low, high = (np.asarray(side, dtype=float) for side in exclude)
        fails &= ((points <= low) | (points >= high)).any(axis=1)
    if not fails.any():
        return None
    worst = int(np.argmax(np.where(fails, values, -np.inf)))
    return points[worst], float(values[worst])


def _around(
    lower: FloatArray, upper: FloatArray, exclude: tuple[npt.ArrayLike, npt.ArrayLike] | None
) -> Interval:
    """The box, cut up around what is excluded."""
    if exclude is None:
        return Interval(lower[None, :].copy(), upper[None, :].copy())
    low, high = (np.asarray(side, dtype=float).ravel() for side in exclude)
    parts = []
    inner_low, inner_high = lower.copy(), upper.copy()
    if np.all(low < upper) and np.all(high > lower):
        for j in range(len(lower)):
            for side in ("below", "above"):
                part_low, part_high = inner_low.copy(), inner_high.copy()
                if side == "below":
                    part_high[j] = low[j]
                    inner_low[j] = max(inner_low[j], low[j])
                else:
                    part_low[j] = high[j]
                    inner_high[j] = min(inner_high[j], high[j])
                if np.all(part_low <= part_high):
                    parts.append((part_low, part_high))
    else:
        parts.append((lower, upper))
    if not parts:
        return _none(len(lower))
    return Interval(np.array([low for low, _ in parts]), np.array([high for _, high in parts]))


def halved(boxes: Interval, along: npt.NDArray[np.intp]) -> Interval:
    """Boxes (m, n), each cut in two in one direction: (2m, n)."""
    rows = np.arange(len(boxes.lower))
    middle = boxes.middle[rows, along]
    first_upper, second_lower = boxes.upper.copy(), boxes.lower.copy()
    first_upper[rows, along] = middle
    second_lower[rows, along] = middle
    return joined(Interval(boxes.lower, first_upper), Interval(second_lower, boxes.upper))


def joined(*parts: Interval) -> Interval:
    """Lists of boxes (m, n) after each other."""
    return Interval(
        np.concatenate([part.lower for part in parts]),
        np.concatenate([part.upper for part in parts]),
    )


def _share(sizes: FloatArray) -> FloatArray:
    """Each of a row by the largest one."""
    largest = sizes.max(axis=1, initial=0.0, keepdims=True)
    return np.where(largest > 0.0, sizes / np.where(largest > 0.0, largest, 1.0), 0.0)


def _none(n: int) -> Interval:
    return Interval(np.empty((0, n)), np.empty((0, n)))
