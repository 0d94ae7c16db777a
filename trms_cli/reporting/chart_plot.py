"""A :class:`trms_cli.core.chart.Chart` for a page: what a reader zooms, pans and points at.

The other back end is :mod:`trms_cli.reporting.chart_picture`: both draw the same data. Stream
lines and level lines are worked out here, once, so that the browser draws plain curves.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from trms_cli.core import wording
from trms_cli.core.chart import (
    Axis,
    Band,
    Chart,
    Contour,
    Curve,
    Flow,
    Line,
    Mark,
    Note,
    Panel,
    Points,
    Region,
    Span,
)
from trms_cli.reporting.interactive import (
    FloatArray,
    Plot,
    band,
    packed,
    plot_text,
    significant,
    thinned,
)

_DASHES = {"solid": "solid", "dashed": "dash", "dotted": "dot"}
_SYMBOLS = {
    "stable": "circle",
    "unstable": "circle-open",
    "saddle": "diamond-open",
    "star": "star",
    "dot": "circle",
    "cross": "x",
    "square": "square",
    "triangle": "triangle-up",
}
#: Pixels for an inch of paper.
_PIXELS = 80
_ARROW = 9.0  # pixels
_HOVER = "%{x:.4g}, %{y:.4g}"


def plots_of(chart: Chart) -> list[Plot] | None:
    """A plot a panel, two of them side by side; None for a chart with a panel of three axes."""
    if any(panel.z is not None for panel in chart.panels):
        return None
    half = chart.columns > 1 and len(chart.panels) > 1
    plots = [_Drawing(panel).plot(half, chart.height) for panel in chart.panels]
    if plots:
        plots[-1].caption = chart.caption
    return plots


@dataclass
class _Drawing:
    """A panel while it is drawn."""

    panel: Panel
    traces: list[dict[str, Any]] = field(default_factory=list)
    shapes: list[dict[str, Any]] = field(default_factory=list)
    notes: list[dict[str, Any]] = field(default_factory=list)
    named: set[str] = field(default_factory=set)

    def plot(self, half: bool, height: float) -> Plot:
        for mark in self.panel.marks:
            self._draw(mark)
        layout: dict[str, Any] = {
            "xaxis": _axis(self.panel.x),
            "yaxis": _axis(self.panel.y),
            "shapes": self.shapes,
            "annotations": self.notes,
            "showlegend": bool(self.named),
        }
        if self.panel.equal:
            layout["yaxis"] |= {"scaleanchor": "x"}
        pixels = max(round(_PIXELS * height), 220) + 20 * math.ceil(len(self.named) / 3)
        return Plot(
            self.panel.title, self.traces, layout, half=half, height=pixels,
            group=self.panel.x.linked,
        )  # fmt: skip

    def _draw(self, mark: Mark) -> None:
        match mark:
            case Curve():
                x, y = thinned(mark.x, mark.y)
                self._line(x, y, mark, mark.width, held=mark.held, arrows=_third(x, y, mark))
            case Points():
                self._points(mark)
            case Flow():
                x, y, arrows = _stream_lines(mark)
                trace = self._line(x, y, mark, 0.8, arrows=arrows)
                trace |= {"opacity": 0.55, "hoverinfo": "skip"}
            case Contour():
                for level in sorted(mark.levels):
                    x, y = _level_lines(mark, level)
                    trace = self._line(x, y, mark, mark.width)
                    if mark.numbers:
                        trace["hovertemplate"] = f"{wording.number(float(level))}"
            case Region():
                self._region(mark)
            case Band():
                shaded = band(mark.x, mark.lower, mark.upper, mark.label, f"@{mark.colour}")
                self.traces.append(shaded | self._legend(mark) | {"opacity": mark.opacity})
            case Span():
                self.shapes.append(
                    {
                        "type": "rect", "xref": "x", "x0": mark.begin, "x1": mark.end,
                        "yref": "paper", "y0": 0, "y1": 1, "layer": "below",
                        "fillcolor": f"@{mark.colour}", "opacity": mark.opacity,
                        "line": {"width": 0},
                    }
                )  # fmt: skip
            case Line():
                self._across(mark)
            case Note():
                self.notes.append(
                    {
                        "x": _place(mark.x, self.panel.x), "y": _place(mark.y, self.panel.y),
                        "text": plot_text(mark.text), "showarrow": False, "xanchor": "left",
                        "yanchor": "bottom", "font": {"color": f"@{mark.colour}", "size": 11},
                    }
                )  # fmt: skip

    def _legend(self, mark: Mark) -> dict[str, Any]:
        """Its name, which stands in the legend once; a click hides all of that name."""
        label = getattr(mark, "label", "")
        first = bool(label) and label not in self.named
        if label:
            self.named.add(label)
        shown = plot_text(label)
        return {"name": shown, "legendgroup": shown, "showlegend": first}

    def _line(
        self, x: FloatArray, y: FloatArray, mark: Any, width: float, *,
        held: bool = False, arrows: Sequence[int] = (),
    ) -> dict[str, Any]:  # fmt: skip
        dash = _DASHES[getattr(mark, "style", "solid")]
        trace: dict[str, Any] = {
            "type": "scatter",
            "mode": "lines",
            "x": packed(x),
            "y": packed(y),
            "line": {"color": f"@{mark.colour}", "width": width + 0.2, "dash": dash},
            "hovertemplate": _HOVER,
        } | self._legend(mark)
        if held:
            trace["line"]["shape"] = "hv"
        if len(arrows):
            sizes = np.zeros(len(x))
            sizes[list(arrows)] = _ARROW
            trace["mode"] = "lines+markers"
            trace["marker"] = {
                "symbol": "arrow", "angleref": "previous", "size": packed(sizes),
                "color": f"@{mark.colour}", "line": {"width": 0},
            }  # fmt: skip
        self.traces.append(trace)
        return trace

    def _points(self, mark: Points) -> None:
        trace: dict[str, Any] = {
            "type": "scatter",
            "mode": "markers",
            "x": packed(mark.x),
            "y": packed(mark.y),
            "marker": {
                "color": f"@{mark.colour}",
                "size": 1.4 * mark.size,
                "symbol": _SYMBOLS[mark.marker],
            },
            "hovertemplate": _HOVER,
        } | self._legend(mark)
        if any(mark.names):
            trace |= {
                "mode": "markers+text",
                "text": [plot_text(name) for name in mark.names],
                "textposition": "top right",
                "cliponaxis": False,
            }
        self.traces.append(trace)

    def _region(self, mark: Region) -> None:
        if not np.any(mark.inside):
            return
        self.traces.append(
            {
                "type": "contour",
                "x": packed(mark.x),
                "y": packed(mark.y),
                "z": np.asarray(mark.inside, dtype=int).tolist(),
                "contours": {"type": "constraint", "operation": "<", "value": 0.5},
                "fillcolor": f"@{mark.colour}",
                "opacity": mark.opacity,
                "line": {"width": 0},
                "showscale": False,
                "hoverinfo": "skip",
            }
            | self._legend(mark)
        )

    def _across(self, mark: Line) -> None:
        look = {"color": f"@{mark.colour}", "width": 1, "dash": _DASHES[mark.style]}
        if mark.x is not None:
            ends = {"xref": "x", "x0": mark.x, "x1": mark.x, "yref": "paper", "y0": 0, "y1": 1}
            self.shapes.append({"type": "line", "layer": "below", "line": look} | ends)
        if mark.y is not None:
            ends = {"xref": "paper", "x0": 0, "x1": 1, "yref": "y", "y0": mark.y, "y1": mark.y}
            self.shapes.append({"type": "line", "layer": "below", "line": look} | ends)
        if mark.label and mark.label not in self.named:
            # a shape has no name: an empty curve of the same look has it
            nothing = {"type": "scatter", "mode": "lines", "x": [None], "y": [None], "line": look}
            self.traces.append(nothing | self._legend(mark))


def _axis(axis: Axis) -> dict[str, Any]:
    told: dict[str, Any] = {"title": {"text": plot_text(wording.titled(axis.label, axis.unit))}}
    if axis.log:
        told |= {"type": "log", "exponentformat": "power"}
    if axis.limits is not None:
        told["range"] = [
            None if edge is None else significant(_place(edge, axis)) for edge in axis.limits
        ]
    return told


def _place(value: float, axis: Axis) -> float:
    """Where a value lies in the units of ranges and notes, which are powers on a log axis."""
    return math.log10(value) if axis.log and value > 0 else value


def _third(x: FloatArray, y: FloatArray, mark: Curve) -> list[int]:
    """Where an arrowhead stands on a curve: after about a third of its way."""
    if not mark.arrow or len(x) < 3:
        return []
    steps = [np.diff(values) / (float(np.nanmax(values) - np.nanmin(values)) or 1.0)
             for values in (x, y)]  # fmt: skip
    length = np.concatenate([[0.0], np.cumsum(np.nan_to_num(np.hypot(*steps)))])
    if not length[-1] > 0:
        return []
    return [int(np.clip(np.searchsorted(length, 0.3 * length[-1]), 1, len(x) - 1))]


def _stream_lines(flow: Flow) -> tuple[FloatArray, FloatArray, list[int]]:
    """Stream lines as one broken curve, and the places of their arrowheads."""
    from matplotlib.figure import Figure

    drawn = Figure().add_subplot().streamplot(
        np.asarray(flow.x, float), np.asarray(flow.y, float), flow.u, flow.v, density=flow.density
    )  # fmt: skip
    xs, ys, arrows, count = [], [], [], 0
    for line in _joined(drawn.lines.get_segments()):
        xs += [line[:, 0], [np.nan]]
        ys += [line[:, 1], [np.nan]]
        arrows.append(count + len(line) // 2)
        count += len(line) + 1
    return np.concatenate([[], *xs]), np.concatenate([[], *ys]), arrows


def _joined(segments: Sequence[Any]) -> Iterator[FloatArray]:
    """Pieces that follow one another as lines."""
    line: list[Any] = []
    for segment in segments:
        if line and not np.allclose(line[-1], segment[0]):
            yield np.asarray(line)
            line = []
        line += list(segment[1:] if line else segment)
    if line:
        yield np.asarray(line)


def _level_lines(contour: Contour, level: float) -> tuple[FloatArray, FloatArray]:
    """The lines on which a function has a value, as one broken curve."""
    from contourpy import contour_generator

    values = np.ma.masked_invalid(contour.values)
    lines = contour_generator(np.asarray(contour.x), np.asarray(contour.y), values).lines(level)
    gap = np.full((1, 2), np.nan)
    points = np.concatenate([np.zeros((0, 2)), *(part for one in lines for part in (one, gap))])
    return points[:, 0], points[:, 1]
