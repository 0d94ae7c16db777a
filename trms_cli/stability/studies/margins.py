"""Margins of the loop that any controller closes, measured around an operating point."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any

import numpy as np
from msgspec import Meta

from trms_cli.controllers.controller import Status
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
from trms_cli.models.operating_point import OperatingPoint
from trms_cli.stability.loops.frequency_response import (
    Analyser,
    ClassicalMargins,
    DiskMargin,
    LoopMargins,
    MarginResult,
    NoResponse,
    StabilityLimit,
    diagonal_mu,
    largest_singular_value,
    measure_response,
    point_of,
)
from trms_cli.stability.study import Tell
from trms_cli.stability.subject import LoopParts, Subject


@dataclass(frozen=True, kw_only=True)
class Margins:
    """Gain, phase, delay and disk margins, and sensitivity."""

    #: Operating point: angles (rad) or commands (V). Empty: level, and yaw at 0.3 rad, where the
    #: tail rotor turns.
    at: Mapping[str, float] = field(default_factory=dict)
    lowest: Positive = 0.1  #: Lowest frequency of the response, rad/s
    #: Of a frequency to the one below it, where the harmonics of the lowest are denser
    ratio: Annotated[float, Meta(gt=1, le=2)] = 1.06
    #: rms of the test signal as a share of half the range of each input
    amplitude: Annotated[float, Meta(gt=0, le=0.5)] = 0.001
    #: Periods of the test signal after which the loop has to have settled
    periods: Annotated[int, Meta(ge=2, le=100)] = 6

    def run(self, subject: Subject, tell: Tell) -> Findings:
        """Measure the response, and read the margins off it.

        Raises TrmsError without a controller, for one that does not look at the rig, and where the
        rig cannot rest.
        """
        loop = subject.require_loop("study=margins")
        point = point_of(subject, self.at)
        analyser = Analyser(self.lowest, self.ratio, self.amplitude, self.periods)
        response = measure_response(analyser, subject, loop, point, tell)
        if isinstance(response, NoResponse):
            return no_response_findings(response, subject, loop, point)
        tell("margins")
        return margin_findings(MarginResult(response), subject, loop, point)


#: Parts of the answer above which a warning is due: change from period to period, what the linear
#: response does not predict, what the interpolation between the lines may miss.
_DRIFT, _NONLINEAR, _BETWEEN = 1e-3, 0.05, 0.1
#: From this part on there is no talk of margins.
_NOT_LINEAR = 0.25
#: Peak of |T| below which a loop does not answer: nothing moves, or nothing is fed back.
_NO_LOOP = 1e-3
#: rad by which the loop may rest beside the point.
_BESIDE = 0.01
#: What is called good and bad: Åström & Murray, "Feedback Systems", 2nd ed. 2021, sec. 10.3: gain
#: margins of 2 to 5, phase margins of 30° to 60°, peaks of S of 1.2 to 2 are reasonable.
_GOOD_GAIN, _GOOD_PHASE, _POOR_PHASE, _GOOD_PEAK = 2.0, 45.0, 30.0, 2.0

TITLE = "Margins of a loop"


def condition_of(subject: Subject, loop: LoopParts, point: OperatingPoint) -> str:
    """``lqr with full_state on newtonian, u_v = 1.41 V, u_h = 0.35 V: alpha_v = 0, …``."""
    law = f"{loop.names['controller']} with {loop.names['observer']}"
    return f"{law} on {subject.name} at {point.words(subject.model)}"


def no_response_findings(
    response: NoResponse, subject: Subject, loop: LoopParts, point: OperatingPoint
) -> Findings:
    """The answer for a loop that has no margins."""
    model, run = subject.model, response.run
    where = condition_of(subject, loop, point)
    turned = "" if response.leaves else _warning_of_reversed(response.reversed)
    marks: list[Mark] = [Line(y=0.0)]
    for name, colour in zip(model.controlled, _COLOURS, strict=False):
        away = run.x[:, model.state_index(name)] - point.value(model, name)
        marks.append(Curve(run.time, away, name, colour))
    departure = Chart(
        "margins_departure",
        [Panel(Axis("time", "s"), Axis("distance from the point", "rad"), marks)],
        f"The loop does not hold: {where}.",
        width=6.5,
    )
    why = "No margins can be read here"
    if response.leaves:
        why = "The loop does not hold this point, and margins do not exist"
    method = (
        "The run begins at rest at the point; a small test signal is added to a command. A stable "
        "loop answers it periodically, and this one does not: it is unstable here, swings by "
        "itself (study=hunting and study=limit_cycles look for that), or settles slower than the "
        "study waits (study.periods)."
    )
    return Findings(
        TITLE,
        [
            f"{why}: {response.words}.",
            f"Studied was {where}.",
            *gliding_words(response.held_states),
        ],
        [Section("What the loop did", [method], [departure])],
        {"holds": False, "what_it_did": response.words, "statuses": dict(run.statuses)},
        [words for words in (warning_of_statuses(run.statuses), turned) if words],
    )


def margin_findings(
    margins: MarginResult, subject: Subject, loop: LoopParts, point: OperatingPoint
) -> Findings:
    """The answer for a loop that has been measured."""
    where = condition_of(subject, loop, point)
    if margins.response.held_states:
        where += ", without its dry friction"
    tables = [_single_table(margins), *([_together_table(margins)] * (len(margins.loops) > 1))]
    method = (
        "Each loop is opened at its command, the others stay closed. The loop was measured while "
        "it was closed, so it is stable as it is; a margin is the first change at which its "
        "Nyquist curve runs through −1. A margin of the delay holds for a linear loop; "
        "study=tolerance compares it with the simulated one."
    )
    sections = [
        Section("Margins", [method], tables),
        Section("Figures", [], [draw(margins, where) for draw in (_bode, _nyquist, _sensitivity)]),
        Section("How it was measured", [_method(margins)], [_quality_table(margins)]),
    ]
    data, warnings = json_data(_results(margins)), _warnings(margins, subject)
    lead, measures = _lead(margins, where), _measures(margins)
    return Findings(TITLE, lead, sections, data, warnings, measures)


def _measures(margins: MarginResult) -> list[Measure]:
    """Of each loop by itself how far its gain may grow, the phase that may be lost, the delay."""
    measures = []
    for loop in margins.loops:
        c, of = loop.margins, f"of {loop.name} alone"
        up = None if c.up is None else c.up.value
        good: Judgement = "good" if up is None or up >= _GOOD_GAIN else "doubtful"
        measures += [
            Measure("gain may grow", up, "times", good, of),
            Measure("phase margin", value_of(c.phase, True), "°", "", of),
            Measure("delay margin", None if c.delay is None else 1e3 * c.delay.value, "ms", "", of),
        ]
    return measures


def _lead(margins: MarginResult, where: str) -> list[str]:
    sentences = []
    for loop in margins.loops:
        c = loop.margins
        if loop.complementary.value < _NO_LOOP:
            sentences.append(
                f"{loop.name}: no loop to speak of: of a signal added to it, the controller gives "
                f"back a part of {loop.complementary.value:.2g} at the most, and margins say "
                "nothing."
            )
            continue
        phase_text = (
            f"{math.degrees(c.phase.value):.0f}° may be lost" if c.phase else "no phase leads to −1"
        )
        sentences.append(
            f"{loop.name}: the gain may grow {_factor(c.up)} and shrink {_factor(c.down)}, "
            f"{phase_text}, {_delay(c.delay)}; the sensitivity peaks at "
            f"{loop.sensitivity.value:.2f} ({loop.sensitivity.omega:.2g} rad/s)."
        )
    m = margins.response
    first = f"{where}: the loop is stable, with these margins."
    if m.nonlinearity > _NOT_LINEAR:
        first = (
            f"{where}: the loop stays at the point, but {100 * m.nonlinearity:.0f} % of its answer "
            "is not that of a linear loop. The figures hold for this test signal, and are no "
            "margins."
        )
    elif m.reversed:
        first = (
            f"{where}: the loop stays at the point, but {' and '.join(m.reversed)} passes zero "
            "there, and no linear loop exists. The figures hold for this test signal."
        )
    lead = [first, *gliding_words(m.held_states), *sentences]
    if len(margins.loops) > 1:
        c, disk = margins.together, margins.disk_each
        most = "any gain above" if math.isinf(disk.gain_up) else f"{disk.gain_up:.2f}"
        lead += [
            f"All commands changed alike: the gain may grow {_factor(c.up)}, {_delay(c.delay)}.",
            f"All commands at once, each by its own factor: gains from {disk.gain_down:.2f} to "
            f"{most} and phases of ±{math.degrees(disk.phase):.0f}° are stood together "
            f"(disk margin {disk.alpha:.2f} at {disk.omega:.2g} rad/s).",
        ]
    return lead


def gliding_words(state_names: Sequence[str]) -> list[str]:
    """A sentence where dry friction was left out."""
    if not state_names:
        return []
    names = " and ".join(state_names)
    return [
        f"Dry friction holds {names} at this point: the small signal of a linear measurement moves "
        "nothing. The loop was measured with the rig gliding, without its dry friction; what "
        "friction itself does to the loop, study=hunting and study=tolerance tell."
    ]


def _factor(limit: StabilityLimit | None) -> str:
    if limit is None:
        return "without a bound in the measured band"
    return f"{limit.value:.3g} times" if limit.value > 1 else f"to {limit.value:.2g} of it"


def _delay(limit: StabilityLimit | None) -> str:
    if limit is None:
        return "no delay matters in the measured band"
    return f"{limit.value:.3g} s of delay may be added"


def _single_table(margins: MarginResult) -> Table:
    def judged_gain(loop: LoopMargins) -> Datum:
        up = value_of(loop.margins.up)
        return _judged(up, up is None or up >= _GOOD_GAIN)

    def judged_peak(loop: LoopMargins) -> Datum:
        return _judged(loop.sensitivity.value, loop.sensitivity.value <= _GOOD_PEAK)

    return table(
        margins.loops,
        [
            Column("loop", "name"),
            Column("gain up", judged_gain),
            Column("gain down", lambda loop: value_of(loop.margins.down)),
            Column("phase [°]", lambda loop: _judged_phase(loop.margins.phase)),
            Column("delay [s]", lambda loop: value_of(loop.margins.delay)),
            Column("crossover [rad/s]", lambda loop: loop.margins.crossover or None),
            Column("peak |S|", judged_peak),
            Column("modulus margin", lambda loop: 1 / loop.sensitivity.value),
            Column("peak |T|", lambda loop: loop.complementary.value),
            Column("disk α", lambda loop: loop.disk.alpha),
        ],
        "Margins of each command alone. Nothing stands where no such change, of any size, leads to "
        "−1 in the measured band.",
    )


def _together_table(margins: MarginResult) -> Table:
    c = margins.together
    alike = (value_of(c.down), value_of(c.up), value_of(c.phase, True), value_of(c.delay), None)
    return Table(
        ["all commands at once", "gain down", "gain up", "phase [°]", "delay [s]", "disk α"],
        [
            ["the same change of each", *alike],
            ["each by a factor of its own", *_disk_row(margins.disk_each)],
            ["any change, coupling included", *_disk_row(margins.disk_any)],
        ],
        f"Largest singular values: σ̄(S) = {margins.sensitivity.value:.3g} at "
        f"{margins.sensitivity.omega:.2g} rad/s (min σ̲(I + L) = "
        f"{1 / margins.sensitivity.value:.3g}), σ̄(T) = {margins.complementary.value:.3g} at "
        f"{margins.complementary.omega:.2g} rad/s. The disks' gains and phases are guaranteed "
        "together, at any frequency; they are no limits, but what is safe.",
    )


def _disk_row(disk: DiskMargin) -> list[Cell]:
    up = None if math.isinf(disk.gain_up) else disk.gain_up
    return [disk.gain_down, up, math.degrees(disk.phase), None, disk.alpha]


def value_of(limit: StabilityLimit | None, degrees: bool = False) -> float | None:
    """A limit's value; None where there is none."""
    if limit is None:
        return None
    return math.degrees(limit.value) if degrees else limit.value


