"""Panels of runs' signals: channels, commands, rates, estimates, torques, phase plots, solver.

Each function makes :class:`~trms_cli.core.chart.Panel` of one run; its picture and its page are put
together of them. Several runs over one another: :mod:`trms_cli.reporting.plot_kinds`. What pitch
and the main rotor have is blue, what yaw and the tail rotor have is vermilion.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from trms_cli.core import chart as draw
from trms_cli.core import wording
from trms_cli.reporting.signals import FloatArray, RunSignals, TimeSeries
from trms_cli.scoring.figures import of_group

Runs = Sequence[RunSignals]
#: Colour and dashes of the n-th of several runs.
Look = Callable[[int], dict[str, Any]]

#: A signal of a run, by its name.
Pick = Callable[[RunSignals, str], TimeSeries | None]

#: Limits further from what happened than this share of its span are not drawn: they would squeeze
#: it; of a command those beyond so many times the largest.
_NEAR, _NEAR_A_COMMAND = 0.3, 2.5
#: Shaded times, marks of events, panels of one kind, and bars of a histogram at most.
_MOST_SPANS, _MOST_MARKS, _MOST_PANELS, _BINS = 200, 60, 8, 60
#: Predictions, and samples of all of them, that a page holds at most.
MOST_FANS, _MOST_SAMPLES = 400, 20_000
#: Stems of fields that stand in one panel.
_STATES = (("omega_", "rotor speeds"), ("S_", "rates"), ("i_", "armature currents"))
_NO_STATES = ("alpha_", "sd_", "predicted_", "innovation_")
_NO_STATE_ENDS = ("_moment", "_motor", "_push")
#: Events that other marks tell already.
_TOLD_ELSEWHERE = ("saturation", "outlier")
_TICKS = tuple(10.0**n for n in range(-6, 7))


def label_of(name: str) -> str:
    """``alpha_v`` as pitch; other names as they are."""
    return {"S_v": "pitch S_v", "S_h": "yaw S_h"}.get(name, wording.signal(name))


def symbol_label(name: str) -> str:
    """An input in words and by its symbol: ``main rotor u_v``."""
    return name if label_of(name) == name else f"{label_of(name)} {name}"


def time_axis(*runs: RunSignals) -> draw.Axis:
    """The time of runs, from the first to the last sample; linked with all others."""
    begin, end = min(run.begin for run in runs), max(run.end for run in runs)
    return draw.Axis("time", "s", (begin, max(end, begin + 1e-3)), linked="time")


def axis_range(samples: Iterable[Any], margin: float = 0.08) -> tuple[float, float] | None:
    """Range of an axis by what happened; None without a finite value.

    The bands of an uncertain start are not among what is seen: they would flatten the rest.
    """
    values = [np.asarray(v, dtype=float) for v in samples]
    finite = np.concatenate([[], *(v[np.isfinite(v)] for v in values)])
    if not finite.size:
        return None
    low, high = float(finite.min()), float(finite.max())
    room = margin * (high - low) or 0.05 * max(abs(high), 1.0)
    return low - room, high + room


# --- one run


def channel_panel(run: RunSignals, name: str, *, detail: bool = False) -> draw.Panel:
    """A channel: reference, rig, estimate with its band, limits.

    ``detail``: what was measured of a rig whose true state is known, and when it was not normal.
    """
    truth, reference = run.truth(name), run.signal("/reference", name)
    measured = run.signal("/measurement", name) if detail else None
    guess = run.estimated(name)
    marks: list[draw.Mark] = _not_normal(run) if detail else []
    estimated = with_band(*guess, "estimate ± 2 sd", "vermilion", 0.9) if guess is not None else []
    marks += estimated if detail else []
    if measured is not None and truth is not None and truth.source == "rig":
        marks.append(draw.Curve(measured.time, measured.values, "measured", "measured", width=0.9))
    if truth is not None and truth.source == "rig":
        wide = {"width": 1.8} if detail else {"width": 2.6, "opacity": 0.6}
        marks.append(draw.Curve(truth.time, truth.values, "rig", **wide))  # type: ignore[arg-type]
    elif truth is not None and truth.source == "measured":
        marks.append(draw.Curve(truth.time, truth.values, "measured", width=1.2))
    if reference is not None:
        marks.append(reference_curve(reference))
    marks += [] if detail else estimated
    if guess is None and truth is not None and truth.source == "estimate":
        marks.append(draw.Curve(truth.time, truth.values, "estimate", "vermilion"))
    response = (
        truth if truth is not None and (truth.source != "estimate" or guess is None) else None
    )
    samples = [each.values for each in (response, reference, measured) if each is not None]
    limits, lines = with_limits([run], [name], axis_range(samples))
    unit = next((each.unit for each in (truth, reference) if each is not None and each.unit), "")
    axis = draw.Axis(label_of(name), unit, limits)
    return draw.Panel(time_axis(run), axis, [*marks, *lines], label_of(name))


def command_panel(run: RunSignals) -> draw.Panel | None:
    """The commands with their limits; shaded where one is saturated."""
    names = run.inputs()
    if not names:
        return None
    marks: list[draw.Mark] = []
    samples = []
    for number, name in enumerate(names):
        colour, values = draw.signal_colour(name, number), run.numbers("/command", name)
        spans = list(run.saturated(name))[:_MOST_SPANS]
        marks += [draw.Span(*span, colour=colour, opacity=0.18) for span in spans]
        time = run.time("/command")
        marks.append(draw.Curve(time, values, symbol_label(name), colour, width=1.0, is_step=True))
        samples.append(values)
    limits, lines = with_limits([run], names, axis_range(samples), of_commands=True)
    axis = draw.Axis("command", run.unit("/command", names[0]), limits)
    caption = (
        "As applied to the rig, after limits. Dotted: limits; shaded: an input asked for more."
    )
    return draw.Panel(time_axis(run), axis, [*marks, *lines], "commands", caption=caption)


def torque_panels(run: RunSignals) -> list[draw.Panel]:
    """Torques that the observer estimates at all, with light bands of two standard deviations.

    A panel reaches as far as most of the lines and of their bands do: neither an observer that
    finds its feet nor the uncertainty of one torque hides the others.
    """
    return [torque_panel(run, place, names) for place, names in run.torques().items()]


def torque_panel(run: RunSignals, place: str, names: Sequence[str]) -> draw.Panel:
    """The torques of some names."""
    marks: list[draw.Mark] = [draw.Line(y=0.0, colour="pale", style="solid")]
    reach, unit = [], ""
    for number, name in enumerate(names):
        estimate = run.estimated(name)
        assert estimate is not None
        torque, factor = in_small_unit(estimate[0])
        deviation, unit = factor * estimate[1], torque.unit
        again = any(
            draw.signal_colour(other) == draw.signal_colour(name) for other in names[:number]
        )
        marks += with_band(
            torque,
            deviation,
            name.replace("_", " "),
            draw.signal_colour(name, number),
            0.9,
            opacity=0.12,
            style="dashed" if again else "solid",
        )
        begin = len(deviation) // 20  # an observer that finds its feet
        reach.append(_reach(torque.values[begin:], deviation[begin:]))
    limits = axis_range(reach)
    title = f"estimated {'pushes' if place == 'pushes' else f'torques on the {place}'}"
    axis = draw.Axis(f"torque on\n{place}" if place != "pushes" else "push", unit, limits)
    return draw.Panel(time_axis(run), axis, marks, title)


def in_small_unit(signal: TimeSeries) -> tuple[TimeSeries, float]:
    unit, factor = {"N m": ("mN m", 1e3)}.get(signal.unit, (signal.unit, 1.0))
    return signal.scaled(factor, unit), factor


def _reach(values: FloatArray, deviation: FloatArray) -> tuple[float, float]:
    """From where to where most of a line and of its band of two deviations goes, and zero."""
    finite = np.isfinite(values) & np.isfinite(deviation)
    if not finite.any():
        return 0.0, 0.0
    values, typical = values[finite], 2 * float(np.median(deviation[finite]))
    low, high = np.quantile(values, (0.005, 0.995))
    middle = float(np.median(values))
    return min(float(low), middle - typical, 0.0), max(float(high), middle + typical, 0.0)


def state_panels(run: RunSignals) -> list[draw.Panel]:
    """Rotor speeds, rates, currents, and what else the rig's state or the estimate has."""
    topics = ("/plant/state", "/measurement", "/estimate")
    groups: dict[str, list[str]] = {}
    for name in dict.fromkeys(name for topic in topics for name in run.names(topic)):
        if name.startswith(_NO_STATES) or "_lag" in name or name.endswith(_NO_STATE_ENDS):
            continue
        words = next((words for stem, words in _STATES if name.startswith(stem)), name)
        groups.setdefault(words, []).append(name)
    panels = []
    for words, members in list(groups.items())[:_MOST_PANELS]:
        unit = next((unit for topic in topics if (unit := run.unit(topic, members[0]))), "")
        marks, samples = [], []
        for number, name in enumerate(members[:6]):
            own, values = _state(run, name, draw.signal_colour(name, number))
            marks += own
            samples += values
        caption = ""
        if any(name.startswith("S_") for name in members):
            caption = "S is the rate less what the other rotor's momentum gives the axis."
        if marks:
            axis, time = draw.Axis(words, unit, axis_range(samples)), time_axis(run)
            panels.append(draw.Panel(time, axis, marks, words, half=True, caption=caption))
    return panels


