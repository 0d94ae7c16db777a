"""What a portrait says in words, tables and data."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from trms_cli.models.model import names
from trms_cli.stability.findings import Judged, Table
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


def commands(section: Section) -> str:
    """``u_v = 1.413 V``."""
    model = section.coordinates.model
    return ", ".join(
        f"{signal.name} = {short(float(value))} {signal.unit}"
        for signal, value in zip(model.inputs, section.point.u, strict=True)
    )


def place(section: Section, rest: RestPoint) -> str:
    """``α_v = 1.903 rad``: by the first coordinate that is no rate, the others where not zero."""
    shown = [
        f"{item.label} = {short(float(value))} {item.unit}"
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
        return f"comes to rest where dry friction holds {_held(section, end.held)}"
    return {
        "rest outside": "comes to rest outside the window",
        "stuck": "stands still elsewhere",
        "moving": "still moving at the end",
        "turning": "turns over and keeps turning",
        "gone": "leaves the window",
    }[end.what]


def _held(section: Section, held: StickingSet) -> str:
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
    """What the words are about.

    Attributes
    ----------
    picture : Picture
        With all ends apart.
    duration : float
        s of each trajectory.
    invariant : bool
    loop : str
        The controller; empty for the model alone.
    """

    picture: Picture
    duration: float
    invariant: bool
    loop: str = ""


def lead_of_model(told: Told) -> list[str]:
    """The answer of a portrait of the model alone."""
    picture = told.picture
    section = picture.section
    lead = [f"At {commands(section)}: {_equilibria(section, picture.rests)}."]
    lead.append(_ends(picture, told.duration))
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
        sets = " and ".join(_held(section, held) for held in lines)
        lead.append(
            f"Dry friction holds {sets}: trajectories end anywhere on such a line, not at a point."
        )
    lead += [
        f"Dry friction holds {_held(section, held)}: a trajectory that gets there goes on along "
        "that line, if at all."
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


def equilibria_table(section: Section, rests: Sequence[RestPoint]) -> Table:
    """Equilibria with their kinds and slowest modes."""
    model = section.coordinates.model
    heads = [f"{symbol(state.name)} [{state.unit}]" for state in model.states]
    rows: list[list[Any]] = []
    for rest in rests:
        rows.append(
            [
                Judged(rest.kind, "good" if rest.stable else "bad"),
                *(short(float(value)) for value in rest.x),
                ", ".join(_eigenvalue(value) for value in rest.eigenvalues if value.imag >= 0),
                _time(max((halving_time(v) for v in rest.eigenvalues if v.real < 0), default=0.0)),
            ]
        )
    return Table(
        ["equilibrium", *heads, "eigenvalues [1/s]", "slowest halves in [s]"],
        rows,
        "Found in the window by Newton's method from many starts: a search.",
    )


def ends_table(section: Section, ends: Sequence[End], total: int) -> Table:
    """Where trajectories end, how many, how soon."""
    rows: list[list[Any]] = []
    for end in ends:
        words = label(section, end)
        if end.what == "rest outside" and end.rest is not None:
            words += f", at {place(section, end.rest)}"
        times = end.times
        rows.append(
            [
                words,
                len(end.members),
                round(100 * len(end.members) / total, 1),
                _time(float(np.median(times))) if times else None,
                _time(max(times)) if times else None,
            ]
        )
    return Table(
        ["the trajectory", "starts", "share [%]", "median time [s]", "longest [s]"],
        rows,
        f"Times until a trajectory stays within {100 * NEAR:g} % of the window's width of its end.",
    )


def results(told: Told) -> dict[str, Any]:
    """The portrait as data."""
    picture = told.picture
    section, total = picture.section, len(picture.journeys)
    model, items = section.coordinates.model, section.coordinates.items
    return {
        "coordinates": [{"name": item.name, "unit": item.unit} for item in items],
        "window": {
            item.name: [float(low), float(high)]
            for item, (low, high) in zip(items, picture.window, strict=True)
        },
        "operating_point": {
            "x": _by_name(model.state_names, section.point.x),
            "u": _by_name(names(model.inputs), section.point.u),
        },
        "held": [model.state_names[i] for i in section.held],
        "settled": [model.state_names[i] for i in section.settled],
        "section_is_invariant": None if picture.loop else told.invariant,
        "equilibria": [
            {
                "x": _by_name(model.state_names, rest.x),
                "coordinates": _by_name(section.coordinates.names, rest.c),
                "kind": rest.kind,
                "isolated": rest.isolated,
                "in_section": rest.in_section,
                "eigenvalues": [[float(v.real), float(v.imag)] for v in rest.eigenvalues],
            }
            for rest in picture.rests
        ],
        "trajectories": {
            "count": total,
            "duration": told.duration,
            "near": NEAR,
            "starts": [
                _by_name(section.coordinates.names, journey.c[0]) for journey in picture.journeys
            ],
            "ends": [_end_data(section, end, total) for end in picture.ends],
        },
        "sticking": [
            {
                "what": sticking.what,
                "along": items[sticking.along].name,
                "from": sticking.reach[0],
                "to": sticking.reach[1],
            }
            for sticking in picture.sticking
        ],
        "separatrices": len(picture.separatrices),
    }


def _end_data(section: Section, end: End, total: int) -> dict[str, Any]:
    return {
        "what": end.what,
        "at": None
        if end.rest is None
        else _by_name(section.coordinates.model.state_names, end.rest.x),
        "held_in": None if end.held is None else list(end.held.reach),
        "starts": list(end.members),
        "share": len(end.members) / total,
        "median_time": float(np.median(end.times)) if end.times else None,
        "longest_time": float(max(end.times)) if end.times else None,
    }


def _by_name(keys: Sequence[str], values: FloatArray) -> dict[str, float | None]:
    return {
        name: float(value) if math.isfinite(value) else None
        for name, value in zip(keys, values, strict=True)
    }


def _equilibria(section: Section, rests: Sequence[RestPoint]) -> str:
    if not rests:
        return "no equilibrium was found in the window"
    if any(not rest.isolated for rest in rests):
        beside = " (none of them alone: in one direction the neighbours rest too)"
    else:
        beside = ""
    words = [f"a {rest.kind} at {place(section, rest)}" for rest in rests]
    joined = words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"
    return f"{joined}{beside}" if len(words) < 6 else f"{len(words)} equilibria in the window"


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
    moving = [v for v in rest.eigenvalues if v.real < -1e-9]
    slow = min(moving, key=lambda v: abs(v.real))
    fast = max(moving, key=lambda v: abs(v.real))
    half = _time(halving_time(slow))
    if slow.imag:
        words = (
            f"Around the {rest.kind} a swing takes {_time(period(slow))} s and loses half of "
            f"itself every {half} s"
        )
    else:
        words = f"The slowest motion into the {rest.kind} halves every {half} s"
    if len(rest.x) == 2 and abs(fast.real) > _MUCH_FASTER * abs(slow.real):
        words += (
            f"; the fast one halves in {_time(1e3 * halving_time(fast))} ms, so that trajectories "
            "first fall along it and then creep along the slow one"
        )
    return words + "."


def _beyond_stops(section: Section, saddles: Sequence[RestPoint]) -> list[str]:
    model = section.coordinates.model
    for name, stop in model.stops.items():
        index = model.state_index(name)
        beyond = sum(abs(float(rest.x[index])) > stop for rest in saddles)
        if beyond:
            what = "The saddle lies" if len(saddles) == 1 else f"{beyond} saddles lie"
            return [
                f"{what} beyond the mechanical stop of {symbol(name)} at ±{short(stop)} rad, which "
                "the equations do not have."
            ]
    return []


def _eigenvalue(value: complex) -> str:
    real = short(value.real)
    return f"{real} ± {short(abs(value.imag))}j" if value.imag else real


def _time(value: float) -> str:
    return f"{value:.3g}" if math.isfinite(value) else "∞"
