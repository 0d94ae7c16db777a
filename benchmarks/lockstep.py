"""Controllers side by side: each closes its own loop, all take a sample before any takes the next.

So a disturbance of the machine hits all of them alike. A controller's time is all that it needs
from an estimate to a command: references of the preview, steady-state target, solve, status.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from time import perf_counter

import casadi as ca
import numpy as np
import numpy.typing as npt

from trms_cli.controllers.controller import (
    Command,
    Controller,
    ControlSample,
    ControlSetup,
    Status,
)
from trms_cli.controllers.newton_mpc import NewtonMpc
from trms_cli.controllers.reference_forecast import smooth_rates
from trms_cli.models.estimate import Estimate
from trms_cli.models.model import names
from trms_cli.models.steady_state import SteadyState
from trms_cli.plants.plant import PlantSetup
from trms_cli.simulation.closed_loop import Experiment

FloatArray = npt.NDArray[np.float64]

#: Samples at the start that do not count for times: caches fill, first solves start from nothing.
WARM_UP = 5


@dataclass
class Entrant:
    """A controller in its own closed loop with the full state, one control period a sample."""

    name: str
    experiment: Experiment
    times: list[float] = field(default_factory=list)  #: s per sample
    #: list of (n_x,) arrays; at the samples, the one after the last command included
    states: list[FloatArray] = field(default_factory=list)
    commands: list[FloatArray] = field(default_factory=list)  #: list of (n_u,) arrays
    answers: list[Command] = field(default_factory=list)

    def __post_init__(self) -> None:
        e = self.experiment
        period = e.controller.sample_time or e.sample_time
        samples = round(e.duration / period)
        self.plant = e.plant.init(PlantSetup(period, samples, e.seed))
        setup = ControlSetup(e.model, period, self.plant.first_command)
        self.period, self.samples = period, samples
        preview = e.controller.preview(setup)
        self._lookahead = np.arange(preview + 1)
        axes = e.reference.restricted_to(e.model.controlled)
        self.references = axes.sample(np.arange(samples + preview + 1, dtype=np.float64) * period)
        self._state = e.controller.init(setup)
        self._u = self.plant.first_command.copy()
        n_x, n_w = e.model.n_x, e.model.n_w
        self._estimate = Estimate(np.zeros(n_x), np.zeros(n_x), np.zeros(n_w), np.zeros(n_w))
        self.states.append(self.plant.state.copy())

    def sample(self, k: int) -> None:
        """One control period."""
        self.plant.measure()
        self._estimate.x[:] = self.plant.state
        begin = perf_counter()
        answer = self.experiment.controller.step(
            self._state,
            ControlSample(
                k * self.period, self.references[k + self._lookahead], self._estimate, self._u
            ),
            want_prediction=False,
        )
        self.times.append(perf_counter() - begin)
        lower, upper = self.plant.input_limits
        self._u = np.clip(answer.u, lower, upper)
        self.plant.advance(self._u)
        self.answers.append(answer)
        self.commands.append(self._u)
        self.states.append(self.plant.state.copy())

    @property
    def counted_times(self) -> FloatArray:
        """Times after the warm-up, µs."""
        return 1e6 * np.array(self.times[WARM_UP:])

    @property
    def iterations(self) -> float:
        """Mean per sample."""
        return float(np.mean([answer.iterations for answer in self.answers]))

    @property
    def failures(self) -> int:
        """Samples whose solve failed."""
        return Counter(answer.status for answer in self.answers)[Status.FAILED]

    def part(self, attribute: str) -> float:
        """Median of a time that the controller reports of itself, µs."""
        values = [getattr(answer, attribute) for answer in self.answers[WARM_UP:]]
        return float(1e6 * np.median(values))

    def closed_loop_objective(self, problem: NewtonMpc) -> float:
        """The stage costs of ``newton_mpc`` summed along what really happened."""
        model = self.experiment.model
        states, commands = np.array(self.states[1:]), np.array(self.commands)
        references = self.references[1 : len(states) + 1]
        first = self.plant.first_command[None, :]
        moves = np.diff(np.concatenate([first, commands]), axis=0)
        steady = SteadyState(model)
        target, goals, inputs = None, [], []
        for reference in references:
            target = steady.solve(reference, None, target)
            goals.append(target.x)
            inputs.append(target.u)
        goal = np.array(goals)
        for column, name in enumerate(model.controlled):
            goal[:, model.state_index(name)] = references[:, column]
        rho = _row(problem.input_weights, names(model.inputs))
        s = _row(problem.move_weights, names(model.inputs))
        q = _row(problem.state_weights, model.state_names)
        damping = _row(problem.rate_weights, model.state_names)
        rates = np.diff(np.array(self.states), axis=0) / self.period
        columns = [model.state_index(name) for name in model.controlled]
        reference_rates = ca.Function(
            "reference_rates",
            [r := ca.SX.sym("r", *references.T.shape)],
            [smooth_rates(r, self.period)],
        )
        rates[:, columns] -= np.asarray(reference_rates(references.T)).T
        return float(
            ((states - goal) ** 2 @ q).sum()
            + (rates**2 @ damping).sum()
            + ((commands - np.array(inputs)) ** 2 @ rho).sum()
            + (moves**2 @ s).sum()
        )


def race(experiment: Experiment, controllers: Mapping[str, Controller]) -> list[Entrant]:
    """Let controllers run side by side in the same experiment."""
    entrants = [
        Entrant(name, replace(experiment, controller=controller))
        for name, controller in controllers.items()
    ]
    for k in range(min(entrant.samples for entrant in entrants)):
        for entrant in entrants:
            entrant.sample(k)
    return entrants


def quantiles(times: FloatArray) -> tuple[float, float]:
    """Median and 99th percentile."""
    median, p99 = np.percentile(times, [50, 99])
    return float(median), float(p99)


def _row(weights: Mapping[str, float], keys: Sequence[str]) -> FloatArray:
    return np.array([weights.get(name, 0.0) for name in keys])