def _state(run: RunSignals, name: str, colour: Any) -> tuple[list[draw.Mark], list[FloatArray]]:
    """A state as it was, as measured where nothing truer is known, and as estimated."""
    marks: list[draw.Mark] = []
    truth, label = run.signal("/plant/state", name), label_of(name)
    if truth is None:
        truth = run.signal("/measurement", name)
        marks += (
            [draw.Curve(truth.time, truth.values, f"{label} measured", colour)] if truth else []
        )
    else:
        marks.append(draw.Curve(truth.time, truth.values, label, colour, width=1.6))
    guess = run.estimated(name)
    if guess is not None:
        marks += with_band(*guess, f"{label} estimate", colour, 1.1, style="dotted")
    elif truth is None and (alone := run.signal("/estimate", name)) is not None:
        truth = alone
        marks.append(draw.Curve(alone.time, alone.values, f"{label} estimate", colour, "dotted"))
    series = truth or (guess[0] if guess is not None else None)
    return marks, [] if series is None else [series.values]


def innovation_panels(
    run: RunSignals, figures: Mapping[str, Mapping[str, Any]] | None = None
) -> list[draw.Panel]:
    """Measured minus foretold, against two of the deviations that the observer expects.

    ``figures``: of a replay, by channel, which then has a panel each.
    """
    candidates = run.names("/estimate") if figures is None else [f"innovation_{n}" for n in figures]
    names = [n for n in candidates if n.startswith("innovation_") and "innovation_sd_" not in n]
    panels = []
    for name in names[: None if figures else _MOST_PANELS]:
        channel = name.removeprefix("innovation_")
        innovation = run.signal("/estimate", name)
        if innovation is None:
            continue
        deviation = run.numbers("/estimate", f"innovation_sd_{channel}")
        band = 2 * deviation if len(deviation) else np.full(len(innovation.time), np.nan)
        marks: list[draw.Mark] = [
            draw.Band(innovation.time, -band, band, "±2σ expected", "vermilion", 0.3),
            draw.Curve(innovation.time, innovation.values, "innovation", width=0.7),
        ]
        words = label_of(channel)
        axis = draw.Axis(
            f"innovation\nof {words}", innovation.unit, _around_band(innovation.values, band)
        )
        panels.append(
            draw.Panel(
                time_axis(run),
                axis,
                marks,
                f"innovation of {words}",
                half=True,
                note=_foretold(figures[channel]) if figures else "",
            )
        )
    return panels


