"""What a figure shows, as plain data: a domain says what is drawn, `reporting` how it looks.

::

    Chart(
        "equilibria",
        [Panel(Axis("u_v", "V"), Axis("α_v", "rad"),
               [Curve(u, lower, "stable"), Curve(u, upper, "unstable", "vermilion", "dashed"),
                Points([2.23], [0.95], "fold", marker="star")])],
        "Where pitch rests over the main rotor's command.",
    )

The same data are the figure's JSON twin.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:  # findings without a chart are told before NumPy is loaded
    import numpy as np
    import numpy.typing as npt

    from trms_cli.core.arrays import BoolArray, FloatArray

    Values = Sequence[float] | npt.NDArray[np.floating[Any]]
#: Names of the house's palette (told apart with any common colour blindness), and of its inks.
Colour = Literal[
    "blue",
    "vermilion",
    "green",
    "purple",
    "orange",
    "sky",
    "yellow",
    "ink",
    "grey",
    "pale",
    "measured",
    "alarm",
]
Style = Literal["solid", "dashed", "dotted", "dashdot", "dashdotdot", "long"]
#: ``stable`` a filled disc, ``unstable`` a ring, ``saddle`` a half-filled diamond.
Marker = Literal[
    "stable", "unstable", "saddle", "star", "dot", "cross", "square", "triangle", "down", "diamond",
]  # fmt: skip
#: The order in which curves take colours; dashes, where those are lost in print.
CURVES: tuple[Colour, ...] = ("blue", "vermilion", "green", "purple", "orange", "sky")
STYLES: tuple[Style, ...] = ("solid", "dashed", "dotted", "dashdot", "dashdotdot", "long")
#: What belongs to pitch and the main rotor has the first colour in every figure, yaw and the tail
#: rotor the second.
_PLACES = (("pitch", "main", "_v"), ("yaw", "tail", "_h"))


def signal_place(name: str, number: int = 0) -> int:
    """Place of a signal's colour: that of its axis, else the one that its number gives."""
    for place, parts in enumerate(_PLACES):
        if name.startswith(parts[:2]) or name.endswith(parts[2]):
            return place
    return number + len(_PLACES)


def signal_colour(name: str, number: int = 0) -> Colour:
    """Colour of a signal: the same in every figure for what belongs to an axis."""
    return CURVES[signal_place(name, number) % len(CURVES)]


def curve_look(place: int) -> dict[str, Any]:
    """Colour and dashes of one of several curves in print: told apart without colour too."""
    return {"colour": CURVES[place % len(CURVES)], "style": STYLES[place % len(STYLES)]}


