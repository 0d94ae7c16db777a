"""Linear model predictive control around the steady states of the nonlinear model.

The model is linearised, its prediction condensed to the future inputs, and one quadratic program a
sample gives all of them: horizon, blocks and objective are those of ``newton_mpc``. Beyond the
horizon the cost to go of the unconstrained problem counts (Rawlings, Mayne & Diehl, "Model
Predictive Control", 2017, ch. 1.3 and 2.5), so that without active limits the law is the
linear-quadratic regulator.

Where the linear model is taken:

- ``fixed``: at one operating point. All matrices are made before the run.
- ``target``: at the steady state of the present reference.
- ``current``: at the present estimate and the last command, again at each sample.

The deviations are from the nonlinear model's steady state under the observer's disturbance: with an
observer that estimates them there is no offset, wherever the matrices come from (Pannocchia &
Rawlings 2003, AIChE J. 49). A rotor at rest has a thrust without slope (ω|ω|): a linear model in
which an input has lost most of its effect is not used, that of the operating point stands in.

The prediction: with Δx = x − x_s and v = u − u_s the distances to a steady state, and δ what the
linear model drifts by there (zero where it was linearised at that state),

    Δx⁺ = A Δx + B v + δ        Δx_k = Aᵏ Δx_0 + Σ_i A^{k−1−i} (B v_i + δ)

The inputs are constant over blocks. The objective is that of
:class:`~trms_cli.controllers.horizon.Horizon`, as a sum of squares |G v + e_0|² + ….
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from time import perf_counter
from typing import Literal

import numpy as np

from trms_cli.controllers.controller import Command, ControlSample, ControlSetup, Prediction, Status
from trms_cli.controllers.fallback import NOT_FINITE, Policy, are_finite, fall_back
from trms_cli.controllers.horizon import (
    HorizonSettings,
    NotNegative,
    SoftLimits,
    Weights,
    blocks_of,
    check_names,
    check_problem,
)
from trms_cli.controllers.reference_forecast import ReferenceForecast
from trms_cli.core.arrays import FloatArray, IntArray
from trms_cli.core.compilation import BufferedFunction
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.qp import Daqp, Qp, QpResult, QpSolver, solve_or_fail
from trms_cli.models.discretisation import discretise
from trms_cli.models.linearisation import Linearisation, require_drivable
from trms_cli.models.model import names
from trms_cli.models.steady_state import SteadyState, Target

_KEY = "controller.operating_point"
#: Least part of its effect at the operating point that an input must have in a linear model.
_LEAST_EFFECT = 0.3
#: A target whose inputs moved less keeps its linear model, V.
_SAME_TARGET = 0.01


@dataclass(frozen=True)
class StageCost:
    """Weights of the objective in the model's order."""

    #: (n,) array; q of the squared deviation of each state, 1/unit²; memory of the input path
    #: included
    states: FloatArray
    rates: FloatArray  #: (n,) array; d of the squared mean rate of a state over a period, s²/unit²
    #: ``inputs``, ``moves``: (n_u,) arrays; ρ of the deviation from the steady-state input and s of
    #: the change, 1/V²
    inputs: FloatArray
    moves: FloatArray
    period: float  #: T, s

    def terminal(self, A: FloatArray, B: FloatArray) -> FloatArray:
        """Root L of the cost to go |L (Δx, v_last)|² of the unconstrained problem.

        The Riccati equation of the state with the last input beside it, whose stage cost is that
        of a period: the state that it leads to, the rate on the way, the input and its change.

        Raises ConfigurationError if there is no solution.
        """
        from scipy.linalg import solve_discrete_are

        n, n_u = B.shape
        F, G = np.zeros((n + n_u, n + n_u)), np.vstack([B, np.eye(n_u)])
        F[:n, :n] = A
        last = np.zeros((n_u, n + n_u))
        last[:, n:] = -np.eye(n_u)
        ahead = np.hstack([A, np.zeros((n, n_u)), B])
        difference = ahead.copy()
        difference[:, :n] -= np.eye(n)
        change = np.hstack([last, np.eye(n_u)])
        inputs = np.hstack([np.zeros((n_u, n + n_u)), np.eye(n_u)])
        cost = (
            ahead.T * self.states @ ahead
            + difference.T * (self.rates / self.period**2) @ difference
            + change.T * self.moves @ change
            + inputs.T * self.inputs @ inputs
        )
        m = n + n_u
        try:
            P = solve_discrete_are(F, G, cost[:m, :m], cost[m:, m:], s=cost[:m, m:])
        except (np.linalg.LinAlgError, ValueError) as error:
            raise ConfigurationError(
                f"the cost beyond the horizon has no Riccati solution here: {error}",
                where="controller.operating_point",
                remedy="choose a point with both rotors turning, a weight on inputs or moves, "
                "or terminal=none",
            ) from error
        values, vectors = np.linalg.eigh((P + P.T) / 2)
        return np.asarray(np.sqrt(values.clip(min=0.0))[:, None] * vectors.T)


