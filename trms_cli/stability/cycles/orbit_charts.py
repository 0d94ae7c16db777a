"""Figures of periodic orbits: phase plane, one period, multipliers on the unit circle, branches."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from trms_cli.core.arrays import FloatArray
from trms_cli.core.chart import Axis, Chart, Colour, Curve, Line, Mark, Marker, Panel, Points, Style
from trms_cli.core.wording import symbol
from trms_cli.models.model import Model
from trms_cli.stability.cycles.branch import Branch, EquilibriumBranch, Hopf
from trms_cli.stability.cycles.search import OrbitSearch
from trms_cli.stability.cycles.shooting import Orbit

#: Motions drawn beside the orbits, and how long, s.
_DRAWN, _SHOWN = 5, 40.0
#: Orbits drawn of a continuum, spread over their sizes.
_OF_MANY = 7


def plane(
    model: Model,
    search: OrbitSearch,
    x: FloatArray,
    state: int,
    words: str,
    name: str = "limit_cycles",
) -> Chart:
    """Orbits and motions in the plane of a state and its rate, and the orbits over time."""
    signal = model.states[state]
    label = symbol(signal.name)
    marks: list[Mark] = []
    shown = round(_SHOWN / search.step)
    drawn = [*search.orbits, *search.continuum]
    grey: Colour = "pale" if drawn else "grey"
    moving = [motion for motion in search.motions if motion.fate != "leaves"]
    for i, motion in enumerate(moving[:_DRAWN]):
        path = motion.path[:shown, state]
        rate = np.gradient(path, search.step)
        marks.append(Curve(path, rate, "motions" if i == 0 else "", grey, width=0.6))
    over_time: list[Mark] = []
    many = sorted(search.continuum, key=lambda orbit: float(orbit.swing[state]))
    chosen = np.linspace(0, len(many) - 1, min(len(many), _OF_MANY)).round().astype(int)
    several: list[tuple[Orbit, tuple[Colour, Style, str]]] = [
        (many[i], ("purple", "solid", "orbits of a continuum")) for i in chosen
    ]
    for orbit, look in [*((one, _look(one)) for one in search.orbits), *several]:
        colour, style, words_of = look
        path = orbit.path[:, state]
        rate = np.gradient(path, orbit.period / (len(path) - 1))
        marks.append(Curve(path, rate, words_of, colour, style, width=2.0, arrow=True))
        over_time.append(Curve(orbit.time, path, words_of, colour, style, width=1.8))
    marks.append(Points([x[state]], [0.0], "equilibrium", "dot", "ink"))
    stop = model.stops.get(signal.name)
    if stop is not None and drawn:
        low, high = _span(drawn, state)
        for at in (-stop, stop):
            if low < at < high:
                marks.append(Line(x=at, label="mechanical stop", colour="alarm"))
                over_time.append(Line(y=at, label="mechanical stop", colour="alarm"))
    panels = [
        Panel(Axis(label, signal.unit), Axis(f"d{label}/dt", f"{signal.unit}/s"), marks, "Plane")
    ]
    if over_time:
        panels.append(Panel(Axis("time", "s"), Axis(label, signal.unit), over_time, "One period"))
    return Chart(name, panels, words)


def _look(orbit: Orbit) -> tuple[Colour, Style, str]:
    if orbit.stable:
        return "blue", "solid", "stable cycle"
    return "vermilion", "dashed", "unstable cycle"


def _span(orbits: Sequence[Orbit], state: int) -> tuple[float, float]:
    return (
        min(float(orbit.path[:, state].min()) for orbit in orbits) - 0.05,
        max(float(orbit.path[:, state].max()) for orbit in orbits) + 0.05,
    )


def multipliers(orbits: Sequence[Orbit]) -> Chart:
    """Floquet multipliers on the unit circle."""
    turn = np.linspace(0.0, 2.0 * np.pi, 181)
    marks: list[Mark] = [Curve(np.cos(turn), np.sin(turn), "", "grey", "solid", 1.0)]
    for orbit in orbits:
        colour, _, words = _look(orbit)
        others = orbit.multipliers[1:]
        marks.append(
            Points(
                others.real,
                others.imag,
                f"of the {words}",
                "stable" if orbit.stable else "unstable",
                colour,
                size=7.0,
            )
        )
    marks.append(Points([1.0], [0.0], "trivial, 1", "cross", "ink", size=8.0))
    return Chart(
        "floquet_multipliers",
        [Panel(Axis("real part"), Axis("imaginary part"), marks, equal=True)],
        "Floquet multipliers of the cycles found: what a deviation is multiplied by in one period. "
        "A cycle is stable if all but the trivial one lie within the circle.",
        columns=1,
        height=4.2,
    )


def diagram(
    model: Model,
    curve: EquilibriumBranch,
    hopfs: Sequence[Hopf],
    followed: Sequence[Branch],
    channel: int,
    state: int,
    at: float,
) -> Chart:
    """Equilibria and cycles over a command."""
    signal, command = model.states[state], model.inputs[channel]
    label = symbol(signal.name)
    marks: list[Mark] = []
    values = curve.x[:, state]
    steady = curve.growth < 0
    marks.append(Curve(curve.commands, np.where(steady, values, np.nan), "stable rest", "ink"))
    if not np.all(steady):
        marks.append(
            Curve(
                curve.commands, np.where(steady, np.nan, values), "unstable rest", "grey", "dashed"
            )
        )
    periods: list[Mark] = []
    for branch in followed:
        if not branch.orbits:
            continue
        commands = branch.commands(channel)
        high = np.array([orbit.path[:, state].max() for orbit in branch.orbits])
        low = np.array([orbit.path[:, state].min() for orbit in branch.orbits])
        lengths = np.array([orbit.period for orbit in branch.orbits])
        changes = branch.changes(channel, state)
        stable, unstable = branch.stable(), ~branch.stable()
        # Both curves go to the change between two orbits, and neither beyond it.
        for change in reversed(changes):
            k = change.after + 1
            commands = np.insert(commands, k, change.command)
            high, low = np.insert(high, k, change.highest), np.insert(low, k, change.lowest)
            lengths = np.insert(lengths, k, change.period)
            ends = [side[k - 1] or side[k] for side in (stable, unstable)]
            stable, unstable = (
                np.insert(side, k, end) for side, end in zip((stable, unstable), ends, strict=True)
            )
        for chosen, words, colour, style in (
            (stable, "stable cycle", "blue", "solid"),
            (unstable, "unstable cycle", "vermilion", "dashed"),
        ):
            if not chosen.any():
                continue
            for edge in (high, low):
                marks.append(_part(commands, edge, chosen, words, colour, style))
            periods.append(_part(commands, lengths, chosen, "", colour, style))
        for change in changes:
            shape = _MARKERS[change.kind]
            edges = [change.lowest, change.highest]
            marks.append(Points([change.command] * 2, edges, change.kind, shape, "purple"))
            periods.append(Points([change.command], [change.period], "", shape, "purple"))
    if hopfs:
        marks.append(
            Points(
                [float(h.u[channel]) for h in hopfs],
                [float(h.x[state]) for h in hopfs],
                "Hopf point",
                "star",
                "green",
                size=9.0,
            )
        )
    marks.append(Line(x=at, label="commands asked about", colour="grey"))
    stop = model.stops.get(signal.name)
    if stop is not None:
        for place in (-stop, stop):
            marks.append(Line(y=place, label="mechanical stop", colour="alarm"))
    spread = np.concatenate([[at], *(branch.commands(channel) for branch in followed)])
    near = (float(spread.min()) - 0.4, float(spread.max()) + 0.15) if len(spread) > 1 else None
    x_axis = Axis(symbol(command.name), command.unit)
    panels = [
        Panel(
            Axis(symbol(command.name), command.unit, near),
            Axis(label, signal.unit),
            marks,
            "Rest and cycles",
        )
    ]
    if periods:
        panels.append(Panel(x_axis, Axis("period", "s"), periods, "Period of the cycles"))
    return Chart(
        "cycles_over_command",
        panels,
        f"Equilibria and cycles over {symbol(command.name)}, the other commands held.",
        width=5.0,
        height=3.8,
    )


_MARKERS: dict[str, Marker] = {"fold": "square", "period doubling": "triangle", "torus": "cross"}


def _part(
    x: FloatArray, y: FloatArray, chosen: npt.NDArray[np.bool_], words: str, colour: str, style: str
) -> Curve:
    return Curve(x, np.where(chosen, y, np.nan), words, colour, style, 1.8)  # type: ignore[arg-type]