def _around_band(values: FloatArray, band: FloatArray) -> tuple[float, float]:
    """Some way beyond the band, further where innovations are; its start is no measure."""
    typical = float(np.nanmedian(band)) if np.isfinite(band).any() else 0.0
    worst = float(np.nanquantile(np.abs(values), 0.999))
    reach = max(1.6 * typical, min(1.2 * worst, 6.0 * typical or math.inf)) or 1.0
    return -reach, reach


def _foretold(figures: Mapping[str, Any]) -> str:
    words = [f"RMSE {wording.number(figures['prediction_rmse'])}"]
    if figures["within_2sd"] is not None:
        words.append(f"{wording.percent(figures['within_2sd'])} within")
    if figures["whiteness_p"] is not None:
        words.append("white" if figures["whiteness_p"] >= 0.05 else "not white")
    return ", ".join(words)


def solver_panel(run: RunSignals) -> draw.Panel | None:
    """Time of each step against its deadline; marks where a fall-back acted or a fault began."""
    times = run.step_times()
    if times is None:
        return None
    time, deadline = run.time("/controller"), run.deadline
    finite_times = times[np.isfinite(times)]
    marks: list[draw.Mark] = _not_normal(run, named=True)
    marks.append(draw.Points(time, times, "", "dot", "grey", size=1.6))
    for rows, label, marker, colour in (
        (run.deadline_misses(), "deadline missed", "cross", "alarm"),
        (run.fell_back(), "fall-back", "down", "vermilion"),
    ):
        if rows.any():
            heights = np.where(np.isfinite(times[rows]), times[rows], finite_times.min())
            marks.append(draw.Points(time[rows], heights, label, marker, colour, size=5))  # type: ignore[arg-type]
    marks += [draw.Line(y=deadline, colour="alarm")] if deadline is not None else []
    top = 3 * max(deadline, float(finite_times.max())) if deadline is not None else None
    axis = step_axis((0.5 * float(finite_times.min()), top))
    failed, missed = int(run.fell_back().sum()), int(run.deadline_misses().sum())
    note = f"median {np.median(finite_times):.3g} ms"
    words = (
        f"Median {np.median(finite_times):.3g} ms, "
        f"99th percentile {np.quantile(finite_times, 0.99):.3g} ms, "
        f"longest {finite_times.max():.3g} ms"
    )
    if deadline is not None:
        note += f", deadline {deadline:.3g} ms" + (f", {missed} missed" if missed else "")
        words += f"; the deadline is {deadline:.4g} ms (dotted), missed {missed} times"
    note += f", {failed} fall-backs" if failed else ""
    words += f"; a fall-back acted on {failed} steps." if failed else "."
    return draw.Panel(
        time_axis(run), axis, marks, "time of a control step", note=note, caption=words
    )