def page_look(place: int) -> dict[str, Any]:
    """Colour and dashes of one of several curves on a page: dashes once the colours are used."""
    styles: tuple[Style, ...] = ("solid", "dashed", "dotted", "dashdot")
    style = styles[place // len(CURVES) % len(styles)]
    return {"colour": CURVES[place % len(CURVES)], "style": style}


@dataclass(frozen=True)
class Axis:
    """An axis of a panel."""

    label: str  #: What and in which unit
    unit: str = ""  #: an empty unit shows none
    #: None, the whole or an end of it: as the marks need
    limits: tuple[float | None, float | None] | None = None
    log: bool = False
    linked: str = ""  #: Axes of one name are zoomed together where a reader can; "" for alone
    ticks: Sequence[float] = ()  #: Where numbers stand; empty: as it looks best
    categories: Sequence[str] = ()  #: Names of the places 0, 1, …, the first on top or on the left


@dataclass(frozen=True)
class Curve:
    """A line through points; NaN breaks it."""

    x: Values  #: (n,)
    y: Values  #: (n,)
    label: str = ""  #: In the legend; empty for none. Equal labels of a panel stand there once.
    colour: Colour = "blue"
    style: Style = "solid"
    width: float = 1.4  #: Points
    arrow: bool = False  #: Whether an arrowhead on it tells its direction
    z: Values | None = None  #: (n,) or None; in a panel of three axes
    is_step: bool = False  #: Whether each value holds until the next, as a command does
    opacity: float = 1.0  #: 0 to 1
    filled: bool = False  #: Whether the area down to zero is shaded in its colour


@dataclass(frozen=True)
class Points:
    """Single points."""

    x: Values  #: (n,)
    y: Values  #: (n,)
    label: str = ""
    marker: Marker = "dot"
    colour: Colour = "ink"
    names: Sequence[str] = ()  #: Written beside the points; empty for none
    size: float = 6.0  #: Points
    z: Values | None = None  #: (n,) or None; in a panel of three axes
    tooltips: Sequence[str] = ()  #: What a reader who points at one is told; empty: its place
    opacity: float = 1.0  #: 0 to 1
    step_shape: Literal["", "hv", "vh"] = ""  #: Steps from each point to the next, which way first
    reach: tuple[Values, Values] | None = None  #: Whiskers along x, to the left and to the right
    values: Values | None = None  #: (n,) or None; colours on a scale, for the colour that is given


@dataclass(frozen=True)
class Events:
    """What happened when: triangles at the upper edge of a panel."""

    times: Values  #: (n,)
    label: str = ""
    colour: Colour = "alarm"
    tooltips: Sequence[str] = ()  #: What a reader who points at one is told


@dataclass(frozen=True)
class Fans:
    """Curves that each begin at a moment of their own, of which a page draws one bold."""

    times: Sequence[float]  #: When each was made
    x: Values  #: (n,); one behind another, NaN after each
    y: Values  #: (n,)
    label: str = "predictions"
    colour: Colour = "orange"
    is_step: bool = False  #: Whether each value holds until the next

    @property
    def starts(self) -> list[int]:
        """Where each begins; one more at the end."""
        ends = [i + 1 for i, value in enumerate(self.x) if math.isnan(value)]
        return [0, *ends]


@dataclass(frozen=True)
class Boxes:
    """Quartiles with whiskers, each at a place of an axis with categories."""

    places: Values  #: (n,)
    quantiles: Sequence[Sequence[float]]  #: (n, 5): end, quartile, median, quartile, end
    label: str = ""
    colours: Sequence[Colour] = ("blue",)  #: One each, or one for all
    across: bool = True  #: Whether they lie, with their places on the vertical axis
    width: float = 0.6  #: In the unit of the places


@dataclass(frozen=True)
class Heat:
    """A map of values on two axes with categories: dark is large."""

    values: npt.NDArray[np.float64]  #: (m, n); at ``(j, i)``; NaN where there is none


@dataclass(frozen=True)
class Flow:
    """Stream lines of a vector field in the plane."""

    x: Values  #: (n,), (m,); grid lines, equally spaced
    y: Values  #: (n,), (m,); grid lines, equally spaced
    u: FloatArray  #: (m, n); components at ``(x[j], y[i])``
    v: FloatArray  #: (m, n); components at ``(x[j], y[i])``
    colour: Colour = "grey"
    density: float = 1.0  #: of lines, relative to the usual


@dataclass(frozen=True)
class Contour:
    """Level lines of a function on a grid: nullclines (level 0), level sets of a V."""

    x: Values  #: (n,), (m,)
    y: Values  #: (n,), (m,)
    values: FloatArray  #: (m, n); at ``(x[j], y[i])``; NaN where there is none
    levels: Sequence[float]
    label: str = ""
    colour: Colour = "blue"
    style: Style = "solid"
    width: float = 1.4  #: points
    numbers: bool = False  #: Whether the levels are written on the lines


@dataclass(frozen=True)
class Region:
    """A shaded set, on a grid."""

    x: Values  #: (n,), (m,)
    y: Values  #: (n,), (m,)
    inside: BoolArray  #: (m, n) bool; whether ``(x[j], y[i])`` belongs to it
    label: str = ""
    colour: Colour = "sky"
    opacity: float = 0.25  #: 0 to 1


@dataclass(frozen=True)
class Band:
    """A shaded strip between two curves."""

    x: Values  #: (n,)
    lower: Values  #: (n,)
    upper: Values  #: (n,)
    label: str = ""
    colour: Colour = "sky"
    opacity: float = 0.25  #: 0 to 1


@dataclass(frozen=True)
class Span:
    """A shaded stretch of the horizontal axis: a time in which something was so."""

    begin: float  #: in the axis' unit
    end: float  #: in the axis' unit
    label: str = ""
    colour: Colour = "pale"
    opacity: float = 0.35  #: 0 to 1


@dataclass(frozen=True)
class Line:
    """A line across the panel, at one value of x or of y."""

    x: float | None = None  #: One of the two
    y: float | None = None  #: One of the two
    label: str = ""
    colour: Colour = "grey"
    style: Style = "dotted"


@dataclass(frozen=True)
class Note:
    """A few words at a place."""

    x: float  #: in the axes' units
    y: float  #: in the axes' units
    text: str
    colour: Colour = "ink"


@dataclass(frozen=True)
class Bars:
    """Horizontal bars below one another, each with its name on the left; alone in its panel."""

    names: Sequence[str]
    values: Values  #: (n,); lengths
    colours: Sequence[Colour] = ()  #: One each; empty: all blue
    spread: Values | None = None  #: (n,) or None; a whisker to either side of an end
    notes: Sequence[str] = ()  #: Written on the right, one each


Mark = (
    Curve | Points | Flow | Contour | Region | Band | Span | Line | Note | Bars
    | Events | Fans | Boxes | Heat
)  # fmt: skip


@dataclass(frozen=True)
class Panel:
    """One coordinate system."""

    x: Axis
    y: Axis
    marks: Sequence[Mark]  #: sequence of marks; drawn in order, what comes later on top
    title: str = ""
    z: Axis | None = None  #: A third axis; curves and points only then
    equal: bool = False  #: One unit of x is as long as one of y
    row_height: float = 0.0  #: Of its row, relative to the others'; 0: as theirs
    note: str = ""  #: A few words above it, on the right
    caption: str = ""  #: Under it on a page, in place of the chart's
    half: bool = False  #: On a page and in a plot of logs: it stands beside its neighbour
    #: What else it can show, by what a reader chooses: the same marks with other data
    variants: Mapping[str, Panel] = field(default_factory=dict)


@dataclass(frozen=True)
class Chart:
    """A figure of one or more panels."""

    name: str  #: File name without its ending
    panels: Sequence[Panel]
    caption: str = ""  #: A sentence under it: what is seen, with the condition
    columns: int = 2  #: Panels in a row
    width: float = 4.4  #: Inches, of a panel
    height: float = 3.2  #: Inches, of a panel
    together: bool = False  #: Panels share their x axis, which the last row alone labels


#: What a place of the rig's block diagram carries: a share, and the ends of its interval.
Share = tuple[float, float, float]


@dataclass(frozen=True)
class DiagramRow:
    """A row of the rig's block diagram: from a command to what is measured."""

    places: Mapping[str, str]  #: By kind: ``actuator``, ``motor``, ``thrust``, ``moment``…
    #: ``command``, ``output``, ``speed``: Signals at its ends and at its tacho; empty for none
    command: str = ""
    output: str = ""
    speed: str = ""

    @property
    def channels(self) -> set[str]:
        """What a recording of it may have."""
        return {self.command, self.output, self.speed} - {""}


@dataclass(frozen=True)
class RigDiagram:
    """The rig from its commands to its sensors, with a share at each place that has one."""

    name: str  #: File name without its ending
    shares: Mapping[str, Share]  #: By place: ``yaw_moment``
    channels: Sequence[str] = ()  #: Recorded ones; a sensor of none of them is dashed
    caption: str = ""
    rows: Sequence[DiagramRow] = ()  #: Of the rig; empty for those of a beam with two rotors


def as_data(chart: Chart) -> dict[str, Any]:
    """A chart as JSON data; numbers to six digits, what is not finite as None."""
    data: dict[str, Any] = _plain(chart)
    return data


#: What a mark is called in JSON.
_KINDS = {kind: kind.__name__.lower() for kind in Mark.__args__}


#: What a field is called in JSON, where that is not its own name.
_KEYS = {"is_step": "held", "tooltips": "told", "step_shape": "joined"}


#: Keys that are left out of the document where they are not set.
_SILENT = (
    "held", "filled", "linked", "ticks", "categories", "row_height", "together", "told", "joined",
    "reach", "values", "note", "caption", "half", "variants",
)  # fmt: skip


def _plain(value: Any) -> Any:
    if hasattr(value, "tolist"):  # an array, or a number of NumPy's
        return _plain(value.tolist())
    if isinstance(value, float):
        return float(f"{value:.6g}") if math.isfinite(value) else None
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if hasattr(value, "__dataclass_fields__"):
        kind = {"kind": _KINDS[type(value)]} if type(value) in _KINDS else {}
        attributes = {_KEYS.get(f.name, f.name): getattr(value, f.name) for f in fields(value)}
        return kind | {
            key: _plain(item) for key, item in attributes.items() if not _is_silent(key, item)
        }
    return value


def _is_silent(key: str, item: Any) -> bool:
    if key == "opacity":
        return bool(item == 1.0)
    return key in _SILENT and not (len(item) if hasattr(item, "__len__") else item)
