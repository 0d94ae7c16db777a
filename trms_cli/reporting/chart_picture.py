"""Draws a :class:`trms_cli.core.chart.Chart` with matplotlib in the look of the house.

Panels and marks are drawn by one code (:func:`draw_panel`); they are laid out on paper as a chart
of a study (:func:`picture_of`), as the sheet of a run (:func:`sheet_of`), or by ``trms plot``.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import ListedColormap, to_rgba
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from matplotlib.transforms import ScaledTranslation

from trms_cli.core import chart as charts
from trms_cli.reporting.style import (
    ALARM,
    GREY,
    GROUND,
    INK,
    MEASURED,
    PALE,
    PALETTE,
    SHADES,
    legend_above,
    line_scale,
    new_figure,
    thin_every,
)

#: Letters of a legend that fit into an inch, its handle counted as some.
_LETTERS_PER_INCH, _HANDLE_LETTERS = 15.0, 6
#: Numbers that fit along an inch of a panel, with a sign and three digits each.
_TICKS_PER_INCH = 1.4
#: Inches from a panel down to its legend: tick labels and the axis' label lie between.
_BENEATH = 0.45
#: From more panels than this on a figure has small letters and margins of its own.
_CROWDED = 12
#: A logarithmic axis up to this ratio has room for 1, 2 and 5 of each decade.
_PLAIN_SPAN = 150.0


def picture_of(chart: charts.Chart) -> Figure:
    """The figure, to be called within :func:`trms_cli.reporting.style.house_style`."""
    columns = max(1, min(chart.columns, len(chart.panels)))
    rows = math.ceil(len(chart.panels) / columns)
    width = max(chart.width * columns, 3.0)
    heights = [
        max(panel.row_height or 1.0 for panel in chart.panels[columns * i : columns * (i + 1)])
        for i in range(rows)
    ]
    height = chart.height * sum(heights)
    figure = new_figure(width, height)
    margins: dict[str, float] = {}
    crowded = len(chart.panels) > _CROWDED
    if crowded:  # to arrange themselves takes such panels longer than to draw them
        figure.set_layout_engine("none")
        titled = any(panel.title for panel in chart.panels)
        margins = {
            "left": 0.75 / width,
            "right": 1 - 0.1 / width,
            "bottom": 0.75 / height,
            "top": 1 - 0.4 / height,
            "wspace": 0.36,
            "hspace": 0.6 if titled else 0.25,
        }
    grid = figure.add_gridspec(rows, columns, height_ratios=heights, **margins)
    legends: list[dict[str, Handle]] = []
    places: list[Axes] = []
    for number, panel in enumerate(chart.panels):
        projection = None if panel.z is None else "3d"
        shared = places[0] if chart.together and places else None
        axes = figure.add_subplot(
            grid[divmod(number, columns)], projection=projection, sharex=shared
        )
        legends.append(draw_panel(axes, panel))
        if chart.together and number + columns < len(chart.panels):
            axes.tick_params(labelbottom=False)
            axes.set_xlabel("")
        if not panel.x.log and panel.z is None and not (panel.x.ticks or panel.x.categories):
            axes.locator_params(axis="x", nbins=max(4, round(_TICKS_PER_INCH * chart.width)))
        if crowded:
            axes.tick_params(labelsize=7)
            axes.title.set(fontsize=7.5, fontweight="normal")
            axes.xaxis.label.set_fontsize(8)
            axes.yaxis.label.set_fontsize(8)
            axes.locator_params(nbins=4)
        if not panel.marks:
            axes.set_visible(False)
        places.append(axes)
    if not crowded:
        figure.align_ylabels()
    if _one_legend_serves(legends):
        union = {label: handle for legend in legends for label, handle in legend.items()}
        _legend_beneath(figure, union, width)
    else:
        for axes, legend in zip(places, legends, strict=True):
            _legend_beneath_panel(figure, axes, legend, chart.width)
    return figure


#: Inches of a sheet: around its panels, between two below and beside one another, for a long note.
_LEFT, _RIGHT, _TOP, _BOTTOM, _GAP, _BETWEEN, _NOTE = 0.84, 0.14, 0.55, 0.45, 0.27, 0.95, 0.15
#: Of a sheet's title: letters along an inch, and inches that each further line takes.
_TITLE_LETTERS, _TITLE_LINE = 9.8, 0.19
#: Letters of a note and a legend, with its handles, along an inch.
_NOTE_LETTERS = 15.5


def sheet_of(chart: charts.Chart, title: str = "") -> Figure:
    """Panels over one time in rows, heights and width in inches, each legend over its panel.

    Placed by hand: to have the places found takes as long as all the drawing. To be called within
    :func:`trms_cli.reporting.style.house_style`.
    """
    columns = chart.columns
    rows = [chart.panels[i : i + columns] for i in range(0, len(chart.panels), columns)]
    lines = _title_lines(title, chart.width)
    heights = [max(panel.row_height for panel in row) for row in rows]
    wide = (chart.width - _LEFT - _RIGHT - (columns - 1) * _BETWEEN) / columns
    gaps = [_NOTE * any(_is_crowded(panel, wide) for panel in row) for row in rows]
    top = _TOP + (len(lines) - 1) * _TITLE_LINE
    whole = top + sum(heights) + sum(gaps) + _GAP * (len(rows) - 1) + _BOTTOM
    figure = Figure(figsize=(chart.width, whole))
    FigureCanvasAgg(figure)
    ceiling = whole - top
    first: Any = None
    for row, height, gap in zip(rows, heights, gaps, strict=True):
        ceiling -= gap
        for place, panel in enumerate(row):
            left = (_LEFT + place * (wide + _BETWEEN)) / chart.width
            size = (wide / chart.width, height / whole)
            axes = figure.add_axes((left, (ceiling - height) / whole, *size), sharex=first)
            first = first or axes
            axes.yaxis.set_label_coords(-(0.48 if columns == 1 else 0.6) / wide, 0.5)
            handles = draw_panel(axes, panel)
            axes.tick_params(labelbottom=row is rows[-1])
            if row is not rows[-1]:
                axes.set_xlabel("")
            if handles:
                legend_above(
                    axes,
                    handles=[handle.artist for handle in handles.values()],
                    labels=list(handles),
                )
            if _is_crowded(panel, wide):
                axes.set_title(panel.note, loc="right", fontsize=8, color=GREY, pad=3 + 72 * _NOTE)
        ceiling -= height + _GAP
    figure.text(
        0.01,
        1 - 0.12 / whole,
        "\n".join(lines),
        va="top",
        fontsize=11,
        fontweight="bold",
        color=INK,
    )
    return figure


def _is_crowded(panel: charts.Panel, width: float) -> bool:
    """Whether a note and a legend find no room beside each other."""
    labels = dict.fromkeys(label for mark in panel.marks if (label := getattr(mark, "label", "")))
    letters = sum(len(label) + _HANDLE_LETTERS for label in labels) + len(panel.note)
    return bool(panel.note) and letters > _NOTE_LETTERS * width


def _title_lines(title: str, width: float) -> list[str]:
    """A title in lines that fit, broken between its parts where that is possible."""
    most = int(width * _TITLE_LETTERS)
    parts = (
        part.replace(" ", "\N{NO-BREAK SPACE}") if len(part) < most // 2 else part
        for part in title.split(" · ")
    )
    return textwrap.wrap(" · ".join(parts), most, break_on_hyphens=False) or [""]


def draw_panel(axes: Any, panel: charts.Panel) -> dict[str, Handle]:
    """Draw everything into axes; what the legend shows, by label."""
    if panel.z is not None:
        axes.set_proj_type("ortho")
        axes.view_init(elev=22, azim=-58)
        axes.tick_params(labelsize=7, pad=0)
        for side in (axes.xaxis, axes.yaxis, axes.zaxis):
            side.pane.set_facecolor((1, 1, 1, 0))
            side.line.set_color(GREY)
            side._axinfo["grid"].update(color=GROUND, linewidth=0.5)
    for name, axis in (("x", panel.x), ("y", panel.y), ("z", panel.z)):
        if axis is not None:
            _set_axis(axes, name, axis)
    handles: dict[str, Handle] = {}
    for mark in panel.marks:
        handle = draw_mark(axes, mark)
        label = getattr(mark, "label", "")
        same = handles.get(label)
        # a curve and its band of one name: the curve stands for both
        if handle is not None and label and (same is None or isinstance(same.artist, Patch)):
            handles[label] = handle
    # Marks may have widened what was asked for.
    for name, axis in (("x", panel.x), ("y", panel.y), ("z", panel.z)):
        if axis is not None and axis.limits is not None:
            getattr(axes, f"set_{name}lim")(*axis.limits)
        if axis is not None and axis.log:
            _set_decades(axes, name)
        if axis is not None:
            _set_ticks(axes, name, axis)
    if panel.x.log and panel.y.log:  # minor ticks cost more than all the rest
        axes.minorticks_off()
    if panel.title:
        axes.set_title(panel.title, fontweight="bold")
    if panel.note:
        axes.set_title(panel.note, loc="right", fontsize=8, color=GREY, pad=3)
    if panel.equal:
        # limits that were chosen are kept: then it is the box that gives way
        has_limits = panel.x.limits is not None and panel.y.limits is not None
        axes.set_aspect("equal", adjustable="box" if has_limits else "datalim")
    return handles


def _set_axis(axes: Any, name: str, axis: charts.Axis) -> None:
    label = f"{axis.label} [{axis.unit}]" if axis.unit else axis.label
    pad = {} if not hasattr(axes, "zaxis") else {"labelpad": 2.0}
    getattr(axes, f"set_{name}label")(label, **pad)
    if axis.log:
        getattr(axes, f"set_{name}scale")("log")


def _set_ticks(axes: Any, name: str, axis: charts.Axis) -> None:
    side = getattr(axes, f"{name}axis")
    if axis.ticks:
        limits = getattr(axes, f"get_{name}lim")()
        side.set_ticks(axis.ticks, [f"{tick:g}" for tick in axis.ticks])
        getattr(axes, f"set_{name}lim")(*limits)
    if axis.categories:
        side.set_ticks(range(len(axis.categories)), axis.categories)
        ends = (-0.7, len(axis.categories) - 0.3)
        getattr(axes, f"set_{name}lim")(*(ends[::-1] if name == "y" else ends))


def _set_decades(axes: Any, name: str) -> None:
    """Plain numbers on a logarithmic axis of a decade or two, powers of ten on a longer one."""
    low, high = getattr(axes, f"get_{name}lim")()
    side = getattr(axes, f"{name}axis")
    side.set_minor_formatter(NullFormatter())
    if low > 0 and high / low < _PLAIN_SPAN:
        side.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        side.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def _one_legend_serves(legends: Sequence[dict[str, Handle]]) -> bool:
    """Whether no look means two things in different panels, and nothing has two looks."""
    pairs = {(label, handle.look) for legend in legends for label, handle in legend.items()}
    labels, looks = {label for label, _ in pairs}, {look for _, look in pairs}
    return len(labels) == len(looks) == len(pairs) <= 10


def _columns(labels: Sequence[str], width: float) -> int:
    longest = max(len(label) for label in labels) + _HANDLE_LETTERS
    return max(1, min(len(labels), int(width * _LETTERS_PER_INCH / longest)))


def _legend_beneath(figure: Figure, handles: dict[str, Handle], width: float) -> None:
    if handles:
        figure.legend(
            [handle.artist for handle in handles.values()],
            list(handles),
            loc="outside lower center",
            ncols=_columns(list(handles), width),
            handlelength=1.8,
            columnspacing=1.4,
        )


def _legend_beneath_panel(
    figure: Figure, axes: Any, handles: dict[str, Handle], width: float
) -> None:
    if not handles:
        return
    axes.legend(
        [handle.artist for handle in handles.values()],
        list(handles),
        loc="upper left",
        bbox_to_anchor=(0.0, 0.0),
        bbox_transform=axes.transAxes + ScaledTranslation(0.0, -_BENEATH, figure.dpi_scale_trans),
        ncols=_columns(list(handles), width),
        handlelength=1.6,
        columnspacing=1.2,
        borderaxespad=0.0,
    )


_DASHES: dict[str, Any] = {
    "solid": "-",
    "dashed": (0, (4.5, 2.2)),
    "dotted": (0, (1.2, 1.8)),
    "dashdot": (0, (6.0, 1.5, 1.2, 1.5)),
    "dashdotdot": (0, (3.0, 1.2, 1.0, 1.2, 1.0, 1.2)),
    "long": (0, (9.0, 2.5)),
}
_INKS = {"ink": INK, "grey": GREY, "pale": PALE, "measured": MEASURED, "alarm": ALARM}
_SHAPES = {
    "stable": "o",
    "unstable": "o",
    "saddle": "D",
    "star": "*",
    "dot": "o",
    "cross": "x",
    "square": "s",
    "triangle": "^",
    "down": "v",
    "diamond": "D",
}
#: Behind words, so that they can be read across lines.
_PAPER = {"boxstyle": "square,pad=0.1", "facecolor": (1, 1, 1, 0.7), "edgecolor": "none"}


@dataclass(frozen=True)
class Handle:
    """What a legend shows of a mark."""

    artist: Any  #: matplotlib artist
    look: object  #: Equal for marks that cannot be told apart


def draw_mark(axes: Any, mark: charts.Mark) -> Handle | None:
    """Draw one; what stands for it in the legend, or None for a mark without."""
    match mark:
        case charts.Curve():
            return _curve(axes, mark)
        case charts.Points():
            return _points(axes, mark)
        case charts.Flow():
            _flow(axes, mark)
        case charts.Contour():
            return _contour(axes, mark)
        case charts.Region():
            return _region(axes, mark)
        case charts.Band():
            return _band(axes, mark)
        case charts.Span():
            colour = to_rgba(_colour(mark.colour), mark.opacity)
            axes.axvspan(mark.begin, mark.end, color=colour, linewidth=0, zorder=0)
            return Handle(Patch(facecolor=colour), ("patch", mark.colour, round(mark.opacity, 2)))
        case charts.Line():
            return _line(axes, mark)
        case charts.Note():
            _note(axes, mark)
        case charts.Bars():
            _bars(axes, mark)
        case charts.Events():
            return _events(axes, mark)
        case charts.Fans():
            return _curve(
                axes,
                charts.Curve(
                    mark.x, mark.y, mark.label, mark.colour, width=0.6, is_step=mark.is_step
                ),
            )
        case charts.Boxes():
            _boxes(axes, mark)
        case charts.Heat():
            rows, columns = np.shape(mark.values)
            axes.pcolormesh(
                range(columns), range(rows), mark.values, cmap=ListedColormap(SHADES), zorder=0.5
            )
    return None


def _colour(name: str) -> str:
    return _INKS[name] if name in _INKS else PALETTE[name]


def _line_handle(colour: str, style: str, width: float, opacity: float = 1.0) -> Handle:
    line = Line2D(
        [],
        [],
        color=_colour(colour),
        linestyle=_DASHES[style],
        linewidth=width * line_scale(),
        alpha=opacity,
    )
    return Handle(line, ("line", colour, style))


def _curve(axes: Any, mark: charts.Curve) -> Handle:
    look = {
        "color": _colour(mark.colour),
        "linestyle": _DASHES[mark.style],
        "linewidth": mark.width * line_scale(),
        "alpha": mark.opacity,
        "label": mark.label or None,
    }
    if mark.z is not None:
        axes.plot(mark.x, mark.y, mark.z, **look)
    else:
        x, y = thin_every(mark.x, mark.y)
        axes.plot(x, y, drawstyle="steps-post" if mark.is_step else "default", **look)
        if mark.filled:
            axes.fill_between(
                x,
                y,
                step="post" if mark.is_step else None,
                alpha=mark.opacity,
                color=look["color"],
                linewidth=0,
            )
        if mark.arrow:
            _arrowhead(axes, np.asarray(mark.x, float), np.asarray(mark.y, float), mark)
    return _line_handle(mark.colour, mark.style, mark.width, mark.opacity)


def _arrowhead(axes: Any, x: np.ndarray, y: np.ndarray, mark: charts.Curve) -> None:
    """An arrowhead where a third of the way on the panel is done."""
    finite = np.isfinite(x) & np.isfinite(y)
    x, y = x[finite], y[finite]
    if len(x) < 3:
        return
    steps = [np.diff(values) / (float(np.ptp(values)) or 1.0) for values in (x, y)]
    length = np.concatenate([[0.0], np.cumsum(np.hypot(*steps))])
    if not length[-1] > 0:
        return
    k = int(np.clip(np.searchsorted(length, 0.3 * length[-1]), 1, len(x) - 1))
    # Points may lie close: the direction is that over some stretch.
    before = int(np.clip(np.searchsorted(length, length[k] - 0.02 * length[-1]), 0, k - 1))
    axes.annotate(
        "",
        xy=(x[k], y[k]),
        xytext=(x[before], y[before]),
        arrowprops={
            "arrowstyle": "-|>,head_length=0.75,head_width=0.33",
            "color": _colour(mark.colour),
            "lw": 0.0 if mark.style == "solid" else 0.6,
            "shrinkA": 0,
            "shrinkB": 0,
        },
    )


def _points(axes: Any, mark: charts.Points) -> Handle:
    colour = _colour(mark.colour)
    face: Any = {"unstable": "white", "saddle": "white"}.get(mark.marker, colour)
    if mark.marker == "cross":
        face = colour
    look = {
        "marker": _SHAPES[mark.marker],
        "markersize": mark.size * (1.7 if mark.marker == "star" else 1.0),
        "color": colour,
        "markerfacecolor": face,
        "markeredgecolor": colour,
        "markeredgewidth": 1.4
        if mark.marker in ("unstable", "saddle", "cross")
        else 0.8 * (mark.size > 3),
        "linestyle": "none",
        "alpha": mark.opacity,
    }
    if mark.step_shape:
        step_style = "steps-post" if mark.step_shape == "hv" else "steps-pre"
        axes.plot(mark.x, mark.y, color=colour, linewidth=1.0, drawstyle=step_style, zorder=4)
    if mark.reach is not None:
        axes.errorbar(mark.x, mark.y, xerr=mark.reach, color=colour, linestyle="none", zorder=4)
    where = (mark.x, mark.y) if mark.z is None else (mark.x, mark.y, mark.z)
    axes.plot(*where, zorder=5, **look)
    for place in zip(mark.names, *where, strict=False):
        name, *at = place
        if mark.z is not None:
            axes.text(*at, f"   {name}", fontsize=8, color=INK, zorder=10, bbox=_PAPER)
            continue
        axes.annotate(
            name,
            at,
            xytext=(6, 5),
            textcoords="offset points",
            fontsize=8,
            color=INK,
            zorder=6,
            bbox=_PAPER,
            annotation_clip=True,
        )
    return Handle(Line2D([], [], **look), ("points", mark.marker, mark.colour))


def _flow(axes: Any, mark: charts.Flow) -> None:
    axes.streamplot(
        np.asarray(mark.x, float),
        np.asarray(mark.y, float),
        mark.u,
        mark.v,
        color=to_rgba(_colour(mark.colour), 0.45),
        linewidth=0.6,
        arrowsize=0.7,
        density=mark.density,
        zorder=1,
    )


def _contour(axes: Any, mark: charts.Contour) -> Handle:
    contours = axes.contour(
        mark.x,
        mark.y,
        np.ma.masked_invalid(mark.values),
        levels=sorted(mark.levels),
        colors=[_colour(mark.colour)],
        linestyles=[_DASHES[mark.style]],
        linewidths=mark.width,
    )
    if mark.numbers:
        axes.clabel(contours, fontsize=7, fmt=_level, inline_spacing=2)
    return _line_handle(mark.colour, mark.style, mark.width)


def _level(value: float) -> str:
    """A level with a minus that is as wide as a digit, not a hyphen that the line hides."""
    return f"{value:.3g}".replace("-", "−")


def _region(axes: Any, mark: charts.Region) -> Handle:
    colour = to_rgba(_colour(mark.colour), mark.opacity)
    if np.any(mark.inside):
        axes.contourf(
            mark.x,
            mark.y,
            np.asarray(mark.inside, float),
            levels=[0.5, 1.5],
            colors=[colour],
            zorder=0.5,
        )
    return Handle(Patch(facecolor=colour), ("patch", mark.colour, round(mark.opacity, 2)))


def _band(axes: Any, mark: charts.Band) -> Handle:
    colour = to_rgba(_colour(mark.colour), mark.opacity)
    axes.fill_between(mark.x, mark.lower, mark.upper, color=colour, linewidth=0, zorder=0.5)
    return Handle(Patch(facecolor=colour), ("patch", mark.colour, round(mark.opacity, 2)))


def _line(axes: Any, mark: charts.Line) -> Handle:
    look = {
        "color": _colour(mark.colour),
        "linestyle": _DASHES[mark.style],
        "linewidth": line_scale(),
        "label": mark.label or None,
    }
    if mark.x is not None:
        axes.axvline(mark.x, zorder=0.8, **look)
    if mark.y is not None:
        axes.axhline(mark.y, zorder=0.8, **look)
    return _line_handle(mark.colour, mark.style, 1.0)


def _events(axes: Any, mark: charts.Events) -> Handle:
    look: Any = {"marker": "v", "color": _colour(mark.colour), "markersize": 5, "linestyle": "none"}
    high = np.full(len(mark.times), 0.9)
    axes.plot(mark.times, high, transform=axes.get_xaxis_transform(), zorder=5, **look)
    return Handle(Line2D([], [], **look), ("points", "down", mark.colour))


def _boxes(axes: Any, mark: charts.Boxes) -> None:
    parts = [
        {"whislo": low, "q1": first, "med": middle, "q3": third, "whishi": high}
        for low, first, middle, third, high in mark.quantiles
    ]
    axes.bxp(
        parts,
        positions=list(mark.places),
        widths=mark.width,
        showfliers=False,
        vert=not mark.across,
        manage_ticks=False,
    )


def _note(axes: Any, mark: charts.Note) -> None:
    axes.annotate(
        mark.text,
        (mark.x, mark.y),
        fontsize=8,
        color=_colour(mark.colour),
        zorder=6,
        annotation_clip=True,
    )


def _bars(axes: Any, mark: charts.Bars) -> None:
    places = np.arange(len(mark.names))
    colours = [_colour(name) for name in mark.colours or ["blue"] * len(places)]
    axes.barh(places, mark.values, height=0.62, color=colours, zorder=2)
    if mark.spread is not None:
        look = {"color": INK, "linewidth": 1.0, "capsize": 2.5, "linestyle": "none"}
        axes.errorbar(mark.values, places, xerr=mark.spread, zorder=3, **look)
    for place, text in zip(places, mark.notes, strict=False):
        beside = axes.get_yaxis_transform()
        axes.text(1.01, place, text, transform=beside, va="center", fontsize=8, color=INK)
    axes.set_yticks(places, mark.names)
    axes.set_ylim(len(places) - 0.5, -0.5)
    axes.grid(axis="y", visible=False)
    axes.axvline(0.0, color=GREY, linewidth=0.8)
