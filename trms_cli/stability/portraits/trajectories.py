"""Trajectories of a portrait, and what of them is drawn.

Trajectories of a closed loop in the plane of a portrait.

The command follows from what the controller and its observer remember, not from the state alone:
there is no field in the plane, so no nullclines, and trajectories may cross.

Where each trajectory of a portrait ends, and when it has arrived.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from trms_cli.core.arrays import BoolArray, FloatArray
from trms_cli.models.operating_point import refined
from trms_cli.stability.closed_loop import run_loop
from trms_cli.stability.portraits.invariant_sets import RestPoint, StickingSet, rest_point
from trms_cli.stability.portraits.section import StateSection
from trms_cli.stability.study import Tell
from trms_cli.stability.subject import LoopParts

#: Points while a mode lasts that is over within a step, and between them in its time constants.
_FINE_STEPS, _FINE = 40, 0.2
#: Starts of motions that are integrated at once.
_MOST_AT_ONCE = 64


@dataclass(frozen=True)
class PortraitTrajectory:
    """A trajectory."""

    time: FloatArray  #: (n,) array; s
    x: FloatArray  #: (n, n_x) array
    c: FloatArray  #: (n, n_c) array; coordinates
    #: (n,) bool array; whether a command is at its bound; False throughout for the model alone
    saturated: BoolArray


def trajectories(
    section: StateSection, starts: FloatArray, duration: float, step: float
) -> tuple[PortraitTrajectory, ...]:
    """Motions of the whole model from starts (m, n_x) with the section's command held.

    Where a mode is over within a step (an armature's current: 0.1 ms), finer points come first: a
    line from the start to the end of the first step would show the fall along it aslant.
    """
    coordinates, u = section.coordinates, section.point.u
    slopes, _ = coordinates.field.linearised(section.point.x, u)
    fastest = float(np.abs(np.linalg.eigvals(slopes).real).max())
    fine = _FINE / fastest if fastest * step > 1.0 else 0.0  # s; 0 where a step shows it
    time: FloatArray = np.arange(max(1, round(duration / step)) + 1, dtype=np.float64) * step
    if fine:
        early = np.arange(_FINE_STEPS + 1) * fine
        time = np.concatenate([early, early[-1] + time[1:]])
    found: list[PortraitTrajectory] = []
    for first in range(0, len(starts), _MOST_AT_ONCE):
        part = starts[first : first + _MOST_AT_ONCE]
        if fine:
            begun = coordinates.field.motions(part, u, _FINE_STEPS * fine, fine)
            rest = coordinates.field.motions(begun[-1], u, duration, step)
            x = np.concatenate([begun, rest[1:]])
        else:
            x = coordinates.field.motions(part, u, duration, step)
        never = np.zeros(len(time), dtype=bool)
        for i in range(len(part)):
            c = coordinates.values(x[:, i], u)
            found.append(PortraitTrajectory(time, x[:, i], c, never))
    return tuple(found)


def drawn_points(
    trajectory: PortraitTrajectory, window: FloatArray, apart: float, longest: float = np.inf
) -> tuple[FloatArray, BoolArray]:
    """A trajectory for drawing: points some distance apart, up to a length, within the window.

    Distances are shares of the window's width. Returns points (n, n_c), NaN outside, and whether a
    command is at its bound, (n,).
    """
    c = trajectory.c
    steps = np.linalg.norm(np.diff(c, axis=0) / np.ptp(window, axis=1), axis=1)
    length = np.concatenate([[0.0], np.cumsum(np.nan_to_num(steps, nan=np.inf))])
    finite = np.isfinite(length)
    end = min(float(length[finite][-1]), longest)
    kept = np.unique(np.searchsorted(length[finite], np.arange(0.0, end + apart / 2, apart)))
    kept = kept[kept < finite.sum()]
    points = c[kept].copy()
    inside = np.all((points >= window[:, 0]) & (points <= window[:, 1]), axis=1)
    # One point beyond each way out, so that lines reach the edge.
    near = inside.copy()
    near[1:] |= inside[:-1]
    near[:-1] |= inside[1:]
    points[~near] = np.nan
    return points, trajectory.saturated[kept]


#: A command within this share of its bound is at it.
_AT_BOUND = 1e-6


@dataclass(frozen=True)
class LoopTrajectories:
    """Trajectories of a loop."""

    trajectories: tuple[PortraitTrajectory, ...]
    failures: int  #: Control samples whose solve failed, of all runs
    ended: tuple[str, ...]  #: Why runs ended early


def loop_trajectories(
    section: StateSection, loop: LoopParts, starts: FloatArray, duration: float, tell: Tell
) -> LoopTrajectories:
    """Runs of the loop from starts (m, n_x), its references at the section's operating point."""
    coordinates, point = section.coordinates, section.point
    model = coordinates.model
    bound = model.input_bounds()[1] * (1.0 - _AT_BOUND)
    found, failures, ended = [], 0, []
    for number, start in enumerate(starts, 1):
        tell(f"run {number} of {len(starts)}")
        offset = dict(zip(model.state_names, (start - point.x).tolist(), strict=True))
        run = run_loop(model, loop, point, duration, offset=offset)
        # What is held back is the command as given: a loop's path to the motors bounds it too.
        saturated = np.any(np.abs(run.applied) >= bound, axis=1)
        c = coordinates.values(run.x, run.applied)
        found.append(PortraitTrajectory(run.time, run.x, c, saturated))
        failures += run.failures
        if run.ended:
            ended.append(run.ended)
    return LoopTrajectories(tuple(found), failures, tuple(ended))


What = Literal["rest", "rest outside", "line", "held", "stuck", "moving", "turning", "gone"]

#: Share of the window's width within which a motion has arrived.
NEAR = 0.02
#: The last part of a motion, which must lie there.
_TAIL = 0.1


@dataclass(frozen=True)
class TrajectoryEnd:
    """Where some of the motions end."""

    #: ``rest``: at an equilibrium of the window; ``rest outside``: at one outside; ``line``: on a
    #: line of them. ``held``: on a sticking set; ``stuck``: standing still elsewhere under dry
    #: friction. ``moving``: still on its way in the window; ``turning``: half a turn or more
    #: outside it and moving; ``gone``: outside otherwise.
    what: What
    members: tuple[int, ...]  #: Numbers of the journeys
    #: s after which each stays within 2 % of the window's width of its end; empty where nothing is
    #: reached
    times: tuple[float, ...] = ()
    rest: RestPoint | None = None
    held: StickingSet | None = None


def ends_of(
    section: StateSection,
    window: FloatArray,
    rests: Sequence[RestPoint],
    found: Sequence[PortraitTrajectory],
    sticking: Sequence[StickingSet] = (),
    *,
    dry_friction: bool = False,
    search_beyond: bool = True,
) -> tuple[TrajectoryEnd, ...]:
    """The motions by their ends, the most frequent end first.

    With dry friction something may stand still where there is no equilibrium of f; equilibria
    outside the window are looked for on request, where motions seem to rest.
    """
    known, near = list(rests), NEAR * np.ptp(window, axis=1)

    def end_of(path: PortraitTrajectory) -> tuple[What, int, float]:
        """What, the place of its rest point or sticking set, and when."""
        c = path.c
        if not np.isfinite(c[-1]).all():
            return "gone", -1, np.inf
        tail = c[-max(2, round(_TAIL * len(c))) :]
        still = bool(np.all(np.ptp(tail, axis=0) <= near))
        for place, held in enumerate(sticking):
            if still and held.holds(c[-1], near):
                return "held", place, _arrival(path, c[-1], near)
        for place, rest in enumerate(known):
            if np.all(np.abs(tail - rest.c) <= near):
                return "rest", place, _arrival(path, rest.c, near)
        if still and search_beyond:
            x = refined(section.coordinates.field, path.x[-1], section.point.u)
            beyond = None if x is None else rest_point(section, x)
            if beyond is not None and np.all(np.abs(tail - beyond.c) <= near):
                known.append(beyond)
                return "rest", len(known) - 1, _arrival(path, beyond.c, near)
        if still and dry_friction:
            return "stuck", -1, _arrival(path, c[-1], near)
        past = np.maximum(window[:, 0] - c[-1], c[-1] - window[:, 1])
        angles = [item.unit == "rad" for item in section.coordinates.items]
        if np.any(past[angles] > np.pi):
            return "turning", -1, np.inf
        inside = np.all((tail >= window[:, 0]) & (tail <= window[:, 1]))
        return "moving" if inside else "gone", -1, np.inf

    groups: dict[tuple[What, int], list[tuple[int, float]]] = {}
    for number, trajectory in enumerate(found):
        what, place, time = end_of(trajectory)
        if what == "rest" and known[place].line:
            what, place = "line", -1
        elif what == "rest" and place >= len(rests):
            c = known[place].c
            inside = np.all((c >= window[:, 0]) & (c <= window[:, 1]))
            what = "rest" if inside else "rest outside"
        groups.setdefault((what, place), []).append((number, time))
    ends = []
    for (what, place), members in groups.items():
        times = tuple(time for _, time in members if np.isfinite(time))
        rest = known[place] if what in ("rest", "rest outside") else None
        held = sticking[place] if what == "held" else None
        ends.append(TrajectoryEnd(what, tuple(number for number, _ in members), times, rest, held))
    return tuple(sorted(ends, key=lambda end: -len(end.members)))


def _arrival(trajectory: PortraitTrajectory, goal: FloatArray, near: FloatArray) -> float:
    """s after which it stays near."""
    away = np.flatnonzero(~np.all(np.abs(trajectory.c - goal) <= near, axis=1))
    return float(trajectory.time[min(away[-1] + 1, len(trajectory.time) - 1)]) if len(away) else 0.0
