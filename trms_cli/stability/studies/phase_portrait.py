"""``study=phase_portrait``: how a model, or a closed loop, moves in two or three of its states."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Literal

from msgspec import Meta

from trms_cli.core.findings import Findings
from trms_cli.stability.portraits.portrait import (
    PortraitRequest,
    portrait_of_loop,
    portrait_of_model,
)
from trms_cli.stability.portraits.section import section_of
from trms_cli.stability.portraits.window import checked_window
from trms_cli.stability.study import Tell
from trms_cli.stability.subject import Subject


@dataclass(frozen=True, kw_only=True)
class PhasePortrait:
    """Trajectories, nullclines, equilibria and separatrices."""

    #: Two or three states, or rates of angles (``rate_v`` is dα_v/dt); None: the first axis' angle
    #: and rate, or the two states of a motor
    states: tuple[str, ...] | None = None
    #: Operating point: controlled angles (rad) or commands (V); empty: rest without command
    at: Mapping[str, float] = field(default_factory=dict)
    #: Limits by coordinate; others are chosen
    window: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    #: How many, or each by coordinates and other states; None: 28 in a plane, 16 in space, 8 for a
    #: loop
    starts: Annotated[int, Meta(ge=1, le=500)] | tuple[Mapping[str, float], ...] | None = None
    #: The states that are no coordinates: held at the operating point, or where their own rates are
    #: zero; names: these settle, the others are held
    others: Literal["held", "settled"] | tuple[str, ...] = "held"
    #: s of a trajectory; None: five time constants of the slowest mode, 20 s for a loop
    duration: Annotated[float, Meta(gt=0, le=1000)] | None = None
    #: s between two points of a trajectory of the model alone
    step: Annotated[float, Meta(ge=1e-4, le=0.5)] = 0.02
    open_loop_too: bool = False  #: For a loop: trajectories without the controller beside it

    def run(self, subject: Subject, tell: Tell) -> Findings:
        """The portrait.

        Raises ConfigurationError, ModelError for a model that only steps or has a single state, and
        for names and limits that make no window.
        """
        model = subject.require_equations("study=phase_portrait")
        tell("operating point")
        section = section_of(model, self.states, self.at, self.others)
        request = PortraitRequest(
            section=section,
            window=checked_window(section.coordinates, self.window),
            starts=self.starts,
            duration=self.duration,
            step=self.step,
            open_loop_too=self.open_loop_too,
        )
        if subject.loop is None:
            return portrait_of_model(request, tell)
        return portrait_of_loop(request, subject.loop, tell)
