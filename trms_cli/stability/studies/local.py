"""``study=local``: the modes at an operating point, and over the range of the rig."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any

from msgspec import Meta

from trms_cli.core.findings import (
    Block,
    Column,
    Findings,
    Judgement,
    Measure,
    Section,
    Table,
    json_data,
    table,
)
from trms_cli.models.model import by_name
from trms_cli.models.operating_point import OperatingPoint
from trms_cli.stability.local import tables
from trms_cli.stability.local.linear import EigenMode, Modes, Side, Switch, modes_of
from trms_cli.stability.local.sweep import (
    Locus,
    OperatingPath,
    amount_words,
    line_of,
    locus_of,
    sweep_eigenvalues,
    usual_line,
)
from trms_cli.stability.study import Tell
from trms_cli.stability.subject import Subject


@dataclass(frozen=True, kw_only=True)
class Local:
    """Eigenvalues with names."""

    #: Operating point: angles (rad) or commands (V); empty: the rest without command
    at: Mapping[str, float] = field(default_factory=dict)
    #: What is varied: a controlled state, an input or a parameter; None: the first angle, the first
    #: command where ``at`` names commands, or the command of a motor alone
    over: str | None = None
    #: In the unit of ``over``; None: as far as the rig has operating points
    range: tuple[float, float] | None = None
    points: Annotated[int, Meta(ge=2, le=2000)] = 81  #: Steps over the range
    #: Whose slopes are taken over the range where a coefficient depends on a direction
    side: Side = "mean"

    def run(self, subject: Subject, tell: Tell) -> Findings:
        """The modes.

        Raises TrmsError where there is no such operating point, or with a controller.
        """
        subject.require_no_loop("study=local", "leave it out; for loops: study=margins")
        model, at = subject.model, dict(self.at)
        tell("the operating point")
        over = line_of(model, at, self.over, usual_line(model))
        path = OperatingPath(model, at, over, self.side)
        point = path.balance.first(at)
        linear = path.linear
        sides: dict[Side, Modes] = {
            side: modes_of(model, linear.matrices(point.x, point.u, side))
            for side in ("mean", "upper", "lower")
        }
        switches = linear.switches(point.x, point.u)
        tell(f"over {over}")
        value = point.value(model, over) if path.kind != "parameter" else path.began
        sweep = sweep_eigenvalues(path, *path.range(self.range), self.points, (value,))
        result = LocalResult(locus_of(path, sweep), point, sides, switches)
        condition_text = ", ".join(
            amount_words(model, name, v) for name, v in path.at.items() if name != over
        )
        ranged = tables.locus_section(
            f"Over {over}",
            f"The operating point is solved anew for each {over}; eigenvalues are followed from "
            "one to the next by their eigenvectors.",
            result.locus,
            ("local_plane", "local_range"),
            value,
            f" ({condition_text})" if condition_text else "",
            note="; dotted: the operating point",
        )
        sections = _point_section(result), ranged
        lead = *_lead(result), *_lead_range(result.locus)
        data = json_data(_results(result))
        measures = _measures(result.sides["mean"])
        return Findings("Local stability", lead, sections, data, _warnings(result), measures)


def _measures(modes: Modes) -> list[Measure]:
    """The verdict, the rightmost eigenvalue, and of the modes that swing the least damped."""
    judgement: Judgement = "good" if modes.verdict == "stable" else "bad"
    rightmost = max(modes.modes, key=lambda mode: mode.eigenvalue.real)
    measures = [
        Measure("small motions", modes.verdict, "", judgement),
        Measure("rightmost", rightmost.eigenvalue.real, "1/s", "", rightmost.name),
    ]
    swinging = [mode for mode in modes.modes if mode.oscillates]
    if swinging:
        least = min(swinging, key=lambda m: -m.eigenvalue.real / m.natural_frequency)
        damping = -least.eigenvalue.real / least.natural_frequency
        measures += [
            Measure("least damping", damping, "", "", least.name),
            Measure("its frequency", least.damped_frequency / math.tau, "Hz", "", least.name),
        ]
    return measures


@dataclass(frozen=True)
class LocalResult:
    """The modes at an operating point, and over the range."""

    locus: Locus
    point: OperatingPoint
    sides: Mapping[Side, Modes]  #: With the mean of the slopes on a switch, and those of each side
    switches: tuple[Switch, ...]


def _lead(result: LocalResult) -> list[str]:
    sides, modes, model = result.sides, result.sides["mean"], result.locus.path.model
    verdict = {
        "stable": "small motions die out",
        "marginal": "small motions neither grow nor all die out",
        "unstable": "small motions grow",
    }[modes.verdict]
    sentences = [f"{modes.verdict.capitalize()}, {verdict}, at {result.point.words(model)}."]
    finite = (m for m in modes.modes if math.isfinite(m.eigenvalue.real))
    critical = max(finite, key=lambda m: m.eigenvalue.real)
    sentences.append(f"Closest to growing is {_described(critical)}.")
    swing = [m for m in modes.modes if m.oscillates and m is not critical and not m.alternating]
    for mode in sorted(swing, key=lambda m: m.damping_ratio or 0.0)[:2]:
        if not mode.name.startswith("past"):
            sentences.append(f"Besides, {_described(mode)}.")
    if result.switches and sides["upper"].verdict != sides["lower"].verdict:
        sentences.append(
            f"On a switch, it is {sides['upper'].verdict} on the upper side and "
            f"{sides['lower'].verdict} on the lower."
        )
    return sentences


def _described(mode: EigenMode) -> str:
    value = tables.eigenvalue_words(mode.eigenvalue, 3)
    if mode.oscillates:
        hertz = mode.damped_frequency / (2 * math.pi)
        pace = f"{hertz:.3g} Hz, damping ratio {mode.damping_ratio:.2g}".replace("-", "−")
        return f"the {mode.name} (λ = {value} 1/s: {pace})"
    if mode.time_constant is None:
        return f"the mode “{mode.name}” (λ = 0: it stays wherever it is put)"
    grows = "doubles" if mode.eigenvalue.real > 0 else "halves"
    return (
        f"the mode “{mode.name}” (λ = {value} 1/s: {grows} in "
        f"{math.log(2) * mode.time_constant:.3g} s)"
    )


def _lead_range(locus: Locus) -> list[str]:
    path, sweep = locus.path, locus.sweep
    low, high = sweep.values[0], sweep.values[-1]
    span = f"{path.over} from {low:.4g} to {high:.4g} {path.unit}".rstrip()
    if len(sweep.places) < 2:
        return [
            f"There is no operating point beside it along {path.over}: {sweep.high or sweep.low}. "
            f"Vary an angle instead, as study.over={path.model.controlled[0]}: the commands follow."
        ]
    unstable = max(float(track.slowest.real.max()) for track in locus.tracks)
    if not locus.crossings:
        # A mode that is at rest on the axis everywhere does not cross it.
        always = "; one is unstable throughout" if unstable > 1e-6 else ""
        return [f"Over {span}, no mode crosses the imaginary axis{always}."]
    sentences = [
        f"{path.over} = {c.value:.4g} {path.unit} ({locus.name(c)}, "
        + (f"{c.frequency:.3g} rad/s, " if c.frequency else "")
        + f"unstable {c.side})"
        for c in locus.crossings
    ]
    return [f"Over {span}, modes cross the imaginary axis at {'; '.join(sentences)}."]


def _point_section(result: LocalResult) -> Section:
    model, modes, switches = result.locus.path.model, result.sides["mean"], result.switches
    words = result.point.words(model)
    sentences = [
        "Modes are named after the states that take part in them (participation factors w_i v_i, "
        "which do not depend on units). Natural frequency ω_n = |λ|, damping ratio ζ = −Re λ/|λ|, "
        "time constant 1/|Re λ|."
    ]
    if model.sample_time is not None:
        sentences.append(
            f"The model only steps, every {model.sample_time:g} s: λ = ln z / T of the eigenvalues "
            f"z of its step where it rests. {modes.forgotten} of its states are gone within a "
            "sample and no modes."
        )
    for mode in modes.modes:
        if mode.multiplicity > 1:
            several = "fewer eigenvectors than that (motions grow as t·e^λt before they decay)"
            own = "an eigenvector for each"
            sentences.append(
                f"“{mode.name}” stands for {mode.multiplicity} equal eigenvalues with "
                f"{several if mode.defective else own}."
            )
    sentences += [tables.switch_words(model, switch) for switch in switches]
    if switches:
        sentences.append(
            "The table of modes is for the mean of both slopes, which small oscillations across "
            "the switch see (their first harmonic); those of either side are given beside it."
        )
    blocks: list[Block] = [
        tables.mode_table(modes, f"Modes at {words}."),
        tables.participation_table(model, modes),
        *([_sides_table(result.sides)] if switches else []),
        tables.points_alone("local_modes", modes, f"Eigenvalues at {words}."),
    ]
    return Section(f"At {words}", sentences, blocks)


def _sides_table(sides: Mapping[Side, Modes]) -> Table:
    def near(mode: EigenMode, side: Side) -> str:
        modes = sides[side].modes
        nearest = min(modes, key=lambda other: abs(other.eigenvalue - mode.eigenvalue))
        return tables.eigenvalue_words(nearest.eigenvalue)

    return table(
        sides["mean"].modes,
        [
            Column("mode", "name"),
            Column("λ below [1/s]", lambda mode: near(mode, "lower")),
            Column("λ above [1/s]", lambda mode: near(mode, "upper")),
            Column("λ of the mean [1/s]", lambda mode: tables.eigenvalue_words(mode.eigenvalue)),
        ],
        "Either side of the switch.",
    )


def _results(result: LocalResult) -> dict[str, Any]:
    path, point, modes = result.locus.path, result.point, result.sides["mean"]
    model, matrices = path.model, path.linear.matrices(point.x, point.u)
    return {
        "at": {
            "x": by_name(model.states, point.x),
            "u": by_name(model.inputs, point.u),
            "verdict": modes.verdict,
            "modes": [tables.mode_data(model, mode) for mode in modes.modes],
            "forgotten": modes.forgotten,
            "A": matrices.a,
            "B": matrices.b,
            "sample_time_s": model.sample_time,
        },
        "switches": [
            {
                "state": model.state_names[s.state],
                "entries": [[model.state_names[i], model.state_names[j]] for i, j in s.entries],
                "upper": s.upper,
                "lower": s.lower,
            }
            for s in result.switches
        ],
        "sides": {
            side: [tables.mode_data(model, mode) for mode in result.sides[side].modes]
            for side in ("upper", "lower")
            if result.switches
        },
        "range": tables.locus_data(result.locus),
        "crossings": tables.crossing_data(result.locus),
    }


def _warnings(result: LocalResult) -> list[str]:
    sentences = []
    if result.switches:
        sentences.append(
            "On a switch the eigenvalues of either side do not by themselves decide about motions "
            "that cross it; that of the mean is what a small, nearly harmonic swing sees."
        )
    if result.sides["mean"].verdict == "marginal":
        sentences.append(
            "An eigenvalue on the imaginary axis decides nothing: what the equations do beyond "
            "first order does."
        )
    return sentences
