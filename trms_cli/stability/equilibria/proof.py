"""All equilibria for given inputs, or for all inputs of a range, with proof.

Blocks are solved one after the other, each for every root of those before; a root's bounds are
what the following block is given, so that all that is proved holds for the root itself. An input
may be an interval: then a number of equilibria is proved for each of its values.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import casadi as ca
import numpy as np
import numpy.typing as npt

from trms_cli.core.arrays import BoolArray, FloatArray
from trms_cli.core.errors import ModelError
from trms_cli.stability.equilibria.rest_system import EquationBlock, RestSystem
from trms_cli.stability.intervals.enclosure import Enclosure
from trms_cli.stability.intervals.interval import Interval

IntArray = npt.NDArray[np.int64]

#: Halvings of a box in which the mobility may have to be shown regular.
_REGULARITY_CUTS = 14
#: What has no bounds is searched to here (in its unit); beyond, bounds of the equations alone.
FAR = 1e6
_INFLATION = 1.2
_ROUNDS = 400
#: Boxes of one problem at once, by unknowns; a problem with more is given up as undecided.
_MOST_BOXES = {1: 256, 2: 1024}
_MOST_BOXES_OF_MORE = 4096
#: The same where a doubt ends it: a range that needs more is cut instead.
_MOST_BOXES_IN_RANGES = 96


class BlockEquations:
    """``g_b`` of a block over boxes.

    Given are all unknowns z (those of blocks before are read) and v, side by side, as intervals:
    what is proved holds for each of their values.

    Parameters
    ----------
    system : RestSystem
    block : EquationBlock
    """

    def __init__(self, system: RestSystem, block: EquationBlock) -> None:
        self.n = len(block.unknowns)
        n_z, n_v = system.n, len(system.given)
        own, given = ca.SX.sym("own", self.n), ca.SX.sym("given", n_z + n_v)
        p = ca.SX.sym("p", len(system.model.parameters))
        z = given[:n_z]
        for k, j in enumerate(block.unknowns):
            z[j] = own[k]
        g = system.residual(z, given[n_z:], p)[list(block.rows)]
        slopes = ca.densify(ca.jacobian(g, own))
        (g, slopes), constants, bounds = _constants_apart([g, slopes], p, system)
        self._constants = bounds
        arguments = [own, given, constants]
        self._values = Enclosure(ca.Function("values", arguments, [g]))
        self._both = Enclosure(ca.Function("both", arguments, [g, slopes]))

    def values(self, own: Interval, given: Interval) -> Interval:
        """g over boxes, (m, n)."""
        return self._values(own, given, self._constants)[0]

    def with_slopes(self, own: Interval, given: Interval) -> tuple[Interval, Interval]:
        """g over boxes, (m, n), and its slopes in the block's unknowns, (m, n, n)."""
        g, slopes = self._both(own, given, self._constants)
        return g, slopes if slopes.lower.ndim == 3 else slopes[:, :, None]


class PointBounds:
    """Bounds of the whole state and the commands over boxes of z and v.

    Parameters
    ----------
    system : RestSystem
    """

    def __init__(self, system: RestSystem) -> None:
        z, v = ca.SX.sym("z", system.n), ca.SX.sym("v", len(system.given))
        p = ca.SX.sym("p", len(system.model.parameters))
        state, commands, _ = system.point(z, v, p)
        expressions, constants, self._constants = _constants_apart([state, commands], p, system)
        self._function = Enclosure(ca.Function("point", [z, v, constants], expressions))

    def __call__(self, z: Interval, v: Interval) -> tuple[Interval, Interval]:
        """x, (m, n_x), and u, (m, n_u)."""
        state, commands = self._function(z, v, self._constants)
        return state, commands


