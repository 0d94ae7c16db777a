"""Why an eigenvalue moves: its derivative by what is varied, entry by entry of A.

An entry of A is, in words, an equation (row) by what it depends on (column). For a simple
eigenvalue with ``wᵀv = 1``

    dλ/dp = wᵀ (dA/dp) v = Σ_ij w_i (dA_ij/dp) v_j

(Kato, Perturbation Theory for Linear Operators, ch. 2), so each physical equation has its share.
dA/dp is exact: ``∂A/∂p`` and, through the operating point that moves along, ``∂A/∂x dx/dp +
∂A/∂u du/dp``, with dx/dp and du/dp by the implicit function theorem.

The loop that a share stands in is read off the signal flow graph of ``sI − A`` at ``s = λ``: the
edge j → i has the gain ``A_ij/(s − A_ii)``, and by Mason's rule an eigenvalue is where the
determinant of the graph, made of the gains of its cycles, vanishes (Mason 1956, Proc. IRE 44).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from trms_cli.core.arrays import BoolArray, FloatArray
from trms_cli.core.chart import Axis, Chart, Colour, Curve, Line, Mark, Panel
from trms_cli.core.findings import Column, Table, round_significant, table
from trms_cli.core.wording import listing
from trms_cli.models.model import Model
from trms_cli.stability.local.linear import parts_of, rate_of
from trms_cli.stability.local.sweep import EigenvalueSweep, LocusPoint, OperatingPath, amount_words


def entry_words(model: Model, i: int, j: int) -> str:
    """``pitch moment per yaw rate`` for the entry (Ṡ_v, S_h)."""
    return f"{_words_of(model, i)[1]} per {state_words(model, j)}"


def state_words(model: Model, j: int) -> str:
    """``yaw rate`` for S_h: what a state stands for."""
    return _words_of(model, j)[0]


def _words_of(model: Model, k: int) -> tuple[str, str]:
    """What a state stands for, and what its equation is of."""
    part, name = parts_of(model)[k], model.state_names[k]
    if part.role == "rate":
        return f"{part.name} rate", f"{part.name} moment"
    if part.role == "angle":
        return f"{part.name} angle", f"{part.name} rate"
    if part.name.endswith("rotor"):
        return f"speed of the {part.name}", f"torque on the {part.name}"
    return part.name if part.name.startswith("armature") else name, f"rate of {name}"


#: 1/s: nearer to a pole of its own, an edge has no gain to speak of.
_NO_GAIN = 1e-9
#: Loops longer than this are no explanation.
_LONGEST = 6


@dataclass(frozen=True)
class EntryShare:
    """Part of dλ/dp that one entry of A has."""

    row: int  #: The entry
    column: int  #: The entry
    change: float  #: dA_ij/dp
    part: complex  #: Its part of dλ/dp, 1/s per unit of what is varied


@dataclass(frozen=True)
class SignalLoop:
    """A cycle of the signal flow graph."""

    states: tuple[int, ...]  #: In the order of cause and effect; the last acts on the first
    gain: complex  #: At s = λ


@dataclass(frozen=True)
class Sensitivity:
    """dλ/dp of one eigenvalue at one place."""

    total: complex  #: dλ/dp, 1/s per unit
    direct: complex  #: What of it would remain if the operating point did not move
    shares: tuple[EntryShare, ...]  #: By the size of their real parts, largest first


def sensitivity(path: OperatingPath, place: LocusPoint, track: int) -> Sensitivity:
    """dλ/dp and its shares for one eigenvalue of a place."""
    direction = path.direction()
    displacement = path.balance.tangent(place.condition, place.point, direction)
    along = np.concatenate([displacement, direction.p])
    alone = np.concatenate([np.zeros(path.model.n_x), displacement[path.model.n_x :], direction.p])
    if path.kind == "parameter":
        alone[: len(displacement)] = 0.0
    where = (place.point.x, place.point.u)
    change = path.linear.change(*where, along, path.side, place.condition.p)
    still = path.linear.change(*where, alone, path.side, place.condition.p)
    left, right = place.spectrum.left[:, track], place.spectrum.right[:, track]
    scale: complex = 1.0
    if path.model.sample_time is not None:
        scale = 1.0 / (complex(place.spectrum.values[track]) * path.model.sample_time)
    parts = scale * left[:, None] * change * right[None, :]
    shares = [
        EntryShare(int(i), int(j), float(change[i, j]), complex(parts[i, j]))
        for i, j in np.argwhere(change != 0.0)
    ]
    shares.sort(key=lambda share: -abs(share.part.real))
    direct = complex(scale * (left @ still @ right))
    return Sensitivity(complex(parts.sum()), direct, tuple(shares))


def loops_through(a: FloatArray, row: int, column: int, s: complex) -> tuple[SignalLoop, ...]:
    """Cycles of the signal flow graph of A (n, n) through an entry, the strongest first.

    An entry on the diagonal is a loop by itself. Gains are taken at s; none are returned where one
    of them is infinite.
    """
    if np.any(np.abs(s - np.diag(a)) < _NO_GAIN):
        return ()  # a state that integrates alone: the graph has no finite gains there
    if row == column:
        return (SignalLoop((row,), complex(a[row, row] / s)),)
    loops = []
    for way in _ways(a, row, column, (column,)):
        states, gain = (column, *way), complex(1.0)
        for cause, effect in zip(states, (*way, column), strict=True):
            gain *= a[effect, cause] / (s - a[effect, effect])
        loops.append(SignalLoop(states, gain))
    return tuple(sorted(loops, key=lambda loop: -abs(loop.gain)))


def _ways(
    a: FloatArray, begin: int, end: int, visited_states: tuple[int, ...]
) -> Iterator[tuple[int, ...]]:
    """Ways from a state back to another, without a state twice."""
    if a[end, begin] != 0.0:
        yield (begin,)
    if len(visited_states) + 1 >= _LONGEST:
        return
    for following in np.flatnonzero(a[:, begin]):
        k = int(following)
        if k not in (*visited_states, begin, end):
            for rest in _ways(a, k, end, (*visited_states, begin)):
                yield (begin, *rest)


#: Shares below this part of the sum of sizes are not told.
_SMALL = 0.03
#: 1/s per unit: a growth rate that changes by less does not move.
_UNMOVED = 1e-6
#: Or by less than this share of the sizes that add up to it, which cancel but for rounding.
_CANCELLED = 1e-9
#: Derivatives that differ by more than this share of the largest from one place to the next jump.
_JUMP = 0.5
_COLOURS: tuple[Colour, ...] = ("blue", "vermilion", "green", "purple", "orange")


@dataclass(frozen=True)
class ModeSensitivity:
    """Why an eigenvalue moves as it does at one place."""

    mode: str
    value: float  #: Of what is varied
    sensitivity: Sensitivity
    loops: tuple[SignalLoop, ...]  #: Through the entry with the largest share, the strongest first
    #: What the growth rate does around the place, where the derivative is none
    course: GrowthTrend | None = None


@dataclass(frozen=True)
class GrowthTrend:
    """How the growth rate of a mode goes over the range, for a place where it does not move."""

    growth: float  #: Re λ at the place, 1/s
    least: float  #: Of Re λ over the range, 1/s
    most: float  #: Of Re λ over the range, 1/s
    below: float  #: d Re λ/dp at the place before and after, 1/s per unit
    above: float  #: NaN where there is none


def moves(derivative: Sensitivity) -> bool:
    """Whether a derivative of a growth rate is more than rounding."""
    size = sum(abs(share.part.real) for share in derivative.shares)
    return abs(derivative.total.real) >= max(_UNMOVED, _CANCELLED * size)


def growth_trend(path: OperatingPath, sweep: EigenvalueSweep, k: int, track: int) -> GrowthTrend:
    """How Re λ of a column of a sweep goes around place k."""
    T = path.model.sample_time
    growth = [rate_of(place.spectrum.values[track], T).real for place in sweep.places]
    below, above = (
        sensitivity(path, sweep.places[i], track).total.real
        if 0 <= i < len(sweep.places)
        else float("nan")
        for i in (k - 1, k + 1)
    )
    return GrowthTrend(growth[k], min(growth), max(growth), below, above)


def mode_sensitivity(
    path: OperatingPath, place: LocusPoint, track: int, mode: str
) -> ModeSensitivity:
    """The shares of dλ/dp at a place, and the loops through the largest."""
    derivative = sensitivity(path, place, track)
    loops: tuple[SignalLoop, ...] = ()
    shares = derivative.shares
    if shares and abs(shares[0].part.real) > 0 and path.model.sample_time is None:
        a = path.linear.a(place.point.x, place.point.u, path.side, place.condition.p)
        largest = shares[0]
        s = rate_of(place.spectrum.values[track], None)
        loops = loops_through(a, largest.row, largest.column, s)
    return ModeSensitivity(mode, place.value, derivative, loops)


def sensitivity_words(path: OperatingPath, why: ModeSensitivity) -> list[str]:
    """The reason in a few sentences."""
    model, total = path.model, why.sensitivity.total.real
    unit = f" per {path.unit}" if path.unit else " per unit"
    shares = _large(why.sensitivity.shares)
    at = amount_words(model, path.over, why.value, 4)
    if not shares or not moves(why.sensitivity):
        return _still(path, why, at, unit)
    answer = (
        f"At {at} a larger {path.over} {'raises' if total > 0 else 'lowers'} the growth rate of "
        f"the {why.mode} by {abs(total):.3g} 1/s{unit}"
    )
    if model.sample_time is not None:
        return [
            f"{answer}. What of it comes through which entry of A says nothing here: the entries "
            "are slopes of a network, and no equations of a rig."
        ]
    named = [
        f"the {entry_words(model, s.row, s.column)} ({_percent(s.part.real / total)})"
        for s in shares[:3]
    ]
    sentences = [f"{answer}: {listing(named)} of it."]
    apart = abs(why.sensitivity.direct - why.sensitivity.total)
    if path.kind != "angle" and apart > 1e-3 * abs(why.sensitivity.total):
        own = f"{why.sensitivity.direct.real / total:.0%}".replace("-", "−")
        sentences.append(f"Without the operating point that moves along it would be {own} of that.")
    if why.loops and len(why.loops[0].states) > 1:
        sentences.append(f"It closes the loop {_loop_words(model, why.loops[0], shares[0].row)}.")
    return sentences


def _percent(share: float) -> str:
    return f"{share:+.0%}".replace("-", "−")


def _still(path: OperatingPath, why: ModeSensitivity, at: str, unit: str) -> list[str]:
    """A place where the derivative is none: what the growth rate does around it."""
    course = why.course
    if course is None:
        return [f"At {at} {path.over} does not move the growth rate of the {why.mode}."]
    sentences = (
        f"The {why.mode} comes closest to the axis at {at}, with a growth rate of "
        f"{course.growth:.3g} 1/s; over the range it lies between {course.least:.3g} and "
        f"{course.most:.3g} 1/s."
    )
    if np.isfinite(course.below) and np.isfinite(course.above):
        sentences += (
            f" To first order {path.over} does not move it at that point: the derivative is "
            f"{course.below:+.3g} 1/s{unit} just below and {course.above:+.3g} just above."
        )
    return [sentences.replace("-", "−")]


def _loop_words(model: Model, loop: SignalLoop, begin: int) -> str:
    """``yaw rate → pitch rate → yaw rate, by the …``: each edge by the equation it stands in."""
    k = loop.states.index(begin)
    way = (*loop.states[k:], *loop.states[:k], begin)
    edges = [entry_words(model, effect, cause) for cause, effect in pairwise(way)]
    # An angle follows its own rate: no equation that one would have to look up.
    kinematic = {f"{axis} rate per {axis} rate" for axis in model.axes}
    by = ", ".join(f"the {words}" for words in edges if words not in kinematic)
    return f"{' → '.join(state_words(model, k) for k in way)}, by {by}"


def share_table(path: OperatingPath, why: ModeSensitivity) -> Table:
    """The entries of A that move the eigenvalue."""
    total = why.sensitivity.total
    unit = path.unit or "1"

    def symbol(one: EntryShare) -> str:
        """``∂(dS_v/dt)/∂S_h``, or ``∂alpha_v⁺/∂u_v`` of a model that steps."""
        row, column = (path.model.state_names[k] for k in (one.row, one.column))
        after = f"d{row}/dt" if path.model.sample_time is None else f"{row}⁺"
        return f"∂({after})/∂{column}"

    def share(one: EntryShare) -> str | None:
        return _percent(one.part.real / total.real) if abs(total.real) > 1e-12 else None

    return table(
        _large(why.sensitivity.shares)[:8],
        [
            Column("entry", lambda s: entry_words(path.model, s.row, s.column)),
            Column("symbol", symbol),
            Column(f"change per {unit}", lambda s: round_significant(s.change)),
            Column(f"of d Re λ [1/s per {unit}]", lambda s: round_significant(s.part.real)),
            Column(f"of d Im λ [rad/s per {unit}]", lambda s: round_significant(s.part.imag)),
            Column("share", share),
        ],
        f"What moves the {why.mode} at {amount_words(path.model, path.over, why.value, 4)}: "
        f"dλ/d{path.over} = {total.real:.4g} {'+' if total.imag >= 0 else '−'} "
        f"{abs(total.imag):.4g}j.",
        heads=2,
    )


def share_chart(
    name: str, path: OperatingPath, sweep: EigenvalueSweep, track: int, mode: str
) -> Chart | None:
    """d Re λ/dp of one mode over the range, and of its largest entries; None: nothing moves it."""
    derivatives = [sensitivity(path, place, track) for place in sweep.places]
    if not any(moves(one) for one in derivatives):
        return None
    sizes: dict[tuple[int, int], float] = {}
    for one in derivatives:
        for share in one.shares:
            key = (share.row, share.column)
            sizes[key] = max(sizes.get(key, 0.0), abs(share.part.real))
    largest = sorted(sizes, key=lambda key: -sizes[key])[: len(_COLOURS)]
    floor = _SMALL * max(sizes.values(), default=0.0)
    marks: list[Mark] = [Line(y=0.0, colour="ink", style="solid")]
    totals = np.array([one.total.real for one in derivatives])
    # A derivative has no meaning where the mode meets another: it grows beyond bounds there.
    bound = 20.0 * float(np.median(np.abs(totals))) or 1.0
    hidden = (np.abs(totals) > bound) | _broken(totals)
    for key, colour in zip(largest, _COLOURS, strict=False):
        if sizes[key] <= floor:
            continue
        parts = [
            sum(s.part.real for s in one.shares if (s.row, s.column) == key) for one in derivatives
        ]
        series = np.where(hidden, np.nan, parts)
        marks.append(Curve(sweep.values, series, entry_words(path.model, *key), colour))
    series = np.where(hidden, np.nan, totals)
    marks.append(Curve(sweep.values, series, "together", "ink", "dashed", 2.0))
    unit = f"1/s per {path.unit}" if path.unit else "1/s per unit"
    panel = Panel(Axis(path.over, path.unit), Axis(f"d Re λ / d {path.over}", unit), marks)
    caption = (
        f"What moves the {mode}: the derivative of its growth rate, by the entry of A (the "
        "physical equation) that it comes through."
    )
    return Chart(name, [panel], caption, 1, 7.0, 4.2)


def _broken(totals: FloatArray) -> BoolArray:
    """Places on a jump of a derivative, between two of opposite sign: a kink of the growth rate."""
    broken = np.zeros(len(totals), dtype=bool)
    if len(totals) > 2:
        before, here, after = totals[:-2], totals[1:-1], totals[2:]
        size = np.maximum(np.abs(before), np.abs(after))
        steps = np.minimum(np.abs(here - before), np.abs(after - here))
        # Both steps are of the size of the derivative itself: no curve goes so from place to place.
        broken[1:-1] = (before * after < 0) & (steps > _JUMP * size)
    return broken


def sensitivity_data(path: OperatingPath, why: ModeSensitivity) -> dict[str, Any]:
    """A reason as JSON data."""
    names = path.model.state_names
    return {
        "mode": why.mode,
        "value": why.value,
        "dlambda": why.sensitivity.total,
        "dlambda_direct": why.sensitivity.direct,
        "shares": [
            {
                "entry": [names[s.row], names[s.column]],
                "words": entry_words(path.model, s.row, s.column),
                "change": s.change,
                "real": s.part.real,
                "imag": s.part.imag,
            }
            for s in why.sensitivity.shares[:12]
        ],
        "loops": [
            {"states": [names[k] for k in loop.states], "gain": loop.gain} for loop in why.loops[:4]
        ],
    }


def _large(shares: Sequence[EntryShare]) -> list[EntryShare]:
    size = sum(abs(s.part.real) for s in shares)
    return [s for s in shares if abs(s.part.real) > _SMALL * size]
