"""All equilibria for given inputs, or for all inputs of a range, with proof.

Equations of rest are solved block by block, each for every root of those before; a root's bounds
are what the following block is given, so that all that is proved holds for the root itself. An
input may be an interval: then a number of equilibria is proved for each of its values.

All roots of a block in a box are found by branch and prune. A box is thrown away when bounds of the
equations over it exclude zero, or when the image of the interval Newton operator has nothing in
common with it. The operator also tells which boxes hold exactly one root, for each value of what is
given. Of one unknown a slope that is nowhere zero and ends of opposite signs prove it (Bolzano); of
several the Krawczyk operator ``K(Z) = c − Y g(c) + (I − Y g'(Z))(Z − c)`` in the interior of Z
(Krawczyk 1969; Moore, Kearfott & Cloud 2009, ch. 8; Neumaier 1990, ch. 5).

All else is cut in two, until it is as small as the tolerance: what is left then is undecided, and
told so. Boxes are tested a little larger than they are, so that a root on the border of two is
found. The equations must be continuous; where they have a kink (a coefficient for each direction)
the bounds of the slopes hold the slopes of both sides.
"""

from dataclasses import dataclass
from itertools import groupby, pairwise, product

import casadi as ca
import numpy as np
import numpy.typing as npt

from trms_cli.core.arrays import BoolArray, FloatArray, IntArray
from trms_cli.core.errors import ModelError
from trms_cli.stability.equilibria.rest_system import EquationBlock, RestSystem
from trms_cli.stability.intervals.branch_and_bound import halve_boxes, join_boxes
from trms_cli.stability.intervals.enclosure import Enclosure
from trms_cli.stability.intervals.interval import Interval

#: A box is cut no further when it is this share of its unknown's scale.
_SHARE_AT_POINTS = 1e-9
_SHARE_OVER_RANGES = 2e-4
#: Parts of a range that are tried before the rest is left untold, by the largest block.
_MOST_RANGES = {1: 600}
_MOST_RANGES_OF_MORE = 200
#: Halvings of a box in which the mobility may have to be shown regular.
_REGULARITY_CUTS = 14
#: What has no bounds is searched to here (in its unit); beyond, bounds of the equations alone.
FAR = 1e6
_INFLATION = 1.2
_ROUNDS = 400
_REFINEMENTS = 120
#: Boxes of one problem at once, by unknowns; a problem with more is given up as undecided.
_MOST_BOXES = {1: 256, 2: 1024}
_MOST_BOXES_OF_MORE = 4096
#: The same where a doubt ends it: a range that needs more is cut instead.
_MOST_BOXES_IN_RANGES = 96


class BlockEquations:
    """``g_b`` of a block over boxes.

    Its knowns are all unknowns z (those of blocks before are read) and v, side by side, as
    intervals: what is proved holds for each of their values.
    """

    def __init__(self, system: RestSystem, block: EquationBlock) -> None:
        self.n = len(block.unknowns)
        n_z, n_v = system.n, len(system.knowns)
        own, knowns = ca.SX.sym("own", self.n), ca.SX.sym("knowns", n_z + n_v)
        p = ca.SX.sym("p", len(system.model.parameters))
        z = knowns[:n_z]
        for k, j in enumerate(block.unknowns):
            z[j] = own[k]
        g = system.residual(z, knowns[n_z:], p)[list(block.rows)]
        slopes = ca.densify(ca.jacobian(g, own))
        (g, slopes), constants, self._constants = _constants_apart([g, slopes], p, system)
        arguments = [own, knowns, constants]
        self._values = Enclosure(ca.Function("values", arguments, [g]))
        self._both = Enclosure(ca.Function("both", arguments, [g, slopes]))

    def values(self, own: Interval, knowns: Interval) -> Interval:
        """g over boxes, (m, n)."""
        return self._values(own, knowns, self._constants)[0]

    def with_slopes(self, own: Interval, knowns: Interval) -> tuple[Interval, Interval]:
        """g over boxes, (m, n), and its slopes in the block's unknowns, (m, n, n)."""
        g, slopes = self._both.matrices(own, knowns, self._constants)
        return g[:, :, 0], slopes


