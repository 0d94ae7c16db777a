"""Time plots of a run: angles, commands, rates, speeds, torques, innovations, with its events."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from trms_cli.reporting.interactive import (
    ALARM,
    CURVES,
    GREY,
    INK,
    PALE,
    Plot,
    band,
    framed,
    instant,
    level,
    line,
    plot_text,
    points,
    significant,
    span,
    time_plot,
)
from trms_cli.reporting.reported import FloatArray, ReportedRun, RunEvent, numbers
from trms_cli.reporting.style import LABELS, signal_place

#: Marks and shaded times of a plot at most: more say no more than that there are many.
MOST_MARKS = 60
_MOST_SPANS = 200
#: Limits further away than this many times what happened are not drawn.
_NEAR = 2.5
_MOST_PLOTS = 8
_RIG, _MEASURED, _ESTIMATE = CURVES[0], GREY, CURVES[1]
#: Stems of fields that stand in one plot: words, and factor for the shown unit.
_STATES = (("omega_", "rotor speeds"), ("S_", "rates"), ("i_", "armature currents"))
_TORQUES = (
    ("_moment", "estimated torques on the axes"),
    ("_motor", "estimated torques on the rotors"),
)
_OWN_PLOTS = ("alpha_", "sd_", "predicted_", "innovation_")


def label_of(name: str) -> str:
    """``alpha_v`` as pitch; other names as they are."""
    rates = {"S_v": "pitch S_v", "S_h": "yaw S_h"}
    return LABELS.get(name, rates.get(name, name))


def axis_title(words: str, unit: str) -> str:
    """``pitch [rad]``."""
    return f"{words} [{unit}]" if unit else words


def angle_plots(run: ReportedRun) -> list[Plot]:
    """Each controlled channel: reference, rig, measured, estimate with its band, events."""
    plots = []
    for number, name in enumerate(run.channels()):
        unit = _unit_of_channel(run, name)
        plot = time_plot(label_of(name), axis_title(label_of(name), unit), height=300)
        seen = _draw_channel(plot, run, name)
        _limits(plot, run, [name], seen)
        _frame(plot, seen)
        if number == 0:
            _event_marks(plot, run)
        plots.append(plot)
    return plots


def command_plot(run: ReportedRun) -> list[Plot]:
    """The commands with their limits; shaded where one is saturated."""
    names = run.inputs()
    if not names:
        return []
    unit = run.unit("/command", names[0])
    plot = time_plot("commands", axis_title("command", unit), height=240)
    time, seen = run.time("/command"), []
    for number, name in enumerate(names):
        colour = CURVES[signal_place(name, number) % len(CURVES)]
        values = numbers(run.topic("/command")[name])
        label = name if label_of(name) == name else f"{label_of(name)} {name}"
        plot.traces.append(line(time, values, label, colour, steps=True))
        seen.append(values)
        spans = list(_saturated(run, name))[:_MOST_SPANS]
        plot.shapes([span(begin, end, colour) for begin, end in spans])
    _limits(plot, run, names, seen)
    _frame(plot, seen)
    plot.caption = (
        "As applied to the rig, after limits. Dotted: limits; shaded: an input asked for more."
    )
    return [plot]


def state_plots(run: ReportedRun) -> list[Plot]:
    """Rotor speeds, rates, currents, and what else the rig's state or the estimate has."""
    names = dict.fromkeys(
        name
        for topic in ("/plant/state", "/measurement", "/estimate")
        for name in run.topic(topic)
        if not name.startswith(_OWN_PLOTS) and "_lag" not in name and not _is_torque(name)
    )
    groups: dict[str, list[str]] = {}
    for name in names:
        words = next((words for stem, words in _STATES if name.startswith(stem)), name)
        groups.setdefault(words, []).append(name)
    plots = []
    for words, members in list(groups.items())[:_MOST_PLOTS]:
        unit = _unit_anywhere(run, members[0])
        plot = time_plot(words, axis_title(words, unit), half=True, height=240)
        seen: list[FloatArray] = []
        for number, name in enumerate(members[: len(CURVES)]):
            colour = CURVES[signal_place(name, number) % len(CURVES)]
            seen += _draw_state(plot, run, name, colour)
        if any(trace["mode"] == "lines" for trace in plot.traces):
            _frame(plot, seen)
            if any(name.startswith("S_") for name in members):
                plot.caption = "S is the rate less what the other rotor's momentum gives the axis."
            plots.append(plot)
    return plots


