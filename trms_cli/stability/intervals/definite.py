"""Definiteness of symmetric matrices whose entries are only known to lie in intervals.

A symmetric matrix M is positive definite if a floating point Cholesky factorisation of M − s I
succeeds, where s outweighs the rounding of the factorisation (Rump, "Verification of positive
definiteness", BIT 46, 2006) and the norm of what is uncertain in M. The bound used,
s = ‖radius‖_∞ + 4 (n + 2) ε trace M, is above Rump's.
"""

from __future__ import annotations

import itertools

import numpy as np

from trms_cli.core.arrays import BoolArray, FloatArray
from trms_cli.stability.intervals.interval import Interval

#: Entries whose both ends are taken in turn; 2¹² matrices are factorised in some ten ms.
MOST_ENTRIES = 12


def positive_definite(matrix: Interval) -> BoolArray:
    """Whether all symmetric matrices within bounds (m, n, n) are proved positive definite, (m,).

    Bounds that are not symmetric stand for the symmetric part.
    """
    half = Interval.point(np.full_like(matrix.lower, 0.5))
    both = (matrix + matrix.transposed) * half
    finite = np.all(np.isfinite(both.lower) & np.isfinite(both.upper), axis=(1, 2))
    with np.errstate(invalid="ignore", over="ignore"):
        middle = np.where(finite[:, None, None], 0.5 * (both.lower + both.upper), 0.0)
    middle = 0.5 * (middle + middle.transpose(0, 2, 1))
    radius = np.maximum(both.upper - middle, middle - both.lower) * (1.0 + 1e-12)
    n = middle.shape[1]
    trace = np.abs(np.trace(middle, axis1=1, axis2=2))
    with np.errstate(invalid="ignore"):
        norm = radius.sum(axis=2).max(axis=1) * (1.0 + 1e-12)
    shift = norm + 4.0 * (n + 2) * np.finfo(float).eps * trace
    found = np.zeros(len(middle), dtype=bool)
    candidates = finite & np.isfinite(shift)
    least = np.full(len(middle), -np.inf)
    shift = np.where(candidates, shift, 0.0)
    least[candidates] = np.linalg.eigvalsh(middle[candidates])[:, 0]
    # The eigenvalues only sort out what would make the factorisation fail.
    for k in np.flatnonzero(least > shift):
        try:
            np.linalg.cholesky(middle[k] - shift[k] * np.eye(n))
        except np.linalg.LinAlgError:
            continue
        found[k] = True
    return found


def definite(matrix: Interval) -> tuple[BoolArray, BoolArray]:
    """Which matrices (m, n, n) are proved positive definite, and which middles seem to be.

    Of many matrices at once: TᵀQT with T from the Cholesky factor of the middle is near the unit
    matrix, and positive definite if its rows are diagonally dominant (Gershgorin).
    """
    middle = np.nan_to_num(matrix.middle, nan=0.0, posinf=0.0, neginf=0.0)
    least = np.linalg.eigvalsh(middle)[:, 0]
    positive = least > 0.0
    proved = np.zeros(len(middle), dtype=bool)
    if positive.any():
        factor = np.linalg.cholesky(middle[positive])
        turn = Interval.point(np.linalg.inv(factor))
        unit = turn @ matrix[positive] @ turn.transposed
        diagonal = np.einsum("mii->mi", unit.lower)
        sizes = unit.magnitude
        beside = sizes.sum(axis=2) - np.einsum("mii->mi", sizes)
        # The sum rounds by less than this share.
        proved[positive] = (diagonal > beside * (1.0 + 1e-12)).all(axis=1)
    return proved, positive


def corners(bounds: Interval, most: int = MOST_ENTRIES) -> Interval:
    """Matrices (2^k, n, n) that span an interval matrix (n, n): the ends of its uncertain entries.

    They are points but where more than ``most`` entries are uncertain: the narrowest of those stay
    intervals. The hull of the matrices is the whole interval matrix.
    """
    width = bounds.upper - bounds.lower
    size = np.maximum(np.abs(bounds.lower), np.abs(bounds.upper))
    certain = width <= 1e-9 * size.max(initial=1e-300)
    order = np.argsort(np.where(certain, 0.0, width), axis=None)[::-1]
    chosen = [k for k in order[:most] if not certain.flat[k]]
    count = 2 ** len(chosen)
    lower = np.broadcast_to(bounds.lower.ravel(), (count, bounds.lower.size)).copy()
    upper = np.broadcast_to(bounds.upper.ravel(), (count, bounds.upper.size)).copy()
    ends = np.array(list(itertools.product((False, True), repeat=len(chosen))))
    for column, k in enumerate(chosen):
        value = np.where(ends[:, column], bounds.upper.flat[k], bounds.lower.flat[k])
        lower[:, k] = upper[:, k] = value
    shape = (count, *bounds.lower.shape)
    return Interval(lower.reshape(shape), upper.reshape(shape))


def decays(P: FloatArray, bounds: Interval) -> bool:
    """Whether yᵀPy is proved to fall along ẏ = A(y) y for all A(y) within bounds (n, n).

    Linear in A, it holds for all of them if it holds at the corners: AᵀP + PA ≺ 0.
    """
    A = corners(bounds)
    weight = Interval.point(P[None])
    return bool(np.all(positive_definite(-(A.transposed @ weight + weight @ A))))


def inside_slab(P: FloatArray, level: float, row: FloatArray) -> bool:
    """Whether {yᵀPy ≤ level} is proved to lie in \\|row · y\\| < 1: P − level row rowᵀ ≻ 0."""
    column = Interval.point(row[:, None]) * Interval.point(row[None])
    scaled = column * Interval.point(np.full_like(P, level))
    return bool(positive_definite((Interval.point(P) - scaled)[None])[0])