def is_regular(system: RestSystem, box: Interval, v: Interval) -> bool:
    """Whether nothing that the rows of a system were divided by is zero in a box of its unknowns.

    ``box``: (n,); infinite where there is no bound. ``v``: (n_v,).
    """
    z, inputs = ca.SX.sym("z", system.n), ca.SX.sym("v", len(system.knowns))
    p = ca.SX.sym("p", len(system.model.parameters))
    (w,), constants, bounds = _constants_apart([system.nonzero(z, inputs, p)], p, system)
    read = [j for j in range(system.n) if ca.depends_on(w, z[j])] if w.numel() else []
    enclosure = Enclosure(ca.Function("nonzero", [z, inputs, constants], [w]))
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
            boxes = halve_boxes(boxes, j)
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
    """Roots of many problems."""

    owner: IntArray  #: (r,) int array; problem that each belongs to
    box: Interval  #: (r, n), around each
    unique: BoolArray  #: (r,) bool array; whether exactly one root is proved to lie in it
    exists: BoolArray  #: (r,) bool array; whether at least one is proved to
    open_ended: bool  #: Whether roots beyond :data:`FAR` are not excluded
    undecided: IntArray  #: (k,) int array; groups that were left at a doubt


def isolate(
    equations: BlockEquations,
    box: Interval,
    knowns: Interval,
    tolerance: FloatArray,
    groups: IntArray | None = None,
) -> Roots:
    """All roots in a box (n,), infinite where there is no bound, for each of many problems.

    A problem is a row of ``knowns``, (m, n_knowns); a box is no longer cut below the tolerance,
    (n,). Problems of one number in ``groups``, (m,), are left together as soon as there is a doubt
    in one of them; what was found of them until then is not all there is.
    """
    count = len(knowns.lower)
    starts, tails = _starts(box)
    open_ended = False
    if len(tails.lower):
        problem = np.repeat(np.arange(count), len(tails.lower))
        many = Interval(np.tile(tails.lower, (count, 1)), np.tile(tails.upper, (count, 1)))
        with np.errstate(invalid="ignore", over="ignore"):
            values = equations.values(many, knowns[problem])
        open_ended = not np.all(np.any(~values.contains_zero(), axis=1))
    owner = np.repeat(np.arange(count), len(starts.lower))
    queue = Interval(np.tile(starts.lower, (count, 1)), np.tile(starts.upper, (count, 1)))
    most = _MOST_BOXES.get(equations.n, _MOST_BOXES_OF_MORE)
    search = _Search(
        equations, knowns, tolerance, most if groups is None else _MOST_BOXES_IN_RANGES
    )
    doubtful_groups: set[int] = set()
    for _ in range(_ROUNDS):
        if not len(owner):
            break
        queue, owner = search.round(queue, owner)
        if groups is not None:
            doubtful_groups.update(g for own, _ in search.undecided for g in groups[own].tolist())
            sure = ~np.isin(groups[owner], list(doubtful_groups))
            queue, owner = queue[sure], owner[sure]
    if len(owner):
        search.undecided.append((owner, queue))
    return Roots(*search.roots(box), open_ended, np.array(sorted(doubtful_groups), dtype=np.int64))


def _starts(box: Interval) -> tuple[Interval, Interval]:
    """The boxes that a search begins with, and those that reach to infinity."""
    sides: list[list[tuple[float, float]]] = []
    for low, high in zip(box.lower.tolist(), box.upper.tolist(), strict=True):
        near = (max(low, -FAR), min(high, FAR))
        # Coefficients change with the direction: nothing has a kink but at zero.
        cuts = [near[0], 0.0, near[1]] if near[0] < 0.0 < near[1] else list(near)
        below = [(low, -FAR)] if low < -FAR else []
        sides.append([*pairwise(cuts), *below, *([(FAR, high)] if high > FAR else [])])
    whole = np.array(list(product(*sides))).reshape(-1, len(sides), 2)
    boxes = Interval(whole[:, :, 0], whole[:, :, 1])
    inner = np.all((boxes.lower >= -FAR) & (boxes.upper <= FAR), axis=1)
    return boxes[inner], boxes[~inner]


