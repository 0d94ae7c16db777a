"""Curves of equilibria over one input, found from many starts, with what is special on them.

``y = (z, λ)`` are the unknowns z of :class:`RestSystem` and the varied input λ. On a switch (a
cable that is stiffer to one side) ∂f/∂x is the mean of both sides, which small swings across it
see; :mod:`trms_cli.stability.local.linear` tells why. All studies take the same.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import casadi as ca
import numpy as np
from scipy.stats import qmc

from trms_cli.core.arrays import ComplexArray, FloatArray
from trms_cli.models.continuation import ImplicitCurve, SolutionCurve
from trms_cli.models.operating_point import OperatingPoint
from trms_cli.stability.equilibria.rest_system import RestSystem
from trms_cli.stability.intervals.interval import Interval
from trms_cli.stability.local.linear import Linear, Verdict, modes_of_matrix, parts_of

#: 1/s: growth below this is rounding (a free yaw neither grows nor returns).
GROWTH = 1e-7
_SEED = 20260


@dataclass(frozen=True)
class EquilibriumPoint(OperatingPoint):
    """An equilibrium with its stability."""

    eigenvalues: ComplexArray  #: (n_x,) complex array; of ∂f/∂x there, rightmost first
    unstable: int  #: How many of them grow
    verdict: Verdict  #: ``marginal`` where none grows and one neither grows nor dies out


class CurveEquations(ImplicitCurve):
    """``g(z, λ) = 0`` with the other inputs and torques given, v (n_v,); λ is that at ``varied``.

    ``box``, ``scale``: (n,), of z; ``bounds``: of λ.
    """

    def __init__(
        self,
        system: RestSystem,
        varied: int,
        v: FloatArray,
        box: Interval,
        scale: FloatArray,
        bounds: tuple[float, float],
    ) -> None:
        self.system, self.varied = system, varied
        y = ca.SX.sym("y", system.n + 1)
        given = ca.SX(ca.DM(v))
        given[varied] = y[system.n]
        p = ca.DM(system.model.parameters.values)
        super().__init__(
            system.residual(y[: system.n], given, p),
            y,
            system.unknowns,
            np.append(box.lower, bounds[0]),
            np.append(box.upper, bounds[1]),
            np.append(scale, 0.5 * (bounds[1] - bounds[0])),
        )
        self._point = ca.Function("point", [y], list(system.point(y[: system.n], given, p)))

    def point(self, y: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """x, u and what reaches the motors."""
        x, u, reached = self._point(y)
        return np.array(x)[:, 0], np.array(u)[:, 0], np.array(reached)[:, 0]

    def stability(self, y: FloatArray) -> EquilibriumPoint:
        """A point of a curve with its eigenvalues; y is (n + 1,)."""
        return equilibrium_point(self.system.linear, *self.point(y))

    def starts(self, inputs: FloatArray, count: int) -> list[FloatArray]:
        """Equilibria from many starts, at each of some inputs (m,)."""
        low = np.where(np.isfinite(self.lower), self.lower, -4.0 * self.scale)[:-1]
        high = np.where(np.isfinite(self.upper), self.upper, 4.0 * self.scale)[:-1]
        points: list[FloatArray] = []
        shares = qmc.Sobol(max(self.n, 1), seed=_SEED).random(count)
        for value in inputs:
            for share in shares:
                guess = np.append(low + share[: self.n] * (high - low), value)
                y = self.pinned(guess, self.n, float(value))
                if y is None or not self.inside(y):
                    continue
                if not any(self.same(y, other) for other in points):
                    points.append(y)
        return points


def equilibrium_point(
    linear: Linear, x: FloatArray, u: FloatArray, reached: FloatArray
) -> EquilibriumPoint:
    """An equilibrium with its eigenvalues; ``reached``, (n_u,), is what of u reaches the motors."""
    with np.errstate(invalid="ignore"):
        slopes = linear.a(x, reached)
    if not np.all(np.isfinite(slopes)):
        return EquilibriumPoint(x, u, np.full(len(x), np.nan, dtype=complex), 0, "marginal")
    values = np.linalg.eigvals(slopes).astype(complex)
    values = values[np.argsort(-values.real, kind="stable")]
    unstable, staying = (int(np.sum(values.real > side)) for side in (GROWTH, -GROWTH))
    verdict: Verdict = "unstable" if unstable else "marginal" if staying else "stable"
    if not unstable and staying > 1:
        # Two on the axis may grow as t: their eigenvectors decide.
        verdict = modes_of_matrix(slopes, parts_of(linear.model)).verdict
    return EquilibriumPoint(x, u, values, unstable, verdict)


Kind = Literal["fold", "kink", "oscillation", "exchange", "crossing", "level", "zero"]

_BISECTIONS = 40
#: Scaled distance from a fold of the two nodes between which its own eigenvalue crosses.
_BESIDE = 1e-5


@dataclass(frozen=True)
class Landmark:
    """A special point of a curve."""

    #: ``fold``: the input has an extreme, to rounding. ``kink``: the same where the equations have
    #: a kink, between two points of the curve. ``oscillation``: a pair of eigenvalues crosses the
    #: imaginary axis (Hopf). ``exchange``: a real one does, away from a fold. ``crossing``: another
    #: curve may cross. ``level``: a controlled angle is zero. ``zero``: the input is.
    kind: Kind
    name: str  #: The angle of a level; empty otherwise
    y: FloatArray  #: (n + 1,) array; unknowns and the varied input
    at: EquilibriumPoint
    frequency: float | None = None  #: Hz, of an oscillation


def landmarks(
    equations: CurveEquations, curve: SolutionCurve, points: Sequence[EquilibriumPoint]
) -> list[Landmark]:
    """The special points of a curve, in order along it."""
    folds = _folds(equations, curve)
    marks = list(folds)
    kinks = [place for place, one in folds if one.kind == "kink"]
    for before, after in pairwise(_with_folds(equations, curve, points, folds)):
        more = after.at.unstable - before.at.unstable
        # At a fold one real eigenvalue crosses, between the two nodes beside it. Where a kink is
        # is not known as well.
        folding = abs(more) == 1 and before.beside and after.beside
        kinked = more % 2 == 1 and any(abs(place - before.place) <= 2 for place in kinks)
        if more != 0 and not folding and not kinked:
            marks.append((before.place, _change(equations, before.y, after.y, before.at)))
    for k in curve.crossings:
        if not any(abs(place - k) <= 2 for place, _ in marks):
            y = curve.y[k]
            marks.append((k, Landmark("crossing", "", y, equations.stability(y))))
    levels: list[tuple[Kind, str, FloatArray]] = []
    for index, signal in enumerate(equations.system.unknowns):
        controlled = signal.name in equations.system.model.controlled
        if controlled and float(np.ptp(curve.y[:, index])) > 1e-6:
            for y in equations.crossings_of(curve, 0.0, index):
                if not _stays(equations, curve, y, index):
                    levels.append(("level", signal.name, y))
    levels += [("zero", "", y) for y in equations.crossings_of(curve, 0.0)]
    for kind, name, y in levels:
        mark = Landmark(kind, name, y, equations.stability(y))
        marks.append((_place(equations, curve, y), mark))
    return [landmark for _, landmark in sorted(marks, key=lambda item: item[0])]


def _stays(equations: CurveEquations, curve: SolutionCurve, y: FloatArray, index: int) -> bool:
    """Whether a coordinate keeps its value around a point: in a dead zone it crosses nothing."""
    k = _place(equations, curve, y)
    around = curve.y[max(k - 1, 0) : k + 2, index] - y[index]
    return int(np.sum(np.abs(around) < 1e-9 * equations.scale[index])) >= 2


def _place(equations: CurveEquations, curve: SolutionCurve, y: FloatArray) -> int:
    return int(np.argmin(np.linalg.norm((curve.y - y) / equations.scale, axis=1)))


def _folds(equations: CurveEquations, curve: SolutionCurve) -> list[tuple[float, Landmark]]:
    steps = np.diff(curve.y[:, -1])
    folds: list[tuple[float, Landmark]] = []
    # The end of a curve may lie on its last point: a step of nothing turns nowhere.
    moving = np.flatnonzero(np.abs(steps) > 1e-12 * equations.scale[-1])
    for i, j in pairwise(moving):
        if steps[i] * steps[j] >= 0:
            continue
        near = curve.y[j]
        y = equations.fold(near)
        smooth = y is not None and equations.inside(y)
        point = y if smooth and y is not None else near
        kind: Kind = "fold" if smooth else "kink"
        place = _between(equations, curve, point, range(int(i), int(j) + 1)) if smooth else float(i)
        folds.append((place, Landmark(kind, "", point, equations.stability(point))))
    return folds


def _between(
    equations: CurveEquations, curve: SolutionCurve, y: FloatArray, parts: Iterable[int]
) -> float:
    """Where a point lies on some parts of a curve, as a position among its points."""
    places: list[tuple[float, float]] = []
    for k in parts:
        chord = (curve.y[k + 1] - curve.y[k]) / equations.scale
        away = (y - curve.y[k]) / equations.scale
        share = float(np.clip(away @ chord / max(float(chord @ chord), 1e-300), 0.0, 1.0))
        places.append((float(np.linalg.norm(away - share * chord)), k + share))
    return min(places)[1]


@dataclass(frozen=True)
class _Node:
    """A point of a curve, its position among the others, and whether it is one beside a fold."""

    place: float
    y: FloatArray
    at: EquilibriumPoint
    beside: bool = False


def _with_folds(
    equations: CurveEquations,
    curve: SolutionCurve,
    points: Sequence[EquilibriumPoint],
    folds: Sequence[tuple[float, Landmark]],
) -> list[_Node]:
    """The points of a curve, with more of them towards each fold on both sides.

    Where a real eigenvalue is near zero a pair often is, too: both may cross in one step.
    """
    nodes = [_Node(float(k), y, at) for k, (y, at) in enumerate(zip(curve.y, points, strict=True))]
    for place, fold in folds:
        if fold.kind != "fold":
            continue
        k = min(math.floor(place), len(curve.y) - 2)
        chord = (curve.y[k + 1] - curve.y[k]) / equations.scale
        along = equations.tangent(fold.y, chord)

        def offset(y: FloatArray, fold: Landmark = fold, along: FloatArray = along) -> float:
            return float((y - fold.y) / equations.scale @ along)

        nodes = [n for n in nodes if abs(n.place - place) > 2 or abs(offset(n.y)) > _BESIDE]
        for side, end in ((-1.0, curve.y[k]), (1.0, curve.y[k + 1])):
            size = _BESIDE
            while size == _BESIDE or size < side * offset(end):
                guess = fold.y + side * size * along * equations.scale
                y = equations.corrected(guess, along)
                if y is not None and equations.inside(y):
                    at = equations.stability(y)
                    where = _between(equations, curve, y, (k,))
                    nodes.append(_Node(where, y, at, beside=size == _BESIDE))
                size *= 2.0
    return sorted(nodes, key=lambda node: node.place)


def _change(
    equations: CurveEquations, before: FloatArray, after: FloatArray, first: EquilibriumPoint
) -> Landmark:
    """Where the number of growing motions changes between two points, by bisection."""
    chord = (after - before) / equations.scale
    along = chord / np.linalg.norm(chord)
    low, high = 0.0, 1.0
    y, at = before, first
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        here = equations.corrected(before + middle * (after - before), along)
        if here is None:
            break
        y, at = here, equations.stability(here)
        if at.unstable == first.unstable:
            low = middle
        else:
            high = middle
    # What grows next to nothing crosses the axis; what is free stays on it.
    moving = at.eigenvalues[np.argsort(np.abs(at.eigenvalues))[len(equations.system.free) :]]
    crossing = moving[np.argmin(np.abs(moving.real))]
    turning = abs(crossing.imag) > 1e-6
    frequency = abs(float(crossing.imag)) / (2.0 * math.pi) if turning else None
    return Landmark("oscillation" if turning else "exchange", "", y, at, frequency)
