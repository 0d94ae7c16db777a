"""Figures of controllability and observability."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from trms_cli.core.chart import Axis, Chart, Colour, Curve, Line, Mark, Panel, Points
from trms_cli.models.dry_friction import SPEEDS
from trms_cli.models.model import Model
from trms_cli.stability.local.access import ReachAlong
from trms_cli.stability.local.scales import MOTION, Scales
from trms_cli.stability.local.sensors import set_words
from trms_cli.stability.local.sweep import Path, Sweep
from trms_cli.stability.local.torques import TorquesSeen

_COLOURS: tuple[Colour, ...] = (
    "blue",
    "vermilion",
    "green",
    "purple",
    "orange",
    "sky",
    "ink",
    "grey",
    "yellow",
)
#: A rotor whose speed spans more than this part of its largest over a range has a panel of it.
_VARIES = 0.5


def loss_chart(path: Path, sweep: Sweep, reach: ReachAlong, duration: float) -> Chart:
    """How far each input moves each controlled state, over the range and over the rotor's speed."""
    model = path.model
    axis = Axis(path.over, path.unit)
    panels = []
    for i, name in enumerate(model.controlled):
        unit = model.states[model.state_index(name)].unit
        marks: list[Mark] = [
            Curve(sweep.values, reach.per_volt[:, i, j], signal.name, colour, width=2.0)
            for j, (signal, colour) in enumerate(zip(model.inputs, _COLOURS, strict=False))
        ]
        marks += _zeros(sweep, reach, i)
        top = 1.08 * float(reach.per_volt[:, i].max()) or 1.0
        per = f"{unit} per {_per(model.inputs[0].unit)} rms"
        moved = Axis(f"{name} moved in {duration:g} s", per, (-0.03 * top, top))
        panels.append(Panel(axis, moved, marks, f"what moves {name}"))
    for i, j, speed in _rotors(path, sweep):
        name, signal = model.controlled[i], model.inputs[j]
        unit = model.states[model.state_index(name)].unit
        omega = np.array([place.point.x[model.state_index(speed)] for place in sweep.places])
        order = np.argsort(omega)
        gain = reach.per_volt[:, i, j][order]
        margin = reach.margin[:, i, j][order]
        moved = Axis(f"{name} moved in {duration:g} s", f"{unit} per {_per(signal.unit)} rms")
        turning = Axis(speed, "rad/s")
        colour = _COLOURS[j % len(_COLOURS)]
        panels.append(
            Panel(turning, moved, [Curve(omega[order], gain, signal.name, colour, width=2.0)])
        )
        if np.isfinite(margin).any():
            panels.append(
                Panel(
                    turning,
                    Axis(f"PBH margin of {name}", "1/s" if model.sample_time is None else "1"),
                    [Curve(omega[order], margin, signal.name, colour, width=2.0)],
                )
            )
    caption = (
        f"What one unit of each input alone moves, over {path.over}. The gain of a rotor goes as "
        "|ω|: at a standstill the linearised rig loses it."
    )
    return Chart("controllability_loss", panels, caption, 2, 4.6, 3.3)


def volts_chart(
    path: Path, sweep: Sweep, reach: ReachAlong, scales: Scales, duration: float
) -> Chart:
    """The least command for a typical motion, over the range."""
    model = path.model
    panels = []
    for i, name in enumerate(model.controlled):
        unit = model.states[model.state_index(name)].unit
        marks: list[Mark] = []
        for j, (signal, colour) in enumerate(zip(model.inputs, _COLOURS, strict=False)):
            gain = reach.per_volt[:, i, j]
            volts = np.where(gain > 0, MOTION / np.maximum(gain, 1e-300), np.nan)
            # Far beyond the limit the number says nothing but that.
            volts = np.where(volts > 30.0 * scales.u[j], np.nan, volts)
            marks.append(Curve(sweep.values, volts, signal.name, colour, width=2.0))
        limit = float(scales.u.max())
        marks.append(Line(y=limit, label="limit", colour="alarm", style="dashed"))
        title = f"{MOTION:g} {unit} of {name} in {duration:g} s"
        least = Axis("least command", f"{_per(model.inputs[0].unit)} rms", log=True)
        panels.append(Panel(Axis(path.over, path.unit), least, marks, title))
    return Chart(
        "controllability_volts",
        panels,
        "Least command, root mean square, that moves an angle by a typical amount; it ends where "
        "the input loses the angle.",
        2,
        4.6,
        3.3,
    )


def torque_chart(
    model: Model,
    sets: tuple[tuple[str, ...], ...],
    torques: Mapping[tuple[str, ...], TorquesSeen],
    times: tuple[float, ...],
) -> Chart | None:
    """How exactly each set of sensors tells a constant torque, over the time it has."""
    panels = []
    for j, signal in enumerate(model.disturbances):
        marks: list[Mark] = []
        for one, colour in zip(sets, _COLOURS, strict=False):
            errors = torques[one].torques[j].errors[1:]
            values = np.array([np.nan if e is None else e for e in errors])
            if np.isfinite(values).any():
                marks.append(Curve(times, values, set_words(model, one), colour))
        if marks:
            panels.append(
                Panel(
                    Axis("time of reading", "s", log=True),
                    Axis("error of the estimate", signal.unit, log=True),
                    marks,
                    signal.name,
                )
            )
    if not panels:
        return None
    caption = (
        "Standard deviation of the best linear estimate of a constant torque, if it is the only "
        "one. Sets of sensors that are missing cannot tell it."
    )
    return Chart("observability_torques", panels, caption, 2, 4.6, 3.3)


def _per(unit: str) -> str:
    """A normalised command is one of full."""
    return "full" if unit == "1" else unit


def _zeros(sweep: Sweep, reach: ReachAlong, i: int) -> list[Mark]:
    """Where an input does not move a state at all."""
    marks: list[Mark] = []
    for j in range(reach.per_volt.shape[2]):
        gain = reach.per_volt[:, i, j]
        lost = np.flatnonzero(gain <= 1e-6 * float(gain.max(initial=0.0)))
        if 0 < len(lost) <= 3 and gain.max() > 0:
            marks.append(
                Points(
                    sweep.values[lost],
                    gain[lost],
                    "lost",
                    "unstable",
                    "alarm",
                    size=7.0,
                )
            )
    return marks


def _rotors(path: Path, sweep: Sweep) -> list[tuple[int, int, str]]:
    """Controlled state, input and rotor's speed by axis, where the speed varies over the range."""
    model = path.model
    found = []
    inputs = [signal.name for signal in model.inputs]
    for rotor, command in model.rotors.items():
        speed = SPEEDS.get(rotor, "")
        if speed not in model.state_names or command not in inputs:
            continue
        omega = np.array([place.point.x[model.state_index(speed)] for place in sweep.places])
        largest = float(np.abs(omega).max(initial=0.0))
        j = inputs.index(command)
        if largest > 0 and np.ptp(omega) > _VARIES * largest and j < len(model.controlled):
            found.append((j, j, speed))
    return found