class _Search:
    """The boxes of a search that are proved or undecided so far, with whom they belong to."""

    def __init__(
        self, equations: BlockEquations, knowns: Interval, tolerance: FloatArray, most: int
    ) -> None:
        self.equations, self.knowns, self.tolerance, self.most = equations, knowns, tolerance, most
        none = np.zeros(0, dtype=np.int64), Interval.point(np.zeros((0, equations.n)))
        self.proved: list[tuple[IntArray, Interval]] = [none]
        self.undecided: list[tuple[IntArray, Interval]] = [none]

    def round(self, queue: Interval, owner: IntArray) -> tuple[Interval, IntArray]:
        """One test of every box, and the boxes that are left."""
        half = 0.5 * _INFLATION * queue.width + 1e-300
        tested = Interval(queue.middle - half, queue.middle + half)
        step = newton(self.equations, tested, self.knowns[owner])
        alive = step.possible & np.all(step.image.meets(queue), axis=1)
        proved = alive & step.unique
        self.proved.append((owner[proved], tested[proved]))
        is_open = alive & ~proved
        if proved.any():
            is_open &= ~_inside(queue, owner, tested[proved], owner[proved])
        contracted = queue.intersection(step.image)[is_open]
        before, owner = queue[is_open], owner[is_open]
        slopes = step.slopes[is_open]
        small = np.all(contracted.width <= self.tolerance, axis=1)
        # What cannot be cut at its middle any more.
        stuck = (contracted.middle <= contracted.lower) | (contracted.middle >= contracted.upper)
        small |= np.all(stuck, axis=1)
        self.undecided.append((owner[small], contracted[small]))
        stalled = np.all(contracted.width > 0.7 * before.width, axis=1)[~small]
        contracted, owner, slopes = contracted[~small], owner[~small], slopes[~small]
        halves = self._bisect(contracted[stalled], slopes[stalled])
        queue = join_boxes(contracted[~stalled], halves)
        owner = np.concatenate([owner[~stalled], owner[stalled], owner[stalled]])
        # Problems that have too many boxes are given up.
        over = (np.bincount(owner) > self.most)[owner]
        self.undecided.append((owner[over], queue[over]))
        return queue[~over], owner[~over]

    def _bisect(self, box: Interval, slopes: Interval) -> Interval:
        """Both halves of each box, cut where the equations change most."""
        if not len(box.lower):
            return box
        with np.errstate(invalid="ignore", over="ignore"):
            change = slopes.magnitude * box.width[:, None, :]
            change /= np.maximum(change.max(axis=2, keepdims=True), 1e-300)
        weight = np.where(np.isfinite(change), change, 1.0).sum(axis=1) + 1e-3
        side = np.argmax(np.where(box.width > self.tolerance, weight, -1.0), axis=1)
        return halve_boxes(box, side, centre_of(box))

    def roots(self, box: Interval) -> tuple[IntArray, Interval, BoolArray, BoolArray]:
        """What was found within a box: as the first fields of :class:`Roots`."""
        owner, domain = _together(self.proved)
        tight = refine_boxes(self.equations, domain, self.knowns[owner])
        owner, domain, tight, certain = _distinct(owner, domain, tight)
        small_owner, small = _together(self.undecided)
        outside = ~_inside(small, small_owner, domain, owner)
        small_owner, small = _clusters(small_owner[outside], small[outside], self.tolerance)
        # A cluster may hold a root that lay on the border of all its boxes.
        half = small.width + self.tolerance
        tested = Interval(small.middle - half, small.middle + half)
        proved = np.zeros(len(small_owner), dtype=bool)
        exists = proved.copy()
        if len(small_owner):
            step = newton(self.equations, tested, self.knowns[small_owner])
            keep = step.possible
            proved, small_owner = step.unique[keep], small_owner[keep]
            small = small[keep].intersection(step.image[keep])
            ends = _end_signs(self.equations, tested[keep], self.knowns[small_owner])
            exists = proved | (ends < 0)
        everything = join_boxes(tight, small)
        owner = np.concatenate([owner, small_owner])
        unique, exists = np.concatenate([certain, proved]), np.concatenate([certain, exists])
        # What lies outside is not asked for; what lies on the edge cannot be told.
        meets = np.all(everything.meets(box), axis=1)
        whole = np.all((everything.lower >= box.lower) & (everything.upper <= box.upper), axis=1)
        order = np.lexsort((everything.middle[:, 0], owner))
        order = order[meets[order]]
        return owner[order], everything[order], (unique & whole)[order], (exists & whole)[order]


