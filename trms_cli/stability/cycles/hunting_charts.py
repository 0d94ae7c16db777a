"""Figures of hunting: over time, in the planes, the event map, Nyquist, and over friction."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from trms_cli.core.chart import Axis, Band, Chart, Curve, Line, Mark, Panel, Points
from trms_cli.stability.cycles.hunting_prediction import Harmonics, HuntingPrediction
from trms_cli.stability.cycles.hunting_runs import AxisRun, LevelSweep
from trms_cli.stability.cycles.stick_slip import StickSlip

#: Periods that a history shows, and s of one without a period.
_PERIODS, _SHOWN = 3.0, 60.0


def history(run: AxisRun, label: str, input_label: str) -> Chart:
    """The angle's error and the command over time, sticks shaded."""
    shown = _SHOWN if run.period is None else _PERIODS * run.period
    n = max(2, int(np.searchsorted(run.time, run.time[-1] - shown, side="left")))
    part = slice(n, None) if run.hunts else slice(0, int(np.searchsorted(run.time, shown)) + 1)
    time = run.time[part] - run.time[part][0]
    panels = []
    for values, name, unit_of in ((run.angle, label, "rad"), (run.command, input_label, "V")):
        y = values[part]
        room = 0.08 * max(float(np.ptp(y)), 1e-9)
        low, high = float(y.min()) - room, float(y.max()) + room
        at_rest = run.stuck[part]
        marks: list[Mark] = [
            Band(
                time,
                np.where(at_rest, low, np.nan),
                np.where(at_rest, high, np.nan),
                "sticks",
                "orange",
                0.2,
            ),
            Curve(time, y, "", "blue", width=1.6),
        ]
        panels.append(Panel(Axis("time", "s"), Axis(name, unit_of, (low, high)), marks))
    words = "hunting after the transient" if run.hunts else "after the push"
    return Chart(
        "hunting_history",
        panels,
        f"The loop in simulation, {words}: while the axis sticks the integral ramps.",
        columns=1,
        width=7.5,
        height=2.4,
    )


def planes(
    run: AxisRun,
    prediction: HuntingPrediction | None,
    events: StickSlip | None,
    label: str,
    input_label: str,
) -> Chart:
    """One cycle in the plane of angle and rate, and of angle and command."""
    period = run.period or _SHOWN
    n = int(np.searchsorted(run.time, run.time[-1] - 1.02 * period, side="left"))
    angle, rate, given = run.angle[n:], run.rate[n:], run.command[n:]
    marks: list[Mark] = [Curve(angle, rate, "simulated", "blue", width=1.8)]
    if prediction is not None and prediction.cycle is not None and events is not None:
        _, path, speed = events.trace(prediction.cycle.half)
        for sign in (1.0, -1.0):
            marks.append(Curve(sign * path, sign * speed, "predicted", "vermilion", "dashed", 1.6))
    at_rest = run.stuck[n:]
    marks.append(Points(angle[at_rest], rate[at_rest], "sticks", "square", "orange", size=6.0))
    other: list[Mark] = [
        Curve(angle, given, "simulated", "blue", width=1.6, arrow=True),
        Curve(
            np.where(at_rest, angle, np.nan),
            np.where(at_rest, given, np.nan),
            "sticks",
            "orange",
            width=3.5,
        ),
    ]
    return Chart(
        "hunting_plane",
        [
            Panel(Axis(label, "rad"), Axis(f"rate of {label}", "rad/s"), marks, "Angle and rate"),
            Panel(Axis(label, "rad"), Axis(input_label, "V"), other, "Angle and command"),
        ],
        "One hunting cycle. A stick is a point on the left, a vertical line on the right: the "
        "command climbs until the axis breaks away.",
    )


