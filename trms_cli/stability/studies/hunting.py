"""Whether a loop with dry friction hunts, how far and how fast, and what predicts it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta

from trms_cli.controllers.controller import ControlSetup
from trms_cli.controllers.pid import Pid
from trms_cli.controllers.pid_design import holding_input
from trms_cli.controllers.pid_tuning import Gains
from trms_cli.core.chart import Axis, Band, Chart, Curve, Line, Mark, Panel, Points
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.findings import (
    Cell,
    Column,
    Datum,
    Findings,
    Judgement,
    Measure,
    Section,
    Table,
    json_data,
    table,
)
from trms_cli.core.ranges import Positive
from trms_cli.core.wording import percent, symbol
from trms_cli.models.model import Model
from trms_cli.models.operating_point import OperatingPoint
from trms_cli.stability.cycles.hunting_runs import (
    AxisRun,
    HuntingLevel,
    LevelSweep,
    axis_run,
    with_sizes,
)
from trms_cli.stability.cycles.stick_slip import (
    Balance,
    Cycle,
    Friction,
    FrictionLaw,
    Harmonics,
    HuntingPrediction,
    StickSlip,
    friction_loop,
    frictions_of,
    harmonics,
    predict,
    swings,
)
from trms_cli.stability.study import Tell
from trms_cli.stability.subject import LoopParts, Subject, not_level, usual_point

#: s, of a run at least; predicted periods that it lasts at least.
_SHORTEST, _LASTING = 200.0, 8
#: By which a run in which slips are too rare to tell is lengthened, once.
_LONGER = 4.0
#: Factors of the predicted curves, and excesses beside the one in force.
_CURVE = np.geomspace(0.25, 4.0, 11)
_EXCESSES = (0.5, 1.0, 2.0)


@dataclass(frozen=True, kw_only=True)
class Hunting:
    """Stick-slip in a closed loop."""

    axis: Literal["pitch", "yaw"] | None = None  #: None: the one axis with dry friction
    #: Operating point by angles (rad) or by commands (V); nothing: level, at a yaw of 0.3 rad
    at: Mapping[str, float] = field(default_factory=dict)
    #: rad, by which the axis starts beside its reference
    push: Annotated[float, Meta(ge=-3, le=3)] = 0.3
    #: s, of each run; None: 200, or eight predicted periods
    duration: Annotated[float, Meta(ge=20, le=100000)] | None = None
    #: Factors of the friction, and of k_i of a PID, for further runs
    torques: tuple[Positive, ...] | None = None
    integrals: tuple[Positive, ...] | None = (
        None  #: None: half and twice for a PID, none for others
    )

    def run(self, subject: Subject, tell: Tell) -> Findings:
        """Simulate, predict, confirm.

        Raises TrmsError without a controller that feeds back or dry friction, for an operating
        point that does not exist, and for a model without equations.
        """
        loop = subject.require_loop("hunting")
        model = subject.require_equations("hunting")
        friction = self._friction(model)
        pid = loop.controller if isinstance(loop.controller, Pid) else None
        if self.integrals and pid is None:
            raise ConfigurationError(
                f"controller={loop.names['controller']} has no k_i",
                where="integrals",
                remedy="leave it out, or choose controller=pid",
            )
        point = usual_point(model, self.at)
        channel = holding_input(model, friction.axis)
        case = LoopCase(model, loop, point, friction, self.push, channel)
        prediction = one = events = None
        warnings = list(not_level(model, self.at, point))
        if pid is not None:
            tell("the event map of the linear loop")
            linear = friction_loop(model, loop, pid, point, friction.axis)
            if linear.stable():
                events = StickSlip(linear, friction.law)
                prediction = predict(events)
                tell("describing functions")
                one = harmonics(linear, friction.law)
            else:
                warnings.append("the linear loop without friction is unstable: nothing predicted")
            if loop.names["observer"] != "full_state":
                warnings.append(
                    "the prediction takes the true angle; in simulation "
                    f"observer={loop.names['observer']} stands in between"
                )
        else:
            warnings.append(
                "predicted for controller=pid only, whose law is linear and known: here simulation"
            )
        cycle = prediction.cycle if prediction is not None else None
        expected = cycle.swing if cycle is not None else None
        least = _LASTING * cycle.period if cycle is not None else 0.0
        duration = self.duration or max(_SHORTEST, least)
        tell(f"{duration:.0f} s of the loop")
        run = case.run(duration)
        elsewhere = None
        if expected is not None and not run.hunts:
            # The push may have ended within the reach of rest: begin on the cycle.
            elsewhere, run = run, case.run(duration, push=expected / 2.0)
        if run.verdict == "undecided" and self.duration is None:
            duration *= _LONGER
            tell(f"slips are rare: {duration:.0f} s of the loop")
            run = case.run(duration)
        coulomb = None
        if friction.law.excess > 0:
            tell("the same with Coulomb friction alone")
            short = min(duration, _SHORTEST)
            alone = replace(friction.law, excess=0.0)
            coulomb = case.run(short, law=alone)
            if coulomb.verdict == "undecided":
                coulomb = case.run(_LONGER * short, law=alone)
        sweeps = [
            self._over_torques(case, events, duration, tell),
            self._over_integrals(case, pid, events, duration, tell),
        ]
        if run.at_limit:
            warnings.append("a command reaches its limit: the prediction knows none")
        own = HuntingLevel(1.0, expected, run)
        level_sweeps = [
            replace(s, levels=sorted([*s.levels, own], key=lambda level: level.factor))
            for s in sweeps
            if s.levels
        ]
        result = HuntingResult(case, run, elsewhere, coulomb, prediction, one, events, level_sweeps)
        sections = [_run_section(result)]
        if prediction is not None:
            sections.append(_prediction_section(result, prediction))
        if one is not None:
            sections.append(_harmonic_section(result, one))
        if level_sweeps:
            sections.append(_sweep_section(result))
        data = json_data(_results(result))
        lead, measures = _lead(result), _measures(result)
        return Findings("Hunting", lead, sections, data, tuple(warnings), measures)

    def _friction(self, model: Model) -> Friction:
        frictions = frictions_of(model)
        if self.axis is not None:
            frictions = tuple(one for one in frictions if one.axis == self.axis)
        if len(frictions) == 1 and frictions[0].law.torque > 0:
            return frictions[0]
        if len(frictions) > 1:
            raise ConfigurationError(
                f"dry friction by {', '.join(one.effect for one in frictions)}",
                where="axis",
                remedy="choose an axis with one of them: study.axis=pitch",
            )
        axis = str(self.axis or [*model.axes, "pitch"][0])
        raise ConfigurationError(
            "without dry friction on an axis nothing sticks",
            where="effect",
            remedy=f"add it: effect={axis}_stribeck_friction (or {axis}_coulomb_friction)",
        )

    def _over_torques(
        self, case: LoopCase, events: StickSlip | None, duration: float, tell: Tell
    ) -> LevelSweep:
        law = case.friction.law
        factors = self.torques if self.torques is not None else (0.5, 2.0) if events else ()
        curves = []
        if events is not None and factors:
            for excess in sorted({law.excess, *(law.excess * e for e in _EXCESSES)} - {0.0}):
                laws = [replace(law.scaled(float(f)), excess=excess) for f in _CURVE]
                words = f"predicted, F_s/F_c = {1 + excess:.3g}"
                curves.append((words, swings(events, laws)))

        def one(factor: float) -> tuple[float | None, AxisRun]:
            scaled = law.scaled(factor)
            expected = _finite(swings(events, [scaled])[0]) if events is not None else None
            return expected, case.run_to_cycle(duration, expected, law=scaled)

        return _sweep("torques", "friction", curves, factors, one, tell)

    def _over_integrals(
        self, case: LoopCase, pid: Pid | None, events: StickSlip | None, duration: float, tell: Tell
    ) -> LevelSweep:
        factors = self.integrals if self.integrals is not None else (0.5, 2.0) if events else ()
        if pid is None or events is None or not factors:
            return _sweep("integrals", "k_i", [], (), lambda _: (None, case.run(duration)), tell)

        def of(factor: float) -> tuple[LoopParts, StickSlip | None]:
            changed = _with_integral(case, pid, factor)
            loop = replace(case.loop, controller=changed)
            linear = friction_loop(case.model, loop, changed, case.point, case.friction.axis)
            return loop, StickSlip(linear, case.friction.law) if linear.stable() else None

        def swing(factor: float) -> float:
            there = of(factor)[1]
            return float("nan") if there is None else float(swings(there, [case.friction.law])[0])

        def one(factor: float) -> tuple[float | None, AxisRun]:
            expected = _finite(swing(factor))
            return expected, case.run_to_cycle(duration, expected, loop=of(factor)[0])

        values = np.array([swing(float(f)) for f in _CURVE])
        return _sweep("integrals", "k_i", [("predicted", values)], factors, one, tell)


@dataclass(frozen=True)
class LoopCase:
    """A loop to be run with other friction, or another controller."""

    model: Model
    loop: LoopParts
    point: OperatingPoint
    friction: Friction
    push: float  #: rad
    channel: int  #: Of the command that holds the axis

    def run(
        self,
        duration: float,
        *,
        law: FrictionLaw | None = None,
        loop: LoopParts | None = None,
        push: float | None = None,
    ) -> AxisRun:
        """A run, with other friction, another loop or another push."""
        model = self.model
        if law is not None:
            sizes = {f"{self.friction.effect}.{key}": value for key, value in vars(law).items()}
            model = with_sizes(model, {k: v for k, v in sizes.items() if k in model.parameters})
        start = self.push if push is None else push
        axis = self.friction.axis
        return axis_run(model, loop or self.loop, self.point, axis, start, duration, self.channel)

    def run_to_cycle(self, duration: float, expected: float | None, **other: Any) -> AxisRun:
        """A run; where it rests but a cycle of some swing is expected, one from that cycle."""
        run = self.run(duration, **other)
        if expected is not None and not run.hunts:
            run = self.run(duration, **other, push=expected / 2.0)
        return run


def _with_integral(case: LoopCase, pid: Pid, factor: float) -> Pid:
    """The PID with the gains that it has, but k_i of the axis times a factor."""
    period = pid.sample_time or case.loop.sample_time
    state = pid.init(ControlSetup(case.loop.model, period, case.point.u))
    gains: dict[str, Gains] = {}
    for name, law in zip(case.loop.model.axes, state.axes, strict=True):
        own = factor if name == case.friction.axis else 1.0
        gains[name] = Gains(law.gains.kp, own * law.gains.ki, law.gains.kd)
    return replace(pid, **gains)  # type: ignore[arg-type]


def _sweep(
    name: str,
    label: str,
    curves: Sequence[tuple[str, np.ndarray]],
    factors: Sequence[float],
    one: Callable[[float], tuple[float | None, AxisRun]],
    tell: Tell,
) -> LevelSweep:
    levels = []
    for factor in factors:
        tell(f"{label} × {factor:g}")
        levels.append(HuntingLevel(factor, *one(factor)))
    return LevelSweep(name, label, curves, levels)


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


_VERDICTS = {
    "hunting": "hunts",
    "rest": "comes to rest",
    "dying out": "slips die out",
    "undecided": "slips too seldom to tell",
    "oscillating": "oscillates without sticking",
    "unstable": "does not hold",
}


@dataclass(frozen=True)
class HuntingResult:
    """Everything about one loop."""

    case: LoopCase
    run: AxisRun  #: The loop as asked for
    #: The run from the push, where it came to rest beside a predicted cycle; ``run`` then begins on
    #: that
    elsewhere: AxisRun | None
    coulomb: AxisRun | None  #: The same with Coulomb friction alone; None where there is no excess
    prediction: HuntingPrediction | None  #: Only for a PID
    harmonics: Harmonics | None  #: Only for a PID
    events: StickSlip | None  #: Only for a PID
    sweeps: Sequence[LevelSweep]

    @property
    def angle(self) -> str:
        """Symbol of the axis' angle."""
        return symbol(self.case.model.axes[self.case.friction.axis].angle)