def _together(parts: list[tuple[IntArray, Interval]]) -> tuple[IntArray, Interval]:
    return np.concatenate([owner for owner, _ in parts]), join_boxes(*(box for _, box in parts))


def _inside(boxes: Interval, owner: IntArray, domains: Interval, owners: IntArray) -> BoolArray:
    """Whether each box lies in a domain of its problem."""
    same = owner[:, None] == owners[None, :]
    lower = np.all(domains.lower[None, :, :] <= boxes.lower[:, None, :], axis=2)
    upper = np.all(boxes.upper[:, None, :] <= domains.upper[None, :, :], axis=2)
    return np.asarray(np.any(same & lower & upper, axis=1))


def _distinct(
    owner: IntArray, domain: Interval, tight: Interval
) -> tuple[IntArray, Interval, Interval, BoolArray]:
    """One of each root that was proved more than once, and whether it is told from the others."""

    def within(one: Interval, other: Interval) -> bool:
        return bool(np.all((other.lower <= one.lower) & (one.upper <= other.upper)))

    keep: dict[int, bool] = {}
    for i in range(len(owner)):
        touching = []
        for j in (j for j in keep if owner[j] == owner[i]):
            if within(tight[i], domain[j]) or within(tight[j], domain[i]):
                break
            if np.all(tight[i].meets(tight[j])):
                touching.append(j)
        else:
            keep[i] = not touching
        keep.update(dict.fromkeys(touching, False))
    indices = list(keep)
    return (
        owner[indices],
        domain[indices],
        tight[indices],
        np.array(list(keep.values()), dtype=bool),
    )


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
    ends = np.array(hulls).reshape(-1, 2, boxes.lower.shape[1])
    return np.array(owners, dtype=np.int64), Interval(ends[:, 0], ends[:, 1])


@dataclass(frozen=True)
class IntervalNewtonStep:
    """Of the interval Newton operator on boxes: what it tells, and its image."""

    possible: BoolArray  #: whether a root is not excluded
    unique: BoolArray  #: whether there is exactly one
    image: Interval  #: holds every root of the box
    slopes: Interval  #: bounds of g' over it


def newton(equations: BlockEquations, box: Interval, knowns: Interval) -> IntervalNewtonStep:
    """One step on boxes (m, n), for the knowns (m, n_knowns)."""
    g, slopes = equations.with_slopes(box, knowns)
    centre = centre_of(box)
    at_centre = equations.values(Interval.point(centre), knowns)
    away = box - Interval.point(centre)
    possible = np.all(g.contains_zero(), axis=1)
    possible &= np.all((at_centre + _times(slopes, away)).contains_zero(), axis=1)
    if equations.n == 1:
        monotonic = ~slopes.contains_zero()[:, 0, 0]
        ends = _end_signs(equations, box, knowns)
        possible &= ~(monotonic & (ends > 0))
        image = box.intersection(_newton_image(centre, at_centre, slopes))
        return IntervalNewtonStep(possible, monotonic & (ends < 0), image, slopes)
    inverse = _inverses(slopes.middle)
    shift = _times(Interval.point(inverse), at_centre)
    image = Interval.point(centre) - shift + _times(_deviation(inverse, slopes), away)
    return IntervalNewtonStep(possible, np.all(image.within(box), axis=1), image, slopes)


def _newton_image(centre: FloatArray, at_centre: Interval, slopes: Interval) -> Interval:
    """Of one unknown."""
    with np.errstate(invalid="ignore", over="ignore"):
        return Interval.point(centre) - at_centre / slopes[:, :, 0]


