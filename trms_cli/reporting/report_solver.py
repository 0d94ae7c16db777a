"""Plots of the solver: the time of each step against its deadline, iterations, fall-backs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from trms_cli.reporting.interactive import (
    ALARM,
    CURVES,
    GREY,
    Plot,
    curve_style,
    level,
    line,
    plot_text,
    points,
    significant,
    time_plot,
)
from trms_cli.reporting.report_signals import mode_spans
from trms_cli.reporting.reported import FloatArray, ReportedRun, numbers

_BINS = 60
#: A law of one line takes less than the clock can tell, ms.
_LEAST_MS = 1e-3
_MOST_POINTS = 4_000


def step_times(run: ReportedRun) -> FloatArray | None:
    """Time of each control step, ms; None for a run without a solver's words."""
    column = run.topic("/controller").get("solve_time_s")
    if column is None:
        return None
    milliseconds = 1e3 * numbers(column)
    if not np.isfinite(milliseconds).any():
        return None
    return np.maximum(milliseconds, _LEAST_MS)  # NaN stays


def deadline_of(run: ReportedRun) -> float | None:
    """The time between two control steps, ms."""
    time = run.time("/controller")
    return 1e3 * float(np.median(np.diff(time))) if len(time) > 1 else None


def solver_plots(run: ReportedRun) -> list[Plot]:
    """Times over the run and their distribution, and iterations where a solver has some."""
    times = step_times(run)
    if times is None:
        return []
    return [_over_time(run, times), *_iterations(run), _distribution(run, times)]


def missed(run: ReportedRun) -> np.ndarray:
    """Which control steps took longer than their deadline, (n,) of bool."""
    return numbers(run.topic("/controller").get("deadline_missed", ())) > 0


def fell_back(run: ReportedRun) -> np.ndarray:
    """On which control steps a fall-back acted, or the solver failed, (n,) of bool."""
    columns = run.topic("/controller")
    count = len(run.time("/controller"))
    acted = numbers(columns["fallback"]) > 0 if "fallback" in columns else np.zeros(count, bool)
    if "status" in columns:
        acted = acted | (np.asarray(columns["status"], dtype=object) == "failed")
    return np.asarray(acted, dtype=bool)


def solver_overlay(runs: Sequence[ReportedRun]) -> list[Plot]:
    """Times of several runs: side by side as boxes, and over each other in time."""
    boxes = Plot("time of a control step", height=60 + 44 * len(runs))
    over = time_plot("time of a control step", "step time [ms]", height=280)
    over.layout["yaxis"] |= _LOGARITHMIC
    told = False
    for number, run in enumerate(runs):
        times = step_times(run)
        if times is None:
            continue
        told = True
        colour, _ = curve_style(number)
        boxes.traces.append(_box(times, run.name, colour, deadline_of(run)))
        at, kept = _dots(run.time("/controller"), times)
        over.traces.append(points(at, kept, run.name, colour, size=3, hovertemplate="%{y:.3g} ms"))
        deadline = deadline_of(run)
        if deadline is not None:
            over.shapes([level(deadline)])
    boxes.layout = {
        "xaxis": {"title": {"text": "step time [ms]"}, **_LOGARITHMIC},
        "yaxis": {"autorange": "reversed"},
        "showlegend": False,
        "margin": {"l": 90},
    }
    boxes.caption = (
        "Box: quartiles and median; whiskers: 1st and 99th percentile; diamond: deadline."
    )
    over.caption = "Dotted: deadlines."
    _unlogged(over)
    boxes.traces = _with_deadlines(boxes.traces, runs)
    return [boxes, over] if told else []


#: Figures as they are (0.1, 1, 10) instead of powers.
_LOGARITHMIC = {"type": "log", "dtick": 1, "exponentformat": "none"}


def _over_time(run: ReportedRun, times: FloatArray) -> Plot:
    plot = time_plot("time of a control step", "step time [ms]", height=240)
    plot.layout["yaxis"] |= _LOGARITHMIC
    at, kept = _dots(run.time("/controller"), times)
    plot.traces.append(points(at, kept, "step", GREY, size=3, hovertemplate="%{y:.3g} ms"))
    for rows, name, colour, symbol in (
        (missed(run), "deadline missed", ALARM, "x"),
        (fell_back(run), "fall-back", CURVES[1], "triangle-down"),
    ):
        if rows.any():
            time, taken = run.time("/controller")[rows], times[rows]
            taken = np.where(np.isfinite(taken), taken, _LEAST_MS)
            plot.traces.append(points(time, taken, name, colour, size=8, symbol=symbol))
    deadline = deadline_of(run)
    if deadline is not None:
        plot.shapes([level(deadline)])
    plot.shapes(mode_spans(run))
    plot.caption = _words(run, times)
    _unlogged(plot)
    return plot


