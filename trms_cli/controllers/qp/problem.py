"""The quadratic program that a Newton step solves, and what a solver is.

    min  ½ zᵀ H z + gᵀ z + Σ_i (μ_i |v_i| + ν_i v_i²)
    s.t. lower ≤ (z; A z + v) ≤ upper

``v_i`` is the violation of a soft row; a hard row (μ_i infinite) has none.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]


@dataclass
class Qp:
    """A quadratic program with simple bounds and two-sided rows.

    Attributes
    ----------
    hessian : (n, n) array
        Symmetric positive definite.
    gradient : (n,) array
    rows : (m, n) array
        A.
    lower, upper : (n + m,) arrays
        Bounds of the unknowns, then of the rows.
    linear, quadratic : (m,) arrays
        μ and ν; μ infinite makes the row hard.
    """

    hessian: FloatArray
    gradient: FloatArray
    rows: FloatArray
    lower: FloatArray
    upper: FloatArray
    linear: FloatArray
    quadratic: FloatArray


@dataclass
class QpResult:
    """A solver's answer.

    Attributes
    ----------
    z : (n,) array
    solved : bool
        Whether z is a solution to the solver's tolerance.
    iterations : int
    message : str
        Why not, in the solver's words.
    """

    z: FloatArray
    solved: bool
    iterations: int
    message: str = ""


class QpSolver(Protocol):
    """An immutable configuration of a solver."""

    def start(self) -> Any:
        """A fresh workspace."""
        ...

    def solve(self, workspace: Any, qp: Qp) -> QpResult:
        """Solve, warm-started from the workspace's last solution of the same size."""
        ...
