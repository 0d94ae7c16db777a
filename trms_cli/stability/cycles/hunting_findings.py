"""What was found about a loop with friction, in sentences, tables and figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from trms_cli.core.chart import Chart
from trms_cli.core.findings import Findings, Judged, Section, Table, Value
from trms_cli.models.model import Model
from trms_cli.stability.cycles.friction_loop import Friction
from trms_cli.stability.cycles.hunting_charts import (
    Level,
    event_map,
    history,
    nyquist,
    over_levels,
    planes,
)
from trms_cli.stability.cycles.hunting_prediction import Harmonics, Prediction
from trms_cli.stability.cycles.hunting_runs import Watched
from trms_cli.stability.cycles.orbit_charts import symbol
from trms_cli.stability.cycles.stick_slip import StickSlip

FloatArray = npt.NDArray[np.float64]

_VERDICTS = {
    "hunting": "hunts",
    "rest": "comes to rest",
    "dying out": "slips die out",
    "undecided": "slips too seldom to tell",
    "oscillating": "oscillates without sticking",
    "unstable": "does not hold",
}


@dataclass(frozen=True)
class Sweep:
    """Runs over one quantity."""

    name: str  #: ``torques`` or ``integrals``
    label: str  #: Of the axis of the figure
    x: FloatArray  #: (n,) array; factors of the predicted curves
    #: sequence of (words, (n,) array); predicted swings, rad
    curves: Sequence[tuple[str, FloatArray]]
    levels: Sequence[Level]  #: That were simulated


@dataclass(frozen=True)
class Studied:
    """Everything about one loop."""

    model: Model
    controller: str
    words: str  #: The operating point
    friction: Friction
    push: float  #: rad
    seen: Watched  #: The loop as asked for
    #: The run from the push, where it came to rest beside a predicted cycle; ``seen`` then begins
    #: on that
    elsewhere: Watched | None
    command: FloatArray  #: (n,) array; V, of the rotor that holds the axis
    channel: int  #: That command
    coulomb: Watched | None  #: The same with Coulomb friction alone; None where there is no excess
    prediction: Prediction | None  #: Only for a PID
    harmonics: Harmonics | None  #: Only for a PID
    events: StickSlip | None  #: Only for a PID
    sweeps: Sequence[Sweep]
    warnings: Sequence[str]

    @property
    def angle(self) -> str:
        return self.model.axes[self.friction.axis].angle


def findings_of(studied: Studied) -> Findings:
    """The findings."""
    sections = [_run_section(studied)]
    if studied.prediction is not None:
        sections.append(_prediction_section(studied, studied.prediction))
    if studied.harmonics is not None:
        sections.append(_harmonic_section(studied, studied.harmonics))
    if studied.sweeps:
        sections.append(_sweep_section(studied))
    return Findings("Hunting", _lead(studied), sections, _results(studied), tuple(studied.warnings))


def _lead(studied: Studied) -> list[str]:
    seen, name = studied.seen, symbol(studied.angle)
    law = studied.friction.law
    friction = (
        f"{law.torque:g} N m of friction on {studied.friction.axis}"
        if not law.excess
        else f"{law.torque:g} N m of friction on {studied.friction.axis} "
        f"({law.breakaway:g} N m to break away)"
    )
    if seen.hunts:
        lead = [
            f"The loop hunts: with {friction}, {name} swings by {seen.swing:.4f} rad every "
            f"{seen.period or float('nan'):.2f} s and sticks {100 * seen.stuck_share:.0f} % of the "
            "time."
        ]
    elif seen.verdict == "oscillating":
        lead = [
            f"The loop oscillates without sticking, with {friction}: {name} swings by "
            f"{seen.swing:.4f} rad. That is no hunting: look at its margins (study=margins)."
        ]
    elif seen.verdict == "undecided":
        lead = [
            f"Undecided, with {friction}: the axis slipped only once or twice in the second half "
            f"of {seen.time[-1]:.0f} s; run longer (study.duration={4 * seen.time[-1]:.0f})."
        ]
    elif seen.verdict == "unstable":
        lead = [f"The loop does not hold, with {friction}: look at its margins (study=margins)."]
    else:
        lead = [
            f"No hunting was found with {friction}: from {studied.push:g} rad beside the reference "
            f"the axis {_VERDICTS[seen.verdict]} within {seen.time[-1]:.0f} s."
        ]
    if studied.elsewhere is not None and seen.hunts:
        lead.append(
            f"It does so from a stick {abs(seen.angle[0]):.3g} rad beside the reference; from "
            f"{studied.push:g} rad the axis {_VERDICTS[studied.elsewhere.verdict]}: rest and cycle "
            "stand side by side."
        )
    prediction = studied.prediction
    if prediction is not None and prediction.cycle is not None:
        cycle = prediction.cycle
        words = (
            f"Predicted from the linear loop, event by event: {cycle.swing:.4f} rad every "
            f"{cycle.period:.2f} s"
        )
        if seen.hunts and seen.period:
            words += (
                f" ({_percent(cycle.swing, seen.swing)} in swing and "
                f"{_percent(cycle.period, seen.period)} in period off the simulation)"
            )
        lead.append(
            f"{words}; the largest Floquet multiplier is {abs(cycle.multipliers[0]):.2g}, so that "
            "the cycle attracts."
        )
    elif prediction is not None:
        lead.append(
            "Predicted from the linear loop, event by event: every slip leaves a smaller error "
            "than the one before, no hunting."
        )
    if prediction is not None and prediction.threshold is not None:
        lead.append(
            f"A stick less than {prediction.threshold:.2g} rad beside the reference ends at rest, "
            "a larger one on the cycle."
        )
    if studied.coulomb is not None:
        lead.append(
            f"With Coulomb friction alone ({law.torque:g} N m, no excess at break-away) the loop "
            f"{_VERDICTS[studied.coulomb.verdict]}"
            + ("." if not studied.coulomb.hunts else " too.")
        )
    return lead


def _percent(predicted: float, seen: float) -> str:
    return f"{100 * (predicted / seen - 1):+.1f} %"


def _run_section(studied: Studied) -> Section:
    name, input_label = symbol(studied.angle), symbol(studied.model.inputs[studied.channel].name)
    text = [
        f"{studied.controller} at {studied.words}, started {studied.seen.angle[0]:.3g} rad beside "
        f"the reference, {studied.seen.time[-1]:.0f} s; the second half is judged. The axis sticks "
        "where its rate is zero to rounding: friction acts as an impulse that stops it exactly.",
    ]
    label = f"{name} − reference"
    blocks: list[Table | Chart] = [
        history(studied.seen, studied.command, label, "rad", input_label)
    ]
    if studied.seen.hunts:
        blocks.append(
            planes(
                studied.seen,
                studied.command,
                studied.prediction,
                studied.events,
                label,
                "rad",
                input_label,
            )
        )
    return Section("In simulation", text, blocks)


def _prediction_section(studied: Studied, prediction: Prediction) -> Section:
    seen, cycle = studied.seen, prediction.cycle
    harmonic = studied.harmonics.balance if studied.harmonics is not None else None
    rows: list[list[Value | Judged]] = [
        _row("simulated", seen.swing, seen.period, seen.stuck_share, None, seen)
        if seen.hunts
        else ["simulated", _VERDICTS[seen.verdict], None, None, None, None],
        _row("event map", cycle.swing, cycle.period, cycle.stuck, cycle.stable, seen)
        if cycle is not None
        else ["event map", "no hunting", None, None, None, None],
        _row("one harmonic", harmonic.swing, harmonic.period, harmonic.stuck, None, seen)
        if harmonic is not None
        else ["one harmonic", "no cycle", None, None, None, None],
    ]
    table = Table(
        ["by", "swing [rad]", "period [s]", "stuck", "swing off by", "period off by"],
        rows,
        "Predicted and simulated.",
    )
    text = [
        "While the axis sticks the integral ramps until the break-away moment is reached; then it "
        "slips until its rate is zero. Both parts follow from the linearised loop, the second with "
        "the friction's law, and the map from stick to stick has the cycle as its fixed point.",
        (
            "For Coulomb friction alone the map is a straight line: a slip leaves "
            f"{abs(prediction.coulomb):.2g} of the error before it, whatever the friction's size. "
            "It cannot hunt."
            if np.isfinite(prediction.coulomb) and abs(prediction.coulomb) < 1
            else "For Coulomb friction alone a slip creeps to the reference without a stop."
        ),
    ]
    return Section("Predicted, event by event", text, (table, event_map(prediction, seen, "rad")))


def _row(
    name: str,
    swing: float,
    period: float | None,
    stuck: float,
    stable: bool | None,
    seen: Watched,
) -> list[Value | Judged]:
    comparable = name != "simulated" and seen.hunts and period and seen.period
    return [
        name,
        f"{swing:.4f}",
        None if period is None else f"{period:.2f}",
        f"{100 * stuck:.0f} %",
        _judged(swing, seen.swing) if comparable else None,
        _judged(period, seen.period) if comparable and period and seen.period else None,
    ]


def _judged(predicted: float, seen: float) -> Judged:
    return Judged(
        _percent(predicted, seen), "good" if abs(predicted / seen - 1) < 0.05 else "doubtful"
    )


def _harmonic_section(studied: Studied, one: Harmonics) -> Section:
    sliding = (
        "G(jω), the rate by the friction's moment, does not cross the negative real axis: no cycle "
        "without a stop."
        if one.sliding is None
        else f"G(jω) crosses the negative real axis at {one.sliding[1]:.2f} rad/s: a cycle without "
        f"a stop, of {one.sliding[0]:.3g} rad/s."
    )
    sticking = (
        "An axis that sticks, under a sine of the moment, has no balance with the loop either."
        if one.balance is None
        else f"With the axis that sticks under a sine of the moment there is a balance: "
        f"{one.balance.swing:.4f} rad every {2 * np.pi / one.balance.omega:.2f} s"
        + (
            ". It tells that there is a cycle; its figures are rough, as the moment on an axis "
            "that sticks is a ramp, no sine."
            if studied.prediction is not None and studied.prediction.cycle is not None
            else ", and that is wrong: the moment on an axis that sticks is a ramp, no sine. The "
            "event map and the simulation have no cycle."
        )
    )
    return Section("Describing functions", (sliding, sticking), (nyquist(one),))


def _sweep_section(studied: Studied) -> Section:
    rows: list[list[Value | Judged]] = []
    for sweep in studied.sweeps:
        for level in sweep.levels:
            hunts = level.seen.hunts
            rows.append(
                [
                    f"{sweep.label} × {level.factor:g}",
                    "no hunting" if level.predicted is None else f"{level.predicted:.4f}",
                    f"{level.seen.swing:.4f}" if hunts else _VERDICTS[level.seen.verdict],
                    f"{level.seen.period:.2f}" if hunts and level.seen.period else None,
                    _judged(level.predicted, level.seen.swing)
                    if hunts and level.predicted is not None
                    else None,
                ]
            )
    blocks: list[Table | Chart] = [
        Table(
            ["level", "predicted swing [rad]", "simulated [rad]", "period [s]", "swing off by"],
            rows,
            "Other levels.",
        )
    ]
    if any(sweep.curves for sweep in studied.sweeps):
        panels = [(f"{s.label}, times", s.x, s.curves, s.levels) for s in studied.sweeps]
        blocks.append(over_levels(symbol(studied.angle), panels))
    return Section("Over friction and integral action", (), blocks)


def _results(studied: Studied) -> dict[str, Any]:
    law, prediction = studied.friction.law, studied.prediction
    results: dict[str, Any] = {
        "axis": studied.friction.axis,
        "friction": {"torque": law.torque, "excess": law.excess, "velocity": law.velocity},
        "simulated": _seen(studied.seen),
        "coulomb": None if studied.coulomb is None else _seen(studied.coulomb),
        "predicted": None,
        "harmonic": None,
        "levels": [
            {
                "of": sweep.name,
                "factor": level.factor,
                "predicted_swing": level.predicted,
                "simulated": _seen(level.seen),
            }
            for sweep in studied.sweeps
            for level in sweep.levels
        ],
    }
    if prediction is not None:
        cycle = prediction.cycle
        results["predicted"] = {
            "hunts": cycle is not None,
            "threshold": prediction.threshold,
            "coulomb_factor": prediction.coulomb if np.isfinite(prediction.coulomb) else None,
            "swing": None if cycle is None else cycle.swing,
            "period": None if cycle is None else cycle.period,
            "stuck": None if cycle is None else cycle.stuck,
            "multipliers": None
            if cycle is None
            else [[m.real, m.imag] for m in cycle.multipliers[:4].tolist()],
        }
    if studied.harmonics is not None and studied.harmonics.balance is not None:
        balance = studied.harmonics.balance
        results["harmonic"] = {
            "swing": balance.swing,
            "period": balance.period,
            "stuck": balance.stuck,
        }
    return results


def _seen(seen: Watched) -> dict[str, Any]:
    return {
        "verdict": seen.verdict,
        "hunts": seen.hunts,
        "period": seen.period,
        "swing": seen.swing if np.isfinite(seen.swing) else None,
        "stuck": seen.stuck_share,
        "failures": seen.failures,
    }
