"""Plots that a reader of a page zooms, pans and points at: specifications for plotly.js.

A :class:`Plot` is plain data: what plotly calls traces and a layout. Colours are named (``@blue``)
and become those of a light or dark page, or of paper, in the reader's browser. Plots of the same
`group` share their time axis there: zooming one zooms all.

Series are packed as single precision (seven digits) and base64, a third of their size as text.
Longer ones than :data:`MOST_POINTS` are thinned: the time is cut into equal numbers of samples, of
which the least and the largest stay, in their order. So no peak is lost, and a drawing up to half
as many pixels wide is the same as one of all samples (Jugel et al., M4: a visualization-oriented
time series data aggregation, VLDB 2014).
"""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

#: Samples of a series that are drawn at most.
MOST_POINTS = 2_000
#: Of a band, which has two edges and no fine detail worth bytes.
_MOST_OF_A_BAND = 600
#: Single precision tells times apart to a tenth of a millisecond up to here, s.
_LARGEST_SINGLE_TIME = 1_000.0
_LONGEST_TEXT = 200

#: Names of colours that the page's script knows (those of :mod:`trms_cli.reporting.style`, with
#: lighter ones on a dark ground), in the order in which curves take them.
CURVES = ("@blue", "@vermilion", "@green", "@purple", "@orange", "@sky")
INK, GREY, PALE, ALARM = "@ink", "@grey", "@pale", "@alarm"
_DASHES = ("solid", "dash", "dot", "dashdot")


@dataclass(frozen=True)
class Variant:
    """Another figure that the same plot can show."""

    label: str  #: What the reader chooses
    traces: Sequence[Mapping[str, Any]]  #: Per trace of the plot, the keys that change (``y``)
    #: By axis (``xaxis``, ``yaxis``), its title then
    titles: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Fans:
    """Predictions of which one at a time is drawn bold, as a slider chooses."""

    times: Sequence[float]  #: When each was made, s
    starts: Sequence[int]  #: Where each begins in the traces of all; one more at the end
    #: The trace of all predictions and the one that shows the chosen
    pairs: Sequence[tuple[int, int]]


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
    #: What else it can show: a choice appears over the first plot of a section that has some
    variants: list[Variant] = field(default_factory=list)
    fans: Fans | None = None

    def document(self) -> dict[str, Any]:
        """What the page's script gets."""
        told: dict[str, Any] = {
            "group": self.group,
            "height": self.height,
            "traces": self.traces,
            "layout": self.layout,
        }
        if self.variants:
            told["variants"] = [
                {"label": v.label, "traces": list(v.traces), "titles": dict(v.titles)}
                for v in self.variants
            ]
        if self.fans is not None:
            told["fans"] = {
                "times": [round(float(time), 6) for time in self.fans.times],
                "starts": [int(start) for start in self.fans.starts],
                "pairs": [list(pair) for pair in self.fans.pairs],
            }
        return told

    def shapes(self, shapes: Sequence[Mapping[str, Any]]) -> None:
        """Add lines and areas behind the curves."""
        self.layout.setdefault("shapes", []).extend(dict(shape) for shape in shapes)


def time_plot(title: str, unit_title: str, **how: Any) -> Plot:
    """An empty plot over the time, linked with all others."""
    plot = Plot(title, group="time", **how)
    plot.layout = {"yaxis": {"title": {"text": plot_text(unit_title)}}}
    return plot


def line(
    time: Any, values: Any, name: str, colour: str, *,
    width: float = 1.4, dash: str = "solid", steps: bool = False, opacity: float = 1.0,
    most: int = MOST_POINTS, **more: Any,
) -> dict[str, Any]:  # fmt: skip
    """A curve over the time, thinned and packed.

    Parameters
    ----------
    time, values : (n,) array
        A value that is not finite is a gap.
    steps : bool
        Held until the next sample.
    more
        Other keys of plotly's scatter trace.
    """
    kept_time, kept = thinned(time, values, most)
    trace: dict[str, Any] = {
        "type": "scatter",
        "mode": "lines",
        "x": packed_time(kept_time),
        "y": packed(kept),
        "name": plot_text(name),
        "line": {"color": colour, "width": width, "dash": dash},
        "hovertemplate": "%{y:.4g}",
    }
    if steps:
        trace["line"]["shape"] = "hv"
    if opacity < 1.0:
        trace["opacity"] = opacity
    return trace | more


def band(time: Any, low: Any, high: Any, name: str, colour: str, **more: Any) -> dict[str, Any]:
    """An area between two curves; none where one of them is not finite."""
    x, bottom, top = _outline(time, low, high)
    return {
        "type": "scatter",
        "mode": "lines",
        "x": packed_time(x),
        "y": packed(np.concatenate([[], *_closed(bottom, top)])),
        "name": plot_text(name),
        "line": {"width": 0},
        "fill": "toself",
        "fillcolor": colour,
        "opacity": 0.22,
        "hoverinfo": "skip",
    } | more


def points(x: Any, y: Any, name: str, colour: Any, *, size: float = 5, symbol: str = "circle",
           **more: Any) -> dict[str, Any]:  # fmt: skip
    """Markers."""
    return {
        "type": "scatter",
        "mode": "markers",
        "x": packed_time(x),
        "y": packed(y),
        "name": plot_text(name),
        "marker": {"color": colour, "size": size, "symbol": symbol},
    } | more