def _measures(result: HuntingResult) -> list[Measure]:
    """The verdict, and of a loop that hunts its swing, period and share of the time stuck."""
    run = result.run
    judgement: Judgement = "bad" if run.hunts else "good"
    measures = [Measure("the loop", _VERDICTS[run.verdict], "", judgement)]
    if run.hunts:
        measures += [
            Measure("swing", run.swing, "rad", "", result.angle),
            Measure("period", run.period, "s"),
            Measure("stuck", percent(run.stuck_share), "", "", "of the time"),
        ]
    return measures


def _lead(result: HuntingResult) -> list[str]:
    run, law, prediction = result.run, result.case.friction.law, result.prediction
    friction = f"{law.torque:g} N m of friction on {result.case.friction.axis}"
    if law.excess:
        friction += f" ({law.breakaway:g} N m to break away)"
    lead = [_verdict_words(result, friction)]
    if result.elsewhere is not None and run.hunts:
        lead.append(
            f"It does so from a stick {abs(run.angle[0]):.3g} rad beside the reference; from "
            f"{result.case.push:g} rad the axis {_VERDICTS[result.elsewhere.verdict]}: rest and "
            "cycle stand side by side."
        )
    if prediction is not None and prediction.cycle is not None:
        cycle = prediction.cycle
        words = (
            f"Predicted from the linear loop, event by event: {cycle.swing:.4f} rad every "
            f"{cycle.period:.2f} s"
        )
        if run.hunts and run.period:
            words += (
                f" ({_off(cycle.swing, run.swing)} in swing and "
                f"{_off(cycle.period, run.period)} in period off the simulation)"
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
    if result.coulomb is not None:
        lead.append(
            f"With Coulomb friction alone ({law.torque:g} N m, no excess at break-away) the loop "
            f"{_VERDICTS[result.coulomb.verdict]}{' too.' if result.coulomb.hunts else '.'}"
        )
    return lead


def _verdict_words(result: HuntingResult, friction: str) -> str:
    run = result.run
    if run.hunts:
        return (
            f"The loop hunts: with {friction}, {result.angle} swings by {run.swing:.4f} rad every "
            f"{run.period or float('nan'):.2f} s and sticks {100 * run.stuck_share:.0f} % of the "
            "time."
        )
    if run.verdict == "oscillating":
        return (
            f"The loop oscillates without sticking, with {friction}: {result.angle} swings by "
            f"{run.swing:.4f} rad. That is no hunting: look at its margins (study=margins)."
        )
    if run.verdict == "undecided":
        return (
            f"Undecided, with {friction}: the axis slipped only once or twice in the second half "
            f"of {run.time[-1]:.0f} s; run longer (study.duration={4 * run.time[-1]:.0f})."
        )
    if run.verdict == "unstable":
        return f"The loop does not hold, with {friction}: look at its margins (study=margins)."
    return (
        f"No hunting was found with {friction}: from {result.case.push:g} rad beside the reference "
        f"the axis {_VERDICTS[run.verdict]} within {run.time[-1]:.0f} s."
    )


def _off(predicted: float, simulated: float) -> str:
    return f"{100 * (predicted / simulated - 1):+.1f} %"


def _judged(predicted: float | None, simulated: float | None) -> Cell:
    """How far a prediction is off; nothing where there is nothing to compare."""
    if not predicted or not simulated:
        return None
    close = abs(predicted / simulated - 1) < 0.05
    return Datum(_off(predicted, simulated), "good" if close else "doubtful")


def _run_section(result: HuntingResult) -> Section:
    run, label = result.run, f"{result.angle} − reference"
    case, model = result.case, result.case.model
    command = symbol(model.inputs[case.channel].name)
    text = [
        f"controller={case.loop.names['controller']} at {case.point.words(model)}, started "
        f"{run.angle[0]:.3g} rad beside the reference, {run.time[-1]:.0f} s; the second half is "
        "judged. The axis sticks where its rate is zero to rounding: friction acts as an impulse "
        "that stops it exactly."
    ]
    blocks = [history(run, label, command)]
    if run.hunts:
        blocks.append(planes(run, result.prediction, result.events, label, command))
    return Section("In simulation", text, blocks)


def _prediction_section(result: HuntingResult, prediction: HuntingPrediction) -> Section:
    run, cycle = result.run, prediction.cycle
    balance = result.harmonics.balance if result.harmonics is not None else None

    def row(name: str, cycle: AxisRun | Cycle | Balance | None, none: str) -> list[Cell]:
        if cycle is None:
            return [name, none, None, None, None, None]
        compare = cycle is not run and run.hunts and bool(cycle.period and run.period)
        return [
            name,
            f"{cycle.swing:.4f}",
            None if cycle.period is None else f"{cycle.period:.2f}",
            f"{100 * cycle.stuck_share:.0f} %",
            _judged(cycle.swing, run.swing) if compare else None,
            _judged(cycle.period, run.period) if compare else None,
        ]

    rows = [
        row("simulated", run if run.hunts else None, _VERDICTS[run.verdict]),
        row("event map", cycle, "no hunting"),
        row("one harmonic", balance, "no cycle"),
    ]
    heads = ["by", "swing [rad]", "period [s]", "stuck", "swing off by", "period off by"]
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
    blocks = (Table(heads, rows, "Predicted and simulated."), event_map(prediction, run))
    return Section("Predicted, event by event", text, blocks)


def _harmonic_section(result: HuntingResult, one: Harmonics) -> Section:
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
            if result.prediction is not None and result.prediction.cycle is not None
            else ", and that is wrong: the moment on an axis that sticks is a ramp, no sine. The "
            "event map and the simulation have no cycle."
        )
    )
    return Section("Describing functions", (sliding, sticking), (nyquist(one),))


