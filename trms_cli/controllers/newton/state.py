"""A sample of the Newton MPC in NumPy: target, shifted plan, terminal region, fall-back.

It acts where :mod:`trms_cli.controllers.newton.engine` does not; ``nmpc`` has it in common.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from trms_cli.controllers.controller import Command, ControlSample, ControlSetup, Prediction, Status
from trms_cli.controllers.fallback import NOT_FINITE, Policy, are_finite, fall_back
from trms_cli.controllers.horizon import Horizon
from trms_cli.controllers.newton.region import RegionDesign, TerminalRegion
from trms_cli.controllers.newton.step import NewtonStep
from trms_cli.controllers.reference_forecast import ReferenceForecast
from trms_cli.core.arrays import FloatArray, IntArray
from trms_cli.core.compilation import BufferedFunction
from trms_cli.models.steady_state import Target

if TYPE_CHECKING:
    from trms_cli.controllers.linear_mpc import LinearMpc
    from trms_cli.controllers.newton_mpc import NewtonMpc

NO_REGION = "this target has no terminal region; its steady state ends the horizon"


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
    most = 16  #: Regions that are remembered, the first one forgotten first

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
                if len(self._regions) == self.most:
                    self._regions.pop(next(iter(self._regions)))
                self._regions[key] = self._design.at(self._centre, disturbance)
            self.region = self._regions[key]
        if self.region is None:
            engine = self._equality
        else:
            engine = self._newton
            engine.set_region(self._centre, self.region.root, self.region.level)
        if engine is not present:
            engine.plan[:], engine.trajectory[:] = present.plan, present.trajectory
            engine.remaining_share = present.remaining_share
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


class NewtonMpcState:
    """What changes during a run: the plan, the target, the memory of the input path."""

    #: A scaled terminal residual above this counts as a relaxed equality.
    relaxed_above = 1e-3

    def __init__(self, config: NewtonMpc | LinearMpc, setup: ControlSetup) -> None:
        problem = config.problem(setup)
        model = problem.model
        self.config, self.model, self.problem = problem.config, model, problem
        self.discrete, self.steady_state = problem.discrete, problem.steady_state
        self._memory = list(model.path_memory)

        def engine(horizon: Horizon) -> NewtonStep:
            return NewtonStep(horizon, config.qp, problem.largest_moves)

        self.newton = engine(problem.horizon)
        #: Regions by target, and the equality for targets without; None with another terminal.
        self.regions: TerminalRegions | None = None
        if config.terminal == "quasi_infinite":
            design = RegionDesign(
                problem.horizon,
                problem.largest_moves,
                config.terminal_weight,
                config.terminal_decay,
            )
            equality = engine(problem.horizon_ending(in_region=False))
            self.regions = TerminalRegions(design, self.newton, equality)
        blocks = problem.horizon.blocks
        self._shift = _shift_matrix(blocks)
        self._beyond = 1.0 - self._shift.sum(axis=0)
        self._step = BufferedFunction(self.discrete.step)
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
            at = self._full, sample.previous_command, self.model.parameters.values, 0.0
            self._full[n_x:] = self._step.evaluate(*at)[0][n_x:]
        self._full[:n_x] = sample.estimate.x
        references = sample.reference
        if len(references) == 1:
            references = self._forecast.update(references[0])
        request = goal = references[-1]
        limits = self.problem.goal_limits
        if limits is not None:
            # A steady state beyond a soft limit would be fought over for ever.
            goal = np.clip(request, limits[:, 0], limits[:, 1])
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
            # It may lie behind a point where the linearisation sees no way to it: a tail rotor at
            # rest has no thrust slope. Taken only where the plan is stuck there.
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

    def step(self, sample: ControlSample, *, want_prediction: bool) -> Command:
        """One sample: target, Newton iterations, command."""
        self.begin_sample(sample)
        return self.solve(want_prediction=want_prediction)

    def solve(self, *, want_prediction: bool) -> Command:
        """The command of the sample that was taken in."""
        newton, target, config = self.newton, self.target, self.config
        if not self.inputs_finite:
            return self.fall_back(self.problem.name, config.fallback, NOT_FINITE)
        begin_linearise = newton.linearise_time
        self.prepare_model()
        begin_qp = newton.qp_time
        outcome = newton.solve(config.max_iterations, config.tolerance, self.other_start)
        if outcome.failed:
            return self.fall_back(self.problem.name, config.fallback, outcome.message)
        if outcome.terminal_residual > self.relaxed_above and target is not None:
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
            message=self._message(status),
            prediction=self.prediction() if want_prediction else None,
            out_of_reach=target is not None and target.projected,
            terminal_residual=outcome.terminal_residual if newton.horizon.terminal else math.nan,
        )

    def prepare_model(self) -> None:
        """What a model needs that is made anew for each sample."""

    def _message(self, status: Status) -> str:
        words = [status.meaning] if status is Status.RELAXED else []
        words += self.target_words()
        if self.regions is not None and self.regions.region is None:
            words.append(NO_REGION)
        return "; ".join(words)

    def target_words(self) -> list[str]:
        """What a person should know of the target."""
        is_projected = self.target is not None and self.target.projected
        return target_words(is_held=self.target_is_held, is_projected=is_projected)

    def fall_back(self, who: str, policy: Policy, reason: str) -> Command:
        """The declared command of a sample whose solve failed."""
        newton = self.newton
        bounds, planned = (newton.lower, newton.upper), newton.plan[:, 0]
        return fall_back(who, policy, reason, planned, self.target, self._last_command, bounds)


def target_words(*, is_held: bool, is_projected: bool) -> list[str]:
    """What a person should know of a target.

    ``is_held``: whether there is one under the present disturbances. ``is_projected``: whether the
    reference is out of reach.
    """
    if not is_held:
        return ["no input holds the estimated disturbance; the last target goes on"]
    if is_projected:
        return ["the reference is out of reach; the nearest steady state is the target"]
    return []


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
