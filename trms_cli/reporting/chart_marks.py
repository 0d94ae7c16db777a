"""How each mark of a chart looks: curves, points, flows, level lines, shaded sets."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.colors import to_rgba
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from trms_cli.core.chart import (
    Band,
    Bars,
    Contour,
    Curve,
    Flow,
    Line,
    Mark,
    Note,
    Points,
    Region,
    Span,
)
from trms_cli.reporting.style import ALARM, GREY, INK, PALE, PALETTE, thinned

_DASHES: dict[str, Any] = {"solid": "-", "dashed": (0, (4.5, 2.2)), "dotted": (0, (1.2, 1.8))}
_INKS = {"ink": INK, "grey": GREY, "pale": PALE, "alarm": ALARM}
_SHAPES = {
    "stable": "o",
    "unstable": "o",
    "saddle": "D",
    "star": "*",
    "dot": "o",
    "cross": "x",
    "square": "s",
    "triangle": "^",
}
#: Behind words, so that they can be read across lines.
_PAPER = {"boxstyle": "square,pad=0.1", "facecolor": (1, 1, 1, 0.7), "edgecolor": "none"}


@dataclass(frozen=True)
class Handle:
    """What a legend shows of a mark."""

    artist: Any  #: matplotlib artist
    look: object  #: Equal for marks that cannot be told apart


def draw_mark(axes: Any, mark: Mark) -> Handle | None:
    """Draw one; what stands for it in the legend, or None for a mark without."""
    match mark:
        case Curve():
            return _curve(axes, mark)
        case Points():
            return _points(axes, mark)
        case Flow():
            _flow(axes, mark)
        case Contour():
            return _contour(axes, mark)
        case Region():
            return _region(axes, mark)
        case Band():
            return _band(axes, mark)
        case Span():
            colour = to_rgba(_colour(mark.colour), mark.opacity)
            axes.axvspan(mark.begin, mark.end, color=colour, linewidth=0, zorder=0)
            return Handle(Patch(facecolor=colour), ("patch", mark.colour, round(mark.opacity, 2)))
        case Line():
            return _line(axes, mark)
        case Note():
            _note(axes, mark)
        case Bars():
            _bars(axes, mark)
    return None


def _colour(name: str) -> str:
    return _INKS[name] if name in _INKS else PALETTE[name]


def _line_handle(colour: str, style: str, width: float) -> Handle:
    shown = Line2D([], [], color=_colour(colour), linestyle=_DASHES[style], linewidth=width)
    return Handle(shown, ("line", colour, style))


def _curve(axes: Any, mark: Curve) -> Handle:
    look = {
        "color": _colour(mark.colour),
        "linestyle": _DASHES[mark.style],
        "linewidth": mark.width,
    }
    if mark.z is not None:
        axes.plot(mark.x, mark.y, mark.z, **look)
    else:
        x, y = thinned(mark.x, mark.y)
        axes.plot(x, y, drawstyle="steps-post" if mark.held else "default", **look)
        if mark.arrow:
            _arrowhead(axes, np.asarray(mark.x, float), np.asarray(mark.y, float), mark)
    return _line_handle(mark.colour, mark.style, mark.width)


def _arrowhead(axes: Any, x: np.ndarray, y: np.ndarray, mark: Curve) -> None:
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


def _points(axes: Any, mark: Points) -> Handle:
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
        "markeredgewidth": 1.4 if mark.marker in ("unstable", "saddle", "cross") else 0.8,
        "linestyle": "none",
    }
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


def _flow(axes: Any, mark: Flow) -> None:
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


def _contour(axes: Any, mark: Contour) -> Handle:
    drawn = axes.contour(
        mark.x,
        mark.y,
        np.ma.masked_invalid(mark.values),
        levels=sorted(mark.levels),
        colors=[_colour(mark.colour)],
        linestyles=[_DASHES[mark.style]],
        linewidths=mark.width,
    )
    if mark.numbers:
        axes.clabel(drawn, fontsize=7, fmt=_level, inline_spacing=2)
    return _line_handle(mark.colour, mark.style, mark.width)


def _level(value: float) -> str:
    """A level with a minus that is as wide as a digit, not a hyphen that the line hides."""
    return f"{value:.3g}".replace("-", "−")


def _region(axes: Any, mark: Region) -> Handle:
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


def _band(axes: Any, mark: Band) -> Handle:
    colour = to_rgba(_colour(mark.colour), mark.opacity)
    axes.fill_between(mark.x, mark.lower, mark.upper, color=colour, linewidth=0, zorder=0.5)
    return Handle(Patch(facecolor=colour), ("patch", mark.colour, round(mark.opacity, 2)))


def _line(axes: Any, mark: Line) -> Handle:
    look = {"color": _colour(mark.colour), "linestyle": _DASHES[mark.style], "linewidth": 1.0}
    if mark.x is not None:
        axes.axvline(mark.x, zorder=0.8, **look)
    if mark.y is not None:
        axes.axhline(mark.y, zorder=0.8, **look)
    return _line_handle(mark.colour, mark.style, 1.0)


def _note(axes: Any, mark: Note) -> None:
    axes.annotate(
        mark.text,
        (mark.x, mark.y),
        fontsize=8,
        color=_colour(mark.colour),
        zorder=6,
        annotation_clip=True,
    )


def _bars(axes: Any, mark: Bars) -> None:
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
