"""Figures of a loop's margins: Bode, Nyquist with its disks, sensitivities."""

from __future__ import annotations

import math

import numpy as np

from trms_cli.core.arrays import ComplexArray, FloatArray
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
)
from trms_cli.stability.loops.margins import (
    LoopMargins,
    MarginResult,
    StabilityLimit,
    diagonal_mu,
    largest_singular_value,
)

COLOURS: tuple[Colour, ...] = ("blue", "vermilion", "green", "purple")
_OMEGA = Axis("ω", "rad/s", log=True)
#: Side of what the Nyquist figure shows of the plane around the unit circle, and its least and
#: largest reach to the left: as far as the crossing of the real axis asks for.
_REACH, _LEAST_LEFT, _MOST_LEFT = 1.35, -2.2, -4.0
#: What the Bode figure shows of the phase, and the sensitivity's of sizes.
_DEGREES, _SIZES = (-390.0, 90.0), (0.01, 5.0)
#: Points along each side of a shaded disk's grid.
_GRID = 301


def bode(margins: MarginResult, condition: str) -> Chart:
    """Gain and phase of each loop, the others closed, with the lines at which it was measured."""
    size: list[Mark] = [Line(y=1.0)]
    phase: list[Mark] = [Line(y=-180.0)]
    lines = margins.response.omega
    at_lines = 1 / np.diagonal(margins.response.S, axis1=1, axis2=2) - 1
    for i, (loop, colour) in enumerate(zip(margins.loops, COLOURS, strict=False)):
        curve, label = margins.single[:, i], f"loop of {loop.name}"
        size.append(Curve(margins.omega, np.abs(curve), label, colour))
        size.append(Points(lines, np.abs(at_lines[:, i]), "lines measured", "dot", "ink", size=1.6))
        degrees = _degrees(curve)
        phase.append(Curve(margins.omega, degrees, label, colour))
        up, lost = loop.margins.up, loop.margins.phase
        if up is not None:
            at = float(np.interp(up.omega, margins.omega, np.abs(curve)))
            size.append(Points([up.omega], [at], "limit of the gain", "triangle", colour))
        if lost is not None:
            at = float(np.interp(lost.omega, margins.omega, degrees))
            phase.append(Points([lost.omega], [at], "limit of the phase", "square", colour))
    return Chart(
        "margins_bode",
        [
            Panel(_OMEGA, Axis("|L|", log=True), size, "Gain"),
            Panel(_OMEGA, Axis("arg L", "°", _DEGREES), phase, "Phase"),
        ],
        f"Each loop opened at its command, the others closed: {condition}.",
    )


def _degrees(curve: ComplexArray) -> FloatArray:
    """The phase without jumps, between −360° and 0 where the gain is last 1."""
    phase = np.unwrap(np.angle(curve))
    above = np.flatnonzero(np.abs(curve) >= 1)
    at = int(above[-1]) if above.size else len(curve) // 2
    turns = math.ceil(phase[at] / (2 * math.pi))
    return np.asarray(np.degrees(phase - 2 * math.pi * turns))


def nyquist(margins: MarginResult, condition: str) -> Chart:
    """Nyquist curves beside the unit circle, with the largest disk around −1 that they leave."""
    panels = []
    for i, (loop, colour) in enumerate(zip(margins.loops, COLOURS, strict=False)):
        curve = margins.single[:, i]
        real, imaginary = window(loop)
        shown = within(curve, real, imaginary)
        gaps = np.flatnonzero(np.isnan(shown.real))
        cut = int(gaps[-1]) + 1 if gaps.size else 0
        low, high = shown[:cut], shown[cut:]
        turn = np.exp(1j * np.linspace(0, 2 * math.pi, 361))
        marks: list[Mark] = [
            Line(x=0.0),
            Line(y=0.0),
            Curve(turn.real, turn.imag, "|L| = 1", "grey", "dashed", 0.8),
            _disk(loop, real, imaginary),
            # low frequencies that come by on their own, without the arrow that a gap would mislead
            *(
                Curve(part.real, part.imag, f"loop of {loop.name}", colour, arrow=part is high)
                for part in (low, high)
                if np.isfinite(part.real).sum() > 1
            ),
        ]
        limits: tuple[tuple[StabilityLimit | None, str, Marker], ...] = (
            (loop.margins.up, "limit of the gain", "triangle"),
            (loop.margins.down, "limit of the gain", "triangle"),
            (loop.margins.phase, "limit of the phase", "square"),
        )
        for limit, label, marker in limits:
            if limit is None:
                continue
            at = at_frequency(margins.omega, curve, limit.omega)
            if real[0] <= at.real <= real[1] and abs(at.imag) <= imaginary[1]:
                marks.append(Points([at.real], [at.imag], label, marker, "ink", size=5))
        marks.append(Points([-1.0], [0.0], "−1", "cross", "alarm", size=9))
        panels.append(
            Panel(
                Axis("Re L", limits=real),
                Axis("Im L", limits=imaginary),
                marks,
                f"Loop of {loop.name}",
                equal=True,
            )
        )
    return Chart(
        "margins_nyquist",
        panels,
        f"Nyquist curves for ω > 0, around the unit circle: {condition}. No gain and phase within "
        "the disk leads to −1.",
        columns=2,
        width=4.6,
        height=4.2,
    )


