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
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Literal

from msgspec import Meta

from trms_cli.controllers.controller import Command, ControlSample, ControlSetup, Status
from trms_cli.controllers.newton_sizes import typical_sizes
from trms_cli.controllers.newton_state import NewtonMpcState
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.qp import Daqp, QpSolver

__all__ = ["NewtonMpc", "NewtonMpcState", "typical_sizes"]

Positive = Annotated[float, Meta(gt=0)]
NotNegative = Annotated[float, Meta(ge=0)]


@dataclass(frozen=True, kw_only=True)
class NewtonMpc:
    """Newton-type MPC."""

    sample_time: Positive = 0.1  #: Control period, s
    prediction_horizon: Annotated[int, Meta(ge=2)] = 40  #: N, control periods
    #: Lengths of the blocks over which an input is constant, in control periods (the control
    #: horizon). The last block lasts to the end of the prediction horizon; what is beyond it is
    #: left out.
    move_blocks: tuple[int, ...] = (1,) * 10 + (2,) * 5 + (4,) * 5
    #: How many control periods ahead the reference is known, at most N; beyond, it is taken as
    #: constant, so that the terminal state leaves N − preview periods to settle
    preview_horizon: Annotated[int, Meta(ge=0)] = 0
    #: How many control periods ahead a reference that is not known is carried on as the constant,
    #: ramp or sine that it has been so far (:mod:`trms_cli.controllers.reference_forecast`), at
    #: most N; 0 for none. Without effect where ``preview_horizon`` knows it.
    forecast_horizon: Annotated[int, Meta(ge=0)] = 15
    #: ``state_weights``, ``rate_weights``, ``input_weights``, ``move_weights``: See
    #: :class:`trms_cli.controllers.horizon.Weights`. Where no controlled state has a weight (the
    #: speed of a rotor alone), each gets that of its typical size.
    state_weights: Mapping[str, NotNegative] = field(
        default_factory=lambda: {"alpha_v": 1.2, "alpha_h": 1.0}
    )
    rate_weights: Mapping[str, NotNegative] = field(
        default_factory=lambda: {"alpha_v": 0.5, "alpha_h": 0.38}
    )
    input_weights: Mapping[str, NotNegative] = field(default_factory=dict)
    move_weights: Mapping[str, NotNegative] = field(
        default_factory=lambda: {"u_v": 0.02, "u_h": 0.005}
    )
    #: Largest change per second, V/s
    input_rate_limits: Mapping[str, Positive] = field(default_factory=dict)
    #: Limits on states, met if at all possible; in the states' units
    soft_limits: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    soft_linear: Positive = 100.0  #: Price of violating them
    soft_quadratic: Positive = 1000.0  #: Price of violating them
    #: Whether the predicted trajectory must end in the steady state of the reference, or in a
    #: region around it at the cost of a local law that goes on from there (see
    #: :mod:`trms_cli.controllers.newton_region`; where a target has no such region, in the steady
    #: state), or anywhere
    terminal: Literal["equality", "quasi_infinite", "none"] = "equality"
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
    #: Newton iterations a sample; 1 is the real-time iteration
    max_iterations: Annotated[int, Meta(ge=1)] = 10
    tolerance: Positive = 1e-4  #: Converged when no input moves more than this, V
    #: Steps of the model's integrator in a control period
    integration_steps: Annotated[int, Meta(ge=1)] = 1
    #: Whether the observer's constant disturbances enter prediction and target (offset-free)
    disturbance_compensation: bool = True
    #: What acts when a solve fails: the last plan shifted in time, the last command, the
    #: steady-state input of the reference, or the end of the run
    fallback: Literal["shifted_plan", "hold", "steady_input", "stop"] = "shifted_plan"
    qp: QpSolver = field(default_factory=Daqp)

    def __post_init__(self) -> None:
        if self.preview_horizon > self.prediction_horizon:
            raise ConfigurationError(
                f"{self.preview_horizon} given",
                where="preview_horizon",
                remedy=f"at most the prediction horizon, {self.prediction_horizon}",
            )

    def preview(self, setup: ControlSetup) -> int:
        """Reference samples wanted beyond the present one."""
        return self.preview_horizon

    def init(self, setup: ControlSetup) -> NewtonMpcState:
        """Compiled functions, workspaces and the first plan."""
        return NewtonMpcState(self, setup)

    def step(
        self, state: NewtonMpcState, sample: ControlSample, *, want_prediction: bool
    ) -> Command:
        """One sample: target, Newton iterations, command."""
        state.begin_sample(sample)
        newton, target = state.newton, state.target
        if not state.inputs_finite:
            return state.fall_back(self.fallback, "the estimate or the reference is not finite")
        begin_linearise = newton.linearise_time
        begin_qp = newton.qp_time
        outcome = newton.solve(self.max_iterations, self.tolerance, state.other_start)
        if outcome.failed:
            return state.fall_back(self.fallback, outcome.message)
        if outcome.terminal_residual > state.relaxed_above and target is not None:
            status = Status.RELAXED
        elif outcome.converged:
            status = Status.OK
        else:
            status = Status.BUDGET
        return Command(
            newton.plan[:, 0].copy(),
            status,
            outcome.iterations,
            outcome.objective,
            max(outcome.violation, outcome.terminal_residual),
            outcome.kkt_residual,
            newton.linearise_time - begin_linearise,
            newton.qp_time - begin_qp,
            message=_message(status, state),
            prediction=state.prediction() if want_prediction else None,
            out_of_reach=target is not None and target.projected,
            terminal_residual=math.nan if self.terminal == "none" else outcome.terminal_residual,
        )


def _message(status: Status, state: NewtonMpcState) -> str:
    words = [status.meaning] if status is Status.RELAXED else []
    if not state.target_is_held:
        words.append("no input holds the estimated disturbance; the last target goes on")
    elif state.target is not None and state.target.projected:
        words.append("the reference is out of reach; the nearest steady state is the target")
    if state.regions is not None and state.regions.region is None:
        words.append("this target has no terminal region; its steady state ends the horizon")
    return "; ".join(words)
