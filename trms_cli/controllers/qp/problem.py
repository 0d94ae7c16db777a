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
    """A quadratic program with simple bounds and two-sided rows."""

    hessian: FloatArray  #: (n, n) array; symmetric positive definite
    gradient: FloatArray  #: (n,) array
    rows: FloatArray  #: (m, n) array; A
    #: ``lower``, ``upper``: (n + m,) arrays; bounds of the unknowns, then of the rows
    lower: FloatArray
    upper: FloatArray
    linear: FloatArray  #: (m,) arrays; μ and ν
    quadratic: FloatArray  #: (m,) arrays; μ infinite makes the row hard


@dataclass
class QpResult:
    """A solver's answer."""

    z: FloatArray  #: (n,) array
    solved: bool  #: Whether z is a solution to the solver's tolerance
    iterations: int
    message: str = ""  #: Why not, in the solver's words


class QpSolver(Protocol):
    """An immutable configuration of a solver."""

    def start(self) -> Any:
        """A fresh workspace."""
        ...

    def solve(self, workspace: Any, qp: Qp) -> QpResult:
        """Solve, warm-started from the workspace's last solution of the same size."""
        ...