def _judged_phase(limit: StabilityLimit | None) -> Datum:
    value = value_of(limit, degrees=True)
    if value is None or value >= _GOOD_PHASE:
        return Datum(value, "good")
    return Datum(value, "doubtful" if value >= _POOR_PHASE else "bad")


def _judged(value: float | str | None, good: bool) -> Datum:
    return Datum(value, "good" if good else "bad")


def _method(margins: MarginResult) -> str:
    m = margins.response
    return (
        f"A multisine of {m.omega.size} lines from {m.omega[0]:.3g} to {m.omega[-1]:.4g} rad/s was "
        "added to one command at a time, held over the control period "
        f"({m.step:g} s), in {m.duration:.0f} s of simulation; S = U/D and T = −U_c/D at each "
        "line, and L = T S⁻¹: the sampled loop, hold, delays and observer in it, up to half the "
        "controller's rate. A last run with another signal, half as strong and on all commands at "
        "once, has to give what T predicts."
    )


def _quality_table(margins: MarginResult) -> Table:
    m = margins.response
    rows: list[list[Cell]] = [
        ["change from one period to the next", _share(m.drift, _DRIFT)],
        ["answer to half the signal that is not predicted", _share(m.nonlinearity, _NONLINEAR)],
        ["power between the lines", f"{100 * m.beside:.2g} %"],
        ["bound of what the interpolation misses", _share(margins.interpolation, _BETWEEN)],
        ["control samples at a limit", m.limited],
    ]
    rows += [[f"control samples that ended {label}", n] for label, n in m.statuses.items()]
    return Table(["quality of the measurement", "value"], rows, on_screen=False)


