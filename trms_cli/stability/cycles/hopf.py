"""Equilibria over one command, and the Hopf points among them.

At a Hopf point a pair of eigenvalues crosses the imaginary axis.

On a switch, where the slopes of the two sides differ, the eigenvalues are those of their mean
(:mod:`trms_cli.stability.local.linear`), as in the other studies.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from trms_cli.models.model import Model
from trms_cli.models.operating_point import refined
from trms_cli.models.vector_field import VectorField
from trms_cli.stability.local.linear import Linear

FloatArray = npt.NDArray[np.float64]

#: Growth below this is rounding, 1/s.
_NO_GROWTH = 1e-9


@dataclass(frozen=True)
class Curve:
    """Equilibria over one command, the others held."""

    commands: FloatArray  #: (n,) array; V, rising
    x: FloatArray  #: (n, n_x) array
    #: (n,) array; largest real part of the eigenvalues, 1/s; directions that nothing pulls back
    #: left out
    growth: FloatArray


@dataclass(frozen=True)
class Hopf:
    """Where a pair of eigenvalues crosses the imaginary axis."""

    x: FloatArray  #: The equilibrium
    u: FloatArray  #: The equilibrium
    omega: float  #: rad/s
    #: (n_x,) complex array; the eigenvector, its largest entry of size 1
    mode: npt.NDArray[np.complex128]


def equilibria_over(
    model: Model, x: FloatArray, u: FloatArray, channel: int, step: float = 0.02
) -> Curve:
    """The equilibria that one is part of, over a command, as far as they go within its limits."""
    field = VectorField(model)
    low, high = (float(bound[channel]) for bound in model.input_bounds())
    commands, states = [float(u[channel])], [x]
    for direction, limit in ((1.0, high), (-1.0, low)):
        here, at = x, u.copy()
        ahead = step
        slope = np.zeros_like(x)
        while ahead > 1e-4:
            goal = float(np.clip(at[channel] + direction * ahead, low, high))
            trial = at.copy()
            trial[channel] = goal
            moved = abs(goal - at[channel])
            following = refined(field, here + slope * moved, trial)
            bound = 0.2 + 20.0 * moved * (1.0 + float(np.abs(here).max()))
            if following is None or np.abs(following - here).max() > bound:
                ahead /= 2.0
                continue
            slope = (following - here) / moved if moved else slope
            here, at = following, trial
            ahead = min(2.0 * ahead, step)
            commands.append(goal)
            states.append(here)
            if goal == limit:
                break
    linear = Linear(model)
    order = np.argsort(commands)
    along = np.array(commands)[order]
    found = np.array(states)[order]
    growth = np.array(
        [_growth(linear, row, _with(u, channel, v)) for row, v in zip(found, along, strict=True)]
    )
    return Curve(along, found, growth)


def hopf_points(model: Model, curve: Curve, u: FloatArray, channel: int) -> list[Hopf]:
    """Where a complex pair crosses along a curve of equilibria, by bisection."""
    field, linear = VectorField(model), Linear(model)
    found = []
    # Growth that is rounding has no sign: a pair that stays on the axis crosses it nowhere.
    clear = np.flatnonzero(np.abs(curve.growth) > _NO_GROWTH)
    for i, j in pairwise(clear):
        if (curve.growth[i] < 0) == (curve.growth[j] < 0):
            continue
        low, high = curve.commands[i], curve.commands[j]
        x, sign = curve.x[i], curve.growth[i] < 0
        for _ in range(40):
            middle = 0.5 * (low + high)
            trial = refined(field, x, _with(u, channel, middle))
            if trial is None:
                break
            if (_growth(linear, trial, _with(u, channel, middle)) < 0) == sign:
                low, x = middle, trial
            else:
                high = middle
        at = _with(u, channel, low)
        found_pair = np.linalg.eig(linear.a(x, at))
        values, vectors = (part.astype(complex) for part in found_pair)
        k = int(np.argmax(np.where(_pulled(values), values.real, -np.inf)))
        if abs(values[k].imag) < 1e-6:
            continue  # a real eigenvalue: a fold of equilibria
        mode = vectors[:, k] if values[k].imag > 0 else vectors[:, k].conj()
        mode = mode / mode[int(np.argmax(np.abs(mode)))]
        found.append(Hopf(x, at, float(abs(values[k].imag)), mode))
    return found


def _with(u: FloatArray, channel: int, value: float) -> FloatArray:
    changed = u.copy()
    changed[channel] = value
    return changed


def _pulled(values: npt.NDArray[np.complex128]) -> npt.NDArray[np.bool_]:
    """Eigenvalues but those of a direction in which nothing changes."""
    return np.asarray(np.abs(values) > 1e-9)


def _growth(linear: Linear, x: FloatArray, u: FloatArray) -> float:
    values = np.linalg.eigvals(linear.a(x, u)).astype(complex)
    kept = values[_pulled(values)]
    return float(kept.real.max()) if kept.size else 0.0
