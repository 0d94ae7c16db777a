"""Eigenvalues followed along a line of operating points, as modes, and where they cross the axis.

The sweep, over an angle, a command or a parameter, begins where the request stands and goes both
ways until the range ends, the equilibrium ends (a fold), or a command or angle reaches its limit.

Two spectra are matched by what their eigenvectors have in common and by how far the eigenvalues
move. For left and right eigenvectors with ``wᵀv = 1`` the product ``(w_iᵀ v'_j)(w'_jᵀ v_i)`` is 1
for the same mode and near 0 for another, whatever the units of the states. The assignment is the
best of all one-to-one ones (Jonker & Volgenant 1987, as in SciPy). Between two points whose
eigenvalues cannot be matched with certainty more points are put.

The tracks are modes: conjugate partners together, named by who takes part. Where one crosses the
imaginary axis is located to rounding, by Brent's method on Re λ with the operating point solved
anew for each value. A pair that crosses off zero frequency is a Hopf point of the rig's equations
if nothing else happens there; what crosses at zero is the end or the exchange of an equilibrium.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.optimize import brentq, linear_sum_assignment

from trms_cli.core import wording
from trms_cli.core.arrays import ComplexArray, FloatArray
from trms_cli.core.errors import ConfigurationError, TrmsError
from trms_cli.core.plugins import require_known
from trms_cli.models.model import Model, by_name, names
from trms_cli.models.operating_point import (
    OperatingPoint,
    TrimCondition,
    TrimSolver,
    prescribes_angles,
)
from trms_cli.stability.local import linear

#: Weight of a move of an eigenvalue by its own size against eigenvectors with nothing in common.
_MOVE = 1.0


def match_spectra(
    before: linear.EigenSpectrum, after: linear.EigenSpectrum
) -> tuple[linear.EigenSpectrum, float]:
    """``after`` in the order of ``before``, and how sure the worst match is (1: certain).

    Sureness is how much better the match is than the best one that exchanges a mode, where the
    exchange would matter; two modes whose eigenvalues agree may be exchanged.
    """
    same = np.abs(before.left.T @ after.right) * np.abs(after.left.T @ before.right).T
    same = np.minimum(same, 1.0)
    size = 1e-3 + np.abs(before.values)[:, None] + np.abs(after.values)[None, :]
    apart = np.abs(before.values[:, None] - after.values[None, :]) / size
    # A conjugate is never the continuation of its partner while both swing.
    cost = (1.0 - same) + _MOVE * apart
    rows, columns = linear_sum_assignment(cost)
    order = columns[np.argsort(rows)]
    match_costs = cost[np.arange(len(order)), order]
    return after.reorder(order), float(1.0 - match_costs.max(initial=0.0))


def line_of(model: Model, at: Mapping[str, float], over: str | None, usual: str) -> str:
    """What is varied: what is asked for; the first command held, if commands are; the usual.

    Raises ConfigurationError for an angle where commands are held, and the reverse; for names in
    ``at``, angles (rad) or commands (V), that are neither, or of both kinds.
    """
    if not at:
        return over or usual
    by_angle = prescribes_angles(model, at)
    if over is None:
        return usual if by_angle else next(iter(at))
    kinds = {True: ("an angle", model.controlled), False: ("a command", names(model.inputs))}
    if over in kinds[not by_angle][1]:
        use = next(iter(at))
        raise ConfigurationError(
            f"over={over} varies {kinds[not by_angle][0]}; at holds "
            f"{'angles' if by_angle else 'commands'} ({', '.join(at)})",
            where="study.over",
            remedy=f"use study.over={use}, or give {'commands' if by_angle else 'angles'} in at",
        )
    return over


def in_order(bounds: tuple[float, float], where: str) -> tuple[float, float]:
    """A range as given; ConfigurationError for one that is empty or reversed."""
    low, high = bounds
    if low == high:
        raise ConfigurationError(
            f"{list(bounds)} given", where=where, remedy="give two different numbers"
        )
    if not low < high:
        raise ConfigurationError(
            f"{list(bounds)} given: the upper end comes first",
            where=where,
            remedy=f"give the lower end first: '{where}=[{high:g},{low:g}]'",
        )
    return low, high


Kind = Literal["angle", "command", "parameter"]

#: Matches below this are looked at again at half the step, so often.
_SURE, _DEEPEST = 0.6, 6
#: An eigenvalue that is not faster than the first times the median may move by the second of it.
_SLOW, _CORNER = 10.0, 0.04
#: The end of a branch is located to this share of the range.
_END = 1e-5
#: Share of a step down to which it is halved.
_SHORTEST = 2.0**-10
#: rad, 1: range of an angle without stops, and of a command without limits.
_WIDE = 1.0


@dataclass(frozen=True)
class LocusPoint:
    """An operating point of a sweep."""

    value: float  #: Of what is varied
    condition: TrimCondition  #: What is held there
    point: OperatingPoint
    spectrum: linear.EigenSpectrum  #: In the order of the sweep's tracks


@dataclass(frozen=True)
class EigenvalueSweep:
    """What was found along a line."""

    places: tuple[LocusPoint, ...]  #: By rising value; eigenvalue i of each belongs to track i
    low: str = ""  #: Why it ended before the range did, on either side
    high: str = ""  #: empty if it did not

    @property
    def values(self) -> FloatArray:
        return np.array([place.value for place in self.places])

    @property
    def states(self) -> FloatArray:
        """(n, n_x), of the operating points."""
        return np.array([place.point.x for place in self.places])

    @property
    def eigenvalues(self) -> ComplexArray:
        """(n, n_x), of the matrices; column i is one track."""
        return np.array([place.spectrum.values for place in self.places])

    @property
    def early_ends(self) -> list[str]:
        """A sentence a side on which it ended early."""
        return [f"The range ends early: {why}." for why in (self.low, self.high) if why]


class OperatingPath:
    """A family of operating points by one number.

    ``at`` holds angles or commands (that of ``over`` does not count), ``over`` is a controlled
    state, an input or a parameter, ``side`` says whose slopes are taken on a switch. Raises
    ConfigurationError for a name that is none of these, or that does not go with ``at``.
    """

    def __init__(
        self, model: Model, at: Mapping[str, float], over: str, side: linear.Side = "mean"
    ) -> None:
        self.model, self.over, self.side = model, over, side
        self.balance, self.linear = TrimSolver(model), linear.Linear(model)
        self.kind = _kind(model, over)
        self.at = dict(at)
        self._requested_names = tuple(at)
        self._free = self.kind != "parameter" and over not in self.at
        if self._free:
            # Where nothing is said of it the sweep begins at zero, or at rest if it must.
            self.at[over] = 0.0
        self._base = self.balance.condition(self.at)
        self.began = (
            self.model.parameters[over].value if self.kind == "parameter" else self.at[over]
        )

    def with_value(self, name: str, value: float) -> OperatingPath:
        """The same with another number held; ConfigurationError: an angle for commands, or so."""
        kind = _kind(self.model, name)
        other = copy.copy(self)
        if kind == "parameter" or (kind == "angle") == self._base.by_angle:
            other._base = self._with(name, value)
            other.at = self.at if kind == "parameter" else self.at | {name: value}
            return other
        if np.any(self._base.values):
            raise ConfigurationError(
                f"{name} is {'an angle' if kind == 'angle' else 'a command'}, and "
                f"{', '.join(self.at)} held",
                where="study.against",
                remedy="hold angles and vary an angle, or hold commands and vary a command",
            )
        other._base = replace(self.balance.condition({name: value}), p=self._base.p)
        other.at = {name: value}
        return other

    def _with(self, name: str, value: float) -> TrimCondition:
        """What is held, with one value changed."""
        kind = _kind(self.model, name)
        if kind == "parameter":
            p = self._base.p.copy()
            p[self.model.parameters.names.index(name)] = value
            return replace(self._base, p=p)
        order = self.model.controlled if kind == "angle" else names(self.model.inputs)
        values = self._base.values.copy()
        values[order.index(name)] = value
        return replace(self._base, values=values)

    @property
    def unit(self) -> str:
        """As it is printed; empty for a number without one."""
        return wording.unit(unit_of(self.model, self.over))

    @property
    def head(self) -> str:
        """Of a column: ``u_v [V]``."""
        return wording.with_unit(self.over, self.unit)

    def condition(self, value: float) -> TrimCondition:
        """What is held at a value."""
        return self._with(self.over, value)

    def direction(self) -> TrimCondition:
        """Rates of change of what is held, per unit of what is varied."""
        one, zero = self.condition(1.0), self.condition(0.0)
        return TrimCondition(one.by_angle, one.values - zero.values, one.p - zero.p)

    def first(self, low: float, high: float) -> LocusPoint:
        """Where a sweep begins: where the request stands, or the end next to it; or TrmsError."""
        begin = self._begin()
        value = min(max(self.began, low), high)
        point = self.balance.advance(self.condition(self.began), self.condition(value), begin)
        if point is not None and not self._within(point):
            raise ConfigurationError(
                f"the rig cannot rest at {self.over} = {value:g} within its inputs and stops",
                where="study.range",
                remedy="choose a range nearer to where it rests, or leave the range out",
            )
        if point is None:
            raise ConfigurationError(
                f"the operating point ends between {self.over} = {self.began:g} and {value:g}",
                where="study.range",
                remedy="choose a range nearer to where the rig rests",
            )
        return self.place(value, point)

    def place(self, value: float, point: OperatingPoint) -> LocusPoint:
        """A place at a known operating point."""
        condition = self.condition(value)
        a = self.linear.a(point.x, point.u, self.side, condition.p)
        return LocusPoint(value, condition, point, linear.spectrum_of(a))

    def following(
        self, last: LocusPoint, value: float, shortest: float = 1e-3
    ) -> LocusPoint | None:
        """The place at another value on the same branch, its eigenvalues matched."""
        matched = self.matched(last, value, shortest)
        return None if matched is None else matched[0]

    def matched(
        self, last: LocusPoint, value: float, shortest: float
    ) -> tuple[LocusPoint, float] | None:
        """The same, and how sure the match is; ``shortest`` as of :meth:`TrimSolver.advance`."""
        condition = self.condition(value)
        point = self.balance.advance(last.condition, condition, last.point, shortest)
        if point is None or not self._within(point):
            return None
        place = self.place(value, point)
        spectrum, sure = match_spectra(last.spectrum, place.spectrum)
        return replace(place, spectrum=spectrum), sure

    def range(
        self, bounds: tuple[float, float] | None, where: str = "study.range"
    ) -> tuple[float, float]:
        """The range asked for, or the usual one.

        Raises ConfigurationError for one that is empty, reversed or outside the parameter's bounds.
        """
        if bounds is None:
            return self._usual()
        low, high = in_order(bounds, where)
        if self.kind == "parameter":
            p = self.model.parameters[self.over]
            if not p.lower <= low <= high <= p.upper:
                raise ConfigurationError(
                    f"{list(bounds)} given, and {self.over} lies between {p.lower:g} and "
                    f"{p.upper:g} {p.unit}",
                    where=where,
                    remedy="give a range within",
                )
        return low, high

    def _usual(self) -> tuple[float, float]:
        if self.kind == "parameter":
            p = self.model.parameters[self.over]
            if p.typical is not None:
                return p.typical
            if p.value == 0.0:
                raise ConfigurationError(
                    f"{self.over} is 0, which suggests no range",
                    where="study.range",
                    remedy=f"give one in {p.unit or '1'}, as 'study.range=[0,1]'",
                )
            ends = sorted((p.value / 4, p.value * 4))
            return max(ends[0], p.lower), min(ends[1], p.upper)
        limits = self.model.stops if self.kind == "angle" else self.model.input_limits
        limit = limits.get(self.over, np.inf)
        limit = limit if np.isfinite(limit) else _WIDE
        return -limit, limit

    def _begin(self) -> OperatingPoint:
        try:
            return self.balance.first(self.at)
        except TrmsError:
            if not self._free or self.kind != "angle":
                raise
            at_rest = by_name(self.model.states, self.model.rest())
            free = [name for name in self.model.controlled if name not in self._requested_names]
            rest = {name: at_rest[name] for name in free}
            begin = self.balance.first(self.at | rest)
            self.at |= rest
            self.began = self.at[self.over]
            self._base = self.balance.condition(self.at)
            return begin

    def _within(self, point: OperatingPoint) -> bool:
        return self.kind != "angle" or self.balance.within_limits(point)


def sweep_eigenvalues(
    path: OperatingPath, low: float, high: float, points: int, also: tuple[float, ...] = ()
) -> EigenvalueSweep:
    """Go through a range, and further values within; TrmsError where there is nowhere to begin."""
    begin = path.first(low, high)
    grid = np.linspace(low, high, points)
    grid = np.unique(np.concatenate([grid, [value for value in also if low < value < high]]))
    up, why_high = _one_way(path, begin, grid[grid > begin.value + 1e-12 * (high - low)])
    down, why_low = _one_way(path, begin, grid[grid < begin.value - 1e-12 * (high - low)][::-1])
    return EigenvalueSweep((*down[::-1], begin, *up), why_low, why_high)


def _one_way(
    path: OperatingPath, begin: LocusPoint, values: FloatArray
) -> tuple[list[LocusPoint], str]:
    places = [begin]
    for value in values:
        between = _filled(path, places[-1], float(value), 0)
        if between is None:
            end, why = _end(path, places[-1], float(value))
            return [*places[1:], *([end] if end is not None else [])], why
        places += between
    return places[1:], ""


def _filled(
    path: OperatingPath, last: LocusPoint, value: float, depth: int
) -> list[LocusPoint] | None:
    """Places up to a value, with further ones between where the matching is unsure."""
    matched = path.matched(last, value, _SHORTEST)
    if matched is None:
        return None
    place, sure = matched
    # Whether a curve through the eigenvalues would show corners.
    pace = np.abs(last.spectrum.values)
    typical = float(np.median(pace))
    leaps = np.abs(place.spectrum.values - last.spectrum.values)[pace <= _SLOW * typical]
    corners = bool(leaps.max(initial=0.0) > _CORNER * typical)
    if (sure < _SURE or corners) and depth < _DEEPEST:
        first = _filled(path, last, 0.5 * (last.value + value), depth + 1)
        second = None if first is None else _filled(path, first[-1], value, depth + 1)
        if first is not None and second is not None:
            return [*first, *second]
    return [place]


def _end(path: OperatingPath, last: LocusPoint, value: float) -> tuple[LocusPoint | None, str]:
    """The last place before a value that is not reached, and why."""
    good, bad, span = last, value, abs(value - last.value)
    while abs(bad - good.value) > _END * span:
        middle = 0.5 * (good.value + bad)
        place = path.following(good, middle, 0.5)
        if place is None:
            bad = middle
        else:
            good = place
    beyond = path.balance.advance(good.condition, path.condition(bad), good.point, 0.5)
    at = f"{path.over} = {good.value:.4g} {path.unit}".rstrip()
    why = f"the equilibrium ends at {at}"
    if beyond is not None:
        upper = path.model.input_bounds()[1]
        hit = [
            f"{signal.name} is at its limit, {limit:g} {signal.unit}"
            for signal, u, limit in zip(path.model.inputs, beyond.u, upper, strict=True)
            if abs(u) > limit
        ]
        why = f"at {at} {' and '.join(hit) or 'a stop is reached'}"
    return (good if good is not last else None), why


def unit_of(model: Model, name: str) -> str:
    """The unit of a state, an input or a parameter; empty for a number without one."""
    if name in model.parameters:
        unit = model.parameters[name].unit
    else:
        unit = next(s.unit for s in (*model.states, *model.inputs) if s.name == name)
    return "" if unit == "1" else unit


def amount_words(model: Model, name: str, value: float, digits: int = 6) -> str:
    """``alpha_v = 0.4 rad``: a state, an input or a parameter with its unit."""
    return f"{name} = {value:.{digits}g} {wording.unit(unit_of(model, name))}".rstrip()


def usual_line(model: Model, last: bool = False) -> str:
    """What is varied when nothing is said: the first (or last) angle, or the command of a motor."""
    name = model.controlled[-1 if last else 0]
    angle = model.states[model.state_index(name)].unit == "rad"
    return name if angle else model.inputs[0].name


def _kind(model: Model, over: str) -> Kind:
    choices = (*model.controlled, *names(model.inputs), *model.parameters.names)
    unknown = f"{over!r} is no controlled state, input or parameter of model {model.name!r}"
    require_known(over, choices, unknown, "study.over")
    if over in model.controlled:
        return "angle"
    return "command" if over in names(model.inputs) else "parameter"


#: Modes this many times as fast as the fastest motion of an axis have no room in a plane with it.
_FAR = 8.0


@dataclass(frozen=True)
class Track:
    """A mode over a sweep."""

    name: str  #: After the states that take part, on average
    part: str  #: The part of the rig with the largest share
    members: tuple[int, ...]  #: Columns of the sweep: one, or a pair that is conjugate somewhere
    rates: ComplexArray  #: (n, m) complex array; λ of the members, 1/s
    #: Too fast to be shown beside the motions of the axes: armature currents, a network's memory
    fast: bool

    @property
    def slowest(self) -> ComplexArray:
        """The member with the largest real part and a frequency of at least zero, (n,)."""
        best = np.argmax(self.rates.real + 1e-12 * (self.rates.imag > 0), axis=1)
        slowest_rates = self.rates[np.arange(len(best)), best]
        return np.asarray(slowest_rates.real + 1j * np.abs(slowest_rates.imag))

    @property
    def pace(self) -> float:
        """Typical |λ|, 1/s."""
        return float(np.median(np.abs(self.rates)))


@dataclass(frozen=True)
class Locus:
    """Eigenvalues over a range as modes, and where they cross the imaginary axis."""

    path: OperatingPath
    sweep: EigenvalueSweep
    tracks: tuple[Track, ...]
    crossings: tuple[Crossing, ...]

    @property
    def slow(self) -> list[Track]:
        """Those that have room in a plane with the motions of the axes."""
        return [track for track in self.tracks if not track.fast]

    def name(self, crossing: Crossing) -> str:
        """The mode that crosses, by what it is of there.

        That is the name of its track, unless the mode has become another along the range: its
        largest share is of another part, or it swings there and does not elsewhere.
        """
        track = next(track for track in self.tracks if crossing.track in track.members)
        shares = crossing.place.spectrum.participation(crossing.track)
        parts = linear.parts_of(self.path.model)
        part = next(iter(linear.shares_of_parts(parts, shares)))
        swings = crossing.frequency > 0.0
        if part == track.part and swings == ("swing" in track.name):
            return track.name
        # A real one grows on one side of the crossing: that is what it is called after.
        rate = complex(0.0, crossing.frequency) if swings else complex(1.0)
        return linear.mode_name(parts, shares, rate)


def locus_of(path: OperatingPath, sweep: EigenvalueSweep) -> Locus:
    """The modes of a sweep and their crossings."""
    return Locus(path, sweep, tracks_of(path.model, sweep), crossings(path, sweep))


def tracks_of(model: Model, sweep: EigenvalueSweep) -> tuple[Track, ...]:
    """The modes of a sweep, the slowest motions of the rig first."""
    parts = linear.parts_of(model)
    rates = rates_of(sweep, model.sample_time)
    tracks = []
    for members in _partners(rates):
        taking_part = [[place.spectrum.participation(i) for i in members] for place in sweep.places]
        shares = np.mean(taking_part, axis=(0, 1))
        own = rates[:, members]
        swings = np.abs(own.imag).max(axis=1) > linear.STILL
        typical = own[np.flatnonzero(swings)[0], 0] if swings.mean() >= 0.5 else own.real.mean()
        name = linear.mode_name(parts, shares, complex(typical.real, abs(typical.imag)))
        part = next(iter(linear.shares_of_parts(parts, shares)))
        tracks.append(Track(name, part, tuple(members), own, fast=False))
    tracks.sort(key=lambda track: track.pace)
    moving = [t.pace for t in tracks if t.part in model.axes and not t.name.startswith("past")]
    paces = [
        track.pace for track in tracks if np.isfinite(track.pace) and track.pace > linear.STILL
    ]
    limit = _FAR * max(moving or [min(paces, default=1.0)])
    named = linear.distinct_names([track.name for track in tracks], "slower", "faster")
    return tuple(
        replace(track, name=name, fast=not track.pace <= limit)
        for track, name in zip(tracks, named, strict=True)
    )


def cell(rates: ComplexArray, digits: int = 3) -> str:
    """λ of a mode at a point: ``−0.047 ± 1.83j``, or two real ones."""
    if np.abs(rates.imag).max() > linear.STILL:
        return f"{_number(rates.real.mean(), digits)} ± {np.abs(rates.imag).max():.{digits}g}j"
    return ", ".join(_number(value, digits) for value in sorted(rates.real))


def _number(value: float, digits: int) -> str:
    if not np.isfinite(value):
        return "−∞"
    return f"{0.0 if abs(value) <= linear.STILL else value:.{digits}g}".replace("-", "−")


def _partners(rates: ComplexArray) -> list[list[int]]:
    """Columns, each with the one that it is conjugate to where it swings."""
    remaining_columns = list(range(rates.shape[1]))
    groups = []
    while remaining_columns:
        i = remaining_columns.pop(0)
        swings = np.flatnonzero(np.abs(rates[:, i].imag) > linear.STILL)
        partner = None
        if swings.size:
            votes = [
                min(
                    remaining_columns,
                    key=lambda j: abs(rates[k, j] - rates[k, i].conjugate()),
                    default=None,
                )
                for k in swings
            ]
            counted = [j for j in votes if j is not None]
            best = max(set(counted), key=counted.count) if counted else None
            if best is not None and np.median(
                np.abs(rates[swings, best] - rates[swings, i].conj())
            ) <= 1e-6 * (1.0 + np.median(np.abs(rates[swings, i]))):
                partner = best
        if partner is not None:
            remaining_columns.remove(partner)
        groups.append([i] if partner is None else [i, partner])
    return groups


#: Values are located to this share of the step that they are searched in.
_EXACT = 1e-12
#: A real part (1/s) that is larger than this where its sign changes has jumped.
_JUMPED = 1e-6


@dataclass(frozen=True)
class Crossing:
    """A crossing of the imaginary axis."""

    track: int  #: Of the sweep
    value: float  #: Of what is varied
    frequency: float  #: Im λ there, rad/s; 0 for a real eigenvalue
    unstable_above: bool  #: Whether the mode is unstable for larger values
    jumps: bool  #: Whether Re λ jumps there (a switch is passed) instead of going through zero
    place: LocusPoint

    @property
    def kind(self) -> str:
        """``Hopf`` or ``real``."""
        return "Hopf" if self.frequency > linear.STILL else "real"

    @property
    def side(self) -> str:
        """On which side the mode is unstable: ``above`` or ``below``."""
        return "above" if self.unstable_above else "below"


def rates_of(sweep: EigenvalueSweep, sample_time: float | None) -> np.ndarray:
    """λ along a sweep, (n, n_x) complex, 1/s."""
    rates = [[linear.rate_of(value, sample_time) for value in row] for row in sweep.eigenvalues]
    return np.array(rates, dtype=complex)


def crossings(path: OperatingPath, sweep: EigenvalueSweep) -> tuple[Crossing, ...]:
    """All crossings of a sweep by rising value, one for each conjugate pair."""
    T = path.model.sample_time
    rates = rates_of(sweep, T)
    crossed = []
    for k, (before, after) in enumerate(zip(sweep.places, sweep.places[1:], strict=False)):
        for track in range(rates.shape[1]):
            a, b = rates[k, track], rates[k + 1, track]
            if min(abs(a.real), abs(b.real)) <= linear.STILL or a.real * b.real > 0:
                continue
            crossing = _located(path, before, after, track)
            if crossing is not None and crossing.frequency > -linear.STILL:
                crossed.append(crossing)
    return tuple(crossed)


def _located(
    path: OperatingPath, before: LocusPoint, after: LocusPoint, track: int
) -> Crossing | None:
    T = path.model.sample_time

    def place_at(value: float) -> LocusPoint | None:
        place = path.following(before, value)
        # The far end settles which of two modes that meet in between is which.
        if place is not None and abs(value - after.value) < abs(value - before.value):
            place = replace(place, spectrum=match_spectra(after.spectrum, place.spectrum)[0])
        return place

    def growth(value: float) -> float:
        place = place_at(value)
        return np.nan if place is None else linear.rate_of(place.spectrum.values[track], T).real

    low, high = growth(before.value), growth(after.value)
    if not low * high < 0:
        return None
    span = abs(after.value - before.value)
    try:
        value = brentq(growth, before.value, after.value, xtol=_EXACT * span)
    except (ValueError, RuntimeError):
        return None
    if (place := place_at(value)) is None:
        return None
    rate = linear.rate_of(place.spectrum.values[track], T)
    frequency = rate.imag if abs(rate.imag) > linear.STILL else 0.0
    return Crossing(track, value, frequency, high > 0, abs(rate.real) > _JUMPED, place)