def _sweep_section(result: HuntingResult) -> Section:
    levels = [(sweep.label, level) for sweep in result.sweeps for level in sweep.levels]

    def simulated(item: tuple[str, HuntingLevel]) -> Cell:
        run = item[1].run
        return f"{run.swing:.4f}" if run.hunts else _VERDICTS[run.verdict]

    def period(item: tuple[str, HuntingLevel]) -> Cell:
        run = item[1].run
        return f"{run.period:.2f}" if run.hunts and run.period else None

    def predicted(item: tuple[str, HuntingLevel]) -> Cell:
        swing = item[1].predicted
        return "no hunting" if swing is None else f"{swing:.4f}"

    columns = [
        Column("level", lambda item: f"{item[0]} × {item[1].factor:g}"),
        Column("predicted swing [rad]", predicted),
        Column("simulated [rad]", simulated),
        Column("period [s]", period),
        Column(
            "swing off by",
            lambda item: (
                _judged(item[1].predicted, item[1].run.swing) if item[1].run.hunts else None
            ),
        ),
    ]
    blocks: list[Table | Chart] = [table(levels, columns, "Other levels.")]
    if any(sweep.curves for sweep in result.sweeps):
        blocks.append(over_levels(result.angle, result.sweeps))
    return Section("Over friction and integral action", (), blocks)