def step_axis(limits: tuple[float, float | None] | None = None) -> draw.Axis:
    return draw.Axis("step time", "ms", limits, log=True, ticks=_TICKS)


def solver_panels(run: RunSignals) -> list[draw.Panel]:
    """Times over the run and their distribution, and iterations where a solver has some."""
    over_time, times = solver_panel(run), run.step_times()
    if over_time is None or times is None:
        return []
    finite_times = times[np.isfinite(times)]
    low, high = float(finite_times.min()), float(finite_times.max())
    edges = np.geomspace(low, max(high, 1.0001 * low), _BINS + 1)
    marks: list[draw.Mark] = [histogram(finite_times, edges)]
    marks += [draw.Line(x=run.deadline, colour="alarm")] if run.deadline is not None else []
    return [
        over_time,
        *(replace(panel, half=True) for panel in iteration_panels([run])),
        draw.Panel(step_axis(), draw.Axis("steps"), marks, "distribution of the times", half=True),
    ]


def histogram(
    values: FloatArray,
    edges: FloatArray,
    label: str = "",
    colour: Any = "blue",
    opacity: float = 0.8,
) -> draw.Curve:
    """How many values lie between the edges."""
    counts = np.histogram(values[np.isfinite(values)], edges)[0]
    return draw.Curve(
        edges,
        np.append(counts, 0.0),
        label,
        colour,
        width=0.6,
        is_step=True,
        opacity=opacity,
        filled=True,
    )


