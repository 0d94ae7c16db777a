"""A :class:`trms_cli.core.chart.Chart` for a page: what a reader zooms, pans and points at.

The other back end is :mod:`trms_cli.reporting.chart_picture`: both draw the same data. A
:class:`Plot` is what plotly.js calls traces and a layout. Colours are named (``@blue``) and become
those of a light or dark page, or of paper, in the reader's browser. Plots of the same `group` share
their time axis there: zooming one zooms all. Stream lines and level lines are worked out here,
once, so that the browser draws plain curves.

Series are packed as single precision (seven digits) and base64, a third of their size as text.
Longer ones than :data:`MOST_POINTS` are thinned: the time is cut into equal numbers of samples, of
which the least and the largest stay, in their order. So no peak is lost, and a drawing up to half
as many pixels wide is the same as one of all samples (Jugel et al., M4: a visualization-oriented
time series data aggregation, VLDB 2014).
"""

import base64
import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from trms_cli.core import chart as charts
from trms_cli.core import wording
from trms_cli.core.arrays import stretches
from trms_cli.core.findings import json_data, round_significant

FloatArray = npt.NDArray[np.float64]

#: Samples of a series that are drawn at most; of one that is no function of x, such as a phase
#: portrait, and of single points.
MOST_POINTS, _MOST_OF_A_PORTRAIT, _MOST_DOTS = 2_000, 3_000, 4_000
#: Of a band, which has two edges and no fine detail worth bytes.
_MOST_OF_A_BAND = 600
#: Single precision tells times apart to a tenth of a millisecond up to here, s.
_LARGEST_SINGLE_TIME = 1_000.0
_LONGEST_TEXT = 200
#: Letters of a name in a legend or beside an axis: as many as fit on a telephone.
_LONGEST_NAME = 28
#: The names of points stand on their left beyond this share of the panel.
_RIGHT_PART = 0.75
_DASHES = {
    "solid": "solid",
    "dashed": "dash",
    "dotted": "dot",
    "dashdot": "dashdot",
    "dashdotdot": "3px,2px,1px,2px,1px,2px",
    "long": "longdash",
}
_SYMBOLS = {
    "stable": "circle",
    "unstable": "circle-open",
    "saddle": "diamond-open",
    "star": "star",
    "dot": "circle",
    "cross": "x",
    "square": "square",
    "triangle": "triangle-up",
    "down": "triangle-down",
    "diamond": "diamond",
}
#: Pixels for an inch of paper.
_PIXELS = 80
_ARROW = 9.0  # pixels
#: What a curve or a point tells, of a place and over the time.
_HOVER, _HOVER_OVER_TIME = "%{x:.4g}, %{y:.4g}", "%{y:.4g}"
#: Colours of values: dark is large.
_SCALE = {"colorscale": "Viridis", "reversescale": True, "colorbar": {"thickness": 12}}


@dataclass
class Plot:
    """A plot."""

    title: str
    traces: list[dict[str, Any]] = field(default_factory=list)  #: As plotly has them
    #: As plotly has it, laid over the look of the house
    layout: dict[str, Any] = field(default_factory=dict)
    caption: str = ""  #: Under the plot; also told to who cannot see it
    group: str = ""  #: Plots of one group share their x axis; "" for none
    height: int = 260  #: Pixels
    half: bool = False  #: Two of them stand side by side where there is room
    #: What else it can show: what the reader chooses, per trace the keys that change, and by axis
    #: its title then; a choice appears over the first plot of a section that has some
    variants: list[dict[str, Any]] = field(default_factory=list)
    #: Predictions of which a slider chooses one: when each was made, where each begins in the trace
    #: of all, and pairs of that trace and of the one that shows the chosen
    fans: dict[str, Any] = field(default_factory=dict)

    def document(self) -> dict[str, Any]:
        """What the page's script gets."""
        content = {
            "group": self.group,
            "height": self.height,
            "traces": self.traces,
            "layout": self.layout,
        }
        content |= {"variants": self.variants} if self.variants else {}
        return content | ({"fans": self.fans} if self.fans else {})


