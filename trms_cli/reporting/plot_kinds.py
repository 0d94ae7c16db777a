"""The kinds of ``trms plot``: signals of runs over one another, each a panel or a few.

What pitch and the main rotor have is blue, what yaw and the tail rotor have is vermilion, where one
run is drawn alone; several have a colour each.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from trms_cli.core import chart as draw
from trms_cli.core import wording
from trms_cli.reporting.run_panels import (
    Look,
    Pick,
    Runs,
    axis_range,
    channel_panel,
    curves_of,
    fan_panels,
    in_small_unit,
    iteration_panels,
    label_of,
    reference_curve,
    step_axis,
    symbol_label,
    time_axis,
    with_band,
    with_limits,
)
from trms_cli.reporting.signals import FloatArray, RunReport, RunSignals, TimeSeries
from trms_cli.scoring.figures import finite, part

_NOT_LOGGED = "its estimates were not logged (sim.estimate_every=0)"
_ANGLES, _SPEEDS = ("alpha_v", "alpha_h"), ("omega_v", "omega_h")


class Absent(Exception):
    """Why something cannot be drawn, as a sentence."""


def tracking(runs: Runs, look: Look = draw.curve_look) -> list[draw.Panel]:
    """What was asked of each controlled axis, and what the rig did."""
    channel_names = _in_order(
        name for run in runs for name in [*run.names("/reference"), *_angles(run)]
    ) or _in_order(name for run in runs for name in run.channels())
    if not channel_names:
        raise Absent(_no_angle(runs))
    if len(runs) == 1:
        return [channel_panel(runs[0], name) for name in channel_names]
    panels = []
    for name in channel_names:
        marks, samples, unit = curves_of(runs, RunSignals.truth, name, look)
        references = _references(runs, name, look)
        limits, lines = with_limits(
            runs, [name], axis_range([*samples, *(c.y for c in references)])
        )
        axis = draw.Axis(label_of(name), unit or "rad", limits)
        panels.append(
            draw.Panel(time_axis(*runs), axis, [*references, *marks, *lines], label_of(name))
        )
    return panels


def _no_angle(runs: Runs) -> str:
    if any(len(table.time) for run in runs for table in run.tables.values()):
        return "no log has an angle: a motor or a propeller alone has none"
    return "no log holds a sample: the run ended, or was cut off, before the first one"


def errors(runs: Runs, look: Look = draw.curve_look) -> list[draw.Panel]:
    """Reference minus what the rig did."""
    names = _in_order(name for run in runs for name in run.names("/reference"))
    if not names:
        raise Absent("no log has a reference: nothing was to be followed")
    return [
        _over_time(
            runs,
            f"{label_of(name)} error",
            RunSignals.error,
            name,
            look,
            title=f"tracking error of {label_of(name)}",
        )
        for name in names
    ]


def inputs(runs: Runs, look: Look = draw.curve_look) -> list[draw.Panel]:
    """The commands as they were applied, held from sample to sample."""
    names = _in_order(name for run in runs for name in run.inputs())
    if not names:
        raise Absent("no log has a command")
    panels = []
    for name in names:
        marks, samples, unit = curves_of(
            runs, lambda run, name: run.signal("/command", name), name, look, is_step=True
        )
        limits, lines = with_limits(runs, [name], axis_range(samples), of_commands=True)
        label = f"{label_of(name)}\ncommand" if label_of(name) != name else name
        axis = draw.Axis(label, unit or "V", limits)
        panels.append(
            draw.Panel(time_axis(*runs), axis, [*marks, *lines], symbol_label(name), row_height=0.8)
        )
    return panels


def rates(runs: Runs) -> list[draw.Panel]:
    """How fast the axes turn, and the rotors."""
    panels = [
        _over_time(runs, f"{label_of(name)} rate\n", _rate, name, height=0.8)
        for name in _in_order(name for run in runs for name in _angles(run))
    ]
    panels += [
        _over_time(runs, f"{label_of(name)}\n", RunSignals.truth, name, height=0.8)
        for name in _SPEEDS
        if any(run.truth(name) is not None for run in runs)
    ]
    if not panels:
        raise Absent("no log has an angle or a rotor's speed")
    return panels


def _rate(run: RunSignals, name: str) -> TimeSeries | None:
    smooth = run.smooth(name)
    return smooth.rate if smooth is not None else None


def estimate(runs: Runs) -> list[draw.Panel]:
    """Estimated minus true, with two standard deviations; without a true state, innovations."""
    names = {
        run.name: [
            n
            for n in run.names("/estimate")
            if not n.endswith(("_moment", "_motor")) and run.estimated(n) is not None
        ]
        for run in runs
    }
    if not any(names.values()):
        if any(run.names("/estimate") for run in runs):
            raise Absent("the observer is handed the true state (full_state): it estimates nothing")
        raise Absent(f"no log has an estimate: no observer ran, or {_NOT_LOGGED}")
    comparable_names = _in_order(
        name
        for run in runs
        for name in names[run.name]
        if run.signal("/plant/state", name) is not None
        or f"innovation_{name}" in run.names("/estimate")
    )
    return [_off_panel(runs, name) for name in comparable_names]


def _off_panel(runs: Runs, name: str) -> draw.Panel:
    marks: list[draw.Mark] = [draw.Line(y=0.0, colour="sky", style="solid")]
    what, unit = "", ""
    for i, run in enumerate(runs):
        result = _off(run, name)
        if result is None:
            continue
        what, off, deviation = result
        unit, factor = wording.small_unit(off.unit)
        settled = len(deviation) // 20  # an observer that finds its feet hides the rest
        band = 2 * factor * deviation[settled:]
        alone = len(runs) == 1
        look: dict[str, Any] = {"colour": "green"} if alone else draw.curve_look(i)
        if len(band):
            label = "±2 standard deviations" if alone else ""
            colour = "measured" if alone else look["colour"]
            marks.append(
                draw.Band(off.time[settled:], -band, band, label, colour, 0.44 if alone else 0.15)  # type: ignore[arg-type]
            )
        label = what if alone else run.name
        marks.append(draw.Curve(off.time, factor * off.values, label, **look))
    kind = "innovation" if what == "innovation" else "error"
    return draw.Panel(
        time_axis(*runs), draw.Axis(f"{_symbol(name)}\n{kind}", unit), marks, row_height=0.8
    )


def _off(run: RunSignals, name: str) -> tuple[str, TimeSeries, FloatArray] | None:
    """What an estimate is off by, in words, as a curve and with its deviation; or innovations."""
    guess, true = run.signal("/estimate", name), run.signal("/plant/state", name)
    if guess is not None and true is not None:
        at = np.clip(np.searchsorted(true.time, guess.time), 0, len(true.time) - 1)
        if np.array_equal(true.time[at], guess.time):  # a sweep logs each tenth estimate
            off = TimeSeries(guess.time, guess.values - true.values[at], guess.unit)
            return "estimate − true", off, run.numbers("/estimate", f"sd_{name}")
    innovation = run.signal("/estimate", f"innovation_{name}")
    if innovation is None:
        return None
    return "innovation", innovation, run.numbers("/estimate", f"innovation_sd_{name}")


def torques(runs: Runs) -> list[draw.Panel]:
    """Torques that the observer needs besides its model, with two standard deviations."""
    groups = (names for run in runs for place, names in run.torques().items() if place != "pushes")
    names = _in_order(name for some in groups for name in some)
    if not names:
        raise Absent(
            f"no log has an estimated torque: its observer estimates none, or {_NOT_LOGGED}"
        )
    panels = []
    for name in names:
        marks: list[draw.Mark] = [draw.Line(y=0.0, colour="sky", style="solid")]
        unit = ""
        for i, run in enumerate(runs):
            guess = run.estimated(name)
            if guess is None:
                continue
            torque, factor = in_small_unit(guess[0])
            guess[1][: len(guess[1]) // 20] = np.nan  # an observer that finds its feet
            unit = torque.unit
            alone = len(runs) == 1
            look = {"colour": draw.signal_colour(name)} if alone else draw.curve_look(i)
            label = f"{name.replace('_', ' ')}, estimate" if alone else run.name
            marks += with_band(torque, factor * guess[1], label, look.pop("colour"), 1.4, **look)
        axis = draw.Axis(f"{name.replace('_', ' ')}\n", unit)
        panels.append(draw.Panel(time_axis(*runs), axis, marks, row_height=0.8))
    return panels


def solver(runs: Runs, look: Look = draw.curve_look) -> list[draw.Panel]:
    """Time of each control step against its deadline, and the solver's iterations."""
    timed = [
        (i, run, times) for i, run in enumerate(runs) if (times := run.step_times()) is not None
    ]
    if not timed:
        raise Absent("no log has a controller's times: no controller ran (a recording has none)")
    marks: list[draw.Mark] = []
    deadlines: dict[float, list[int]] = {}  # ms, and whose
    shapes: Sequence[draw.Marker] = ("dot", "square", "triangle", "diamond", "down")
    for i, run, times in timed:
        colour, marker = look(i)["colour"], shapes[i % len(shapes)]
        label = run.name if len(runs) > 1 else "time of a step"
        marks.append(draw.Points(run.time("/controller"), times, label, marker, colour, size=1.6))
        if run.deadline is not None:
            deadlines.setdefault(run.deadline, []).append(i)
    for deadline, whose in deadlines.items():
        if len(deadlines) == 1:
            marks.append(draw.Line(y=deadline, label="deadline", colour="alarm"))
        else:
            named = ", ".join(runs[i].name for i in whose)
            marks.append(
                draw.Line(
                    y=deadline,
                    label=f"deadline of {named}, {deadline:g} ms",
                    colour=look(whose[0])["colour"],
                )
            )
    panel = draw.Panel(time_axis(*runs), step_axis(), marks, "time of a control step")
    return [panel, *iteration_panels(runs, look)]


