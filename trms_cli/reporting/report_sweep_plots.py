"""Plots of many runs: how figures spread, what they depend on, and what cannot be had together."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from trms_cli.reporting.interactive import (
    GREY,
    Plot,
    Variant,
    curve_style,
    line,
    packed,
    plot_text,
    significant,
)
from trms_cli.reporting.reported_sweep import Objective, ReportedSweep, SweepRun

#: More entrants than this are not told apart by colour; their boxes still stand side by side.
_MOST_COLOURS, _MOST_BOXES = 8, 60
_MOST_KEYS, _MOST_CATEGORIES, _MOST_CELLS = 8, 40, 60
#: Runs of a box that are drawn as dots too.
_MOST_DOTS = 300
#: Entrants that are told apart by rings around one another.
_MOST_RINGS = 4
_OTHER = "all runs"


def spread_plots(sweep: ReportedSweep, figures: Sequence[str]) -> list[Plot]:
    """Boxes of a figure for each entrant, and a histogram; the reader chooses the figure."""
    if not figures:
        return []
    entrants = _groups(sweep, _MOST_BOXES)
    boxes = Plot("by who ran", height=90 + 34 * len(entrants))
    few = max((len(runs) for _, runs in entrants), default=0) <= _MOST_DOTS
    for number, (name, runs) in enumerate(entrants):
        colour, _ = curve_style(number if len(entrants) <= _MOST_COLOURS else 0)
        boxes.traces.append(
            {
                "type": "box", "orientation": "h", "name": plot_text(name),
                "x": _column(runs, figures[0]), "y": [plot_text(name)] * len(runs),
                "text": [plot_text(run.name) for run in runs],
                "boxpoints": "all" if few else "outliers", "pointpos": 0, "jitter": 0.4,
                "marker": {"color": colour, "size": 4, "opacity": 0.55},
                "line": {"color": colour, "width": 1.4}, "hoveron": "points" if few else "boxes",
                "hovertemplate": "%{text}: %{x:.4g}<extra></extra>" if few else None,
            }
        )  # fmt: skip
    boxes.layout = {
        "xaxis": {"title": {"text": plot_text(sweep.title(figures[0]))}},
        "yaxis": {"autorange": "reversed", "type": "category"},
        "showlegend": False,
        "margin": {"l": 90},
    }
    boxes.variants = _variants(
        sweep, figures, lambda name: [{"x": _column(runs, name)} for _, runs in entrants], "xaxis"
    )
    boxes.caption = (
        "Box: quartiles and median. A dot is a run." if few else "Box: quartiles and median."
    )
    return [boxes, _histogram(sweep, figures)]


def key_plots(sweep: ReportedSweep, figures: Sequence[str]) -> list[Plot]:
    """A figure against each key that was varied: dots over numbers, boxes over options."""
    if not figures:
        return []
    numeric, chosen = sweep.numeric_keys, _numeric(sweep)
    others = [
        key
        for key in sweep.keys
        if key not in numeric
        and not sweep.names_entrants(key)  # their spread is drawn already
        and 1 < _distinct(sweep, key) <= _MOST_CATEGORIES
    ]
    plots = [_scatter(sweep, key, figures) for key in chosen[:_MOST_KEYS]]
    plots += [_categories(sweep, key, figures) for key in others[:_MOST_KEYS]]
    if len(chosen) >= 2:
        plots.append(_map(sweep, chosen[0], chosen[1], figures))
    return plots


def chosen_words(sweep: ReportedSweep) -> str:
    """Which of many varied keys are drawn, as a sentence; "" where all are."""
    count = len(_numeric(sweep))
    if count <= _MOST_KEYS:
        return ""
    by = "the first in the order in which they were typed"
    if sweep.draws and sweep.draws.correlations:
        by = "those with the largest rank correlation with a figure, whatever its sign"
    return (
        f" Of {count} values that were varied {_MOST_KEYS} are here: {by}. The others stand in the "
        "table of all runs."
    )


def _numeric(sweep: ReportedSweep) -> list[str]:
    """Numbers that were varied; seeds, which have no order, only where there is nothing else."""
    varied = [key for key in sweep.numeric_keys if _distinct(sweep, key) > 1]
    return [key for key in varied if not key.endswith("seed")] or varied


def pareto_plots(sweep: ReportedSweep) -> list[Plot]:
    """Each pair of objectives: all runs, and those that nothing beats."""
    pairs = list(itertools.combinations(sweep.objectives, 2))[:6]
    front = sweep.front()
    plots = [_pareto(sweep, front, one, other, len(pairs) > 1) for one, other in pairs]
    return plots + _history(sweep)


def _history(sweep: ReportedSweep) -> list[Plot]:
    """The best so far over the trials: whether more of them would have helped."""
    if sum(value is not None for value in sweep.history) < 2:
        return []
    several = len(sweep.objectives) > 1
    words = "volume dominated by the front" if several else sweep.title(sweep.objectives[0].figure)
    plot = Plot("the best so far", height=240)
    numbers = range(1, len(sweep.history) + 1)
    values = [math.nan if value is None else float(value) for value in sweep.history]
    plot.traces.append(line(numbers, values, "best so far", "@blue", steps=True))
    plot.layout = {
        "xaxis": {"title": {"text": "trials"}},
        "yaxis": {"title": {"text": plot_text(words)}},
    }
    return [plot]


def _pareto(
    sweep: ReportedSweep, front: Sequence[SweepRun], one: Objective, other: Objective, half: bool
) -> Plot:
    plot = Plot(f"{other.figure} against {one.figure}", height=400, half=half)
    known = [
        r for r in sweep.tried if not r.failed and {one.figure, other.figure} <= set(r.figures)
    ]
    best = sorted(
        (r for r in front if {one.figure, other.figure} <= set(r.figures)),
        key=lambda run: run.figures[one.figure],
    )
    # With three objectives the front is a surface, and a line over it would say nothing.
    joined = "lines+markers" if len(sweep.objectives) == 2 else "markers"
    for runs, name, colour, size, mode in (
        (known, "trials" if sweep.trials else "runs", GREY, 6, "markers"),
        (best, "Pareto front", "@vermilion", 9, joined),
    ):  # fmt: skip
        plot.traces.append(
            {
                "type": "scatter", "mode": mode, "name": name, "x": _column(runs, one.figure),
                "y": _column(runs, other.figure), "text": [plot_text(run.name) for run in runs],
                "marker": {"color": colour, "size": size},
                # Between two runs of the front nothing is known to be had: steps, not a slope.
                "line": {"color": colour, "width": 1.2, "shape": "vh" if one.largest else "hv"},
                "hovertemplate": "%{text}: %{x:.4g}, %{y:.4g}<extra></extra>",
            }
        )  # fmt: skip
    titles = [
        plot_text(f"{sweep.title(o.figure)}, {'largest' if o.largest else 'least'} sought")
        for o in (one, other)
    ]
    plot.layout = {
        "xaxis": {"title": {"text": titles[0]}},
        "yaxis": {"title": {"text": titles[1]}},
    }
    plot.caption = (
        "Of the runs on the front none is as good as another in all objectives and better in one."
    )
    return plot


def _histogram(sweep: ReportedSweep, figures: Sequence[str]) -> Plot:
    groups = _groups(sweep, 4)
    plot = Plot("distribution", height=260)
    for number, (name, runs) in enumerate(groups):
        colour, _ = curve_style(number)
        plot.traces.append(
            {
                "type": "histogram", "x": _column(runs, figures[0]), "name": plot_text(name),
                "nbinsx": 40, "opacity": 0.6 if len(groups) > 1 else 0.9,
                "marker": {"color": colour},
                "bingroup": "one", "hovertemplate": "%{x}: %{y}<extra></extra>",
            }
        )  # fmt: skip
    plot.layout = {
        "barmode": "overlay",
        "xaxis": {"title": {"text": plot_text(sweep.title(figures[0]))}},
        "yaxis": {"title": {"text": "runs"}},
        "showlegend": len(groups) > 1,
    }
    plot.variants = _variants(
        sweep, figures, lambda name: [{"x": _column(runs, name)} for _, runs in groups], "xaxis"
    )
    return plot


def _scatter(sweep: ReportedSweep, key: str, figures: Sequence[str]) -> Plot:
    groups = _groups(sweep, _MOST_COLOURS)
    plot = Plot(f"against {key}", height=300, half=True)
    size = 7 if len(sweep.runs) <= 200 else 4
    for number, (name, runs) in enumerate(groups):
        colour, _ = curve_style(number)
        plot.traces.append(
            {
                "type": "scatter", "mode": "markers", "name": plot_text(name),
                "x": packed([_float(run.values.get(key)) for run in runs]),
                "y": _column(runs, figures[0]), "text": [plot_text(run.name) for run in runs],
                "marker": {"color": colour, "size": size, "opacity": 0.7},
                "hovertemplate": "%{text}: %{x:.4g}, %{y:.4g}<extra></extra>",
            }
        )  # fmt: skip
    plot.layout = {
        "xaxis": {"title": {"text": plot_text(key)}},
        "yaxis": {"title": {"text": plot_text(sweep.title(figures[0]))}},
        "showlegend": len(groups) > 1,
    }
    if _spans_decades([run.values.get(key) for run in sweep.runs]):
        plot.layout["xaxis"] |= {"type": "log"}
    plot.variants = _variants(
        sweep, figures, lambda name: [{"y": _column(runs, name)} for _, runs in groups], "yaxis"
    )
    return plot


def _categories(sweep: ReportedSweep, key: str, figures: Sequence[str]) -> Plot:
    groups = _groups(sweep, _MOST_COLOURS)
    plot = Plot(f"by {key}", height=300, half=True)
    for number, (name, runs) in enumerate(groups):
        colour, _ = curve_style(number)
        plot.traces.append(
            {
                "type": "box", "name": plot_text(name), "boxpoints": False,
                "x": [plot_text(_word(run.values.get(key))) for run in runs],
                "y": _column(runs, figures[0]), "marker": {"color": colour},
                "line": {"color": colour, "width": 1.4},
            }
        )  # fmt: skip
    plot.layout = {
        "boxmode": "group",
        "xaxis": {"title": {"text": plot_text(key)}, "type": "category"},
        "yaxis": {"title": {"text": plot_text(sweep.title(figures[0]))}},
        "showlegend": len(groups) > 1,
    }
    plot.variants = _variants(
        sweep, figures, lambda name: [{"y": _column(runs, name)} for _, runs in groups], "yaxis"
    )
    return plot


def _map(sweep: ReportedSweep, across: str, up: str, figures: Sequence[str]) -> Plot:
    """A heat map of means where two keys make a grid, else dots coloured by the figure."""
    runs = [
        run
        for run in sweep.runs
        if not run.failed and run.values.get(across) is not None and run.values.get(up) is not None
    ]
    xs, ys = (sorted({_float(run.values[key]) for run in runs}) for key in (across, up))
    plot = Plot(f"over {across} and {up}", height=400, half=True)
    titles = {
        "xaxis": {"title": {"text": plot_text(across)}},
        "yaxis": {"title": {"text": plot_text(up)}},
    }
    is_grid = max(len(xs), len(ys)) <= _MOST_CELLS and len(xs) * len(ys) <= 4 * len(runs)
    if is_grid:
        plot.traces = [
            {
                "type": "heatmap", "x": [f"{v:g}" for v in xs], "y": [f"{v:g}" for v in ys],
                "z": _cells(runs, across, up, xs, ys, figures[0]), "colorscale": "Viridis",
                "reversescale": True, "hovertemplate": "%{x}, %{y}: %{z:.4g}<extra></extra>",
                "colorbar": {"thickness": 12},
            }
        ]  # fmt: skip
        for axis in titles.values():
            axis["type"] = "category"  # type: ignore[assignment]
        plot.caption = "Mean over the runs of a cell; empty where none ended well."
    else:
        plot.traces = [
            {
                "type": "scatter", "mode": "markers", "name": "runs",
                "x": packed([_float(run.values[across]) for run in runs]),
                "y": packed([_float(run.values[up]) for run in runs]),
                "text": [plot_text(run.name) for run in runs],
                "marker": {"size": 8, "color": _values(runs, figures[0]), "colorscale": "Viridis",
                           "reversescale": True, "showscale": True, "colorbar": {"thickness": 12}},
                "hovertemplate": "%{text}: %{marker.color:.4g}<extra></extra>",
            }
        ]  # fmt: skip
        plot.caption = "Colour: the figure; dark is large." + _ringed(plot, sweep, runs)
    plot.layout = {**titles, "showlegend": False}

    def changed(name: str) -> list[dict[str, Any]]:
        if is_grid:
            return [{"z": _cells(runs, across, up, xs, ys, name)}]
        return [{"marker": {"color": _values(runs, name)}}]

    plot.variants = _variants(sweep, figures, changed, "")
    return plot


def _ringed(plot: Plot, sweep: ReportedSweep, runs: Sequence[SweepRun]) -> str:
    """Draw entrants at equal draws as a dot and rings around it, so that all are seen; in words."""
    entrants = [name for name in sweep.entrants if any(run.entrant == name for run in runs)]
    if not 1 < len(entrants) <= _MOST_RINGS:
        return ""
    places = [entrants.index(run.entrant) for run in runs]
    plot.traces[0]["marker"] |= {
        "size": [8 + 6 * place for place in places],
        "symbol": ["circle-open" if place else "circle" for place in places],
        "line": {"width": [2.5 if place else 0 for place in places]},
    }
    plot.traces[0]["text"] = [plot_text(f"{run.name}, {run.entrant}") for run in runs]
    return f" Dot: {entrants[0]}; rings, from the inside: {', '.join(entrants[1:])}."


def _cells(
    runs: Sequence[SweepRun], across: str, up: str, xs: list[float], ys: list[float], figure: str
) -> list[list[float | None]]:
    total, count = np.zeros((len(ys), len(xs))), np.zeros((len(ys), len(xs)))
    columns = {value: i for i, value in enumerate(xs)}
    rows = {value: i for i, value in enumerate(ys)}
    for run in runs:
        if figure in run.figures:
            place = rows[_float(run.values[up])], columns[_float(run.values[across])]
            total[place] += run.figures[figure]
            count[place] += 1
    with np.errstate(invalid="ignore"):
        means = total / count
    return [[significant(v) if math.isfinite(v) else None for v in row] for row in means.tolist()]


def _variants(
    sweep: ReportedSweep,
    figures: Sequence[str],
    traces: Callable[[str], list[dict[str, Any]]],
    axis: str,
) -> list[Variant]:
    """The same plot for each figure; none where there is but one."""
    if len(figures) < 2:
        return []
    return [
        Variant(
            plot_text(sweep.title(name)),
            traces(name),
            {axis: plot_text(sweep.title(name))} if axis else {},
        )
        for name in figures
    ]


def _groups(sweep: ReportedSweep, most: int) -> list[tuple[str, list[SweepRun]]]:
    """Runs by entrant; all in one where there are more than can be told apart."""
    if len(sweep.entrants) > most:
        return [(_OTHER, [run for run in sweep.runs if not run.failed])]
    return [(name or _OTHER, sweep.of(name)) for name in sweep.entrants if sweep.of(name)]


def _column(runs: Sequence[SweepRun], figure: str) -> dict[str, str]:
    return packed(_numbers(runs, figure))


def _values(runs: Sequence[SweepRun], figure: str) -> list[float | None]:
    return [significant(v) if math.isfinite(v) else None for v in _numbers(runs, figure)]


def _numbers(runs: Sequence[SweepRun], figure: str) -> list[float]:
    return [float(run.figures.get(figure, math.nan)) for run in runs]


def _float(value: Any) -> float:
    return float(value) if isinstance(value, (int, float)) else math.nan


def _word(value: Any) -> str:
    return "–" if value in (None, "") else str(value)


def _distinct(sweep: ReportedSweep, key: str) -> int:
    return len({v for run in sweep.runs if (v := run.values.get(key)) not in (None, "")})


def _spans_decades(values: Sequence[Any]) -> bool:
    known = [float(v) for v in values if isinstance(v, (int, float))]
    return bool(known) and min(known) > 0 and max(known) / min(known) >= 100
