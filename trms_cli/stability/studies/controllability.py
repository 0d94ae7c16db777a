"""``study=controllability``: what each input moves, and what each set of sensors sees."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
from msgspec import Meta

from trms_cli.core.arrays import FloatArray
from trms_cli.core.chart import Axis, Chart, Colour, Curve, Line, Mark, Panel, Points
from trms_cli.core.errors import TrmsError
from trms_cli.core.findings import (
    Cell,
    Datum,
    Findings,
    Judgement,
    Measure,
    Section,
    Table,
    json_data,
    round_significant,
)
from trms_cli.core.ranges import Positive
from trms_cli.models.model import Model, Signal, by_name, names
from trms_cli.models.operating_point import OperatingPoint
from trms_cli.stability.local.access import (
    MOTION,
    Access,
    Gramians,
    InputGains,
    ModeAccess,
    PbhResult,
    Scales,
    TorqueEstimates,
    input_gains,
    scales_of,
    sensor_sets,
    set_words,
)
from trms_cli.stability.local.linear import STILL, Side
from trms_cli.stability.local.sensitivity import state_words
from trms_cli.stability.local.sweep import (
    EigenvalueSweep,
    OperatingPath,
    line_of,
    sweep_eigenvalues,
    unit_of,
    usual_line,
)
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
    duration: Positive = 2.0  #: s, that inputs have to move and sensors to see
    #: list of lists of str or None; sets of measured outputs; None: all, the angles with each
    #: tachometer, the angles, each alone
    sensors: tuple[tuple[str, ...], ...] | None = None
    #: ``angle_noise``, ``speed_noise``: Standard deviation of a reading of an angle (rad) and of a
    #: rotor's speed (rad/s)
    angle_noise: Positive = 0.00044
    speed_noise: Positive = 1.6
    sample_time: Positive = 0.01  #: s, between two readings
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
        access, durations = Access(model, matrices, scales), (self.duration, *times)
        estimates = {one: access.torques(one, durations, self.sample_time) for one in sets}
        tell(f"over {over}")
        # Where a rotor may stand still, where an input is lost in a single point.
        span, standstill = self.range, [0.0]
        if path.kind == "angle":
            span = span or (-_USUAL_SPAN, _USUAL_SPAN)
            standstill.append(float(model.rest()[model.state_index(over)]))
        sweep = sweep_eigenvalues(path, *path.range(span), self.points, tuple(standstill))
        result = ControllabilityResult(
            point=point,
            scales=scales,
            duration=self.duration,
            reading_time=self.sample_time,
            sets=sets,
            access=access.of_modes(sets, self.duration),
            volts=access.volts(self.duration),
            gramians=access.gramians(self.duration),
            torques=estimates,
            times=times,
            path=path,
            sweep=sweep,
            gains=input_gains(path, sweep, scales, self.duration),
        )
        method = (
            "How far one unit (rms) of each input alone moves a controlled state in "
            f"{self.duration:g} s at best, the operating point solved anew along {over}. "
            "Where a rotor's speed goes through zero its gain goes to zero with |ω|."
        )
        charts = _loss_chart(result), _volts_chart(result)
        ranged = Section(f"Over {over}", [method], charts)
        sections = _inputs(result), ranged, _sensors(result), _torques(result)
        title, data = "Controllability and observability", json_data(_data(result))
        lead, measures = _lead(result), _measures(result)
        return Findings(title, lead, sections, data, _warnings(result), measures)


def _is_free(model: Model, at: Mapping[str, float], over: str) -> bool:
    """Whether nothing depends on an angle: it rests wherever it is put."""
    path = OperatingPath(model, at, over)
    if path.kind != "angle":
        return False
    point = path.balance.first(at)
    column = path.linear.a(point.x, point.u)[:, model.state_index(over)]
    return model.sample_time is None and bool(np.abs(column).max() <= STILL)


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


def _data(result: ControllabilityResult) -> dict[str, Any]:
    model, sweep = result.path.model, result.sweep
    inputs = names(model.inputs)
    with_all = [*inputs, "together"] if model.n_u > 1 else inputs

    def by_input(values: FloatArray) -> dict[str, dict[str, FloatArray]]:
        """(n, n_c, n_u) array by controlled state and input."""
        return {
            name: dict(zip(inputs, values[:, i].T, strict=True))
            for i, name in enumerate(model.controlled)
        }

    return {
        "at": {
            "x": by_name(model.states, result.point.x),
            "u": by_name(model.inputs, result.point.u),
        },
        "duration_s": result.duration,
        "scales": {
            "x": by_name(model.states, result.scales.x),
            "u": by_name(model.inputs, result.scales.u),
        },
        "modes": [
            {
                "name": a.mode.name,
                "real": a.mode.eigenvalue.real,
                "imag": a.mode.eigenvalue.imag,
                "by_input": dict(zip(with_all, a.by_input, strict=True)),
                "by_sensors": [
                    {"sensors": one} | vars(reach)
                    for one, reach in zip(result.sets, a.by_sensors, strict=True)
                ],
            }
            for a in result.access
        ],
        "least_rms_command": {
            name: by_name(model.inputs, row)
            for name, row in zip(model.state_names, result.volts, strict=True)
        },
        "gramians": result.gramians,
        "torques": [{"sensors": one} | vars(result.torques[one]) for one in result.sets],
        "torque_times_s": result.times,
        "range": {
            "over": result.path.over,
            "unit": unit_of(result.path.model, result.path.over),
            "values": sweep.values,
            "states": dict(zip(model.state_names, sweep.states.T, strict=True)),
            "moved_per_unit_rms": by_input(result.gains.per_volt),
            "pbh_margin": by_input(result.gains.margin),
            "ended_low": sweep.low or None,
            "ended_high": sweep.high or None,
        },
    }


def _measures(result: ControllabilityResult) -> list[Measure]:
    """Modes that the inputs together move, and of each set of all or of the angles what is seen."""
    total = len(result.access)
    grades = [access.by_input[-1].grade for access in result.access]
    moved = total - grades.count("none")
    good: Judgement = "good" if moved == total else "bad"
    measures = [Measure("modes moved", f"{moved} of {total}", "", good, "by all inputs")]
    for k, one in enumerate(result.sets):
        words = set_words(result.path.model, one)
        if k and words != "angles":
            continue
        seen = total - [access.by_sensors[k].grade for access in result.access].count("none")
        good = "good" if seen == total else "bad"
        note = f"by {words}" + (" sensors" if words == "all" else "")
        together = result.torques[one].together
        measures += [
            Measure("modes seen", f"{seen} of {total}", "", good, note),
            Measure("torques told at once", together, "", "", note),
        ]
    return measures


def _lead(result: ControllabilityResult) -> list[str]:
    model = result.path.model
    unmoved_modes = [a.mode.name for a in result.access if a.by_input[-1].grade == "none"]
    words = result.point.words(model)
    sentences = [
        f"At {words} no input moves: {', '.join(unmoved_modes)}."
        if unmoved_modes
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
            count = sum(torque.seen for torque in torques.alone.values())
            sentences.append(
                f"With {words} "
                + (f"not seen: {', '.join(blind)}" if blind else "every mode is seen")
                + f"; of {len(torques.alone)} constant torques {count} can be told one at a time "
                f"and {torques.together} at once."
            )
    return sentences


def _zero_gain_indices(gain: FloatArray) -> npt.NDArray[np.intp]:
    """Places at which an input does not move a state; none where there are more than a few."""
    indices = np.flatnonzero(gain <= 1e-6 * float(gain.max(initial=0.0)))
    return indices if len(indices) <= 3 else indices[:0]


def _loss_words(result: ControllabilityResult, i: int) -> list[str]:
    """Where an input ceases to move a controlled state, if it does within the range."""
    path = result.path
    sentences = []
    for j, signal in enumerate(path.model.inputs):
        reach = result.gains.per_volt[:, i, j]
        zero = _zero_gain_indices(reach)
        # What hardly moves it anywhere has nothing to lose.
        if len(zero) and float(reach.max()) * result.scales.u[j] > _LITTLE * MOTION:
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
    model, gramians = result.path.model, result.gramians
    heads = [*names(model.inputs), *["together"] * (model.n_u > 1)]

    def input_cell(reach: PbhResult) -> Datum:
        words, judgement = _GRADES[reach.grade]
        if reach.grade != "none":
            words += f" ({_strength(reach)}×; {reach.margin:.2g})"
        return Datum(words, judgement)

    modes = Table(
        ("mode", *heads),
        [[a.mode.name, *(input_cell(reach) for reach in a.by_input)] for a in result.access],
        "Whether an input moves a mode; in brackets how far a full command in step with it pumps "
        f"it in {result.duration:g} s (1×: an angle of {MOTION:g} rad or its like), and the PBH "
        "margin.",
    )

    def least(i: int, j: int) -> Cell:
        value, limit = float(result.volts[i, j]), float(result.scales.u[j])
        if value > _ABSURD * limit:
            return Datum("never", "bad")
        return Datum(round_significant(value, 3), "" if value <= limit else "doubtful")

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
        f"{gramians.lyapunov_residual:.1e}); Hankel singular values of the scaled system: "
        f"{', '.join(f'{v:.3g}' for v in gramians.hankel)}.",
    ]
    return Section("What the inputs move", text, (modes, moves))


def _sensors(result: ControllabilityResult) -> Section:
    heads = [set_words(result.path.model, one) for one in result.sets]

    def sensor_cell(reach: PbhResult) -> Datum:
        words, judgement = _GRADES[reach.grade]
        return Datum(words if reach.grade == "none" else f"{_strength(reach)}σ", judgement)

    modes = Table(
        ("mode", *heads),
        [[a.mode.name, *(sensor_cell(reach) for reach in a.by_sensors)] for a in result.access],
        "Whether sensors see a mode, and how large a motion worth speaking of "
        f"({MOTION:g} rad or its like) reads, in standard deviations σ of one reading.",
    )
    text = ["A mode is observable if [λI − A; C] has full rank."]
    return Section("What the sensors see", text, (modes,))


def _torques(result: ControllabilityResult) -> Section:
    model = result.path.model

    def estimate(one: tuple[str, ...], name: str) -> Cell:
        torque = result.torques[one].alone[name]
        weakly = Datum("weakly", "doubtful") if torque.seen else Datum("no", "bad")
        return weakly if torque.error is None else f"±{torque.error:.2g}"

    rows: list[list[Cell]] = [
        [f"{signal.name} [{signal.unit}]", *(estimate(one, signal.name) for one in result.sets)]
        for signal in model.disturbances
    ]
    rows.append(["estimated at once", *(result.torques[one].together for one in result.sets)])
    errors = Table(
        ("constant torque", *(set_words(model, one) for one in result.sets)),
        rows,
        f"Standard deviation of its estimate after {result.duration:g} s of readings every "
        f"{result.reading_time * 1000:g} ms, if it is the only one and the initial state is known "
        "to ±1 rad and ±1 rad/s; no: it is not observable.",
    )
    text = [
        "A constant torque is a state without a rate beside the others; it is observable if "
        "[A e; C 0] has full rank. Two torques that move the sensors alike in the end cannot be "
        "distinguished, whatever the filter: the last row is how many can be estimated at once."
    ]
    chart = _torque_chart(result)
    return Section("Constant torques", text, [errors, *([] if chart is None else [chart])])


def _strength(reach: PbhResult) -> str:
    return f"{reach.strength:.0f}" if reach.strength >= 10 else f"{reach.strength:.2g}"


def _command(volts: float, limit: float, unit: str) -> str:
    if not volts <= _ABSURD * limit:
        return "cannot"
    beyond = " (beyond its limit)" if volts > limit else ""
    return f"{volts:.3g} {unit}".replace(" 1", "") + beyond


def _amount(size: float, unit: str) -> str:
    return f"{size:.3g} {unit}" if unit not in ("", "1") else f"{size:.3g}"


def _loss_chart(result: ControllabilityResult) -> Chart:
    """How far each input moves each controlled state, over the range and over the rotor's speed."""
    model, path, sweep, reach = result.path.model, result.path, result.sweep, result.gains
    panels = []
    for i, name in enumerate(model.controlled):
        marks: list[Mark] = [
            Curve(sweep.values, reach.per_volt[:, i, j], signal.name, colour, width=2.0)
            for j, (signal, colour) in enumerate(zip(model.inputs, _COLOURS, strict=False))
        ]
        for gain in reach.per_volt[:, i].T:
            loss_indices = _zero_gain_indices(gain)
            if len(loss_indices) and gain.max() > 0:
                marks.append(
                    Points(
                        sweep.values[loss_indices],
                        gain[loss_indices],
                        "lost",
                        "unstable",
                        "alarm",
                        size=7.0,
                    )
                )
        top = 1.08 * float(reach.per_volt[:, i].max()) or 1.0
        reach_axis = _moved_axis(result, name, model.inputs[0], (-0.03 * top, top))
        panels.append(Panel(Axis(path.over, path.unit), reach_axis, marks, f"what moves {name}"))
    for j, speed in _rotors(path, sweep):
        name, signal = model.controlled[j], model.inputs[j]
        omega = sweep.states[:, model.state_index(speed)]
        order = np.argsort(omega)
        margin = Axis(f"PBH margin of {name}", "1/s" if model.sample_time is None else "1")
        for axis, values in (
            (_moved_axis(result, name, signal), reach.per_volt[:, j, j]),
            (margin, reach.margin[:, j, j]),
        ):
            colour = _COLOURS[j % len(_COLOURS)]
            curve = Curve(omega[order], values[order], signal.name, colour, width=2.0)
            if np.isfinite(values).any():
                panels.append(Panel(Axis(speed, "rad/s"), axis, [curve]))
    caption = (
        f"What one unit of each input alone moves, over {path.over}. The gain of a rotor goes as "
        "|ω|: at a standstill the linearised rig loses it."
    )
    return Chart("controllability_loss", panels, caption, 2, 4.6, 3.3)


