"""The figures of the study, in the look of the house."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from experiments.model_study.judgement import ANGLES, Judgement
from experiments.model_study.results import Results
from experiments.model_study.study import Entrant, Family
from trms_cli.reporting.style import (
    COLOURS,
    GREY,
    INK,
    house_style,
    legend_above,
    new_figure,
    save_png,
)

COLOUR_OF: Mapping[Family, str] = dict(
    zip(("white", "grey", "network", "linear"), COLOURS, strict=True)
)
_AXES = {"alpha_v": "pitch", "alpha_h": "yaw"}
_FREE_RUNS = "free runs"
_MILLI = 1e3
_HIGHEST = 1e4  # mrad, of the record's panels
#: Of a figure whose thin lines would lose their colours to a smaller palette.
_COLOURS = 256
#: Marks within a family, in the order of the entrants.
_MARKS = ("o", "s", "^", "D", "v")
_DASHES = ("-", "--", ":", "-.", (0, (5, 1, 1, 1, 1, 1)))


def draw(results: Results, folder: Path) -> None:
    """All figures, as PNG."""
    with house_style():
        save_png(_ranking(results), folder / "ranking.png", _COLOURS)
        save_png(_horizons(results), folder / "horizons.png", _COLOURS)
        save_png(_responses(results), folder / "responses.png", _COLOURS)
        save_png(_price(results), folder / "price.png", _COLOURS)
        if results.record is not None:
            assert results.study.record is not None
            save_png(
                _record(results.record.judgements, results.study.record.models),
                folder / "record.png",
                _COLOURS,
            )


def _ranking(results: Results) -> Any:
    """A row a model, a dot a rig: errors in the loop and of free runs."""
    order = [s.name for s in results.by_loop]
    panels_of: dict[str, dict[str, list[float]]] = {
        task: {n: [_MILLI * e for e in results.loop_errors(n, [task])] for n in order}
        for task in results.study.loops.chosen()
    }
    panels_of[_FREE_RUNS] = {n: results.free_run_errors(n) for n in order}
    figure = new_figure(11.5, 1.2 + 0.3 * len(order))
    panels = figure.subplots(1, len(panels_of), sharey=True, squeeze=False)[0]
    for panel, (title, errors) in zip(panels, panels_of.items(), strict=True):
        for row, name in enumerate(order):
            values = np.array([v for v in errors[name] if np.isfinite(v)])
            colour = COLOUR_OF[results.study.models[name].family]
            panel.plot(values, np.full(values.size, row), "o", ms=3.5, mew=0,
                       color=colour)  # fmt: skip
            if values.size:
                mean = float(np.exp(np.mean(np.log(values))))
                panel.plot([mean, mean], [row - 0.33, row + 0.33], color=INK, lw=1.6)
        panel.set_xscale("log")
        _plain(panel.xaxis)
        panel.set_title(title)
        over = "error over no change's" if title == _FREE_RUNS else "error of both axes [mrad]"
        panel.set_xlabel(over)
        panel.grid(axis="y", visible=False)
    names = [results.study.models[name].name for name in order]
    panels[0].set_yticks(range(len(order)), names)
    panels[0].set_ylim(len(order) - 0.5, -0.5)
    _family_legend(figure, {results.study.models[n].family for n in order})
    return figure


def _horizons(results: Results) -> Any:
    """How errors of free runs grow, over those of no change."""
    ahead = results.study.horizons
    figure = new_figure(10.0, 4.6)
    panels = figure.subplots(1, 2, sharey=True)
    families: dict[str, int] = {}
    for name in results.names:
        entrant = results.study.models[name]
        k = families[entrant.family] = families.get(entrant.family, -1) + 1
        for panel, angle in zip(panels, ANGLES, strict=True):
            values = [results.over_no_change(name, [angle], str(h)) for h in ahead]
            panel.plot(ahead, values, marker=_MARKS[k], ms=4, ls=_DASHES[k], lw=1.1,
                       color=COLOUR_OF[entrant.family], label=entrant.name)  # fmt: skip
    for panel, angle in zip(panels, ANGLES, strict=True):
        panel.axhline(1.0, color=GREY, lw=0.8)
        panel.set(xscale="log", yscale="log", xlabel="time ahead [s]", title=_AXES[angle])
        _at(panel.xaxis, ahead)
        _plain(panel.yaxis)
    panels[0].set_ylabel("error over that of no change")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside right center", fontsize=8)
    return figure


def _responses(results: Results) -> Any:
    """Errors of the best of each family on one rig, over time."""
    task = results.ranked_tasks[0]
    rig = results.common[0]
    best: dict[str, str] = {}
    for s in results.by_loop:
        if s.failures == 0:
            best.setdefault(results.study.models[s.name].family, s.name)
    first = rig.loops[task][next(iter(best.values()))].traces
    figure = new_figure(10.0, 4.8)
    grid = figure.subplots(2, 2, sharex=True, height_ratios=[1.0, 1.2])
    for column, axis in enumerate(_AXES.values()):
        upper, lower = grid[:, column]
        upper.plot(first["time"], first["reference"][:, column], color=INK, lw=0.8, ls="--")
        for family, name in best.items():
            traces = rig.loops[task][name].traces
            colour = COLOUR_OF[family]  # type: ignore[index]
            label = results.study.models[name].name
            upper.plot(traces["time"], traces["angle"][:, column], color=colour, lw=1.0)
            error = _MILLI * (traces["angle"] - traces["reference"])[:, column]
            lower.plot(traces["time"], error, color=colour, lw=0.9, label=label)
        counted = first["time"] >= results.study.loops.begin
        errors = [
            _MILLI * (t["angle"] - t["reference"])[counted, column]
            for t in (rig.loops[task][name].traces for name in best.values())
        ]
        bound = 1.15 * max(float(np.max(np.abs(e))) for e in errors)
        lower.set_ylim(-bound, bound)
        lower.axvline(results.study.loops.begin, color=GREY, lw=0.6)
        upper.set_title(axis)
        lower.set_xlabel("time [s]")
        lower.set_xlim(0.0, first["time"][-1])
    grid[0, 0].set_ylabel("angle [rad]")
    grid[1, 0].set_ylabel("error [mrad]")
    legend_above(grid[1, 0], 2)
    figure.align_ylabels()
    return figure


def _price(results: Results) -> Any:
    """Error in the loop against the time of a fit, and of a control sample."""
    task = results.ranked_tasks[0]
    fitted = [n for n in results.names if results.study.models[n].fit]
    figure = new_figure(11.0, 4.4)
    panels = figure.subplots(1, 2, sharey=True)
    _family_legend(figure, {results.study.models[n].family for n in results.names})
    named = []
    means = {s.name: _MILLI * s.mean for s in results.by_loop if np.isfinite(s.mean)}
    for panel, words, values in (
        (panels[0], "fit [s]", {n: results.seconds(n) for n in fitted if n in means}),
        (panels[1], "a control sample [ms]", {n: results.step_ms(n, task) for n in means}),
    ):
        points = []
        for name, value in values.items():
            entrant = results.study.models[name]
            panel.plot(value, means[name], "o", ms=5, color=COLOUR_OF[entrant.family])
            points.append((value, means[name], entrant.name))
        panel.set(xscale="log", yscale="log", xlabel=words)
        panel.margins(x=0.3, y=0.12)
        panel.autoscale_view()
        _plain(panel.xaxis)
        _plain(panel.yaxis)
        named.append((panel, points))
    panels[0].set_ylabel("error in the loop [mrad]")
    for panel, points in named:  # once nothing else moves the panels
        _name(panel, points)
    return figure


def _record(judgements: Mapping[str, Judgement], entrants: Mapping[str, Entrant]) -> Any:
    """Errors on the held-out part of the real record."""
    figure = new_figure(10.0, 4.4)
    panels = figure.subplots(1, 2)
    families: dict[str, int] = {}
    first = next(iter(judgements.values()))
    for name, judgement in judgements.items():
        entrant = entrants[name]
        k = families[entrant.family] = families.get(entrant.family, -1) + 1
        for panel, angle in zip(panels, ANGLES, strict=True):
            ahead = [float(h) for h in judgement.errors[angle]]
            # what runs away leaves the panel
            values = [min(_MILLI * v, 2 * _HIGHEST) for v in judgement.errors[angle].values()]
            panel.plot(ahead, values, marker=_MARKS[k], ms=4, ls=_DASHES[k], lw=1.1,
                       color=COLOUR_OF[entrant.family], label=entrant.name)  # fmt: skip
    for panel, angle in zip(panels, ANGLES, strict=True):
        ahead = [float(h) for h in first.unchanged[angle]]
        values = [_MILLI * v for v in first.unchanged[angle].values()]
        panel.plot(ahead, values, color=INK, lw=2.0, label="no change")
        panel.set(xscale="log", yscale="log", xlabel="time ahead [s]", title=_AXES[angle])
        panel.set_ylim(top=_HIGHEST)
        _at(panel.xaxis, ahead)
        _plain(panel.yaxis)
    panels[0].set_ylabel("RMS error [mrad]")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside right center", fontsize=8)
    return figure


def _family_legend(figure: Any, families: set[Family]) -> None:
    from matplotlib.lines import Line2D

    marks = [
        Line2D([], [], marker="o", ls="", color=colour, label=family)
        for family, colour in COLOUR_OF.items()
        if family in families
    ]
    figure.legend(handles=marks, loc="outside upper left", ncols=4)


def _name(panel: Any, points: Sequence[tuple[float, float, str]]) -> None:
    """Names beside their points, moved up where they would lie on another name."""
    size = 7.0  # points
    scale = 72.0 / panel.figure.dpi
    panel.figure.draw_without_rendering()
    boxes: list[tuple[float, float, float]] = []
    for x, y, name in sorted(points, key=lambda point: point[1]):
        centre, height = scale * panel.transData.transform((x, y))
        begin, end, at = centre + 6.0, centre + 6.0 + 0.55 * size * len(name), height - 2.0
        while any(begin < right and left < end and abs(at - h) < 1.15 * size
                  for left, right, h in boxes):  # fmt: skip
            at += 1.0
        boxes.append((begin, end, at))
        far = at - height > size
        tie = {"arrowstyle": "-", "lw": 0.5, "color": GREY, "relpos": (0, 0), "shrinkB": 3}
        panel.annotate(name, (x, y), xytext=(6, at - height), textcoords="offset points",
                       fontsize=size, arrowprops=tie if far else None)  # fmt: skip


def _plain(axis: Any) -> None:
    """1, 2, 5, 10 … in figures instead of powers of ten; over many decades 1, 10, 100 …"""
    from matplotlib.ticker import LogLocator

    low, high = axis.get_view_interval()
    wide = np.log10(high / low) > 2.5
    axis.set_major_locator(LogLocator(subs=(1.0,) if wide else (1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_locator(NullLocator())


def _at(axis: Any, places: Sequence[float]) -> None:
    axis.set_major_locator(FixedLocator(list(places)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_locator(NullLocator())
