"""Which motions of a model repeat themselves while its commands are held."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated

from msgspec import Meta

from trms_cli.core.errors import ConfigurationError
from trms_cli.core.findings import Findings
from trms_cli.core.plugins import nearest
from trms_cli.models.model import names
from trms_cli.models.vector_field import has_impulses
from trms_cli.stability.cycles.absence import absence
from trms_cli.stability.cycles.branch import at_the_point, follow_over
from trms_cli.stability.cycles.orbit_findings import LimitCycleResult, findings_of
from trms_cli.stability.cycles.orbits import (
    Shooting,
    different,
    half_widths,
    search_orbits,
    starts_in,
)
from trms_cli.stability.study import Tell
from trms_cli.stability.subject import Subject, not_level, usual_point


@dataclass(frozen=True, kw_only=True)
class LimitCycles:
    """A search for periodic orbits, a proof of their absence where one is possible."""

    #: Operating point by angles (rad) or by commands (V); nothing: level, at a yaw of 0.3 rad
    at: Mapping[str, float] = field(default_factory=dict)
    #: Input over which Hopf points are sought and cycles are followed; None: the first
    over: str | None = None
    #: Half-widths of the box of starts, by state
    box: Mapping[str, Annotated[float, Meta(ge=0)]] = field(default_factory=dict)
    starts: Annotated[int, Meta(ge=1, le=1000)] = 24  #: Motions
    duration: Annotated[float, Meta(ge=10, le=10000)] = 150.0  #: s, of each
    orbits: Annotated[int, Meta(ge=10, le=2000)] = 90  #: Most cycles of a branch

    def run(self, subject: Subject, tell: Tell) -> Findings:
        """Search, prove, follow.

        Raises
        ------
        ConfigurationError
            For a controller, an unknown name, or an operating point that does not exist.
        ModelError
            For a model without equations.
        """
        subject.require_no_loop(
            "limit_cycles", "study=hunting looks for the cycles of a loop with friction"
        )
        model = subject.require_equations("limit_cycles")
        for name in self.box:
            if name not in model.state_names:
                raise ConfigurationError(
                    f"{name!r} is not a state of this model",
                    where=f"box.{name}",
                    remedy=nearest(name, model.state_names),
                )
        inputs = names(model.inputs)
        over = inputs[0] if self.over is None else self.over
        if over not in inputs:
            raise ConfigurationError(
                f"{over!r} is not an input of this model",
                where="over",
                remedy=nearest(over, inputs),
            )
        channel = inputs.index(over)
        point = usual_point(model, self.at)
        widths = half_widths(model, point.x, self.box)
        smooth = not has_impulses(model)
        tell("is a cycle possible at all")
        proof = absence(model, point.x, point.u, widths)
        tell(f"{self.starts} motions of {self.duration:g} s")
        shooting = Shooting(model) if smooth and not (proof.proved and proof.everywhere) else None
        search = search_orbits(
            model, starts_in(point.x, widths, self.starts), point.u, self.duration, shooting
        )
        over_command = None
        if smooth:
            tell(f"Hopf points over {over}")
            over_command = follow_over(model, point, channel, search.orbits, shooting, self.orbits)
            if shooting is not None:
                more = at_the_point(shooting, over_command.branches, channel, point.u)
                search = replace(search, orbits=different([*search.orbits, *more]))
        findings = findings_of(
            LimitCycleResult(
                model, point, widths, self.duration, smooth, proof, search, channel, over_command
            )
        )
        elsewhere = not_level(model, self.at, point)
        return replace(findings, warnings=[*elsewhere, *findings.warnings])
