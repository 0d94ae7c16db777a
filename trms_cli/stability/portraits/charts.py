"""Charts of portraits, as data."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.core.chart import (
    Axis,
    Chart,
    Colour,
    Contour,
    Curve,
    Flow,
    Line,
    Mark,
    Marker,
    Panel,
    Points,
)
from trms_cli.stability.portraits.invariant_sets import RestPoint, Separatrix, StickingSet, grid
from trms_cli.stability.portraits.section import StateSection
from trms_cli.stability.portraits.trajectories import (
    PortraitTrajectory,
    TrajectoryEnd,
    drawn_points,
)

#: Points between two drawn points, and the length up to which trajectories are drawn, in shares of
#: the window's width: a lightly damped spiral drawn to its end hides the plane.
_APART, _LONGEST = 0.006, 2.2
_LONGEST_IN_SPACE = 3.0
#: Trajectories drawn until dry friction holds them.
_TO_THE_END = 4
#: Rest points beyond which their places are not written beside them.
_MOST_NAMES = 6
_FLOW_GRID, _NULLCLINE_GRID = 41, 101
#: Of the two nullclines; where these are drawn no trajectory has one of their colours.
_NULLCLINES: tuple[Colour, Colour] = ("green", "purple")
#: What trajectories take where the usual colour of their end is taken.
_OTHERWISE: tuple[Colour, ...] = ("sky", "yellow", "green", "purple", "orange", "vermilion", "blue")
_USUAL: dict[str, Colour] = {
    "rest": "blue",
    "held": "blue",
    "line": "blue",
    "rest outside": "orange",
    "turning": "vermilion",
    "gone": "vermilion",
    "moving": "sky",
    "stuck": "yellow",
}
#: Share of a window's width that the marker of a rest point covers.
_MARKER = 0.015
#: Shares of a window's width to its right edge in which a name has no room, and only its value.
_NO_ROOM, _LITTLE_ROOM = 0.06, 0.15


@dataclass(frozen=True)
class PortraitResult:
    """What a portrait shows."""

    section: StateSection
    window: FloatArray  #: (n_c, 2) array
    rests: Sequence[RestPoint]
    trajectories: Sequence[PortraitTrajectory]
    ends: Sequence[TrajectoryEnd]  #: Of the trajectories
    duration: float  #: s of each trajectory
    invariant: bool = False  #: Whether no motion leaves the section
    separatrices: Sequence[Separatrix] = ()
    sticking: Sequence[StickingSet] = ()
    #: Drawn faintly: the model alone, beside its loop
    beside: Sequence[PortraitTrajectory] = ()
    loop: str = ""  #: The controller of a closed loop; empty for the model alone


def portrait(
    result: PortraitResult, caption: str, ends: Sequence[TrajectoryEnd], labels: Sequence[str]
) -> Chart:
    """The figure, in the plane or in space, its ends told apart by labels of the legend."""
    in_space = len(result.section.coordinates) == 3
    items = result.section.coordinates.items
    axes = [
        Axis(item.label, item.unit, (float(low), float(high)))
        for item, (low, high) in zip(items, result.window, strict=True)
    ]
    marks: list[Mark] = []
    if not in_space and not result.loop:
        marks += _field(result)
    if not in_space:
        marks += _stops(result)
    marks += [
        _curve(
            drawn_points(trajectory, result.window, _APART, _LONGEST)[0],
            "without controller",
            "grey",
        )
        for trajectory in result.beside
    ]
    marks += _trajectories(result, ends, labels)
    marks += _manifolds(result)
    marks += [
        _curve(s.c, f"dry friction holds {s.what}", "alarm", width=4.5)
        for s in result.sticking
        if not is_hidden(result, s)
    ]
    marks += _rest_points(result)
    panel = Panel(axes[0], axes[1], marks, z=axes[2] if in_space else None)
    return Chart(
        "phase_portrait", [panel], caption, columns=1, width=5.6 if in_space else 6.6, height=4.8
    )


def is_hidden(result: PortraitResult, sticking_set: StickingSet) -> bool:
    """Whether a sticking set is shorter than the marker of a rest point that lies on it."""
    width = np.ptp(result.window, axis=1)
    low, high = sticking_set.reach
    return (high - low) / width[sticking_set.along] < _MARKER and any(
        sticking_set.holds(rest.c, 0.5 * _MARKER * width) for rest in result.rests
    )


def has_field(section: StateSection, window: FloatArray) -> bool:
    """Whether both rates of a plane differ from zero somewhere in it.

    The two angles of a rig with its rates held have none of their own: what moves them is not seen.
    """
    _, _, rates = _on_grid(section, window, _FLOW_GRID)
    size = np.nanmax(np.abs(rates), axis=(0, 1)) / np.ptp(window, axis=1)
    return bool(size.min() > 1e-9 * max(1.0, size.max()))


def _field(result: PortraitResult) -> list[Mark]:
    """Stream lines of the section, and where each coordinate's rate is zero."""
    section, window = result.section, result.window
    if not has_field(section, window):
        return []
    x, y, rates = _on_grid(section, window, _FLOW_GRID)
    marks: list[Mark] = [Flow(x, y, rates[..., 0], rates[..., 1], "grey", 0.9)]
    x, y, rates = _on_grid(section, window, _NULLCLINE_GRID)
    for place, item in enumerate(section.coordinates.items):
        values = rates[..., place]
        if np.nanmin(values) < 0 < np.nanmax(values):
            label = f"{item.rate_label} = 0"
            marks.append(Contour(x, y, values, [0.0], label, _NULLCLINES[place], "dashed", 1.2))
    return marks


