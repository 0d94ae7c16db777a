"""OSQP: operator splitting (Stellato et al. 2020, Math. Prog. Comp. 12), with polishing.

Each soft row gets two slack variables, one to either side.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from msgspec import Meta

from trms_cli.core.qp import FloatArray, Qp, QpResult
from trms_cli.core.ranges import Positive


@dataclass
class _Workspace:
    last: FloatArray | None = None


@dataclass(frozen=True, kw_only=True)
class Osqp:
    """OSQP."""

    #: Absolute and relative. The library's own default, 1e-3, leaves errors of 2e-2 in an input
    #: sequence.
    tolerance: Positive = 1e-8
    max_iterations: Annotated[int, Meta(ge=1)] = 50000

    def start(self) -> _Workspace:
        """A fresh workspace."""
        return _Workspace()

    def solve(self, workspace: _Workspace, qp: Qp) -> QpResult:
        """See :class:`trms_cli.core.qp.QpSolver`."""
        import osqp
        from scipy import sparse

        n, m = len(qp.gradient), len(qp.linear)
        soft = np.flatnonzero(np.isfinite(qp.linear))
        k = len(soft)
        select = sparse.csc_matrix((np.ones(k), (soft, np.arange(k))), shape=(m, k))
        hessian = sparse.block_diag(
            [qp.hessian, sparse.diags(np.tile(2 * qp.quadratic[soft], 2))], format="csc"
        )
        gradient = np.concatenate([qp.gradient, qp.linear[soft], qp.linear[soft]])
        rows = sparse.vstack(
            [
                sparse.hstack([sparse.csc_matrix(qp.rows), select, -select]),
                sparse.identity(n + 2 * k),
            ],
            format="csc",
        )
        zeros, infinite = np.zeros(2 * k), np.full(2 * k, np.inf)
        lower = np.concatenate([qp.lower[n:], qp.lower[:n], zeros])
        upper = np.concatenate([qp.upper[n:], qp.upper[:n], infinite])
        solver = osqp.OSQP()
        solver.setup(
            sparse.triu(hessian, format="csc"),
            gradient,
            rows,
            lower,
            upper,
            verbose=False,
            polishing=True,
            eps_abs=self.tolerance,
            eps_rel=self.tolerance,
            max_iter=self.max_iterations,
        )
        if workspace.last is not None and len(workspace.last) == n + 2 * k:
            solver.warm_start(x=workspace.last)
        result = solver.solve(raise_error=False)
        solved = result.info.status == "solved" and bool(np.isfinite(result.x).all())
        workspace.last = result.x if solved else None
        message = "" if solved else str(result.info.status)
        return QpResult(np.array(result.x[:n]), solved, int(result.info.iter), message)