def event_map(prediction: HuntingPrediction, run: AxisRun) -> Chart:
    """Error at a stick over error at the one before; the simulation's sticks too."""
    e, f = prediction.errors, prediction.following
    size = np.abs(f)
    crossed, short = np.where(f > 0, size, np.nan), np.where(f < 0, size, np.nan)
    marks: list[Mark] = [
        Curve(e, e, "as large as before", "grey", "dotted"),
        Curve(e, crossed, "slip beyond the reference", "blue"),
    ]
    if np.isfinite(short).any():
        marks.append(Curve(e, short, "slip that falls short of it", "sky", "dashed"))
    before, after = run.sticks
    if before.size:
        marks.append(Points(before, after, "simulated, from stick to stick", "dot", "ink"))
    if np.isfinite(prediction.coulomb):
        marks.append(
            Curve(e, np.abs(prediction.coulomb) * e, "Coulomb friction alone", "green", "dashed")
        )
    if prediction.threshold is not None:
        marks.append(Line(x=prediction.threshold, label="below: comes to rest", colour="purple"))
    if prediction.cycle is not None:
        at = prediction.cycle.swing / 2.0
        marks.append(Points([at], [at], "hunting cycle, predicted", "star", "vermilion", size=9.0))
    return Chart(
        "hunting_map",
        [
            Panel(
                Axis("error at a stick", "rad", log=True),
                Axis("error at the next stick", "rad", log=True),
                marks,
            )
        ],
        "The Poincaré map from stick to stick, by the linear loop. Above the dotted line slips "
        "grow, below it they shrink; where it crosses is the cycle.",
        columns=1,
        width=5.6,
        height=4.0,
    )


def nyquist(one: Harmonics) -> Chart:
    """Describing functions in the Nyquist plane."""
    G = one.response
    reach = 1.1 * float(np.abs(G).max())
    left: list[Mark] = [
        Curve([-reach, 0.0], [0.0, 0.0], "−1/N(A), all amplitudes", "vermilion", width=2.2),
        Curve(G.real, G.imag, "G(jω): rate by friction's moment", "blue", arrow=True),
    ]
    panels = [
        Panel(
            Axis("real part", "(rad/s)/(N m)"),
            Axis("imaginary part", "(rad/s)/(N m)"),
            left,
            "An axis that never sticks",
        )
    ]
    if one.balance is not None:
        near = (one.omega > 0.5 * one.balance.omega) & (one.omega < 2.5 * one.balance.omega)
        Z = one.impedance[near]
        at = complex(np.interp(one.balance.omega, one.omega, one.impedance))
        size = 4.0 * abs(at)
        shown = np.abs(one.inverse) < size
        right: list[Mark] = [
            Curve(
                np.where(shown, one.inverse.real, np.nan),
                np.where(shown, one.inverse.imag, np.nan),
                "−1/M(X, ω*) of the sticking axis",
                "vermilion",
            ),
            Curve(Z.real, Z.imag, "Z(jω): the loop on the axis", "blue", arrow=True),
            Points([at.real], [at.imag], "balance", "star", "green", size=8.0),
        ]
        panels.append(
            Panel(
                Axis("real part", "N m s/rad"),
                Axis("imaginary part", "N m s/rad"),
                right,
                "An axis that sticks, one harmonic",
            )
        )
    return Chart(
        "hunting_nyquist", panels, "Harmonic balance: a crossing is a cycle.", width=4.8, height=3.8
    )


def over_levels(axis_label: str, sweeps: Sequence[LevelSweep]) -> Chart:
    """Swing over levels of friction and of integral action, predicted and simulated."""
    colours = ("blue", "green", "purple")
    shown = []
    for sweep in sweeps:
        marks: list[Mark] = [
            Curve(sweep.x, values, words, colours[i % 3])  # type: ignore[arg-type]
            for i, (words, values) in enumerate(sweep.curves)
        ]
        hunting = [level for level in sweep.levels if level.run.hunts]
        still = [level for level in sweep.levels if not level.run.hunts]
        if hunting:
            marks.append(
                Points(
                    [level.factor for level in hunting],
                    [level.run.swing for level in hunting],
                    "simulated",
                    "star",
                    "vermilion",
                    size=8.0,
                )
            )
        if still:
            marks.append(
                Points(
                    [level.factor for level in still],
                    [0.0] * len(still),
                    "simulated: comes to rest",
                    "unstable",
                    "vermilion",
                    size=8.0,
                )
            )
        factor = Axis(f"{sweep.label}, times", "", log=True)
        shown.append(Panel(factor, Axis(f"swing of {axis_label}", "rad"), marks))
    return Chart(
        "hunting_over_friction",
        shown,
        "How far the loop hunts, peak to peak: predicted lines end where hunting vanishes.",
    )