def torque_plots(run: ReportedRun) -> list[Plot]:
    """Torques that the observer estimates at all, with two standard deviations."""
    estimate, time, plots = run.topic("/estimate"), run.time("/estimate"), []
    for ending, words in (*_TORQUES, ("_push", "estimated pushes")):
        plot = time_plot(words, "", half=True, height=240)
        seen, unit = [], ""
        for name in (n for n in estimate if n.endswith(ending) and not n.startswith("sd_")):
            deviation = numbers(estimate.get(f"sd_{name}", np.zeros(len(time))))
            if not np.any(deviation > 0):
                continue
            colour = CURVES[signal_place(name, len(plot.traces) // 2) % len(CURVES)]
            unit = run.unit("/estimate", name)
            factor = 1e3 if unit == "N m" else 1.0  # shown in mN m
            values, deviation = factor * numbers(estimate[name]), factor * deviation
            plot.traces += _with_band(time, values, deviation, name.replace("_", " "), colour)
            seen += _reach(values, deviation)
        if seen:
            shown = "mN m" if unit == "N m" else unit
            plot.layout["yaxis"]["title"]["text"] = plot_text(axis_title("torque", shown))
            _frame(plot, seen)
            plots.append(plot)
    return plots


def innovation_plots(run: ReportedRun) -> list[Plot]:
    """Measured minus foretold, against two of the deviations that the observer expects."""
    estimate, time = run.topic("/estimate"), run.time("/estimate")
    names = [n for n in estimate if n.startswith("innovation_") and "innovation_sd_" not in n]
    plots = []
    for name in names[:_MOST_PLOTS]:
        channel = name.removeprefix("innovation_")
        values = numbers(estimate[name])
        if not np.isfinite(values).any():
            continue
        words, unit = label_of(channel), run.unit("/estimate", name)
        title = axis_title(words, unit)
        plot = time_plot(f"innovation of {words}", title, half=True, height=210)
        deviation = numbers(estimate.get(f"innovation_sd_{channel}", np.full(len(time), np.nan)))
        plot.traces.append(
            band(time, -2 * deviation, 2 * deviation, "± 2 sd expected", CURVES[1], opacity=0.3)
        )
        plot.traces.append(line(time, values, "innovation", CURVES[0], width=1.0))
        _frame(plot, [values])
        plots.append(plot)
    return plots


def whole_time(plots: Sequence[Plot], begin: float, end: float) -> None:
    """Give plots of the time the same range, and the last its title."""
    timed = [plot for plot in plots if plot.group == "time"]
    for plot in timed:
        plot.layout["xaxis"] = {
            "range": [significant(begin, 9), significant(max(end, begin + 1e-3), 9)],
            "title": {"text": "time [s]"},
        }


def mode_spans(run: ReportedRun) -> list[dict[str, Any]]:
    """Shaded times in which the loop was not normal."""
    modes, time = run.topic("/controller").get("mode", ()), run.time("/controller")
    found = []
    for mode, colour in (("degraded", PALE), ("landing", CURVES[4])):
        inside = np.asarray(modes, dtype=object) == mode if len(modes) else np.zeros(0, dtype=bool)
        edges = np.flatnonzero(np.diff(np.concatenate([[False], inside, [False]]).astype(int)))
        for begin, end in zip(edges[::2], edges[1::2], strict=True):
            found.append(
                span(float(time[begin]), float(time[min(end, len(time) - 1)]), colour, 0.35)
            )
    return found[:_MOST_SPANS]


def shown_events(run: ReportedRun) -> list[RunEvent]:
    """Events worth a mark: what neither a saturation nor an outlier is, the first ones."""
    told = ("saturation", "outlier")
    return [e for e in run.events if not e.kind.startswith(told) and math.isfinite(e.time)]


def _draw_channel(plot: Plot, run: ReportedRun, name: str) -> list[FloatArray]:
    truth, measured = run.topic("/plant/state"), run.topic("/measurement")
    reference, seen = run.topic("/reference"), []
    plot.traces += _estimate_traces(run, name)
    if name in measured:
        values = numbers(measured[name])
        plain = name not in truth
        colour, width = (_RIG, 1.4) if plain else (_MEASURED, 0.9)
        plot.traces.append(line(run.time("/measurement"), values, "measured", colour, width=width))
        seen.append(values)
    if name in truth:
        values = numbers(truth[name])
        plot.traces.append(line(run.time("/plant/state"), values, "rig", _RIG, width=2))
        seen.append(values)
    if name in reference:
        values = numbers(reference[name])
        plot.traces.append(
            line(
                run.time("/reference"), values, "reference", INK, dash="dash", steps=True, width=1.2
            )
        )
        seen.append(values)
    plot.shapes(mode_spans(run))
    return seen


def _estimate_traces(run: ReportedRun, name: str) -> list[dict[str, Any]]:
    """The estimate with two standard deviations, if it is one: a full-state observer has none."""
    estimate = run.topic("/estimate")
    deviation = numbers(estimate.get(f"sd_{name}", ()))
    if name not in estimate or not np.any(deviation > 0):
        return []
    values = numbers(estimate[name])
    return _with_band(run.time("/estimate"), values, deviation, "estimate ± 2 sd", _ESTIMATE)


def _with_band(
    time: FloatArray, values: FloatArray, deviation: FloatArray, name: str, colour: str
) -> list[dict[str, Any]]:
    """A curve and its band of two deviations, which a click on its name hides together."""
    shaded = band(
        time, values - 2 * deviation, values + 2 * deviation, name, colour,
        legendgroup=plot_text(name), showlegend=False,
    )  # fmt: skip
    return [shaded, line(time, values, name, colour, width=1.1, legendgroup=plot_text(name))]


def _draw_state(plot: Plot, run: ReportedRun, name: str, colour: str) -> list[FloatArray]:
    """A state as it was, as measured where nothing truer is known, and as estimated."""
    seen, label = [], label_of(name)
    truth = "/plant/state" if name in run.topic("/plant/state") else "/measurement"
    if name in run.topic(truth):
        values = numbers(run.topic(truth)[name])
        word = "" if truth == "/plant/state" else " measured"
        plot.traces.append(line(run.time(truth), values, f"{label}{word}", colour, width=1.6))
        seen.append(values)
    if name in run.topic("/estimate"):
        values = numbers(run.topic("/estimate")[name])
        deviation = numbers(run.topic("/estimate").get(f"sd_{name}", np.zeros(len(values))))
        if np.any(deviation > 0) or not seen:
            plot.traces += _with_band(
                run.time("/estimate"), values, deviation, f"{label} estimate", colour
            )
            plot.traces[-1]["line"]["dash"] = "dot"
            seen += [values] if len(seen) == 0 else []
    return seen


def _event_marks(plot: Plot, run: ReportedRun) -> None:
    """Triangles at the top, told when pointed at, and lines."""
    events = shown_events(run)[:MOST_MARKS]
    if not events:
        return
    plot.shapes([instant(e.time, ALARM if _alarming(e) else GREY) for e in events])
    plot.traces.append(
        points(
            [e.time for e in events],
            np.full(len(events), 0.97),
            "events",
            [ALARM if _alarming(e) else GREY for e in events],
            size=9,
            symbol="triangle-down",
            yaxis="y2",
            hovertemplate="%{text}",
            text=[
                plot_text(": ".join(p for p in (e.kind, e.source, e.message) if p)) for e in events
            ],
        )
    )
    plot.layout["yaxis2"] = {
        "overlaying": "y", "range": [0, 1], "visible": False, "fixedrange": True,
    }  # fmt: skip


def _alarming(event: RunEvent) -> bool:
    return not event.kind.endswith("_end") and event.kind not in ("fault_removed", "note")


def _limits(plot: Plot, run: ReportedRun, names: Sequence[str], seen: Sequence[FloatArray]) -> None:
    finite = np.concatenate([v[np.isfinite(v)] for v in seen]) if seen else np.zeros(0)
    reach = float(np.abs(finite).max()) if finite.size else 1.0
    bounds = {float(b) for name in names for b in run.limits.get(name, ()) if math.isfinite(b)}
    plot.shapes([level(bound) for bound in sorted(bounds) if abs(bound) < _NEAR * reach])


def _frame(plot: Plot, seen: Sequence[FloatArray]) -> None:
    found = framed(seen)
    if found is not None:
        plot.layout.setdefault("yaxis", {})["range"] = found


def _saturated(run: ReportedRun, name: str) -> Iterator[tuple[float, float]]:
    begin = None
    for event in run.events:
        if event.source == name and event.kind == "saturation_begin":
            begin = event.time
        elif event.source == name and event.kind == "saturation_end" and begin is not None:
            yield begin, event.time
            begin = None
    if begin is not None:
        yield begin, run.end


def _reach(values: FloatArray, deviation: FloatArray) -> list[FloatArray]:
    """A settled curve, and how far its typical band goes from its middle."""
    settled = values[len(values) // 20 :]
    known = np.isfinite(settled)
    if not known.any():
        return []
    middle, typical = np.median(settled[known]), 2 * np.nanmedian(deviation)
    return [settled, np.array([middle - typical, middle + typical])]


def _is_torque(name: str) -> bool:
    return name.endswith((*(ending for ending, _ in _TORQUES), "_push"))


def _unit_of_channel(run: ReportedRun, name: str) -> str:
    told: Mapping[str, Any] = run.score.get("channels", {}).get(name, {})
    return str(told.get("unit") or _unit_anywhere(run, name))


def _unit_anywhere(run: ReportedRun, name: str) -> str:
    for topic in ("/measurement", "/plant/state", "/estimate", "/reference"):
        if name in run.units.get(topic, {}):
            return run.unit(topic, name)
    return ""
