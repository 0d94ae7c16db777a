"""Branches of solutions followed step by step, and curves of ``g(y) = 0`` along their arc.

One loop, :func:`follow`, for all branches: of operating points over a command, of equilibria along
their arc, of periodic orbits. What differs is the attempt at the next place: prediction, correction
and the judgement whether it lies on the same branch.

An :class:`ImplicitCurve` has one unknown more than equations. It is followed both ways by its
tangent and a Newton correction across it (Keller 1977), through folds, where its last coordinate
reaches an extreme, as through any other point. It ends where a coordinate leaves its range.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import TypeVar

import casadi as ca
import numpy as np

from trms_cli.models.model import FloatArray, Signal

Place = TypeVar("Place")

#: Of a Newton step, in units of what counts: converged.
TOLERANCE = 1e-11
_ITERATIONS = 30
#: Scaled lengths.
_FIRST_STEP, _LONGEST_STEP, _SHORTEST_STEP = 0.01, 0.03, 1e-8
#: Largest angle between two tangents, rad.
_TURN = 0.12
_MOST_POINTS = 4000


def follow(
    place: Place,
    attempt: Callable[[Place, float], tuple[Place | None, float]],
    step: float,
    shortest: float,
) -> Iterator[Place]:
    """The places of a branch after one, until steps get shorter than the shortest.

    ``attempt``: (place, step) → the next place, or None where the step was too long; and the length
    of the step after it. ``step``, ``shortest``: the first step, and the shortest one that is
    tried.
    """
    while step >= shortest:
        following, step = attempt(place, step)
        if following is not None:
            place = following
            yield place


@dataclass(frozen=True)
class SolutionCurve:
    """Points of an :class:`ImplicitCurve`, in order along it."""

    y: FloatArray  #: (m, n + 1) array; unknowns, the one that is varied last
    ends: tuple[str, str]  #: Why it ends at its beginning and its end
    #: Points after which another curve may cross: a regular curve has none
    crossings: tuple[int, ...] = field(default=())


class ImplicitCurve:
    """``g(y) = 0``, n equations in n + 1 unknowns; all lengths are in units of what counts of each.

    ``g``, ``y``: (n, 1), (n + 1, 1); the equations and the symbols of their unknowns; the last one
    is varied. ``signals``: what the first n unknowns are. ``lower``, ``upper``, ``scale``: (n +
    1,); range of each unknown, and the size of it that counts.
    """

    def __init__(
        self,
        g: ca.SX,
        y: ca.SX,
        signals: Sequence[Signal],
        lower: FloatArray,
        upper: FloatArray,
        scale: FloatArray,
    ) -> None:
        self.n, self.signals = y.numel() - 1, tuple(signals)
        self.lower, self.upper, self.scale = lower, upper, scale
        slopes = ca.densify(ca.jacobian(g, y))
        self._function = ca.Function("curve", [y], [g, slopes])
        null, reference = ca.SX.sym("null", self.n), ca.SX.sym("reference", self.n)
        flat = ca.vertcat(g, slopes[:, : self.n] @ null, ca.dot(reference, null) - 1.0)
        both = ca.vertcat(y, null)
        jacobian = ca.densify(ca.jacobian(flat, both))
        self._fold = ca.Function("fold", [both, reference], [flat, jacobian])

    def residual(self, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """g, (n,), and its slopes in y, (n, n + 1)."""
        g, slopes = self._function(y)
        return np.array(g)[:, 0], np.array(slopes)

    def tangent(self, y: FloatArray, before: FloatArray | None = None) -> FloatArray:
        """Direction of the curve in scaled units, of length 1, (n + 1,); on in its direction."""
        direction = np.linalg.svd(self._scaled_slopes(y))[2][-1]
        if before is not None and direction @ before < 0:
            direction = -direction
        return np.asarray(direction)

    def corrected(self, guess: FloatArray, along: FloatArray) -> FloatArray | None:
        """The point of a curve in the plane through a guess, (n + 1,), across a direction."""

        def equations(y: FloatArray) -> tuple[FloatArray, FloatArray]:
            g, slopes = self.residual(y)
            across = along @ ((y - guess) / self.scale)
            return np.append(g, across), np.vstack([slopes * self.scale, along])

        y = _newton(equations, guess, self.scale, TOLERANCE)
        return y if y is not None and self._small(y) else None

    def pinned(self, guess: FloatArray, index: int, value: float) -> FloatArray | None:
        """The point with one coordinate given, from a guess near it."""
        along = np.zeros(self.n + 1)
        along[index] = 1.0
        start = guess.copy()
        start[index] = value
        y = self.corrected(start, along)
        if y is not None:
            y[index] = value
        return y

    def fold(self, near: FloatArray) -> FloatArray | None:
        """A fold from a point near it: where the slopes in z, all but the last, have a null vector.

        Newton's method on the system of Moore & Spence (1980, SIAM J. Numer. Anal. 17)::

            g(z, λ) = 0        g_z(z, λ) φ = 0        φ₀ᵀφ = 1
        """
        direction = self._weakest(near)[1]
        null, reference = direction * self.scale[:-1], direction / self.scale[:-1]
        units = np.concatenate([self.scale, np.abs(null).max() * np.ones(self.n)])

        def equations(both: FloatArray) -> tuple[FloatArray, FloatArray]:
            value, jacobian = (np.array(part) for part in self._fold(both, reference))
            return value[:, 0], jacobian * units

        both = _newton(equations, np.concatenate([near, null]), units, 1e-10)
        if both is None:
            return None
        y = both[: self.n + 1]
        close = np.abs((y - near) / self.scale).max() < 0.2
        flat = self._weakest(y)[0] < 1e-8
        return y if close and flat and self._small(y) else None

    def inside(self, y: FloatArray) -> bool:
        """Whether a point is within the ranges, to rounding."""
        slack = 1e-9 * self.scale
        return bool(np.all(y >= self.lower - slack) and np.all(y <= self.upper + slack))

    def same(self, one: FloatArray, other: FloatArray) -> bool:
        """Whether two points are one."""
        return bool(np.abs((one - other) / self.scale).max() < 1e-6)

    def crossings_of(self, curve: SolutionCurve, value: float, index: int = -1) -> list[FloatArray]:
        """The points of a curve at which one coordinate, by default the varied one, has a value."""
        along = curve.y[:, index] - value
        points: list[FloatArray] = []
        for k in np.flatnonzero(along[:-1] * along[1:] <= 0):
            a, b = along[k], along[k + 1]
            share = 0.0 if a == b else a / (a - b)
            guess = curve.y[k] + share * (curve.y[k + 1] - curve.y[k])
            y = self.pinned(guess, index, value)
            near = 2.0 * np.abs((curve.y[k + 1] - curve.y[k]) / self.scale).max() + 1e-6
            if y is None or np.abs((y - guess) / self.scale).max() > near:
                continue
            if not any(self.same(y, other) for other in points):
                points.append(y)
        return points

    def curves_through(self, seeds: Sequence[FloatArray]) -> list[SolutionCurve]:
        """The curves through some points, each once."""
        curves: list[SolutionCurve] = []
        for seed in seeds:
            crossings = (self.crossings_of(c, float(seed[-1])) for c in curves)
            if not any(self.same(seed, y) for points in crossings for y in points):
                curves.append(self.through(seed))
        return curves

    def through(self, seed: FloatArray) -> SolutionCurve:
        """The whole curve through a point, its varied unknown rising from first to last."""
        forward = self._traced(seed, self.tangent(seed))
        if forward.is_closed:
            return SolutionCurve(
                np.array(forward.y), ("closed", "closed"), tuple(forward.crossings)
            )
        backward = self._traced(seed, -self.tangent(seed))
        y = np.array(backward.y[:0:-1] + forward.y)
        shift = len(backward.y) - 1
        crossings = [shift - 1 - k for k in backward.crossings]
        crossings += [shift + k for k in forward.crossings]
        if y[0, -1] > y[-1, -1]:
            last = len(y) - 2
            return SolutionCurve(
                y[::-1].copy(), (forward.end, backward.end), tuple(last - k for k in crossings)
            )
        return SolutionCurve(y, (backward.end, forward.end), tuple(crossings))

    def _traced(self, seed: FloatArray, direction: FloatArray) -> _Trace:
        def attempt(
            place: tuple[FloatArray, FloatArray], step: float
        ) -> tuple[tuple[FloatArray, FloatArray] | None, float]:
            here, tangent = place
            guess = here + step * tangent * self.scale
            y = self.corrected(guess, tangent)
            # A step that fails is made shorter, down to where only a corner is left to explain it:
            # a dead zone ends, a coefficient changes with the direction.
            corner = step <= 100.0 * _SHORTEST_STEP
            farthest = (20.0 if corner else 0.5) * step
            if y is not None and np.abs((y - guess) / self.scale).max() <= farthest:
                following = self.tangent(y, tangent)
                turn = float(np.arccos(np.clip(following @ tangent, -1.0, 1.0)))
                if turn <= _TURN or corner:
                    longer = 1.6 if turn < 0.5 * _TURN else 1.0
                    return (y, following), min(_LONGEST_STEP, step * longer)
            return None, 0.5 * step

        trace = _Trace([seed], [])
        sign = self._orientation(seed, direction)
        for y, tangent in follow((seed, direction), attempt, _FIRST_STEP, _SHORTEST_STEP):
            if not self.inside(y):
                last = self._last_inside(trace.y[-1], y)
                trace.end = self._bound_at(last)
                trace.y.append(last)
                return trace
            orientation = self._orientation(y, tangent)
            if orientation * sign < 0:
                trace.crossings.append(len(trace.y) - 1)
            sign = orientation
            trace.y.append(y)
            if len(trace.y) > 10 and self._returned(trace.y, seed):
                trace.is_closed = True
                return trace
            if len(trace.y) >= _MOST_POINTS:
                trace.end = "where it was left, after many points"
                return trace
        trace.end = "where it can no longer be followed"
        return trace

    def _scaled_slopes(self, y: FloatArray) -> FloatArray:
        """Slopes in scaled units, each row of size one: what is left of a row at a fold counts."""
        slopes = self.residual(y)[1] * self.scale
        size = np.abs(slopes).max(axis=1, keepdims=True)
        return np.asarray(slopes / np.where(size > 0, size, 1.0))

    def _weakest(self, y: FloatArray) -> tuple[float, FloatArray]:
        """Least singular value of the slopes in z, and its direction."""
        _, values, directions = np.linalg.svd(self._scaled_slopes(y)[:, : self.n])
        return float(values[-1]), directions[-1]

    def _small(self, y: FloatArray) -> bool:
        g, slopes = self.residual(y)
        size = (np.abs(slopes) * self.scale).max(axis=1)
        return bool(np.all(np.abs(g) <= 1e-7 * np.where(size > 0, size, 1.0)))

    def _orientation(self, y: FloatArray, tangent: FloatArray) -> float:
        """Sign of the bordered determinant: it changes where another curve crosses."""
        determinant = float(np.linalg.det(np.vstack([self._scaled_slopes(y), tangent])))
        return 0.0 if abs(determinant) < 1e-12 else float(np.sign(determinant))

    def _returned(self, y: list[FloatArray], seed: FloatArray) -> bool:
        before, after = (y[-2] - seed) / self.scale, (y[-1] - seed) / self.scale
        gap = np.linalg.norm(after - before)
        return bool(np.linalg.norm(after) < gap and np.linalg.norm(before) < gap)

    def _last_inside(self, here: FloatArray, beyond: FloatArray) -> FloatArray:
        """Where the curve leaves its ranges, between two of its points."""
        best = here
        shortest = np.inf
        for index in range(self.n + 1):
            for bound in (self.lower[index], self.upper[index]):
                a, b = here[index] - bound, beyond[index] - bound
                if not np.isfinite(bound) or a * b > 0 or a == b:
                    continue
                share = a / (a - b)
                y = self.pinned(here + share * (beyond - here), index, float(bound))
                if y is not None and self.inside(y) and share < shortest:
                    best, shortest = y, share
        return best

    def _bound_at(self, y: FloatArray) -> str:
        for index in range(self.n, -1, -1):
            for bound in (self.lower[index], self.upper[index]):
                if np.isfinite(bound) and abs(y[index] - bound) <= 1e-9 * self.scale[index]:
                    if index == self.n:
                        return "end of the range"
                    return f"{self.signals[index].name} = {bound:.4g} {self.signals[index].unit}"
        return "edge of the box"


@dataclass
class _Trace:
    """A curve on its way in one direction."""

    y: list[FloatArray]
    crossings: list[int]
    end: str = ""
    is_closed: bool = False


def _newton(
    equations: Callable[[FloatArray], tuple[FloatArray, FloatArray]],
    y: FloatArray,
    units: FloatArray,
    tolerance: float,
) -> FloatArray | None:
    """Newton's method until a step is small; the slopes are those in the units, row by row scaled.

    Unlike :func:`trms_cli.models.operating_point.newton` it judges by where the root is, and not by
    what is left: at a fold little is left far from it.
    """
    for _ in range(_ITERATIONS):
        value, matrix = equations(y)
        if not np.all(np.isfinite(matrix)) or not np.all(np.isfinite(value)):
            return None
        size = np.abs(matrix).max(axis=1)
        size = np.where(size > 0, size, 1.0)
        step = np.linalg.lstsq(matrix / size[:, None], value / size, rcond=1e-14)[0]
        y = y - step * units
        if np.abs(step).max() <= tolerance:
            return y
    return None
