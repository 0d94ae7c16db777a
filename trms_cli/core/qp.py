"""Quadratic programs of predictive controllers and moving-horizon estimators, and what solves them.

    min  ½ zᵀ H z + gᵀ z + Σ_i (μ_i |v_i| + ν_i v_i²)
    s.t. lower ≤ (z; A z + v) ≤ upper

``v_i`` is the violation of a soft row; a hard row (μ_i infinite) has none.

DAQP: dual active-set solver (Arnström, Bemporad & Axehill 2022, IEEE TAC 67), dense, exact. Soft
rows with a linear and a quadratic price are its own kind of constraint, so that an exact penalty
costs no further variables. The other solvers are plugins: :mod:`trms_cli.controllers.qp`.
"""

from dataclasses import dataclass, field
from typing import Annotated, Any, Protocol

import daqp
import numpy as np
from msgspec import Meta

from trms_cli.core.arrays import FloatArray
from trms_cli.core.ranges import Positive

_HARD, _EQUALITY, _SOFT = 0, 5, 8
#: Violation of a row that DAQP may leave where what it is asked for leads nowhere.
_SECOND_TOLERANCE = 1e-8
_REASONS = {
    -1: "infeasible",
    -2: "cycling",
    -3: "unbounded",
    -4: "iteration limit",
    -5: "not convex",
    -6: "initial active set overdetermined",
}


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

    def solve(self, workspace: Any, qp: Qp) -> QpResult:
        """Solve, warm-started from the workspace's last solution of the same size."""


def solve_or_fail(solver: QpSolver, workspace: Any, qp: Qp) -> tuple[QpResult, Any]:
    """The answer and the workspace to go on with; an exception of a library is a failed solve."""
    try:
        return solver.solve(workspace, qp), workspace
    except Exception as error:
        reason = f"{type(error).__name__}: {error}"
        return QpResult(np.full(len(qp.gradient), np.nan), False, 0, reason), solver.start()


@dataclass
class _Workspace:
    models: dict[tuple[int, int], Any] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Daqp:
    """DAQP."""

    max_iterations: Annotated[int, Meta(ge=1)] = 1000  #: Changes of the active set
    primal_tolerance: Positive = 1e-10  #: Violation of a row that it leaves

    def start(self) -> _Workspace:
        """A fresh workspace."""
        return _Workspace()

    def solve(self, workspace: _Workspace, qp: Qp) -> QpResult:
        """See :class:`trms_cli.core.qp.QpSolver`."""
        result = self._solve(workspace, qp, self.primal_tolerance)
        if not result.solved:  # it may have cycled between active sets that are all but the same
            result = self._solve(workspace, qp, _SECOND_TOLERANCE)
            workspace.models.pop(qp.rows.shape, None)
        return result

    def _solve(self, workspace: _Workspace, qp: Qp, primal_tolerance: float) -> QpResult:
        size = qp.rows.shape
        model = workspace.models.get(size)
        if model is not None:
            # Without rows, `update` would look at the first of none.
            rows = qp.rows if len(qp.rows) else None
            model.update(H=qp.hessian, f=qp.gradient, A=rows, bupper=qp.upper, blower=qp.lower)
        else:
            model = daqp.Model()
            model.settings = {
                "iter_limit": self.max_iterations,
                "primal_tol": primal_tolerance,
                "dual_tol": 1e-12,
            }
            flag, _ = model.setup(qp.hessian, qp.gradient, qp.rows, qp.upper, qp.lower, _kinds(qp))
            if flag < 0:  # no model: to ask it for a solution would be an error
                return QpResult(np.full(len(qp.gradient), np.nan), False, 0, _reason(flag))
            self._set_prices(model, qp)
            workspace.models[size] = model
        z, _, flag, info = model.solve()
        solved = flag in (1, 2) and bool(np.isfinite(z).all())
        if not solved:
            # A workspace that failed may hold a bad active set: the next solve starts afresh.
            del workspace.models[size]
        message = "" if solved else _reason(flag)
        return QpResult(z, solved, int(info["iterations"]), message)

    @staticmethod
    def _set_prices(model: Any, qp: Qp) -> None:
        soft = np.isfinite(qp.linear)
        if not soft.any():
            return
        n = len(qp.gradient)
        linear = np.concatenate([np.zeros(n), np.where(soft, qp.linear, 0.0)])
        # DAQP takes the reciprocal of the weight of ½ v².
        reciprocal = np.concatenate([np.ones(n), np.where(soft, 0.5 / qp.quadratic, 1.0)])
        model.soft_weights(rho_l=reciprocal, rho_u=reciprocal, w_l=linear, w_u=linear)


def _reason(flag: int) -> str:
    return _REASONS.get(flag, f"exit flag {flag}")


def _kinds(qp: Qp) -> np.ndarray:
    n = len(qp.gradient)
    kinds = np.full(n + len(qp.linear), _HARD, dtype=np.int32)
    rows, soft = kinds[n:], np.isfinite(qp.linear)
    rows[soft] = _SOFT
    rows[~soft & (qp.lower[n:] == qp.upper[n:])] = _EQUALITY
    return kinds
