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

from trms_cli.core.arrays import FloatArray
from trms_cli.stability.attraction.functions import LyapunovCandidate
from trms_cli.stability.attraction.level_set import SampledLevel
from trms_cli.stability.intervals.branch_and_bound import BoxSearch, branch_and_bound, halved
from trms_cli.stability.intervals.definite import corners, positive_definite
from trms_cli.stability.intervals.enclosure import Enclosure
from trms_cli.stability.intervals.interval import Interval

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
    candidate: LyapunovCandidate,
    sampled: SampledLevel,
    most: int,
    share: float = 1.0,
    tell: Callable[[str], None] | None = None,
) -> LevelProof:
    """Prove as much of a sampled level set as a number of boxes allows.

    A share of the sampled level is tried: on the level itself V̇ = 0.
    """
    search = _Search(candidate, sampled)
    inner = search.inner()
    if inner == 0.0:
        return LevelProof(0.0, 0, False, 0.0, search.T)
    target = share * sampled.level
    stuck, count = np.inf, 1

    def visit(boxes: Interval, keys: FloatArray) -> tuple[Interval, FloatArray, int]:
        nonlocal stuck, count
        # Only what lies below the lowest box that cannot be closed is worth the trouble.
        boxes = boxes[keys < min(target, stuck)]
        halves = halved(boxes, np.argmax(boxes.width, axis=1))
        value, falls = search.bounds(halves)
        edge = np.any((halves.lower <= -1.0) | (halves.upper >= 1.0), axis=1)
        core = np.all((halves.lower >= -inner) & (halves.upper <= inner), axis=1)
        open_ = ~core & (edge | ~falls) & (value < target)
        narrow = open_ & (halves.width.max(axis=1) < 2.0 * _NARROWEST)
        stuck = min(stuck, float(value[narrow].min(initial=np.inf)))
        open_ &= ~narrow
        spent = len(value)
        if tell and (count + spent) // (32 * _BATCH) != count // (32 * _BATCH):
            done = max(0.0, min(target, float(keys.min()))) / target
            tell(f"{count + spent} boxes, proved to {done:.0%} of the level")
        count += spent
        return halves[open_], value[open_], spent

    whole = Interval(-np.ones((1, candidate.system.n)), np.ones((1, candidate.system.n)))
    result = branch_and_bound(
        BoxSearch(whole, search.bounds(whole)[0], 1),
        visit,
        budget=most,
        enough=lambda lowest: lowest >= min(target, stuck),
        chunk=_BATCH,
        whole_chunks=True,
    )
    reached = min(target, stuck, result.lowest)
    return LevelProof(max(reached, 0.0), result.examined, reached >= target, inner, search.T)


def frame(candidate: LyapunovCandidate, sampled: SampledLevel) -> FloatArray:
    """T of a cube around the sampled level set, in the axes of V's second derivative, (n, n)."""
    value, vectors = np.linalg.eigh(candidate.P)
    root = vectors / np.sqrt(np.maximum(value, 1e-12 * value[-1]))
    reach = np.abs(np.linalg.solve(root, sampled.edge.T)).max(axis=1)
    return np.asarray(root * (_BEYOND * reach))


class _Search:
    """Bounds of V and V̇ in coordinates in which Z is the unit cube."""

    def __init__(self, candidate: LyapunovCandidate, sampled: SampledLevel) -> None:
        system = candidate.system
        self.T = frame(candidate, sampled)
        self._candidate, self._error = candidate, system.error
        z, e = system.symbols()
        y = ca.DM(self.T) @ z
        both = ca.Function("both", [z, e], [ca.vertcat(*candidate.both(y, e))])
        self._both = Enclosure(both)
        self._hessian = Enclosure(ca.Function("H", [z, e], [candidate.hessian(y, e)]))
        self._slopes = Enclosure(ca.Function("A", [z, e], [system.slopes(y, e)]))

    def bounds(self, box: Interval) -> tuple[FloatArray, np.ndarray]:
        """Lower bounds of V, and whether V̇ < 0 is proved, in each box."""
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
        H = _square(self._hessian(box, self._error)[0]).mean()[None]
        A = corners(_square(self._slopes(box, self._error)[0]).mean())
        T = Interval.point(self.T[None])
        return bool(np.all(positive_definite(-(T.transposed @ (H.transposed @ (A @ T))))))


def _square(matrices: Interval) -> Interval:
    """A matrix of one row and column is a matrix."""
    return matrices if matrices.lower.ndim == 3 else matrices[:, :, None]