@dataclass(frozen=True)
class Limits:
    """What inputs and states have to keep."""

    lower: FloatArray  #: Of the inputs, (n_u,), V
    upper: FloatArray  #: (n_u,), V
    moves: FloatArray  #: (n_u,) array; largest change of an input in a period, V; infinite for none
    states: FloatArray  #: (n_limited, 2) array; soft limits of the limited states, in their units
    linear: float  #: Price of violating these by one unit
    quadratic: float  #: Price of the square of the violation


class CondensedProblem:
    """One linear model over one horizon.

    ``A``, ``B``: (n, n), (n, n_u). ``blocks``: (N,); block of each period. ``terminal``: (m, n +
    n_u) or None; L; see :meth:`StageCost.terminal`. ``limited``: states that have soft limits.
    ``hessian``: (n_z, n_z); of the objective in v, block by block; slightly regularised.
    ``limited_slopes``: (n_limited·N, n_z); of the limited states, period by period. ``effect``:
    (n_u,); how far each input held over the whole horizon moves the weighted states.
    """

    #: Added to the Hessian's diagonal, 1/V²: inputs without influence stay where they are.
    regularisation = 1e-9

    def __init__(
        self,
        A: FloatArray,
        B: FloatArray,
        blocks: IntArray,
        cost: StageCost,
        terminal: FloatArray | None,
        limited: list[int],
    ) -> None:
        n, n_u = B.shape
        periods, n_blocks = len(blocks), int(blocks[-1]) + 1
        powers = np.empty((periods + 1, n, n))
        powers[0] = np.eye(n)
        for k in range(periods):
            np.dot(powers[k], A, out=powers[k + 1])
        sums = np.zeros((periods + 1, n, n))
        np.cumsum(powers[:-1], axis=0, out=sums[1:])
        step_response = sums @ B  # of an input from the first period on
        begin = np.searchsorted(blocks, np.arange(n_blocks))
        end = np.append(begin[1:], periods)
        now = np.arange(periods + 1)[:, None]
        slopes = step_response[(now - begin).clip(0)] - step_response[(now - end).clip(0)]
        self._slopes = slopes.transpose(0, 2, 1, 3).reshape(periods + 1, n, n_blocks * n_u)
        self._powers, self._sums = powers, sums
        self._terminal = terminal
        self._states = np.flatnonzero(cost.states)
        self._rates = np.flatnonzero(cost.rates)
        self._root_states = np.sqrt(cost.states[self._states])
        self._root_rates = np.sqrt(cost.rates[self._rates]) / cost.period
        ends = np.zeros((n_u, n_blocks * n_u))
        ends[:, -n_u:] = np.eye(n_u)
        self._G = self._errors(self._slopes, ends)
        difference = np.eye(n_blocks * n_u) - np.eye(n_blocks * n_u, k=-n_u)
        self.difference = difference
        self._moves = np.tile(cost.moves, n_blocks)
        inputs = (np.bincount(blocks)[:, None] * cost.inputs).ravel()
        self.hessian = 2.0 * (
            self._G.T @ self._G + np.diag(inputs) + difference.T * self._moves @ difference
        ) + self.regularisation * np.eye(n_blocks * n_u)
        self.limited_slopes = self._slopes[1:, limited].reshape(-1, n_blocks * n_u)
        self._limited = limited
        self.effect = np.sqrt(
            (self._root_states[:, None] * step_response[-1, self._states]) ** 2
        ).sum(0)

    def free(self, start: FloatArray, drift: FloatArray) -> FloatArray:
        """Δx_0 … Δx_N with v = 0, shape (N + 1, n)."""
        return np.asarray(self._powers @ start + self._sums @ drift)

    def gradient(self, free: FloatArray, goals: FloatArray, last: FloatArray) -> FloatArray:
        """Of the objective at v = 0.

        ``free``: (N + 1, n); from :meth:`free`. ``goals``: (N, n); where the states should be,
        relative to x_s. ``last``: (n_u,); the last command, relative to u_s.
        """
        shifted = free.copy()
        shifted[1:] -= goals
        errors = self._errors(shifted[:, :, None], np.zeros((len(last), 1)), free)[:, 0]
        gradient = 2.0 * (self._G.T @ errors)
        gradient[: len(last)] -= 2.0 * self._moves[: len(last)] * last
        return np.asarray(gradient)

    def states(self, free: FloatArray, v: FloatArray) -> FloatArray:
        """Δx_0 … Δx_N under the inputs v (n_z,), shape (N + 1, n)."""
        return np.asarray(free + self._slopes @ v)

    def program(
        self,
        gradient: FloatArray,
        free: FloatArray,
        limits: Limits,
        x_s: FloatArray,
        u_s: FloatArray,
        last: FloatArray,
    ) -> Qp:
        """The quadratic program in v: rows of limited moves (hard), then of states (soft).

        ``gradient``, ``free``: from :meth:`gradient` and :meth:`free`. ``x_s``, ``u_s``: the steady
        state. ``last``: (n_u,); the last command, relative to u_s.
        """
        blocks = len(gradient) // len(last)
        lower, upper = (np.tile(bound - u_s, blocks) for bound in (limits.lower, limits.upper))
        moves, before = np.tile(limits.moves, blocks), np.zeros(len(gradient))
        before[: len(last)] = last
        hard = np.isfinite(moves)
        present = (free[1:, self._limited] + x_s[self._limited]).ravel()
        ranges = np.tile(limits.states, (len(free) - 1, 1))
        soft = len(present)
        return Qp(
            self.hessian,
            gradient,
            np.concatenate([self.difference[hard], self.limited_slopes]),
            np.concatenate([lower, (before - moves)[hard], ranges[:, 0] - present]),
            np.concatenate([upper, (before + moves)[hard], ranges[:, 1] - present]),
            np.concatenate([np.full(hard.sum(), np.inf), np.full(soft, limits.linear)]),
            np.concatenate([np.ones(hard.sum()), np.full(soft, limits.quadratic)]),
        )

    def _errors(
        self, along: FloatArray, ends: FloatArray, moving: FloatArray | None = None
    ) -> FloatArray:
        """Weighted errors of trajectories (N + 1, n, columns) and last inputs (n_u, columns).

        ``moving`` (N + 1, n), where it is given, is what rates and the end are taken of.
        """
        columns = along.shape[2]
        path = along if moving is None else moving[:, :, None]
        at = self._root_states[:, None] * along[1:, self._states]
        rate = self._root_rates[:, None] * np.diff(path[:, self._rates], axis=0)
        parts = [at.reshape(-1, columns), rate.reshape(-1, columns)]
        if self._terminal is not None:
            parts.append(self._terminal @ np.vstack([path[-1], ends]))
        return np.concatenate(parts)


