"""``study=local``: the modes at an operating point, and over the range of the rig."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any

from msgspec import Meta

from trms_cli.core.findings import Block, Column, Findings, Section, Table, json_data, table
from trms_cli.models.model import Model, by_name
from trms_cli.models.operating_point import OperatingPoint
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
from trms_cli.stability.local.tables import (
    crossing_data,
    eigenvalue_words,
    locus_data,
    locus_section,
    mode_data,
    mode_table,
    participation_table,
    points_alone,
    switch_words,
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
        value, words = _value_of(path, point), point.words(model)
        locus = locus_of(
            path, sweep_eigenvalues(path, *path.range(self.range), self.points, (value,))
        )
        return Findings(
            "Local stability",
            (*_lead(model, words, sides, switches), *_lead_range(locus)),
            (
                Section(
                    f"At {words}",
                    _text_here(model, sides["mean"], switches),
                    _blocks_here(model, sides, switches, words),
                ),
                _range_section(locus, value),
            ),
            json_data(_results(locus, point, sides, switches)),
            _warnings(sides["mean"], switches),
        )


def _lead(
    model: Model, words: str, sides: Mapping[Side, Modes], switches: tuple[Switch, ...]
) -> list[str]:
    modes = sides["mean"]
    verdict = {
        "stable": "small motions die out",
        "marginal": "small motions neither grow nor all die out",
        "unstable": "small motions grow",
    }[modes.verdict]
    sentences = [f"{modes.verdict.capitalize()}, {verdict}, at {words}."]
    finite = (m for m in modes.modes if math.isfinite(m.eigenvalue.real))
    critical = max(finite, key=lambda m: m.eigenvalue.real)
    sentences.append(f"Closest to growing is {_described(critical)}.")
    swing = [m for m in modes.modes if m.oscillates and m is not critical and not m.alternating]
    for mode in sorted(swing, key=lambda m: m.damping_ratio or 0.0)[:2]:
        if not mode.name.startswith("past"):
            sentences.append(f"Besides, {_described(mode)}.")
    if switches and sides["upper"].verdict != sides["lower"].verdict:
        sentences.append(
            f"On a switch, it is {sides['upper'].verdict} on the upper side and "
            f"{sides['lower'].verdict} on the lower."
        )
    return sentences


def _described(mode: EigenMode) -> str:
    value = eigenvalue_words(mode.eigenvalue, 3)
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


def _text_here(model: Model, modes: Modes, switches: tuple[Switch, ...]) -> list[str]:
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
    sentences += [switch_words(model, switch) for switch in switches]
    if switches:
        sentences.append(
            "The table of modes is for the mean of both slopes, which small oscillations across "
            "the switch see (their first harmonic); those of either side are given beside it."
        )
    return sentences


def _blocks_here(
    model: Model, sides: Mapping[Side, Modes], switches: tuple[Switch, ...], words: str
) -> list[Block]:
    modes = sides["mean"]
    blocks: list[Block] = [
        mode_table(modes, f"Modes at {words}."),
        participation_table(model, modes),
    ]
    if switches:
        blocks.append(_sides_table(sides))
    blocks.append(points_alone("local_modes", modes, f"Eigenvalues at {words}."))
    return blocks


def _sides_table(sides: Mapping[Side, Modes]) -> Table:
    def near(mode: EigenMode, side: Side) -> str:
        modes = sides[side].modes
        nearest = min(modes, key=lambda other: abs(other.eigenvalue - mode.eigenvalue))
        return eigenvalue_words(nearest.eigenvalue)

    return table(
        sides["mean"].modes,
        [
            Column("mode", "name"),
            Column("λ below [1/s]", lambda mode: near(mode, "lower")),
            Column("λ above [1/s]", lambda mode: near(mode, "upper")),
            Column("λ of the mean [1/s]", lambda mode: eigenvalue_words(mode.eigenvalue)),
        ],
        "Either side of the switch.",
    )


def _range_section(locus: Locus, value: float) -> Section:
    path = locus.path
    held = ", ".join(
        amount_words(path.model, name, v) for name, v in path.at.items() if name != path.over
    )
    return locus_section(
        f"Over {path.over}",
        f"The operating point is solved anew for each {path.over}; eigenvalues are followed from "
        "one to the next by their eigenvectors.",
        locus,
        ("local_plane", "local_range"),
        value,
        f" ({held})" if held else "",
        note="; dotted: the operating point",
    )


def _value_of(path: OperatingPath, point: OperatingPoint) -> float:
    """Where the request stands on the line."""
    if path.kind == "parameter":
        return float(path.model.parameters[path.over].value)
    return point.value(path.model, path.over)


def _results(
    locus: Locus, point: OperatingPoint, sides: Mapping[Side, Modes], switches: tuple[Switch, ...]
) -> dict[str, Any]:
    model = locus.path.model
    matrices = locus.path.linear.matrices(point.x, point.u)
    return {
        "at": {
            "x": by_name(model.states, point.x),
            "u": by_name(model.inputs, point.u),
            "verdict": sides["mean"].verdict,
            "modes": [mode_data(model, mode) for mode in sides["mean"].modes],
            "forgotten": sides["mean"].forgotten,
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
            for s in switches
        ],
        "sides": {
            side: [mode_data(model, mode) for mode in sides[side].modes]
            for side in ("upper", "lower")
            if switches
        },
        "range": locus_data(locus),
        "crossings": crossing_data(locus),
    }


def _warnings(modes: Modes, switches: tuple[Switch, ...]) -> list[str]:
    sentences = []
    if switches:
        sentences.append(
            "On a switch the eigenvalues of either side do not by themselves decide about motions "
            "that cross it; that of the mean is what a small, nearly harmonic swing sees."
        )
    if modes.verdict == "marginal":
        sentences.append(
            "An eigenvalue on the imaginary axis decides nothing: what the equations do beyond "
            "first order does."
        )
    return sentences
