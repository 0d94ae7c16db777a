"""Why a mode crosses, in sentences and a table: shares of dλ/dp, and the loop they close."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from trms_cli.core.chart import Axis, Chart, Colour, Curve, Line, Mark, Panel
from trms_cli.core.findings import Table
from trms_cli.models.model import Model
from trms_cli.stability.local.entries import entry_symbol, entry_words, state_words
from trms_cli.stability.local.modes import rate_of
from trms_cli.stability.local.sensitivity import Loop, Sensitivity, loops_through, sensitivity
from trms_cli.stability.local.sweep import Path, Place, Sweep
from trms_cli.stability.local.told import amount_words

FloatArray = npt.NDArray[np.float64]

#: Shares below this part of the sum of sizes are not told.
_SMALL = 0.03
#: 1/s per unit: a growth rate that changes by less does not move.
_STILL = 1e-6
#: Or by less than this share of the sizes that add up to it, which cancel but for rounding.
_CANCELLED = 1e-9
#: Derivatives that differ by more than this share of the largest from one place to the next jump.
_JUMP = 0.5
_COLOURS: tuple[Colour, ...] = ("blue", "vermilion", "green", "purple", "orange")


@dataclass(frozen=True)
class Reason:
    """Why an eigenvalue moves as it does at one place."""

    mode: str
    value: float  #: Of what is varied
    sensitivity: Sensitivity
    loops: tuple[Loop, ...]  #: Through the entry with the largest share, the strongest first
    #: What the growth rate does around the place, where the derivative is none
    course: Course | None = None


@dataclass(frozen=True)
class Course:
    """How the growth rate of a mode goes over the range, for a place where it does not move."""

    growth: float  #: Re λ at the place, 1/s
    least: float  #: Of Re λ over the range, 1/s
    most: float  #: Of Re λ over the range, 1/s
    below: float  #: d Re λ/dp at the place before and after, 1/s per unit
    above: float  #: NaN where there is none


def moves(found: Sensitivity) -> bool:
    """Whether a derivative of a growth rate is more than rounding."""
    size = sum(abs(share.part.real) for share in found.shares)
    return abs(found.total.real) >= max(_STILL, _CANCELLED * size)


def course_of(path: Path, sweep: Sweep, k: int, track: int) -> Course:
    """How Re λ of a column of a sweep goes around place k."""
    T = path.model.sample_time
    growth = [rate_of(place.spectrum.values[track], T).real for place in sweep.places]
    below, above = (
        sensitivity(path, sweep.places[i], track).total.real
        if 0 <= i < len(sweep.places)
        else float("nan")
        for i in (k - 1, k + 1)
    )
    return Course(growth[k], min(growth), max(growth), below, above)


def reason(path: Path, place: Place, track: int, mode: str) -> Reason:
    """The shares of dλ/dp at a place, and the loops through the largest."""
    found = sensitivity(path, place, track)
    loops: tuple[Loop, ...] = ()
    if found.shares and abs(found.shares[0].part.real) > 0 and path.model.sample_time is None:
        a = path.linear.a(place.point.x, place.point.u, path.side, place.held.p)
        largest = found.shares[0]
        s = rate_of(place.spectrum.values[track], None)
        loops = loops_through(a, largest.row, largest.column, s)
    return Reason(mode, place.value, found, loops)


def reason_words(path: Path, why: Reason) -> list[str]:
    """The reason in a few sentences."""
    model, total = path.model, why.sensitivity.total.real
    unit = f" per {path.unit}" if path.unit else " per unit"
    shares = _told(why.sensitivity)
    at = amount_words(model, path.over, why.value, 4)
    if not shares or not moves(why.sensitivity):
        return _still(path, why, at, unit)
    sign = "raises" if total > 0 else "lowers"
    if model.sample_time is not None:
        return [
            f"At {at} a larger {path.over} {sign} the growth rate of the "
            f"{why.mode} by {abs(total):.3g} 1/s{unit}. What of it comes through which entry of A "
            "says nothing here: the entries are slopes of a network, and no equations of a rig."
        ]
    named = [
        f"the {entry_words(model, s.row, s.column)} ({s.part.real / total:+.0%})".replace("-", "−")
        for s in shares[:3]
    ]
    told = [
        f"At {at} a larger {path.over} {sign} the growth rate of the "
        f"{why.mode} by {abs(total):.3g} 1/s{unit}: {_listed(named)} of it."
    ]
    apart = abs(why.sensitivity.direct - why.sensitivity.total)
    if path.kind != "angle" and apart > 1e-3 * abs(why.sensitivity.total):
        own = why.sensitivity.direct.real / total
        told.append(
            f"Without the operating point that moves along it would be {own:.0%} of that.".replace(
                "-", "−"
            )
        )
    if why.loops and len(why.loops[0].states) > 1:
        largest = shares[0]
        told.append(
            f"It closes the loop {loop_words(model, why.loops[0], largest.row)}, by "
            f"{_steps(model, why.loops[0], largest.row)}."
        )
    return told


def _still(path: Path, why: Reason, at: str, unit: str) -> list[str]:
    """A place where the derivative is none: what the growth rate does around it."""
    course = why.course
    if course is None:
        return [f"At {at} {path.over} does not move the growth rate of the {why.mode}."]
    told = (
        f"The {why.mode} comes closest to the axis at {at}, with a growth rate of "
        f"{course.growth:.3g} 1/s; over the range it lies between {course.least:.3g} and "
        f"{course.most:.3g} 1/s."
    )
    if np.isfinite(course.below) and np.isfinite(course.above):
        told += (
            f" To first order {path.over} does not move it at that point: the derivative is "
            f"{course.below:+.3g} 1/s{unit} just below and {course.above:+.3g} just above."
        )
    return [told.replace("-", "−")]


def loop_words(model: Model, loop: Loop, begin: int) -> str:
    """``yaw rate → pitch rate → pitch angle → yaw rate``."""
    way = [state_words(model, k) for k in _from(loop, begin)]
    return " → ".join([*way, way[0]])


def share_table(path: Path, why: Reason) -> Table:
    """The entries of A that move the eigenvalue."""
    total = why.sensitivity.total.real
    unit = path.unit or "1"
    rows = [
        (
            entry_words(path.model, s.row, s.column),
            entry_symbol(path.model, s.row, s.column),
            float(f"{s.change:.4g}"),
            float(f"{s.part.real:.4g}"),
            float(f"{s.part.imag:.4g}"),
            f"{s.part.real / total:+.0%}".replace("-", "−") if abs(total) > 1e-12 else None,
        )
        for s in _told(why.sensitivity)[:8]
    ]
    return Table(
        (
            "entry",
            "symbol",
            f"change per {unit}",
            f"of d Re λ [1/s per {unit}]",
            f"of d Im λ [rad/s per {unit}]",
            "share",
        ),
        rows,
        f"What moves the {why.mode} at {amount_words(path.model, path.over, why.value, 4)}: "
        f"dλ/d{path.over} = {why.sensitivity.total.real:.4g} "
        f"{'+' if why.sensitivity.total.imag >= 0 else '−'} "
        f"{abs(why.sensitivity.total.imag):.4g}j.",
        heads=2,
    )


def share_chart(name: str, path: Path, sweep: Sweep, track: int, mode: str) -> Chart | None:
    """d Re λ/dp of one mode over the range, and the parts of the largest entries.

    None where nothing moves it.
    """
    found = [sensitivity(path, place, track) for place in sweep.places]
    if not any(moves(one) for one in found):
        return None
    sizes: dict[tuple[int, int], float] = {}
    for one in found:
        for share in one.shares:
            key = (share.row, share.column)
            sizes[key] = max(sizes.get(key, 0.0), abs(share.part.real))
    largest = sorted(sizes, key=lambda key: -sizes[key])[: len(_COLOURS)]
    floor = _SMALL * max(sizes.values(), default=0.0)
    marks: list[Mark] = [Line(y=0.0, colour="ink", style="solid")]
    totals = np.array([one.total.real for one in found])
    # A derivative has no meaning where the mode meets another: it grows beyond bounds there.
    bound = 20.0 * float(np.median(np.abs(totals))) or 1.0
    broken = _broken(totals)
    for key, colour in zip(largest, _COLOURS, strict=False):
        if sizes[key] <= floor:
            continue
        part = np.array(
            [sum(s.part.real for s in one.shares if (s.row, s.column) == key) for one in found]
        )
        part = np.where((np.abs(totals) > bound) | broken, np.nan, part)
        marks.append(Curve(sweep.values, part, entry_words(path.model, *key), colour))
    shown = np.where((np.abs(totals) > bound) | broken, np.nan, totals)
    marks.append(Curve(sweep.values, shown, "together", "ink", "dashed", 2.0))
    unit = f"1/s per {path.unit}" if path.unit else "1/s per unit"
    panel = Panel(Axis(path.over, path.unit), Axis(f"d Re λ / d {path.over}", unit), marks)
    return Chart(
        name,
        [panel],
        f"What moves the {mode}: the derivative of its growth rate, by the entry of A (the "
        "physical equation) that it comes through.",
        1,
        7.0,
        4.2,
    )


def _broken(totals: FloatArray) -> npt.NDArray[np.bool_]:
    """Places on a jump of a derivative, between two of opposite sign: a kink of the growth rate."""
    broken = np.zeros(len(totals), dtype=bool)
    if len(totals) > 2:
        before, here, after = totals[:-2], totals[1:-1], totals[2:]
        size = np.maximum(np.abs(before), np.abs(after))
        steps = np.minimum(np.abs(here - before), np.abs(after - here))
        # Both steps are of the size of the derivative itself: no curve goes so from place to place.
        broken[1:-1] = (before * after < 0) & (steps > _JUMP * size)
    return broken


def reason_data(path: Path, why: Reason) -> dict[str, Any]:
    """A reason as JSON data."""
    names = path.model.state_names
    return {
        "mode": why.mode,
        "value": float(why.value),
        "dlambda": [why.sensitivity.total.real, why.sensitivity.total.imag],
        "dlambda_direct": [why.sensitivity.direct.real, why.sensitivity.direct.imag],
        "shares": [
            {
                "entry": [names[s.row], names[s.column]],
                "words": entry_words(path.model, s.row, s.column),
                "change": float(s.change),
                "real": float(s.part.real),
                "imag": float(s.part.imag),
            }
            for s in why.sensitivity.shares[:12]
        ],
        "loops": [
            {"states": [names[k] for k in loop.states], "gain": [loop.gain.real, loop.gain.imag]}
            for loop in why.loops[:4]
        ],
    }


def _told(found: Sensitivity) -> Sequence[Any]:
    size = sum(abs(s.part.real) for s in found.shares)
    return [s for s in found.shares if abs(s.part.real) > _SMALL * size]


def _steps(model: Model, loop: Loop, begin: int) -> str:
    """Each edge by the equation that it stands in."""
    way = _from(loop, begin)
    edges = zip(way, (*way[1:], way[0]), strict=True)
    told = [entry_words(model, effect, cause) for cause, effect in edges]
    # An angle follows its own rate: no equation that one would have to look up.
    kinematic = {f"{axis} rate per {axis} rate" for axis in model.axes}
    return ", ".join(f"the {words}" for words in told if words not in kinematic)


def _from(loop: Loop, begin: int) -> tuple[int, ...]:
    k = loop.states.index(begin)
    return (*loop.states[k:], *loop.states[:k])


def _listed(words: Sequence[str]) -> str:
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"
