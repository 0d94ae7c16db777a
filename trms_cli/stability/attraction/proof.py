"""The level up to which V is proved to fall, by interval branch and bound.

For a level c it is shown, in coordinates y = T z in which V is about \\|z\\|², that

1. V̇ < 0 in a small box N around the equilibrium but at the equilibrium itself. With ∇V(y) = H y and
   f(y) = A y, both H and A averages of second and first derivatives over a segment and so within
   known bounds, V̇ = yᵀ Hᵀ A y, and the symmetric part of Hᵀ A is negative definite for all of them;
2. in every box that covers the rest of a large box Z, V̇ < 0 or V > c;
3. in every box that touches the edge of Z, V > c.

Then no motion leaves {V ≤ c} ∩ Z, for it would have to cross V = c where V falls, or the edge of Z
where V > c; the set is compact and V falls in all of it but at the equilibrium, to which therefore
every motion tends (LaSalle). Nothing is asked of V elsewhere.

Boxes are taken lowest V first, so that the search may stop at any time: all below the lowest box
that is still open is proved. Everything is rounded outwards, and holds for the exact equilibrium.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca
import numpy as np
import numpy.typing as npt

from trms_cli.stability.attraction.definite import corners, positive_definite, product
from trms_cli.stability.attraction.functions import Candidate
from trms_cli.stability.attraction.level_set import SampledLevel
from trms_cli.stability.intervals.enclosure import Enclosure
from trms_cli.stability.intervals.interval import Interval

FloatArray = npt.NDArray[np.float64]

#: Boxes that are halved at once.
_BATCH = 1024
#: A box narrower than this share of Z is not halved again.
_NARROWEST = 2.0**-16
#: Sides of Z beyond those of the sampled level set.
_BEYOND = 1.05
#: Parts of the segments over which slopes are averaged.
_PARTS = 8


@dataclass(frozen=True)
class LevelProof:
    """What branch and bound proved."""

    level: float  #: V falls in {V < level}, which is attracted; 0 where nothing is proved
    boxes: int  #: That were looked at
    complete: bool  #: Whether all boxes up to the level that was proposed are closed
    inner: float  #: Size of the box N as a share of Z
    frame: FloatArray  #: (n, n) array; T: Z is the image of the unit cube


def proved_level(
    candidate: Candidate,
    sampled: SampledLevel,
    most: int,
    share: float = 1.0,
    tell: Callable[[str], None] | None = None,
) -> LevelProof:
    """Prove as much of a sampled level set as a number of boxes allows.

    Parameters
    ----------
    candidate : Candidate
    sampled : SampledLevel
        Its level set: no more is tried.
    most : int
        Boxes.
    share : float
        Of the sampled level that is tried: the level itself is where V̇ = 0.
    """
    search = _Search(candidate, sampled)
    inner = search.inner()
    if inner == 0.0:
        return LevelProof(0.0, 0, False, 0.0, search.T)
    target = share * sampled.level
    n = candidate.system.n
    lower, upper = -np.ones((1, n)), np.ones((1, n))
    value, falls = search.bounds(lower, upper)
    count = 1
    stuck = np.inf
    while len(lower) and count < most:
        # Only what lies below the lowest box that cannot be closed is worth the trouble.
        wanted = value < min(target, stuck)
        lower, upper, value, falls = lower[wanted], upper[wanted], value[wanted], falls[wanted]
        if not len(lower):
            break
        size = min(_BATCH, len(lower))
        order = np.argpartition(value, size - 1)
        first, rest = order[:size], order[size:]
        low, high = _halved(lower[first], upper[first])
        found, fall = search.bounds(low, high)
        count += len(low)
        edge = np.any((low <= -1.0) | (high >= 1.0), axis=1)
        core = np.all((low >= -inner) & (high <= inner), axis=1)
        open_ = ~core & (edge | ~fall) & (found < target)
        narrow = open_ & ((high - low).max(axis=1) < 2.0 * _NARROWEST)
        stuck = min(stuck, float(found[narrow].min(initial=np.inf)))
        open_ &= ~narrow
        lower, upper = np.vstack([lower[rest], low[open_]]), np.vstack([upper[rest], high[open_]])
        value, falls = (
            np.concatenate([value[rest], found[open_]]),
            np.concatenate([falls[rest], fall[open_]]),
        )
        if tell and count // (32 * _BATCH) != (count - len(low)) // (32 * _BATCH):
            done = max(0.0, float(value.min(initial=target))) / target
            tell(f"{count} boxes, proved to {done:.0%} of the level")
    reached = min(target, stuck, float(value.min(initial=np.inf)))
    return LevelProof(max(reached, 0.0), count, reached >= target, inner, search.T)


def frame(candidate: Candidate, sampled: SampledLevel) -> FloatArray:
    """T of a cube around the sampled level set, in the axes of V's second derivative, (n, n)."""
    value, vectors = np.linalg.eigh(candidate.P)
    root = vectors / np.sqrt(np.maximum(value, 1e-12 * value[-1]))
    reach = np.abs(np.linalg.solve(root, sampled.edge.T)).max(axis=1)
    return np.asarray(root * (_BEYOND * reach))