def is_regular(system: RestSystem, box: Interval, v: Interval) -> bool:
    """Whether nothing that the rows of a system were divided by is zero in a box of its unknowns.

    ``box``: (n,); infinite where there is no bound. ``v``: (n_v,).
    """
    z, given = ca.SX.sym("z", system.n), ca.SX.sym("v", len(system.given))
    p = ca.SX.sym("p", len(system.model.parameters))
    (w,), constants, bounds = _constants_apart([system.nonzero(z, given, p)], p, system)
    read = [j for j in range(system.n) if ca.depends_on(w, z[j])] if w.numel() else []
    enclosure = Enclosure(ca.Function("nonzero", [z, given, constants], [w]))
    boxes = box[None, :]
    for _ in range(_REGULARITY_CUTS):
        bounds_there = enclosure(boxes, v, bounds)[0]
        doubtful = np.any(bounds_there.contains_zero() | ~np.isfinite(bounds_there.width), axis=1)
        if not doubtful.any():
            return True
        boxes = boxes[doubtful]
        for j in read:
            if not np.all(np.isfinite(boxes.width[:, j])):
                return False
            first, second = boxes.upper.copy(), boxes.lower.copy()
            first[:, j] = second[:, j] = boxes.middle[:, j]
            boxes = Interval(
                np.concatenate([boxes.lower, second]), np.concatenate([first, boxes.upper])
            )
    return False


def _constants_apart(
    expressions: list[ca.SX], p: ca.SX, system: RestSystem
) -> tuple[list[ca.SX], ca.SX, Interval]:
    """Expressions with what depends on parameters alone as constants, and the constants' bounds."""
    shapes = [e.shape for e in expressions]
    together = ca.cse(ca.vertcat(*(ca.vec(e) for e in expressions)))
    symbols: list[ca.SX] = []
    parts: list[ca.SX] = []
    if p.numel():
        together, symbols, parts = ca.extract_parametric(together, p)
    enclosure = Enclosure(ca.Function("constants", [p], [ca.vertcat(p, *parts)]))
    bounds = enclosure(Interval.point(system.model.parameters.values))[0]
    dense, at = [], 0
    for rows, columns in shapes:
        dense.append(ca.densify(ca.reshape(together[at : at + rows * columns], rows, columns)))
        at += rows * columns
    return dense, ca.vertcat(p, *symbols), bounds[0]


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
    progress = _Progress(equations.n)
    left: set[int] = set()
    for _ in range(_ROUNDS):
        if not len(owner):
            break
        queue, owner = _round(equations, queue, owner, given, tolerance, progress)
        queue, owner = _within_budget(queue, owner, progress, groups is not None)
        if groups is not None:
            left.update(g for own, _ in progress.undecided for g in groups[own].tolist())
            sure = ~np.isin(groups[owner], list(left))
            queue, owner = queue[sure], owner[sure]
    if len(owner):
        progress.undecided.append((owner, queue))
    roots = _result(
        equations, progress, given, box, tolerance, np.array(sorted(left), dtype=np.int64)
    )
    return replace(roots, open_ended=open_ended)


class _Progress:
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
    progress: _Progress,
) -> tuple[Interval, IntArray]:
    """One test of every box, and the boxes that are left."""
    half = 0.5 * _INFLATION * queue.width + 1e-300
    tested = Interval(queue.middle - half, queue.middle + half)
    step = newton(equations, tested, given[owner])
    alive = step.possible & np.all(step.image.meets(queue), axis=1)
    proved = alive & step.unique
    progress.proved.append((owner[proved], tested[proved]))
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
    progress.undecided.append((owner[small], contracted[small]))
    stalled = np.all(contracted.width > 0.7 * before.width, axis=1)[~small]
    contracted, owner, slopes = contracted[~small], owner[~small], slopes[~small]
    halves = _cut(contracted[stalled], slopes[stalled], tolerance)
    queue = Interval(
        np.concatenate([contracted.lower[~stalled], halves.lower]),
        np.concatenate([contracted.upper[~stalled], halves.upper]),
    )
    owner = np.concatenate([owner[~stalled], owner[stalled], owner[stalled]])
    return queue, owner


