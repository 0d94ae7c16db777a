"""The interval Newton operator on boxes: what it excludes, what it proves, and its image.

One unknown: a slope that is nowhere zero and ends of opposite signs prove one root (Bolzano).
Several: the Krawczyk operator ``K(Z) = c − Y g(c) + (I − Y g'(Z))(Z − c)`` in the interior of Z
does (Krawczyk 1969; Moore, Kearfott & Cloud 2009, ch. 8; Neumaier 1990, ch. 5).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from trms_cli.stability.equilibria.block_equations import BlockEquations
from trms_cli.stability.intervals.interval import Interval

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

_REFINEMENTS = 120


@dataclass(frozen=True)
class Step:
    """Of the interval Newton operator on boxes: what it tells, and its image."""

    possible: BoolArray  #: whether a root is not excluded
    unique: BoolArray  #: whether there is exactly one
    image: Interval  #: holds every root of the box
    slopes: Interval  #: bounds of g' over it


def newton(equations: BlockEquations, box: Interval, given: Interval) -> Step:
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
    return Step(possible, unique, image, slopes)


def _one_unknown(
    equations: BlockEquations,
    box: Interval,
    given: Interval,
    over: tuple[Interval, Interval],
    about: tuple[FloatArray, Interval, Interval],
) -> Step:
    (g, slopes), (centre, at_centre, away) = over, about
    slope = slopes[:, :, 0]
    monotonic = ~slope.contains_zero()[:, 0]
    possible = (g.contains_zero() & (at_centre + slope * away).contains_zero())[:, 0]
    low = _signs(equations.values(Interval.point(box.lower), given))
    high = _signs(equations.values(Interval.point(box.upper), given))
    unique = monotonic & (low * high < 0)
    possible &= ~(monotonic & (low * high > 0))
    image = box.intersection(_newton_image(centre, at_centre, slope))
    return Step(possible, unique, image, slopes)


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
    found = np.zeros_like(matrices)
    found[usable] = np.linalg.inv(matrices[usable])
    return found


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
