"""Intervals of real numbers, many at once, rounded outwards; and symmetric matrices of them.

Every operation returns bounds that hold for all real operands within the given bounds: the four
operations and the square root are rounded one step outwards, where IEEE 754 rounds them to the
nearest; the functions of libm four steps, more than their largest known error. After Moore,
Kearfott & Cloud, "Introduction to Interval Analysis" (SIAM 2009).

A symmetric matrix M is positive definite if a floating point Cholesky factorisation of M − s I
succeeds, where s outweighs the rounding of the factorisation (Rump, "Verification of positive
definiteness", BIT 46, 2006) and the norm of what is uncertain in M. The bound used,
s = ‖radius‖_∞ + 4 (n + 2) ε trace M, is above Rump's.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from trms_cli.core.arrays import BoolArray, FloatArray

#: Units in the last place that a function of libm may be off, with room to spare.
_LIBRARY_ERROR = 4


@dataclass(frozen=True)
class Interval:
    """An array of intervals."""

    #: ``lower``, ``upper``: arrays of one shape; ``lower <= upper``, infinite where there is no
    #: bound
    lower: FloatArray
    upper: FloatArray

    @classmethod
    def point(cls, value: npt.ArrayLike) -> Interval:
        """Numbers that are known."""
        array = np.array(value, dtype=np.float64)
        return cls(array, array.copy())

    @classmethod
    def of(cls, lower: npt.ArrayLike, upper: npt.ArrayLike) -> Interval:
        """From bounds."""
        return cls(np.array(lower, dtype=np.float64), np.array(upper, dtype=np.float64))

    @property
    def width(self) -> FloatArray:
        return self.upper - self.lower

    @property
    def middle(self) -> FloatArray:
        """A number inside, near the middle; NaN of what has no bounds."""
        with np.errstate(invalid="ignore", over="ignore"):
            return np.asarray(np.clip(0.5 * (self.lower + self.upper), self.lower, self.upper))

    @property
    def magnitude(self) -> FloatArray:
        """The largest absolute value."""
        return np.asarray(np.maximum(np.abs(self.lower), np.abs(self.upper)))

    def contains(self, value: npt.ArrayLike) -> BoolArray:
        """Whether each value lies within."""
        value = np.asarray(value, dtype=np.float64)
        return np.asarray((self.lower <= value) & (value <= self.upper))

    def contains_zero(self) -> BoolArray:
        return self.contains(0.0)

    def within(self, other: Interval) -> BoolArray:
        """Whether each lies in the interior of the other."""
        return np.asarray((other.lower < self.lower) & (self.upper < other.upper))

    def meets(self, other: Interval) -> BoolArray:
        """Whether the two have a number in common."""
        return np.asarray((self.lower <= other.upper) & (other.lower <= self.upper))

    def intersection(self, other: Interval) -> Interval:
        """What both hold; empty ones (see :meth:`meets`) come out with lower > upper."""
        return Interval(np.maximum(self.lower, other.lower), np.minimum(self.upper, other.upper))

    def hull(self, other: Interval) -> Interval:
        """The smallest interval around both."""
        return Interval(np.minimum(self.lower, other.lower), np.maximum(self.upper, other.upper))

    def __getitem__(self, index: Any) -> Interval:
        return Interval(self.lower[index], self.upper[index])

    def __neg__(self) -> Interval:
        return Interval(-self.upper, -self.lower)

    def __add__(self, other: Interval) -> Interval:
        with np.errstate(invalid="ignore", over="ignore"):
            return _outwards(self.lower + other.lower, self.upper + other.upper)

    def __sub__(self, other: Interval) -> Interval:
        with np.errstate(invalid="ignore", over="ignore"):
            return _outwards(self.lower - other.upper, self.upper - other.lower)

    def __mul__(self, other: Interval) -> Interval:
        a, b, c, d = self.lower, self.upper, other.lower, other.upper
        with np.errstate(invalid="ignore", over="ignore"):
            low, high = _ends(a * c, a * d, b * c, b * d)
            if np.isnan(low).any():
                low, high = _ends(_product(a, c), _product(a, d), _product(b, c), _product(b, d))
        return _outwards(low, high)

    def __truediv__(self, other: Interval) -> Interval:
        return self * other.reciprocal()

    def __matmul__(self, other: Interval) -> Interval:
        """Products of (m, n, k) and (m or 1, k, l) matrices."""
        total = self[:, :, 0, None] * other[:, None, 0, :]
        for i in range(1, self.lower.shape[2]):
            total = total + self[:, :, i, None] * other[:, None, i, :]
        return total

    @property
    def transposed(self) -> Interval:
        """Matrices (m, n, k) with rows and columns exchanged."""
        return Interval(self.lower.swapaxes(1, 2), self.upper.swapaxes(1, 2))

    def mean(self) -> Interval:
        """Of parts along the first axis, (m, …) → (…)."""
        total, count = self[0], len(self.lower)
        for k in range(1, count):
            total = total + self[k]
        return total * Interval.point(np.full(total.lower.shape, 1.0 / count))

    def reciprocal(self) -> Interval:
        """1/x; everything where x may be zero."""
        with np.errstate(divide="ignore", over="ignore"):
            quotient = _outwards(1.0 / self.upper, 1.0 / self.lower)
        unbounded = self.contains_zero()
        return Interval(
            np.where(unbounded, -np.inf, quotient.lower),
            np.where(unbounded, np.inf, quotient.upper),
        )

    def absolute(self) -> Interval:
        straddles = self.contains_zero()
        low = np.minimum(np.abs(self.lower), np.abs(self.upper))
        return Interval(np.where(straddles, 0.0, low), self.magnitude)

    def square(self) -> Interval:
        size = self.absolute()
        with np.errstate(over="ignore"):
            result = _outwards(size.lower**2, size.upper**2)
        return Interval(np.maximum(result.lower, 0.0), result.upper)

    def square_root(self) -> Interval:
        """Of the part that is not negative."""
        low = np.sqrt(np.maximum(self.lower, 0.0))
        root = _outwards(low, np.sqrt(np.maximum(self.upper, 0.0)))
        return Interval(np.maximum(root.lower, 0.0), root.upper)

    def power(self, exponent: int) -> Interval:
        """To a whole power from 0 on."""
        if exponent == 0:
            return Interval.point(np.ones_like(self.lower))
        if exponent % 2 == 0:
            half = self.power(exponent // 2)
            return half.square()
        return self if exponent == 1 else self * self.power(exponent - 1)

    def rising(self, function: np.ufunc) -> Interval:
        """A function of libm that rises everywhere: exp, atan, tanh, log…"""
        with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
            low, high = function(self.lower), function(self.upper)
        return _outwards(low, high, _LIBRARY_ERROR)

    def sine(self) -> Interval:
        return self._wave(np.sin, 0.5 * math.pi)

    def cosine(self) -> Interval:
        return self._wave(np.cos, 0.0)

    def _wave(self, function: np.ufunc, crest: float) -> Interval:
        """Sine or cosine, with its crests at ``crest + 2kπ``.

        A crest is taken to be inside as soon as rounding might put it there.
        """
        with np.errstate(invalid="ignore"):
            ends = function(self.lower), function(self.upper)
        hull = _outwards(np.minimum(*ends), np.maximum(*ends), _LIBRARY_ERROR)
        high, low = self._has(crest), self._has(crest + math.pi)
        return Interval(
            np.where(low, -1.0, np.maximum(hull.lower, -1.0)),
            np.where(high, 1.0, np.minimum(hull.upper, 1.0)),
        )

    def _has(self, place: float) -> BoolArray:
        """Whether a number ``place + 2kπ`` may lie within."""
        turn = 2.0 * math.pi
        # Arguments are of the order of a few turns; this slack is far above their rounding.
        slack = 1e-12 * (1.0 + self.magnitude)
        with np.errstate(invalid="ignore"):
            first = np.ceil((self.lower - slack - place) / turn)
            inside = place + first * turn <= self.upper + slack
        return np.asarray(inside | ~np.isfinite(self.lower) | ~np.isfinite(self.upper))


def stack(parts: list[Interval]) -> Interval:
    """Intervals of one shape side by side, along a new last axis."""
    return Interval(
        np.stack([part.lower for part in parts], axis=-1),
        np.stack([part.upper for part in parts], axis=-1),
    )


def _ends(*corners: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The least and the largest; NaN where one is."""
    p, q, r, s = corners
    low = np.minimum(np.minimum(p, q), np.minimum(r, s))
    return low, np.maximum(np.maximum(p, q), np.maximum(r, s))


