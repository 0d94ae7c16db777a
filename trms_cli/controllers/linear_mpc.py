"""Linear model predictive control around the steady states of the nonlinear model.

The model is linearised, its prediction condensed to the future inputs
(:mod:`trms_cli.controllers.linear_prediction`), and one quadratic program a sample gives all of
them: horizon, blocks and objective are those of ``newton_mpc``. Beyond the horizon the cost to go
of the unconstrained problem counts (Rawlings, Mayne & Diehl, "Model Predictive Control", 2017,
ch. 1.3 and 2.5), so that without active limits the law is the linear-quadratic regulator.

Where the linear model is taken:

- ``fixed``: at one operating point. All matrices are made before the run.
- ``target``: at the steady state of the present reference.
- ``current``: at the present estimate and the last command, again at each sample.

The deviations are from the nonlinear model's steady state under the observer's disturbance: with an
observer that estimates them there is no offset, wherever the matrices come from (Pannocchia &
Rawlings 2003, AIChE J. 49). A rotor at rest has a thrust without slope (ω|ω|): a linear model in
which an input has lost most of its effect is not used, that of the operating point stands in.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from time import perf_counter
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
from trms_cli.controllers.fallback import Policy, fall_back
from trms_cli.controllers.linear_prediction import Condensed, Limits, StageCost
from trms_cli.controllers.newton_problem import (
    SoftLimits,
    Weights,
    blocks_of,
    check_names,
    check_problem,
)
from trms_cli.controllers.reference_forecast import ReferenceForecast
from trms_cli.core.compilation import BufferedFunction
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.qp import Daqp, QpResult, QpSolver
from trms_cli.models.discretisation import discretise
from trms_cli.models.linearisation import Linearisation, require_drivable
from trms_cli.models.model import names
from trms_cli.models.steady_state import SteadyState, Target

FloatArray = npt.NDArray[np.float64]
_Positive = Annotated[float, Meta(gt=0)]
_NotNegative = Annotated[float, Meta(ge=0)]
_KEY = "controller.operating_point"
#: Least part of its effect at the operating point that an input must have in a linear model.
_LEAST_EFFECT = 0.3
#: A target whose inputs moved less keeps its linear model, V.
_SAME_TARGET = 0.01


@dataclass(frozen=True, kw_only=True)
class LinearMpc:
    """Linear MPC."""

    sample_time: _Positive = 0.1  #: Control period, s
    #: Where the linear model is taken
    linearisation: Literal["fixed", "target", "current"] = "current"
    #: Controlled angles of ``fixed``, rad; also of the cost beyond the horizon
    operating_point: Mapping[str, float] = field(default_factory=lambda: {"alpha_h": 0.5})
    prediction_horizon: Annotated[int, Meta(ge=2)] = 40  #: N, control periods
    #: Lengths of the blocks over which an input is constant, in control periods
    move_blocks: tuple[int, ...] = (1,) * 10 + (2,) * 5 + (4,) * 5
    #: How many control periods ahead the reference is known, at most N
    preview_horizon: Annotated[int, Meta(ge=0)] = 0
    #: How many control periods ahead a reference that is not known is carried on as the constant,
    #: ramp or sine that it has been (:mod:`trms_cli.controllers.reference_forecast`), at most N
    forecast_horizon: Annotated[int, Meta(ge=0)] = 15
    #: ``state_weights``, ``rate_weights``, ``input_weights``, ``move_weights``: See
    #: :class:`trms_cli.controllers.newton_problem.Weights`
    state_weights: Mapping[str, _NotNegative] = field(
        default_factory=lambda: {"alpha_v": 1.2, "alpha_h": 1.0}
    )
    rate_weights: Mapping[str, _NotNegative] = field(
        default_factory=lambda: {"alpha_v": 0.73, "alpha_h": 0.36}
    )
    input_weights: Mapping[str, _NotNegative] = field(default_factory=dict)
    move_weights: Mapping[str, _NotNegative] = field(
        default_factory=lambda: {"u_v": 0.01, "u_h": 0.02}
    )
    #: Largest change per second, V/s
    input_rate_limits: Mapping[str, _Positive] = field(default_factory=dict)
    #: Limits on states, met if at all possible; in the states' units
    soft_limits: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    soft_linear: _Positive = 100.0  #: Price of violating them
    soft_quadratic: _Positive = 1000.0  #: Price of violating them
    #: Whether what is beyond the horizon counts, by the cost to go of the Riccati equation
    terminal: Literal["riccati", "none"] = "riccati"
    #: Steps of the model's integrator in a control period, where it is linearised on the way
    integration_steps: Annotated[int, Meta(ge=1)] = 1
    #: Whether the steady state is that under the observer's disturbances (offset-free)
    disturbance_compensation: bool = True
    #: What acts when a solve fails: the last plan shifted in time, the last command, the
    #: steady-state input of the reference, or the end of the run
    fallback: Policy = "shifted_plan"
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

    def init(self, setup: ControlSetup) -> LinearMpcState:
        """The linear model, its condensed prediction, and an empty plan."""
        return LinearMpcState(self, setup)

    def step(
        self, state: LinearMpcState, sample: ControlSample, *, want_prediction: bool
    ) -> Command:
        """One sample: target, linear model, quadratic program, command."""
        reason = state.begin_sample(sample)
        if reason:
            return state.fall_back(reason, sample)
        begin = perf_counter()
        condensed, drift = state.condensed_here()
        middle = perf_counter()
        result = state.solved(condensed, drift, sample)
        spent = perf_counter() - middle
        if not result.solved:
            return state.fall_back(f"the QP was not solved: {result.message}", sample)
        u = state.follow(result.z)
        target = state.target
        assert target is not None
        words = "the reference is out of reach; the nearest steady state is the target"
        return Command(
            u,
            Status.OK,
            result.iterations,
            linearise_time=middle - begin,
            qp_time=spent,
            message=words if target.projected else "",
            prediction=state.prediction(condensed, result.z) if want_prediction else None,
            out_of_reach=target.projected,
        )


class LinearMpcState:
    """What changes during a run: target, linear model, plan, memory of the input path.

    Attributes
    ----------
    target : Target or None
    plan : (n_u, n_blocks) array
        V; only with ``age``, the control periods since it was made, None before the first.
    """

    def __init__(self, config: LinearMpc, setup: ControlSetup) -> None:
        model = setup.model
        self.config, self.model = config, model
        inputs, controlled = names(model.inputs), model.controlled
        weights = Weights(
            config.state_weights, config.rate_weights, config.input_weights, config.move_weights
        )
        soft = SoftLimits(config.soft_limits, config.soft_linear, config.soft_quadratic)
        check_problem(model, weights, soft)
        check_names(config.input_rate_limits, inputs, "input_rate_limits")
        positive = {name: q for name, q in weights.states.items() if q > 0}
        if not any(name in positive for name in controlled):
            raise ConfigurationError(
                f"no weight on any of {', '.join(controlled)}",
                where="controller.state_weights",
                remedy=f"controller.state_weights.{controlled[0]}=1.0",
            )
        self.steady = SteadyState(model, positive)
        linear = Linearisation(model, setup.sample_time, self.steady).at(
            config.operating_point, _KEY
        )
        require_drivable(linear, _KEY)
        # Its model lacks the impulses of dry friction, which has no slopes where it holds an axis.
        self.discrete = discretise(
            linear.discrete.model, setup.sample_time, config.integration_steps
        )
        self.blocks = blocks_of(config.prediction_horizon, tuple(config.move_blocks))
        n_memory = linear.discrete.n_x - model.n_x

        def of_states(given: Mapping[str, float]) -> FloatArray:
            row = [given.get(name, 0.0) for name in model.state_names]
            return np.array(row + [0.0] * n_memory)

        def of_inputs(given: Mapping[str, float], default: float) -> FloatArray:
            return np.array([given.get(name, default) for name in inputs])

        self._cost = StageCost(
            of_states(positive),
            of_states({name: d for name, d in weights.rates.items() if name in controlled}),
            of_inputs(weights.inputs, 0.0),
            of_inputs(weights.moves, 0.0),
            setup.sample_time,
        )
        self._root = (
            self._cost.terminal(linear.A, linear.B) if config.terminal == "riccati" else None
        )
        limited = [name for name in model.state_names if name in soft.states]
        self._limited = [model.state_index(name) for name in limited]
        lower, upper = model.input_bounds()
        self.lower, self.upper = lower, upper
        rate = of_inputs(config.input_rate_limits, np.inf) * setup.sample_time
        ranges = np.array([soft.states[name] for name in limited]).reshape(-1, 2)
        self._limits = Limits(lower, upper, rate, ranges, soft.linear, soft.quadratic)
        goal_limits = [soft.states.get(name, (-np.inf, np.inf)) for name in controlled]
        self._goal_limits = np.array(goal_limits)
        self._controlled = [model.state_index(name) for name in controlled]
        self._fixed = self._condensed(linear.A, linear.B)
        self._of_target, self._linearised_for = self._fixed, linear.target.u
        self._step = BufferedFunction(self.discrete.step)
        moving = config.linearisation != "fixed"
        self._slopes = BufferedFunction(self.discrete.slopes("slopes")) if moving else None
        self._workspace = config.qp.start()
        self.target: Target | None = None
        self._solved_for: tuple[float, ...] = ()
        self._disturbance = np.zeros(model.n_w)
        self._full = self.discrete.initial(model.rest(), setup.first_command)
        self._at_target = self._full.copy()
        self._goals = np.zeros((len(self.blocks), len(controlled)))
        ahead = 0 if config.preview_horizon else config.forecast_horizon
        self._forecast = ReferenceForecast(min(ahead, len(self.blocks)), len(controlled))
        self._last = setup.first_command.copy()
        self._free = np.zeros((len(self.blocks) + 1, self.discrete.n_x))
        self.plan = np.zeros((model.n_u, int(self.blocks[-1]) + 1))
        self.age: int | None = None
        self._started = False

    def _condensed(self, A: FloatArray, B: FloatArray) -> Condensed:
        return Condensed(A, B, self.blocks, self._cost, self._root, self._limited)

    def begin_sample(self, sample: ControlSample) -> str:
        """Take in the sample; why it cannot be answered, empty if it can."""
        if self.age is not None:
            self.age += 1
        x, w = sample.estimate.x, sample.estimate.disturbance
        values = x.tolist() + w.tolist() + sample.reference.ravel().tolist()
        if not math.isfinite(sum(values)):
            return "the estimate or the reference is not finite"
        n_x = self.model.n_x
        if self._started and len(self._full) > n_x:
            p, w = self.model.parameters.values, self._disturbance
            after = self._step.evaluate(self._full, sample.previous_command, p, w)[0]
            self._full[n_x:] = after[n_x:]
        self._started = True
        self._full[:n_x] = x
        self._last = sample.previous_command
        if self.config.disturbance_compensation:
            self._disturbance = w.copy()
        references = sample.reference
        if len(references) == 1:
            references = self._forecast.seen(references[0])
        known = len(references)
        self._goals[: known - 1] = references[1:]
        self._goals[known - 1 :] = asked = references[-1]
        goal = np.clip(asked, self._goal_limits[:, 0], self._goal_limits[:, 1])
        given = (*goal.tolist(), *self._disturbance.tolist())
        if self.target is None or given != self._solved_for:
            found = self.steady.solve(goal, self._disturbance, self.target)
            self._solved_for = given if found.converged else ()
            if found.converged:
                self.target = found
                self._at_target = self.discrete.initial(found.x, found.u)
        if self.target is None:
            return "nothing holds the rig at the estimated disturbance"
        reached = self.target.reference_reached if self.target.projected else goal
        # What cannot be held must not be striven for.
        self._goals[:] = np.where(self._goals == asked, reached, self._goals)
        return ""

    def _linearised(
        self, full: FloatArray, u: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Next full state, A and B at a full state and a command."""
        assert self._slopes is not None
        p = self.model.parameters.values
        after, A, B = self._slopes.evaluate(full, u, p, self._disturbance)
        # A single input's B comes as a vector.
        return after.copy(), A.copy(), B.reshape(len(full), -1).copy()

    def condensed_here(self) -> tuple[Condensed, FloatArray]:
        """The prediction to use at this sample, and how its model drifts at the target."""
        target, still = self.target, np.zeros(self.discrete.n_x)
        assert target is not None
        way = self.config.linearisation
        if way == "target":
            if np.abs(target.u - self._linearised_for).max() > _SAME_TARGET:
                _, A, B = self._linearised(self._at_target, target.u)
                self._of_target = self._effective(self._condensed(A, B))
                self._linearised_for = target.u
            return self._of_target, still
        if way == "current":
            after, A, B = self._linearised(self._full, self._last)
            if np.isfinite(A).all() and np.isfinite(B).all():
                here = self._condensed(A, B)
                if self._effective(here) is here:
                    goal = self._at_target
                    drift = after + A @ (goal - self._full) + B @ (target.u - self._last) - goal
                    return here, drift
        return self._fixed, still

    def _effective(self, condensed: Condensed) -> Condensed:
        """A prediction in which every input does something, else that of the operating point."""
        enough = bool((condensed.effect >= _LEAST_EFFECT * self._fixed.effect).all())
        return condensed if enough else self._fixed

    def solved(self, condensed: Condensed, drift: FloatArray, sample: ControlSample) -> QpResult:
        """The quadratic program of this sample; z are the inputs relative to the target's."""
        target = self.target
        assert target is not None
        start = self._full - self._at_target
        free = self._free = condensed.free(start, drift)
        goals = np.zeros((len(self.blocks), len(self._full)))
        goals[:, self._controlled] = self._goals - target.x[self._controlled]
        last = self._last - target.u
        gradient = condensed.gradient(free, goals, last)
        if not math.isfinite(float(gradient.sum())):
            nothing = np.full(len(gradient), np.nan)
            return QpResult(nothing, False, 0, "the predicted trajectory is not finite")
        qp = condensed.program(gradient, free, self._limits, target.x, target.u, last)
        try:
            return self.config.qp.solve(self._workspace, qp)
        except Exception as error:  # an exception of the library is a solve that failed
            self._workspace = self.config.qp.start()
            reason = f"{type(error).__name__}: {error}"
            return QpResult(np.full(len(gradient), np.nan), False, 0, reason)

    def follow(self, v: FloatArray) -> FloatArray:
        """Make the solution the plan; its first command."""
        assert self.target is not None
        plan = v.reshape(self.plan.shape, order="F") + self.target.u[:, None]
        self.plan = np.clip(plan, self.lower[:, None], self.upper[:, None])
        self.age = 0
        return self.plan[:, 0].copy()

    def prediction(self, condensed: Condensed, v: FloatArray) -> Prediction:
        """The plan and the trajectory that the linear model expects of it."""
        assert self.target is not None
        n_x = self.model.n_x
        states = condensed.states(self._free, v)[:, :n_x] + self.target.x
        inputs = self.plan[:, self.blocks].T
        times = np.arange(len(states), dtype=np.float64) * self.discrete.step_length
        return Prediction(times, states, np.vstack([inputs, inputs[-1]]))

    def fall_back(self, reason: str, sample: ControlSample) -> Command:
        """The declared command of a sample that has no solution."""
        planned = None
        if self.age is not None:
            planned = self.plan[:, self.blocks[min(self.age, len(self.blocks) - 1)]].copy()
        return fall_back(
            "linear_mpc",
            self.config.fallback,
            reason,
            {
                "shifted_plan": planned,
                "steady_input": None if self.target is None else self.target.u.copy(),
                "hold": sample.previous_command.copy(),
            },
            (self.lower, self.upper),
        )