def _inside(boxes: Interval, owner: IntArray, domains: Interval, owners: IntArray) -> BoolArray:
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
    queue: Interval, owner: IntArray, progress: _Progress, in_ranges: bool
) -> tuple[Interval, IntArray]:
    """Give up the problems that have too many boxes."""
    if not len(owner):
        return queue, owner
    most = _MOST_BOXES.get(progress.n, _MOST_BOXES_OF_MORE)
    over = (np.bincount(owner) > (_MOST_BOXES_IN_RANGES if in_ranges else most))[owner]
    if over.any():
        progress.undecided.append((owner[over], queue[over]))
    return queue[~over], owner[~over]


def _result(
    equations: BlockEquations,
    progress: _Progress,
    given: Interval,
    box: Interval,
    tolerance: FloatArray,
    left: IntArray,
) -> Roots:
    owner, domain = progress.together(progress.proved)
    tight = refined(equations, domain, given[owner])
    owner, domain, tight, certain = _distinct(owner, domain, tight)
    small_owner, small = progress.together(progress.undecided)
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


_REFINEMENTS = 120


@dataclass(frozen=True)
class IntervalNewtonStep:
    """Of the interval Newton operator on boxes: what it tells, and its image."""

    possible: BoolArray  #: whether a root is not excluded
    unique: BoolArray  #: whether there is exactly one
    image: Interval  #: holds every root of the box
    slopes: Interval  #: bounds of g' over it


def newton(equations: BlockEquations, box: Interval, given: Interval) -> IntervalNewtonStep:
    """One step on boxes (m, n), for what is given (m, n_given)."""
    g, slopes = equations.with_slopes(box, given)
    centre = centre_of(box)
    at_centre = equations.values(Interval.point(centre), given)
    away = Interval.point(box.lower) - Interval.point(centre)
    away = Interval(away.lower, (Interval.point(box.upper) - Interval.point(centre)).upper)
    if equations.n == 1:
        return _one_unknown(equations, box, given, (g, slopes), (centre, at_centre, away))
    possible = np.all(g.contains_zero(), axis=1)
    possible &= np.all((at_centre + _times(slopes, away)).contains_zero(), axis=1)
    inverse = _inverses(slopes.middle)
    deviation = _deviation(inverse, slopes)
    shift = _times(Interval.point(inverse), at_centre)
    image = Interval.point(centre) - shift + _times(deviation, away)
    unique = np.all(image.within(box), axis=1)
    return IntervalNewtonStep(possible, unique, image, slopes)


def _one_unknown(
    equations: BlockEquations,
    box: Interval,
    given: Interval,
    over: tuple[Interval, Interval],
    about: tuple[FloatArray, Interval, Interval],
) -> IntervalNewtonStep:
    (g, slopes), (centre, at_centre, away) = over, about
    slope = slopes[:, :, 0]
    monotonic = ~slope.contains_zero()[:, 0]
    possible = (g.contains_zero() & (at_centre + slope * away).contains_zero())[:, 0]
    low = _signs(equations.values(Interval.point(box.lower), given))
    high = _signs(equations.values(Interval.point(box.upper), given))
    unique = monotonic & (low * high < 0)
    possible &= ~(monotonic & (low * high > 0))
    image = box.intersection(_newton_image(centre, at_centre, slope))
    return IntervalNewtonStep(possible, unique, image, slopes)


def _newton_image(centre: FloatArray, at_centre: Interval, slope: Interval) -> Interval:
    with np.errstate(invalid="ignore", over="ignore"):
        return Interval.point(centre) - at_centre / slope


def centre_of(box: Interval) -> FloatArray:
    """The middle; of a box with very different ends of one sign, in orders of magnitude."""
    near = np.minimum(np.abs(box.lower), np.abs(box.upper))
    far = box.magnitude
    sign = np.where(box.upper > 0, 1.0, -1.0)
    wide = ((box.lower >= 0) | (box.upper <= 0)) & (far > 16.0 * np.maximum(near, 1.0))
    return np.where(wide, sign * np.sqrt(np.maximum(near, 1.0) * far), box.middle)


