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
from trms_cli.models.model import Model, names
from trms_cli.models.operating_point import OperatingPoint
from trms_cli.models.rest import rest_equations
from trms_cli.plants.plant import PlantRun, PlantSetup
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
    ended: str = ""  #: Why it ended early; empty if it did not
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


@dataclass
class RecordedPlant:
    """A rig that remembers its states and what reached its motors."""

    rig: PlantRun
    path: Path | None = None
    until: Until | None = None
    #: ``visited``, ``commands``, ``applied``: States before each sample; commands as given and as
    #: they arrived
    visited: list[FloatArray] = field(default_factory=list)
    commands: list[FloatArray] = field(default_factory=list)
    applied: list[FloatArray] = field(default_factory=list)

    def __getattr__(self, name: str) -> object:
        return getattr(self.rig, name)

    def advance(self, command: FloatArray) -> None:
        """A sample of the rig, its command changed on the way."""
        if self.until is not None and (why := self.until(self.rig.state)):
            raise Enough(why)
        k = len(self.applied)
        arriving = command if self.path is None else self.path(k, command)
        self.visited.append(self.rig.state.copy())
        self.commands.append(command.copy())
        self.applied.append(np.array(arriving, dtype=float))
        self.rig.advance(arriving)


@dataclass(frozen=True)
class _Bench:
    """The rig as a plant of an experiment."""

    rig: SimulatedRig
    made: list[RecordedPlant]
    path: Path | None
    until: Until | None

    def init(self, setup: PlantSetup) -> RecordedPlant:
        self.made.append(RecordedPlant(self.rig.init(setup), self.path, self.until))
        return self.made[-1]


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
    integration_step: float = 0.005,
) -> LoopRun:
    """Close the loop around an operating point.

    Parameters
    ----------
    model : Model
        The rig, with its effects.
    point : OperatingPoint
        Of the model: the run starts there with its command in force.
    duration : float
        s.
    offset : dict of str to float
        By how much the start differs from the point, by state.
    reference : dict of str to float
        Constant references by controlled state; default the point's.
    path : callable, optional
        What reaches the motors instead of the command. It may raise :class:`Enough`.
    until : callable, optional
        Ends the run at a state, and tells why.

    Returns
    -------
    LoopRun
        Shorter than asked for where the run had to end (a state that is no longer finite), or
        where the path had enough.
    """
    start = dict(zip(model.state_names, point.x.tolist(), strict=True))
    for name, change in (offset or {}).items():
        start[name] += change
    if model.sample_time is not None:
        # what a black box remembers follows from where it is, unless it is given
        free = {model.state_names[i] for i in rest_equations(model).unknowns}
        start = {name: value for name, value in start.items() if name in {*free, *(offset or {})}}
    goal = {name: float(point.x[model.state_index(name)]) for name in model.controlled} | dict(
        reference or {}
    )
    rig = SimulatedRig(
        model=model,
        integration_step=integration_step,
        sensors=Sensors(noise_sd={}, quantum={}),
        initial=start,
        first_command=dict(zip(names(model.inputs), point.u.tolist(), strict=True)),
        mechanical_stops=False,
    )
    signals: dict[str, Any] = {name: Constant(offset=value) for name, value in goal.items()}
    made: list[RecordedPlant] = []
    period = getattr(loop.controller, "sample_time", None)
    counted = CountedController(loop.controller, period, Counter())
    experiment = Experiment(
        model=loop.model,
        plant=_Bench(rig, made, path, until),
        observer=loop.observer,
        controller=counted,
        reference=ReferenceTrajectory(**signals),
        duration=duration,
        sample_time=loop.sample_time,
        prediction_every=0,
    )
    running = Loop.start(experiment, lambda plant: History({}, None))
    ended = ""
    try:
        running.run()
    except Enough as enough:
        ended = str(enough)
    except (ArithmeticError, SimulationError) as error:
        ended = str(error)
    plant = made[0]
    n = len(plant.applied)
    kept = plant.visited[:n], plant.commands[:n], plant.applied
    widths = model.n_x, model.n_u, model.n_u
    x, u, applied = (
        np.array(rows, dtype=float).reshape(n, width)
        for rows, width in zip(kept, widths, strict=True)
    )
    failures = sum(kind == "solver" for _, kind, *_ in running.history.events)
    time = np.arange(n, dtype=np.float64) * loop.sample_time
    return LoopRun(time, x, u, applied, failures, ended, dict(counted.statuses))
