"""Plots of many runs: how figures spread, what they depend on, and what cannot be had together."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from trms_cli.core.chart import Axis, Boxes, Colour, Curve, Heat, Mark, Panel, Points, page_look
from trms_cli.reporting.reported_sweep import Objective, ReportedSweep, SweepRun
from trms_cli.reporting.run_panels import histogram
from trms_cli.reporting.signals import FloatArray

#: More entrants than this are not told apart by colour; their boxes still stand side by side.
_MOST_COLOURS, _MOST_BOXES = 8, 60
_MOST_KEYS, _MOST_CATEGORIES, _MOST_CELLS, _BINS = 8, 40, 60, 30
#: Runs of a box that are drawn as dots too.
_MOST_DOTS = 300
#: Entrants that are told apart by rings around one another.
_MOST_RINGS = 4
_OTHER = "all runs"
#: Each dot of a box has a place beside it by its number times this, modulo one (the golden ratio).
_SCATTER = 0.618
#: A whisker reaches this many times the distance of the quartiles at most.
_WHISKER = 1.5


def spread_panels(sweep: ReportedSweep, figures: Sequence[str]) -> list[Panel]:
    """Boxes of a figure for each entrant, and a histogram; the reader chooses the figure."""
    if not figures:
        return []
    entrants, groups = _groups(sweep, _MOST_BOXES), _groups(sweep, 4)
    few = max((len(runs) for _, runs in entrants), default=0) <= _MOST_DOTS
    colours = [_colour(i if len(entrants) <= _MOST_COLOURS else 0) for i in range(len(entrants))]
    who = Axis("", categories=[name for name, _ in entrants])
    caption = "Box: quartiles and median." + (" A dot is a run." if few else "")

    def boxes(figure: str) -> Panel:
        quantiles = [_quartiles(_numbers(runs, figure)) for _, runs in entrants]
        marks: list[Mark] = [Boxes(range(len(entrants)), quantiles, colours=colours)]
        for place, (_, runs) in enumerate(entrants):
            low, high = quantiles[place][0], quantiles[place][-1]
            shown = [
                (i, value, run.name)
                for i, (run, value) in enumerate(zip(runs, _numbers(runs, figure), strict=True))
                if few or value < low or value > high
            ]
            beside = [place + 0.3 * (i * _SCATTER % 1.0 - 0.5) for i, _, _ in shown]
            marks.append(
                Points([value for _, value, _ in shown], beside, colour=colours[place], size=3,
                       told=[name for _, _, name in shown], opacity=0.55)
            )  # fmt: skip
        height = (90 + 34 * len(entrants)) / 256
        return Panel(Axis(sweep.title(figure)), who, marks, "by who ran", caption=caption,
                     row_height=height)  # fmt: skip

    def counts(figure: str) -> Panel:
        values = [np.array(_numbers(runs, figure)) for _, runs in groups]
        known = np.concatenate([[], *values])
        known = known[np.isfinite(known)]
        low, high = (known.min(), known.max()) if len(known) else (0.0, 1.0)
        edges = np.linspace(low, high if high > low else low + 1e-9, _BINS + 1)
        several = len(groups) > 1
        marks = [
            histogram(own, edges, name if several else "", _colour(number),
                      opacity=0.6 if several else 0.9)
            for number, ((name, _), own) in enumerate(zip(groups, values, strict=True))
        ]  # fmt: skip
        return Panel(Axis(sweep.title(figure)), Axis("runs"), marks, "distribution")

    return [_chosen(sweep, figures, boxes), _chosen(sweep, figures, counts)]


def key_panels(sweep: ReportedSweep, figures: Sequence[str]) -> list[Panel]:
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
    panels = [_chosen(sweep, figures, partial(_scatter, sweep, key)) for key in chosen[:_MOST_KEYS]]
    for key in others[:_MOST_KEYS]:
        panels.append(_chosen(sweep, figures, partial(_categories, sweep, key)))
    if len(chosen) >= 2:
        panels.append(_chosen(sweep, figures, partial(_map, sweep, chosen[0], chosen[1])))
    return panels


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


def pareto_panels(sweep: ReportedSweep) -> list[Panel]:
    """Each pair of objectives: all runs, and those that nothing beats."""
    pairs = list(itertools.combinations(sweep.objectives, 2))[:6]
    front = sweep.front()
    panels = [_pareto(sweep, front, one, other, len(pairs) > 1) for one, other in pairs]
    return panels + _history(sweep)


def _history(sweep: ReportedSweep) -> list[Panel]:
    """The best so far over the trials: whether more of them would have helped."""
    if sum(value is not None for value in sweep.history) < 2:
        return []
    several = len(sweep.objectives) > 1
    words = "volume dominated by the front" if several else sweep.title(sweep.objectives[0].figure)
    values = [math.nan if value is None else float(value) for value in sweep.history]
    curve = Curve(range(1, len(values) + 1), values, held=True)
    return [Panel(Axis("trials"), Axis(words), [curve], "the best so far")]


def _pareto(
    sweep: ReportedSweep, front: Sequence[SweepRun], one: Objective, other: Objective, half: bool
) -> Panel:
    both = {one.figure, other.figure}
    known = [run for run in sweep.tried if not run.failed and both <= set(run.figures)]
    best = sorted((run for run in front if both <= set(run.figures)),
                  key=lambda run: run.figures[one.figure])  # fmt: skip

    def dots(
        runs: Sequence[SweepRun], label: str, colour: Colour, size: float, **more: Any
    ) -> Mark:
        x, y = (_numbers(runs, objective.figure) for objective in (one, other))
        told = [run.name for run in runs]
        return Points(x, y, label, colour=colour, size=size, told=told, **more)

    # Between two runs of the front nothing is known to be had: steps, not a slope. With three
    # objectives the front is a surface, and a line over it would say nothing.
    steps = ("vh" if one.largest else "hv") if len(sweep.objectives) == 2 else ""
    marks = [
        dots(known, "trials" if sweep.trials else "runs", "grey", 4.5),
        dots(best, "Pareto front", "vermilion", 6.5, joined=steps),
    ]
    across, up = (
        Axis(f"{sweep.title(o.figure)}, {'largest' if o.largest else 'least'} sought")
        for o in (one, other)
    )
    caption = (
        "Of the runs on the front none is as good as another in all objectives and better in one."
    )
    return Panel(across, up, marks, f"{other.figure} against {one.figure}", caption=caption,
                 half=half, row_height=1.55)  # fmt: skip


def _scatter(sweep: ReportedSweep, key: str, figure: str) -> Panel:
    groups = _groups(sweep, _MOST_COLOURS)
    size = 5.0 if len(sweep.runs) <= 200 else 3.0
    marks = [
        Points([_float(run.values.get(key)) for run in runs], _numbers(runs, figure),
               name if len(groups) > 1 else "", colour=_colour(number), size=size, opacity=0.7,
               told=[run.name for run in runs])
        for number, (name, runs) in enumerate(groups)
    ]  # fmt: skip
    across = Axis(key, log=_spans_decades([run.values.get(key) for run in sweep.runs]))
    return Panel(across, Axis(sweep.title(figure)), marks, f"against {key}", half=True,
                 row_height=1.2)  # fmt: skip


def _categories(sweep: ReportedSweep, key: str, figure: str) -> Panel:
    groups = _groups(sweep, _MOST_COLOURS)
    words = list(dict.fromkeys(_word(run.values.get(key)) for _, runs in groups for run in runs))
    width = 0.8 / len(groups)
    marks = []
    for number, (name, runs) in enumerate(groups):
        own = [[r for r in runs if _word(r.values.get(key)) == word] for word in words]
        places = [place + width * (number - 0.5 * (len(groups) - 1)) for place in range(len(words))]
        quantiles = [_quartiles(_numbers(some, figure)) for some in own]
        label = name if len(groups) > 1 else ""
        marks.append(
            Boxes(places, quantiles, label, [_colour(number)], across=False, width=0.8 * width)
        )
    across = Axis(key, categories=words)
    return Panel(across, Axis(sweep.title(figure)), marks, f"by {key}", half=True, row_height=1.2)


def _map(sweep: ReportedSweep, across: str, up: str, figure: str) -> Panel:
    """A heat map of means where two keys make a grid, else dots coloured by the figure."""
    runs = [
        run
        for run in sweep.runs
        if not run.failed and run.values.get(across) is not None and run.values.get(up) is not None
    ]
    xs, ys = (sorted({_float(run.values[key]) for run in runs}) for key in (across, up))
    axes = (Axis(across), Axis(up))
    marks: Sequence[Mark]
    if max(len(xs), len(ys)) <= _MOST_CELLS and len(xs) * len(ys) <= 4 * len(runs):
        ys = ys[::-1]  # the largest on top
        axes = (Axis(across, categories=[f"{v:g}" for v in xs]),
                Axis(up, categories=[f"{v:g}" for v in ys]))  # fmt: skip
        marks = [Heat(_cells(runs, across, up, xs, ys, figure))]
        caption = "Mean over the runs of a cell; empty where none ended well."
    else:
        marks, words = _rings(sweep, runs, across, up, figure)
        caption = f"Colour: the figure; dark is large.{words}"
    return Panel(*axes, marks, f"over {across} and {up}", caption=caption, half=True,
                 row_height=1.55)  # fmt: skip


def _rings(
    sweep: ReportedSweep, runs: Sequence[SweepRun], across: str, up: str, figure: str
) -> tuple[list[Points], str]:
    """Entrants at equal draws as a dot and rings around it, so that all are seen; in words."""
    entrants = [name for name in sweep.entrants if any(run.entrant == name for run in runs)]
    ringed = 1 < len(entrants) <= _MOST_RINGS
    marks = []
    for place, entrant in enumerate(entrants if ringed else [""]):
        own = [run for run in runs if not ringed or run.entrant == entrant]
        x, y = ([_float(run.values[key]) for run in own] for key in (across, up))
        told = [f"{run.name}, {entrant}" if ringed else run.name for run in own]
        marks.append(
            Points(x, y, marker="unstable" if place else "dot", size=5.7 + 4.3 * place, told=told,
                   values=_numbers(own, figure))
        )  # fmt: skip
    if not ringed:
        return marks, ""
    return marks, f" Dot: {entrants[0]}; rings, from the inside: {', '.join(entrants[1:])}."


def _cells(
    runs: Sequence[SweepRun], across: str, up: str, xs: list[float], ys: list[float], figure: str
) -> FloatArray:
    total, count = np.zeros((len(ys), len(xs))), np.zeros((len(ys), len(xs)))
    columns = {value: i for i, value in enumerate(xs)}
    rows = {value: i for i, value in enumerate(ys)}
    for run in runs:
        if figure in run.figures:
            place = rows[_float(run.values[up])], columns[_float(run.values[across])]
            total[place] += run.figures[figure]
            count[place] += 1
    with np.errstate(invalid="ignore"):
        return total / count


def _chosen(sweep: ReportedSweep, figures: Sequence[str], draw: Callable[[str], Panel]) -> Panel:
    """A panel that shows the first figure, and any that the reader chooses."""
    panel = draw(figures[0])
    if len(figures) < 2:
        return panel
    others = {sweep.title(figure): draw(figure) for figure in figures}
    return replace(panel, variants=others)


def _quartiles(values: Sequence[float]) -> list[float]:
    """Whisker, quartile, median, quartile, whisker; NaN without a value."""
    known = np.array(values, dtype=float)
    known = known[np.isfinite(known)]
    if not len(known):
        return [math.nan] * 5
    first, middle, third = np.quantile(known, (0.25, 0.5, 0.75))
    reach = _WHISKER * (third - first)
    low, high = known[known >= first - reach].min(), known[known <= third + reach].max()
    return [float(value) for value in (low, first, middle, third, high)]


def _colour(number: int) -> Colour:
    colour: Colour = page_look(number)["colour"]
    return colour


def _groups(sweep: ReportedSweep, most: int) -> list[tuple[str, list[SweepRun]]]:
    """Runs by entrant; all in one where there are more than can be told apart."""
    if len(sweep.entrants) > most:
        return [(_OTHER, [run for run in sweep.runs if not run.failed])]
    return [(name or _OTHER, sweep.of(name)) for name in sweep.entrants if sweep.of(name)]


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
