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
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

Values = Sequence[float] | npt.NDArray[np.float64]
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
    "alarm",
]
Style = Literal["solid", "dashed", "dotted"]
#: ``stable`` a filled disc, ``unstable`` a ring, ``saddle`` a half-filled diamond.
Marker = Literal["stable", "unstable", "saddle", "star", "dot", "cross", "square", "triangle"]


@dataclass(frozen=True)
class Axis:
    """An axis of a panel.

    Attributes
    ----------
    label, unit : str
        What and in which unit; an empty unit shows none.
    limits : (float, float) or None
        None: as the marks need.
    log : bool
    """

    label: str
    unit: str = ""
    limits: tuple[float, float] | None = None
    log: bool = False


@dataclass(frozen=True)
class Curve:
    """A line through points; NaN breaks it.

    Attributes
    ----------
    x, y : (n,)
    label : str
        In the legend; empty for none. Equal labels of a panel stand there once.
    colour : Colour
    style : Style
    width : float
        Points.
    arrow : bool
        Whether an arrowhead on it tells its direction.
    z : (n,) or None
        In a panel of three axes.
    """

    x: Values
    y: Values
    label: str = ""
    colour: Colour = "blue"
    style: Style = "solid"
    width: float = 1.4
    arrow: bool = False
    z: Values | None = None


@dataclass(frozen=True)
class Points:
    """Single points.

    Attributes
    ----------
    x, y : (n,)
    label : str
    marker : Marker
    colour : Colour
    names : sequence of str
        Written beside the points; empty for none.
    size : float
        Points.
    z : (n,) or None
        In a panel of three axes.
    """

    x: Values
    y: Values
    label: str = ""
    marker: Marker = "dot"
    colour: Colour = "ink"
    names: Sequence[str] = ()
    size: float = 6.0
    z: Values | None = None


@dataclass(frozen=True)
class Flow:
    """Stream lines of a vector field in the plane.

    Attributes
    ----------
    x, y : (n,), (m,)
        Grid lines, equally spaced.
    u, v : (m, n)
        Components at ``(x[j], y[i])``.
    colour : Colour
    density : float
    """

    x: Values
    y: Values
    u: npt.NDArray[np.float64]
    v: npt.NDArray[np.float64]
    colour: Colour = "grey"
    density: float = 1.0


@dataclass(frozen=True)
class Contour:
    """Level lines of a function on a grid: nullclines (level 0), level sets of a V.

    Attributes
    ----------
    x, y : (n,), (m,)
    values : (m, n)
        At ``(x[j], y[i])``; NaN where there is none.
    levels : sequence of float
    label : str
    colour : Colour
    style : Style
    width : float
    numbers : bool
        Whether the levels are written on the lines.
    """

    x: Values
    y: Values
    values: npt.NDArray[np.float64]
    levels: Sequence[float]
    label: str = ""
    colour: Colour = "blue"
    style: Style = "solid"
    width: float = 1.4
    numbers: bool = False


@dataclass(frozen=True)
class Region:
    """A shaded set, on a grid.

    Attributes
    ----------
    x, y : (n,), (m,)
    inside : (m, n) bool
        Whether ``(x[j], y[i])`` belongs to it.
    label : str
    colour : Colour
    opacity : float
    """

    x: Values
    y: Values
    inside: npt.NDArray[np.bool_]
    label: str = ""
    colour: Colour = "sky"
    opacity: float = 0.25


@dataclass(frozen=True)
class Band:
    """A shaded strip between two curves.

    Attributes
    ----------
    x, lower, upper : (n,)
    label : str
    colour : Colour
    opacity : float
    """

    x: Values
    lower: Values
    upper: Values
    label: str = ""
    colour: Colour = "sky"
    opacity: float = 0.25


@dataclass(frozen=True)
class Line:
    """A line across the panel, at one value of x or of y.

    Attributes
    ----------
    x, y : float or None
        One of the two.
    label : str
    colour : Colour
    style : Style
    """

    x: float | None = None
    y: float | None = None
    label: str = ""
    colour: Colour = "grey"
    style: Style = "dotted"


@dataclass(frozen=True)
class Note:
    """A few words at a place.

    Attributes
    ----------
    x, y : float
    text : str
    colour : Colour
    """

    x: float
    y: float
    text: str
    colour: Colour = "ink"


Mark = Curve | Points | Flow | Contour | Region | Band | Line | Note


@dataclass(frozen=True)
class Panel:
    """One coordinate system.

    Attributes
    ----------
    x, y : Axis
    marks : sequence of marks
        Drawn in order, what comes later on top.
    title : str
    z : Axis or None
        A third axis; curves and points only then.
    equal : bool
        One unit of x is as long as one of y.
    """

    x: Axis
    y: Axis
    marks: Sequence[Mark]
    title: str = ""
    z: Axis | None = None
    equal: bool = False


@dataclass(frozen=True)
class Chart:
    """A figure of one or more panels.

    Attributes
    ----------
    name : str
        File name without its ending.
    panels : sequence of Panel
    caption : str
        A sentence under it: what is seen, with the condition.
    columns : int
        Panels in a row.
    width, height : float
        Inches, of a panel.
    """

    name: str
    panels: Sequence[Panel]
    caption: str = ""
    columns: int = 2
    width: float = 4.4
    height: float = 3.2


def as_data(chart: Chart) -> dict[str, Any]:
    """A chart as JSON data; numbers to six digits, what is not finite as None."""
    data: dict[str, Any] = _plain(chart)
    return data


#: What a mark is called in JSON.
_KINDS = {
    kind: kind.__name__.lower() for kind in (Curve, Points, Flow, Contour, Region, Band, Line, Note)
}


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, bool | np.bool_):
        return bool(value)
    if isinstance(value, float | np.floating):
        return float(f"{float(value):.6g}") if math.isfinite(value) else None
    if isinstance(value, int | np.integer):
        return int(value)
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if hasattr(value, "__dataclass_fields__"):
        kind = {"kind": _KINDS[type(value)]} if type(value) in _KINDS else {}
        return kind | {f.name: _plain(getattr(value, f.name)) for f in fields(value)}
    return value