def time_boxes(runs: Runs) -> draw.Panel | None:
    """Times of a control step of several runs beside one another."""
    timed = [(run, times) for run in runs if (times := run.step_times()) is not None]
    if not timed:
        return None
    shares = (0.01, 0.25, 0.5, 0.75, 0.99)
    quantiles = [np.quantile(times[np.isfinite(times)], shares).tolist() for _, times in timed]
    deadlines = [(i, run.deadline) for i, (run, _) in enumerate(timed) if run.deadline is not None]
    colours = [draw.page_look(i)["colour"] for i in range(len(timed))]
    marks: list[draw.Mark] = [draw.Boxes(range(len(timed)), quantiles, colours=colours)]
    marks.append(
        draw.Points([d for _, d in deadlines], [i for i, _ in deadlines], "", "diamond", "alarm")
    )
    caption = "Box: quartiles and median; whiskers: 1st and 99th percentile; diamond: deadline."
    names = draw.Axis("", categories=[run.name for run, _ in timed])
    return draw.Panel(
        step_axis(),
        names,
        marks,
        "times of a control step",
        caption=caption,
        row_height=(60 + 44 * len(timed)) / 240,
    )


def phase(runs: Runs, look: Look = draw.curve_look) -> list[draw.Panel]:
    """Each axis's rate over its angle."""
    names = _in_order(name for run in runs for name in _angles(run))
    if not names:
        raise Absent(_no_angle(runs))
    return phase_panels(runs, names, look)


