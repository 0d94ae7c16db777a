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
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from time import perf_counter
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta

from trms_cli.controllers.controller import Command, ControlSample, ControlSetup, Prediction, Status
from trms_cli.controllers.fallback import NOT_FINITE, Policy, are_finite, fall_back
from trms_cli.controllers.horizon import (
    Horizon,
    HorizonSettings,
    NotNegative,
    Positive,
    SoftLimits,
    TerminalPrice,
    Weights,
    blocks_of,
    check_names,
)
from trms_cli.controllers.newton_region import RegionDesign, TerminalRegion
from trms_cli.controllers.reference_forecast import ReferenceForecast
from trms_cli.core.arrays import FloatArray, IntArray
from trms_cli.core.compilation import BufferedFunction
from trms_cli.core.qp import Daqp, Qp, QpResult, QpSolver, solve_or_fail
from trms_cli.models.discretisation import DiscreteModel, discretise
from trms_cli.models.model import Model, names
from trms_cli.models.steady_state import SteadyState, Target
from trms_cli.models.vector_field import holds_at_rest

_ARMIJO = 1e-4
_STEP_LENGTHS = (1.0, 0.5, 0.25, 0.1, 0.03, 0.01)
#: Added to the Hessian's diagonal (1/V²): inputs without influence stay where they are.
_REGULARISATION = 1e-6
#: Least weights (1/V²) of the rotors' inputs, of their deviation from the steady state, for a model
#: whose friction holds an axis. Inside the friction's cone an input moves nothing and nothing else
#: prices it: it would drift to the cone's edge, where the axis slips at the least error of the
#: estimate, or serve the other axis at every whim of its noise. As large as
#: tracking bears: sines are followed as without (measured: docs/closing-the-loop.md).
_HOLDING_WEIGHTS = {"main": 2e-3, "tail": 3e-5}


@dataclass
class NewtonResult:
    """How the iterations of a sample ended."""

    iterations: int
    converged: bool  #: Whether the last Newton step moved no input by more than the tolerance
    failed: bool  #: Whether there is no usable answer; ``message`` says why
    stalled: bool  #: Whether no step along the Newton direction lowered the merit
    objective: float  #: J of the plan
    merit: float  #: φ of the plan
    violation: float  #: Largest, of a soft limit
    terminal_residual: float  #: Largest, of the terminal constraint
    kkt_residual: float  #: Largest component of the Lagrangian's gradient before the last step
    message: str = ""