def level(value: float, colour: str = ALARM, *, dash: str = "dot") -> dict[str, Any]:
    """A horizontal line across a plot: a limit, a deadline."""
    return {
        "type": "line", "xref": "paper", "x0": 0, "x1": 1, "yref": "y", "y0": value, "y1": value,
        "layer": "below", "line": {"color": colour, "width": 1, "dash": dash},
    }  # fmt: skip


def instant(time: float, colour: str) -> dict[str, Any]:
    """A vertical line across a plot."""
    return {
        "type": "line", "xref": "x", "x0": time, "x1": time, "yref": "paper", "y0": 0, "y1": 1,
        "layer": "below", "line": {"color": colour, "width": 1, "dash": "dot"},
    }  # fmt: skip


def span(begin: float, end: float, colour: str, opacity: float = 0.18) -> dict[str, Any]:
    """A shaded time."""
    return {
        "type": "rect", "xref": "x", "x0": begin, "x1": end, "yref": "paper", "y0": 0, "y1": 1,
        "layer": "below", "fillcolor": colour, "opacity": opacity, "line": {"width": 0},
    }  # fmt: skip


def framed(seen: Sequence[Any], margin: float = 0.08) -> list[float] | None:
    """Range of an axis by what happened; None without a finite value.

    The bands of an uncertain start are not among what is seen: they would flatten the rest.
    """
    values = [np.asarray(v, dtype=float) for v in seen]
    finite = np.concatenate([v[np.isfinite(v)] for v in values]) if values else np.zeros(0)
    if not finite.size:
        return None
    low, high = float(finite.min()), float(finite.max())
    room = margin * (high - low) or 0.05 * max(abs(high), 1.0)
    return [significant(low - room), significant(high + room)]


def thinned(time: Any, values: Any, most: int = MOST_POINTS) -> tuple[FloatArray, FloatArray]:
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
    chosen = np.unique(np.concatenate([first + least, first + largest, first + gap]))
    chosen = chosen[chosen < count]
    return time[chosen], values[chosen]


def packed(values: Any) -> dict[str, str]:
    """An array as plotly reads it: single precision, base64."""
    with np.errstate(over="ignore"):
        single = np.asarray(values, dtype="<f4")
    return {"dtype": "f4", "bdata": base64.b64encode(single.tobytes()).decode("ascii")}


def packed_time(values: Any) -> dict[str, str]:
    """Times, in double precision where single would blur them."""
    times = np.asarray(values, dtype=float)
    finite = times[np.isfinite(times)]
    if not finite.size or np.abs(finite).max() <= _LARGEST_SINGLE_TIME:
        return packed(times)
    return {"dtype": "f8", "bdata": base64.b64encode(times.astype("<f8").tobytes()).decode("ascii")}


def plot_text(text: Any) -> str:
    """Text that plotly shows as it stands: it takes ``<b>`` and ``<a href>`` for markup else."""
    shown = str(text)
    if len(shown) > _LONGEST_TEXT:
        shown = shown[: _LONGEST_TEXT - 1] + "…"
    # A per cent sign before a brace would be a placeholder of a hover text.
    shown = shown.replace("%{", "%\u200b{").replace("\n", " ")
    return shown.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")


def script_json(value: Any) -> str:
    """JSON that can stand inside a ``<script>`` element, whatever text it holds.

    Nothing in it ends the element or opens a comment, and it is valid JavaScript too. What is not
    finite is null.
    """
    text = json.dumps(_plain(value), ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    for sign, code in (
        ("<", "\\u003c"), (">", "\\u003e"), ("&", "\\u0026"),
        ("\u2028", "\\u2028"), ("\u2029", "\\u2029"),
    ):  # fmt: skip
        text = text.replace(sign, code)
    # A lone surrogate, as a damaged text may hold, cannot be written as UTF-8.
    return text.encode("utf-8", "replace").decode("utf-8")


def significant(value: float, digits: int = 6) -> float:
    """Rounded to significant digits."""
    return float(f"{value:.{digits}g}") if math.isfinite(value) else value


def curve_style(number: int) -> tuple[str, str]:
    """Colour and dash of the n-th of several curves: no two of the first 24 are alike."""
    return CURVES[number % len(CURVES)], _DASHES[number // len(CURVES) % len(_DASHES)]


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _outline(
    time: Any, low: Any, high: Any
) -> tuple[FloatArray, list[FloatArray], list[FloatArray]]:
    """Pieces between gaps, thinned: their times there and back, and both edges."""
    time, low, high = (np.asarray(each, dtype=float) for each in (time, low, high))
    count = min(len(time), len(low), len(high))
    size = max(1, math.ceil(count / _MOST_OF_A_BAND))
    inside = np.isfinite(low[:count]) & np.isfinite(high[:count])
    edges = np.flatnonzero(np.diff(np.concatenate([[False], inside, [False]]).astype(int)))
    there: list[FloatArray] = []
    bottoms, tops = [], []
    for begin, end in zip(edges[::2], edges[1::2], strict=True):
        cuts = np.arange(begin, end, size)
        at = np.append(time[cuts], time[end - 1])
        bottom = np.minimum.reduceat(low[:end], cuts)
        top = np.maximum.reduceat(high[:end], cuts)
        bottom, top = np.append(bottom, bottom[-1]), np.append(top, top[-1])
        there += [at, at[::-1], np.array([np.nan])]
        bottoms.append(bottom)
        tops.append(top)
    return np.concatenate([[], *there]), bottoms, tops


def _closed(bottoms: list[FloatArray], tops: list[FloatArray]) -> list[FloatArray]:
    found: list[FloatArray] = []
    for bottom, top in zip(bottoms, tops, strict=True):
        found += [top, bottom[::-1], np.array([np.nan])]
    return found
