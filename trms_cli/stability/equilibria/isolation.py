"""All roots of one block of equations in a box, by interval branch and prune.

A box is thrown away when bounds of the equations over it exclude zero, or when the image of the
interval Newton operator (:mod:`trms_cli.stability.equilibria.interval_newton`) has nothing in
common with it; that operator also tells which boxes hold exactly one root, for each value of what
is given.

All else is cut in two, until it is as small as the tolerance: what is left then is undecided, and
told so. Boxes are tested a little larger than they are, so that a root on the border of two is
found. The equations must be continuous; where they have a kink (a coefficient for each direction)
the bounds of the slopes hold the slopes of both sides.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from trms_cli.stability.equilibria.block_equations import BlockEquations
from trms_cli.stability.equilibria.interval_newton import (
    centre_of,
    changes_sign,
    newton,
    refined,
)
from trms_cli.stability.intervals.interval import Interval

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int64]

#: What has no bounds is searched to here (in its unit); beyond, bounds of the equations alone.
FAR = 1e6
_INFLATION = 1.2
_ROUNDS = 400
#: Boxes of one problem at once, by unknowns; a problem with more is given up as undecided.
_MOST_BOXES = {1: 256, 2: 1024}
_MOST_BOXES_OF_MORE = 4096
#: The same where a doubt ends it: a range that needs more is cut instead.
_MOST_BOXES_IN_RANGES = 96


@dataclass(frozen=True)
class Roots:
    """Roots of many problems of one block."""

    owner: IntArray  #: (r,) int array; problem that each belongs to
    box: Interval  #: (r, n), around each
    unique: BoolArray  #: (r,) bool array; whether exactly one root is proved to lie in it
    exists: BoolArray  #: (r,) bool array; whether at least one is proved to
    open_ended: bool  #: Whether roots beyond :data:`FAR` are not excluded
    left: IntArray  #: (k,) int array; groups that were left at a doubt


def isolate(
    equations: BlockEquations,
    box: Interval,
    given: Interval,
    tolerance: FloatArray,
    groups: IntArray | None = None,
) -> Roots:
    """All roots in a box, for each of many problems.

    Parameters
    ----------
    equations : BlockEquations
    box : Interval
        (n,), of the unknowns; infinite where there is no bound.
    given : Interval
        (m, n_given): a problem each.
    tolerance : (n,) array
        Width of a box below which it is no longer cut.
    groups : (m,) int array, optional
        Problems of one number are left together as soon as there is a doubt in one of them; what
        was found of them until then is not all there is.
    """
    count = len(given.lower)
    starts, tails = _starts(box)
    open_ended = bool(len(tails.lower)) and not _excluded(equations, tails, given)
    owner = np.repeat(np.arange(count), len(starts.lower))
    queue = Interval(np.tile(starts.lower, (count, 1)), np.tile(starts.upper, (count, 1)))
    found = _Found(equations.n)
    left: set[int] = set()
    for _ in range(_ROUNDS):
        if not len(owner):
            break
        queue, owner = _round(equations, queue, owner, given, tolerance, found)
        queue, owner = _within_budget(queue, owner, found, groups is not None)
        if groups is not None:
            left.update(g for own, _ in found.undecided for g in groups[own].tolist())
            sure = ~np.isin(groups[owner], list(left))
            queue, owner = queue[sure], owner[sure]
    if len(owner):
        found.undecided.append((owner, queue))
    roots = _result(equations, found, given, box, tolerance, np.array(sorted(left), dtype=np.int64))
    return replace(roots, open_ended=open_ended)


class _Found:
    """What a search has come to so far."""

    def __init__(self, n: int) -> None:
        self.n = n
        self.proved: list[tuple[IntArray, Interval]] = []
        self.undecided: list[tuple[IntArray, Interval]] = []

    def together(self, parts: list[tuple[IntArray, Interval]]) -> tuple[IntArray, Interval]:
        if not parts:
            return np.zeros(0, dtype=np.int64), Interval.point(np.zeros((0, self.n)))
        return np.concatenate([owner for owner, _ in parts]), Interval(
            np.concatenate([box.lower for _, box in parts]),
            np.concatenate([box.upper for _, box in parts]),
        )


def _starts(box: Interval) -> tuple[Interval, Interval]:
    """The boxes that a search begins with, and those that reach to infinity."""
    finite, reaching = [], []
    for low, high in zip(box.lower.tolist(), box.upper.tolist(), strict=True):
        near = (max(low, -FAR), min(high, FAR))
        # Coefficients change with the direction: nothing has a kink but at zero.
        cuts = [near[0], 0.0, near[1]] if near[0] < 0.0 < near[1] else list(near)
        finite.append(list(pairwise(cuts)))
        ends = [(low, -FAR)] if low < -FAR else []
        reaching.append(ends + ([(FAR, high)] if high > FAR else []))
    inner = _products(finite)
    outer: list[FloatArray] = []
    for j, ends in enumerate(reaching):
        if ends:
            outer.append(
                _products([*finite[:j], ends, *(f + r for f, r in _after(finite, reaching, j))])
            )
    whole = np.concatenate(outer) if outer else np.zeros((0, len(finite), 2))
    return Interval(inner[:, :, 0], inner[:, :, 1]), Interval(whole[:, :, 0], whole[:, :, 1])


def _after(
    finite: list[list[tuple[float, float]]], reaching: list[list[tuple[float, float]]], j: int
) -> list[tuple[list[tuple[float, float]], list[tuple[float, float]]]]:
    return list(zip(finite[j + 1 :], reaching[j + 1 :], strict=True))


def _products(segments: list[list[tuple[float, float]]]) -> FloatArray:
    """All boxes with a side from each list, (n_boxes, n, 2)."""
    index = np.indices([len(side) for side in segments]).reshape(len(segments), -1)
    return np.stack([np.array(side)[i] for side, i in zip(segments, index, strict=True)], axis=1)


def _excluded(equations: BlockEquations, boxes: Interval, given: Interval) -> bool:
    """Whether no box has a root for any problem."""
    m = len(given.lower)
    owner = np.repeat(np.arange(m), len(boxes.lower))
    many = Interval(np.tile(boxes.lower, (m, 1)), np.tile(boxes.upper, (m, 1)))
    with np.errstate(invalid="ignore", over="ignore"):
        values = equations.values(many, given[owner])
    return bool(np.all(np.any(~values.contains_zero(), axis=1)))


def _round(
    equations: BlockEquations,
    queue: Interval,
    owner: IntArray,
    given: Interval,
    tolerance: FloatArray,
    found: _Found,
) -> tuple[Interval, IntArray]:
    """One test of every box, and the boxes that are left."""
    half = 0.5 * _INFLATION * queue.width + 1e-300
    tested = Interval(queue.middle - half, queue.middle + half)
    step = newton(equations, tested, given[owner])
    alive = step.possible & np.all(step.image.meets(queue), axis=1)
    proved = alive & step.unique
    found.proved.append((owner[proved], tested[proved]))
    left = alive & ~proved
    if proved.any():
        left &= ~_inside(queue, owner, tested[proved], owner[proved])
    contracted = queue.intersection(step.image)[left]
    before, owner = queue[left], owner[left]
    slopes = step.slopes[left]
    small = np.all(contracted.width <= tolerance, axis=1)
    # What cannot be cut at its middle any more.
    small |= np.all(
        (contracted.middle <= contracted.lower) | (contracted.middle >= contracted.upper), axis=1
    )
    found.undecided.append((owner[small], contracted[small]))
    stalled = np.all(contracted.width > 0.7 * before.width, axis=1)[~small]
    contracted, owner, slopes = contracted[~small], owner[~small], slopes[~small]
    halves = _cut(contracted[stalled], slopes[stalled], tolerance)
    queue = Interval(
        np.concatenate([contracted.lower[~stalled], halves.lower]),
        np.concatenate([contracted.upper[~stalled], halves.upper]),
    )
    owner = np.concatenate([owner[~stalled], owner[stalled], owner[stalled]])
    return queue, owner


def _inside(
    boxes: Interval,
    owner: IntArray,
    domains: Interval,
    owners: IntArray,
) -> BoolArray:
    """Whether each box lies in a domain of its problem."""
    same = owner[:, None] == owners[None, :]
    lower = np.all(domains.lower[None, :, :] <= boxes.lower[:, None, :], axis=2)
    upper = np.all(boxes.upper[:, None, :] <= domains.upper[None, :, :], axis=2)
    return np.asarray(np.any(same & lower & upper, axis=1))


def _cut(box: Interval, slopes: Interval, tolerance: FloatArray) -> Interval:
    """Both halves of each box, cut where the equations change most."""
    if not len(box.lower):
        return box
    with np.errstate(invalid="ignore", over="ignore"):
        change = slopes.magnitude * box.width[:, None, :]
        change /= np.maximum(change.max(axis=2, keepdims=True), 1e-300)
    weight = np.where(np.isfinite(change), change, 1.0).sum(axis=1) + 1e-3
    side = np.argmax(np.where(box.width > tolerance, weight, -1.0), axis=1)
    rows = np.arange(len(side))
    at = centre_of(box)[rows, side]
    first, second = box.upper.copy(), box.lower.copy()
    first[rows, side] = at
    second[rows, side] = at
    return Interval(np.concatenate([box.lower, second]), np.concatenate([first, box.upper]))


def _within_budget(
    queue: Interval, owner: IntArray, found: _Found, in_ranges: bool
) -> tuple[Interval, IntArray]:
    """Give up the problems that have too many boxes."""
    if not len(owner):
        return queue, owner
    most = _MOST_BOXES.get(found.n, _MOST_BOXES_OF_MORE)
    over = (np.bincount(owner) > (_MOST_BOXES_IN_RANGES if in_ranges else most))[owner]
    if over.any():
        found.undecided.append((owner[over], queue[over]))
    return queue[~over], owner[~over]


def _result(
    equations: BlockEquations,
    found: _Found,
    given: Interval,
    box: Interval,
    tolerance: FloatArray,
    left: IntArray,
) -> Roots:
    owner, domain = found.together(found.proved)
    tight = refined(equations, domain, given[owner])
    owner, domain, tight, certain = _distinct(owner, domain, tight)
    small_owner, small = found.together(found.undecided)
    outside = ~_inside(small, small_owner, domain, owner)
    small_owner, small = _clusters(small_owner[outside], small[outside], tolerance)
    # A cluster may hold a root that lay on the border of all its boxes.
    half = small.width + tolerance
    tested = Interval(small.middle - half, small.middle + half)
    proved = np.zeros(len(small_owner), dtype=bool)
    exists = proved.copy()
    if len(small_owner):
        step = newton(equations, tested, given[small_owner])
        keep = step.possible
        proved, small_owner = step.unique[keep], small_owner[keep]
        small, tested = small[keep], tested[keep]
        small = small.intersection(step.image[keep])
        exists = proved | changes_sign(equations, tested, given[small_owner])
    everything = Interval(
        np.concatenate([tight.lower, small.lower]), np.concatenate([tight.upper, small.upper])
    )
    owner = np.concatenate([owner, small_owner])
    unique = np.concatenate([certain, proved])
    exists = np.concatenate([certain, exists])
    # What lies outside is not asked for; what lies on the edge cannot be told.
    meets = np.all(everything.meets(box), axis=1)
    whole = np.all((everything.lower >= box.lower) & (everything.upper <= box.upper), axis=1)
    order = np.lexsort((everything.middle[:, 0], owner))
    order = order[meets[order]]
    return Roots(
        owner[order],
        everything[order],
        (unique & whole)[order],
        (exists & whole)[order],
        False,
        left,
    )


def _distinct(
    owner: IntArray, domain: Interval, tight: Interval
) -> tuple[IntArray, Interval, Interval, BoolArray]:
    """One of each root that was proved more than once."""
    keep: list[int] = []
    certain: list[bool] = []
    for i in range(len(owner)):
        same = False
        doubtful = False
        for place, j in enumerate(keep):
            if owner[j] != owner[i]:
                continue
            if _within(tight[i], domain[j]) or _within(tight[j], domain[i]):
                same = True
                break
            if np.all(tight[i].meets(tight[j])):
                doubtful = True
                certain[place] = False
        if not same:
            keep.append(i)
            certain.append(not doubtful)
    return owner[keep], domain[keep], tight[keep], np.array(certain, dtype=bool)


def _within(one: Interval, other: Interval) -> bool:
    return bool(np.all((other.lower <= one.lower) & (one.upper <= other.upper)))


def _clusters(owner: IntArray, boxes: Interval, tolerance: FloatArray) -> tuple[IntArray, Interval]:
    """Neighbouring boxes as one."""
    owners: list[int] = []
    hulls: list[tuple[FloatArray, FloatArray]] = []
    for k in np.unique(owner):
        own = np.flatnonzero(owner == k)
        groups: list[tuple[FloatArray, FloatArray]] = []
        for i in own[np.argsort(boxes.lower[own, 0])]:
            low, high = boxes.lower[i], boxes.upper[i]
            apart = []
            for other_low, other_high in groups:
                if np.all(low <= other_high + tolerance) and np.all(other_low <= high + tolerance):
                    low, high = np.minimum(low, other_low), np.maximum(high, other_high)
                else:
                    apart.append((other_low, other_high))
            groups = [*apart, (low, high)]
        owners += [int(k)] * len(groups)
        hulls += groups
    n = boxes.lower.shape[1]
    low = np.array([h[0] for h in hulls]).reshape(-1, n)
    high = np.array([h[1] for h in hulls]).reshape(-1, n)
    return np.array(owners, dtype=np.int64), Interval(low, high)