def _share(value: float, most: float) -> Datum:
    return _judged(f"{100 * value:.2g} %", value <= most)


def warning_of_statuses(
    statuses: Mapping[str, int], consequence: str = "the margins are in part those of the fall-back"
) -> str:
    """A word where it was not the controller's own law that was measured."""
    total = sum(statuses.values())
    poor = {
        status: statuses[status.label]
        for status in (Status.RELAXED, Status.FAILED, Status.OVERRIDDEN)
        if statuses.get(status.label)
    }
    if not poor:
        return ""
    status_text = "; ".join(
        f"{count} {status.label} ({status.meaning})" for status, count in poor.items()
    )
    return f"of {total} control samples, {status_text}: {consequence}"


def _warning_of_reversed(speeds: Sequence[str]) -> str:
    """A word where a rotor turns round."""
    if not speeds:
        return ""
    return (
        f"{' and '.join(speeds)} passes zero here: a rotor that stands still has a thrust ω|ω| "
        "without slope, and what is read of its loop depends on the signal's size; "
        "study.at.alpha_h=0.3 is a point at which the tail rotor turns"
    )


def _warnings(margins: MarginResult, subject: Subject) -> list[str]:
    m = margins.response
    sentences = [warning_of_statuses(m.statuses), _warning_of_reversed(m.reversed)]
    if m.limited:
        sentences.append(
            f"the commands were at a limit in {m.limited} control samples: the margins are not "
            "those of the free loop; lower study.amplitude, or choose another point"
        )
    if m.nonlinearity > _NONLINEAR:
        sentences.append(
            f"{100 * m.nonlinearity:.0f} % of the answer is not that of a linear loop (dry "
            "friction, a kink at the point, an active constraint, a solver's tolerance): see "
            "whether a smaller or larger study.amplitude gives the same margins"
        )
    if m.drift > _DRIFT:
        sentences.append(
            f"the loop has not settled: its answer still changes by {100 * m.drift:.1g} % from one "
            "period to the next; raise study.periods"
        )
    if margins.interpolation > _BETWEEN:
        sentences.append(
            "the lines are too far apart for the loop's peaks; lower study.lowest and study.ratio"
        )
    dead = [one.name for one in margins.loops if one.complementary.value < _NO_LOOP]
    if dead:
        sentences.append(
            f"the loop of {' and '.join(dead)} does not answer: something holds the rig at the "
            "point (a coarse sensor, a dead zone), or the controller does not use the command; a "
            "larger study.amplitude may move it"
        )
    angles = zip(subject.model.controlled, m.rest.tolist(), strict=True)
    beside = [f"{name} by {rest:+.2g} rad" for name, rest in angles if abs(rest) > _BESIDE]
    if beside:
        sentences.append(
            f"the loop rests beside the point, {', '.join(beside)}: the margins are those where it "
            "rests"
        )
    return [words for words in sentences if words]


