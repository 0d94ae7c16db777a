"""Figures of modes: the complex plane with trajectories, and damping and frequency over a range."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from trms_cli.core.chart import (
    Axis,
    Chart,
    Colour,
    Curve,
    Line,
    Mark,
    Marker,
    Panel,
    Points,
    Region,
    Style,
)
from trms_cli.stability.local.modes import STILL, Modes
from trms_cli.stability.local.sweep import Crossing, Locus, Track

_OF_PART: dict[str, Colour] = {
    "pitch": "blue",
    "yaw": "vermilion",
    "main rotor": "green",
    "tail rotor": "purple",
}
_OTHERS: tuple[Colour, ...] = ("orange", "sky", "ink", "yellow", "grey")
_STYLES: tuple[Style, ...] = ("solid", "dashed", "dotted")
_MARKERS: tuple[Marker, ...] = ("dot", "square", "triangle", "star")
#: Damping ratios whose lines are drawn in the plane.
_DAMPING = (0.1, 0.3, 0.6)


def colours_of(tracks: Sequence[Track]) -> dict[str, Colour]:
    """A colour for each mode by its part; what has none of its own takes the next one free."""
    found: dict[str, Colour] = {}
    used: set[Colour] = set()
    free = iter([*_OTHERS] * (len(tracks) + 1))
    for track in tracks:
        wanted = _OF_PART.get(track.part)
        found[track.name] = wanted if wanted is not None and wanted not in used else next(free)
        used.add(found[track.name])
    return found


def styles_of(colours: Mapping[str, Colour]) -> dict[str, Style]:
    """A style for each mode, so that two of one colour differ."""
    met: dict[Colour, int] = {}
    found: dict[str, Style] = {}
    for name, colour in colours.items():
        found[name] = _STYLES[met.get(colour, 0) % len(_STYLES)]
        met[colour] = met.get(colour, 0) + 1
    return found


def locus_charts(
    names: tuple[str, str], locus: Locus, value: float, where: str, digits: int = 3, note: str = ""
) -> tuple[Chart, Chart]:
    """The complex plane with trajectories, and damping and frequency over the range.

    ``value`` is that of what is varied at the operating point, told with some digits; ``where``
    says in the captions what is held, ``note`` stands at the end of the second.
    """
    path, values = locus.path, locus.sweep.values
    at = int(np.argmin(np.abs(values - value)))
    low, high = (f"{v:.3g} {path.unit}".rstrip() for v in (values[0], values[-1]))
    here = f"{values[at]:.{digits}g} {path.unit}".rstrip()
    caption = (
        f"Eigenvalues as {path.over} goes from {low} to {high}{where}; discs: {path.over} = {here}."
    )
    over = f"Damping and frequency over {path.over}{where}{note}."
    return _plane(names[0], locus, at, (low, high), caption), _range(names[1], locus, value, over)


def _plane(name: str, locus: Locus, at: int, ends: tuple[str, str], caption: str) -> Chart:
    """The complex plane: where each mode is at one point, and how it moves over the range."""
    over, tracks, crossings = locus.path.over, locus.tracks, locus.crossings
    slow = [track for track in tracks if not track.fast]
    colours = colours_of(slow)
    styles = styles_of(colours)
    marks: list[Mark] = []
    everything = np.concatenate([track.rates.ravel() for track in slow])
    left, right = float(everything.real.min()), float(everything.real.max())
    top = float(np.abs(everything.imag).max())
    width = max(right - left, 0.3, 0.15 * top)
    x = (left - 0.08 * width, max(right, 0.0) + 0.12 * width)
    y = 1.12 * top if top > STILL else 0.5
    # The half plane in which motions grow.
    marks.append(
        Region(
            np.array([0.0, x[1]]),
            np.array([-y, y]),
            np.ones((2, 2), dtype=bool),
            "unstable",
            "alarm",
            0.07,
        )
    )
    if top > STILL:
        marks += _damping_lines(x[0], y)
    marks.append(Line(x=0.0, colour="ink", style="solid"))
    for track in slow:
        for column in track.rates.T:
            marks.append(
                Curve(
                    column.real,
                    column.imag,
                    track.name,
                    colours[track.name],
                    styles[track.name],
                    width=2.0,
                )
            )
    for track in slow:
        here = track.rates[at]
        marks.append(Points(here.real, here.imag, "", "dot", colours[track.name], size=8.0))
    for label, k, marker, size in (
        (f"{over} = {ends[0]}", 0, "square", 4.0),
        (f"{over} = {ends[1]}", -1, "triangle", 5.0),
    ):
        both = np.concatenate([track.rates[k] for track in slow])
        marks.append(Points(both.real, both.imag, label, marker, "ink", size=size))  # type: ignore[arg-type]
    if crossings:
        flat = [c for c in crossings if not c.jumps]
        marks.append(
            Points(
                [0.0] * len(flat),
                [c.frequency for c in flat],
                "crosses",
                "star",
                "alarm",
                [f"{c.value:.4g}" for c in flat],
                7.0,
            )
        )
    panel = Panel(Axis("Re λ", "1/s", x), Axis("Im λ", "rad/s", (-y, y)), marks)
    close = _close_up(slow, crossings, x, y)
    if close is None:
        return Chart(name, [panel], caption, 1, 7.2, 5.0)
    whole = Panel(panel.x, panel.y, marks, "all modes")
    near = Panel(Axis("Re λ", "1/s", close[0]), Axis("Im λ", "rad/s", close[1]), marks, close[2])
    return Chart(name, [whole, near], caption, 2, 5.4, 4.4)


def _close_up(
    tracks: Sequence[Track], crossings: Sequence[Crossing], x: tuple[float, float], y: float
) -> tuple[tuple[float, float], tuple[float, float], str] | None:
    """Limits around the mode that crosses first, where it is small in the whole, and its name."""
    if not crossings:
        return None
    own = [track for track in tracks if crossings[0].track in track.members]
    if not own:
        return None
    rates = own[0].slowest
    spans = []
    for part, whole in ((rates.real, x[1] - x[0]), (rates.imag, 2 * y)):
        low, high = float(part.min()), float(part.max())
        if high - low > 0.3 * whole:
            return None
        margin = 0.25 * (high - low) + 0.01 * whole
        spans.append((low - margin, high + margin))
    return spans[0], spans[1], own[0].name


def _range(name: str, locus: Locus, at: float, caption: str) -> Chart:
    """Growth rate, damping ratio, frequency and pace of each mode over what is varied."""
    axis, tracks, values = Axis(locus.path.over, locus.path.unit), locus.tracks, locus.sweep.values
    slow = [track for track in tracks if not track.fast]
    colours = colours_of(tracks)
    styles = styles_of(colours)
    growth: list[Mark] = [Line(y=0.0, colour="ink", style="solid"), Line(x=at)]
    damping: list[Mark] = [Line(y=0.0, colour="ink", style="solid"), Line(x=at)]
    frequency: list[Mark] = [Line(x=at)]
    pace: list[Mark] = [Line(x=at)]
    for track in tracks:
        colour, style = colours[track.name], styles[track.name]
        for k, column in enumerate(track.rates.T):
            size = np.abs(column)
            shown = np.where((size > STILL) & np.isfinite(size), size, np.nan)
            if k == 0 or np.any(np.abs(size - np.abs(track.rates[:, 0])) > 1e-9):
                pace.append(Curve(values, shown, track.name, colour, style))
            if track.fast:
                continue
            swings = np.abs(column.imag) > STILL
            if k == 0 or np.any(np.abs(column.real - track.rates[:, 0].real) > 1e-9):
                growth.append(Curve(values, column.real, track.name, colour, style))
            if k == 0 and swings.any():
                ratio = np.where(swings, -column.real / np.maximum(size, STILL), np.nan)
                hertz = np.where(swings, np.abs(column.imag) / (2 * math.pi), np.nan)
                damping.append(Curve(values, ratio, track.name, colour, style))
                frequency.append(Curve(values, hertz, track.name, colour, style))
    panels = [Panel(axis, Axis("Re λ", "1/s"), growth, "growth rate")]
    if len(frequency) > 1:
        panels.append(Panel(axis, Axis("damping ratio ζ"), damping, "damping of what swings"))
        panels.append(Panel(axis, Axis("Im λ / 2π", "Hz"), frequency, "frequency of what swings"))
    if len(slow) < len(tracks) or len(panels) == 3:
        panels.append(Panel(axis, Axis("|λ|", "1/s", log=True), pace, "pace, all modes"))
    return Chart(name, panels, caption, 2, 4.6, 3.2)


def points_alone(name: str, modes: Modes, caption: str = "") -> Chart:
    """The complex plane of one operating point with the modes' names."""
    finite = [m for m in modes.modes if np.isfinite(m.eigenvalue.real)]
    slowest = sorted(finite, key=lambda m: m.natural_frequency)
    shown = [
        m for m in slowest if m.natural_frequency <= 8.0 * max(slowest[0].natural_frequency, 5.0)
    ]
    marks: list[Mark] = [Line(x=0.0, colour="ink", style="solid")]
    used: dict[Colour, int] = {}
    for mode in shown:
        value = mode.eigenvalue
        both = [value, value.conjugate()] if mode.oscillates else [value]
        own = next((c for part, c in _OF_PART.items() if mode.name.startswith(part)), None)
        colour: Colour = (
            own
            if own is not None and own not in used
            else min(_OTHERS, key=lambda other: used.get(other, 0))
        )
        used[colour] = used.get(colour, 0) + 1
        # A disc or a ring where the colour is its own; another shape where it comes again.
        disc: Marker = "stable" if mode.verdict == "stable" else "unstable"
        marker = disc if used[colour] == 1 else _MARKERS[(used[colour] - 1) % len(_MARKERS)]
        marks.append(
            Points(
                [v.real for v in both], [v.imag for v in both], mode.name, marker, colour, size=9.0
            )
        )
    top = max([abs(m.eigenvalue.imag) for m in shown], default=0.0)
    reals = [m.eigenvalue.real for m in shown]
    width = max(0.0, *reals) - min(0.0, *reals) or 1.0
    x = Axis("Re λ", "1/s", (min(0.0, *reals) - 0.08 * width, max(0.0, *reals) + 0.08 * width))
    y = Axis("Im λ", "rad/s", (-1.15 * top, 1.15 * top) if top > STILL else (-1.0, 1.0))
    return Chart(name, [Panel(x, y, marks)], caption, 1, 6.4, 4.4)


def _damping_lines(left: float, top: float) -> list[Mark]:
    """Lines of equal damping ratio in the left half plane."""
    marks: list[Mark] = []
    for ratio in _DAMPING:
        angle = math.acos(ratio)
        reach = min(-left / math.cos(angle), top / math.sin(angle)) if left < 0 else 0.0
        if reach <= 0:
            continue
        x, y = -reach * math.cos(angle), reach * math.sin(angle)
        marks.append(
            Curve([x, 0.0, x], [y, 0.0, -y], "ζ = 0.1, 0.3, 0.6", "pale", "dotted", width=1.0)
        )
    return marks
