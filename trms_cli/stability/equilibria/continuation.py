"""Curves of equilibria: multi-start and pseudo-arclength continuation.

Equilibria are looked for from many starts at several inputs; through each runs a curve, which is
followed both ways by its tangent and a Newton correction across it (Keller 1977), through folds,
where an input reaches its extreme, as through any other point. A curve ends where an input or a
state leaves its range.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from scipy.stats import qmc

from trms_cli.models.model import names
from trms_cli.stability.equilibria.curve_equations import CurveEquations

FloatArray = npt.NDArray[np.float64]

#: Scaled lengths.
_FIRST_STEP, _LONGEST_STEP, _SHORTEST_STEP = 0.01, 0.03, 1e-8
#: Largest angle between two tangents, rad.
_TURN = 0.12
_MOST_POINTS = 4000
_SEED = 20260


@dataclass(frozen=True)
class Curve:
    """A curve of equilibria, in order along it."""

    y: FloatArray  #: (m, n + 1) array; unknowns and the varied input
    ends: tuple[str, str]  #: Why it ends at its beginning and its end
    #: Points after which another curve may cross: a regular curve has none
    crossings: tuple[int, ...] = field(default=())


def starts(equations: CurveEquations, inputs: FloatArray, count: int) -> list[FloatArray]:
    """Equilibria from many starts, at each of some inputs (m,)."""
    low = np.where(np.isfinite(equations.lower), equations.lower, -4.0 * equations.scale)[:-1]
    high = np.where(np.isfinite(equations.upper), equations.upper, 4.0 * equations.scale)[:-1]
    found: list[FloatArray] = []
    shares = qmc.Sobol(max(equations.n, 1), seed=_SEED).random(count)
    for value in inputs:
        for share in shares:
            guess = np.append(low + share[: equations.n] * (high - low), value)
            y = equations.pinned(guess, equations.n, float(value))
            if y is None or not equations.inside(y):
                continue
            if not any(same(equations, y, other) for other in found):
                found.append(y)
    return found


def same(equations: CurveEquations, one: FloatArray, other: FloatArray) -> bool:
    """Whether two points are one."""
    return bool(np.abs((one - other) / equations.scale).max() < 1e-6)


def curves_through(equations: CurveEquations, seeds: list[FloatArray]) -> list[Curve]:
    """The curves through some points, each once."""
    found: list[Curve] = []
    for seed in seeds:
        if any(_on(equations, curve, seed) for curve in found):
            continue
        found.append(curve_through(equations, seed))
    return found


def at_input(equations: CurveEquations, curve: Curve, value: float) -> list[FloatArray]:
    """The points of a curve at a value of the varied input."""
    return crossings_of(equations, curve, equations.n, value)


def crossings_of(
    equations: CurveEquations, curve: Curve, index: int, value: float
) -> list[FloatArray]:
    """The points of a curve at which one coordinate has a value."""
    along = curve.y[:, index] - value
    found: list[FloatArray] = []
    for k in np.flatnonzero(along[:-1] * along[1:] <= 0):
        a, b = along[k], along[k + 1]
        share = 0.0 if a == b else a / (a - b)
        guess = curve.y[k] + share * (curve.y[k + 1] - curve.y[k])
        y = equations.pinned(guess, index, value)
        near = 2.0 * np.abs((curve.y[k + 1] - curve.y[k]) / equations.scale).max() + 1e-6
        if y is None or np.abs((y - guess) / equations.scale).max() > near:
            continue
        if not any(same(equations, y, other) for other in found):
            found.append(y)
    return found


def _on(equations: CurveEquations, curve: Curve, seed: FloatArray) -> bool:
    at = at_input(equations, curve, float(seed[-1]))
    return any(same(equations, seed, y) for y in at)


def curve_through(equations: CurveEquations, seed: FloatArray) -> Curve:
    """The whole curve through a point."""
    forward = _traced(equations, seed, equations.tangent(seed))
    if forward.closed:
        return Curve(np.array(forward.y), ("closed", "closed"), tuple(forward.crossings))
    backward = _traced(equations, seed, -equations.tangent(seed))
    y = np.array(backward.y[:0:-1] + forward.y)
    shift = len(backward.y) - 1
    crossings = [shift - 1 - k for k in backward.crossings] + [shift + k for k in forward.crossings]
    if y[0, -1] > y[-1, -1]:
        last = len(y) - 2
        y = y[::-1].copy()
        return Curve(y, (forward.end, backward.end), tuple(last - k for k in crossings))
    return Curve(y, (backward.end, forward.end), tuple(crossings))


@dataclass
class _Trace:
    """A curve on its way in one direction."""

    y: list[FloatArray]
    crossings: list[int]
    end: str = ""
    closed: bool = False


def _traced(equations: CurveEquations, seed: FloatArray, direction: FloatArray) -> _Trace:
    trace = _Trace([seed], [])
    step, tangent, sign = _FIRST_STEP, direction, _orientation(equations, seed, direction)
    while len(trace.y) < _MOST_POINTS:
        here = trace.y[-1]
        guess = here + step * tangent * equations.scale
        y = equations.corrected(guess, tangent)
        # A step that fails is made shorter, down to where only a corner is left to explain it: a
        # dead zone ends, a coefficient changes with the direction.
        corner = step <= 100.0 * _SHORTEST_STEP
        farthest = (20.0 if corner else 0.5) * step
        if y is not None and np.abs((y - guess) / equations.scale).max() <= farthest:
            following = equations.tangent(y, tangent)
            turn = float(np.arccos(np.clip(following @ tangent, -1.0, 1.0)))
            if turn <= _TURN or corner:
                if not equations.inside(y):
                    last = _last_inside(equations, here, y)
                    trace.end = _reason(equations, last)
                    trace.y.append(last)
                    return trace
                orientation = _orientation(equations, y, following)
                if orientation * sign < 0:
                    trace.crossings.append(len(trace.y) - 1)
                sign = orientation
                trace.y.append(y)
                tangent = following
                if len(trace.y) > 10 and _returned(equations, trace.y, seed):
                    trace.closed = True
                    return trace
                step = min(_LONGEST_STEP, step * (1.6 if turn < 0.5 * _TURN else 1.0))
                continue
        step *= 0.5
        if step < _SHORTEST_STEP:
            trace.end = "where it can no longer be followed"
            return trace
    trace.end = "where it was left, after many points"
    return trace


def _orientation(equations: CurveEquations, y: FloatArray, tangent: FloatArray) -> float:
    """Sign of the bordered determinant: it changes where another curve crosses."""
    slopes = equations.residual(y)[1] * equations.scale
    size = np.abs(slopes).max(axis=1, keepdims=True)
    bordered = np.vstack([slopes / np.where(size > 0, size, 1.0), tangent])
    determinant = float(np.linalg.det(bordered))
    return 0.0 if abs(determinant) < 1e-12 else float(np.sign(determinant))


def _returned(equations: CurveEquations, y: list[FloatArray], seed: FloatArray) -> bool:
    before, after = (y[-2] - seed) / equations.scale, (y[-1] - seed) / equations.scale
    gap = np.linalg.norm(after - before)
    return bool(np.linalg.norm(after) < gap and np.linalg.norm(before) < gap)


def _last_inside(equations: CurveEquations, here: FloatArray, beyond: FloatArray) -> FloatArray:
    """Where the curve leaves the box, between two of its points."""
    best = here
    shortest = np.inf
    for index in range(equations.n + 1):
        for bound in (equations.lower[index], equations.upper[index]):
            a, b = here[index] - bound, beyond[index] - bound
            if not np.isfinite(bound) or a * b > 0 or a == b:
                continue
            share = a / (a - b)
            y = equations.pinned(here + share * (beyond - here), index, float(bound))
            if y is not None and equations.inside(y) and share < shortest:
                best, shortest = y, share
    return best


def _reason(equations: CurveEquations, y: FloatArray) -> str:
    """Which bound a point is at."""
    signals = equations.system.unknowns
    for index in range(equations.n, -1, -1):
        for bound in (equations.lower[index], equations.upper[index]):
            if np.isfinite(bound) and abs(y[index] - bound) <= 1e-9 * equations.scale[index]:
                if index == equations.n:
                    return "end of the range"
                return f"{names(signals)[index]} = {bound:.4g} {signals[index].unit}"
    return "edge of the box"