class NewtonStep:
    """The iteration, with its plan and buffers.

    ``largest_moves``: (n_u,); largest change of an input in one control period, V; infinite for
    none. ``plan``: (n_u, n_blocks); the present inputs; always within the bounds. ``reference``:
    (n_r, N); to be filled before :meth:`solve`. ``trajectory``: (n_full, N); states that the plan
    leads to.
    """

    def __init__(self, horizon: Horizon, qp: QpSolver, largest_moves: FloatArray) -> None:
        model = horizon.model
        self.horizon = horizon
        self._qp, self._workspace = qp, qp.start()
        self.lower, self.upper = model.input_bounds()
        self.plan = np.zeros((model.n_u, horizon.n_blocks), order="F")
        self.reference = horizon.arguments["r"]
        self.trajectory = horizon.linearise.outputs[0].copy()
        self.linearise_time = self.qp_time = 0.0
        self._step = BufferedFunction(horizon.discrete.step)
        self._step.inputs[2][:] = model.parameters.values
        self._constant_terms()
        self._program_rows(largest_moves)

    def _constant_terms(self) -> None:
        """The part of the Hessian that does not depend on the trajectory: inputs and moves."""
        horizon = self.horizon
        inputs = names(horizon.model.inputs)
        n_u, n_blocks, n = len(inputs), horizon.n_blocks, horizon.n_z
        periods = np.bincount(horizon.blocks)
        rho = np.array([horizon.weights.inputs.get(name, 0.0) for name in inputs])
        s = np.array([horizon.weights.moves.get(name, 0.0) for name in inputs])
        self._difference = difference = np.eye(n) - np.eye(n, k=-n_u)
        self._constant_hessian = 2.0 * (
            np.diag((periods[:, None] * rho).ravel())
            + difference.T * np.tile(s, n_blocks) @ difference
        ) + _REGULARISATION * np.eye(n)
        limits = [horizon.soft_limits.states[name] for name in horizon.limited]
        self._limits = np.array(limits).reshape(-1, 2)
        self._limited = [horizon.model.state_index(name) for name in horizon.limited]

    def _program_rows(self, largest_moves: FloatArray) -> None:
        """Rows of the QP that do not change, and room for those that do.

        First the terminal equality, or the one row of a terminal region (soft, at their
        exact-penalty price), then the changes between blocks of the inputs whose rate is limited
        (hard).
        """
        horizon, n = self.horizon, self.horizon.n_z
        terminal = horizon.terminal
        n_terminal = horizon.n_terminal
        bound = np.tile(largest_moves, horizon.n_blocks)
        self._rate_chosen = np.isfinite(bound)
        self.largest_moves = largest_moves
        self._rate_limited = bool(self._rate_chosen.any())
        rate_bound = bound[self._rate_chosen]
        m = n_terminal + len(rate_bound)
        self._n_terminal = n_terminal
        self._rows = np.zeros((m, n))
        self._rows[n_terminal:] = self._difference[self._rate_chosen]
        # Bounds of the unknowns (block by block, input by input), then of the rows. They are for
        # the inputs and moves themselves; a QP is about their change.
        self._lowest = np.concatenate([np.tile(self.lower, horizon.n_blocks), np.zeros(m)])
        self._highest = np.concatenate([np.tile(self.upper, horizon.n_blocks), np.zeros(m)])
        self._lowest[n + n_terminal :] = -rate_bound
        self._highest[n + n_terminal :] = rate_bound
        if horizon.has_region:  # inside is as good as on its edge
            self._lowest[n : n + n_terminal] = -np.inf
        self._present = np.zeros(n + m)
        self._linear, self._quadratic = np.full(m, np.inf), np.ones(m)
        if terminal is not None:
            self._linear[:n_terminal] = terminal.linear
            self._quadratic[:n_terminal] = terminal.quadratic

    def set_problem(
        self, full: FloatArray, u_previous: FloatArray, disturbance: FloatArray, target: Target
    ) -> None:
        """Initial state (with memory), last command, disturbances and target of this sample."""
        arguments = self.horizon.arguments
        arguments["x0"][:] = full
        arguments["u_previous"][:] = u_previous
        arguments["w"][:] = disturbance
        arguments["x_s"][:] = target.x
        arguments["u_s"][:] = target.u

    def set_region(self, centre: FloatArray, root: FloatArray, level: float) -> None:
        """The terminal region of this sample, for a horizon that ends in one."""
        arguments = self.horizon.arguments
        arguments["centre"][:] = centre
        arguments["root"][:] = root
        arguments["radius"][:] = np.sqrt(level)

    def advance(self, full: FloatArray, u: FloatArray) -> FloatArray:
        """The full state one control period later without disturbance, for its memory."""
        step = self._step
        step.inputs[0][:] = full
        step.inputs[1][:] = u
        step()
        return step.outputs[0]

    def merit(self, plan: FloatArray) -> float:
        """φ of a plan; the outputs of ``horizon.evaluate`` are then those of it."""
        self.horizon.arguments["z"][:] = plan
        self.horizon.evaluate()
        return float(self.horizon.evaluate.outputs[3][0])

    def solve(
        self, max_iterations: int, tolerance: float, other: FloatArray | None = None
    ) -> NewtonResult:
        """Iterate from the present plan; the plan never gets worse in merit.

        ``tolerance``: V. ``other``: (n_u, n_blocks) array; a second plan to start from. A single
        iteration starts from the better of the two; more are made from both, and the better end is
        kept.
        """
        if other is None:
            return self._solve(max_iterations, tolerance)
        if max_iterations == 1:
            if not self.merit(self.plan) <= self.merit(other):
                self.plan[:] = other
            return self._solve(1, tolerance)
        first = self._solve(max_iterations, tolerance)
        plan, trajectory = self.plan.copy(), self.trajectory.copy()
        self.plan[:] = other
        second = self._solve(max_iterations, tolerance)
        if second.failed or (second.merit >= first.merit and not first.failed):
            # The second's end is the worse: go back to the first's.
            self.plan[:], self.trajectory[:] = plan, trajectory
            first.iterations += second.iterations
            return first
        second.iterations += first.iterations
        return second

    def _solve(self, max_iterations: int, tolerance: float) -> NewtonResult:
        if self._rate_limited:
            self.limit_rates(self.plan)
        outcome = NewtonResult(0, False, False, False, np.nan, np.nan, np.nan, np.nan, np.nan)
        for iteration in range(1, max_iterations + 1):
            outcome.iterations = iteration
            self._iterate(outcome, tolerance)
            if outcome.failed or outcome.converged or outcome.stalled:
                break
        return outcome

    def _iterate(self, outcome: NewtonResult, tolerance: float) -> None:
        begin = perf_counter()
        horizon = self.horizon
        horizon.arguments["z"][:] = self.plan
        horizon.linearise()
        trajectory, terminal, _, merit, _, gradient, root, terminal_slope, limited_slopes = (
            horizon.linearise.outputs
        )
        merit_now = float(merit[0])
        if not merit_now < np.inf:
            self.linearise_time += perf_counter() - begin
            outcome.failed, outcome.message = True, "the predicted trajectory is not finite"
            return
        hessian = root.T @ root
        hessian *= 2.0
        hessian += self._constant_hessian
        z = self.plan.ravel(order="F")
        qp = self._program(hessian, gradient, z, terminal_slope, terminal)
        middle = perf_counter()
        self.linearise_time += middle - begin
        result, self._workspace = solve_or_fail(self._qp, self._workspace, qp)
        if result.solved and self._limited:
            result = self._within_limits(qp, result, trajectory[self._limited], limited_slopes)
        self.qp_time += perf_counter() - middle
        if not result.solved:
            outcome.failed = True
            outcome.message = f"the QP was not solved: {result.message}"
            return
        step = result.z
        curvature = hessian @ step
        outcome.kkt_residual = _largest(curvature)
        outcome.converged = _largest(step) <= tolerance
        self._move(z, step, float(step @ curvature), merit_now, outcome)

    def _program(
        self,
        hessian: FloatArray,
        gradient: FloatArray,
        z: FloatArray,
        terminal_slope: FloatArray,
        terminal: FloatArray,
    ) -> Qp:
        n, n_t, present = len(z), self._n_terminal, self._present
        present[:n] = z
        if n_t:
            self._rows[:n_t] = terminal_slope
            present[n : n + n_t] = terminal
        if self._rate_limited:
            moves = self._difference @ z
            moves[: len(self.lower)] -= self.horizon.arguments["u_previous"]
            present[n + n_t :] = moves[self._rate_chosen]
        return Qp(
            hessian,
            gradient,
            self._rows,
            self._lowest - present,
            self._highest - present,
            self._linear,
            self._quadratic,
        )

    def _within_limits(
        self, qp: Qp, result: QpResult, values: FloatArray, slopes: FloatArray
    ) -> QpResult:
        """Solve again with the soft state limits, if the solution without them breaks one.

        A solution that keeps them is the solution of both programs; most samples end here.
        """
        present = values.ravel(order="F")
        predicted = present + slopes @ result.z
        lower = np.tile(self._limits[:, 0], self.horizon.n_periods)
        upper = np.tile(self._limits[:, 1], self.horizon.n_periods)
        if bool(((predicted >= lower) & (predicted <= upper)).all()):
            return result
        limits, m = self.horizon.soft_limits, len(present)
        extended = Qp(
            qp.hessian,
            qp.gradient,
            np.concatenate([qp.rows, slopes]),
            np.concatenate([qp.lower, lower - present]),
            np.concatenate([qp.upper, upper - present]),
            np.concatenate([qp.linear, np.full(m, limits.linear)]),
            np.concatenate([qp.quadratic, np.full(m, limits.quadratic)]),
        )
        result, self._workspace = solve_or_fail(self._qp, self._workspace, extended)
        return result

    def _move(
        self,
        z: FloatArray,
        step: FloatArray,
        curvature: float,
        merit_now: float,
        outcome: NewtonResult,
    ) -> None:
        """Go along the Newton direction until the merit falls (Armijo); else stay.

        The QP's model of the merit is convex, so that the full step lowers it by at least half of
        stepᵀ H step: a descent direction of the merit itself.
        """
        evaluate, trial = self.horizon.evaluate, self.horizon.arguments["z"]
        slack = 1e-12 * (1.0 + abs(merit_now))
        for length in _STEP_LENGTHS:
            trial[:] = (z + length * step).reshape(trial.shape, order="F")
            evaluate()
            if float(evaluate.outputs[3][0]) <= merit_now - _ARMIJO * length * curvature + slack:
                # Rounding may leave a bound by a hair.
                np.clip(trial, self.lower[:, None], self.upper[:, None], out=self.plan)
                self._report(evaluate.outputs, outcome)
                return
        outcome.stalled = not outcome.converged
        self._report(self.horizon.linearise.outputs[:5], outcome)

    def _report(self, outputs: Sequence[FloatArray], outcome: NewtonResult) -> None:
        trajectory, terminal, objective, merit, violation = outputs
        self.trajectory[:] = trajectory
        outcome.objective = float(objective[0])
        outcome.merit = float(merit[0])
        outcome.violation = float(violation[0])
        if not self._n_terminal:
            outcome.terminal_residual = 0.0
        elif self.horizon.has_region:
            outcome.terminal_residual = max(0.0, float(terminal[0]))
        else:
            outcome.terminal_residual = float(np.abs(terminal).max())

    def limit_rates(self, plan: FloatArray) -> None:
        """Bring a plan within the rate limits, block after block from the last command."""
        previous = self.horizon.arguments["u_previous"]
        for block in range(self.horizon.n_blocks):
            previous = np.clip(
                plan[:, block], previous - self.largest_moves, previous + self.largest_moves
            )
            plan[:, block] = previous