def _results(result: HuntingResult) -> dict[str, Any]:
    prediction, harmonics = result.prediction, result.harmonics
    cycle = prediction.cycle if prediction is not None else None
    balance = harmonics.balance if harmonics is not None else None
    return {
        "axis": result.case.friction.axis,
        "friction": result.case.friction.law,
        "simulated": _run_data(result.run),
        "coulomb": result.coulomb and _run_data(result.coulomb),
        "predicted": prediction
        and {
            "hunts": cycle is not None,
            "threshold": prediction.threshold,
            "coulomb_factor": prediction.coulomb,
            "swing": cycle and cycle.swing,
            "period": cycle and cycle.period,
            "stuck": cycle and cycle.stuck_share,
            "multipliers": cycle and cycle.multipliers[:4],
        },
        "harmonic": balance
        and {"swing": balance.swing, "period": balance.period, "stuck": balance.stuck_share},
        "levels": [
            {
                "of": sweep.name,
                "factor": level.factor,
                "predicted_swing": level.predicted,
                "simulated": _run_data(level.run),
            }
            for sweep in result.sweeps
            for level in sweep.levels
        ],
    }


def _run_data(run: AxisRun) -> dict[str, Any]:
    return {
        "verdict": run.verdict,
        "hunts": run.hunts,
        "period": run.period,
        "swing": run.swing,
        "stuck": run.stuck_share,
        "failures": run.failures,
    }