def centre_of(box: Interval) -> FloatArray:
    """The middle; of a box with very different ends of one sign, in orders of magnitude."""
    near = np.minimum(np.abs(box.lower), np.abs(box.upper))
    far = box.magnitude
    sign = np.where(box.upper > 0, 1.0, -1.0)
    wide = ((box.lower >= 0) | (box.upper <= 0)) & (far > 16.0 * np.maximum(near, 1.0))
    return np.where(wide, sign * np.sqrt(np.maximum(near, 1.0) * far), box.middle)


def _signs(values: Interval) -> FloatArray:
    """Of one equation: −1, 1, or 0 where it is not certain."""
    return np.where(values.lower[:, 0] > 0, 1.0, np.where(values.upper[:, 0] < 0, -1.0, 0.0))


def _end_signs(equations: BlockEquations, box: Interval, knowns: Interval) -> FloatArray:
    """The product of the signs at both ends; −1: at least one root. 0 of several equations."""
    if equations.n > 1:
        return np.zeros(len(box.lower))
    low, high = (equations.values(Interval.point(at), knowns) for at in (box.lower, box.upper))
    return _signs(low) * _signs(high)


def _times(matrix: Interval, vector: Interval) -> Interval:
    return (matrix @ vector[:, :, None])[:, :, 0]


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
    total = Interval.point(np.broadcast_to(np.eye(inverse.shape[1]), inverse.shape))
    for k in range(inverse.shape[1]):
        total = total - Interval.point(inverse[:, :, k, None]) * slopes[:, None, k, :]
    return total


def refine_boxes(equations: BlockEquations, box: Interval, knowns: Interval) -> Interval:
    """Boxes (m, n) with one proved root each, made as tight as they get."""
    active = np.arange(len(box.lower))
    lower, upper = box.lower.copy(), box.upper.copy()
    rises = np.zeros(len(active))
    if equations.n == 1 and len(active):
        rises = _signs(equations.values(Interval.point(upper), knowns))
    for _ in range(_REFINEMENTS):
        if not len(active):
            break
        now = Interval(lower[active], upper[active])
        image = now.intersection(_smaller(equations, now, knowns[active], rises[active]))
        sound = np.all(image.lower <= image.upper, axis=1)
        lower[active[sound]], upper[active[sound]] = image.lower[sound], image.upper[sound]
        shrunk = np.any(image.width < 0.8 * now.width, axis=1)
        active = active[sound & shrunk]
    return Interval(lower, upper)