def _signs(values: Interval) -> FloatArray:
    """−1, 1, or 0 where the sign is not certain."""
    return np.where(values.lower[:, 0] > 0, 1.0, np.where(values.upper[:, 0] < 0, -1.0, 0.0))


def _times(matrix: Interval, vector: Interval) -> Interval:
    total: Interval | None = None
    for j in range(vector.lower.shape[1]):
        term = matrix[:, :, j] * vector[:, None, j]
        total = term if total is None else total + term
    assert total is not None
    return total


def _inverses(matrices: FloatArray) -> FloatArray:
    """Approximate inverses; zero where there is none, which proves nothing."""
    usable = np.all(np.isfinite(matrices), axis=(1, 2))
    matrices = np.where(usable[:, None, None], matrices, 0.0)
    size = np.where(usable, np.abs(matrices).max(axis=(1, 2)), 1.0)
    usable &= np.abs(np.linalg.det(matrices / np.where(size > 0, size, 1.0)[:, None, None])) > 1e-14
    inverses = np.zeros_like(matrices)
    inverses[usable] = np.linalg.inv(matrices[usable])
    return inverses


def _deviation(inverse: FloatArray, slopes: Interval) -> Interval:
    """``I − Y g'``."""
    n = inverse.shape[1]
    identity = np.broadcast_to(np.eye(n), inverse.shape)
    total = Interval.point(identity)
    for k in range(n):
        left = Interval.point(np.repeat(inverse[:, :, k, None], n, axis=2))
        right = Interval(
            np.repeat(slopes.lower[:, None, k, :], n, axis=1),
            np.repeat(slopes.upper[:, None, k, :], n, axis=1),
        )
        total = total - left * right
    return total


def refined(equations: BlockEquations, box: Interval, given: Interval) -> Interval:
    """Boxes (m, n) with one proved root each, made as tight as they get."""
    active = np.arange(len(box.lower))
    lower, upper = box.lower.copy(), box.upper.copy()
    rises = np.zeros(len(active))
    if equations.n == 1 and len(active):
        rises = _signs(equations.values(Interval.point(upper), given))
    for _ in range(_REFINEMENTS):
        if not len(active):
            break
        now = Interval(lower[active], upper[active])
        image = now.intersection(_smaller(equations, now, given[active], rises[active]))
        sound = np.all(image.lower <= image.upper, axis=1)
        lower[active[sound]], upper[active[sound]] = image.lower[sound], image.upper[sound]
        shrunk = np.any(image.width < 0.8 * now.width, axis=1)
        active = active[sound & shrunk]
    return Interval(lower, upper)


def _smaller(
    equations: BlockEquations, box: Interval, given: Interval, rises: FloatArray
) -> Interval:
    """The image of a box with one root; of one unknown also the side of its centre."""
    if equations.n > 1:
        return newton(equations, box, given).image
    _, slopes = equations.with_slopes(box, given)
    centre = centre_of(box)
    at_centre = equations.values(Interval.point(centre), given)
    image = _newton_image(centre, at_centre, slopes[:, :, 0])
    side = (_signs(at_centre) * rises)[:, None]
    return Interval(
        np.where(side < 0, np.maximum(image.lower, centre), image.lower),
        np.where(side > 0, np.minimum(image.upper, centre), image.upper),
    )


def changes_sign(equations: BlockEquations, box: Interval, given: Interval) -> BoolArray:
    """Whether one equation has ends of opposite signs: at least one root."""
    if equations.n > 1:
        return np.zeros(len(box.lower), dtype=bool)
    low = _signs(equations.values(Interval.point(box.lower), given))
    high = _signs(equations.values(Interval.point(box.upper), given))
    return np.asarray(low * high < 0)


