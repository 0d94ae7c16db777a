"""A QP solver that fails on purpose: better to see what a loop does then before a rig does it."""

from dataclasses import dataclass, field
from typing import Annotated, Any

import numpy as np
from msgspec import Meta

from trms_cli.core.qp import Daqp, Qp, QpResult, QpSolver


@dataclass
class _Workspace:
    inner: Any
    solves: int = 0


@dataclass(frozen=True, kw_only=True)
class FailingQp:
    """Another solver, some of whose solves fail."""

    qp: QpSolver = field(default_factory=Daqp)  #: The one that solves the others
    #: The solve at which it begins, counted from 0 since the controller started (afresh); there is
    #: one a Newton iteration
    first: Annotated[int, Meta(ge=0)] = 100
    count: Annotated[int, Meta(ge=1)] = 20  #: How many solves fail in a row
    #: After how many solves it happens again, from the first one on; None for never
    every: Annotated[int, Meta(ge=1)] | None = None

    def start(self) -> _Workspace:
        """A fresh workspace."""
        return _Workspace(self.qp.start())

    def solve(self, workspace: _Workspace, qp: Qp) -> QpResult:
        """See :class:`trms_cli.core.qp.QpSolver`."""
        since = workspace.solves - self.first
        workspace.solves += 1
        if since >= 0 and (since if self.every is None else since % self.every) < self.count:
            return QpResult(np.full(len(qp.gradient), np.nan), False, 0, "made to fail")
        return self.qp.solve(workspace.inner, qp)