#: Periods that a history shows, and s of one without a period.
_PERIODS, _SHOWN = 3.0, 60.0


def history(run: AxisRun, label: str, input_label: str) -> Chart:
    """The angle's error and the command over time, sticks shaded."""
    span = _SHOWN if run.period is None else _PERIODS * run.period
    n = max(2, int(np.searchsorted(run.time, run.time[-1] - span, side="left")))
    part = slice(n, None) if run.hunts else slice(0, int(np.searchsorted(run.time, span)) + 1)
    time = run.time[part] - run.time[part][0]
    panels = []
    for values, name, unit_of in ((run.angle, label, "rad"), (run.command, input_label, "V")):
        y = values[part]
        room = 0.08 * max(float(np.ptp(y)), 1e-9)
        low, high = float(y.min()) - room, float(y.max()) + room
        lower, upper = (np.where(run.is_stuck[part], end, np.nan) for end in (low, high))
        marks: list[Mark] = [
            Band(time, lower, upper, "sticks", "orange", 0.2),
            Curve(time, y, "", "blue", width=1.6),
        ]
        panels.append(Panel(Axis("time", "s"), Axis(name, unit_of, (low, high)), marks))
    words = "hunting after the transient" if run.hunts else "after the push"
    caption = f"The loop in simulation, {words}: while the axis sticks the integral ramps."
    return Chart("hunting_history", panels, caption, columns=1, width=7.5, height=2.4)


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
    angle, rate, input_values = run.angle[n:], run.rate[n:], run.command[n:]
    marks: list[Mark] = [Curve(angle, rate, "simulated", "blue", width=1.8)]
    if prediction is not None and prediction.cycle is not None and events is not None:
        _, path, speed = events.trace(prediction.cycle.half)
        for sign in (1.0, -1.0):
            marks.append(Curve(sign * path, sign * speed, "predicted", "vermilion", "dashed", 1.6))
    at_rest = run.is_stuck[n:]
    marks.append(Points(angle[at_rest], rate[at_rest], "sticks", "square", "orange", size=6.0))
    stick_values = np.where(at_rest, input_values, np.nan)
    other: list[Mark] = [
        Curve(angle, input_values, "simulated", "blue", width=1.6, arrow=True),
        Curve(np.where(at_rest, angle, np.nan), stick_values, "sticks", "orange", width=3.5),
    ]
    x, speed_of = Axis(label, "rad"), Axis(f"rate of {label}", "rad/s")
    left = Panel(x, speed_of, marks, "Angle and rate")
    right = Panel(x, Axis(input_label, "V"), other, "Angle and command")
    caption = (
        "One hunting cycle. A stick is a point on the left, a vertical line on the right: the "
        "command climbs until the axis breaks away."
    )
    return Chart("hunting_plane", [left, right], caption)


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
    x, y = (Axis(f"error at {which} stick", "rad", log=True) for which in ("a", "the next"))
    caption = (
        "The Poincaré map from stick to stick, by the linear loop. Above the dotted line slips "
        "grow, below it they shrink; where it crosses is the cycle."
    )
    return Chart("hunting_map", [Panel(x, y, marks)], caption, columns=1, width=5.6, height=4.0)