def event_marks(run: RunSignals) -> list[draw.Events]:
    """Triangles at the top, told when pointed at: what alarms, and the rest."""
    events = [e for e in run.events if not e.kind.startswith(_TOLD_ELSEWHERE)]
    events = [e for e in events if math.isfinite(e.time)][:_MOST_MARKS]
    parts = [
        ("alarm", [e for e in events if e.alarming]),
        ("grey", [e for e in events if not e.alarming]),
    ]
    return [
        draw.Events(
            [e.time for e in some],
            "event",
            colour,  # type: ignore[arg-type]
            [": ".join(p for p in (e.kind, e.source, e.message) if p) for e in some],
        )
        for colour, some in parts
        if some
    ]


def fan_panels(run: RunSignals, most: int = MOST_FANS) -> list[draw.Panel]:
    """All predictions of a controller, of which a page draws one bold, over what happened."""
    starts = run.time("/prediction")
    ahead = run.column("/prediction", "time")
    if not len(ahead):
        return []
    step = max(1, math.ceil(len(starts) / most))
    length = max(np.size(ahead[i]) for i in range(0, len(starts), step))
    step = max(step, math.ceil(len(starts) * max(length, 1) / _MOST_SAMPLES))
    names = [*run.channels(), *run.inputs()]
    predicted_names = [name for name in names if name in run.names("/prediction")]
    return [panel for name in predicted_names if (panel := _fan_panel(run, name, step)) is not None]


def _fan_panel(run: RunSignals, name: str, step: int) -> draw.Panel | None:
    starts, ahead = run.time("/prediction"), run.column("/prediction", "time")
    values = run.column("/prediction", name)
    xs: list[Any] = []
    ys: list[Any] = []
    times: list[float] = []
    for i in range(0, len(starts), step):
        later, foretold = (np.ravel(each[i]).astype(float) for each in (ahead, values))
        count = min(len(later), len(foretold))  # the inputs have one step less than the states
        if count:
            xs += [starts[i] + later[:count], [np.nan]]
            ys += [foretold[:count], [np.nan]]
            times.append(float(starts[i]))
    if not times:
        return None
    is_input = name in run.inputs()
    happened = run.signal("/command", name) if is_input else run.truth(name)
    reference = run.signal("/reference", name)
    marks: list[draw.Mark] = []
    if happened is not None:
        look: dict[str, Any] = {"width": 3.0, "opacity": 0.5, "is_step": is_input}
        marks.append(draw.Curve(happened.time, happened.values, "what happened", **look))
    marks += [reference_curve(reference)] if reference is not None else []
    marks.append(draw.Fans(times, np.concatenate(xs), np.concatenate(ys), is_step=is_input))
    samples = [each.values for each in (happened, reference) if each is not None]
    label = symbol_label(name) if is_input else label_of(name)
    axis = draw.Axis(
        label, happened.unit if happened is not None else "", axis_range(samples) or axis_range(ys)
    )
    return draw.Panel(time_axis(run), axis, marks, f"predictions of {label}")