def phase_panels(
    runs: Runs, names: Sequence[str], look: Look = draw.curve_look
) -> list[draw.Panel]:
    """Each channel's rate over it; the rate is the central difference of the smoothest there is."""
    panels = []
    for name in names:
        marks: list[draw.Mark] = []
        unit = ""
        for i, run in enumerate(runs):
            signal = _rising(run.smooth(name))
            if signal is not None:
                unit = signal.unit
                alone = len(runs) == 1
                label = f"{label_of(name)}, {signal.source}" if alone else run.name
                own = {"colour": draw.signal_colour(name), "style": "solid"} if alone else look(i)
                marks += _trajectory(signal.values, signal.rate.values, label, own, alone=alone)
        words = label_of(name)
        if marks:
            across, up = draw.Axis(words, unit), draw.Axis(f"{words} rate", f"{unit}/s")
            panels.append(
                draw.Panel(
                    across,
                    up,
                    marks,
                    f"{words} against its rate",
                    half=len(names) > 1,
                    row_height=1.9,
                )
            )
    return panels


def path_panel(runs: Runs, yaw: str, pitch: str, look: Look = draw.curve_look) -> draw.Panel | None:
    """Two channels against each other, with the places where they were to be."""
    marks: list[draw.Mark] = []
    for i, run in enumerate(runs):
        one, other = run.smooth(yaw), run.smooth(pitch)
        if one is not None and other is not None and len(one.values) == len(other.values):
            label = run.name if len(runs) > 1 else one.source
            marks += _trajectory(one.values, other.values, label, look(i), alone=len(runs) == 1)
    if not marks:
        return None
    path = np.column_stack(
        [runs[0].numbers("/reference", yaw), runs[0].numbers("/reference", pitch)]
    )
    places = np.unique(path[np.isfinite(path).all(axis=1)], axis=0)
    if 0 < len(places) <= 40:  # places to be at, not a course that moves all the time
        marks.append(draw.Points(places[:, 0], places[:, 1], "reference", "cross", "ink"))
    title = f"{label_of(pitch)} against {label_of(yaw)}"
    across, up = draw.Axis(label_of(yaw), "rad"), draw.Axis(label_of(pitch), "rad")
    return draw.Panel(across, up, marks, title, half=True, row_height=1.9)