def window(loop: LoopMargins) -> tuple[tuple[float, float], tuple[float, float]]:
    """Limits of the real and the imaginary axis: the unit circle, and what the disk reaches."""
    disk = loop.disk
    left = -disk.gain_up if disk.alpha < 2 else _MOST_LEFT
    real = (max(_MOST_LEFT, min(_LEAST_LEFT, 1.1 * left)), _REACH)
    half = (real[1] - real[0]) / 2
    return real, (-half, half)


def within(
    curve: ComplexArray, real: tuple[float, float], imaginary: tuple[float, float]
) -> ComplexArray:
    """The curve inside a window, broken (NaN) where it is outside."""
    inside = (curve.real >= real[0]) & (curve.real <= real[1])
    inside &= (curve.imag >= imaginary[0]) & (curve.imag <= imaginary[1])
    return np.asarray(np.where(inside, curve, complex(np.nan, np.nan)))


def at_frequency(omega: FloatArray, curve: ComplexArray, wanted: float) -> complex:
    """A curve's value at a frequency between two of its own."""
    return complex(np.interp(wanted, omega, curve.real), np.interp(wanted, omega, curve.imag))


def _disk(loop: LoopMargins, real: tuple[float, float], imaginary: tuple[float, float]) -> Region:
    """Values of L from which a change within the disk margin leads to −1: −1/f, f in D(α)."""
    x, y = np.linspace(*real, _GRID), np.linspace(*imaginary, _GRID)
    z = x[None, :] + 1j * y[:, None]
    # f = (1 + δ/2)/(1 − δ/2) = −1/L solved for δ; at L = 1 it has no solution
    inside = 2 * np.abs(1 + z) < loop.disk.alpha * np.abs(1 - z)
    return Region(x, y, inside, "disk margin", "orange")


def sensitivity(margins: MarginResult, condition: str) -> Chart:
    """What each frequency is amplified by, and how large a disk it leaves."""
    S, T, omega = margins.S, margins.T, margins.omega
    size: list[Mark] = [Line(y=1.0)]
    disks: list[Mark] = [Line(y=2.0)]
    for i, (loop, colour) in enumerate(zip(margins.loops, COLOURS, strict=False)):
        size.append(Curve(omega, np.abs(S[:, i, i]), f"|S| of {loop.name}", colour))
        size.append(Curve(omega, np.abs(T[:, i, i]), f"|T| of {loop.name}", colour, "dashed"))
        top = [loop.sensitivity, loop.complementary]
        size.append(
            Points([p.omega for p in top], [p.value for p in top], "peaks", "dot", "ink", size=4)
        )
        apart = 2 / np.abs(S[:, i, i] - T[:, i, i])
        disks.append(Curve(omega, apart, f"{loop.name} alone", colour))
    panels = [Panel(_OMEGA, Axis("size", limits=_SIZES, log=True), size, "Each loop")]
    if len(margins.loops) > 1:
        both: list[Mark] = [
            Line(y=1.0),
            Curve(omega, largest_singular_value(S), "σ̄(S)", "purple"),
            Curve(omega, largest_singular_value(T), "σ̄(T)", "purple", "dashed"),
        ]
        panels.append(Panel(_OMEGA, Axis("size", limits=_SIZES, log=True), both, "Both loops"))
        disks.append(Curve(omega, 2 / diagonal_mu(S - T), "each by its own factor", "ink"))
        apart = 2 / largest_singular_value(S - T)
        disks.append(Curve(omega, apart, "any change, coupling too", "grey", "dashed"))
    panels.append(Panel(_OMEGA, Axis("size α of the disk", limits=(0.0, 2.1)), disks, "Disks"))
    return Chart(
        "margins_sensitivity",
        panels,
        f"Sensitivity S, complementary sensitivity T, and the disk that each frequency leaves: "
        f"{condition}.",
        columns=len(panels),
        width=4.0,
    )


def departure(
    time: FloatArray, angles: FloatArray, names: tuple[str, ...], condition: str
) -> Chart:
    """What a loop did that does not hold its point: the angles' distances from it."""
    marks: list[Mark] = [Line(y=0.0)]
    marks += [
        Curve(time, angles[:, i], name, colour)
        for i, (name, colour) in enumerate(zip(names, COLOURS, strict=False))
    ]
    panel = Panel(Axis("time", "s"), Axis("distance from the point", "rad"), marks)
    return Chart("margins_departure", [panel], f"The loop does not hold: {condition}.", width=6.5)
