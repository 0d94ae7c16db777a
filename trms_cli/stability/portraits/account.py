"""What a portrait says in words, tables and data."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from trms_cli.stability.portraits.coordinates import symbol
from trms_cli.stability.portraits.drawing import Picture
from trms_cli.stability.portraits.ends import NEAR, End
from trms_cli.stability.portraits.rest_points import RestPoint, halving_time, period
from trms_cli.stability.portraits.section import Section
from trms_cli.stability.portraits.sticking import StickingSet

FloatArray = npt.NDArray[np.float64]

#: A mode this much faster than the slowest one is told apart in words.
_MUCH_FASTER = 20.0


def short(value: float) -> str:
    """Three digits behind what matters; rounding is zero."""
    return "0" if abs(value) < 5e-7 else f"{value:.4g}"


def _unit(unit: str) -> str:
    return "" if unit == "1" else f" {unit}"


def commands(section: Section) -> str:
    """``u_v = 1.413 V``."""
    model = section.coordinates.model
    return ", ".join(
        f"{signal.name} = {short(float(value))}{_unit(signal.unit)}"
        for signal, value in zip(model.inputs, section.point.u, strict=True)
    )


def place(section: Section, rest: RestPoint) -> str:
    """``α_v = 1.903 rad``: by the first coordinate that is no rate, the others where not zero."""
    shown = [
        f"{item.label} = {short(float(value))}{_unit(item.unit)}"
        for item, value in zip(section.coordinates.items, rest.c, strict=True)
        if not (item.is_rate or (abs(value) < 1e-6 and item.unit != "rad"))
    ]
    return ", ".join(shown) or "the origin"


def label(section: Section, end: End) -> str:
    """An end in words."""
    if end.what == "rest":
        assert end.rest is not None
        return f"comes to rest at {place(section, end.rest)}"
    if end.what == "held":
        assert end.held is not None
        return f"comes to rest where dry friction holds {held_words(section, end.held)}"
    return {
        "line": "comes to rest on the line of rest points",
        "rest outside": "comes to rest outside the window",
        "stuck": "stands still elsewhere",
        "moving": "still moving at the end",
        "turning": "turns over and keeps turning",
        "gone": "leaves the window",
    }[end.what]


def held_words(section: Section, held: StickingSet) -> str:
    """``α_v, α_v from −0.648 to −0.591 rad``."""
    item = section.coordinates.items[held.along]
    low, high = (short(value) for value in held.reach)
    what = "" if held.what == item.label else f"{held.what} at "
    return f"{what}{item.label} = {low} to {high} {item.unit}"


def _rests_along(section: Section, held: StickingSet) -> bool:
    """Whether the set extends along the angle that is held, and so consists of rest points."""
    return held.what == section.coordinates.items[held.along].label


def legend(section: Section, end: End, rests: Sequence[RestPoint]) -> str:
    """An end in the legend: by its kind where that is enough."""
    if end.what == "held":
        return "comes to rest, held by dry friction"
    if end.rest is None or end.what != "rest" or not rests:
        return "comes to rest at the goal" if end.what == "rest" else label(section, end)
    alike = [rest for rest in rests if rest.kind == end.rest.kind]
    if len(alike) == 1:
        return f"comes to rest at the {end.rest.kind}"
    return label(section, end)


def merged(ends: Sequence[End]) -> tuple[End, ...]:
    """The ends with all rest points outside the window as one."""
    outside = [end for end in ends if end.what == "rest outside"]
    if len(outside) < 2:
        return tuple(ends)
    members = tuple(number for end in outside for number in end.members)
    times = tuple(time for end in outside for time in end.times)
    rest = [end for end in ends if end.what != "rest outside"]
    return (*rest, End("rest outside", members, times))


@dataclass(frozen=True)
class Told:
    """What the words are about."""

    picture: Picture  #: With all ends apart
    duration: float  #: s of each trajectory
    invariant: bool
    loop: str = ""  #: The controller; empty for the model alone


def lead_of_model(told: Told) -> list[str]:
    """The answer of a portrait of the model alone."""
    picture = told.picture
    section = picture.section
    lead = [f"At {commands(section)}: {_equilibria(section, picture.rests)}."]
    lead.append(_ends(picture, told.duration))
    lead += [_growth(rest) for rest in picture.rests if rest.kind == "saddle focus"]
    stable = [rest for rest in picture.rests if rest.stable]
    if stable:
        lead.append(_tempo(stable[0]))
    saddles = [rest for rest in picture.rests if rest.kind == "saddle"]
    if saddles and any(path.into and not path.surface for path in picture.separatrices):
        lead.append(
            "The motions into the saddle (the separatrix) part the starts by where they end."
        )
    lead += _beyond_stops(section, saddles)
    lines = [held for held in picture.sticking if _rests_along(section, held)]
    if lines:
        sets = " and ".join(held_words(section, held) for held in lines)
        lead.append(
            f"Dry friction holds {sets}: trajectories end anywhere on such a line, not at a point."
        )
    lead += [
        f"Dry friction holds {held_words(section, held)}: a trajectory that gets there goes on "
        "along that line, if at all."
        for held in picture.sticking
        if held not in lines
    ]
    return lead


def lead_of_loop(told: Told, at_bound: float) -> list[str]:
    """The answer of a portrait of a closed loop.

    Parameters
    ----------
    at_bound : float
        Share of the samples with a command at its bound.
    """
    picture = told.picture
    total = len(picture.journeys)
    reached = [end for end in picture.ends if end.what == "rest"]
    count = sum(len(end.members) for end in reached)
    times = [time for end in reached for time in end.times]
    who = "All" if count == total else f"{count} of the"
    if count:
        lead = [
            f"{who} {total} trajectories under {told.loop} reach the goal and stay within "
            f"{100 * NEAR:g} % of the window's width of it, after {np.median(times):.3g} s by the "
            f"median and {max(times):.3g} s at the longest."
        ]
    else:
        lead = [
            f"None of the {total} trajectories under {told.loop} stays within {100 * NEAR:g} % of "
            f"the window's width of the goal in {told.duration:g} s."
        ]
    if 0 < count < total:
        lead.append(_ends(picture, told.duration))
    lead.append(
        f"A command is at its bound in {100 * at_bound:.3g} % of the samples."
        if at_bound
        else "No command reaches its bound."
    )
    return lead


def _equilibria(section: Section, rests: Sequence[RestPoint]) -> str:
    if not rests:
        return "no equilibrium was found in the window"
    if any(rest.line for rest in rests):
        return "rest points lie side by side on a line: in its direction nothing pulls"
    alone = all(rest.isolated for rest in rests)
    beside = "" if alone else " (in one direction, not seen here, their neighbours rest too)"
    places = [place(section, rest) for rest in rests]
    if len(set(places)) < len(places):  # they differ in what the portrait does not show
        places = [_angles(section, rest) for rest in rests]
    words = [f"a {rest.kind} at {where}" for rest, where in zip(rests, places, strict=True)]
    joined = words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"
    return f"{joined}{beside}" if len(words) < 6 else f"{len(words)} equilibria in the window"


def _angles(section: Section, rest: RestPoint) -> str:
    """``α_v = 1.903 rad``: by the controlled states."""
    model = section.coordinates.model
    shown = [(name, model.state_index(name)) for name in model.controlled]
    return ", ".join(
        f"{symbol(name)} = {short(float(rest.x[i]))}{_unit(model.states[i].unit)}"
        for name, i in shown
    )


def _ends(picture: Picture, duration: float) -> str:
    ends, total = merged(picture.ends), len(picture.journeys)
    parts = []
    for end in ends:
        count = len(end.members)
        words = label(picture.section, end)
        if count > 1:
            words = words.replace("comes", "come").replace("leaves", "leave")
            words = words.replace("turns over and keeps", "turn over and keep")
            words = words.replace("stands", "stand")
        words = words.replace(
            "still moving", "are still moving" if count > 1 else "is still moving"
        )
        when = f" (after {np.median(end.times):.3g} s by the median)" if end.times else ""
        parts.append((count, f"{words}{when}"))
    if len(parts) == 1:
        if parts[0][0] == 1:
            return f"The trajectory {parts[0][1]}."
        return f"All {total} trajectories {parts[0][1]}."
    first, *others = (f"{count} {words}" for count, words in parts)
    return f"Of {total} trajectories of {duration:.3g} s {first}; {'; '.join(others)}."


def _tempo(rest: RestPoint) -> str:
    shown = rest.eigenvalues[rest.shown] if rest.shown.any() else rest.eigenvalues
    moving = [complex(v) for v in shown if v.real < -1e-9]
    if not moving:
        return f"Nothing that the portrait shows decays at the {rest.kind}."
    slow = min(moving, key=lambda v: abs(v.real))
    fast = max(moving, key=lambda v: abs(v.real))
    half = seconds(halving_time(slow))
    if slow.imag:
        words = (
            f"Around the {rest.kind} a swing takes {seconds(period(slow))} s and loses half of "
            f"itself every {half} s"
        )
    else:
        words = f"The slowest motion into the {rest.kind} halves every {half} s"
    if len(rest.x) == 2 and abs(fast.real) > _MUCH_FASTER * abs(slow.real):
        words += (
            f"; the fast one halves in {seconds(1e3 * halving_time(fast))} ms, so that "
            "trajectories first fall along it and then creep along the slow one"
        )
    return words + "."


def _growth(rest: RestPoint) -> str:
    growing = max((complex(v) for v in rest.eigenvalues), key=lambda v: v.real)
    return (
        f"At the {rest.kind} a swing of {seconds(period(growing))} s grows and doubles every "
        f"{seconds(halving_time(growing))} s, while all else decays."
    )


def _beyond_stops(section: Section, saddles: Sequence[RestPoint]) -> list[str]:
    model = section.coordinates.model
    for name, stop in model.stops.items():
        index = model.state_index(name)
        beyond = sum(abs(float(rest.x[index])) > stop for rest in saddles)
        if beyond:
            what = f"{beyond} of {len(saddles)} saddles" if len(saddles) > 1 else "The saddle"
            verb = "lie" if beyond > 1 else "lies"
            return [
                f"{what} {verb} beyond the mechanical stop of {symbol(name)} at ±{short(stop)} "
                "rad, which the equations do not have."
            ]
    return []


def seconds(value: float) -> str:
    return f"{value:.3g}" if math.isfinite(value) else "∞"
