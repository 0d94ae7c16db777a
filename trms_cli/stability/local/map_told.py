"""The map of stability in words, figure and data."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from trms_cli.core.chart import Axis, Chart, Contour, Line, Mark, Panel, Points, Region
from trms_cli.core.errors import TrmsError
from trms_cli.core.findings import Section, Table
from trms_cli.stability.local.crossings import crossings
from trms_cli.stability.local.map import StabilityMap
from trms_cli.stability.local.sweep import Path, swept
from trms_cli.stability.local.told import amount_words, crossing_data, crossing_name
from trms_cli.stability.local.tracks import tracks_of

Tell = Callable[[str], None]

#: 1/s: growth rates whose lines are drawn.
_LEVELS = (-0.1, -0.04, -0.02, 0.02, 0.1, 0.3)


def boundary_along(
    path: Path,
    against: str,
    span: tuple[float, float],
    span_2: tuple[float, float],
    tell: Tell,
) -> list[dict[str, Any]]:
    """Where stability ends along the second number, at both ends and the model's own value."""
    values = [span[0], span[1]]
    if span[0] < path.began < span[1]:
        values.insert(1, path.began)
    found = []
    for value in values:
        tell(f"along {against} at {amount_words(path.model, path.over, value, 4)}")
        line = Path(path.model, path.at, against, path.side).moved(path.over, value)
        try:
            run = swept(line, *span_2, 41)
        except TrmsError:
            continue  # no operating point there: the map has a hole
        tracks = tracks_of(path.model, run)
        found.append(
            {
                "over": float(value),
                "against_range": [float(run.values[0]), float(run.values[-1])],
                "crossings": [
                    crossing_data(c, crossing_name(line.model, tracks, c))
                    for c in crossings(line, run)
                ],
            }
        )
    return found


def map_section(
    path: Path, against: str, mapped: StabilityMap, at_ends: list[dict[str, Any]]
) -> Section:
    """The map, and where stability ends along the second number."""
    unit_2 = Path(path.model, path.at, against).unit
    grow = mapped.growth > 0
    marks: list[Mark] = []
    if grow.any():
        marks.append(Region(mapped.over, mapped.against, grow, "unstable", "alarm", 0.14))
    nowhere = ~np.isfinite(mapped.growth)
    if nowhere.any():
        words = "no operating point within the limits"
        marks.append(Region(mapped.over, mapped.against, nowhere, words, "grey", 0.3))
    finite = mapped.growth[np.isfinite(mapped.growth)]
    if finite.size and finite.min() < 0 < finite.max():
        marks.append(
            Contour(
                mapped.over, mapped.against, mapped.growth, [0.0], "boundary", "alarm", width=2.2
            )
        )
    levels = [level for level in _LEVELS if finite.size and finite.min() < level < finite.max()]
    if len(levels) < 2 and finite.size and np.ptp(finite) > 0:
        # None of the usual ones lies within: some that do.
        levels = [float(f"{v:.2g}") for v in np.linspace(finite.min(), finite.max(), 7)[1:-1]]
    if levels:
        marks.append(
            Contour(
                mapped.over,
                mapped.against,
                mapped.growth,
                sorted(set(levels)),
                "largest Re λ [1/s]",
                "grey",
                "dotted",
                1.0,
                True,
            )
        )
    if len(mapped.boundary):
        marks.append(
            Points(
                mapped.boundary[:, 0], mapped.boundary[:, 1], "located", "dot", "alarm", size=3.0
            )
        )
    inside = float(mapped.over[0]), float(mapped.over[-1])
    rim = 0.01 * (inside[1] - inside[0])
    if inside[0] + rim < path.began < inside[1] - rim:  # on the frame it could not be told from it
        marks.append(
            Line(x=path.began, label=f"the model's {path.over}", colour="ink", style="dashed")
        )
    held = {name: v for name, v in path.at.items() if name not in (path.over, against)}
    where = "".join(f", {amount_words(path.model, name, v)}" for name, v in held.items() if v)
    x = Axis(path.over, path.unit, (float(mapped.over[0]), float(mapped.over[-1])))
    y = Axis(against, unit_2, (float(mapped.against[0]), float(mapped.against[-1])))
    chart = Chart(
        "root_locus_map",
        [Panel(x, y, marks)],
        f"Largest growth rate over {path.over} and {against}{where}.",
        1,
        7.2,
        5.0,
    )
    rows = [
        (
            float(f"{end['over']:.5g}"),
            c["mode"],
            float(f"{c['value']:.5g}"),
            float(f"{c['frequency_rad_s']:.4g}"),
            "above" if c["unstable_above"] else "below",
        )
        for end in at_ends
        for c in end["crossings"]
    ]
    first = f"{path.over} [{path.unit}]" if path.unit else path.over
    columns = (
        first,
        "mode",
        f"{against} [{unit_2}]" if unit_2 else against,
        "ω [rad/s]",
        "unstable",
    )
    text = [
        f"The largest growth rate of what is not at rest on the imaginary axis, over {path.over} "
        f"and {against}; the boundary is located along {path.over} in each row of the grid."
    ]
    blocks: list[Any] = [chart]
    if rows:
        blocks.append(Table(columns, rows, f"Where stability ends along {against}."))
    return Section(f"{path.over} against {against}", text, blocks)