def _halved(lower: FloatArray, upper: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Both halves of boxes, cut across the longest side."""
    row, axis = np.arange(len(lower)), np.argmax(upper - lower, axis=1)
    middle = 0.5 * (lower[row, axis] + upper[row, axis])
    below, above = upper.copy(), lower.copy()
    below[row, axis] = middle
    above[row, axis] = middle
    return np.vstack([lower, above]), np.vstack([below, upper])


class _Search:
    """Bounds of V and V̇ in coordinates in which Z is the unit cube."""

    def __init__(self, candidate: Candidate, sampled: SampledLevel) -> None:
        system = candidate.system
        self.T = frame(candidate, sampled)
        self._candidate, self._error = candidate, system.error
        z, e = system.symbols()
        y = ca.DM(self.T) @ z
        both = ca.Function("both", [z, e], [ca.vertcat(*candidate.both(y, e))])
        self._both = Enclosure(both)
        self._hessian = Enclosure(ca.Function("H", [z, e], [candidate.hessian(y, e)]))
        self._slopes = Enclosure(ca.Function("A", [z, e], [system.slopes(y, e)]))

    def bounds(self, lower: FloatArray, upper: FloatArray) -> tuple[FloatArray, np.ndarray]:
        """Lower bounds of V, and whether V̇ < 0 is proved, in each box."""
        box = Interval(lower, upper)
        rough = self._both(box, self._error)[0]
        value, falls = rough.lower[:, 0].copy(), rough.upper[:, 1] < 0.0
        left = np.flatnonzero(~falls)
        if len(left):
            fine = self._both.mean_value(box[left], self._error)
            value[left], falls[left] = fine.lower[:, 0], fine.upper[:, 1] < 0.0
        return np.where(np.isnan(value), -np.inf, value), falls

    def inner(self) -> float:
        """Size of the largest cube N, a power of two, in which the first step holds; 0 for none."""
        size = 1.0
        while size > 1e-9:
            if self._falls_in(size):
                return size
            size *= 0.5
        return 0.0

    def _falls_in(self, size: float) -> bool:
        n = self._candidate.system.n
        r = np.nextafter(size * (np.arange(_PARTS) + 1.0) / _PARTS, np.inf)[:, None]
        box = Interval(-r * np.ones(n), r * np.ones(n))
        H = _mean(_square(self._hessian(box, self._error)[0]))
        A = corners(_mean(_square(self._slopes(box, self._error)[0]))[0])
        T = Interval.point(self.T[None])
        turned = _turned(H)
        inside = product(_turned(T), product(turned, product(A, T)))
        return bool(np.all(positive_definite(-inside)))


def _square(found: Interval) -> Interval:
    """A matrix of one row and column is a matrix."""
    return found if found.lower.ndim == 3 else found[:, :, None]


def _turned(matrix: Interval) -> Interval:
    return Interval(matrix.lower.transpose(0, 2, 1), matrix.upper.transpose(0, 2, 1))


def _mean(parts: Interval) -> Interval:
    total = parts[0]
    for k in range(1, _PARTS):
        total = total + parts[k]
    return (total * Interval.point(np.full(total.lower.shape, 1.0 / _PARTS)))[None]
