"""``study=phase_portrait``: how a model, or a closed loop, moves in two or three of its states."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta

from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.findings import Findings, Section, json_data
from trms_cli.stability.portraits import report
from trms_cli.stability.portraits.charts import PortraitResult
from trms_cli.stability.portraits.invariant_sets import (
    RestPoint,
    grid,
    has_impulses,
    rest_point,
    search,
    separatrices,
    sticking_sets,
)
from trms_cli.stability.portraits.section import StateSection, section_of
from trms_cli.stability.portraits.trajectories import (
    ends_of,
    loop_trajectories,
    trajectories,
)
from trms_cli.stability.portraits.window import (
    DEFAULT_COUNT,
    LOOP_COUNT,
    checked_window,
    default_starts,
    default_window,
    given_starts,
    loop_starts,
)
from trms_cli.stability.study import Tell
from trms_cli.stability.subject import LoopParts, Subject

#: s: of a trajectory of a loop; least and longest of the model alone.
_LOOP_DURATION, _LEAST, _LONGEST = 20.0, 1.0, 150.0
#: Time constants of the slowest mode after which 0.7 % of a swing is left.
_TIME_CONSTANTS = 5.0
#: s for which separatrices are followed.
_SEPARATRIX = 25.0
#: Points of all trajectories together.
_MOST_POINTS = 1e7
#: Widths by which trajectories of a loop widen its window at most, to each side.
_MOST_WIDENED = 2.0
_INVARIANCE_GRID = {2: 11, 3: 5}


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
        given = checked_window(section.coordinates, self.window)
        if subject.loop is None:
            return self._of_model(section, given, tell)
        return self._of_loop(section, given, subject.loop, tell)

    def _of_model(
        self, section: StateSection, given: Mapping[int, tuple[float, float]], tell: Tell
    ) -> Findings:
        """The model alone, its command held."""
        n = len(section.coordinates)
        tell("window and equilibria")
        window = default_window(section, given)
        rests = search(section, window)
        invariant = section.is_invariant(grid(window, _INVARIANCE_GRID[n]).reshape(-1, n))
        duration = self.duration or _settling(rest_point(section, section.point.x))
        if isinstance(self.starts, tuple):
            starts = given_starts(section, self.starts)
        else:
            starts = default_starts(section, window, self.starts or DEFAULT_COUNT[n])
        if not len(starts):
            raise ConfigurationError(
                "nowhere in the window have the settled states a value",
                where="others",
                remedy="hold them: study.others=held",
            )
        points = len(starts) * duration / self.step
        if points > _MOST_POINTS:
            raise ConfigurationError(
                f"{len(starts)} trajectories of {duration:g} s by steps of {self.step:g} s are "
                f"{points:.2g} points",
                where="step",
                remedy=f"stay below {_MOST_POINTS:.0e}: by a longer step, fewer starts, or a "
                "shorter duration",
            )
        rubs = has_impulses(section.coordinates.model)
        if rubs:
            tell("sticking sets")
        sticking = sticking_sets(section, window, rests)
        tell("trajectories")
        while True:
            paths = trajectories(section, starts, duration, self.step)
            ends = ends_of(section, window, rests, paths, sticking, dry_friction=rubs)
            moving = any(end.what == "moving" for end in ends)
            if self.duration is not None or not moving or 2 * duration > _LONGEST:
                break
            # Away from the operating point a model may be slower than its slowest mode there.
            duration *= 2
        duration = float(paths[0].time[-1])
        tell("separatrices")
        manifolds = [
            path
            for rest in ([] if rubs else rests)
            for path in separatrices(section, invariant, window, rest, _SEPARATRIX)
        ]
        result = PortraitResult(
            section, window, rests, paths, ends, duration, invariant, manifolds, sticking
        )
        parts = [
            Section("The portrait", report.of_model(result, rubs), [report.chart(result)]),
            Section("Equilibria in the window", (), [report.equilibria_table(section, rests)]),
            report.ends_section(result),
        ]
        data = json_data(report.results(result))
        lead, warnings = report.lead_of_model(result), report.warnings(result)
        return Findings("Phase portrait", lead, parts, data, warnings)

    def _of_loop(
        self,
        section: StateSection,
        given: Mapping[int, tuple[float, float]],
        loop: LoopParts,
        tell: Tell,
    ) -> Findings:
        """The loop around the model, its references at the operating point."""
        tell("window")
        window = default_window(section, given, around=True)
        duration = self.duration or _LOOP_DURATION
        if isinstance(self.starts, tuple):
            starts = given_starts(section, self.starts)
        else:
            starts = loop_starts(section, window, self.starts or LOOP_COUNT)
        runs = loop_trajectories(section, loop, starts, duration, tell)
        paths, name = runs.trajectories, loop.names["controller"]
        window = _around(window, np.concatenate([run.c for run in paths]), given)
        goal = rest_point(section, section.point.x)
        ends = ends_of(section, window, [goal], paths, search_beyond=False)
        beside = trajectories(section, starts, duration, self.step) if self.open_loop_too else ()
        result = PortraitResult(
            section, window, [], paths, ends, duration, beside=beside, loop=name
        )
        at_bound = float(np.mean(np.concatenate([run.saturated for run in paths])))
        parts = [
            Section(
                "The portrait",
                report.of_loop(result, loop.names["observer"]),
                [report.chart(result)],
            ),
            report.ends_section(result),
        ]
        results = report.results(result) | {
            "controller": name,
            "share_at_bound": at_bound,
            "failed_solves": runs.failures,
            "ended_early": len(runs.ended),
        }
        warnings = report.warnings(result)
        if runs.ended:
            warnings.insert(0, f"{len(runs.ended)} runs ended early: {runs.ended[0]}")
        if runs.failures:
            failed = f"{runs.failures} control samples' solves failed; the fall-back acted"
            warnings.insert(0, failed)
        lead = report.lead_of_loop(result, at_bound)
        return Findings(f"Phase portrait under {name}", lead, parts, json_data(results), warnings)


def _settling(rest: RestPoint) -> float:
    """s until the slowest mode of an equilibrium is over."""
    decaying = [-value.real for value in rest.eigenvalues if value.real < -1e-9]
    if not decaying:
        return _LOOP_DURATION
    return float(np.clip(round(_TIME_CONSTANTS / min(decaying), 1), _LEAST, _LONGEST))


def _around(
    window: FloatArray, visited: FloatArray, given: Mapping[int, tuple[float, float]]
) -> FloatArray:
    """A window widened to what was visited; what was given stays."""
    rows = visited[np.isfinite(visited).all(axis=1)]
    found = window.copy()
    for place in range(len(window)):
        if place not in given and len(rows):
            low = min(window[place, 0], rows[:, place].min())
            high = max(window[place, 1], rows[:, place].max())
            # What runs away does not set the scale.
            most = _MOST_WIDENED * (window[place, 1] - window[place, 0])
            margin = 0.04 * (high - low)
            found[place] = (
                max(low - margin, window[place, 0] - most),
                min(high + margin, window[place, 1] + most),
            )
    return found
