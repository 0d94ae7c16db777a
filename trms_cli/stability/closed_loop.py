"""The loop around a rig, run from any state, as :mod:`trms_cli.simulation.closed_loop` runs it.

The rig is the subject's model with its effects and perfect sensors; controller and observer
believe the model without them. A rig may get its commands late, scaled, or with a signal added:
what margins and tolerances are measured by.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from trms_cli.controllers.controller import Command, Controller, ControlSample, ControlSetup, Status
from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import SimulationError
from trms_cli.models.model import Model, by_name
from trms_cli.models.operating_point import OperatingPoint
from trms_cli.models.rest import rest_equations
from trms_cli.plants.envelope import Envelope
from trms_cli.plants.landing import Landing
from trms_cli.plants.plant import PlantSetup
from trms_cli.plants.sensors import Sensors
from trms_cli.plants.simulated import SimulatedRig
from trms_cli.references.constant import Constant
from trms_cli.references.trajectory import ReferenceTrajectory
from trms_cli.simulation.closed_loop import Experiment, Loop
from trms_cli.simulation.history import History
from trms_cli.stability.subject import LoopParts

#: What reaches the motors instead of a command (n_u,) at a sample's number.
Path = Callable[[int, FloatArray], FloatArray]
#: Why a run ends at a state (n_x,); empty: it goes on.
Until = Callable[[FloatArray], str]


@dataclass(frozen=True)
class LoopRun:
    """What a run of the loop gave, at the rig's samples."""

    time: FloatArray  #: (n,) array; s
    x: FloatArray  #: (n, n_x) array; True states of the rig
    u: FloatArray  #: (n, n_u) array; commands that the controller gave
    applied: FloatArray  #: (n, n_u) array; what reached the motors
    failures: int = 0  #: Control samples whose solve failed
    stop_reason: str = ""  #: Why it ended early; empty if it did not
    #: Control samples by how their computation ended (:class:`Status` by its label)
    statuses: Mapping[str, int] = field(default_factory=dict)


class Enough(Exception):
    """What a path raises to end a run that has shown what it was made for."""


@dataclass(frozen=True)
class CountedController:
    """A controller, the statuses of its answers counted."""

    controller: Controller
    sample_time: float | None  #: Its control period, s
    statuses: Counter[str]  #: Answers by the label of their status

    def preview(self, setup: ControlSetup) -> int:
        return self.controller.preview(setup)

    def init(self, setup: ControlSetup) -> Any:
        return self.controller.init(setup)

    def step(self, state: Any, sample: ControlSample, *, want_prediction: bool) -> Command:
        """The controller's own answer."""
        command = self.controller.step(state, sample, want_prediction=want_prediction)
        # what is no command at all is refused by the loop, in its own words
        status = getattr(command, "status", None)
        if isinstance(status, Status):
            self.statuses[status.label] += 1
        return command


class RecordedPlant:
    """A rig, as the plant of an experiment, that remembers its states and its commands."""

    #: Nothing bounds it: where it goes is what is asked.
    landing = Landing(after_run=False)
    envelope = Envelope(beyond_stops=None)

    def __init__(self, plant: SimulatedRig, path: Path | None, until: Until | None) -> None:
        self._plant, self._path, self._until = plant, path, until
        #: States before each sample; commands as given and as they arrived
        self.visited: list[FloatArray] = []
        self.commands: list[FloatArray] = []
        self.applied: list[FloatArray] = []

    def init(self, setup: PlantSetup) -> RecordedPlant:
        """The rig at its start."""
        self._rig = self._plant.init(setup)
        return self

    def __getattr__(self, name: str) -> object:
        if "_rig" not in self.__dict__:  # before a run there is none
            raise AttributeError(name)
        return getattr(self.__dict__["_rig"], name)

    def advance(self, command: FloatArray) -> None:
        """A sample of the rig, its command changed on the way."""
        state = self._rig.state
        if self._until is not None and (why := self._until(state)):
            raise Enough(why)
        arriving = command if self._path is None else self._path(len(self.applied), command)
        self.visited.append(state.copy())
        self.commands.append(command.copy())
        self.applied.append(np.array(arriving, dtype=float))
        self._rig.advance(arriving)


def run_loop(
    model: Model,
    loop: LoopParts,
    point: OperatingPoint,
    duration: float,
    *,
    offset: Mapping[str, float] | None = None,
    reference: Mapping[str, float] | None = None,
    path: Path | None = None,
    until: Until | None = None,
) -> LoopRun:
    """Close the loop around an operating point of a rig: it starts there, its command in force.

    ``offset`` is by how much the start differs from the point, by state; ``reference`` holds
    constant references by controlled state, default the point's. ``path`` is what reaches the
    motors instead of the command; ``until`` ends the run at a state, and tells why. The run is
    also shorter than its duration (s) where a state is no longer finite, or where the path raises
    :class:`Enough`.
    """
    start = by_name(model.states, point.x)
    for name, change in (offset or {}).items():
        start[name] += change
    if model.sample_time is not None:
        # what a black box remembers follows from where it is, unless it is given
        free = {model.state_names[i] for i in rest_equations(model).unknowns}
        start = {name: value for name, value in start.items() if name in {*free, *(offset or {})}}
    goal = {name: point.value(model, name) for name in model.controlled} | dict(reference or {})
    rig = SimulatedRig(
        model=model,
        integration_step=0.005,
        sensors=Sensors(noise_sd={}, quantum={}),
        initial=start,
        first_command=by_name(model.inputs, point.u),
        mechanical_stops=False,
    )
    signals: dict[str, Any] = {name: Constant(offset=value) for name, value in goal.items()}
    plant = RecordedPlant(rig, path, until)
    period = getattr(loop.controller, "sample_time", None)
    counted = CountedController(loop.controller, period, Counter())
    experiment = Experiment(
        model=loop.model,
        plant=plant,
        observer=loop.observer,
        controller=counted,
        reference=ReferenceTrajectory(**signals),
        duration=duration,
        sample_time=loop.sample_time,
        prediction_every=0,
    )
    running = Loop.start(experiment, lambda plant: History({}, None))
    stop_reason = ""
    try:
        running.run()
    except Enough as enough:
        stop_reason = str(enough)
    except (ArithmeticError, SimulationError) as error:
        stop_reason = str(error)
    n = len(plant.applied)
    x = np.array(plant.visited, dtype=float).reshape(n, model.n_x)
    u, applied = (
        np.array(rows, dtype=float).reshape(n, model.n_u)
        for rows in (plant.commands, plant.applied)
    )
    failures = sum(kind == "solver" for _, kind, *_ in running.history.events)
    time = np.arange(n, dtype=np.float64) * loop.sample_time
    return LoopRun(time, x, u, applied, failures, stop_reason, dict(counted.statuses))
