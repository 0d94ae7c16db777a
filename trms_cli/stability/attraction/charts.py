"""Figures of a region of attraction."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from trms_cli.core.chart import (
    Axis,
    Chart,
    Colour,
    Contour,
    Curve,
    Mark,
    Marker,
    Panel,
    Points,
    Region,
)
from trms_cli.stability.attraction.estimates import Estimate, Method
from trms_cli.stability.attraction.inquiry import Region as Found
from trms_cli.stability.attraction.truth import SETTLED

FloatArray = npt.NDArray[np.float64]

_COLOURS: dict[Method, Colour] = {
    "lyapunov": "ink",
    "inclusion": "purple",
    "level_set": "blue",
    "integrals": "vermilion",
    "quartic": "green",
}
#: Lines of the grid on which V is drawn.
_FINE = 241


def plane_chart(found: Found) -> Chart:
    """The plane: the region by simulation, the estimates, other equilibria, motions."""
    i, j = found.plane.axes
    if i == j:
        raise ValueError("a plane needs two states")
    panels = [_panel(found, found.box, "")]
    small = [v.estimate for v in found.verdicts if _size(v.estimate, found) < 0.25]
    if small:
        box = found.box.copy()
        box[[i, j]] = 1.3 * np.max([_reach(e, found) for e in small], axis=0)
        panels.append(_panel(found, box, "near the equilibrium"))
    names, model = found.starts.names, found.system.model
    others = [n for k, n in enumerate(names) if k not in (i, j)]
    rest = [*others, *found.system.settled]
    section = f" In the plane {', '.join(rest)} start at rest." if rest else ""
    unproved = any(not v.estimate.proved for v in found.verdicts)
    return Chart(
        "region_of_attraction",
        panels,
        f"Region of attraction of {found.system.point.words(model)}: shaded, which starts come to "
        "rest there in simulation; lines, what is proved to be attracted"
        + (" (dashed: sampled only)." if unproved else ".")
        + section,
        columns=2,
        width=4.8,
        height=4.2,
    )


def _size(estimate: Estimate, found: Found) -> float:
    return float(np.max(_reach(estimate, found) / found.box[list(found.plane.axes)]))


def _reach(estimate: Estimate, found: Found) -> FloatArray:
    """Half-widths of the section of a set with the plane, (2,); tiny for an empty one."""
    axes = list(found.plane.axes)
    half = found.box[axes].copy()
    for _ in range(16):
        d, _, _ = _grid(found, half, 61)
        inside = np.abs(d[estimate.contains(found.starts.of(d))][:, axes])
        reach = inside.max(axis=0, initial=0.0) + half / 30.0
        if np.all(reach > 0.4 * half):
            return np.asarray(np.minimum(reach, half))
        half = np.minimum(half, np.maximum(1.2 * reach, 0.25 * half))
    return half


def _grid(found: Found, half: FloatArray, lines: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Starts of a grid in the plane, (lines², m), and its lines."""
    i, j = found.plane.axes
    x, y = (np.linspace(-half[k], half[k], lines) for k in (0, 1))
    across, up = np.meshgrid(x, y)
    d = np.zeros((across.size, len(found.box)))
    d[:, i], d[:, j] = across.ravel(), up.ravel()
    return d, x, y


def _panel(found: Found, box: FloatArray, title: str) -> Panel:
    (i, j), whole = found.plane.axes, title == ""
    origin = _origin(found)
    inside = found.plane.fate == SETTLED
    near = np.ix_(np.abs(found.plane.y) <= box[j], np.abs(found.plane.x) <= box[i])
    marks: list[Mark] = []
    if np.any(inside[near]):
        marks.append(
            Region(
                origin[i] + found.plane.x,
                origin[j] + found.plane.y,
                inside,
                "comes to rest (simulated)",
                "sky",
                0.35,
            )
        )
    if whole and found.starts.direct:
        for path, settled in found.plane.paths:
            out = np.any(np.abs(path[:, [i, j]]) > 1.02 * box[[i, j]], axis=1)
            if np.all(out):
                continue
            shown = np.where(out[:, None], np.nan, path)
            colour: Colour = "grey" if settled else "orange"
            label = "motions that do" if settled else "motions that do not"
            marks.append(
                Curve(
                    origin[i] + shown[:, i],
                    origin[j] + shown[:, j],
                    label,
                    colour,
                    width=0.7,
                    arrow=True,
                )
            )
    marks += [mark for v in found.verdicts if (mark := _contour(v.estimate, found, box))]
    marks.append(Points([origin[i]], [origin[j]], "equilibrium", "stable", "ink"))
    for rest in found.rests:
        place = rest.y if found.starts.direct else rest.y[: len(box)]
        if np.all(np.abs(place[[i, j]]) <= box[[i, j]]):
            label = "another rest" if rest.stable else "saddle"
            marker: Marker = "stable" if rest.stable else "saddle"
            marks.append(
                Points(
                    [origin[i] + place[i]], [origin[j] + place[j]], label, marker, "alarm", size=8
                )
            )
    names, model = found.starts.names, found.system.model
    axes = [
        Axis(
            names[k],
            model.states[model.state_index(names[k])].unit,
            (float(origin[k] - box[k]), float(origin[k] + box[k])),
        )
        for k in (i, j)
    ]
    return Panel(axes[0], axes[1], marks, title)


def _origin(found: Found) -> FloatArray:
    model = found.system.model
    return np.array([found.system.point.x[model.state_index(n)] for n in found.starts.names])


def _contour(estimate: Estimate, found: Found, box: FloatArray) -> Contour | None:
    i, j = found.plane.axes
    origin = _origin(found)
    # As fine as the set is small.
    d, x, y = _grid(found, np.minimum(1.1 * _reach(estimate, found), box[[i, j]]), _FINE)
    states = found.starts.of(d)
    near = np.all(np.abs(np.linalg.solve(estimate.frame, states.T)) <= 1.2, axis=0)
    values = np.where(near, estimate.candidate.values(states) / estimate.level, np.nan)
    seen = values.reshape(_FINE, _FINE)[np.ix_(np.abs(y) <= box[j], np.abs(x) <= box[i])]
    # A line that does not cross the window would still be in its legend.
    if not (np.any(seen < 1.0) and np.any(seen >= 1.0)):
        return None
    label = estimate.label if estimate.proved else f"{estimate.label} (sampled)"
    return Contour(
        origin[i] + x,
        origin[j] + y,
        values.reshape(_FINE, _FINE),
        [1.0],
        label,
        _COLOURS[estimate.method],
        "solid" if estimate.proved else "dashed",
        1.6,
    )
