"""Branch and bound over boxes: statements that hold everywhere in a set, and how far they hold.

Every box is bounded with outward rounding; one that settles its part of the question is done with,
any other is halved. The boxes with the lowest keys (a lower bound of what is asked for, say) are
taken first, so that the search may stop at any time: the lowest key that is left bounds the answer.

After Neumaier, "Complete search in continuous global optimization" (Acta Numerica 2004), ch. 11.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import casadi as ca
import numpy as np
import numpy.typing as npt

from trms_cli.core.arrays import FloatArray
from trms_cli.stability.intervals.enclosure import Enclosure
from trms_cli.stability.intervals.interval import Interval

#: Boxes bounded at once: enough for NumPy's loops to be long, little enough to stay in the cache.
_CHUNK = 2048
#: A box narrower than this share of the first one is not halved any more.
_NARROWEST = 1e-9
#: Operations that jump. With one of them the mean value form says nothing.
JUMPS = {ca.OP_SIGN, ca.OP_FLOOR, ca.OP_CEIL}


@dataclass(frozen=True)
class BoxSearch:
    """What branch and bound left open."""

    boxes: Interval  #: (m, n); none when the search is complete
    keys: FloatArray  #: (m,) array; theirs
    examined: int  #: Boxes bounded

    @property
    def lowest(self) -> float:
        """The lowest key; infinite when nothing is left."""
        return float(self.keys.min(initial=np.inf))


def branch_and_bound(
    first: BoxSearch,
    visit: Callable[[Interval, FloatArray], tuple[Interval, FloatArray, int]],
    *,
    budget: int,
    enough: Callable[[float], bool] = lambda lowest: False,
    chunk: int = _CHUNK,
    whole_chunks: bool = False,
) -> BoxSearch:
    """Take boxes in the order of their keys until none is left, or that is enough.

    ``visit``: (boxes (m, n), keys (m,)) → the halves that stay open, their keys, and how many boxes
    were bounded for that; a chunk of boxes at once. At most the budget is bounded, unless the last
    chunk may take more (``whole_chunks``). ``enough``: whether it may end at a lowest key.
    """
    boxes, keys, examined = first.boxes, first.keys, first.examined
    while len(keys) and examined < budget:
        if enough(float(keys.min())):
            break
        size = min(chunk, len(keys), chunk if whole_chunks else budget - examined)
        order = np.argpartition(keys, size - 1)
        now, later = order[:size], order[size:]
        halves, theirs, spent = visit(boxes[now], keys[now])
        boxes, keys = join_boxes(boxes[later], halves), np.concatenate([keys[later], theirs])
        examined += spent
    return BoxSearch(boxes, keys, examined)


@dataclass(frozen=True)
class NegativityProof:
    """What became of a claim g < 0.

    *Proved* is a theorem about the expressions given, parameters being the numbers that they hold;
    a *counterexample* fails beyond rounding.
    """

    status: Literal["proved", "counterexample", "undecided"]
    point: FloatArray | None  #: (n,) array or None; where it does not hold, if that was found
    value: float | None  #: The largest row of g there
    examined: int  #: Boxes bounded
    undecided: Interval  #: (m, n), boxes on which nothing is known yet; none when proved

    @property
    def holds(self) -> bool:
        return self.status == "proved"


def prove_negative(
    function: ca.Function,
    lower: npt.ArrayLike,
    upper: npt.ArrayLike,
    *,
    given: Sequence[npt.ArrayLike] = (),
    budget: int = 100_000,
) -> NegativityProof:
    """Prove g(x) < 0, in all rows, over a box from lower to upper, (n,).

    ``function`` is ``(x, *given) → g``, columns of SX; continuous, unless an operation in it jumps.
    ``given`` holds the values of its other inputs: parameters, a level.
    """
    enclosure = Enclosure(function)
    jumps = operations(function) & JUMPS
    others = [Interval.point(np.atleast_1d(np.asarray(value, dtype=float))) for value in given]
    low, high = (np.asarray(side, dtype=float).ravel() for side in (lower, upper))
    size = np.where(high > low, high - low, 1.0)
    failure: list[tuple[float, FloatArray]] = []

    def visit(boxes: Interval, _: FloatArray) -> tuple[Interval, FloatArray, int]:
        count = len(boxes.lower)
        bounds = enclosure(boxes, *others)[0] if jumps else enclosure.mean_value(boxes, *others)
        boxes = boxes[~(bounds.upper < 0.0).all(axis=1)]
        middles = boxes.middle
        if len(middles):
            values = enclosure(Interval.point(middles), *others)[0].lower.max(axis=1)
            worst = int(np.argmax(values))
            if values[worst] >= 0.0:
                failure.append((float(values[worst]), middles[worst]))
        narrow = (boxes.width <= _NARROWEST * size).all(axis=1)
        halves = halve_boxes(boxes[~narrow], (boxes.width / size)[~narrow].argmax(axis=1))
        remaining = join_boxes(halves, boxes[narrow])
        # The widest come first; what is too narrow to be halved comes last, and ends the search.
        width = (halves.width / size).max(axis=1, initial=0.0)
        return remaining, np.concatenate([-width, np.zeros(int(narrow.sum()))]), count

    first = BoxSearch(Interval(low[None].copy(), high[None].copy()), np.array([-1.0]), 0)
    search = branch_and_bound(
        first, visit, budget=budget, enough=lambda lowest: lowest == 0.0 or bool(failure)
    )
    if failure:
        value, point = failure[0]
        none = Interval(np.empty((0, len(low))), np.empty((0, len(low))))
        return NegativityProof("counterexample", point, value, search.examined, none)
    status: Literal["proved", "undecided"] = "undecided" if len(search.keys) else "proved"
    return NegativityProof(status, None, None, search.examined, search.boxes)


def operations(function: ca.Function) -> set[int]:
    """The kinds of operations in a function."""
    return {function.instruction_id(k) for k in range(function.n_instructions())}


def halve_boxes(
    boxes: Interval, along: npt.NDArray[np.intp] | int, at: FloatArray | None = None
) -> Interval:
    """Boxes (m, n), each cut in two in one direction, at the middle or a point: (2m, n)."""
    rows = np.arange(len(boxes.lower))
    place = (boxes.middle if at is None else at)[rows, along]
    first_upper, second_lower = boxes.upper.copy(), boxes.lower.copy()
    first_upper[rows, along] = second_lower[rows, along] = place
    return join_boxes(Interval(boxes.lower, first_upper), Interval(second_lower, boxes.upper))


def join_boxes(*parts: Interval) -> Interval:
    """Lists of boxes (m, n) after each other."""
    return Interval(
        np.concatenate([part.lower for part in parts]),
        np.concatenate([part.upper for part in parts]),
    )
