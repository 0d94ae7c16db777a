"""Controllability and observability of a rig: the result, in words, tables, figures and data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.core.chart import Axis, Chart, Colour, Curve, Line, Mark, Panel, Points
from trms_cli.core.findings import (
    Cell,
    Findings,
    Judged,
    Judgement,
    Section,
    Table,
    json_data,
    rounded,
)
from trms_cli.models.dry_friction import SPEEDS
from trms_cli.models.model import Model, names
from trms_cli.models.operating_point import OperatingPoint
from trms_cli.stability.local.access import (
    MOTION,
    Gramians,
    InputGains,
    ModeAccess,
    PbhResult,
    Scales,
)
from trms_cli.stability.local.constant_torques import TorqueEstimates, set_words
from trms_cli.stability.local.sensitivity import state_words
from trms_cli.stability.local.sweep import EigenvalueSweep, OperatingPath

_GRADES: dict[str, tuple[str, Judgement]] = {
    "none": ("no", "bad"),
    "weak": ("weakly", "doubtful"),
    "yes": ("yes", "good"),
}
#: A full command that moves an angle by less than this share of a typical motion is no input to it.
_LITTLE = 0.1
#: Commands beyond this many limits move nothing worth the name.
_ABSURD = 1e3
_COLOURS: tuple[Colour, ...] = (
    *("blue", "vermilion", "green", "purple", "orange"),
    *("sky", "ink", "grey", "yellow"),
)
#: A rotor whose speed spans more than this part of its largest over a range has a panel of it.
_VARIES = 0.5


@dataclass(frozen=True)
class ControllabilityResult:
    """What inputs move and sensors see at the operating point, and over the range."""

    point: OperatingPoint
    scales: Scales
    duration: float  #: s
    reading_time: float  #: s
    sets: tuple[tuple[str, ...], ...]  #: Sensors
    access: tuple[ModeAccess, ...]
    volts: FloatArray  #: (n_x, n_u) array; least rms command that moves each state by its size
    gramians: Gramians
    #: By set of sensors; the first error is that after ``duration``, the others after ``times``
    torques: Mapping[tuple[str, ...], TorqueEstimates]
    times: tuple[float, ...]  #: s
    path: OperatingPath
    sweep: EigenvalueSweep
    gains: InputGains  #: Along the sweep

    @property
    def model(self) -> Model:
        return self.path.model


def controllability_findings(result: ControllabilityResult) -> Findings:
    """The result as a study tells it."""
    return Findings(
        "Controllability and observability",
        _lead(result),
        (_inputs(result), _range(result), _sensors(result), _torques(result)),
        json_data(_data(result)),
        _warnings(result),
    )


def _data(result: ControllabilityResult) -> dict[str, Any]:
    model, sweep = result.model, result.sweep
    inputs = names(model.inputs)
    with_all = [*inputs, "together"] if model.n_u > 1 else inputs
    gramians = result.gramians

    def by_input(values: FloatArray) -> dict[str, dict[str, FloatArray]]:
        """(n, n_c, n_u) array by controlled state and input."""
        return {
            name: {inputs[j]: values[:, i, j] for j in range(model.n_u)}
            for i, name in enumerate(model.controlled)
        }

    return {
        "at": {
            "x": dict(zip(model.state_names, result.point.x, strict=True)),
            "u": dict(zip(inputs, result.point.u, strict=True)),
        },
        "duration_s": result.duration,
        "scales": {
            "x": dict(zip(model.state_names, result.scales.x, strict=True)),
            "u": dict(zip(inputs, result.scales.u, strict=True)),
        },
        "modes": [
            {
                "name": a.mode.name,
                "real": a.mode.eigenvalue.real,
                "imag": a.mode.eigenvalue.imag,
                "by_input": {
                    name: _reach_data(reach)
                    for name, reach in zip(with_all, a.by_input, strict=True)
                },
                "by_sensors": [
                    {"sensors": one} | _reach_data(reach)
                    for one, reach in zip(result.sets, a.by_sensors, strict=True)
                ],
            }
            for a in result.access
        ],
        "least_rms_command": {
            name: dict(zip(inputs, row, strict=True))
            for name, row in zip(model.state_names, result.volts, strict=True)
        },
        "gramians": {
            "controllability": gramians.reach,
            "observability": gramians.sight,
            "controllability_forever": gramians.reach_forever,
            "observability_forever": gramians.sight_forever,
            "hankel": gramians.hankel,
            "lyapunov_residual": gramians.residual,
        },
        "torques": [
            {
                "sensors": one,
                "together": result.torques[one].together,
                "alone": {
                    t.name: {"seen": t.seen, "error": t.errors[0], "errors_over_time": t.errors[1:]}
                    for t in result.torques[one].torques
                },
            }
            for one in result.sets
        ],
        "torque_times_s": result.times,
        "range": {
            "over": result.path.over,
            "unit": result.path.unit,
            "values": sweep.values,
            "states": {
                name: [place.point.x[i] for place in sweep.places]
                for i, name in enumerate(model.state_names)
            },
            "moved_per_unit_rms": by_input(result.gains.per_volt),
            "pbh_margin": by_input(result.gains.margin),
            "ended_low": sweep.low or None,
            "ended_high": sweep.high or None,
        },
    }


def _reach_data(reach: PbhResult) -> dict[str, Any]:
    return {"grade": reach.grade, "margin": reach.margin, "strength": reach.strength}


def _lead(result: ControllabilityResult) -> list[str]:
    model = result.model
    lost = [a.mode.name for a in result.access if a.by_input[-1].grade == "none"]
    words = result.point.words(model)
    sentences = [
        f"At {words} no input moves: {', '.join(lost)}."
        if lost
        else f"At {words} the inputs together move every mode."
    ]
    for i, name in enumerate(model.controlled):
        row = model.state_index(name)
        size = _amount(result.scales.x[row], model.states[row].unit)
        parts = [
            f"{signal.name} {_command(result.volts[row, j], result.scales.u[j], signal.unit)}"
            for j, signal in enumerate(model.inputs)
        ]
        sentences.append(
            f"To move {name} by {size} in {result.duration:g} s takes at least (rms): "
            f"{'; '.join(parts)}."
        )
        sentences += _loss_words(result, i)
    for k, one in enumerate(result.sets):
        blind = [a.mode.name for a in result.access if a.by_sensors[k].grade == "none"]
        words = set_words(model, one)
        if words in ("all", "angles") or k == 0:
            words = {"all": "all sensors", "angles": "the angles alone"}.get(words, words)
            torques = result.torques[one]
            count = sum(torque.seen for torque in torques.torques)
            sentences.append(
                f"With {words} "
                + (f"not seen: {', '.join(blind)}" if blind else "every mode is seen")
                + f"; of {len(torques.torques)} constant torques {count} can be told one at a time "
                f"and {torques.together} at once."
            )
    return sentences


def _loss_words(result: ControllabilityResult, i: int) -> list[str]:
    """Where an input ceases to move a controlled state, if it does within the range."""
    path = result.path
    sentences = []
    for j, signal in enumerate(path.model.inputs):
        reach = result.gains.per_volt[:, i, j]
        best = float(reach.max(initial=0.0))
        zero = np.flatnonzero(reach <= 1e-6 * best)
        # What hardly moves it anywhere has nothing to lose.
        if 0 < len(zero) <= 3 and best * result.scales.u[j] > _LITTLE * MOTION:
            at = f"{result.sweep.values[zero[0]]:.4g} {path.unit}".rstrip()
            sentences.append(
                f"{signal.name} loses {path.model.controlled[i]} at {path.over} = {at}: "
                f"to first order it does not move it there at all."
            )
    return sentences


def _warnings(result: ControllabilityResult) -> list[str]:
    sentences = [
        "All of this is of the linearised rig: where an input has no slope (a thrust goes as ω|ω|) "
        "a large command still acts."
    ]
    if result.path.linear.switches(result.point.x, result.point.u):
        sentences.append(
            "The operating point lies on a switch, where a coefficient depends on a direction; the "
            f"slopes are those of study.side={result.path.side}."
        )
    return [*sentences, *result.sweep.early_ends]


def _inputs(result: ControllabilityResult) -> Section:
    model, gramians = result.model, result.gramians
    heads = [*names(model.inputs), *["together"] * (model.n_u > 1)]
    modes = Table(
        ("mode", *heads),
        [[a.mode.name, *(_moved(reach) for reach in a.by_input)] for a in result.access],
        "Whether an input moves a mode; in brackets how far a full command in step with it pumps "
        f"it in {result.duration:g} s (1×: an angle of {MOTION:g} rad or its like), and the PBH "
        "margin.",
    )

    def least(i: int, j: int) -> Cell:
        value, limit = float(result.volts[i, j]), float(result.scales.u[j])
        if value > _ABSURD * limit:
            return Judged("never", "bad")
        return Judged(rounded(value, 3), "" if value <= limit else "doubtful")

    moves = Table(
        ("to move", *(f"{signal.name} [{signal.unit} rms]" for signal in model.inputs)),
        [
            [
                f"{state_words(model, i)} by {_amount(result.scales.x[i], state.unit)}",
                *(least(i, j) for j in range(model.n_u)),
            ]
            for i, state in enumerate(model.states)
        ],
        f"Least command, root mean square over {result.duration:g} s, that moves a state by a "
        "typical size (the others end where they may).",
    )
    text = [
        "A mode is controllable if [λI − A, B] has full rank (Popov, Belevitch, Hautus); the "
        "margin is its smallest singular value with states and inputs scaled by typical sizes.",
        "The least command is √(d²/(c W cᵀ T)) with the Gramian W of the time T.",
        "The point is not asymptotically stable: Gramians exist over a finite time only."
        if gramians.hankel is None
        else "The point is stable, so that Gramians for ever exist (Lyapunov equation, residual "
        f"{gramians.residual:.1e}); Hankel singular values of the scaled system: "
        f"{', '.join(f'{v:.3g}' for v in gramians.hankel)}.",
    ]
    return Section("What the inputs move", text, (modes, moves))


def _range(result: ControllabilityResult) -> Section:
    text = [
        "How far one unit (rms) of each input alone moves a controlled state in "
        f"{result.duration:g} s at best, the operating point solved anew along {result.path.over}. "
        "Where a rotor's speed goes through zero its gain goes to zero with |ω|."
    ]
    return Section(f"Over {result.path.over}", text, (_loss_chart(result), _volts_chart(result)))


def _sensors(result: ControllabilityResult) -> Section:
    heads = [set_words(result.model, one) for one in result.sets]
    modes = Table(
        ("mode", *heads),
        [[a.mode.name, *(_read(reach) for reach in a.by_sensors)] for a in result.access],
        "Whether sensors see a mode, and how large a motion worth speaking of "
        f"({MOTION:g} rad or its like) reads, in standard deviations σ of one reading.",
    )
    text = ["A mode is observable if [λI − A; C] has full rank."]
    return Section("What the sensors see", text, (modes,))


def _torques(result: ControllabilityResult) -> Section:
    model = result.model

    def estimate(one: tuple[str, ...], j: int) -> Cell:
        torque = result.torques[one].torques[j]
        if not torque.seen:
            return Judged("no", "bad")
        error = torque.errors[0]
        return Judged("weakly", "doubtful") if error is None else f"±{error:.2g}"

    rows: list[list[Cell]] = [
        [f"{signal.name} [{signal.unit}]", *(estimate(one, j) for one in result.sets)]
        for j, signal in enumerate(model.disturbances)
    ]
    rows.append(["told at once", *(result.torques[one].together for one in result.sets)])
    errors = Table(
        ("constant torque", *(set_words(model, one) for one in result.sets)),
        rows,
        f"Standard deviation of its estimate after {result.duration:g} s of readings every "
        f"{result.reading_time * 1000:g} ms, if it is the only one and the initial state is known "
        "to ±1 rad and ±1 rad/s; no: it cannot be told.",
    )
    text = [
        "A constant torque is a state without a rate beside the others; it is observable if "
        "[A e; C 0] has full rank. Two torques that move the sensors alike in the end cannot be "
        "told apart, whatever the filter: the last row is how many can be told at once."
    ]
    chart = _torque_chart(result)
    return Section("Constant torques", text, [errors, *([] if chart is None else [chart])])


def _moved(reach: PbhResult) -> Judged:
    words, judgement = _GRADES[reach.grade]
    if reach.grade == "none":
        return Judged(words, judgement)
    return Judged(f"{words} ({_strength(reach)}×; {reach.margin:.2g})", judgement)


def _read(reach: PbhResult) -> Judged:
    words, judgement = _GRADES[reach.grade]
    return Judged(words if reach.grade == "none" else f"{_strength(reach)}σ", judgement)


def _strength(reach: PbhResult) -> str:
    return f"{reach.strength:.0f}" if reach.strength >= 10 else f"{reach.strength:.2g}"


def _command(volts: float, limit: float, unit: str) -> str:
    if not volts <= _ABSURD * limit:
        return "cannot"
    beyond = " (beyond its limit)" if volts > limit else ""
    return f"{volts:.3g} {unit}".replace(" 1", "") + beyond


def _amount(size: float, unit: str) -> str:
    return f"{size:.3g} {unit}" if unit not in ("", "1") else f"{size:.3g}"


# Figures


def _loss_chart(result: ControllabilityResult) -> Chart:
    """How far each input moves each controlled state, over the range and over the rotor's speed."""
    model, path, sweep, reach = result.model, result.path, result.sweep, result.gains
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
        moved = Axis(f"{name} moved in {result.duration:g} s", per, (-0.03 * top, top))
        panels.append(Panel(axis, moved, marks, f"what moves {name}"))
    for i, j, speed in _rotors(path, sweep):
        name, signal = model.controlled[i], model.inputs[j]
        unit = model.states[model.state_index(name)].unit
        omega = np.array([place.point.x[model.state_index(speed)] for place in sweep.places])
        order = np.argsort(omega)
        gain = reach.per_volt[:, i, j][order]
        margin = reach.margin[:, i, j][order]
        moved = Axis(
            f"{name} moved in {result.duration:g} s", f"{unit} per {_per(signal.unit)} rms"
        )
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


