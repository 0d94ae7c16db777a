"""Phase plots of runs, and the predictions that a controller made beside what then happened."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from trms_cli.reporting.interactive import (
    CURVES,
    INK,
    Fans,
    Plot,
    curve_style,
    framed,
    packed,
    packed_time,
    plot_text,
    points,
    time_plot,
)
from trms_cli.reporting.interactive import line as time_line
from trms_cli.reporting.report_signals import axis_title, label_of
from trms_cli.reporting.reported import FloatArray, ReportedRun, numbers

_MOST_POINTS = 3_000
#: Predictions that a page holds at most, and samples of all of them.
_MOST_FANS, _MOST_SAMPLES = 400, 20_000


def phase_plots(runs: Sequence[ReportedRun]) -> list[Plot]:
    """Each angle against its rate, and the two angles against each other.

    The rate is the central difference of the angle: of the true one, else of the estimated one,
    which is smooth, else of the measured one.
    """
    if not runs:
        return []
    channels = runs[0].channels()
    plots = []
    for channel in channels[:4]:
        plot = Plot(f"{label_of(channel)} against its rate", half=True, height=340)
        for number, run in enumerate(runs):
            found = _smooth(run, channel)
            if found is not None:
                time, values = found
                _trajectory(plot, run, number, values, np.gradient(values, time), len(runs))
        unit = runs[0].unit("/measurement", channel) or "rad"
        _axes(plot, axis_title(label_of(channel), unit), axis_title("rate", f"{unit}/s"))
        plots.append(plot)
    if len(channels) >= 2:
        yaw, pitch = channels[1], channels[0]
        plot = Plot(f"{label_of(pitch)} against {label_of(yaw)}", half=True, height=340)
        for number, run in enumerate(runs):
            one, other = _smooth(run, yaw), _smooth(run, pitch)
            if one is not None and other is not None and len(one[1]) == len(other[1]):
                _trajectory(plot, run, number, one[1], other[1], len(runs))
        if plot.traces:
            _setpoints(plot, runs[0], yaw, pitch)
        _axes(plot, axis_title(label_of(yaw), "rad"), axis_title(label_of(pitch), "rad"))
        plots.append(plot)
    return [plot for plot in plots if plot.traces]


def fan_plots(run: ReportedRun) -> list[Plot]:
    """All predictions, thin, and one bold that a slider chooses, over what happened."""
    columns, made = run.topic("/prediction"), run.time("/prediction")
    if "time" not in columns or not len(made):
        return []
    step = max(1, int(np.ceil(len(made) / _MOST_FANS)))
    length = max((np.size(columns["time"][i]) for i in range(0, len(made), step)), default=0)
    step = max(step, int(np.ceil(len(made) * max(length, 1) / _MOST_SAMPLES)))
    chosen = range(0, len(made), step)
    names = [n for n in (*run.channels(), *run.inputs()) if n in columns]
    return [plot for name in names for plot in [_fan(run, name, chosen)] if plot is not None]


def _fan(run: ReportedRun, name: str, chosen: range) -> Plot | None:
    columns, made = run.topic("/prediction"), run.time("/prediction")
    xs: list[FloatArray] = []
    ys: list[FloatArray] = []
    starts, times = [0], []
    for i in chosen:
        ahead, values = (np.ravel(columns[key][i]).astype(float) for key in ("time", name))
        count = min(len(ahead), len(values))  # the inputs have one step less than the states
        if not count:
            continue
        xs += [made[i] + ahead[:count], np.array([np.nan])]
        ys += [values[:count], np.array([np.nan])]
        starts.append(starts[-1] + count + 1)
        times.append(float(made[i]))
    if not times:
        return None
    is_input = name in run.inputs()
    topic = "/command" if is_input else "/measurement"
    unit = run.unit(topic, name)
    title = axis_title(f"{label_of(name)} {name}" if is_input else label_of(name), unit)
    plot = time_plot(f"predictions of {title.partition(' [')[0]}", title, height=260)
    happened, seen = _happened(run, name, is_input=is_input), []
    if happened is not None:
        time, values = happened
        plot.traces.append(
            time_line(
                time, values, "what happened", CURVES[0], width=3.5, opacity=0.5, steps=is_input
            )
        )
        seen.append(values)
    if name in run.topic("/reference"):
        values = numbers(run.topic("/reference")[name])
        plot.traces.append(
            time_line(
                run.time("/reference"), values, "reference", INK, dash="dash", steps=True, width=1.1
            )
        )
        seen.append(values)
    every = len(plot.traces)
    plot.traces += [
        _pieces(np.concatenate(xs), np.concatenate(ys), "predictions", INK, 0.6, steps=is_input),
        _pieces(np.zeros(0), np.zeros(0), "chosen prediction", CURVES[1], 3.0, steps=is_input),
    ]
    plot.fans = Fans(times=times, starts=starts, pairs=[(every, every + 1)])
    found = framed(seen) or framed(ys)
    if found is not None:
        plot.layout["yaxis"]["range"] = found
    return plot


def _pieces(
    x: FloatArray, y: FloatArray, name: str, colour: str, width: float, *, steps: bool
) -> dict[str, object]:
    return {
        "type": "scatter", "mode": "lines", "x": packed_time(x), "y": packed(y), "name": name,
        "line": {"color": colour, "width": width, "shape": "hv" if steps else "linear"},
        "hoverinfo": "skip",
    }  # fmt: skip


def _happened(
    run: ReportedRun, name: str, *, is_input: bool
) -> tuple[FloatArray, FloatArray] | None:
    if is_input:
        return run.time("/command"), numbers(run.topic("/command")[name])
    found = run.actual(name)
    return None if found is None else found[:2]


def _smooth(run: ReportedRun, channel: str) -> tuple[FloatArray, FloatArray] | None:
    """A channel fit to be differentiated, at few enough times; gaps are left out."""
    for topic in ("/plant/state", "/estimate", "/measurement"):
        if channel in run.topic(topic):
            time, values = run.time(topic), numbers(run.topic(topic)[channel])
            known = np.isfinite(values)
            time, values = time[known], values[known]
            rising = np.concatenate([[True], np.diff(time) > 0]) if len(time) else known[:0]
            time, values = time[rising], values[rising]
            step = max(1, int(np.ceil(len(time) / _MOST_POINTS)))
            if len(time) // step >= 2:
                return time[::step], values[::step]
    return None


def _trajectory(
    plot: Plot, run: ReportedRun, number: int, x: FloatArray, y: FloatArray, runs: int
) -> None:
    colour, dash = curve_style(number)
    name = plot_text(run.name) if runs > 1 else "run"
    plot.traces.append(
        {
            "type": "scatter", "mode": "lines", "x": packed(x), "y": packed(y), "name": name,
            "line": {"color": colour, "width": 1.2, "dash": dash},
            "hovertemplate": "%{x:.4g}, %{y:.4g}",
        }
    )  # fmt: skip
    if runs == 1:
        for at, word, symbol in ((0, "begin", "circle-open"), (-1, "end", "circle")):
            plot.traces.append(points([x[at]], [y[at]], word, CURVES[1], size=9, symbol=symbol))


def _setpoints(plot: Plot, run: ReportedRun, yaw: str, pitch: str) -> None:
    reference = run.topic("/reference")
    if yaw not in reference or pitch not in reference:
        return
    path = np.column_stack([numbers(reference[yaw]), numbers(reference[pitch])])
    places = np.unique(path[np.isfinite(path).all(axis=1)], axis=0)
    if 0 < len(places) <= 40:  # places to be at, not a course that moves all the time
        plot.traces.append(points(places[:, 0], places[:, 1], "reference", INK, size=9, symbol="x"))


def _axes(plot: Plot, x: str, y: str) -> None:
    plot.layout = {
        "xaxis": {"title": {"text": plot_text(x)}},
        "yaxis": {"title": {"text": plot_text(y)}},
    }