#: A box is cut no further when it is this share of its unknown's scale.
_SHARE_AT_POINTS = 1e-9
_SHARE_OVER_RANGES = 2e-4
#: Parts of a range that are tried before the rest is left untold, by the largest block.
_MOST_RANGES = {1: 600}
_MOST_RANGES_OF_MORE = 200


@dataclass(frozen=True)
class EnclosedEquilibrium:
    """Bounds around one equilibrium, or around a place where one could not be told."""

    z: Interval  #: (n,), of the unknowns
    x: Interval  #: (n_x,), (n_u,)
    u: Interval  #: (n_x,), (n_u,)
    unique: bool  #: Whether exactly one equilibrium is proved to lie within
    exists: bool  #: Whether at least one is


@dataclass(frozen=True)
class Proof:
    """All equilibria in a box for one input, or for each input of a small range."""

    given: Interval  #: (n_v,)
    enclosed: tuple[EnclosedEquilibrium, ...]
    open_ended: bool  #: Whether equilibria with a state beyond 1e6 are not excluded

    @property
    def complete(self) -> bool:
        """Whether the number of equilibria is proved."""
        return all(one.unique for one in self.enclosed)

    @property
    def count(self) -> int | None:
        """How many there are, where that is proved."""
        return len(self.enclosed) if self.complete else None

    @property
    def proved(self) -> tuple[EnclosedEquilibrium, ...]:
        return tuple(one for one in self.enclosed if one.unique)

    @property
    def undecided(self) -> tuple[EnclosedEquilibrium, ...]:
        return tuple(one for one in self.enclosed if not one.unique)


class Prover:
    """Finds and proves equilibria of one system in one box.

    Parameters
    ----------
    system : RestSystem
    box : Interval
        (n,), of its unknowns, infinite where there is no bound.
    scale : (n,) array
        Size of each unknown that counts.

    Raises
    ------
    ModelError
        If the equations cannot be shown to be regular in the box.
    """

    def __init__(self, system: RestSystem, box: Interval, scale: FloatArray) -> None:
        self.system, self.box, self.scale = system, box, scale
        self._blocks = [BlockEquations(system, block) for block in system.blocks]
        self._point = PointBounds(system)
        idle = Interval.point(np.zeros(len(system.given)))
        if not is_regular(system, box, idle):
            raise ModelError(
                f"the equations of model {system.model.name!r} may be singular somewhere in the "
                "box: an inertia, or the yaw of a beam that stands upright",
                where="study.box",
                remedy="give a smaller box, as study.box.alpha_v=[-1,1]",
            )

    def at(self, v: npt.ArrayLike) -> list[Proof]:
        """Proofs for inputs and torques, (m, n_v)."""
        given = Interval.point(np.atleast_2d(v))
        all_ = self._solve(given, _SHARE_AT_POINTS, whole=True)
        x, u = self._point(all_.z, given[all_.owner]) if len(all_.owner) else (all_.z, all_.z)
        proofs: list[list[EnclosedEquilibrium]] = [[] for _ in given.lower]
        for k, one in enumerate(all_.owner):
            known = bool(all_.unique[k]), bool(all_.exists[k])
            proofs[one].append(EnclosedEquilibrium(all_.z[k], x[k], u[k], *known))
        return [Proof(given[k], tuple(own), all_.open_ended) for k, own in enumerate(proofs)]

    def counts(self, lower: npt.ArrayLike, upper: npt.ArrayLike) -> list[int | None]:
        """How many equilibria there are for every input between bounds, (m, n_v) each.

        None where that could not be told.
        """
        given = Interval.of(lower, upper)
        solutions = self._solve(given, _SHARE_OVER_RANGES, whole=False)
        numbers: list[int | None] = np.bincount(
            solutions.owner, minlength=len(given.lower)
        ).tolist()
        for one in solutions.doubtful:
            numbers[one] = None
        return numbers

    def _solve(self, v: Interval, share: float, whole: bool) -> _Solutions:
        """Unless the ``whole`` is asked for, a problem is left at its first doubt."""
        m, n = len(v.lower), self.system.n
        owner = np.arange(m)
        z = Interval.point(np.zeros((m, n)))
        unique, exists, open_ended = np.ones(m, dtype=bool), np.ones(m, dtype=bool), False
        doubtful: list[int] = []
        for block, equations in zip(self.system.blocks, self._blocks, strict=True):
            columns = list(block.unknowns)
            given = Interval(
                np.concatenate([z.lower, v.lower[owner]], axis=1),
                np.concatenate([z.upper, v.upper[owner]], axis=1),
            )
            tolerance = share * self.scale[columns]
            groups = None if whole else owner
            roots = isolate(equations, self.box[columns], given, tolerance, groups)
            before = roots.owner
            lower, upper = z.lower[before], z.upper[before]
            lower[:, columns], upper[:, columns] = roots.box.lower, roots.box.upper
            z, owner = Interval(lower, upper), owner[before]
            unique = unique[before] & roots.unique
            exists = exists[before] & roots.exists
            open_ended |= roots.open_ended
            if not whole:
                doubtful += np.unique([*owner[~unique], *roots.left]).astype(int).tolist()
                sure = ~np.isin(owner, doubtful)
                z, owner, unique, exists = z[sure], owner[sure], unique[sure], exists[sure]
        return _Solutions(owner, z, unique, exists, tuple(doubtful), open_ended)