def _largest(vector: FloatArray) -> float:
    """Largest absolute component; cheaper than an array of absolute values."""
    return max(float(vector.max()), -float(vector.min()))


class TerminalRegions:
    """Regions of the targets met so far, and which iteration a target calls for.

    ``newton``: the iteration whose horizon ends in a region. ``equality``: the iteration that ends
    in the steady state. Made beforehand, since a run has no time to compile it when a target turns
    up that has no region.

    A region serves all targets within the same cell of a grid (a share of the states' typical
    sizes and of the inputs' range): an estimated disturbance moves the target a little at every
    sample, and a design takes milliseconds.
    """

    cell = 0.01

    def __init__(self, design: RegionDesign, newton: NewtonStep, equality: NewtonStep) -> None:
        self._design, self._newton, self._equality = design, newton, equality
        model = newton.horizon.model
        self._grid = self.cell * np.concatenate(
            [newton.horizon.scale, np.maximum(model.input_bounds()[1], 1e-3)]
        )
        self._regions: dict[tuple[float, ...], TerminalRegion | None] = {}
        self._target: Target | None = None
        self._centre = np.zeros(0)
        #: Of the present target, None where there is none.
        self.region: TerminalRegion | None = None

    def engine_for(
        self, target: Target, disturbance: FloatArray, present: NewtonStep
    ) -> NewtonStep:
        """The iteration for a target, with the plan and the trajectory of the present one."""
        if target is not self._target:
            self._target, self._centre = target, self._design.centre(target)
            key = tuple(np.round(np.concatenate([target.x, target.u]) / self._grid).tolist())
            if key not in self._regions:
                self._regions[key] = self._design.at(self._centre, disturbance)
            self.region = self._regions[key]
        if self.region is None:
            engine = self._equality
        else:
            engine = self._newton
            engine.set_region(self._centre, self.region.root, self.region.level)
        if engine is not present:
            engine.plan[:], engine.trajectory[:] = present.plan, present.trajectory
        return engine

    def tail(self, newton: NewtonStep, target: Target) -> FloatArray:
        """What the plan goes on with beyond its end: the local law, or the steady-state input.

        To be asked before :meth:`engine_for`, for a target that has not changed.
        """
        if self.region is None or target is not self._target:
            return target.u
        end = np.concatenate([newton.trajectory[:, -1], newton.plan[:, -1]])
        command = target.u + self.region.gain @ (end - self._centre)
        return np.asarray(np.clip(command, newton.lower, newton.upper))


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
        self.steady_state = SteadyState(model, {name: q for name, q in weights.items() if q > 0})
        self._memory = list(model.path_memory)
        # The plan may end at any value of what remembers the path: none of it is missed.
        terminal_sizes = sizes.copy()
        terminal_sizes[self._memory] = np.inf

        def engine(*, region: bool) -> NewtonStep:
            horizon = Horizon(
                self.discrete,
                blocks,
                Weights(weights, config.rate_weights, input_weights, config.move_weights),
                SoftLimits(config.soft_limits, config.soft_linear, config.soft_quadratic),
                TerminalPrice(config.terminal_linear, config.terminal_quadratic, region)
                if config.terminal != "none"
                else None,
                terminal_sizes,
            )
            return NewtonStep(horizon, config.qp, largest_moves)

        inputs = names(model.inputs)
        check_names(config.input_rate_limits, inputs, "input_rate_limits")
        rates = np.array([config.input_rate_limits.get(name, np.inf) for name in inputs])
        largest_moves = rates * setup.sample_time
        input_weights = dict(config.input_weights)
        if holds_at_rest(model):
            for rotor, name in model.rotors.items():
                least = _HOLDING_WEIGHTS.get(rotor, 0.0)
                input_weights[name] = max(input_weights.get(name, 0.0), least)
        limits = [config.soft_limits.get(name, (-np.inf, np.inf)) for name in model.controlled]
        self._goal_limits = np.array(limits) if config.soft_limits else None
        self.newton = engine(region=config.terminal == "quasi_infinite")
        #: Regions by target, and the equality for targets without; None with another terminal.
        self.regions = (
            TerminalRegions(
                RegionDesign(
                    self.newton.horizon,
                    largest_moves,
                    config.terminal_weight,
                    config.terminal_decay,
                ),
                self.newton,
                engine(region=False),
            )
            if config.terminal == "quasi_infinite"
            else None
        )
        self._shift = _shift_matrix(blocks)
        self._beyond = 1.0 - self._shift.sum(axis=0)
        self._forecast = ReferenceForecast(config.forecast_periods, len(model.controlled))
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
        n_x = self.model.n_x
        if self.config.disturbance_compensation:
            self._disturbance = sample.estimate.disturbance
        self._last_command = sample.previous_command
        self.inputs_finite = are_finite(sample.estimate.x, self._disturbance, sample.reference)
        if not self.inputs_finite:
            return
        if not self._first and len(self._full) > n_x:
            self._full[n_x:] = self.newton.advance(self._full, sample.previous_command)[n_x:]
        self._full[:n_x] = sample.estimate.x
        references = sample.reference
        if len(references) == 1:
            references = self._forecast.update(references[0])
        request = goal = references[-1]
        if self._goal_limits is not None:
            # A steady state beyond a soft limit would be fought over for ever.
            goal = np.clip(request, self._goal_limits[:, 0], self._goal_limits[:, 1])
        previous_target = self.target
        self.target = target = self._target_for(goal)
        tail = target.u
        if self.regions is not None:
            tail = self.regions.tail(self.newton, target)
            self.newton = self.regions.engine_for(target, self._disturbance, self.newton)
        newton = self.newton
        count = len(references)
        reference = newton.reference
        # `reference` holds r(t+1) … r(t+N), the last known one held to the end of the horizon.
        reference[:, : count - 1] = references[1:].T
        reference[:, count - 1 :] = references[-1][:, None]
        if target.projected or goal is not request:
            # What cannot be held must not be striven for either: the objective would pull away
            # from the terminal state.
            reached = target.reference_reached if target.projected else goal
            reference[:] = np.where(reference == request[:, None], reached[:, None], reference)
        newton.set_problem(self._full, sample.previous_command, self._disturbance, target)
        steady = target.u[:, None]
        self.other_start = None
        if self._first:
            newton.plan[:] = steady
            self._first = False
            return
        newton.plan[:] = newton.plan @ self._shift + tail[:, None] * self._beyond
        foreseen = count > len(sample.reference)
        if not foreseen and (
            previous_target is None or target.reference != previous_target.reference
        ):
            # A new reference may lie behind a point where the linearisation sees no way to it
            # (a tail rotor at rest has no thrust slope), or where a local minimum lies.
            self.other_start = np.broadcast_to(steady, newton.plan.shape)

    def _target_for(self, reference: FloatArray) -> Target:
        """The steady state of a reference (n_r,) under the present disturbance."""
        key = (*reference.tolist(), *self._disturbance.tolist())
        memory = None
        if self._memory:  # an index that picks nothing would cost a microsecond a sample
            memory = self._full[self._memory]
            key += tuple(memory.tolist())
        if self.target is not None and key == self._solved_for:
            return self.target
        target = self.steady_state.solve(reference, self._disturbance, self.target, memory)
        # A disturbance that no input can hold has no steady state: the last one goes on.
        self.target_is_held = target.converged or self.target is None
        self._solved_for = key if target.converged else ()
        return target if self.target_is_held or self.target is None else self.target

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

    def target_words(self) -> list[str]:
        """What a person should know of the target."""
        if not self.target_is_held:
            return ["no input holds the estimated disturbance; the last target goes on"]
        if self.target is not None and self.target.projected:
            return ["the reference is out of reach; the nearest steady state is the target"]
        return []

    def fall_back(self, who: str, policy: Policy, reason: str) -> Command:
        """The declared command of a sample whose solve failed."""
        newton = self.newton
        bounds, planned = (newton.lower, newton.upper), newton.plan[:, 0]
        return fall_back(who, policy, reason, planned, self.target, self._last_command, bounds)


