"""Multistep Newton-type nonlinear model predictive control.

After Li & Biegler 1989 (Chem. Eng. Res. Des. 67): the nonlinear model is linearised along the
nominal trajectory of the whole horizon, one quadratic program gives the Newton direction of all
inputs at once, and the inputs move along it as far as an exact penalty function (see
:mod:`trms_cli.controllers.horizon`) falls. The Hessian is that of Gauss and Newton: the objective
is a sum of squares. The last predicted state must equal the steady state of the reference.

One iteration a sample, warm-started by the last plan shifted in time, is the real-time iteration
of Diehl, Bock & Schlöder 2005 (SIAM J. Control Optim. 43); with more, each sample is solved to
convergence.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Literal

import numpy as np
import numpy.typing as npt
from msgspec import Meta

from trms_cli.controllers.controller import (
    Command,
    ControlSample,
    ControlSetup,
    Prediction,
    Status,
)
from trms_cli.controllers.horizon import (
    Horizon,
    SoftLimits,
    TerminalPrice,
    Weights,
    blocks_of,
    check_names,
)
from trms_cli.controllers.newton_step import NewtonStep
from trms_cli.controllers.operating_point import SteadyState, Target
from trms_cli.controllers.qp.daqp import Daqp
from trms_cli.controllers.qp.problem import QpSolver
from trms_cli.core.compilation import BufferedFunction
from trms_cli.core.errors import ConfigurationError, SimulationError
from trms_cli.models.discretisation import DiscreteModel, discretise
from trms_cli.models.model import Model, names

FloatArray = npt.NDArray[np.float64]
Positive = Annotated[float, Meta(gt=0)]
NotNegative = Annotated[float, Meta(ge=0)]


@dataclass(frozen=True, kw_only=True)
class NewtonMpc:
    """Newton-type MPC.

    Attributes
    ----------
    sample_time : float
        Control period, s.
    prediction_horizon : int
        N, control periods.
    move_blocks : tuple of int
        Lengths of the blocks over which an input is constant, in control periods (the control
        horizon). The last block lasts to the end of the prediction horizon; what is beyond it is
        left out.
    preview_horizon : int
        How many control periods ahead the reference is known, at most N; beyond, it is taken as
        constant, so that the terminal state leaves N − preview periods to settle.
    state_weights, rate_weights, input_weights, move_weights : dict of str to float
        See :class:`trms_cli.controllers.horizon.Weights`. Where no controlled state has a weight
        (the speed of a rotor alone), each gets that of its typical size.
    input_rate_limits : dict of str to float
        Largest change per second, V/s.
    soft_limits : dict of str to (float, float)
        Limits on states, met if at all possible; in the states' units.
    soft_linear, soft_quadratic : float
        Price of violating them.
    terminal : {"equality", "none"}
        Whether the predicted trajectory must end in the steady state of the reference.
    terminal_linear, terminal_quadratic : float
        Exact penalty of the terminal equality, relative to typical sizes of the states. The
        equality holds while its multipliers stay below ``terminal_linear``; otherwise it is
        relaxed, which is reported.
    max_iterations : int
        Newton iterations a sample; 1 is the real-time iteration.
    tolerance : float
        Converged when no input moves more than this, V.
    integration_steps : int
        Steps of the model's integrator in a control period.
    disturbance_compensation : bool
        Whether the observer's constant disturbances enter prediction and target (offset-free).
    fallback : {"shifted_plan", "hold", "steady_input", "stop"}
        What acts when a solve fails: the last plan shifted in time, the last command, the
        steady-state input of the reference, or the end of the run.
    qp : QpSolver
    """

    sample_time: Positive = 0.1
    prediction_horizon: Annotated[int, Meta(ge=2)] = 40
    move_blocks: tuple[int, ...] = (1,) * 10 + (2,) * 5 + (4,) * 5
    preview_horizon: Annotated[int, Meta(ge=0)] = 0
    state_weights: Mapping[str, NotNegative] = field(
        default_factory=lambda: {"alpha_v": 1.2, "alpha_h": 1.0}
    )
    rate_weights: Mapping[str, NotNegative] = field(
        default_factory=lambda: {"alpha_v": 0.73, "alpha_h": 0.36}
    )
    input_weights: Mapping[str, NotNegative] = field(default_factory=dict)
    move_weights: Mapping[str, NotNegative] = field(
        default_factory=lambda: {"u_v": 0.1, "u_h": 0.2}
    )
    input_rate_limits: Mapping[str, Positive] = field(default_factory=dict)
    soft_limits: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    soft_linear: Positive = 100.0
    soft_quadratic: Positive = 1000.0
    terminal: Literal["equality", "none"] = "equality"
    terminal_linear: Positive = 100.0
    terminal_quadratic: Positive = 1000.0
    max_iterations: Annotated[int, Meta(ge=1)] = 10
    tolerance: Positive = 1e-4
    integration_steps: Annotated[int, Meta(ge=1)] = 1
    disturbance_compensation: bool = True
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
        )


class NewtonMpcState:
    """What changes during a run: the plan, the target, the memory of the input path."""

    #: A scaled terminal residual above this counts as a relaxed equality.
    relaxed_above = 1e-3

    def __init__(self, config: NewtonMpc, setup: ControlSetup) -> None:
        model = setup.model
        self.config, self.model = config, model
        self.discrete = discretise(model, setup.sample_time, config.integration_steps)
        blocks = blocks_of(config.prediction_horizon, tuple(config.move_blocks))
        sizes = typical_sizes(self.discrete)
        weights = _tracking(model, config.state_weights, sizes)
        self.steady_state = SteadyState(model, _positive(weights))
        horizon = Horizon(
            self.discrete,
            blocks,
            Weights(
                weights,
                config.rate_weights,
                config.input_weights,
                config.move_weights,
            ),
            SoftLimits(config.soft_limits, config.soft_linear, config.soft_quadratic),
            TerminalPrice(config.terminal_linear, config.terminal_quadratic)
            if config.terminal == "equality"
            else None,
            sizes,
        )
        inputs = names(model.inputs)
        check_names(config.input_rate_limits, inputs, "input_rate_limits")
        rates = np.array([config.input_rate_limits.get(name, np.inf) for name in inputs])
        limits = [config.soft_limits.get(name, (-np.inf, np.inf)) for name in model.controlled]
        self._goal_limits = np.array(limits) if config.soft_limits else None
        self.newton = NewtonStep(horizon, config.qp, rates * setup.sample_time)
        self._shift = _shift_matrix(blocks)
        self._beyond = 1.0 - self._shift.sum(axis=0)
        self.target: Target | None = None
        self._full = self.discrete.initial(model.rest(), setup.first_command)
        self._first = True
        self._last_command = setup.first_command.copy()
        self._disturbance = np.zeros(model.n_w)
        self.inputs_finite = True
        self.target_is_held = True
        self._solved_for: tuple[float, ...] = ()
        #: A second plan to start from, where the reference has changed.
        self.other_start: FloatArray | None = None

    def begin_sample(self, sample: ControlSample) -> None:
        """Take in the sample: state, references, target, and the plan shifted in time."""
        newton, n_x = self.newton, self.model.n_x
        if self.config.disturbance_compensation:
            self._disturbance = sample.estimate.disturbance
        self._last_command = sample.previous_command
        self.inputs_finite = (
            _is_finite(sample.estimate.x)
            and _is_finite(self._disturbance)
            and _is_finite(sample.reference.ravel())
        )
        if not self.inputs_finite:
            return
        if not self._first and len(self._full) > n_x:
            self._full[n_x:] = newton.advance(self._full, sample.previous_command)[n_x:]
        self._full[:n_x] = sample.estimate.x
        known = len(sample.reference)
        reference = newton.reference
        # `reference` holds r(t+1) … r(t+N), the last known one held to the end of the horizon.
        reference[:, : known - 1] = sample.reference[1:].T
        reference[:, known - 1 :] = sample.reference[-1][:, None]
        asked = goal = sample.reference[-1]
        if self._goal_limits is not None:
            # A steady state beyond a soft limit would be fought over for ever.
            goal = np.clip(asked, self._goal_limits[:, 0], self._goal_limits[:, 1])
        previous_target = self.target
        self.target = target = self._target_for(goal)
        if target.projected or goal is not asked:
            # What cannot be held must not be striven for either: the objective would pull away
            # from the terminal state.
            reached = target.reference_reached if target.projected else goal
            reference[:] = np.where(reference == asked[:, None], reached[:, None], reference)
        newton.set_problem(self._full, sample.previous_command, self._disturbance, target)
        steady = target.u[:, None]
        self.other_start = None
        if self._first:
            newton.plan[:] = steady
            self._first = False
            return
        newton.plan[:] = newton.plan @ self._shift + steady * self._beyond
        if previous_target is None or target.asked != previous_target.asked:
            # A new reference may lie behind a point where the linearisation sees no way to it
            # (a tail rotor at rest has no thrust slope), or where a local minimum lies.
            self.other_start = np.broadcast_to(steady, newton.plan.shape)

    def _target_for(self, reference: FloatArray) -> Target:
        """The steady state of a reference (n_r,) under the present disturbance."""
        given = (*reference.tolist(), *self._disturbance.tolist())
        if self.target is not None and given == self._solved_for:
            return self.target
        found = self.steady_state.solve(reference, self._disturbance, self.target)
        # A disturbance that no input can hold has no steady state: the last one goes on.
        self.target_is_held = found.converged or self.target is None
        self._solved_for = given if found.converged else ()
        return found if self.target_is_held or self.target is None else self.target

    def prediction(self) -> Prediction:
        """The plan and the trajectory it leads to."""
        newton = self.newton
        period = self.discrete.step_length
        states = np.vstack([self._full[: self.model.n_x], newton.trajectory[: self.model.n_x].T])
        inputs = newton.plan[:, newton.horizon.blocks].T
        return Prediction(
            np.arange(len(states), dtype=np.float64) * period,
            states,
            np.vstack([inputs, inputs[-1]]),
        )

    def fall_back(self, policy: str, reason: str) -> Command:
        """The declared command of a sample whose solve failed.

        Raises
        ------
        SimulationError
            Under the policy ``stop``.
        """
        if policy == "stop":
            raise SimulationError(
                f"newton_mpc: {reason}",
                where="controller",
                remedy="choose another controller.fallback to go on",
            )
        candidates: dict[str, FloatArray | None] = {
            "shifted_plan": self.newton.plan[:, 0].copy(),
            "steady_input": self.target.u.copy() if self.target is not None else None,
            "hold": self._last_command.copy(),
        }
        chosen = candidates[policy]
        if chosen is None or not np.isfinite(chosen).all():
            policy, chosen = "hold", candidates["hold"]
        assert chosen is not None
        return Command(
            np.clip(chosen, self.newton.lower, self.newton.upper),
            Status.FAILED,
            fallback=policy,
            message=f"{reason}; {policy.replace('_', ' ')} acts",
        )


def _message(status: Status, state: NewtonMpcState) -> str:
    words = [status.meaning] if status is Status.RELAXED else []
    if not state.target_is_held:
        words.append("no input holds the estimated disturbance; the last target goes on")
    elif state.target is not None and state.target.projected:
        words.append("the reference is out of reach; the nearest steady state is the target")
    return "; ".join(words)


def _tracking(model: Model, given: Mapping[str, float], sizes: FloatArray) -> Mapping[str, float]:
    """The weights given, with those of what is controlled where none of them is named.

    The usual weights are of angles. A rotor alone on a bench is controlled in its speed, whose
    deviation then counts as a share of its typical size, as a radian does.
    """
    if any(name in given for name in model.controlled):
        return given
    return {
        **given,
        **{name: sizes[model.state_index(name)] ** -2.0 for name in model.controlled},
    }


def typical_sizes(discrete: DiscreteModel) -> FloatArray:
    """How far each state of a model moves within seconds under full inputs, shape (n_x,).

    From rest, each input is held at either limit; the largest excursion counts. It makes one
    terminal price serve angles (rad) and rotor speeds (hundreds of rad/s) alike.
    """
    model = discrete.model
    step = BufferedFunction(discrete.step)
    sizes = np.full(model.n_x, 1e-3)
    lower, upper = model.input_bounds()
    for i in range(model.n_u):
        for bound in (lower[i], upper[i]):
            u = np.zeros(model.n_u)
            u[i] = bound
            start = discrete.initial(model.rest(), np.zeros(model.n_u))
            x = start.copy()
            for _ in range(max(1, round(2.0 / discrete.step_length))):
                x[:] = step.evaluate(x, u, model.parameters.values, np.zeros(model.n_w))[0]
                if not np.isfinite(x).all():
                    break
                sizes = np.maximum(sizes, np.abs(x - start)[: model.n_x])
    return sizes


def _shift_matrix(blocks: npt.NDArray[np.int64]) -> FloatArray:
    """Mean of the plan, one control period later, over each block, shape (n_blocks, n_blocks).

    ``plan @ shift`` is the shifted plan; what a column's sum lacks to one belongs to the time
    beyond the horizon, where the steady-state input acts.
    """
    n = int(blocks[-1]) + 1
    shift = np.zeros((n, n))
    periods = np.bincount(blocks)
    for k, block in enumerate(blocks):
        if k + 1 < len(blocks):
            shift[blocks[k + 1], block] += 1.0 / periods[block]
    return shift


def _is_finite(vector: FloatArray) -> bool:
    """Whether no component is NaN or infinite; a sum shows either."""
    return math.isfinite(sum(vector.tolist()))


def _positive(weights: Mapping[str, float]) -> dict[str, float]:
    return {name: weight for name, weight in weights.items() if weight > 0}
