"""Whether equilibria are stable: the eigenvalues of ∂f/∂x there."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from trms_cli.stability.equilibria.curve_equations import CurveEquations, EquilibriumPoint
from trms_cli.stability.vector_field import VectorField

FloatArray = npt.NDArray[np.float64]

#: 1/s: growth below this is rounding (a free yaw neither grows nor returns).
GROWTH = 1e-7


def judged(field: VectorField, equations: CurveEquations, y: FloatArray) -> EquilibriumPoint:
    """A point of a curve with its eigenvalues; y is (n + 1,)."""
    x, u, reached = equations.point(y)
    slopes, _ = field.linearised(x, reached)
    if not np.all(np.isfinite(slopes)):
        values = np.full(len(x), np.nan, dtype=complex)
    else:
        values = np.linalg.eigvals(slopes).astype(complex)
        values = values[np.argsort(-values.real, kind="stable")]
    return EquilibriumPoint(x, u, values, int(np.sum(values.real > GROWTH)))