def score_note(score: Mapping[str, Any]) -> str:
    """The figures of a channel that tell most: ``RMSE 0.134 rad · overshoot 4 %``."""
    unit = str(score.get("unit", "rad"))
    return " · ".join(
        f"{figure.label.partition(',')[0]} {wording.quantity(value, figure.unit_of(unit))}"
        for figure in of_group("channels")
        if figure.short and (value := figure.value(score)) is not None
    )


def reference_curve(reference: TimeSeries, **look: Any) -> draw.Curve:
    usual: dict[str, Any] = {"label": "reference", "colour": "ink", "style": "dashed"}
    return draw.Curve(reference.time, reference.values, **(usual | look), width=1.0, is_step=True)


def with_band(
    signal: TimeSeries,
    deviation: FloatArray,
    label: str,
    colour: Any,
    width: float,
    *,
    opacity: float = 0.22,
    **look: Any,
) -> list[draw.Mark]:
    """A curve and its band of two deviations, which a click on its name hides together."""
    low, high = signal.values - 2 * deviation, signal.values + 2 * deviation
    return [
        draw.Band(signal.time, low, high, label, colour, opacity),
        draw.Curve(signal.time, signal.values, label, colour, width=width, **look),
    ]


def _not_normal(run: RunSignals, *, named: bool = False) -> list[draw.Mark]:
    spans: list[draw.Mark] = []
    for mode, colour in (("degraded", "pale"), ("landing", "orange")):
        spans += [draw.Span(*span, mode if named else "", colour, 0.45) for span in run.mode(mode)]  # type: ignore[arg-type]
    return spans[:_MOST_SPANS]


def with_limits(
    runs: Runs,
    names: Sequence[str],
    frame: tuple[float, float] | None,
    *,
    of_commands: bool = False,
) -> tuple[tuple[float, float] | None, list[draw.Line]]:
    """The frame with the limits that the curves come near, and lines at them."""
    if frame is None:
        return None, []
    low, high = frame
    room, reach = _NEAR * (high - low), _NEAR_A_COMMAND * max(abs(low), abs(high))
    bounds = {b for run in runs for name in names for b in run.limits.get(name, ())}
    near = [
        bound
        for bound in sorted(bounds)
        if (abs(bound) < reach if of_commands else low - room < bound < high + room)
    ]
    lines = [
        draw.Line(y=bound, label="limit" if len(runs) > 1 else "", colour="alarm") for bound in near
    ]
    margin = 0.04 * (high - low)
    ends = [bound + side * margin for bound in near for side in (-1, 1)]
    return (min([low, *ends]), max([high, *ends])), lines


def iteration_panels(runs: Runs, look: Look = draw.curve_look) -> list[draw.Panel]:
    """Iterations over the time, where a solver has some."""
    counts = [run.numbers("/controller", "iterations") for run in runs]
    if not any(np.any(count > 1) for count in counts):
        return []
    marks, _, _ = curves_of(
        runs, lambda run, name: run.signal("/controller", name), "iterations", look, is_step=True
    )
    axis = draw.Axis("iterations", limits=(0.0, None))
    return [draw.Panel(time_axis(*runs), axis, marks, "iterations of the solver", row_height=0.6)]


def curves_of(
    runs: Runs, pick: Pick, name: str, look: Look, *, is_step: bool = False
) -> tuple[list[draw.Mark], list[FloatArray], str]:
    """A curve a run of one of its signals, their values, and their unit."""
    marks: list[draw.Mark] = []
    samples, unit = [], ""
    for i, run in enumerate(runs):
        signal = pick(run, name)
        if signal is None:
            continue
        unit = unit or signal.unit
        samples.append(signal.values)
        own, label = look(i), run.name
        if len(runs) == 1:  # the colour says which axis it is
            own = {"colour": draw.signal_colour(name), "style": "solid"}
            label = f"{label_of(name)}, {signal.source}" if signal.source else ""
        marks.append(draw.Curve(signal.time, signal.values, label, **own, is_step=is_step))
    return marks, samples, unit