def _results(margins: MarginResult) -> dict[str, Any]:
    """The margins as JSON data; angles in rad."""
    response, L = margins.response, margins.response.L
    return {
        "holds": True,
        "loops": {
            loop.name: {
                **_classical_data(loop.margins),
                "peak_sensitivity": loop.sensitivity.value,
                "modulus_margin": 1 / loop.sensitivity.value,
                "peak_complementary": loop.complementary.value,
                "disk": _disk_data(loop.disk),
            }
            for loop in margins.loops
        },
        "alike": _classical_data(margins.together),
        "disk_each": _disk_data(margins.disk_each),
        "disk_any": _disk_data(margins.disk_any),
        "peak_sensitivity": margins.sensitivity.value,
        "least_return_difference": 1 / margins.sensitivity.value,
        "peak_complementary": margins.complementary.value,
        # L at the lines, row by column
        "response": {
            "omega": response.omega,
            "control_period": response.step,
            "inputs": response.inputs,
            "L_real": L.real,
            "L_imaginary": L.imag,
        },
        "quality": {
            "drift": response.drift,
            "nonlinearity": response.nonlinearity,
            "beside": response.beside,
            "interpolation": margins.interpolation,
            "limited": response.limited,
            "reversed": response.reversed,
            "held_by_dry_friction": response.held_states,
            "statuses": response.statuses,
        },
    }


