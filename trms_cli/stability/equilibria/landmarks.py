"""What is special on a curve of equilibria: folds, changes of stability, levels, rest."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np
import numpy.typing as npt

from trms_cli.models.model import names
from trms_cli.stability.equilibria.continuation import Curve, crossings_of
from trms_cli.stability.equilibria.curve_equations import CurveEquations, EquilibriumPoint
from trms_cli.stability.equilibria.stability_of_points import judged
from trms_cli.stability.vector_field import VectorField

FloatArray = npt.NDArray[np.float64]
Kind = Literal["fold", "kink", "oscillation", "exchange", "crossing", "level", "zero"]

_BISECTIONS = 40


@dataclass(frozen=True)
class Landmark:
    """A special point of a curve.

    Attributes
    ----------
    kind : Kind
        ``fold``: the input has an extreme, to rounding. ``kink``: the same where the equations
        have a kink, between two points of the curve. ``oscillation``: a pair of eigenvalues
        crosses the imaginary axis (Hopf). ``exchange``: a real one does, away from a fold.
        ``crossing``: another curve may cross. ``level``: a controlled angle is zero. ``zero``: the
        input is.
    name : str
        The angle of a level; empty otherwise.
    y : (n + 1,) array
        Unknowns and the varied input.
    at : EquilibriumPoint
    frequency : float or None
        Hz, of an oscillation.
    """

    kind: Kind
    name: str
    y: FloatArray
    at: EquilibriumPoint
    frequency: float | None = None


def landmarks(
    field: VectorField,
    equations: CurveEquations,
    curve: Curve,
    points: Sequence[EquilibriumPoint],
) -> list[Landmark]:
    """The special points of a curve, in order along it."""
    found: list[tuple[int, Landmark]] = []
    folds = _folds(field, equations, curve)
    found += folds
    for k, after in enumerate(points[1:]):
        more = after.unstable - points[k].unstable
        # At a fold one real eigenvalue crosses; a pair that does so near it is another matter.
        folding = more % 2 == 1 and any(abs(place - k) <= 2 for place, _ in folds)
        if more == 0 or folding:
            continue
        found.append((k, _change(field, equations, curve.y[k], curve.y[k + 1], points[k])))
    for k in curve.crossings:
        if not any(abs(place - k) <= 2 for place, _ in found):
            y = curve.y[k]
            found.append((k, Landmark("crossing", "", y, judged(field, equations, y))))
    for index, signal in enumerate(equations.system.unknowns):
        if signal.name in equations.system.model.controlled and _varies(curve.y[:, index]):
            for y in crossings_of(equations, curve, index, 0.0):
                if _stays(equations, curve, y, index):
                    continue
                point = Landmark("level", signal.name, y, judged(field, equations, y))
                found.append((_place(equations, curve, y), point))
    for y in crossings_of(equations, curve, equations.n, 0.0):
        point = Landmark("zero", "", y, judged(field, equations, y))
        found.append((_place(equations, curve, y), point))
    return [landmark for _, landmark in sorted(found, key=lambda item: item[0])]


def _stays(equations: CurveEquations, curve: Curve, y: FloatArray, index: int) -> bool:
    """Whether a coordinate keeps its value around a point: in a dead zone it crosses nothing."""
    k = _place(equations, curve, y)
    around = curve.y[max(k - 1, 0) : k + 2, index] - y[index]
    return int(np.sum(np.abs(around) < 1e-9 * equations.scale[index])) >= 2


def _varies(values: FloatArray) -> bool:
    return float(np.ptp(values)) > 1e-6


def _place(equations: CurveEquations, curve: Curve, y: FloatArray) -> int:
    return int(np.argmin(np.linalg.norm((curve.y - y) / equations.scale, axis=1)))


def _folds(
    field: VectorField, equations: CurveEquations, curve: Curve
) -> list[tuple[int, Landmark]]:
    steps = np.diff(curve.y[:, -1])
    found: list[tuple[int, Landmark]] = []
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
        found.append((int(i), Landmark(kind, "", point, judged(field, equations, point))))
    return found


def _change(
    field: VectorField,
    equations: CurveEquations,
    before: FloatArray,
    after: FloatArray,
    first: EquilibriumPoint,
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
        y, at = here, judged(field, equations, here)
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


def state_of(equations: CurveEquations, landmark: Landmark, name: str) -> float:
    """A state or a command of a landmark by name."""
    model = equations.system.model
    if name in model.state_names:
        return float(landmark.at.x[model.state_index(name)])
    return float(landmark.at.u[names(model.inputs).index(name)])