def plots_of(chart: charts.Chart) -> list[Plot] | None:
    """A plot a panel, two of them side by side; None for a chart with a panel of three axes."""
    if any(panel.z is not None for panel in chart.panels):
        return None
    half = chart.columns > 1 and len(chart.panels) > 1
    plots = [_plot(panel, half or panel.half, chart.height) for panel in chart.panels]
    if plots and not plots[-1].caption:
        plots[-1].caption = chart.caption
    return plots


def _plot(panel: charts.Panel, half: bool, height: float) -> Plot:
    plot = _Drawing(panel).plot(half, height * (panel.row_height or 1.0))
    for label, other in panel.variants.items():
        changed = _Drawing(other).plot(half, height)
        titles = {
            axis: changed.layout[axis]["title"]["text"]
            for axis in ("xaxis", "yaxis")
            if changed.layout[axis]["title"] != plot.layout[axis]["title"]
        }
        traces = [
            {key: new[key] for key in new if new[key] != old.get(key)}
            for old, new in zip(plot.traces, changed.traces, strict=True)
        ]
        plot.variants.append({"label": plot_text(label), "traces": traces, "titles": titles})
    return plot


@dataclass
class _Drawing:
    """A panel while it is drawn."""

    panel: charts.Panel
    traces: list[dict[str, Any]] = field(default_factory=list)
    shapes: list[dict[str, Any]] = field(default_factory=list)
    notes: list[dict[str, Any]] = field(default_factory=list)
    labels: set[str] = field(default_factory=set)
    more: dict[str, Any] = field(default_factory=dict)
    fans: dict[str, Any] = field(default_factory=dict)

    @property
    def curves(self) -> set[str]:
        return {mark.label for mark in self.panel.marks if isinstance(mark, charts.Curve)}

    @property
    def hover(self) -> str:
        return _HOVER_OVER_TIME if self.panel.x.linked else _HOVER

    def plot(self, half: bool, height: float) -> Plot:
        for mark in self.panel.marks:
            self._draw(mark)
        layout: dict[str, Any] = {
            "xaxis": _axis(self.panel.x),
            "yaxis": _axis(self.panel.y),
            "shapes": self.shapes,
            "annotations": self.notes,
            "showlegend": bool(self.labels),
        } | self.more
        if self.panel.equal:
            layout["yaxis"] |= {"scaleanchor": "x"}
        if self.panel.y.categories:
            layout["yaxis"] |= {"range": [len(self.panel.y.categories) - 0.3, -0.7]}
        pixels = max(round(_PIXELS * height), 220) + 20 * math.ceil(len(self.labels) / 3)
        return Plot(
            self.panel.title,
            self.traces,
            layout,
            self.panel.caption,
            self.panel.x.linked,
            pixels,
            half,
            fans=self.fans,
        )

    def _draw(self, mark: charts.Mark) -> None:
        match mark:
            case charts.Curve():
                x, y = _thin(mark.x, mark.y)
                trace = self._line(
                    x, y, mark, mark.width, is_step=mark.is_step, arrows=_third(x, y, mark)
                )
                trace |= {"opacity": mark.opacity} if mark.opacity < 1.0 else {}
                if mark.filled:
                    trace |= {"fill": "tozeroy", "fillcolor": f"@{mark.colour}"}
            case charts.Points():
                self._points(mark)
            case charts.Flow():
                x, y, arrows = _stream_lines(mark)
                trace = self._line(x, y, mark, 0.8, arrows=arrows)
                trace |= {"opacity": 0.55, "hoverinfo": "skip"}
            case charts.Contour():
                for level in sorted(mark.levels):
                    x, y = _level_lines(mark, level)
                    trace = self._line(x, y, mark, mark.width)
                    if mark.numbers:
                        trace["hovertemplate"] = f"{wording.number(float(level))}"
            case charts.Region():
                self._region(mark)
            case charts.Band():
                self.traces.append(_band(mark) | self._legend(mark))
            case charts.Span():
                self.shapes.append(
                    {
                        "type": "rect",
                        "xref": "x",
                        "x0": mark.begin,
                        "x1": mark.end,
                        "yref": "paper",
                        "y0": 0,
                        "y1": 1,
                        "layer": "below",
                        "fillcolor": f"@{mark.colour}",
                        "opacity": mark.opacity,
                        "line": {"width": 0},
                    }
                )
            case charts.Line():
                self._across(mark)
            case charts.Note():
                self.notes.append(
                    {
                        "x": _place(mark.x, self.panel.x),
                        "y": _place(mark.y, self.panel.y),
                        "text": plot_text(mark.text),
                        "showarrow": False,
                        "xanchor": "left",
                        "yanchor": "bottom",
                        "font": {"color": f"@{mark.colour}", "size": 11},
                    }
                )
            case charts.Events():
                self._events(mark)
            case charts.Fans():
                self._fans(mark)
            case charts.Bars():
                self._bars(mark)
            case charts.Boxes():
                self._boxes(mark)
            case charts.Heat():
                self._heat(mark)

    def _legend(self, mark: charts.Mark) -> dict[str, Any]:
        """Its name, which stands in the legend once; a click hides all of that name."""
        label = getattr(mark, "label", "")
        first = bool(label) and label not in self.labels
        if isinstance(mark, charts.Band) and label in self.curves:
            first = False  # the curve stands for both
        elif label:
            self.labels.add(label)
        group = {"name": _short_name(label)}
        group |= {"legendgroup": plot_text(label)} if label else {}
        return group if first else group | {"showlegend": False}

    def _line(
        self,
        x: FloatArray,
        y: FloatArray,
        mark: Any,
        width: float,
        *,
        is_step: bool = False,
        arrows: Sequence[int] = (),
    ) -> dict[str, Any]:
        dash = _DASHES[getattr(mark, "style", "solid")]
        trace: dict[str, Any] = {
            "type": "scatter",
            "mode": "lines",
            "x": packed_time(x),
            "y": pack_array(y),
            "line": {"color": f"@{mark.colour}", "width": width + 0.2, "dash": dash},
            "hovertemplate": self.hover,
        } | self._legend(mark)
        if is_step:
            trace["line"]["shape"] = "hv"
        if len(arrows):
            sizes = np.zeros(len(x))
            sizes[list(arrows)] = _ARROW
            trace["mode"] = "lines+markers"
            trace["marker"] = {
                "symbol": "arrow",
                "angleref": "previous",
                "size": pack_array(sizes),
                "color": f"@{mark.colour}",
                "line": {"width": 0},
            }
        self.traces.append(trace)
        return trace

    def _sides(self, x: FloatArray) -> list[str]:
        """Where the names of points stand: those on the right of the panel on their left."""
        places = [np.asarray(mark.x, dtype=float) for mark in self.panel.marks
                  if isinstance(mark, charts.Curve | charts.Points)]  # fmt: skip
        finite = np.concatenate([x, *places])
        finite = finite[np.isfinite(finite)]
        low, high = (finite.min(), finite.max()) if finite.size else (0.0, 1.0)
        low, high = (
            own if end is None else end
            for end, own in zip(self.panel.x.limits or (None, None), (low, high), strict=True)
        )
        edge = low + _RIGHT_PART * (high - low)
        return ["top left" if value > edge else "top right" for value in x]

    def _points(self, mark: charts.Points) -> None:
        x, y = np.asarray(mark.x, dtype=float), np.asarray(mark.y, dtype=float)
        if self.panel.x.linked and not mark.tooltips:
            x, y = thin_samples(x, y, _MOST_DOTS)
        marker: dict[str, Any] = {
            "color": f"@{mark.colour}",
            "size": 1.4 * mark.size,
            "symbol": _SYMBOLS[mark.marker],
        }
        marker |= {"opacity": mark.opacity} if mark.opacity < 1.0 else {}
        trace: dict[str, Any] = {
            "type": "scatter",
            "mode": "markers",
            "x": packed_time(x),
            "y": pack_array(y),
            "marker": marker,
            "hovertemplate": self.hover,
        } | self._legend(mark)
        if mark.label and mark.size < 3:  # specks could not be told apart in the legend
            self.more["legend"] = {"itemsizing": "constant"}
        if any(mark.names):
            trace |= {
                "mode": "markers+text",
                "text": [plot_text(name) for name in mark.names],
                "textposition": self._sides(x),
                "cliponaxis": False,
            }
        if mark.tooltips:
            trace |= {"text": [plot_text(text) for text in mark.tooltips]}
            place = "%{x:.4g}" if self.panel.y.categories else "%{x:.4g}, %{y:.4g}"
            trace["hovertemplate"] = f"%{{text}}: {place}<extra></extra>"
        if mark.step_shape:
            line = {"color": f"@{mark.colour}", "width": 1.2, "shape": mark.step_shape}
            trace |= {"mode": "lines+markers", "line": line}
        if mark.reach is not None:
            left, right = (np.asarray(ends, dtype=float).tolist() for ends in mark.reach)
            trace["error_x"] = {
                "type": "data",
                "symmetric": False,
                "array": right,
                "arrayminus": left,
                "color": f"@{mark.colour}",
            }
        if mark.values is not None:
            trace["marker"] |= {
                "color": [round_significant(float(value), 6) for value in mark.values],
                "coloraxis": "coloraxis",
            }
            self.more["coloraxis"] = _SCALE
            trace["hovertemplate"] = "%{text}: %{marker.color:.4g}<extra></extra>"
        self.traces.append(trace)

    def _events(self, mark: charts.Events) -> None:
        """At the upper edge whatever the range of the other curves is: on an axis of their own."""
        look = {"color": f"@{mark.colour}", "width": 1, "dash": "dot"}
        for time in np.asarray(mark.times, dtype=float).tolist():
            ends = {"xref": "x", "x0": time, "x1": time, "yref": "paper", "y0": 0, "y1": 1}
            self.shapes.append({"type": "line", "layer": "below", "line": look} | ends)
        self.more["yaxis2"] = {
            "overlaying": "y",
            "range": [0, 1],
            "visible": False,
            "fixedrange": True,
        }
        self.traces.append(
            {
                "type": "scatter",
                "mode": "markers",
                "x": packed_time(mark.times),
                "y": pack_array(np.full(len(mark.times), 0.97)),
                "yaxis": "y2",
                "marker": {"color": f"@{mark.colour}", "size": 9, "symbol": "triangle-down"},
                "text": [plot_text(text) for text in mark.tooltips],
                "hovertemplate": "%{text}" if mark.tooltips else "%{x:.4g}",
            }
            | self._legend(mark)
        )

    def _fans(self, mark: charts.Fans) -> None:
        number = len(self.traces)
        every = self._line(
            np.asarray(mark.x, dtype=float),
            np.asarray(mark.y, dtype=float),
            charts.Curve((), (), mark.label, "ink"),
            0.4,
            is_step=mark.is_step,
        )
        name = plot_text(f"chosen {mark.label.removesuffix('s')}")
        line = every["line"] | {"color": "@vermilion", "width": 3.0}
        nothing = pack_array(np.zeros(0))
        highlight = {"name": name, "legendgroup": name, "x": nothing, "y": nothing, "line": line}
        every["hoverinfo"] = "skip"
        del every["hovertemplate"]
        self.traces.append(every | highlight)
        self.fans = {
            "times": [round(float(time), 6) for time in mark.times],
            "starts": mark.starts,
            "pairs": [[number, number + 1]],
        }

    def _bars(self, mark: charts.Bars) -> None:
        self.more["yaxis"] = _axis(self.panel.y) | _places(mark.names)
        self.traces.append(
            {
                "type": "bar",
                "orientation": "h",
                "x": pack_array(mark.values),
                "y": list(range(len(mark.names))),
                "hovertemplate": "%{x:.4g}<extra></extra>",
                "marker": {"color": [f"@{name}" for name in mark.colours] or "@blue"},
                "text": [plot_text(note) for note in mark.notes],
            }
        )

    def _boxes(self, mark: charts.Boxes) -> None:
        own, quantity = ("y", "x") if mark.across else ("x", "y")
        colours = list(mark.colours) * (len(mark.places) if len(mark.colours) == 1 else 1)
        for place, quantiles, colour in zip(mark.places, mark.quantiles, colours, strict=True):
            ends = ("lowerfence", "q1", "median", "q3", "upperfence")
            summary = {
                key: [round_significant(float(value), 6)]
                for key, value in zip(ends, quantiles, strict=True)
            }
            self.traces.append(
                {
                    "type": "box",
                    "orientation": "h" if mark.across else "v",
                    own: [float(place)],
                    "line": {"color": f"@{colour}", "width": 1.4},
                    "hoverinfo": quantity,
                    "width": mark.width,
                }
                | summary
                | self._legend(mark)
            )

    def _heat(self, mark: charts.Heat) -> None:
        values = np.asarray(mark.values, float).tolist()
        rows = [[round_significant(value, 6) for value in row] for row in values]
        across, up = (
            [plot_text(name) for name in axis.categories] for axis in (self.panel.x, self.panel.y)
        )
        self.more = {
            name: _axis(axis) | {"type": "category"}
            for name, axis in (("xaxis", self.panel.x), ("yaxis", self.panel.y))
        }
        self.traces.append(
            {
                "type": "heatmap",
                "x": across,
                "y": up,
                "z": rows,
                "hovertemplate": "%{x}, %{y}: %{z:.4g}<extra></extra>",
            }
            | _SCALE
        )

    def _region(self, mark: charts.Region) -> None:
        if not np.any(mark.inside):
            return
        self.traces.append(
            {
                "type": "contour",
                "x": pack_array(mark.x),
                "y": pack_array(mark.y),
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

    def _across(self, mark: charts.Line) -> None:
        look = {"color": f"@{mark.colour}", "width": 1, "dash": _DASHES[mark.style]}
        if mark.x is not None:
            ends = {"xref": "x", "x0": mark.x, "x1": mark.x, "yref": "paper", "y0": 0, "y1": 1}
            self.shapes.append({"type": "line", "layer": "below", "line": look} | ends)
        if mark.y is not None:
            ends = {"xref": "paper", "x0": 0, "x1": 1, "yref": "y", "y0": mark.y, "y1": mark.y}
            self.shapes.append({"type": "line", "layer": "below", "line": look} | ends)
        if mark.label and mark.label not in self.labels:
            # a shape has no name: an empty curve of the same look has it
            nothing = {"type": "scatter", "mode": "lines", "x": [None], "y": [None], "line": look}
            self.traces.append(nothing | self._legend(mark))


def _axis(axis: charts.Axis) -> dict[str, Any]:
    layout: dict[str, Any] = {
        "title": {"text": plot_text(wording.with_unit(axis.label, axis.unit))}
    }
    layout |= _places(axis.categories) if axis.categories else {}
    if axis.ticks:  # figures as they are (0.1, 1, 10) instead of powers
        layout |= {"tickvals": list(axis.ticks)}
    if axis.log:
        layout |= {"type": "log", "exponentformat": "none" if axis.ticks else "power"}
    if axis.limits is not None:
        layout["range"] = [
            None if edge is None else round_significant(_place(edge, axis), 9)
            for edge in axis.limits
        ]
    return layout


def _places(names: Sequence[str]) -> dict[str, Any]:
    """Names at the places 0, 1, … of an axis."""
    return {
        "tickvals": list(range(len(names))),
        "ticktext": [_short_name(name) for name in names],
        "zeroline": False,
    }


def _place(value: float, axis: charts.Axis) -> float:
    """Where a value lies in the units of ranges and notes, which are powers on a log axis."""
    return math.log10(value) if axis.log and value > 0 else value


def _thin(x: Any, y: Any) -> tuple[FloatArray, FloatArray]:
    """A series with its peaks where x rises, else every k-th point of it."""
    x, y = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
    if len(x) > MOST_POINTS and np.any(np.diff(x) < 0):
        step = math.ceil(len(x) / _MOST_OF_A_PORTRAIT)
        return x[::step], y[::step]
    return thin_samples(x, y)


def _band(mark: charts.Band) -> dict[str, Any]:
    """An area between two curves; none where one of them is not finite."""
    x, bottoms, tops = _outline(mark.x, mark.lower, mark.upper)
    closed = [
        piece
        for bottom, top in zip(bottoms, tops, strict=True)
        for piece in (top, bottom[::-1], np.array([np.nan]))
    ]
    return {
        "type": "scatter",
        "mode": "lines",
        "x": packed_time(x),
        "y": pack_array(np.concatenate([[], *closed])),
        "line": {"width": 0},
        "fill": "toself",
        "fillcolor": f"@{mark.colour}",
        "opacity": mark.opacity,
        "hoverinfo": "skip",
    }


def _third(x: FloatArray, y: FloatArray, mark: charts.Curve) -> list[int]:
    """Where an arrowhead stands on a curve: after about a third of its way."""
    if not mark.arrow or len(x) < 3:
        return []
    steps = [
        np.diff(values) / (float(np.nanmax(values) - np.nanmin(values)) or 1.0) for values in (x, y)
    ]
    length = np.concatenate([[0.0], np.cumsum(np.nan_to_num(np.hypot(*steps)))])
    if not length[-1] > 0:
        return []
    return [int(np.clip(np.searchsorted(length, 0.3 * length[-1]), 1, len(x) - 1))]


def _stream_lines(flow: charts.Flow) -> tuple[FloatArray, FloatArray, list[int]]:
    """Stream lines as one broken curve, and the places of their arrowheads."""
    from matplotlib.figure import Figure

    streams = (
        Figure()
        .add_subplot()
        .streamplot(
            np.asarray(flow.x, float),
            np.asarray(flow.y, float),
            flow.u,
            flow.v,
            density=flow.density,
        )
    )
    xs, ys, arrows, count = [], [], [], 0
    for line in _join_segments(streams.lines.get_segments()):
        xs += [line[:, 0], [np.nan]]
        ys += [line[:, 1], [np.nan]]
        arrows.append(count + len(line) // 2)
        count += len(line) + 1
    return np.concatenate([[], *xs]), np.concatenate([[], *ys]), arrows


def _join_segments(segments: Sequence[Any]) -> Iterator[FloatArray]:
    """Pieces that follow one another as lines."""
    line: list[Any] = []
    for segment in segments:
        if line and not np.allclose(line[-1], segment[0]):
            yield np.asarray(line)
            line = []
        line += list(segment[1:] if line else segment)
    if line:
        yield np.asarray(line)


def _level_lines(contour: charts.Contour, level: float) -> tuple[FloatArray, FloatArray]:
    """The lines on which a function has a value, as one broken curve."""
    from contourpy import contour_generator

    values = np.ma.masked_invalid(contour.values)
    lines = contour_generator(np.asarray(contour.x), np.asarray(contour.y), values).lines(level)
    gap = np.full((1, 2), np.nan)
    points = np.concatenate([np.zeros((0, 2)), *(part for one in lines for part in (one, gap))])
    return points[:, 0], points[:, 1]


def thin_samples(time: Any, values: Any, most: int = MOST_POINTS) -> tuple[FloatArray, FloatArray]:
    """At most about `most` samples; of each piece the least and the largest, in their order.

    Gaps (values that are not finite) stay: a piece that has one keeps it.
    """
    time, values = np.asarray(time, dtype=float), np.asarray(values, dtype=float)
    count = min(len(time), len(values))
    time, values = time[:count], values[:count]
    if count <= most:
        return time, values
    size = math.ceil(2 * count / most)
    pieces = math.ceil(count / size)
    padded = np.full(pieces * size, np.nan)
    padded[:count] = values
    table = padded.reshape(pieces, size)
    finite = np.isfinite(table)
    least = np.argmin(np.where(finite, table, np.inf), axis=1)
    largest = np.argmax(np.where(finite, table, -np.inf), axis=1)
    within = np.arange(pieces * size).reshape(pieces, size) < count
    hollow = ~finite & within
    gap = np.where(hollow.any(axis=1), np.argmax(hollow, axis=1), least)
    first = np.arange(pieces) * size
    indices = np.unique(np.concatenate([first + least, first + largest, first + gap]))
    indices = indices[indices < count]
    return time[indices], values[indices]


def pack_array(values: Any) -> dict[str, str]:
    """An array as plotly reads it: single precision, base64."""
    with np.errstate(over="ignore"):
        single = np.asarray(values, dtype="<f4")
    return {"dtype": "f4", "bdata": base64.b64encode(single.tobytes()).decode("ascii")}


def packed_time(values: Any) -> dict[str, str]:
    """Times, in double precision where single would blur them."""
    times = np.asarray(values, dtype=float)
    finite = times[np.isfinite(times)]
    if not finite.size or np.abs(finite).max() <= _LARGEST_SINGLE_TIME:
        return pack_array(times)
    return {"dtype": "f8", "bdata": base64.b64encode(times.astype("<f8").tobytes()).decode("ascii")}


def _short_name(label: str) -> str:
    """A name in a legend or beside an axis, on a telephone too: of a long one its two ends."""
    if len(label) > _LONGEST_NAME:
        half = _LONGEST_NAME // 2
        label = f"{label[: half - 1]}…{label[-half:]}"
    return plot_text(label)


def plot_text(text: Any) -> str:
    """Text that plotly shows as it stands: it takes ``<b>`` and ``<a href>`` for markup else."""
    content = str(text)
    if len(content) > _LONGEST_TEXT:
        content = content[: _LONGEST_TEXT - 1] + "…"
    # A per cent sign before a brace would be a placeholder of a hover text.
    content = content.replace("%{", "%\u200b{").replace("\n", " ")
    return content.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")


def script_json(value: Any) -> str:
    """JSON that can stand inside a ``<script>`` element, whatever text it holds.

    Nothing in it ends the element or opens a comment, and it is valid JavaScript too. What is not
    finite is null.
    """
    text = json.dumps(json_data(value), ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    for sign, code in (
        ("<", "\\u003c"),
        (">", "\\u003e"),
        ("&", "\\u0026"),
        ("\u2028", "\\u2028"),
        ("\u2029", "\\u2029"),
    ):
        text = text.replace(sign, code)
    # A lone surrogate, as a damaged text may hold, cannot be written as UTF-8.
    return text.encode("utf-8", "replace").decode("utf-8")


def _outline(
    time: Any, low: Any, high: Any
) -> tuple[FloatArray, list[FloatArray], list[FloatArray]]:
    """Pieces between gaps, thinned: their times there and back, and both edges."""
    time, low, high = (np.asarray(each, dtype=float) for each in (time, low, high))
    count = min(len(time), len(low), len(high))
    size = max(1, math.ceil(count / _MOST_OF_A_BAND))
    inside = np.isfinite(low[:count]) & np.isfinite(high[:count])
    there: list[FloatArray] = []
    bottoms, tops = [], []
    for begin, end in stretches(inside):
        cuts = np.arange(begin, end, size)
        at = np.append(time[cuts], time[end - 1])
        bottom = np.minimum.reduceat(low[:end], cuts)
        top = np.maximum.reduceat(high[:end], cuts)
        bottom, top = np.append(bottom, bottom[-1]), np.append(top, top[-1])
        there += [at, at[::-1], np.array([np.nan])]
        bottoms.append(bottom)
        tops.append(top)
    return np.concatenate([[], *there]), bottoms, tops