def _product(a: FloatArray, b: FloatArray) -> FloatArray:
    """a·b, where 0 times infinity is 0: the bound of a product of numbers."""
    return np.where((a == 0.0) | (b == 0.0), 0.0, a * b)


def _outwards(lower: FloatArray, upper: FloatArray, steps: int = 1) -> Interval:
    unknown = np.isnan(lower), np.isnan(upper)
    if unknown[0].any():
        lower = np.where(unknown[0], -np.inf, lower)
    if unknown[1].any():
        upper = np.where(unknown[1], np.inf, upper)
    for _ in range(steps):
        lower, upper = np.nextafter(lower, -np.inf), np.nextafter(upper, np.inf)
    return Interval(np.asarray(lower), np.asarray(upper))


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
    is_definite = np.zeros(len(middle), dtype=bool)
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
        is_definite[k] = True
    return is_definite


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


def corners(bounds: Interval) -> Interval:
    """Matrices (2^k, n, n) that span an interval matrix (n, n): the ends of its uncertain entries.

    They are points but where more than :data:`MOST_ENTRIES` are uncertain: the narrowest of those
    stay intervals. The hull of the matrices is the whole interval matrix.
    """
    width = bounds.upper - bounds.lower
    size = np.maximum(np.abs(bounds.lower), np.abs(bounds.upper))
    certain = width <= 1e-9 * size.max(initial=1e-300)
    order = np.argsort(np.where(certain, 0.0, width), axis=None)[::-1]
    uncertain_entries = [k for k in order[:MOST_ENTRIES] if not certain.flat[k]]
    count = 2 ** len(uncertain_entries)
    lower = np.broadcast_to(bounds.lower.ravel(), (count, bounds.lower.size)).copy()
    upper = np.broadcast_to(bounds.upper.ravel(), (count, bounds.upper.size)).copy()
    ends = np.array(list(itertools.product((False, True), repeat=len(uncertain_entries))))
    for column, k in enumerate(uncertain_entries):
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
