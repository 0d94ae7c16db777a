"""Controllability and observability in words, tables, figures and data."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from trms_cli.core.findings import Judged, Judgement, Section, Table, Value
from trms_cli.models.model import Model
from trms_cli.stability.local.access_charts import loss_chart, torque_chart, volts_chart
from trms_cli.stability.local.entries import state_words
from trms_cli.stability.local.found import Along, Found
from trms_cli.stability.local.reach import Reach
from trms_cli.stability.local.scales import MOTION
from trms_cli.stability.local.sensors import set_words

FloatArray = npt.NDArray[np.float64]

_GRADES: dict[str, tuple[str, Judgement]] = {
    "none": ("no", "bad"),
    "weak": ("weakly", "doubtful"),
    "yes": ("yes", "good"),
}
#: A full command that moves an angle by less than this share of a typical motion is no input to it.
_LITTLE = 0.1
#: Commands beyond this many limits move nothing worth the name.
_ABSURD = 1e3


def lead_of(found: Found, along: Along) -> list[str]:
    """The answer in sentences."""
    model = found.model
    told = []
    lost = [a.mode.name for a in found.access if a.by_input[-1].grade == "none"]
    words = found.point.words(model)
    told.append(
        f"At {words} the inputs together move every mode."
        if not lost
        else f"At {words} no input moves: {', '.join(lost)}."
    )
    for i, name in enumerate(model.controlled):
        row = model.state_index(name)
        size = _amount(found.scales.x[row], model.states[row].unit)
        parts = [
            f"{signal.name} {_command(found.volts[row, j], found.scales.u[j], signal.unit)}"
            for j, signal in enumerate(model.inputs)
        ]
        told.append(
            f"To move {name} by {size} in {found.duration:g} s takes at least (rms): "
            f"{'; '.join(parts)}."
        )
        told += _loss_words(found, along, i)
    for one in found.sets:
        blind = [
            a.mode.name
            for a, k in ((a, found.sets.index(one)) for a in found.access)
            if a.by_sensors[k].grade == "none"
        ]
        if set_words(model, one) in ("all", "angles") or one == found.sets[0]:
            seen = found.torques[one]
            count = sum(torque.seen for torque in seen.torques)
            told.append(
                f"With {_set(model, one)} "
                + ("every mode is seen" if not blind else f"not seen: {', '.join(blind)}")
                + f"; of {len(seen.torques)} constant torques {count} can be told one at a time "
                f"and {seen.together} at once."
            )
    return told


def _loss_words(found: Found, along: Along, i: int) -> list[str]:
    """Where an input ceases to move a controlled state, if it does within the range."""
    path, values = along.path, along.sweep.values
    told = []
    for j, signal in enumerate(path.model.inputs):
        reach = along.reach.per_volt[:, i, j]
        best = float(reach.max(initial=0.0))
        zero = np.flatnonzero(reach <= 1e-6 * best)
        # What hardly moves it anywhere has nothing to lose.
        if 0 < len(zero) <= 3 and best * found.scales.u[j] > _LITTLE * MOTION:
            at = values[zero[0]]
            unit = f" {path.unit}" if path.unit else ""
            told.append(
                f"{signal.name} loses {path.model.controlled[i]} at {path.over} = {at:.4g}{unit}: "
                f"to first order it does not move it there at all."
            )
    return told


def sections_of(found: Found, along: Along) -> list[Section]:
    """Inputs, the range, sensors, torques."""
    return [_inputs(found), _range(found, along), _sensors(found), _torques(found)]


def warnings_of(found: Found, along: Along) -> list[str]:
    """What limits the answer."""
    told = [
        "All of this is of the linearised rig: where an input has no slope (a thrust goes as ω|ω|) "
        "a large command still acts."
    ]
    if along.path.linear.switches(found.point.x, found.point.u):
        told.append(
            "The operating point lies on a switch, where a coefficient depends on a direction; the "
            f"slopes are those of study.side={along.path.side}."
        )
    told += [f"The range ends early: {why}." for why in (along.sweep.low, along.sweep.high) if why]
    return told


def _inputs(found: Found) -> Section:
    model = found.model
    columns = [signal.name for signal in model.inputs] + ["together"] * (model.n_u > 1)
    rows: list[list[Value | Judged]] = [
        [a.mode.name, *(_moved(reach) for reach in a.by_input)] for a in found.access
    ]
    table = Table(
        ("mode", *columns),
        rows,
        "Whether an input moves a mode; in brackets how far a full command in step with it pumps "
        f"it in {found.duration:g} s (1×: an angle of {MOTION:g} rad or its like), and the PBH "
        "margin.",
    )
    volts: list[list[Value | Judged]] = []
    for i, state in enumerate(model.states):
        cells: list[Value | Judged] = [
            f"{state_words(model, i)} by {_amount(found.scales.x[i], state.unit)}"
        ]
        for j in range(model.n_u):
            value = float(found.volts[i, j])
            limit = float(found.scales.u[j])
            if value > _ABSURD * limit:
                cells.append(Judged("never", "bad"))
            else:
                cells.append(Judged(_sig(value), "" if value <= limit else "doubtful"))
        volts.append(cells)
    units = [f"{signal.name} [{signal.unit} rms]" for signal in model.inputs]
    moves = Table(
        ("to move", *units),
        volts,
        f"Least command, root mean square over {found.duration:g} s, that moves a state by a "
        "typical size (the others end where they may).",
    )
    text = [
        "A mode is controllable if [λI − A, B] has full rank (Popov, Belevitch, Hautus); the "
        "margin is its smallest singular value with states and inputs scaled by typical sizes.",
        "The least command is √(d²/(c W cᵀ T)) with the Gramian W of the time T.",
    ]
    gramians = found.gramians
    if gramians.hankel is not None:
        values = ", ".join(f"{v:.3g}" for v in gramians.hankel)
        text.append(
            "The point is stable, so that Gramians for ever exist (Lyapunov equation, residual "
            f"{gramians.residual:.1e}); Hankel singular values of the scaled system: {values}."
        )
    else:
        text.append(
            "The point is not asymptotically stable: Gramians exist over a finite time only."
        )
    return Section("What the inputs move", text, (table, moves))


def _range(found: Found, along: Along) -> Section:
    text = [
        "How far one unit (rms) of each input alone moves a controlled state in "
        f"{found.duration:g} s at best, the operating point solved anew along {along.path.over}. "
        "Where a rotor's speed goes through zero its gain goes to zero with |ω|."
    ]
    charts = [loss_chart(along.path, along.sweep, along.reach, found.duration)]
    charts.append(volts_chart(along.path, along.sweep, along.reach, found.scales, found.duration))
    return Section(f"Over {along.path.over}", text, charts)


def _sensors(found: Found) -> Section:
    model = found.model
    heads = [set_words(model, one) for one in found.sets]
    rows: list[list[Value | Judged]] = [
        [a.mode.name, *(_seen(reach) for reach in a.by_sensors)] for a in found.access
    ]
    table = Table(
        ("mode", *heads),
        rows,
        "Whether sensors see a mode, and how large a motion worth speaking of "
        f"({MOTION:g} rad or its like) reads, in standard deviations σ of one reading.",
    )
    return Section(
        "What the sensors see",
        ["A mode is observable if [λI − A; C] has full rank."],
        (table,),
    )


def _torques(found: Found) -> Section:
    model = found.model
    heads = [set_words(model, one) for one in found.sets]
    rows: list[list[Value | Judged]] = []
    for j, signal in enumerate(model.disturbances):
        cells: list[Value | Judged] = [f"{signal.name} [{signal.unit}]"]
        for one in found.sets:
            torque = found.torques[one].torques[j]
            error = torque.errors[0]
            if not torque.seen:
                cells.append(Judged("no", "bad"))
            else:
                cells.append(f"±{error:.2g}" if error is not None else Judged("weakly", "doubtful"))
        rows.append(cells)
    rows.append(["told at once", *(found.torques[one].together for one in found.sets)])
    table = Table(
        ("constant torque", *heads),
        rows,
        f"Standard deviation of its estimate after {found.duration:g} s of readings every "
        f"{found.reading_time * 1000:g} ms, if it is the only one and the initial state is known "
        "to ±1 rad and ±1 rad/s; no: it cannot be told.",
    )
    text = [
        "A constant torque is a state without a rate beside the others; it is observable if "
        "[A e; C 0] has full rank. Two torques that move the sensors alike in the end cannot be "
        "told apart, whatever the filter: the last row is how many can be told at once."
    ]
    blocks: list[Any] = [table]
    chart = torque_chart(model, found.sets, found.torques, found.times)
    if chart is not None:
        blocks.append(chart)
    return Section("Constant torques", text, blocks)


def _moved(reach: Reach) -> Judged:
    words, judgement = _GRADES[reach.grade]
    if reach.grade == "none":
        return Judged(words, judgement)
    return Judged(f"{words} ({_rounded(reach.strength)}×; {reach.margin:.2g})", judgement)


def _seen(reach: Reach) -> Judged:
    words, judgement = _GRADES[reach.grade]
    return Judged(words if reach.grade == "none" else f"{_rounded(reach.strength)}σ", judgement)


def _rounded(value: float) -> str:
    return f"{value:.0f}" if value >= 10 else f"{value:.2g}"


def _command(volts: float, limit: float, unit: str) -> str:
    if not volts <= _ABSURD * limit:
        return "cannot"
    return f"{volts:.3g} {unit}".replace(" 1", "") + (
        " (beyond its limit)" if volts > limit else ""
    )


def _amount(size: float, unit: str) -> str:
    return f"{size:.3g} {unit}" if unit not in ("", "1") else f"{size:.3g}"


def _set(model: Model, one: tuple[str, ...]) -> str:
    words = set_words(model, one)
    return {"all": "all sensors", "angles": "the angles alone"}.get(words, words)


def _sig(value: float) -> float | None:
    return float(f"{value:.3g}") if math.isfinite(value) else None