def _smaller(
    equations: BlockEquations, box: Interval, knowns: Interval, rises: FloatArray
) -> Interval:
    """The image of a box with one root; of one unknown also the side of its centre."""
    if equations.n > 1:
        return newton(equations, box, knowns).image
    _, slopes = equations.with_slopes(box, knowns)
    centre = centre_of(box)
    at_centre = equations.values(Interval.point(centre), knowns)
    image = _newton_image(centre, at_centre, slopes)
    side = (_signs(at_centre) * rises)[:, None]
    return Interval(
        np.where(side < 0, np.maximum(image.lower, centre), image.lower),
        np.where(side > 0, np.minimum(image.upper, centre), image.upper),
    )


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

    knowns: Interval  #: (n_v,)
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

    ``box``: (n,), of its unknowns, infinite where there is no bound. ``scale``: (n,); size of each
    unknown that counts. Raises ModelError if the equations cannot be shown to be regular there.
    """

    def __init__(self, system: RestSystem, box: Interval, scale: FloatArray) -> None:
        self.system, self.box, self.scale = system, box, scale
        self._blocks = [BlockEquations(system, block) for block in system.blocks]
        z, v = ca.SX.sym("z", system.n), ca.SX.sym("v", len(system.knowns))
        p = ca.SX.sym("p", len(system.model.parameters))
        point = list(system.point(z, v, p)[:2])
        expressions, constants, self._constants = _constants_apart(point, p, system)
        self._point = Enclosure(ca.Function("point", [z, v, constants], expressions))
        if not is_regular(system, box, Interval.point(np.zeros(len(system.knowns)))):
            raise ModelError(
                f"the equations of model {system.model.name!r} may be singular somewhere in the "
                "box: an inertia, or the yaw of a beam that stands upright",
                where="study.box",
                remedy="give a smaller box, as study.box.alpha_v=[-1,1]",
            )

    def at(self, v: npt.ArrayLike) -> list[Proof]:
        """Proofs for inputs and torques, (m, n_v)."""
        inputs = Interval.point(np.atleast_2d(v))
        roots, x, u = self._solve(inputs, _SHARE_AT_POINTS, whole=True), inputs, inputs
        if len(roots.owner):
            x, u = self._point(roots.box, inputs[roots.owner], self._constants)
        proofs: list[list[EnclosedEquilibrium]] = [[] for _ in inputs.lower]
        for k, one in enumerate(roots.owner):
            flags = bool(roots.unique[k]), bool(roots.exists[k])
            proofs[one].append(EnclosedEquilibrium(roots.box[k], x[k], u[k], *flags))
        return [Proof(inputs[k], tuple(own), roots.open_ended) for k, own in enumerate(proofs)]

    def counts(self, lower: npt.ArrayLike, upper: npt.ArrayLike) -> list[int | None]:
        """How many equilibria each input between bounds, (m, n_v), has; None: it was not told."""
        inputs = Interval.of(lower, upper)
        roots = self._solve(inputs, _SHARE_OVER_RANGES, whole=False)
        numbers = np.bincount(roots.owner, minlength=len(inputs.lower)).tolist()
        return [None if k in roots.undecided else number for k, number in enumerate(numbers)]

    def _solve(self, v: Interval, share: float, whole: bool) -> Roots:
        """Unless the ``whole`` is asked for, a problem is left at its first doubt."""
        m, n = len(v.lower), self.system.n
        owner = np.arange(m)
        z = Interval.point(np.zeros((m, n)))
        unique, exists, open_ended = np.ones(m, dtype=bool), np.ones(m, dtype=bool), False
        doubtful: set[int] = set()
        for block, equations in zip(self.system.blocks, self._blocks, strict=True):
            columns = list(block.unknowns)
            knowns = Interval(
                np.concatenate([z.lower, v.lower[owner]], axis=1),
                np.concatenate([z.upper, v.upper[owner]], axis=1),
            )
            tolerance = share * self.scale[columns]
            groups = None if whole else owner
            roots = isolate(equations, self.box[columns], knowns, tolerance, groups)
            before = roots.owner
            lower, upper = z.lower[before], z.upper[before]
            lower[:, columns], upper[:, columns] = roots.box.lower, roots.box.upper
            z, owner = Interval(lower, upper), owner[before]
            unique = unique[before] & roots.unique
            exists = exists[before] & roots.exists
            open_ended |= roots.open_ended
            if not whole:
                doubtful |= {*owner[~unique].tolist(), *roots.undecided.tolist()}
                sure = ~np.isin(owner, list(doubtful))
                z, owner, unique, exists = z[sure], owner[sure], unique[sure], exists[sure]
        doubtful_groups = np.array(sorted(doubtful), dtype=np.int64)
        return Roots(owner, z, unique, exists, open_ended, doubtful_groups)


@dataclass(frozen=True)
class RangePiece:
    """A part of a range of one input, in which the number of equilibria is proved or not."""

    lower: float  #: ends of the input
    upper: float  #: ends of the input
    count: int | None  #: For every input of it; None where it could not be told


def over_range(
    prover: Prover, v: FloatArray, index: int, bounds: tuple[float, float], resolution: float
) -> tuple[RangePiece, ...]:
    """Numbers of equilibria for every value of one input, of position ``index`` in v, (n_v,).

    The range is cut where a number cannot be told, down to the resolution, in the input's unit.
    """
    edges = np.linspace(*bounds, 33)
    waiting = list(zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True))
    pieces: list[RangePiece] = []
    range_count = 0
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
        range_count += len(waiting)
        if range_count > most:
            pieces += [RangePiece(a, b, None) for a, b in following]
            break
        waiting = following
    pieces.sort(key=lambda piece: piece.lower)
    merged = [list(own) for _, own in groupby(pieces, key=lambda piece: piece.count)]
    return tuple(RangePiece(own[0].lower, own[-1].upper, own[0].count) for own in merged)