def _rising(signal: TimeSeries | None) -> TimeSeries | None:
    """A signal without gaps and repeated times, which can be differentiated."""
    if signal is None:
        return None
    is_finite = np.isfinite(signal.values)
    time, values = signal.time[is_finite], signal.values[is_finite]
    rising = np.concatenate([[True], np.diff(time) > 0])
    if np.count_nonzero(rising) < 2:
        return None
    return TimeSeries(time[rising], values[rising], signal.unit, signal.source)


def _trajectory(
    x: draw.Values, y: draw.Values, label: str, look: Mapping[str, Any], *, alone: bool
) -> list[draw.Mark]:
    marks: list[draw.Mark] = [draw.Curve(x, y, label, width=1.2, **look)]
    marks.append(draw.Points(x[:1], y[:1], "begin" if alone else "", "unstable", look["colour"]))
    return (
        [*marks, draw.Points(x[-1:], y[-1:], "end", "stable", look["colour"])] if alone else marks
    )


def prediction(runs: Runs) -> list[draw.Panel]:
    """What the controller foretold, again and again, over what came."""
    panels = []
    for run in runs:
        for panel in fan_panels(run, most=60):
            if panel.y.label in map(label_of, _ANGLES):
                panels.append(replace(panel, note=run.name if len(runs) > 1 else ""))
    if not panels:
        raise Absent(
            "no log has a prediction: only controllers that plan ahead tell any (newton_mpc, nmpc, "
            "linear_mpc, robust_mpc), and none with sim.prediction_every=0"
        )
    return panels


