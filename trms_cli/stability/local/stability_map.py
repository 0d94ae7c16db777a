"""Stability over two numbers at once: the largest growth rate on a grid, and its boundary."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import brentq

from trms_cli.core.arrays import FloatArray
from trms_cli.core.chart import Axis, Chart, Contour, Line, Mark, Panel, Points, Region
from trms_cli.core.errors import TrmsError
from trms_cli.core.findings import Column, Section, rounded, table
from trms_cli.models.operating_point import OperatingPoint
from trms_cli.stability.local.modes import STILL, rate_of
from trms_cli.stability.local.sweep import (
    OperatingPath,
    amount_words,
    headed,
    locus_of,
    sweep_eigenvalues,
    unit_of,
)
from trms_cli.stability.local.tables import crossing_data
from trms_cli.stability.study import Tell

#: Boundary points are located to this share of a cell.
_EXACT = 1e-10


@dataclass(frozen=True)
class StabilityMap:
    """The largest growth rate over two numbers."""

    over: FloatArray  #: (n,), (m,) arrays
    against: FloatArray  #: (n,), (m,) arrays
    #: (m, n) array; largest Re λ of what is not at rest on the imaginary axis throughout, 1/s; NaN
    #: where there is no operating point within the rig's limits
    growth: FloatArray
    #: (k, 2) array; points (over, against) where it is zero, each located along ``over``
    boundary: FloatArray


def stability_map(
    path: OperatingPath,
    against: str,
    over_range: tuple[float, float],
    against_range: tuple[float, float],
    size: tuple[int, int],
    tell: Tell,
) -> StabilityMap:
    """Evaluate a grid, row by row along the operating points.

    ``path`` goes over the first number; the second is a controlled state, an input or a parameter;
    ``size`` is how many values of each.
    """
    over = np.linspace(*over_range, size[0])
    levels = np.linspace(*against_range, size[1])
    growth = np.full((len(levels), len(over)), np.nan)
    boundary: list[tuple[float, float]] = []
    begin: OperatingPoint | None = None
    held = None
    for i, level in enumerate(levels):
        if i % 8 == 0:
            tell(f"map, {100 * i // len(levels)} %")
        row = path.moved(against, float(level))
        following = row.held(float(over[0]))
        if begin is None:
            begin = _anywhere(row, float(over[0]))
        elif held is not None:
            begin = row.balance.advance(held, following, begin) or _anywhere(row, float(over[0]))
        held = following
        if begin is not None:
            _fill(row, over, begin, growth[i], float(level), boundary)
    return StabilityMap(over, levels, growth, np.array(boundary).reshape(-1, 2))


def _anywhere(path: OperatingPath, value: float) -> OperatingPoint | None:
    try:
        return path.first(value, value).point
    except TrmsError:
        return None


def _fill(
    path: OperatingPath,
    over: FloatArray,
    begin: OperatingPoint,
    row: FloatArray,
    level: float,
    boundary: list[tuple[float, float]],
) -> None:
    """One row of the map, and its boundary points."""
    point: OperatingPoint | None = begin
    last = path.held(float(over[0]))
    for k, value in enumerate(over):
        held = path.held(float(value))
        before = point
        point = path.balance.advance(last, held, before) if before is not None else None
        if point is None:
            return
        if path.balance.within_limits(point):
            row[k] = _growth(path, float(value), point)
        if k and row[k - 1] * row[k] < 0 and before is not None:
            here, start = last, before

            def rate(v: float, here=here, start=start) -> float:  # type: ignore[no-untyped-def]
                at = path.balance.advance(here, path.held(v), start)
                return np.nan if at is None else _growth(path, v, at)

            with contextlib.suppress(ValueError, RuntimeError):
                cell = float(over[k] - over[k - 1])
                root = brentq(rate, over[k - 1], value, xtol=_EXACT * abs(cell))
                if abs(rate(root)) < 1e-6:
                    boundary.append((float(root), level))
        last = held


def _growth(path: OperatingPath, value: float, point: OperatingPoint) -> float:
    a = path.linear.a(point.x, point.u, path.side, path.held(value).p)
    rates = [rate_of(v, path.model.sample_time) for v in np.linalg.eigvals(a)]
    moving = [rate.real for rate in rates if abs(rate) > STILL and np.isfinite(rate.real)]
    return max(moving, default=0.0)


#: 1/s: growth rates whose lines are drawn.
_LEVELS = (-0.1, -0.04, -0.02, 0.02, 0.1, 0.3)


def boundary_along(
    path: OperatingPath,
    against: str,
    span: tuple[float, float],
    span_2: tuple[float, float],
    tell: Tell,
) -> list[dict[str, Any]]:
    """Where stability ends along the second number, at both ends and the model's own value."""
    own = [path.began] if span[0] < path.began < span[1] else []
    boundaries = []
    for value in (span[0], *own, span[1]):
        tell(f"along {against} at {amount_words(path.model, path.over, value, 4)}")
        line = OperatingPath(path.model, path.at, against, path.side).moved(path.over, value)
        try:
            run = sweep_eigenvalues(line, *span_2, 41)
        except TrmsError:
            continue  # no operating point there: the map has a hole
        locus = locus_of(line, run)
        boundaries.append(
            {
                "over": float(value),
                "against_range": [float(run.values[0]), float(run.values[-1])],
                "crossings": crossing_data(locus),
            }
        )
    return boundaries


