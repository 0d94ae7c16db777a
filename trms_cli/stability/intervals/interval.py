"""Intervals of real numbers, many at once, rounded outwards.

Every operation returns bounds that hold for all real operands within the given bounds: the four
operations and the square root are rounded one step outwards, where IEEE 754 rounds them to the
nearest; the functions of libm four steps, more than their largest known error. After Moore,
Kearfott & Cloud, "Introduction to Interval Analysis" (SIAM 2009).
"""

from __future__ import annotations

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
            found = _outwards(1.0 / self.upper, 1.0 / self.lower)
        unbounded = self.contains_zero()
        return Interval(
            np.where(unbounded, -np.inf, found.lower), np.where(unbounded, np.inf, found.upper)
        )

    def absolute(self) -> Interval:
        straddles = self.contains_zero()
        low = np.minimum(np.abs(self.lower), np.abs(self.upper))
        return Interval(np.where(straddles, 0.0, low), self.magnitude)

    def square(self) -> Interval:
        size = self.absolute()
        with np.errstate(over="ignore"):
            found = _outwards(size.lower**2, size.upper**2)
        return Interval(np.maximum(found.lower, 0.0), found.upper)

    def square_root(self) -> Interval:
        """Of the part that is not negative."""
        low = np.sqrt(np.maximum(self.lower, 0.0))
        found = _outwards(low, np.sqrt(np.maximum(self.upper, 0.0)))
        return Interval(np.maximum(found.lower, 0.0), found.upper)

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
        found = _outwards(np.minimum(*ends), np.maximum(*ends), _LIBRARY_ERROR)
        high, low = self._has(crest), self._has(crest + math.pi)
        return Interval(
            np.where(low, -1.0, np.maximum(found.lower, -1.0)),
            np.where(high, 1.0, np.minimum(found.upper, 1.0)),
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
