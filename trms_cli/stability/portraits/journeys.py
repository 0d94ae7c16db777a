"""Trajectories, and where each one ends."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from trms_cli.stability.operating_point import refined
from trms_cli.stability.portraits.rest_points import RestPoint, rest_point
from trms_cli.stability.portraits.section import Section

FloatArray = npt.NDArray[np.float64]

#: Share of the window's width within which a motion has arrived, and the last part of it that must
#: lie there.
NEAR = 0.02
_TAIL = 0.1
#: Points while a mode lasts that is over within a step, and between them in its time constants.
_FINE_STEPS, _FINE = 40, 0.2
#: Starts of motions that are integrated at once.
_MOST_AT_ONCE = 64


@dataclass(frozen=True)
class Journey:
    """A trajectory.

    Attributes
    ----------
    time : (n,) array
        s.
    x : (n, n_x) array
    c : (n, n_c) array
        Coordinates.
    saturated : (n,) bool array
        Whether a command is at its bound; False throughout for the model alone.
    """

    time: FloatArray
    x: FloatArray
    c: FloatArray
    saturated: npt.NDArray[np.bool_]


@dataclass(frozen=True)
class End:
    """Where some of the motions end.

    Attributes
    ----------
    what : {"rest", "rest outside", "stuck", "moving", "turning", "gone"}
        At an equilibrium of the window; at one outside; at rest where there is no equilibrium
        (dry friction holds it); still on its way within the window; half a turn or more outside it
        and moving; outside otherwise and moving.
    rest : RestPoint or None
        The equilibrium.
    members : tuple of int
        Numbers of the journeys.
    times : tuple of float
        s after which each stays within 2 % of the window's width of its end; empty where nothing
        is reached.
    """

    what: str
    rest: RestPoint | None
    members: tuple[int, ...]
    times: tuple[float, ...] = ()


def journeys(
    section: Section,
    starts: FloatArray,
    duration: float,
    step: float,
) -> tuple[Journey, ...]:
    """Motions of the whole model from starts (m, n_x) with the section's command held.

    Where a mode is over within a step (an armature's current: 0.1 ms), finer points come first: a
    line from the start to the end of the first step would show the fall along it aslant.
    """
    coordinates, u = section.coordinates, section.point.u
    fine = _fine_step(section, step)
    time: FloatArray = np.arange(max(1, round(duration / step)) + 1, dtype=np.float64) * step
    if fine:
        early = np.arange(_FINE_STEPS + 1) * fine
        time = np.concatenate([early, early[-1] + time[1:]])
    found: list[Journey] = []
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
            found.append(Journey(time, x[:, i], c, never))
    return tuple(found)


def _fine_step(section: Section, step: float) -> float:
    """s between points while the fastest mode lasts; 0 where a step shows it."""
    slopes, _ = section.coordinates.field.linearised(section.point.x, section.point.u)
    fastest = float(np.abs(np.linalg.eigvals(slopes).real).max())
    return _FINE / fastest if fastest * step > 1.0 else 0.0


def ends_of(
    section: Section,
    window: FloatArray,
    rests: Sequence[RestPoint],
    found: Sequence[Journey],
    *,
    dry_friction: bool = False,
    search_beyond: bool = True,
) -> tuple[End, ...]:
    """The motions by their ends, the most frequent end first.

    Parameters
    ----------
    window : (n_c, 2)
    rests : sequence of RestPoint
        Those of the window.
    dry_friction : bool
        Whether something may stand still where there is no equilibrium of f.
    search_beyond : bool
        Whether equilibria outside the window are looked for where motions seem to rest.
    """
    width = np.ptp(window, axis=1)
    groups: dict[tuple[str, int], list[tuple[int, float]]] = {}
    known = list(rests)
    for number, journey in enumerate(found):
        what, place, time = _end(
            section, window, width, known, journey, dry_friction, search_beyond
        )
        groups.setdefault((what, place), []).append((number, time))
    ends = []
    for (what, place), members in groups.items():
        rest = known[place] if place >= 0 else None
        if what == "rest" and rest is not None and place >= len(rests):
            what = "rest outside"
        times = tuple(time for _, time in members if np.isfinite(time))
        ends.append(End(what, rest, tuple(number for number, _ in members), times))
    return tuple(sorted(ends, key=lambda end: -len(end.members)))


def _end(
    section: Section,
    window: FloatArray,
    width: FloatArray,
    known: list[RestPoint],
    journey: Journey,
    dry_friction: bool,
    search_beyond: bool,
) -> tuple[str, int, float]:
    """What, which of the known rest points (−1: none), and after which time."""
    c = journey.c
    if not np.isfinite(c[-1]).all():
        return "gone", -1, np.inf
    tail = c[-max(2, round(_TAIL * len(c))) :]
    for place, rest in enumerate(known):
        if np.all(np.abs(tail - rest.c) <= NEAR * width):
            return "rest", place, _arrival(journey, rest.c, width)
    still = bool(np.all(np.ptp(tail, axis=0) <= NEAR * width))
    if still and search_beyond:
        x = refined(section.coordinates.field, journey.x[-1], section.point.u)
        if x is not None:
            rest = rest_point(section, x)
            if np.all(np.abs(tail - rest.c) <= NEAR * width):
                known.append(rest)
                return "rest", len(known) - 1, _arrival(journey, rest.c, width)
    if still and dry_friction:
        return "stuck", -1, _arrival(journey, c[-1], width)
    for place, item in enumerate(section.coordinates.items):
        past = max(window[place, 0] - c[-1, place], c[-1, place] - window[place, 1])
        if item.unit == "rad" and past > np.pi:
            return "turning", -1, np.inf
    inside = np.all((tail >= window[:, 0]) & (tail <= window[:, 1]))
    return ("moving" if inside else "gone"), -1, np.inf


def _arrival(journey: Journey, goal: FloatArray, width: FloatArray) -> float:
    """s after which it stays near."""
    away = ~np.all(np.abs(journey.c - goal) <= NEAR * width, axis=1)
    last = np.flatnonzero(away)
    return float(journey.time[min(last[-1] + 1, len(away) - 1)]) if len(last) else 0.0


def spaced(
    journey: Journey, window: FloatArray, apart: float, longest: float = np.inf
) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """A trajectory for drawing: points some distance apart, up to a length, within the window.

    Parameters
    ----------
    apart, longest : float
        In shares of the window's width.

    Returns
    -------
    (n, n_c) array, (n,) bool array
        NaN where it is outside; whether a command is at its bound.
    """
    c = journey.c
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
    return points, journey.saturated[kept]