def _moved_axis(
    result: ControllabilityResult,
    name: str,
    signal: Signal,
    limits: tuple[float, float] | None = None,
) -> Axis:
    unit = result.path.model.states[result.path.model.state_index(name)].unit
    label = f"{name} moved in {result.duration:g} s"
    return Axis(label, f"{unit} per {_per(signal.unit)} rms", limits)


def _volts_chart(result: ControllabilityResult) -> Chart:
    """The least command for a typical motion, over the range."""
    model, path, scales = result.path.model, result.path, result.scales
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
    caption = (
        "Least command, root mean square, that moves an angle by a typical amount; it ends where "
        "the input loses the angle."
    )
    return Chart("controllability_volts", panels, caption, 2, 4.6, 3.3)


def _torque_chart(result: ControllabilityResult) -> Chart | None:
    """How exactly each set of sensors tells a constant torque, over the time it has."""
    model, panels = result.path.model, []
    for signal in model.disturbances:
        marks: list[Mark] = []
        for one, colour in zip(result.sets, _COLOURS, strict=False):
            errors = result.torques[one].alone[signal.name].errors_over_time
            values = np.array([np.nan if e is None else e for e in errors])
            if np.isfinite(values).any():
                marks.append(Curve(result.times, values, set_words(model, one), colour))
        if marks:
            error = Axis("error of the estimate", signal.unit, log=True)
            panels.append(Panel(Axis("time of reading", "s", log=True), error, marks, signal.name))
    caption = (
        "Standard deviation of the best linear estimate of a constant torque, if it is the only "
        "one. Sets of sensors that are missing cannot tell it."
    )
    return Chart("observability_torques", panels, caption, 2, 4.6, 3.3) if panels else None


def _per(unit: str) -> str:
    """A normalised command is one of full."""
    return "full" if unit == "1" else unit


def _rotors(path: OperatingPath, sweep: EigenvalueSweep) -> list[tuple[int, str]]:
    """Input, and controlled state, and rotor's speed, where the speed varies over the range."""
    model, inputs = path.model, names(path.model.inputs)
    rotors = []
    for rotor, speed in model.rotor_speeds.items():
        command = model.rotors[rotor].input
        if command not in inputs:
            continue
        omega = sweep.states[:, model.state_index(speed)]
        largest = float(np.abs(omega).max(initial=0.0))
        j = inputs.index(command)
        if largest > 0 and np.ptp(omega) > _VARIES * largest and j < len(model.controlled):
            rotors.append((j, speed))
    return rotors