def _on_grid(
    section: StateSection, window: FloatArray, count: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Grid lines, and the rates (y, x, n_c) in the section."""
    points = grid(window, count)
    rates = section.rates(points.reshape(-1, 2)).reshape(count, count, 2).swapaxes(0, 1)
    return points[:, 0, 0], points[0, :, 1], rates


def _stops(result: PortraitResult) -> list[Mark]:
    model = result.section.coordinates.model
    marks: list[Mark] = []
    for place, item in enumerate(result.section.coordinates.items):
        stop = model.stops.get(item.name, np.inf)
        for value in (-stop, stop):
            if result.window[place, 0] < value < result.window[place, 1]:
                x, y = (value, None) if place == 0 else (None, value)
                marks.append(Line(x, y, "mechanical stop"))
    return marks


def _trajectories(
    result: PortraitResult, ends: Sequence[TrajectoryEnd], labels: Sequence[str]
) -> list[Mark]:
    colours = _colours(result, ends)
    in_space = len(result.section.coordinates) == 3
    usual = np.inf if result.loop else _LONGEST_IN_SPACE if in_space else _LONGEST
    marks: list[Mark] = []
    starts: list[FloatArray] = []
    for end, label, colour in zip(ends, labels, colours, strict=True):
        for place, number in enumerate(end.members):
            # Where friction holds them is what matters: some are drawn to their end.
            longest = np.inf if end.what == "held" and place < _TO_THE_END else usual
            points, saturated = drawn_points(
                result.trajectories[number], result.window, _APART, longest
            )
            marks.append(_curve(points, label, colour, width=1.1, arrow=True))
            if saturated.any():
                at_bound = points.copy()
                at_bound[~saturated] = np.nan
                marks.append(_curve(at_bound, "command at its bound", "orange", width=2.8))
            starts.append(points[0])
    c = np.array(starts)
    marks.append(_points(c, "start", "dot", "grey", 3.0))
    return marks


def _colours(result: PortraitResult, ends: Sequence[TrajectoryEnd]) -> list[Colour]:
    """One for the trajectories of each end, none of them that of something else in the figure."""
    used_colours: set[Colour] = set()
    if result.loop:
        used_colours.add("orange")  # a command at its bound
    elif len(result.section.coordinates) == 2:
        used_colours.update(_NULLCLINES)
    if any(path.surface for path in result.separatrices):
        used_colours.add("orange")
    colours: list[Colour] = []
    for end in ends:
        usual = _USUAL[end.what]
        free = [colour for colour in (usual, *_OTHERWISE) if colour not in used_colours]
        colours.append(free[0] if free else usual)
        used_colours.add(colours[-1])
    return colours


def _manifolds(result: PortraitResult) -> list[Mark]:
    marks: list[Mark] = []
    for path in result.separatrices:
        c = path.c
        if not path.into:  # it winds into a rest point: a turn and a half shows where it goes
            steps = np.linalg.norm(np.diff(c, axis=0) / np.ptp(result.window, axis=1), axis=1)
            c = c[np.concatenate([[0.0], np.cumsum(steps)]) <= _LONGEST]
        c = _clipped(c, result.window)
        label = "into the saddle (separatrix)" if path.into else "out of the saddle"
        if path.surface:
            label = f"surface of motions {'into' if path.into else 'out of'} the saddle"
        colour: Colour = "orange" if path.surface else "ink"
        width = 0.8 if path.surface else 1.8 if path.into else 1.2
        style = "solid" if path.into else "dashed"
        marks.append(_curve(c, label, colour, width=width, style=style))
    return marks


def _rest_points(result: PortraitResult) -> list[Mark]:
    section = result.section
    if result.loop:
        goal = section.coordinates.values(section.point.x, section.point.u)
        return [_points(goal[None], "goal", "star", "ink", 8.0)]
    marks: list[Mark] = []
    for rest in result.rests:
        marker: Marker = "saddle" if rest.kind == "saddle" else "unstable"
        if rest.line:
            marks.append(_points(rest.c[None], "rest points, side by side", "square", "ink", 4.0))
            continue
        if rest.stable:
            marker = "stable"
        label = rest.kind if rest.in_section else f"{rest.kind}, beside the section"
        points = _points(rest.c[None], label, marker, "ink" if rest.in_section else "grey", 7.0)
        if len(result.rests) <= _MOST_NAMES:
            room = (result.window[0, 1] - rest.c[0]) / np.ptp(result.window[0])
            name = _name(section, rest, short=room < _LITTLE_ROOM)
            if room >= _NO_ROOM or rest.c.size == 3:
                points = replace(points, names=(name,))
        marks.append(points)
    return marks


def _name(section: StateSection, rest: RestPoint, *, short: bool) -> str:
    """``α_v = 1.9``, or ``1.9``: by an angle where there is one."""
    items = section.coordinates.items
    places = [place for place, item in enumerate(items) if not item.is_rate]
    place = min(places, key=lambda place: items[place].unit != "rad")
    value = float(rest.c[place])
    words = "0" if abs(value) < 5e-4 else f"{value:.3g}"
    return words if short and len(items) == 2 else f"{items[place].label} = {words}"


def _clipped(c: FloatArray, window: FloatArray) -> FloatArray:
    """NaN where a curve is outside; a picture in space does not cut it."""
    inside = np.all((c >= window[:, 0]) & (c <= window[:, 1]), axis=1)
    if c.shape[1] == 2:
        inside[1:] |= inside[:-1].copy()
        inside[:-1] |= inside[1:].copy()
    return np.where(inside[:, None], c, np.nan)


def _curve(
    c: FloatArray,
    label: str,
    colour: Colour,
    *,
    width: float = 0.8,
    style: str = "solid",
    arrow: bool = False,
) -> Curve:
    z = c[:, 2] if c.shape[1] == 3 else None
    return Curve(c[:, 0], c[:, 1], label, colour, style, width, arrow, z)  # type: ignore[arg-type]


def _points(c: FloatArray, label: str, marker: Marker, colour: Colour, size: float) -> Points:
    z = c[:, 2] if c.shape[1] == 3 else None
    return Points(c[:, 0], c[:, 1], label, marker, colour, (), size, z)
