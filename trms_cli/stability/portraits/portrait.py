"""From what is asked of a portrait to its findings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.core.chart import Chart
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.findings import Findings, Section, json_data
from trms_cli.stability.portraits import report
from trms_cli.stability.portraits.charts import PortraitResult, portrait
from trms_cli.stability.portraits.rest_points import RestPoint, grid, rest_point, search
from trms_cli.stability.portraits.section import StateSection
from trms_cli.stability.portraits.separatrices import separatrices
from trms_cli.stability.portraits.sticking import StickingSet, has_dry_friction, sticking_sets
from trms_cli.stability.portraits.trajectories import (
    PortraitTrajectory,
    TrajectoryEnd,
    ends_of,
    loop_trajectories,
    trajectories,
)
from trms_cli.stability.portraits.window import (
    DEFAULT_COUNT,
    LOOP_COUNT,
    default_starts,
    default_window,
    given_starts,
    loop_starts,
)
from trms_cli.stability.study import Tell
from trms_cli.stability.subject import LoopParts

NAME = "phase_portrait"
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


@dataclass(frozen=True)
class PortraitRequest:
    """What is asked for."""

    section: StateSection
    window: Mapping[int, tuple[float, float]]  #: Limits that were given, by the coordinate's place
    #: number of states, or the states in SI units
    starts: int | tuple[Mapping[str, float], ...] | None = None
    duration: float | None = None  #: s
    step: float = 0.02  #: s
    open_loop_too: bool = False


def portrait_of_model(request: PortraitRequest, tell: Tell) -> Findings:
    """The model alone, its command held."""
    section = request.section
    coordinates, n = section.coordinates, len(section.coordinates)
    tell("window and equilibria")
    window = default_window(section, request.window)
    rests = search(section, window)
    invariant = section.is_invariant(grid(window, _INVARIANCE_GRID[n]).reshape(-1, n))
    duration = request.duration or _settling(rest_point(section, section.point.x))
    if isinstance(request.starts, tuple):
        starts = given_starts(section, request.starts)
    else:
        starts = default_starts(section, window, request.starts or DEFAULT_COUNT[n])
    if not len(starts):
        raise ConfigurationError(
            "nowhere in the window have the settled states a value",
            where="others",
            remedy="hold them: study.others=held",
        )
    _check_size(len(starts), duration, request.step)
    rubs = has_dry_friction(coordinates.model)
    if rubs:
        tell("sticking sets")
    sticking = sticking_sets(section, window, rests)
    tell("trajectories")
    paths, ends = _ended(request, window, rests, starts, duration, sticking, rubs)
    duration = float(paths[0].time[-1])
    tell("separatrices")
    manifolds = [
        path
        for rest in rests
        if not rubs
        for path in separatrices(section, invariant, window, rest, _SEPARATRIX)
    ]
    result = PortraitResult(
        section, window, rests, paths, ends, duration, invariant, manifolds, sticking
    )
    table = report.ends_table(section, report.merged(ends), len(paths))
    parts = [
        Section("The portrait", report.of_model(result, rubs), [_chart(result)]),
        Section("Equilibria in the window", (), [report.equilibria_table(section, rests)]),
        Section("Where the trajectories end", (), [table]),
    ]
    return Findings(
        "Phase portrait",
        report.lead_of_model(result),
        parts,
        json_data(report.results(result)),
        report.warnings(result),
    )


def portrait_of_loop(request: PortraitRequest, loop: LoopParts, tell: Tell) -> Findings:
    """The loop around the model, its references at the operating point."""
    section = request.section
    tell("window")
    window = default_window(section, request.window, around=True)
    duration = request.duration or _LOOP_DURATION
    if isinstance(request.starts, tuple):
        starts = given_starts(section, request.starts)
    else:
        starts = loop_starts(section, window, request.starts or LOOP_COUNT)
    runs = loop_trajectories(section, loop, starts, duration, tell)
    window = _around(window, np.concatenate([run.c for run in runs.trajectories]), request.window)
    goal = rest_point(section, section.point.x)
    ends = ends_of(section, window, [goal], runs.trajectories, search_beyond=False)
    beside = trajectories(section, starts, duration, request.step) if request.open_loop_too else ()
    result = PortraitResult(
        section,
        window,
        [],
        runs.trajectories,
        ends,
        duration,
        beside=beside,
        loop=loop.names["controller"],
    )
    at_bound = float(np.mean(np.concatenate([run.saturated for run in runs.trajectories])))
    table = report.ends_table(section, ends, len(runs.trajectories))
    parts = [
        Section("The portrait", report.of_loop(result, loop.names["observer"]), [_chart(result)]),
        Section("Where the trajectories end", (), [table]),
    ]
    results = report.results(result) | {
        "controller": result.loop,
        "share_at_bound": at_bound,
        "failed_solves": runs.failures,
        "ended_early": len(runs.ended),
    }
    warnings = []
    if runs.failures:
        warnings.append(f"{runs.failures} control samples' solves failed; the fall-back acted")
    if runs.ended:
        warnings.append(f"{len(runs.ended)} runs ended early: {runs.ended[0]}")
    return Findings(
        f"Phase portrait under {result.loop}",
        report.lead_of_loop(result, at_bound),
        parts,
        json_data(results),
        [*warnings, *report.warnings(result)],
    )


def _check_size(count: int, duration: float, step: float) -> None:
    if count * duration / step > _MOST_POINTS:
        raise ConfigurationError(
            f"{count} trajectories of {duration:g} s by steps of {step:g} s are "
            f"{count * duration / step:.2g} points",
            where="step",
            remedy=f"stay below {_MOST_POINTS:.0e}: by a longer step, fewer starts, or a shorter "
            "duration",
        )


def _ended(
    request: PortraitRequest,
    window: FloatArray,
    rests: tuple[RestPoint, ...],
    starts: FloatArray,
    duration: float,
    sticking: tuple[StickingSet, ...],
    rubs: bool,
) -> tuple[tuple[PortraitTrajectory, ...], tuple[TrajectoryEnd, ...]]:
    """Trajectories and their ends; longer ones where some are still on their way.

    Away from the operating point a model may be slower than its slowest mode there.
    """
    while True:
        found = trajectories(request.section, starts, duration, request.step)
        ends = ends_of(request.section, window, rests, found, sticking, dry_friction=rubs)
        unfinished = any(end.what == "moving" for end in ends)
        if request.duration is not None or not unfinished or 2 * duration > _LONGEST:
            return found, ends
        duration *= 2


def _chart(result: PortraitResult) -> Chart:
    ends = report.merged(result.ends)
    labels = [report.legend(result.section, end, result.rests) for end in ends]
    return portrait(result, NAME, report.caption(result), ends, labels)


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
