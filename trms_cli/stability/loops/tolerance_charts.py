"""Figures of what a loop tolerates: runs beside each limit, and the swing over each size."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from trms_cli.core.chart import Axis, Chart, Colour, Curve, Line, Mark, Marker, Panel, Points
from trms_cli.stability.loops.impairments import Class
from trms_cli.stability.loops.tolerance import Limits, Trial
from trms_cli.stability.loops.tolerance_search import Tried
from trms_cli.stability.loops.verdict import Kind

_COLOURS: tuple[Colour, ...] = ("blue", "vermilion", "green", "purple", "orange", "sky")
_AXES: dict[Class, Axis] = {
    "delay": Axis("delay", "s"),
    "gain": Axis("factor of the gain", log=True),
    "friction": Axis("Coulomb friction", "N m", log=True),
}
#: rad below which a swing is not shown.
_LEAST = 1e-5


def responses(limits: Sequence[Limits], trial: Trial, condition: str) -> Chart:
    """The angle that fails, just below and just above each first limit."""
    panels = []
    for found in limits:
        first = found.back
        above = first.above
        if above is None:
            continue
        axis = above.verdict.axis
        name = trial.subject.model.controlled[axis]
        marks: list[Mark] = [Line(y=0.0)]
        for tried, colour in ((above, "vermilion"), (first.below, "blue")):
            word = "just too much" if tried is above else "still stood"
            marks.append(
                Curve(tried.run.time, trial.errors(tried.run.x)[:, axis], word, colour)  # type: ignore[arg-type]
            )
        size = found.impairment.shown(above.size)
        unit = f" {found.impairment.unit}" if found.impairment.unit else ""
        title = f"{found.impairment.words}: {size:.3g}{unit}"
        panels.append(Panel(Axis("time", "s"), Axis(f"error of {name}", "rad"), marks, title))
    return Chart(
        "tolerance_responses",
        panels,
        f"Error of the angle that fails, at sizes just below and just above each limit: "
        f"{condition}.",
        columns=3,
        width=3.9,
        height=2.6,
    )


def overview(limits: Sequence[Limits], trial: Trial, condition: str) -> Chart:
    """What is left of the swing and of the error at the end, over each size that was tried."""
    panels = []
    for kind, axis in _AXES.items():
        marks: list[Mark] = [Line(y=trial.bounds.rest + trial.bounds.swing)]
        chosen = [found for found in limits if found.impairment.kind == kind]
        for i, found in enumerate(chosen):
            marks += _row(found, trial, _COLOURS[i % len(_COLOURS)])
        if chosen:
            panels.append(
                Panel(
                    axis,
                    Axis("error + swing", "rad", log=True),
                    marks,
                    {"delay": "Delay", "gain": "Gain", "friction": "Friction"}[kind],
                )
            )
    return Chart(
        "tolerance_overview",
        panels,
        f"Mean error plus swing in the last third of each run over what was made worse (stars, on "
        f"the dotted line of both bounds: where the linear loop becomes unstable): {condition}.",
        columns=len(panels),
        width=4.2,
        height=4.2,
    )


def _row(found: Limits, trial: Trial, colour: Colour) -> list[Mark]:
    impairment = found.impairment
    every = {t.size: t for t in (*found.back.tried, *found.calm.tried) if t.size != impairment.none}
    tried = [every[size] for size in sorted(every)]
    sizes = np.array([impairment.shown(t.size) for t in tried])
    left = np.array([_left(t, trial) for t in tried])
    marks: list[Mark] = [Curve(sizes, left, impairment.words, colour, width=1.0)]
    looks: tuple[tuple[Marker, str, tuple[Kind, ...]], ...] = (
        ("stable", "comes back", ("settles",)),
        ("triangle", "on its way back", ("dies out",)),
        ("square", "still creeping, or rests beside", ("still creeping", "rests beside")),
        ("cross", "swings on, or is lost", ("chatters", "swings", "is lost")),
    )
    for marker, label, kinds in looks:
        chosen = np.array([t.verdict.kind in kinds for t in tried], dtype=bool)
        if chosen.any():
            marks.append(Points(sizes[chosen], left[chosen], label, marker, colour, size=5))
    if found.predicted is not None and len(sizes):
        at, bound = impairment.shown(found.predicted), trial.bounds.rest + trial.bounds.swing
        if min(sizes) / 2 < at < 2 * max(sizes):
            marks.append(Points([at], [bound], "linear limit", "star", colour))
    return marks


def _left(tried: Tried, trial: Trial) -> float:
    """Mean error plus swing of the last third, rad, of the worse angle: what is judged.

    That at which a run is ended for one that was.
    """
    if tried.run.ended:
        return trial.lost
    verdict = tried.verdict
    return max(_LEAST, float((np.abs(verdict.rest) + verdict.swing).max()))