def comparison(runs: Sequence[RunReport]) -> list[draw.Panel]:
    """Scores beside each other, one bar a log."""
    if len(runs) < 2:
        raise Absent("one log compares with nothing: give two or more")
    if not any(run.score for run in runs):
        raise Absent("no log has a score: the runs did not end, or are recordings")
    names = {
        key: dict.fromkeys(name for run in runs for name in part(run.score, key))
        for key in ("channels", "inputs")
    }

    def unit_of(key: str, name: str, usual: str) -> str:
        own = (part(part(run.score, key), name).get("unit") for run in runs)
        return next((str(unit) for unit in own if unit), usual)

    figures = [
        *(
            (f"RMSE of {label_of(n)}", unit_of("channels", n, "rad"), ("channels", n, "rmse"))
            for n in names["channels"]
        ),
        *(
            (f"effort, {label_of(n)}", f"{unit_of('inputs', n, 'V')}² s", ("inputs", n, "effort"))
            for n in names["inputs"]
        ),
        ("step time, median", "ms", ("solver", "time_ms", "median")),
    ]
    panels: list[draw.Panel] = []
    for words, unit, (first, second, last) in figures:
        scores = [finite(part(part(run.score, first), second).get(last)) for run in runs]
        values = [math.nan if value is None else value for value in scores]
        finite_values = [value for value in values if math.isfinite(value)]
        if not finite_values:
            continue
        named = len(panels) % 2 == 0
        marks = [
            draw.Bars(
                [run.name if named else "" for run in runs],
                np.nan_to_num(values),
                [draw.curve_look(i)["colour"] for i in range(len(runs))],
                notes=[f" {wording.number(value)}" for value in values],
            )
        ]
        limits = (0.0, 1.05 * max(finite_values) if max(finite_values) > 0 else 1.0)
        height = 0.35 + 0.17 * len(runs)
        panels.append(
            draw.Panel(
                draw.Axis(words, unit, limits), draw.Axis(""), marks, row_height=height, half=True
            )
        )
    if not panels:
        raise Absent("the scores of these logs have no figure in common")
    return panels


def _over_time(
    runs: Runs,
    label: str,
    pick: Pick,
    name: str,
    look: Look = draw.curve_look,
    *,
    title: str = "",
    height: float = 0.0,
) -> draw.Panel:
    """A panel into which each run draws one curve; a log alone is named by what its curve is."""
    marks, samples, unit = curves_of(runs, pick, name, look)
    zero = [draw.Line(y=0.0, colour="sky", style="solid")] if "error" in label else []
    axis = draw.Axis(label, unit, axis_range(samples))
    return draw.Panel(time_axis(*runs), axis, [*zero, *marks], title, row_height=height)


def _references(runs: Runs, name: str, look: Look) -> list[draw.Curve]:
    """One dashed line for a reference that all share, else one each in the run's colour."""
    references = [
        (i, reference)
        for i, run in enumerate(runs)
        if (reference := run.signal("/reference", name)) is not None
    ]
    if not references:
        return []
    longest = max(
        (reference for _, reference in references), key=lambda signal: float(signal.time[-1])
    )
    if all(_same(reference, longest) for _, reference in references):
        return [reference_curve(longest)]
    return [
        reference_curve(reference, label=f"reference of {runs[i].name}", colour=look(i)["colour"])
        for i, reference in references
    ]


def _same(one: TimeSeries, longest: TimeSeries) -> bool:
    """Whether a reference is the beginning of another one, also where it was sampled otherwise."""
    at = np.searchsorted(longest.time, one.time + 1e-9, side="right") - 1
    # at a step itself one of them may be a sample behind
    off = np.abs(longest.values[np.clip(at, 0, None)] - one.values) > 1e-9
    return bool(np.mean(off) < 0.02) if len(off) else True


def _angles(run: RunSignals) -> list[str]:
    """Angles of a twin rotor; of another rig the angles and positions that it measures."""
    measured = run.names("/measurement")
    others = [name for name in measured if run.unit("/measurement", name) in ("rad", "m")]
    return [name for name in _ANGLES if run.truth(name) is not None] or others


def _in_order(names: Iterable[str]) -> list[str]:
    """Without repetitions; pitch before yaw, angles before speeds."""
    usual = (*_ANGLES, "u_v", "u_h", "S_v", "S_h", *_SPEEDS)
    unique_names = list(dict.fromkeys(names))
    return sorted(unique_names, key=lambda name: usual.index(name) if name in usual else len(usual))


def _symbol(name: str) -> str:
    """A state in words, or by its symbol: ``S_v``."""
    letter, _, of = name.partition("_")
    words = wording.SIGNALS.get(name)
    return words or (f"${letter}_{of}$" if len(letter) == len(of) == 1 else name)
