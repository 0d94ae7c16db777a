"""A portrait's equilibria and ends as tables, and all of it as data."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from trms_cli.core.findings import Judged, Table
from trms_cli.models.model import names
from trms_cli.stability.portraits.account import Told, label, place, seconds, short
from trms_cli.stability.portraits.coordinates import symbol
from trms_cli.stability.portraits.ends import NEAR, End
from trms_cli.stability.portraits.rest_points import RestPoint, halving_time
from trms_cli.stability.portraits.section import Section

FloatArray = npt.NDArray[np.float64]


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
                _slowest(rest),
            ]
        )
    return Table(
        ["equilibrium", *heads, "eigenvalues [1/s]", "tempo"],
        rows,
        "Found in the window by Newton's method from many starts: a search. Tempo: of a stable one "
        "the time in which its slowest mode halves, of an unstable one that in which its fastest "
        "growing mode doubles.",
    )


def _slowest(rest: RestPoint) -> str | None:
    """``doubles in 0.35 s`` where something grows, else the time in which the slowest halves."""
    moving = rest.eigenvalues[np.abs(rest.eigenvalues) > rest.no_rate].real
    if not moving.size or abs(moving.max()) <= rest.no_rate:
        return None
    what = "doubles" if moving.max() > 0 else "halves"
    return f"{what} in {seconds(halving_time(moving.max()))} s"


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
                seconds(float(np.median(times))) if times else None,
                seconds(max(times)) if times else None,
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
                "on_a_line": rest.line,
                "in_section": rest.in_section,
                "switches": [model.state_names[i] for i in rest.switches],
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


def _eigenvalue(value: complex) -> str:
    real = short(value.real)
    return f"{real} ± {short(abs(value.imag))}j" if value.imag else real
