"""How much delay, gain error and friction a loop tolerates in simulation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated

from msgspec import Meta

from trms_cli.core.errors import ConfigurationError
from trms_cli.core.findings import Findings
from trms_cli.core.plugins import nearest
from trms_cli.stability.loops.frequency_response import Analyser, NoResponse
from trms_cli.stability.loops.impairments import impairments_of
from trms_cli.stability.loops.margin_findings import condition_of, no_response_findings
from trms_cli.stability.loops.margins import MarginResult
from trms_cli.stability.loops.measurement import measured, point_of
from trms_cli.stability.loops.tolerance import Bounds, ToleranceTrial, TrialRun, limits_of
from trms_cli.stability.loops.tolerance_findings import tolerance_findings
from trms_cli.stability.study import Tell
from trms_cli.stability.subject import Subject

_Positive = Annotated[float, Meta(gt=0)]
_Factor = Annotated[float, Meta(gt=1)]


@dataclass(frozen=True, kw_only=True)
class Tolerance:
    """What the loop stands from a start beside its operating point."""

    #: Operating point: angles (rad) or commands (V). Empty: level, and yaw at 0.3 rad, where the
    #: tail rotor turns.
    at: Mapping[str, float] = field(default_factory=dict)
    #: By how much the start differs, by state; rad for angles. Those of axes that the model does
    #: not have are left out.
    offset: Mapping[str, float] = field(default_factory=lambda: {"alpha_v": -0.2, "alpha_h": -0.2})
    duration: _Positive = 30.0  #: s, of a run; judged are its last two thirds
    rest: _Positive = 0.02  #: rad that a loop may rest beside the point
    swing: _Positive = 0.002  #: rad by which it may swing on
    chatter: _Positive = 0.02  #: Share of half its range by which a command may swing on
    lost: _Positive = 1.0  #: rad from the point at which a run is ended
    delays: Sequence[_Positive] = (0.05, 0.1, 0.2, 0.4)  #: s, the scan
    #: Factors above 1, the scan upwards; their inverses downwards
    gains: Sequence[_Factor] = (2.0, 4.0, 8.0, 16.0)
    frictions: Sequence[_Positive] = (0.001, 0.003, 0.01, 0.03)  #: N m, the scan
    #: Factor between a size that is stood and one that is not, at which the search ends
    precision: Annotated[float, Meta(gt=1)] = 1.1

    def run(self, subject: Subject, tell: Tell) -> Findings:
        """Measure the linear margins, then make everything worse until the loop fails.

        Raises TrmsError without a controller, where the rig cannot rest, and for a loop that does
        not come back with nothing wrong.
        """
        loop = subject.require_loop("study=tolerance")
        model, point = subject.model, point_of(subject, self.at)
        trial = ToleranceTrial(
            subject,
            loop,
            point,
            self._start(subject),
            self.duration,
            Bounds(self.rest, self.swing, self.chatter),
            self.lost,
        )
        scans = {"delay": self.delays, "gain": self.gains, "friction": self.frictions}
        wanted = [one for one in impairments_of(model) if scans[one.kind]]
        if not wanted:
            raise ConfigurationError(
                "no sizes to try are given",
                where="delays",
                remedy="give some of study.delays, study.gains, study.frictions",
            )
        response = measured(Analyser(), subject, loop, point, tell)
        if isinstance(response, NoResponse):
            return no_response_findings(response, subject, loop, point)
        tell("nothing wrong")
        nothing = trial.at(wanted[0], wanted[0].none)
        self._require_back(nothing, condition_of(subject, loop, point))
        margins = MarginResult(response)
        limits = []
        for impairment in wanted:
            tell(impairment.words)
            sizes = sorted(scans[impairment.kind])
            limits.append(limits_of(trial, impairment, sizes, self.precision, nothing, margins))
        tell("what differs from the linear margins")
        return tolerance_findings(limits, trial, margins)

    def _start(self, subject: Subject) -> dict[str, float]:
        model = subject.model
        known = {"alpha_v", "alpha_h", *model.state_names}
        for name in self.offset:
            if name not in known:
                raise ConfigurationError(
                    f"{name!r} is no state of model {subject.name!r}",
                    where=f"offset.{name}",
                    remedy=nearest(name, model.state_names),
                )
            if name in model.controlled and abs(self.offset[name]) >= self.lost:
                raise ConfigurationError(
                    f"a start {abs(self.offset[name]):g} rad away counts as lost already",
                    where=f"offset.{name}",
                    remedy=f"start closer than study.lost ({self.lost:g} rad), or raise that",
                )
        return {name: value for name, value in self.offset.items() if name in model.state_names}

    def _require_back(self, nothing: TrialRun, where: str) -> None:
        if not nothing.verdict.back:
            does: str = nothing.verdict.kind
            does = "is still creeping" if does == "still creeping" else f"{does} already"
            raise ConfigurationError(
                f"with nothing wrong, the loop {does} ({where})",
                where="offset",
                remedy="start closer to the point (study.offset.alpha_v=-0.05), run longer "
                "(study.duration), allow more (study.rest, study.swing), or let the observer "
                "estimate what the model lacks (observer=ukf)",
            )