@dataclass(frozen=True, kw_only=True)
class LinearMpc(HorizonSettings):
    """Linear MPC."""

    #: Where the linear model is taken
    linearisation: Literal["fixed", "target", "current"] = "current"
    #: Controlled angles of ``fixed``, rad; also of the cost beyond the horizon
    operating_point: Mapping[str, float] = field(default_factory=lambda: {"alpha_h": 0.5})
    rate_weights: Mapping[str, NotNegative] = field(
        default_factory=lambda: {"alpha_v": 0.73, "alpha_h": 0.36}
    )
    move_weights: Mapping[str, NotNegative] = field(
        default_factory=lambda: {"u_v": 0.01, "u_h": 0.02}
    )
    #: Whether what is beyond the horizon counts, by the cost to go of the Riccati equation
    terminal: Literal["riccati", "none"] = "riccati"
    #: What acts when a solve fails: the last plan shifted in time, the last command, the
    #: steady-state input of the reference, or the end of the run
    fallback: Policy = "shifted_plan"
    qp: QpSolver = field(default_factory=Daqp)

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

    ``plan``: (n_u, n_blocks); V; only with ``age``, the control periods since it was made, None
    before the first.
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

        def of_states(values: Mapping[str, float]) -> FloatArray:
            row = [values.get(name, 0.0) for name in model.state_names]
            return np.array(row + [0.0] * n_memory)

        def of_inputs(values: Mapping[str, float], default: float) -> FloatArray:
            return np.array([values.get(name, default) for name in inputs])

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
        self._forecast = ReferenceForecast(config.forecast_periods, len(controlled))
        self._last = setup.first_command.copy()
        self._free = np.zeros((len(self.blocks) + 1, self.discrete.n_x))
        self.plan = np.zeros((model.n_u, int(self.blocks[-1]) + 1))
        self.age: int | None = None
        self._has_started = False

    def _condensed(self, A: FloatArray, B: FloatArray) -> CondensedProblem:
        return CondensedProblem(A, B, self.blocks, self._cost, self._root, self._limited)

    def begin_sample(self, sample: ControlSample) -> str:
        """Take in the sample; why it cannot be answered, empty if it can."""
        if self.age is not None:
            self.age += 1
        x, w = sample.estimate.x, sample.estimate.disturbance
        if not are_finite(x, w, sample.reference):
            return NOT_FINITE
        n_x = self.model.n_x
        if self._has_started and len(self._full) > n_x:
            at = self._full, sample.previous_command, self.model.parameters.values
            after = self._step.evaluate(*at, self._disturbance)[0]
            self._full[n_x:] = after[n_x:]
        self._has_started = True
        self._full[:n_x] = x
        self._last = sample.previous_command
        if self.config.disturbance_compensation:
            self._disturbance = w.copy()
        references = sample.reference
        if len(references) == 1:
            references = self._forecast.update(references[0])
        count = len(references)
        self._goals[: count - 1] = references[1:]
        self._goals[count - 1 :] = request = references[-1]
        goal = np.clip(request, self._goal_limits[:, 0], self._goal_limits[:, 1])
        key = (*goal.tolist(), *self._disturbance.tolist())
        if self.target is None or key != self._solved_for:
            target = self.steady.solve(goal, self._disturbance, self.target)
            self._solved_for = key if target.converged else ()
            if target.converged:
                self.target = target
                self._at_target = self.discrete.initial(target.x, target.u)
        if self.target is None:
            return "nothing holds the rig at the estimated disturbance"
        reached = self.target.reference_reached if self.target.projected else goal
        # What cannot be held must not be striven for.
        self._goals[:] = np.where(self._goals == request, reached, self._goals)
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

    def condensed_here(self) -> tuple[CondensedProblem, FloatArray]:
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

    def _effective(self, condensed: CondensedProblem) -> CondensedProblem:
        """A prediction in which every input does something, else that of the operating point."""
        enough = bool((condensed.effect >= _LEAST_EFFECT * self._fixed.effect).all())
        return condensed if enough else self._fixed

    def solved(
        self, condensed: CondensedProblem, drift: FloatArray, sample: ControlSample
    ) -> QpResult:
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
        result, self._workspace = solve_or_fail(self.config.qp, self._workspace, qp)
        return result

    def follow(self, v: FloatArray) -> FloatArray:
        """Make the solution the plan; its first command."""
        assert self.target is not None
        plan = v.reshape(self.plan.shape, order="F") + self.target.u[:, None]
        self.plan = np.clip(plan, self.lower[:, None], self.upper[:, None])
        self.age = 0
        return self.plan[:, 0].copy()

    def prediction(self, condensed: CondensedProblem, v: FloatArray) -> Prediction:
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
            planned = self.plan[:, self.blocks[min(self.age, len(self.blocks) - 1)]]
        bounds, last = (self.lower, self.upper), sample.previous_command
        policy = self.config.fallback
        return fall_back("linear_mpc", policy, reason, planned, self.target, last, bounds)