def _classical_data(c: ClassicalMargins) -> dict[str, float | None]:
    limits = {"gain_up": c.up, "gain_down": c.down, "phase": c.phase, "delay": c.delay}
    return {**{name: value_of(limit) for name, limit in limits.items()}, "crossover": c.crossover}


def _disk_data(disk: DiskMargin) -> dict[str, float]:
    keys = ("alpha", "omega", "gain_down", "gain_up", "phase")
    return {key: getattr(disk, key) for key in keys}


_COLOURS: tuple[Colour, ...] = ("blue", "vermilion", "green", "purple")
_OMEGA = Axis("ω", "rad/s", log=True)
#: Side of what the Nyquist figure shows of the plane around the unit circle, and its least and
#: largest reach to the left: as far as the crossing of the real axis asks for.
_REACH, _LEAST_LEFT, _MOST_LEFT = 1.35, -2.2, -4.0
#: What the Bode figure shows of the phase, and the sensitivity's of sizes.
_DEGREES, _SIZES = (-390.0, 90.0), (0.01, 5.0)
#: Points along each side of a shaded disk's grid.
_GRID = 301


def _bode(margins: MarginResult, condition: str) -> Chart:
    """Gain and phase of each loop, the others closed, with the lines at which it was measured."""
    size: list[Mark] = [Line(y=1.0)]
    phase: list[Mark] = [Line(y=-180.0)]
    lines = margins.response.omega
    at_lines = 1 / np.diagonal(margins.response.S, axis1=1, axis2=2) - 1
    for i, (loop, colour) in enumerate(zip(margins.loops, _COLOURS, strict=False)):
        curve, label = margins.single[:, i], f"loop of {loop.name}"
        size.append(Curve(margins.omega, np.abs(curve), label, colour))
        size.append(Points(lines, np.abs(at_lines[:, i]), "lines measured", "dot", "ink", size=1.6))
        degrees = _degrees(curve)
        phase.append(Curve(margins.omega, degrees, label, colour))
        up, phase_limit = loop.margins.up, loop.margins.phase
        if up is not None:
            at = float(np.interp(up.omega, margins.omega, np.abs(curve)))
            size.append(Points([up.omega], [at], "limit of the gain", "triangle", colour))
        if phase_limit is not None:
            at = float(np.interp(phase_limit.omega, margins.omega, degrees))
            phase.append(Points([phase_limit.omega], [at], "limit of the phase", "square", colour))
    gain = Panel(_OMEGA, Axis("|L|", log=True), size, "Gain")
    turn = Panel(_OMEGA, Axis("arg L", "°", _DEGREES), phase, "Phase")
    caption = f"Each loop opened at its command, the others closed: {condition}."
    return Chart("margins_bode", [gain, turn], caption)


