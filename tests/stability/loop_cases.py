"""Loops around a rig for the tests of their margins and tolerances."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from trms_cli.controllers.controller import Command, ControlSample, ControlSetup, Status
from trms_cli.controllers.lqr import Lqr
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.operating_point import operating_point
from trms_cli.observers.full_state import FullState
from trms_cli.stability.loops.frequency_response import Analyser
from trms_cli.stability.subject import LoopParts, Subject

MODEL = Newtonian()
AT = {"alpha_v": 0.0, "alpha_h": 0.3}
POINT = operating_point(MODEL, AT)
PERIOD = 0.1
#: Coarse, for speed: exact at its lines all the same.
COARSE = Analyser(lowest=0.4, ratio=1.2, amplitude=0.0001, periods=20)


def lqr(**keys: Any) -> Lqr:
    return Lqr(operating_point=AT, sample_time=PERIOD, **keys)


def loop_of(controller: Any, model: Any = MODEL) -> LoopParts:
    names = {"controller": type(controller).__name__.lower(), "observer": "full_state"}
    return LoopParts(model, controller, FullState(), 0.02, names)


def subject_of(controller: Any, rig: Any = MODEL) -> Subject:
    return Subject(rig, "newtonian", loop_of(controller))


@dataclass(frozen=True)
class Changed:
    """A controller with a gain around a point, whole periods late, or with another status."""

    controller: Any
    gain: tuple[float, ...] = (1.0, 1.0)
    late: int = 0
    status: Status = Status.OK
    centre: np.ndarray = field(default_factory=lambda: POINT.u)

    @property
    def sample_time(self) -> float:
        return float(self.controller.sample_time)

    def preview(self, setup: ControlSetup) -> int:
        return int(self.controller.preview(setup))

    def init(self, setup: ControlSetup) -> Any:
        past = [setup.first_command.copy() for _ in range(self.late)]
        return [self.controller.init(setup), past]

    def step(self, state: Any, sample: ControlSample, *, want_prediction: bool) -> Command:
        command = self.controller.step(state[0], sample, want_prediction=want_prediction)
        u = self.centre + np.array(self.gain) * (command.u - self.centre)
        state[1].append(u)
        return replace(command, u=state[1].pop(0), status=self.status)