def nyquist(one: Harmonics) -> Chart:
    """Describing functions in the Nyquist plane."""

    def plane(unit: str, marks: list[Mark], title: str) -> Panel:
        return Panel(Axis("real part", unit), Axis("imaginary part", unit), marks, title)

    G = one.response
    reach = 1.1 * float(np.abs(G).max())
    left: list[Mark] = [
        Curve([-reach, 0.0], [0.0, 0.0], "−1/N(A), all amplitudes", "vermilion", width=2.2),
        Curve(G.real, G.imag, "G(jω): rate by friction's moment", "blue", arrow=True),
    ]
    panels = [plane("(rad/s)/(N m)", left, "An axis that never sticks")]
    if one.balance is not None:
        near = (one.omega > 0.5 * one.balance.omega) & (one.omega < 2.5 * one.balance.omega)
        Z = one.impedance[near]
        at = complex(np.interp(one.balance.omega, one.omega, one.impedance))
        inverse = np.where(np.abs(one.inverse) < 4.0 * abs(at), one.inverse, np.nan * (1 + 1j))
        words = "−1/M(X, ω*) of the sticking axis"
        right: list[Mark] = [
            Curve(inverse.real, inverse.imag, words, "vermilion"),
            Curve(Z.real, Z.imag, "Z(jω): the loop on the axis", "blue", arrow=True),
            Points([at.real], [at.imag], "balance", "star", "green", size=8.0),
        ]
        panels.append(plane("N m s/rad", right, "An axis that sticks, one harmonic"))
    return Chart(
        "hunting_nyquist", panels, "Harmonic balance: a crossing is a cycle.", width=4.8, height=3.8
    )


def over_levels(axis_label: str, sweeps: Sequence[LevelSweep]) -> Chart:
    """Swing over levels of friction and of integral action, predicted and simulated."""
    colours = ("blue", "green", "purple")
    panels = []
    for sweep in sweeps:
        marks: list[Mark] = [
            Curve(_CURVE, values, words, colours[i % 3])  # type: ignore[arg-type]
            for i, (words, values) in enumerate(sweep.curves)
        ]
        for hunts, words, shape in (
            (True, "simulated", "star"),
            (False, "simulated: comes to rest", "unstable"),
        ):
            levels = [level for level in sweep.levels if level.run.hunts == hunts]
            if levels:
                factors = [level.factor for level in levels]
                y = [level.run.swing if hunts else 0.0 for level in levels]
                marks.append(Points(factors, y, words, shape, "vermilion", size=8.0))  # type: ignore[arg-type]
        factor = Axis(f"{sweep.label}, times", "", log=True)
        panels.append(Panel(factor, Axis(f"swing of {axis_label}", "rad"), marks))
    return Chart(
        "hunting_over_friction",
        panels,
        "How far the loop hunts, peak to peak: predicted lines end where hunting vanishes.",
    )
