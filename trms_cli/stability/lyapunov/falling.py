"""Up to which level of V its decay is proved: branch and bound in the order of V.

A box of states is done with once Q is positive definite all over it. Always the boxes that reach
deepest are taken next; the deepest one left bounds from below the level up to which V falls

    c* = inf { V(y) : Q(y) not positive definite },

and the lowest middle of a box at which Q is found indefinite bounds it from above.

Definiteness of a matrix of intervals: TᵀQT with T from the Cholesky factor of its middle is
near the unit matrix, and positive definite if its rows are diagonally dominant (Gershgorin).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from trms_cli.stability.intervals.interval import Interval
from trms_cli.stability.lyapunov.proof import halved, joined

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
#: Matrices (m, n, n) over boxes (m, n_y), and (m,) bounds of V.
Matrices = Callable[[Interval], Interval]
Values = Callable[[Interval], Interval]

_CHUNK = 2048
#: The search ends when the bounds of c* are this close to each other.
_CLOSE = 0.01


@dataclass(frozen=True)
class Falling:
    """How far decay reaches."""

    #: Q is proved positive definite where V < level, within the first box; infinite if all over
    level: float
    fails: float  #: V at the lowest state found where Q is not; infinite if there is none
    point: FloatArray | None  #: (n_y,) array or None; that state
    examined: int  #: Boxes bounded


def falling(
    matrices: Matrices,
    values: Values,
    box: Interval,
    most: float,
    budget: int = 20_000,
    *,
    patient: bool = True,
) -> Falling:
    """Bounds of the level up to which Q is positive definite.

    Parameters
    ----------
    matrices : callable
        Q over boxes.
    values : callable
        V over boxes.
    box : Interval
        (n_y,), all states that are asked about.
    most : float
        States with V above it are not asked about.
    budget : int
        Boxes at most.
    patient : bool
        Whether the search goes on below a state found where Q is not definite.
    """
    waiting = Interval(box.lower[None].copy(), box.upper[None].copy())
    lowest = np.atleast_1d(values(waiting).lower)
    fails, point, examined = np.inf, None, 0
    size = np.where(box.width > 0.0, box.width, 1.0)
    while len(lowest) and examined < budget:
        ceiling = min(fails, most)
        if lowest.min() >= (1.0 - _CLOSE) * ceiling:
            break
        order = np.argsort(lowest)[: min(_CHUNK, budget - examined)]
        boxes = waiting[order]
        rest = np.ones(len(lowest), dtype=bool)
        rest[order] = False
        waiting, lowest = waiting[rest], lowest[rest]
        examined += len(order)
        done, middles = definite(matrices(boxes))
        bad = ~middles & ~done
        if bad.any():
            # The middle matrix of the bounds sorts out where to look; the point itself decides.
            places = Interval.point(boxes.middle[bad])
            truly = ~definite(matrices(places))[0]
            levels = np.where(truly, values(places).upper, np.inf)
            if levels.min() < fails:
                best = int(np.argmin(levels))
                fails, point = float(levels[best]), places.lower[best]
        if not patient and fails < most:
            return Falling(0.0, fails, point, examined)
        open_ = boxes[~done]
        if not len(open_.lower):
            continue
        halves = halved(open_, _directions(matrices, open_, size))
        deep = values(halves).lower
        keep = deep < min(fails, most)
        # Boxes above the lowest failure say nothing more about c*.
        waiting = joined(waiting, halves[keep])
        lowest = np.concatenate([lowest, deep[keep]])
    left = float(lowest.min()) if len(lowest) else np.inf
    return Falling(min(left, fails), fails, point, examined)


def definite(matrix: Interval) -> tuple[BoolArray, BoolArray]:
    """Which matrices of intervals are proved positive definite, and which middles seem to be.

    Parameters
    ----------
    matrix : Interval
        (m, n, n), symmetric.

    Returns
    -------
    (m,), (m,) bool
    """
    middle = np.nan_to_num(matrix.middle, nan=0.0, posinf=0.0, neginf=0.0)
    least = np.linalg.eigvalsh(middle)[:, 0]
    positive = least > 0.0
    proved = np.zeros(len(middle), dtype=bool)
    if positive.any():
        factor = np.linalg.cholesky(middle[positive])
        turn = Interval.point(np.linalg.inv(factor))
        back = Interval.point(np.swapaxes(turn.lower, 1, 2))
        unit = _product(_product(turn, matrix[positive]), back)
        diagonal = np.einsum("mii->mi", unit.lower)
        sizes = unit.magnitude
        beside = sizes.sum(axis=2) - np.einsum("mii->mi", sizes)
        # The sum rounds by less than this share.
        proved[positive] = (diagonal > beside * (1.0 + 1e-12)).all(axis=1)
    return proved, positive


def _product(a: Interval, b: Interval) -> Interval:
    total = a[:, :, 0, None] * b[:, None, 0, :]
    for i in range(1, a.lower.shape[2]):
        total = total + a[:, :, i, None] * b[:, None, i, :]
    return total


def _directions(matrices: Matrices, boxes: Interval, size: FloatArray) -> npt.NDArray[np.intp]:
    """The direction that makes most of the width of Q, box by box; the longest where none does.

    Found by collapsing one direction at a time to its middle.
    """
    count, n = boxes.lower.shape
    middle = boxes.middle
    scale = np.sqrt(
        np.maximum(np.einsum("mii->mi", matrices(Interval.point(middle)).upper), 1e-300)
    )
    weight = 1.0 / (scale[:, :, None] * scale[:, None, :])
    whole = _spread(matrices(boxes), weight)
    gain = np.zeros((count, n))
    for j in range(n):
        lower, upper = boxes.lower.copy(), boxes.upper.copy()
        lower[:, j] = upper[:, j] = middle[:, j]
        gain[:, j] = whole - _spread(matrices(Interval(lower, upper)), weight)
    relative = boxes.width / size
    gain = np.where(relative > 1e-9, gain, -np.inf)
    useless = gain.max(axis=1) <= 1e-9 * np.abs(whole)
    return np.where(useless, relative.argmax(axis=1), gain.argmax(axis=1))


def _spread(matrix: Interval, weight: FloatArray) -> FloatArray:
    width = np.nan_to_num(matrix.width, nan=1e300, posinf=1e300)
    return np.asarray((width * weight).sum(axis=(1, 2)))