def _words(run: ReportedRun, times: FloatArray) -> str:
    known = times[np.isfinite(times)]
    deadline = deadline_of(run)
    words = f"Median {np.median(known):.3g} ms, 99th percentile {np.quantile(known, 0.99):.3g} ms, "
    words += f"longest {known.max():.3g} ms"
    if deadline is not None:
        words += (
            f"; the deadline is {deadline:.4g} ms (dotted), missed {int(missed(run).sum())} times"
        )
    falls = int(fell_back(run).sum())
    return words + (f"; a fall-back acted on {falls} steps." if falls else ".")


def _dots(time: FloatArray, times: FloatArray) -> tuple[FloatArray, FloatArray]:
    """At most a few thousand dots: of pieces of equal length the least and the largest."""
    from trms_cli.reporting.interactive import thinned

    return thinned(time[: len(times)], times, _MOST_POINTS)


def _iterations(run: ReportedRun) -> list[Plot]:
    iterations = numbers(run.topic("/controller").get("iterations", ()))
    if not np.any(iterations > 0):
        return []
    plot = time_plot("iterations of the solver", "iterations", half=True, height=220)
    plot.traces.append(
        line(run.time("/controller"), iterations, "iterations", CURVES[0], steps=True, width=1)
    )
    plot.layout["yaxis"]["rangemode"] = "tozero"
    return [plot]


def _distribution(run: ReportedRun, times: FloatArray) -> Plot:
    """Counts in bins that are equal on a logarithmic scale."""
    known = times[np.isfinite(times)]
    low, high = float(known.min()), float(known.max())
    edges = np.geomspace(low, max(high, 1.0001 * low), _BINS + 1)
    counts, _ = np.histogram(known, edges)
    plot = Plot("distribution of the times", height=220, half=True)
    plot.traces.append(
        {
            "type": "bar",
            "x": [significant(v) for v in np.sqrt(edges[1:] * edges[:-1])],
            "y": counts.tolist(),
            "width": [significant(v) for v in np.diff(edges)],
            "marker": {"color": CURVES[0]},
            "hovertemplate": "%{x:.3g} ms: %{y}<extra></extra>",
            "name": "steps",
        }
    )
    plot.layout = {
        "xaxis": {"title": {"text": "step time [ms]"}, **_LOGARITHMIC},
        "yaxis": {"title": {"text": "steps"}},
        "bargap": 0,
        "showlegend": False,
    }
    deadline = deadline_of(run)
    if deadline is not None:
        # A line across both ends of the plot; on a logarithmic axis its place is the value.
        plot.shapes(
            [
                {
                    "type": "line", "xref": "x", "x0": deadline, "x1": deadline, "yref": "paper",
                    "y0": 0, "y1": 1, "line": {"color": ALARM, "width": 1, "dash": "dot"},
                }
            ]
        )  # fmt: skip
    return plot


def _box(times: FloatArray, name: str, colour: str, deadline: float | None) -> dict[str, object]:
    known = times[np.isfinite(times)]
    low, first, middle, third, high = np.quantile(known, (0.01, 0.25, 0.5, 0.75, 0.99))
    return {
        "type": "box", "orientation": "h", "y": [plot_text(name)], "name": plot_text(name),
        "q1": [significant(first)], "median": [significant(middle)], "q3": [significant(third)],
        "lowerfence": [significant(low)], "upperfence": [significant(high)],
        "line": {"color": colour}, "hoverinfo": "x",
    }  # fmt: skip


def _with_deadlines(
    traces: list[dict[str, object]], runs: Sequence[ReportedRun]
) -> list[dict[str, object]]:
    known = [(run.name, deadline_of(run)) for run in runs if step_times(run) is not None]
    found = [(name, deadline) for name, deadline in known if deadline is not None]
    if not found:
        return traces
    mark: dict[str, object] = {
        "type": "scatter", "mode": "markers", "name": "deadline",
        "x": [significant(deadline) for _, deadline in found],
        "y": [plot_text(name) for name, _ in found],
        "marker": {"color": ALARM, "size": 9, "symbol": "diamond"},
        "hovertemplate": "deadline %{x:.4g} ms<extra></extra>",
    }  # fmt: skip
    return [*traces, mark]


def _unlogged(plot: Plot) -> None:
    """Markers alone have no legend worth its room."""
    plot.layout |= {"showlegend": len(plot.traces) > 1, "legend": {"itemsizing": "constant"}}
