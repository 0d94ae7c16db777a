"""What changes during a run of the Newton MPC: the plan, the target, the memory of the inputs."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

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
from trms_cli.controllers.newton_region import RegionDesign
from trms_cli.controllers.newton_sizes import typical_sizes
from trms_cli.controllers.newton_step import NewtonStep
from trms_cli.controllers.newton_terminal import TerminalRegions
from trms_cli.controllers.reference_forecast import ReferenceForecast
from trms_cli.core.errors import SimulationError
from trms_cli.models.discretisation import discretise
from trms_cli.models.model import Model, names
from trms_cli.models.steady_state import SteadyState, Target

if TYPE_CHECKING:
    from trms_cli.controllers.newton_mpc import NewtonMpc

FloatArray = npt.NDArray[np.float64]


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

        def engine(*, region: bool) -> NewtonStep:
            horizon = Horizon(
                self.discrete,
                blocks,
                Weights(weights, config.rate_weights, config.input_weights, config.move_weights),
                SoftLimits(config.soft_limits, config.soft_linear, config.soft_quadratic),
                TerminalPrice(config.terminal_linear, config.terminal_quadratic, region)
                if config.terminal != "none"
                else None,
                sizes,
            )
            return NewtonStep(horizon, config.qp, largest_moves)

        inputs = names(model.inputs)
        check_names(config.input_rate_limits, inputs, "input_rate_limits")
        rates = np.array([config.input_rate_limits.get(name, np.inf) for name in inputs])
        largest_moves = rates * setup.sample_time
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
        ahead = 0 if config.preview_horizon else config.forecast_horizon
        self._forecast = ReferenceForecast(
            min(ahead, config.prediction_horizon), len(model.controlled)
        )
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
        self.inputs_finite = (
            _is_finite(sample.estimate.x)
            and _is_finite(self._disturbance)
            and _is_finite(sample.reference.ravel())
        )
        if not self.inputs_finite:
            return
        if not self._first and len(self._full) > n_x:
            self._full[n_x:] = self.newton.advance(self._full, sample.previous_command)[n_x:]
        self._full[:n_x] = sample.estimate.x
        references = sample.reference
        if len(references) == 1:
            references = self._forecast.seen(references[0])
        asked = goal = references[-1]
        if self._goal_limits is not None:
            # A steady state beyond a soft limit would be fought over for ever.
            goal = np.clip(asked, self._goal_limits[:, 0], self._goal_limits[:, 1])
        previous_target = self.target
        self.target = target = self._target_for(goal)
        tail = target.u
        if self.regions is not None:
            tail = self.regions.tail(self.newton, target)
            self.newton = self.regions.engine_for(target, self._disturbance, self.newton)
        newton = self.newton
        known = len(references)
        reference = newton.reference
        # `reference` holds r(t+1) … r(t+N), the last known one held to the end of the horizon.
        reference[:, : known - 1] = references[1:].T
        reference[:, known - 1 :] = references[-1][:, None]
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
        newton.plan[:] = newton.plan @ self._shift + tail[:, None] * self._beyond
        foreseen = known > len(sample.reference)
        if not foreseen and (previous_target is None or target.asked != previous_target.asked):
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

        Raises SimulationError: Under the policy ``stop``.
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
