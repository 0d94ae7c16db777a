"""Figures of a Lyapunov function: its wells, its sets N and N′ in planes, V along motions."""

from __future__ import annotations

import math

import numpy as np

from trms_cli.core.arrays import BoolArray, FloatArray
from trms_cli.core.chart import Axis, Chart, Contour, Curve, Line, Mark, Note, Panel, Points, Region
from trms_cli.stability.intervals.definite import definite
from trms_cli.stability.intervals.interval import Interval
from trms_cli.stability.lyapunov.candidate import EnergyCandidate
from trms_cli.stability.lyapunov.certificate import LyapunovCertificate
from trms_cli.stability.lyapunov.motions import LevelMotions

_GRID = 101
_SYMBOL = {"Omega": "Ω", "omega": "ω", "alpha": "α"}
_UNIT = {"Omega": "rad/s", "omega": "rad/s", "alpha": "rad"}


def well_chart(certificate: LyapunovCertificate) -> Chart:
    """U of each axis with its equilibria, levels and stops."""
    candidate = certificate.search.candidate
    panels = [_well(certificate, a) for a in candidate.energy.axes]
    return Chart(
        "lyapunov_well",
        panels,
        "The potential of each axis at the constant command, zero at the equilibrium. A motion "
        "that begins below a level stays between the walls it meets there.",
        columns=len(panels),
    )


def _well(certificate: LyapunovCertificate, axis: str) -> Panel:
    candidate, wells = certificate.search.candidate, certificate.search.wells
    energy = candidate.energy
    rest = float(candidate.centre[energy.index("alpha", axis)])
    stop = energy.model.stops[f"alpha_{axis}"]
    marks: list[Mark] = []
    if axis == "v" and wells.saddles is not None:
        low, high = wells.saddles
        ends = (max(low - 0.3, rest - 2.6), min(high + 0.5, rest + 2.6))
    else:
        reach = stop * 1.15 if math.isfinite(stop) else 3.0
        ends = (-reach, reach)
    angles = np.linspace(*ends, 301)
    marks.append(Curve(angles, _potential(candidate, axis, angles), width=2.0))
    top = float(np.nanmax(_potential(candidate, axis, angles)))
    for saddle in wells.saddles or () if axis == "v" else ():
        if ends[0] <= saddle <= ends[1]:
            height = _potential(candidate, axis, np.array([saddle]))
            marks.append(Points([saddle], height, "saddle", "saddle", "vermilion"))
    if certificate.outer > 0.0 and math.isfinite(certificate.outer):
        marks.append(Line(y=certificate.outer, label="edge of N", colour="orange", style="dashed"))
    if certificate.inner > 0.0:
        marks.append(Line(y=certificate.inner, label="edge of N′", colour="green", style="dashed"))
    if math.isfinite(stop):
        marks += [
            Line(x=end, label="stop", colour="grey")
            for end in (-stop, stop)
            if ends[0] <= end <= ends[1]
        ]
    marks.append(Points([rest], [0.0], "equilibrium", "stable", "ink"))
    return Panel(
        Axis(f"α_{axis}", "rad", ends),
        Axis(f"U_{axis}", "J", (-0.05 * top, 1.05 * top)),
        marks,
        "Pitch" if axis == "v" else "Yaw",
    )


def _potential(candidate: EnergyCandidate, axis: str, angles: FloatArray) -> FloatArray:
    y = np.tile(candidate.centre, (len(angles), 1))
    y[:, candidate.energy.index("alpha", axis)] = angles
    cross = candidate.weights
    plain = candidate.weighted(type(cross)(cross.rotor_h, cross.rotor_v, cross.yaw))
    return plain.value(y)


def plane_chart(
    certificate: LyapunovCertificate, paths: dict[str, LevelMotions], display: float
) -> Chart:
    """N and N′ in the plane of each angle and its rate, and where the decay is not proved."""
    candidate = certificate.search.candidate
    panels = [_plane(certificate, a, paths.get(a), display) for a in candidate.energy.axes]
    if candidate.energy.k == 2:
        panels.append(_limits(certificate, ("alpha", "v"), ("Omega", "h"), display))
    else:
        (a,) = candidate.energy.axes
        panels.append(_rates(certificate, a, display))
    return Chart(
        "lyapunov_sets",
        panels,
        "Level lines of V, with all that is not on the axes at the equilibrium. Motions cross them "
        "inwards.",
        columns=min(len(panels), 3),
        width=4.0,
    )