def _volts_chart(result: ControllabilityResult) -> Chart:
    """The least command for a typical motion, over the range."""
    model, path, scales = result.model, result.path, result.scales
    panels = []
    for i, name in enumerate(model.controlled):
        unit = model.states[model.state_index(name)].unit
        marks: list[Mark] = []
        for j, (signal, colour) in enumerate(zip(model.inputs, _COLOURS, strict=False)):
            gain = result.gains.per_volt[:, i, j]
            volts = np.where(gain > 0, MOTION / np.maximum(gain, 1e-300), np.nan)
            # Far beyond the limit the number says nothing but that.
            volts = np.where(volts > 30.0 * scales.u[j], np.nan, volts)
            marks.append(Curve(result.sweep.values, volts, signal.name, colour, width=2.0))
        limit = float(scales.u.max())
        marks.append(Line(y=limit, label="limit", colour="alarm", style="dashed"))
        title = f"{MOTION:g} {unit} of {name} in {result.duration:g} s"
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


def _torque_chart(result: ControllabilityResult) -> Chart | None:
    """How exactly each set of sensors tells a constant torque, over the time it has."""
    model, panels = result.model, []
    for j, signal in enumerate(model.disturbances):
        marks: list[Mark] = []
        for one, colour in zip(result.sets, _COLOURS, strict=False):
            errors = result.torques[one].torques[j].errors[1:]
            values = np.array([np.nan if e is None else e for e in errors])
            if np.isfinite(values).any():
                marks.append(Curve(result.times, values, set_words(model, one), colour))
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


def _zeros(sweep: EigenvalueSweep, reach: InputGains, i: int) -> list[Mark]:
    """Where an input does not move a state at all."""
    marks: list[Mark] = []
    for j in range(reach.per_volt.shape[2]):
        gain = reach.per_volt[:, i, j]
        lost = np.flatnonzero(gain <= 1e-6 * float(gain.max(initial=0.0)))
        if 0 < len(lost) <= 3 and gain.max() > 0:
            marks.append(
                Points(sweep.values[lost], gain[lost], "lost", "unstable", "alarm", size=7.0)
            )
    return marks


def _rotors(path: OperatingPath, sweep: EigenvalueSweep) -> list[tuple[int, int, str]]:
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