def _degrees(curve: ComplexArray) -> FloatArray:
    """The phase without jumps, between −360° and 0 where the gain is last 1."""
    phase = np.unwrap(np.angle(curve))
    above = np.flatnonzero(np.abs(curve) >= 1)
    at = int(above[-1]) if above.size else len(curve) // 2
    turns = math.ceil(phase[at] / (2 * math.pi))
    return np.asarray(np.degrees(phase - 2 * math.pi * turns))


def _nyquist(margins: MarginResult, condition: str) -> Chart:
    """Nyquist curves beside the unit circle, with the largest disk around −1 that they leave."""
    panels = []
    for i, (loop, colour) in enumerate(zip(margins.loops, _COLOURS, strict=False)):
        curve = margins.single[:, i]
        real, imaginary = _window(loop)
        # The curve inside the window, broken (NaN) where it is outside.
        inside = (curve.real >= real[0]) & (curve.real <= real[1])
        inside &= (curve.imag >= imaginary[0]) & (curve.imag <= imaginary[1])
        visible_curve = np.where(inside, curve, complex(np.nan, np.nan))
        gaps = np.flatnonzero(np.isnan(visible_curve.real))
        cut = int(gaps[-1]) + 1 if gaps.size else 0
        low, high = visible_curve[:cut], visible_curve[cut:]
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
            at = complex(np.interp(limit.omega, margins.omega, curve))
            if real[0] <= at.real <= real[1] and abs(at.imag) <= imaginary[1]:
                marks.append(Points([at.real], [at.imag], label, marker, "ink", size=5))
        marks.append(Points([-1.0], [0.0], "−1", "cross", "alarm", size=9))
        x, y = Axis("Re L", limits=real), Axis("Im L", limits=imaginary)
        panels.append(Panel(x, y, marks, f"Loop of {loop.name}", equal=True))
    caption = (
        f"Nyquist curves for ω > 0, around the unit circle: {condition}. No gain and phase within "
        "the disk leads to −1."
    )
    return Chart("margins_nyquist", panels, caption, columns=2, width=4.6, height=4.2)


def _window(loop: LoopMargins) -> tuple[tuple[float, float], tuple[float, float]]:
    """Limits of the real and the imaginary axis: the unit circle, and what the disk reaches."""
    disk = loop.disk
    left_edge = -disk.gain_up if disk.alpha < 2 else _MOST_LEFT
    real = (max(_MOST_LEFT, min(_LEAST_LEFT, 1.1 * left_edge)), _REACH)
    half = (real[1] - real[0]) / 2
    return real, (-half, half)


def _disk(loop: LoopMargins, real: tuple[float, float], imaginary: tuple[float, float]) -> Region:
    """Values of L from which a change within the disk margin leads to −1: −1/f, f in D(α)."""
    x, y = np.linspace(*real, _GRID), np.linspace(*imaginary, _GRID)
    z = x[None, :] + 1j * y[:, None]
    # f = (1 + δ/2)/(1 − δ/2) = −1/L solved for δ; at L = 1 it has no solution
    inside = 2 * np.abs(1 + z) < loop.disk.alpha * np.abs(1 - z)
    return Region(x, y, inside, "disk margin", "orange")


def _sensitivity(margins: MarginResult, condition: str) -> Chart:
    """What each frequency is amplified by, and how large a disk it leaves."""
    S, T, omega = margins.S, margins.T, margins.omega
    size: list[Mark] = [Line(y=1.0)]
    disks: list[Mark] = [Line(y=2.0)]
    for i, (loop, colour) in enumerate(zip(margins.loops, _COLOURS, strict=False)):
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
    caption = (
        f"Sensitivity S, complementary sensitivity T, and the disk that each frequency leaves: "
        f"{condition}."
    )
    return Chart("margins_sensitivity", panels, caption, columns=len(panels), width=4.0)
