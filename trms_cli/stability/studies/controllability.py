"""``study=controllability``: what each input moves, and what each set of sensors sees."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from msgspec import Meta

from trms_cli.core.errors import TrmsError
from trms_cli.core.findings import Findings
from trms_cli.models.model import Model
from trms_cli.stability.local.access import (
    gramians,
    input_gains,
    mode_access,
    scales_of,
    volts_table,
)
from trms_cli.stability.local.constant_torques import sensor_sets, torque_estimates
from trms_cli.stability.local.controllability_findings import (
    ControllabilityResult,
    controllability_findings,
)
from trms_cli.stability.local.linear import Side
from trms_cli.stability.local.modes import STILL
from trms_cli.stability.local.sweep import OperatingPath, line_of, sweep_eigenvalues, usual_line
from trms_cli.stability.study import Tell
from trms_cli.stability.subject import Subject

#: rad: where a rig is linearised when nothing is said. Yaw off zero, so that the tail rotor turns.
_USUAL = ({"alpha_v": 0.0, "alpha_h": 0.3}, {"alpha_v": 0.2, "alpha_h": 0.3})
#: rad, each side: the usual range of an angle, within which the gain of yaw goes to zero and back.
_USUAL_SPAN = 0.6
#: Share of an input's limit below which a rotor hardly turns, and its thrust has no slope.
_IDLE = 0.02
#: Times at which errors of estimated torques are given, as shares of the time asked for.
_TIMES = tuple(float(share) for share in np.geomspace(0.05, 5.0, 21))


@dataclass(frozen=True, kw_only=True)
class Controllability:
    """Controllability and observability of the linearised rig."""

    #: Operating point: angles (rad) or commands (V). Empty: level, and yaw at 0.3 rad, where the
    #: tail rotor turns; with pitch at 0.2 rad where the rotors would stand; rest at last.
    at: Mapping[str, float] = field(default_factory=dict)
    #: What is varied: a controlled state, an input or a parameter; None: the last angle (yaw), the
    #: first where nothing depends on that, the first command where ``at`` names commands, or the
    #: command of a motor alone
    over: str | None = None
    #: In the unit of ``over``; None: 0.6 rad to either side, or what is usual for it
    range: tuple[float, float] | None = None
    points: Annotated[int, Meta(ge=2, le=2000)] = 61  #: Steps over the range
    duration: Annotated[float, Meta(gt=0)] = 2.0  #: s, that inputs have to move and sensors to see
    #: list of lists of str or None; sets of measured outputs; None: all, the angles with each
    #: tachometer, the angles, each alone
    sensors: tuple[tuple[str, ...], ...] | None = None
    #: ``angle_noise``, ``speed_noise``: Standard deviation of a reading of an angle (rad) and of a
    #: rotor's speed (rad/s)
    angle_noise: Annotated[float, Meta(gt=0)] = 0.00044
    speed_noise: Annotated[float, Meta(gt=0)] = 1.6
    sample_time: Annotated[float, Meta(gt=0)] = 0.01  #: s, between two readings
    side: Side = "mean"  #: Whose slopes are taken where a coefficient depends on a direction

    def run(self, subject: Subject, tell: Tell) -> Findings:
        """Test each mode, and weigh the Gramians.

        Raises TrmsError where there is no such operating point, or with a controller.
        """
        subject.require_no_loop("study=controllability", "leave it out; for loops: study=margins")
        model = subject.model
        sets = sensor_sets(model, self.sensors)
        tell("the operating point")
        over = line_of(model, self.at, self.over, usual_line(model, last=True))
        at = dict(self.at) or _usual(model, over, self.side)
        if self.over is None and _is_free(model, at, over):
            over = usual_line(model)
        path = OperatingPath(model, at, over, self.side)
        point = path.balance.first(at)
        matrices = path.linear.matrices(point.x, point.u, self.side)
        scales = scales_of(model, matrices, self.angle_noise, self.speed_noise)
        tell("modes and Gramians")
        times = tuple(share * self.duration for share in _TIMES)
        names = tuple(signal.name for signal in model.disturbances)
        known = [signal.name for signal in model.outputs]
        estimates = {
            one: torque_estimates(
                matrices,
                scales,
                [known.index(name) for name in one],
                names,
                (self.duration, *times),
                self.sample_time,
            )
            for one in sets
        }
        tell(f"over {over}")
        span = self.range
        if span is None and path.kind == "angle":
            span = (-_USUAL_SPAN, _USUAL_SPAN)
        sweep = sweep_eigenvalues(path, *path.range(span), self.points, _standstill(path))
        return controllability_findings(
            ControllabilityResult(
                point=point,
                scales=scales,
                duration=self.duration,
                reading_time=self.sample_time,
                sets=sets,
                access=mode_access(model, matrices, scales, sets, self.duration),
                volts=volts_table(model, matrices, scales, self.duration),
                gramians=gramians(matrices, scales, self.duration),
                torques=estimates,
                times=times,
                path=path,
                sweep=sweep,
                gains=input_gains(path, sweep, scales, self.duration),
            )
        )


def _is_free(model: Model, at: Mapping[str, float], over: str) -> bool:
    """Whether nothing depends on an angle: it rests wherever it is put."""
    path = OperatingPath(model, at, over)
    if path.kind != "angle":
        return False
    point = path.balance.first(at)
    column = path.linear.a(point.x, point.u)[:, model.state_index(over)]
    return model.sample_time is None and bool(np.abs(column).max() <= STILL)


def _standstill(path: OperatingPath) -> tuple[float, ...]:
    """Values at which a rotor may stand still, where an input is lost in a single point."""
    if path.kind != "angle":
        return (0.0,)
    return 0.0, float(path.model.rest()[path.model.state_index(path.over)])


def _usual(model: Model, over: str, side: Side) -> dict[str, float]:
    """The first of the usual points that the rig can hold with every rotor turning; else rest."""
    for candidate in _USUAL:
        at = {name: value for name, value in candidate.items() if name in model.controlled}
        if not at:
            continue
        try:
            point = OperatingPath(model, at, over, side).balance.first(at)
        except TrmsError:
            continue
        limit = np.array([model.input_limits[signal.name] for signal in model.inputs])
        if np.all(np.abs(point.u) > _IDLE * np.where(np.isfinite(limit), limit, 1.0)):
            return at
    return {}
