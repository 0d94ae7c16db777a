"""Margins of the loop that any controller closes, measured around an operating point."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated

from msgspec import Meta

from trms_cli.core.findings import Findings
from trms_cli.stability.loops.frequency_response import Analyser, NoResponse, measured, point_of
from trms_cli.stability.loops.margin_findings import margin_findings, no_response_findings
from trms_cli.stability.loops.margins import MarginResult
from trms_cli.stability.study import Tell
from trms_cli.stability.subject import Subject

_Positive = Annotated[float, Meta(gt=0)]


@dataclass(frozen=True, kw_only=True)
class Margins:
    """Gain, phase, delay and disk margins, and sensitivity."""

    #: Operating point: angles (rad) or commands (V). Empty: level, and yaw at 0.3 rad, where the
    #: tail rotor turns.
    at: Mapping[str, float] = field(default_factory=dict)
    lowest: _Positive = 0.1  #: Lowest frequency of the response, rad/s
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
        response = measured(analyser, subject, loop, point, tell)
        if isinstance(response, NoResponse):
            return no_response_findings(response, subject, loop, point)
        tell("margins")
        return margin_findings(MarginResult(response), subject, loop, point)
