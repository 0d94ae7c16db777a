"""Where each trajectory of a portrait ends, and when it has arrived."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from trms_cli.models.operating_point import refined
from trms_cli.stability.portraits.journeys import Journey
from trms_cli.stability.portraits.rest_points import RestPoint, rest_point
from trms_cli.stability.portraits.section import Section
from trms_cli.stability.portraits.sticking import StickingSet

FloatArray = npt.NDArray[np.float64]
What = Literal["rest", "rest outside", "line", "held", "stuck", "moving", "turning", "gone"]

#: Share of the window's width within which a motion has arrived.
NEAR = 0.02
#: The last part of a motion, which must lie there.
_TAIL = 0.1


@dataclass(frozen=True)
class End:
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


@dataclass(frozen=True)
class _Verdict:
    """On one journey; the place is that of its rest point or sticking set."""

    what: What
    place: int = -1
    time: float = np.inf


def ends_of(
    section: Section,
    window: FloatArray,
    rests: Sequence[RestPoint],
    found: Sequence[Journey],
    sticking: Sequence[StickingSet] = (),
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
    sticking : sequence of StickingSet
    dry_friction : bool
        Whether something may stand still where there is no equilibrium of f.
    search_beyond : bool
        Whether equilibria outside the window are looked for where motions seem to rest.
    """
    known = list(rests)
    groups: dict[tuple[What, int], list[tuple[int, float]]] = {}
    for number, journey in enumerate(found):
        verdict = _verdict(section, window, known, journey, sticking, dry_friction, search_beyond)
        what, place = verdict.what, verdict.place
        if what == "rest" and known[place].line:
            what, place = "line", -1
        elif what == "rest" and place >= len(rests):
            c = known[place].c
            inside = np.all((c >= window[:, 0]) & (c <= window[:, 1]))
            what = "rest" if inside else "rest outside"
        groups.setdefault((what, place), []).append((number, verdict.time))
    ends = []
    for (what, place), members in groups.items():
        at_rest = what in ("rest", "rest outside")
        ends.append(
            End(
                what,
                tuple(number for number, _ in members),
                tuple(time for _, time in members if np.isfinite(time)),
                known[place] if at_rest else None,
                sticking[place] if what == "held" else None,
            )
        )
    return tuple(sorted(ends, key=lambda end: -len(end.members)))


def _verdict(
    section: Section,
    window: FloatArray,
    known: list[RestPoint],
    journey: Journey,
    sticking: Sequence[StickingSet],
    dry_friction: bool,
    search_beyond: bool,
) -> _Verdict:
    c, near = journey.c, NEAR * np.ptp(window, axis=1)
    if not np.isfinite(c[-1]).all():
        return _Verdict("gone")
    tail = c[-max(2, round(_TAIL * len(c))) :]
    still = bool(np.all(np.ptp(tail, axis=0) <= near))
    for place, held in enumerate(sticking):
        if still and held.holds(c[-1], near):
            return _Verdict("held", place, _arrival(journey, c[-1], near))
    for place, rest in enumerate(known):
        if np.all(np.abs(tail - rest.c) <= near):
            return _Verdict("rest", place, _arrival(journey, rest.c, near))
    if still and search_beyond:
        x = refined(section.coordinates.field, journey.x[-1], section.point.u)
        rest_of = None if x is None else rest_point(section, x)
        if rest_of is not None and np.all(np.abs(tail - rest_of.c) <= near):
            known.append(rest_of)
            return _Verdict("rest", len(known) - 1, _arrival(journey, rest_of.c, near))
    if still and dry_friction:
        return _Verdict("stuck", -1, _arrival(journey, c[-1], near))
    for place, item in enumerate(section.coordinates.items):
        past = max(window[place, 0] - c[-1, place], c[-1, place] - window[place, 1])
        if item.unit == "rad" and past > np.pi:
            return _Verdict("turning")
    inside = np.all((tail >= window[:, 0]) & (tail <= window[:, 1]))
    return _Verdict("moving" if inside else "gone")


def _arrival(journey: Journey, goal: FloatArray, near: FloatArray) -> float:
    """s after which it stays near."""
    away = np.flatnonzero(~np.all(np.abs(journey.c - goal) <= near, axis=1))
    return float(journey.time[min(away[-1] + 1, len(journey.time) - 1)]) if len(away) else 0.0