def _grid(
    certificate: LyapunovCertificate, first: tuple[str, str], second: tuple[str, str], level: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Grid lines around {V <= level}, and states of motion (rows, columns, 3k)."""
    candidate = certificate.search.candidate
    energy, rest = candidate.energy, candidate.centre
    box = candidate.extent(level, certificate.search.wells.ends)
    lines = []
    for what, axis in (first, second):
        j = energy.index(what, axis)
        low, high = float(box.lower[j]), float(box.upper[j])
        if what == "Omega":  # as far as the set goes at the equilibrium's inertia
            i, gamma = energy.axes.index(axis), candidate.weights.yaw if axis == "h" else 1.0
            inertia = np.array(energy.inertia(rest))
            reach = 1.1 * math.sqrt(2.0 * level * np.linalg.inv(inertia)[i, i] / gamma)
            low, high = max(low, -reach), min(high, reach)
        room = 0.08 * (high - low)
        lines.append(np.linspace(low - room, high + room, _GRID))
    places = np.tile(rest, (_GRID, _GRID, 1))
    places[:, :, energy.index(*first)] = lines[0][None, :]
    places[:, :, energy.index(*second)] = lines[1][:, None]
    return lines[0], lines[1], places


def _plane(
    certificate: LyapunovCertificate, axis: str, seen: LevelMotions | None, display: float
) -> Panel:
    candidate, wells = certificate.search.candidate, certificate.search.wells
    energy = candidate.energy
    x, y, places = _grid(certificate, ("alpha", axis), ("Omega", axis), display)
    value = candidate.value(places.reshape(-1, places.shape[2])).reshape(_GRID, _GRID)
    i = energy.axes.index(axis)
    between = (x > wells.ends.lower[i]) & (x < wells.ends.upper[i])
    marks: list[Mark] = _sets(certificate, x, y, value, between)
    levels = [display * share for share in (0.05, 0.2, 0.45, 0.7, 1.0)]
    marks.append(Contour(x, y, value, levels, "level sets of V", "grey", width=0.8))
    if seen is not None:
        for m in range(seen.y.shape[1]):
            path = seen.y[:, m]
            marks.append(
                Curve(
                    path[:, energy.index("alpha", axis)],
                    path[:, energy.index("Omega", axis)],
                    "motions" if m == 0 else "",
                    "blue",
                    width=0.9,
                    arrow=True,
                )
            )
    rest = float(candidate.centre[energy.index("alpha", axis)])
    marks.append(Points([rest], [0.0], "equilibrium", "stable", "ink"))
    for saddle in (wells.saddles or ()) if axis == "v" else ():
        if x[0] <= saddle <= x[-1]:
            marks.append(Points([saddle], [0.0], "saddle", "saddle", "vermilion"))
    return Panel(
        Axis(f"α_{axis}", "rad", (float(x[0]), float(x[-1]))),
        Axis(f"Ω_{axis}", "rad/s", (float(y[0]), float(y[-1]))),
        marks,
        "Pitch, rotors settled" if axis == "v" else "Yaw, rotors settled",
    )


def _sets(
    certificate: LyapunovCertificate,
    x: FloatArray,
    y: FloatArray,
    value: FloatArray,
    between: BoolArray,
) -> list[Mark]:
    marks: list[Mark] = []
    inside = np.broadcast_to(between, value.shape)
    if math.isfinite(certificate.outer) and certificate.outer > 0.0:
        marks.append(Region(x, y, (value < certificate.outer) & inside, "N", "orange", 0.3))
        marks.append(Contour(x, y, value, [certificate.outer], colour="orange", width=1.2))
    if certificate.inner > 0.0:
        marks.append(Region(x, y, (value <= certificate.inner) & inside, "N′", "green", 0.35))
        marks.append(Contour(x, y, value, [certificate.inner], colour="green", width=1.4))
    return marks


def _limits(
    certificate: LyapunovCertificate,
    first: tuple[str, str],
    second: tuple[str, str],
    display: float,
) -> Panel:
    """Where Q is not definite, beside N."""
    candidate = certificate.search.candidate
    whole = certificate.outer >= certificate.search.wells.depth * (1.0 - 1e-6)
    x, y, places = _grid(certificate, first, second, display if whole else 1.6 * display)
    flat = places.reshape(-1, places.shape[2])
    value = candidate.value(flat).reshape(_GRID, _GRID)
    bad = ~definite(candidate.matrices(Interval.point(flat)))[0].reshape(_GRID, _GRID)
    marks = _sets(certificate, x, y, value, np.ones(_GRID, dtype=bool))
    if bad.any():
        marks.append(Region(x, y, bad, "no decay proved", "vermilion", 0.3))
    marks.append(
        Contour(x, y, value, [display * s for s in (0.1, 0.4, 1.0)], "", "grey", width=0.8)
    )
    marks.append(_centre(candidate, first, second))
    return Panel(
        Axis(_name(first), _UNIT[first[0]]),
        Axis(_name(second), _UNIT[second[0]]),
        marks,
        "The decay is proved all over" if whole else "Where the decay ends",
    )


def _rates(certificate: LyapunovCertificate, axis: str, display: float) -> Panel:
    """V̇ over rotor speed and rate."""
    candidate = certificate.search.candidate
    first, second = ("omega", axis), ("Omega", axis)
    x, y, places = _grid(certificate, first, second, display)
    flat = places.reshape(-1, places.shape[2])
    rate = candidate.derivative(candidate.states(flat)).reshape(_GRID, _GRID)
    value = candidate.value(flat).reshape(_GRID, _GRID)
    marks = _sets(certificate, x, y, value, np.ones(_GRID, dtype=bool))
    # The decay −V̇: the minus sign of a negative level is lost in the line that it stands on.
    fastest = float(-rate.min())
    factor, unit = next(
        (f, u) for f, u in ((1.0, "W"), (1e3, "mW"), (1e6, "µW")) if f * fastest >= 1.0 or f == 1e6
    )
    marks.append(
        Contour(
            x,
            y,
            -factor * rate,
            [float(f"{factor * fastest * s:.2g}") for s in (0.6, 0.3, 0.1, 0.03, 0.01)],
            f"decay −V̇ [{unit}]",
            "purple",
            width=1.0,
            numbers=True,
        )
    )
    if (rate > 0.0).any():
        marks.append(Region(x, y, rate > 0.0, "V̇ > 0", "vermilion", 0.3))
    marks.append(_centre(candidate, first, second))
    return Panel(
        Axis(_name(first), _UNIT[first[0]], (float(x[0]), float(x[-1]))),
        Axis(_name(second), _UNIT[second[0]], (float(y[0]), float(y[-1]))),
        marks,
        "Decay −V̇ over rotor speed and rate",
    )


def _centre(candidate: EnergyCandidate, first: tuple[str, str], second: tuple[str, str]) -> Points:
    rest, index = candidate.centre, candidate.energy.index
    return Points([rest[index(*first)]], [rest[index(*second)]], "equilibrium", "stable", "ink")


def _name(which: tuple[str, str]) -> str:
    return f"{_SYMBOL[which[0]]}_{which[1]}"


def decay_chart(seen: LevelMotions, proved: bool) -> Chart:
    """V over time."""
    share = np.maximum(seen.value / seen.level, 1e-12)
    marks: list[Mark] = [
        Curve(seen.time, share[:, m], "motions" if m == 0 else "", "blue", width=0.9)
        for m in range(share.shape[1])
    ]
    marks.append(Line(y=1.0, label="start", colour="green", style="dashed"))
    if not proved:
        marks.append(Note(float(seen.time[-1]) * 0.05, float(share.max()), "V rises", "vermilion"))
    low = max(1e-9, 0.5 * float(share.min()))
    return Chart(
        "lyapunov_decay",
        [
            Panel(
                Axis("time", "s"),
                Axis("V / V at the start", "", (low, 2.0 * max(1.0, float(share.max()))), log=True),
                marks,
                "V along motions",
            )
        ],
        "V along motions of the model from random states on one level set"
        + (" (the edge of N′): it only falls." if proved else ": it is no Lyapunov function here."),
        columns=1,
        width=6.0,
    )