def _tracking(model: Model, weights: Mapping[str, float], sizes: FloatArray) -> Mapping[str, float]:
    """The weights given, with those of what is controlled where none of them is named.

    The usual weights are of angles. A rotor alone on a bench is controlled in its speed, whose
    deviation then counts as a share of its typical size, as a radian does.
    """
    if any(name in weights for name in model.controlled):
        return weights
    return {
        **weights,
        **{name: sizes[model.state_index(name)] ** -2.0 for name in model.controlled},
    }


def _shift_matrix(blocks: IntArray) -> FloatArray:
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


@dataclass(frozen=True, kw_only=True)
class NewtonMpc(HorizonSettings):
    """Newton-type MPC."""

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
    #: What acts when a solve fails: the last plan shifted in time, the last command, the
    #: steady-state input of the reference, or the end of the run
    fallback: Policy = "shifted_plan"
    qp: QpSolver = field(default_factory=Daqp)

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
            return state.fall_back("newton_mpc", self.fallback, NOT_FINITE)
        begin_linearise = newton.linearise_time
        begin_qp = newton.qp_time
        outcome = newton.solve(self.max_iterations, self.tolerance, state.other_start)
        if outcome.failed:
            return state.fall_back("newton_mpc", self.fallback, outcome.message)
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
    words += state.target_words()
    if state.regions is not None and state.regions.region is None:
        words.append("this target has no terminal region; its steady state ends the horizon")
    return "; ".join(words)
