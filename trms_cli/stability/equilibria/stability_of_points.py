"""Whether equilibria are stable: the eigenvalues of ∂f/∂x there.

On a switch (a cable that is stiffer to one side) ∂f/∂x is the mean of both sides, which small
swings across it see; :mod:`trms_cli.stability.local.linear` tells why. All studies take the same.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from trms_cli.models.model import Model
from trms_cli.stability.equilibria.curve_equations import CurveEquations, EquilibriumPoint
from trms_cli.stability.local.linear import Linear
from trms_cli.stability.local.modes import Verdict, modes_of_matrix, parts_of

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]

#: 1/s: growth below this is rounding (a free yaw neither grows nor returns).
GROWTH = 1e-7


def judged(linear: Linear, equations: CurveEquations, y: FloatArray) -> EquilibriumPoint:
    """A point of a curve with its eigenvalues; y is (n + 1,)."""
    x, u, reached = equations.point(y)
    values, verdict = eigenvalues_at(linear, x, reached)
    return EquilibriumPoint(x, u, values, int(np.sum(values.real > GROWTH)), verdict)


def eigenvalues_at(
    linear: Linear, x: FloatArray, reached: FloatArray
) -> tuple[ComplexArray, Verdict]:
    """Eigenvalues, (n_x,), rightmost first, and what they say.

    Parameters
    ----------
    x : (n_x,) array
    reached : (n_u,) array
        What reaches the motors.
    """
    with np.errstate(invalid="ignore"):
        slopes = linear.a(x, reached)
    if not np.all(np.isfinite(slopes)):
        return np.full(len(x), np.nan, dtype=complex), "marginal"
    values = np.linalg.eigvals(slopes).astype(complex)
    values = values[np.argsort(-values.real, kind="stable")]
    return values, _verdict(linear.model, slopes, values)


def _verdict(model: Model, slopes: FloatArray, values: ComplexArray) -> Verdict:
    if np.any(values.real > GROWTH):
        return "unstable"
    staying = int(np.sum(values.real >= -GROWTH))
    if staying > 1:
        # Two on the axis may grow as t: their eigenvectors decide.
        return modes_of_matrix(slopes, parts_of(model)).verdict
    return "marginal" if staying else "stable"