@dataclass(frozen=True)
class _Solutions:
    """Of many problems at once."""

    owner: IntArray
    z: Interval
    unique: BoolArray
    exists: BoolArray
    doubtful: tuple[int, ...]  #: problems that were left at a doubt
    open_ended: bool


@dataclass(frozen=True)
class RangePiece:
    """A part of a range of one input, in which the number of equilibria is proved or not."""

    lower: float  #: ends of the input
    upper: float  #: ends of the input
    count: int | None  #: For every input of it; None where it could not be told


def over_range(
    prover: Prover, v: FloatArray, index: int, bounds: tuple[float, float], resolution: float
) -> tuple[RangePiece, ...]:
    """Numbers of equilibria for every value of one input.

    The range is cut where a number cannot be told, down to the resolution.

    Parameters
    ----------
    v : (n_v,) array
        The other inputs, and torques.
    index : int
        Position of the input in v.
    resolution : float
        In the input's unit.
    """
    edges = np.linspace(*bounds, 33)
    waiting = list(zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True))
    pieces: list[RangePiece] = []
    tried = 0
    largest = max((len(block.rows) for block in prover.system.blocks), default=1)
    most = _MOST_RANGES.get(largest, _MOST_RANGES_OF_MORE)
    while waiting:
        lower, upper = np.tile(v, (len(waiting), 1)), np.tile(v, (len(waiting), 1))
        lower[:, index], upper[:, index] = np.array(waiting).T
        following: list[tuple[float, float]] = []
        for (a, b), count in zip(waiting, prover.counts(lower, upper), strict=True):
            if count is None and b - a > resolution:
                following += [(a, 0.5 * (a + b)), (0.5 * (a + b), b)]
            else:
                pieces.append(RangePiece(a, b, count))
        tried += len(waiting)
        if tried > most:
            pieces += [RangePiece(a, b, None) for a, b in following]
            break
        waiting = following
    return _merged(sorted(pieces, key=lambda piece: piece.lower))


def _merged(pieces: list[RangePiece]) -> tuple[RangePiece, ...]:
    merged: list[RangePiece] = []
    for piece in pieces:
        if merged and merged[-1].count == piece.count:
            merged[-1] = RangePiece(merged[-1].lower, piece.upper, piece.count)
        else:
            merged.append(piece)
    return tuple(merged)
