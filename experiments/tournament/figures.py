"""Figures of the tournament: distributions, effects, and what tracking costs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.tournament.verdict import CLASS, Results, by_rig
from trms_cli.scoring.comparison.ranking import Ranking, Standing, figures_of

#: Of a picture: translucent points of four classes need more than lines do.
_COLOURS = 256
NAMES = ("ratios.png", "effects.png", "cost.png")
#: Where axes and colours of ratios end; what is beyond is drawn at the edge and said in words.
_LARGEST, _DARKEST = 10.0, 1.5


def draw(results: Results, folder: Path) -> list[Path]:
    """All figures, as PNG."""
    from trms_cli.reporting.style import house_style, save_png

    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    with house_style():
        for name, figure in (
            (NAMES[0], _ratios(results.main)),
            (NAMES[1], _effects(results)),
            (NAMES[2], _cost(results.main)),
        ):
            if figure is not None:
                save_png(figure, folder / name, _COLOURS)
                paths.append(folder / name)
    return paths


def _ratios(main: Ranking) -> Any:
    """Error over the best of every run, a row an entrant, a colour a class of rigs."""
    from trms_cli.reporting.style import COLOURS, INK, legend_above, new_figure

    entrants = list(main.standings)
    classes = list(dict.fromkeys(condition.get(CLASS, "") for condition in main.contest.conditions))
    figure = new_figure(9.5, 0.9 + 0.42 * len(entrants))
    panel = figure.subplots()
    generator = np.random.default_rng(0)  # of the scatter that keeps points apart, nothing else
    for row, standing in enumerate(entrants):
        of = [main.contest.conditions[int(c)].get(CLASS, "") for c in standing.conditions]
        for i, name in enumerate(classes):
            at = np.array([rig_class == name for rig_class in of], dtype=bool)
            values = np.minimum(standing.ratios[at], _LARGEST)
            spread = generator.uniform(-0.28, 0.28, values.size)
            panel.plot(
                values,
                row + spread,
                "o",
                ms=2.6,
                alpha=0.55,
                mew=0,
                color=COLOURS[i % len(COLOURS)],
                label=name if row == 0 and name else None,
            )
        panel.plot([standing.ratio] * 2, [row - 0.38, row + 0.38], color=INK, lw=1.8)
    panel.axvline(1.0, color=INK, lw=0.6)
    panel.set_xscale("log")
    right = min(_LARGEST, 1.05 * max(float(s.ratios.max(initial=1.0)) for s in entrants))
    left = min(float(s.ratios.min(initial=1.0)) for s in entrants)
    panel.set_xlim(0.97 * left, 1.03 * right)
    _ticks(panel, left, right)
    panel.set_yticks(range(len(entrants)), [_label(standing) for standing in entrants])
    panel.set_ylim(len(entrants) - 0.5, -0.8)  # the legend begins just below the top
    panel.grid(axis="y", visible=False)
    panel.set_xlabel("RMSE over the best entrant's in the same condition (bar: geometric mean)")
    if any(classes):
        legend_above(panel)
    return figure


def _effects(results: Results) -> Any:
    """Ranked entrants × effects: geometric mean over the references of the error over the best."""
    from matplotlib.colors import LinearSegmentedColormap

    from trms_cli.reporting.style import INK, PALETTE, PAPER, SOME, new_figure

    ranking = results.classes.get("effect")
    if ranking is None:
        return None
    entrants = [standing for standing in ranking.standings if standing.rank is not None]
    tables = [by_rig(ranking, standing.name) for standing in entrants]
    rigs = sorted(dict.fromkeys(rig for table in tables for rig in table))
    values = np.array([[table.get(rig, np.nan) for table in tables] for rig in rigs])
    figure = new_figure(2.9 + 0.78 * len(entrants), 1.6 + 0.19 * len(rigs))
    panel = figure.subplots()
    colours = LinearSegmentedColormap.from_list("behind", [PAPER, SOME, PALETTE["vermilion"]])
    panel.imshow(
        np.clip(values, 1.0, _DARKEST), aspect="auto", cmap=colours, vmin=1.0, vmax=_DARKEST
    )
    for i, row in enumerate(values):
        for j, value in enumerate(row):
            if np.isfinite(value):
                text = f"{value:.2f}" if value < 99.5 else f"{value:.0f}"
                bold = "bold" if value == np.nanmin(row) else "normal"
                panel.text(
                    j, i, text, ha="center", va="center", fontsize=6.5, color=INK, weight=bold
                )
    panel.set_xticks(range(len(entrants)), [_label(s).replace(" + ", "\n+ ") for s in entrants])
    panel.tick_params(axis="x", labelsize=7, labelrotation=90, top=True, labeltop=True,
                      bottom=False, labelbottom=False)  # fmt: skip
    names = [rig.removeprefix("effect_").replace("_", " ") for rig in rigs]
    panel.set_yticks(range(len(rigs)), names, fontsize=7)
    panel.grid(visible=False)
    for side in ("left", "bottom"):
        panel.spines[side].set_visible(False)
    panel.tick_params(length=0)
    return figure


def _cost(main: Ranking) -> Any:
    """How far behind against how much the commands move, and how long a step takes."""
    from trms_cli.reporting.style import COLOURS, GREY, INK, new_figure

    figure = new_figure(11.0, 5.0)
    *panels, key = figure.subplots(1, 3, width_ratios=[1, 1, 0.55])
    entrants = [standing for standing in main.standings if np.isfinite(standing.ratio)]
    marks = _marks(entrants)
    for panel, figure_name, words in (
        (panels[0], "variation", "mean Σ|Δu| of a run [V]"),
        (panels[1], "step_ms", "median time of a control step [ms]"),
    ):
        points = []
        for standing, mark in zip(entrants, marks, strict=True):
            x = getattr(figures_of(standing, main.metric), figure_name)
            ranked = standing.rank is not None
            panel.plot(x, standing.ratio, "o" if ranked else "s", ms=5,
                       color=COLOURS[0] if ranked else GREY)  # fmt: skip
            points.append((x, standing.ratio, mark))
        panel.set_xscale("log")
        panel.margins(x=0.12, y=0.12)
        panel.autoscale_view()
        _plain(panel.xaxis)
        _name(panel, points)
        panel.set_xlabel(words)
    panels[1].sharey(panels[0])
    panels[1].tick_params(labelleft=False)
    panels[0].set_ylabel("RMSE over the best")
    panels[0].set_title("with ukf unless another observer is named; squares: not ranked")
    key.set_axis_off()
    for row, (standing, mark) in enumerate(zip(entrants, marks, strict=True)):
        height = 1.0 - row / max(len(entrants) - 1, 18)
        look = {"va": "center", "fontsize": 8, "transform": key.transAxes}
        key.text(0.06, height, mark, ha="right", weight="bold", color=INK, **look)
        key.text(0.1, height, standing.name.replace(" + ukf", ""), color=INK, **look)
    return figure


def _marks(entrants: Sequence[Standing]) -> list[str]:
    """What stands for each entrant: its rank, or a letter without one."""
    letters = iter("abcdefghijklmnopqrstuvwxyz")
    return [str(one.rank) if one.rank is not None else next(letters) for one in entrants]


def _name(panel: Any, points: Sequence[tuple[float, float, str]]) -> None:
    """Marks beside their points, moved up where they would lie on another mark or point."""
    size = 7.0  # points
    scale = 72.0 / panel.figure.dpi
    panel.figure.draw_without_rendering()
    places = [scale * panel.transData.transform((x, y)) for x, y, _ in points]
    boxes = [(centre - 3.0, centre + 3.0, height - 2.0) for centre, height in places]
    for (x, y, name), (centre, height) in sorted(
        zip(points, places, strict=True), key=lambda pair: float(pair[1][1])
    ):
        begin, end, at = centre + 5.0, centre + 8.0 + 0.6 * size * len(name), height - 2.0
        while any(begin < r and b < end and abs(at - h) < 1.1 * size for b, r, h in boxes):
            at += 1.0
        boxes.append((begin, end, at))
        panel.annotate(
            name, (x, y), xytext=(5, at - height), textcoords="offset points", fontsize=size
        )


def _label(standing: Standing) -> str:
    return f"{standing.rank}  {standing.name}" if standing.rank else f"{standing.name}"


def _ticks(panel: Any, left: float, right: float) -> None:
    """Plain numbers on a logarithmic axis that spans less than two decades."""
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

    candidates: Sequence[float] = (0.5, 0.6, 0.7, 0.8, 0.9, 1, 1.1, 1.2, 1.5, 2, 3, 5, 10)
    panel.xaxis.set_major_locator(FixedLocator([v for v in candidates if left <= v <= right]))
    panel.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    panel.xaxis.set_minor_locator(NullLocator())


def _plain(axis: Any) -> None:
    """1, 2, 5, 10 … in figures instead of powers of ten; over many decades 1, 10, 100 …"""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    low, high = axis.get_view_interval()
    wide = np.log10(high / low) > 2.5
    axis.set_major_locator(LogLocator(subs=(1.0,) if wide else (1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())
