"""Multistep Newton-type nonlinear model predictive control.

After Li & Biegler 1989 (Chem. Eng. Res. Des. 67): the nonlinear model is linearised along the
nominal trajectory of the whole horizon, one quadratic program gives the Newton direction of all
inputs at once, and the inputs move along it as far as an exact penalty function (see
:mod:`trms_cli.controllers.horizon`) falls. The Hessian is that of Gauss and Newton: the objective
is a sum of squares. The last predicted state must equal the steady state of the reference, or lie
in a region around it from where a local law leads there (Chen & Allgöwer 1998).

One iteration a sample, warm-started by the last plan shifted in time, is the real-time iteration
of Diehl, Bock & Schlöder 2005 (SIAM J. Control Optim. 43); with more, each sample is solved to
convergence.

The engine is C, compiled once for a structure (:mod:`trms_cli.controllers.newton.engine`); without
a compiler the same runs in NumPy (:mod:`trms_cli.controllers.newton.state`).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated, Literal

from msgspec import Meta

from trms_cli.controllers.controller import Command, ControlSample, ControlSetup
from trms_cli.controllers.fallback import Policy
from trms_cli.controllers.horizon import HorizonSettings, NotNegative, Positive
from trms_cli.controllers.newton.engine import NewtonEngine
from trms_cli.controllers.newton.problem import NewtonProblem
from trms_cli.controllers.newton.state import NewtonMpcState
from trms_cli.controllers.newton.terminals import STATES
from trms_cli.controllers.qp.riccati import Riccati
from trms_cli.core.qp import QpSolver
from trms_cli.models.model import Model
from trms_cli.models.state_scales import bench_ratios


@dataclass(frozen=True, kw_only=True)
class NewtonMpc(HorizonSettings):
    """Newton-type MPC."""

    #: Whether the predicted trajectory must end in the steady state of the reference, or in a
    #: region around it at the cost of a local law that goes on from there (see
    #: :mod:`trms_cli.controllers.newton.region`; where a target has no such region, in the steady
    #: state), or anywhere; ``dual_mode``, ``control_lyapunov`` and ``contractive``, in NumPy alone:
    #: see :mod:`trms_cli.controllers.newton.terminals`
    terminal: Literal[
        "equality", "quasi_infinite", "dual_mode", "control_lyapunov", "contractive", "none"
    ] = "equality"
    #: ``terminal_linear``, ``terminal_quadratic``: Exact penalty of the terminal constraint,
    #: relative to typical sizes of the states. It holds while its multipliers stay below
    #: ``terminal_linear``; otherwise it is relaxed, which is reported.
    terminal_linear: Positive = 100.0
    terminal_quadratic: Positive = 1000.0
    #: ``terminal_weight``, ``terminal_decay``: Of the quasi-infinite horizon: weight of all states
    #: and inputs in the local law's cost, relative to the objective's, and share of the law's decay
    #: that the terminal cost keeps back. Both make room for the nonlinearity: a larger region for a
    #: higher terminal cost. Both 0 are the linear-quadratic regulator of the objective.
    terminal_weight: NotNegative = 0.25
    terminal_decay: Annotated[float, Meta(ge=0, lt=1)] = 0.5
    #: Of ``contractive``: share of the present distance from the steady state at which the horizon
    #: ends at the most
    contraction: Annotated[float, Meta(gt=0, lt=1)] = 0.5
    #: Newton iterations a sample; 1 is the real-time iteration
    max_iterations: Annotated[int, Meta(ge=1)] = 10
    #: V; converged when no input moves more than this, or is expected to by a tenth of it
    tolerance: Positive = 1e-3
    #: What acts when a solve fails: the last plan shifted in time, the last command, the
    #: steady-state input of the reference, or the end of the run
    fallback: Policy = "shifted_plan"
    #: What solves the quadratic programs: ``riccati`` is the compiled engine's own; any other runs
    #: the iteration in NumPy
    qp: QpSolver = field(default_factory=Riccati)

    def for_model(self, model: Model) -> NewtonMpc:
        """As :meth:`HorizonSettings.for_model`, with the tolerance by the scales of the inputs."""
        ratio = float(bench_ratios(model).inputs.min())
        return replace(super().for_model(model), tolerance=self.tolerance * ratio)

    def problem(self, setup: ControlSetup) -> NewtonProblem:
        """What it poses for a model.

        Raises ConfigurationError for names and limits that the model does not have.
        """
        return NewtonProblem(self, setup)

    def init(self, setup: ControlSetup) -> NewtonMpcState | NewtonEngine:
        """The compiled engine; in NumPy without a compiler, and with another solver than its own.

        Raises ConfigurationError for names and limits that the model does not have.
        """
        if self.terminal in STATES:
            return STATES[self.terminal](self, setup)
        if type(self.qp) is Riccati:
            engine = NewtonEngine.of(self.problem(setup), setup, self.preview(setup))
            if engine is not None:
                return engine
        return NewtonMpcState(self, setup)

    def step(
        self,
        state: NewtonMpcState | NewtonEngine,
        sample: ControlSample,
        *,
        want_prediction: bool,
    ) -> Command:
        """One sample: target, Newton iterations, command."""
        return state.step(sample, want_prediction=want_prediction)