def map_section(
    path: OperatingPath, against: str, mapped: StabilityMap, at_ends: list[dict[str, Any]]
) -> Section:
    """The map, and where stability ends along the second number."""
    grid, growth = (mapped.over, mapped.against), mapped.growth
    nowhere, finite = ~np.isfinite(growth), growth[np.isfinite(growth)]
    unit_2 = unit_of(path.model, against)
    marks: list[Mark] = []
    if (growth > 0).any():
        marks.append(Region(*grid, growth > 0, "unstable", "alarm", 0.14))
    if nowhere.any():
        marks.append(Region(*grid, nowhere, "no operating point within the limits", "grey", 0.3))
    low, high = (finite.min(), finite.max()) if finite.size else (0.0, 0.0)
    if low < 0 < high:
        marks.append(Contour(*grid, growth, [0.0], "boundary", "alarm", width=2.2))
    levels = [level for level in _LEVELS if low < level < high]
    if len(levels) < 2 and low < high:
        # None of the usual ones lies within: some that do.
        levels = [float(f"{v:.2g}") for v in np.linspace(low, high, 7)[1:-1]]
    if levels:
        levels, label = sorted(set(levels)), "largest Re λ [1/s]"
        marks.append(Contour(*grid, growth, levels, label, "grey", "dotted", 1.0, True))
    if len(mapped.boundary):
        located = mapped.boundary[:, 0], mapped.boundary[:, 1]
        marks.append(Points(*located, "located", "dot", "alarm", size=3.0))
    inside, rows = ((float(ends[0]), float(ends[-1])) for ends in grid)
    rim = 0.01 * (inside[1] - inside[0])
    if inside[0] + rim < path.began < inside[1] - rim:  # on the frame it could not be told from it
        own = f"the model's {path.over}"
        marks.append(Line(x=path.began, label=own, colour="ink", style="dashed"))
    held = {name: v for name, v in path.at.items() if name not in (path.over, against)}
    where = "".join(f", {amount_words(path.model, name, v)}" for name, v in held.items() if v)
    chart = Chart(
        "root_locus_map",
        [Panel(Axis(path.over, path.unit, inside), Axis(against, unit_2, rows), marks)],
        f"Largest growth rate over {path.over} and {against}{where}.",
        1,
        7.2,
        5.0,
    )
    ends = table(
        (c | {"over": end["over"]} for end in at_ends for c in end["crossings"]),
        [
            Column(path.head, lambda c: rounded(c["over"], 5)),
            Column("mode", "mode"),
            Column(headed(against, unit_2), lambda c: rounded(c["value"], 5)),
            Column("ω [rad/s]", lambda c: rounded(c["frequency_rad_s"])),
            Column("unstable", lambda c: "above" if c["unstable_above"] else "below"),
        ],
        f"Where stability ends along {against}.",
    )
    text = [
        f"The largest growth rate of what is not at rest on the imaginary axis, over {path.over} "
        f"and {against}; the boundary is located along {path.over} in each row of the grid."
    ]
    return Section(f"{path.over} against {against}", text, [chart, *([ends] if ends.rows else [])])
