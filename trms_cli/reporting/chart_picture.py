"""Draws a :class:`trms_cli.core.chart.Chart` in the look of the house."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from matplotlib.transforms import ScaledTranslation

from trms_cli.core.chart import Axis, Chart, Panel
from trms_cli.reporting.chart_marks import Handle, draw_mark
from trms_cli.reporting.style import GREY, GROUND, new_figure

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


def picture_of(chart: Chart) -> Figure:
    """The figure, to be called within :func:`trms_cli.reporting.style.house_style`."""
    columns = max(1, min(chart.columns, len(chart.panels)))
    rows = math.ceil(len(chart.panels) / columns)
    width = max(chart.width * columns, 3.0)
    heights = [
        max(panel.row_height or 1.0 for panel in chart.panels[columns * i : columns * (i + 1)])
        for i in range(rows)
    ]
    figure = new_figure(width, chart.height * sum(heights))
    margins: dict[str, float] = {}
    crowded = len(chart.panels) > _CROWDED
    if crowded:  # to arrange themselves takes such panels longer than to draw them
        figure.set_layout_engine("none")
        titled = any(panel.title for panel in chart.panels)
        margins = _margins(width, chart.height * sum(heights), titled=titled)
    grid = figure.add_gridspec(rows, columns, height_ratios=heights, **margins)
    legends: list[dict[str, Handle]] = []
    places: list[Axes] = []
    for number, panel in enumerate(chart.panels):
        projection = None if panel.z is None else "3d"
        shared = places[0] if chart.together and places else None
        axes = figure.add_subplot(
            grid[divmod(number, columns)], projection=projection, sharex=shared
        )
        legends.append(_draw_panel(axes, panel))
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


def _margins(width: float, height: float, *, titled: bool) -> dict[str, float]:
    """Of a grid of many panels, as shares of the figure: room for labels and one legend."""
    return {
        "left": 0.75 / width,
        "right": 1 - 0.1 / width,
        "bottom": 0.75 / height,
        "top": 1 - 0.4 / height,
        "wspace": 0.36,
        "hspace": 0.6 if titled else 0.25,
    }


def _draw_panel(axes: Any, panel: Panel) -> dict[str, Handle]:
    """Draw everything; what the legend shows, by label."""
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
        if handle is not None and label and label not in handles:
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
    if panel.equal:
        axes.set_aspect("equal", adjustable="datalim")
    return handles


def _set_axis(axes: Any, name: str, axis: Axis) -> None:
    label = f"{axis.label} [{axis.unit}]" if axis.unit else axis.label
    pad = {} if not hasattr(axes, "zaxis") else {"labelpad": 2.0}
    getattr(axes, f"set_{name}label")(label, **pad)
    if axis.log:
        getattr(axes, f"set_{name}scale")("log")


def _set_ticks(axes: Any, name: str, axis: Axis) -> None:
    side = getattr(axes, f"{name}axis")
    if axis.ticks:
        side.set_ticks(axis.ticks, [f"{tick:g}" for tick in axis.ticks])
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
    """Whether no look means two things in different panels."""
    looks: dict[object, str] = {}
    for legend in legends:
        for label, handle in legend.items():
            if looks.setdefault(handle.look, label) != label:
                return False
    labels = {label for legend in legends for label in legend}
    same: dict[str, object] = {}
    for legend in legends:
        for label, handle in legend.items():
            if same.setdefault(label, handle.look) != handle.look:
                return False
    return len(labels) <= 10


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
