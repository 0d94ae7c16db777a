"""From what is asked of a portrait to its findings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from trms_cli.core.chart import Chart
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.findings import Findings
from trms_cli.core.findings import Section as Part
from trms_cli.stability.portraits import account, captions, tables
from trms_cli.stability.portraits.account import Told
from trms_cli.stability.portraits.drawing import Picture, portrait
from trms_cli.stability.portraits.ends import End, ends_of
from trms_cli.stability.portraits.journeys import Journey, journeys
from trms_cli.stability.portraits.loops import loop_journeys
from trms_cli.stability.portraits.rest_points import RestPoint, grid, rest_point, search
from trms_cli.stability.portraits.section import Section
from trms_cli.stability.portraits.separatrices import separatrices
from trms_cli.stability.portraits.starts import (
    DEFAULT_COUNT,
    LOOP_COUNT,
    default_starts,
    given_starts,
    loop_starts,
)
from trms_cli.stability.portraits.sticking import StickingSet, has_dry_friction, sticking_sets
from trms_cli.stability.portraits.window import default_window
from trms_cli.stability.study import Tell
from trms_cli.stability.subject import LoopParts

FloatArray = npt.NDArray[np.float64]

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
class Wish:
    """What is asked for."""

    section: Section
    window: Mapping[int, tuple[float, float]]  #: Limits that were given, by the coordinate's place
    #: number of states, or the states in SI units
    starts: int | tuple[Mapping[str, float], ...] | None = None
    duration: float | None = None  #: s
    step: float = 0.02  #: s
    open_loop_too: bool = False


def portrait_of_model(wish: Wish, tell: Tell) -> Findings:
    """The model alone, its command held."""
    section = wish.section
    coordinates, n = section.coordinates, len(section.coordinates)
    tell("window and equilibria")
    window = default_window(section, wish.window)
    rests = search(section, window)
    invariant = section.is_invariant(grid(window, _INVARIANCE_GRID[n]).reshape(-1, n))
    duration = wish.duration or _settling(rest_point(section, section.point.x))
    if isinstance(wish.starts, tuple):
        starts = given_starts(section, wish.starts)
    else:
        starts = default_starts(section, window, wish.starts or DEFAULT_COUNT[n])
    if not len(starts):
        raise ConfigurationError(
            "nowhere in the window have the settled states a value",
            where="others",
            remedy="hold them: study.others=held",
        )
    _check_size(len(starts), duration, wish.step)
    rubs = has_dry_friction(coordinates.model)
    if rubs:
        tell("sticking sets")
    sticking = sticking_sets(section, window, rests)
    tell("trajectories")
    found, ends = _ended(wish, window, rests, starts, duration, sticking, rubs)
    duration = float(found[0].time[-1])
    tell("separatrices")
    paths = [
        path
        for rest in rests
        if not rubs
        for path in separatrices(section, invariant, window, rest, _SEPARATRIX)
    ]
    picture = Picture(section, window, rests, found, ends, (), paths, sticking)
    told = Told(picture, duration, invariant)
    table = tables.ends_table(section, account.merged(ends), len(found))
    parts = [
        Part("The portrait", captions.of_model(told, rubs), [_chart(told)]),
        Part("Equilibria in the window", (), [tables.equilibria_table(section, rests)]),
        Part("Where the trajectories end", (), [table]),
    ]
    return Findings(
        "Phase portrait",
        account.lead_of_model(told),
        parts,
        tables.results(told),
        captions.warnings(told),
    )


def portrait_of_loop(wish: Wish, loop: LoopParts, tell: Tell) -> Findings:
    """The loop around the model, its references at the operating point."""
    section = wish.section
    tell("window")
    window = default_window(section, wish.window, around=True)
    duration = wish.duration or _LOOP_DURATION
    if isinstance(wish.starts, tuple):
        starts = given_starts(section, wish.starts)
    else:
        starts = loop_starts(section, window, wish.starts or LOOP_COUNT)
    runs = loop_journeys(section, loop, starts, duration, tell)
    window = _around(window, np.concatenate([run.c for run in runs.journeys]), wish.window)
    goal = rest_point(section, section.point.x)
    ends = ends_of(section, window, [goal], runs.journeys, search_beyond=False)
    beside = journeys(section, starts, duration, wish.step) if wish.open_loop_too else ()
    picture = Picture(section, window, [], runs.journeys, ends, (), beside=beside, loop=True)
    told = Told(picture, duration, False, loop.names["controller"])
    at_bound = float(np.mean(np.concatenate([run.saturated for run in runs.journeys])))
    table = tables.ends_table(section, ends, len(runs.journeys))
    parts = [
        Part("The portrait", captions.of_loop(told, loop.names["observer"]), [_chart(told)]),
        Part("Where the trajectories end", (), [table]),
    ]
    results = tables.results(told) | {
        "controller": told.loop,
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
        f"Phase portrait under {told.loop}",
        account.lead_of_loop(told, at_bound),
        parts,
        results,
        [*warnings, *captions.warnings(told)],
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
    wish: Wish,
    window: FloatArray,
    rests: tuple[RestPoint, ...],
    starts: FloatArray,
    duration: float,
    sticking: tuple[StickingSet, ...],
    rubs: bool,
) -> tuple[tuple[Journey, ...], tuple[End, ...]]:
    """Trajectories and their ends; longer ones where some are still on their way.

    Away from the operating point a model may be slower than its slowest mode there.
    """
    while True:
        found = journeys(wish.section, starts, duration, wish.step)
        ends = ends_of(wish.section, window, rests, found, sticking, dry_friction=rubs)
        unfinished = any(end.what == "moving" for end in ends)
        if wish.duration is not None or not unfinished or 2 * duration > _LONGEST:
            return found, ends
        duration *= 2


def _chart(told: Told) -> Chart:
    ends = account.merged(told.picture.ends)
    labels = [account.legend(told.picture.section, end, told.picture.rests) for end in ends]
    picture = replace(told.picture, ends=ends, labels=labels)
    return portrait(picture, NAME, captions.caption(told))


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
