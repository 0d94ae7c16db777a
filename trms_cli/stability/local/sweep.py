"""Operating points and spectra over an angle, a command or a parameter.

The sweep begins where the request stands and goes both ways until the range ends, the equilibrium
ends (a fold), or a command or angle reaches its limit. Between two points whose eigenvalues cannot
be matched with certainty more points are put.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import numpy.typing as npt

from trms_cli.core.errors import ConfigurationError, TrmsError
from trms_cli.core.plugins import nearest
from trms_cli.models.model import Model, names
from trms_cli.models.operating_point import OperatingPoint, TrimCondition, TrimSolver
from trms_cli.stability.local.asked import in_order
from trms_cli.stability.local.linear import Linear, Side
from trms_cli.stability.local.tracking import Spectrum, matched, spectrum_of

FloatArray = npt.NDArray[np.float64]
Kind = Literal["angle", "command", "parameter"]

#: Matches below this are looked at again at half the step, so often.
_SURE, _DEEPEST = 0.6, 6
#: An eigenvalue that is not faster than the first times the median may move by the second of it.
_SLOW, _CORNER = 10.0, 0.04
#: The end of a branch is located to this share of the range.
_END = 1e-5
#: rad, 1: range of an angle without stops, and of a command without limits.
_WIDE = 1.0


@dataclass(frozen=True)
class Place:
    """An operating point of a sweep."""

    value: float  #: Of what is varied
    held: TrimCondition  #: What is held there
    point: OperatingPoint
    spectrum: Spectrum  #: In the order of the sweep's tracks


@dataclass(frozen=True)
class Sweep:
    """What was found along a line."""

    places: tuple[Place, ...]  #: By rising value; eigenvalue i of each belongs to track i
    low: str = ""  #: Why it ended before the range did, on either side
    high: str = ""  #: empty if it did not

    @property
    def values(self) -> FloatArray:
        return np.array([place.value for place in self.places])

    @property
    def eigenvalues(self) -> npt.NDArray[np.complex128]:
        """(n, n_x), of the matrices; column i is one track."""
        return np.array([place.spectrum.values for place in self.places])


class Path:
    """A family of operating points by one number.

    Parameters
    ----------
    model : Model
    at : dict of str to float
        Angles or commands that are held; that of ``over`` does not count.
    over : str
        A controlled state, an input, or a parameter.
    side : Side
        Whose slopes are taken on a switch.

    Raises
    ------
    ConfigurationError
        For a name that is none of these, or that does not go with ``at``.
    """

    def __init__(
        self, model: Model, at: Mapping[str, float], over: str, side: Side = "mean"
    ) -> None:
        self.model, self.over, self.side = model, over, side
        self.balance, self.linear = TrimSolver(model), Linear(model)
        self.kind = _kind(model, over)
        self.at = dict(at)
        self._given = tuple(at)
        self._free = self.kind != "parameter" and over not in self.at
        if self._free:
            # Where nothing is said of it the sweep begins at zero, or at rest if it must.
            self.at[over] = 0.0
        self._base = self.balance.held(self.at)
        self.began = (
            self.model.parameters[over].value if self.kind == "parameter" else self.at[over]
        )

    def moved(self, name: str, value: float) -> Path:
        """The same with another angle, command or parameter held at a value.

        Raises ConfigurationError for an angle where commands are held, and the reverse.
        """
        kind = _kind(self.model, name)
        other = copy.copy(self)
        base = self._base
        if kind == "parameter":
            p = base.p.copy()
            p[self.model.parameters.names.index(name)] = value
            other._base = replace(base, p=p)
            return other
        if (kind == "angle") != base.by_angle and not np.any(base.values):
            base = self.balance.held({name: value})
            other._base = replace(base, p=self._base.p)
            other.at = {name: value}
            return other
        if (kind == "angle") != base.by_angle:
            raise ConfigurationError(
                f"{name} is {'an angle' if kind == 'angle' else 'a command'}, and "
                f"{', '.join(self.at)} held",
                where="study.against",
                remedy="hold angles and vary an angle, or hold commands and vary a command",
            )
        order = self.model.controlled if base.by_angle else names(self.model.inputs)
        values = base.values.copy()
        values[order.index(name)] = value
        other._base = replace(base, values=values)
        other.at = self.at | {name: value}
        return other

    @property
    def unit(self) -> str:
        """Empty for a number without one."""
        if self.kind == "parameter":
            unit = self.model.parameters[self.over].unit
        else:
            signals = (*self.model.states, *self.model.inputs)
            unit = next(signal.unit for signal in signals if signal.name == self.over)
        return "" if unit == "1" else unit

    def held(self, value: float) -> TrimCondition:
        """What is held at a value."""
        if self.kind == "parameter":
            p = self._base.p.copy()
            p[self.model.parameters.names.index(self.over)] = value
            return replace(self._base, p=p)
        order = self.model.controlled if self.kind == "angle" else names(self.model.inputs)
        values = self._base.values.copy()
        values[order.index(self.over)] = value
        return replace(self._base, values=values)

    def direction(self) -> TrimCondition:
        """Rates of change of what is held, per unit of what is varied."""
        values, p = np.zeros_like(self._base.values), np.zeros_like(self._base.p)
        one = self.held(1.0)
        zero = self.held(0.0)
        return TrimCondition(
            self._base.by_angle, values + one.values - zero.values, p + one.p - zero.p
        )

    def first(self, low: float, high: float) -> Place:
        """The place where a sweep begins: where the request stands, or the end next to it.

        Raises TrmsError where there is none.
        """
        begin = self._begin()
        value = min(max(self.began, low), high)
        point = self.balance.advance(self.held(self.began), self.held(value), begin)
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

    def place(self, value: float, point: OperatingPoint) -> Place:
        """A place at a known operating point."""
        held = self.held(value)
        a = self.linear.a(point.x, point.u, self.side, held.p)
        return Place(value, held, point, spectrum_of(a))

    def following(self, last: Place, value: float, shortest: float = 1e-3) -> Place | None:
        """The place at another value on the same branch, its eigenvalues matched."""
        held = self.held(value)
        point = self.balance.advance(last.held, held, last.point, shortest)
        if point is None or not self._within(point):
            return None
        place = self.place(value, point)
        return replace(place, spectrum=matched(last.spectrum, place.spectrum)[0])

    def range(
        self, given: tuple[float, float] | None, where: str = "study.range"
    ) -> tuple[float, float]:
        """The range asked for, or the usual one.

        Raises ConfigurationError for one that is empty, reversed or outside the parameter's bounds.
        """
        if given is None:
            return self._usual()
        low, high = in_order(given, where)
        if self.kind == "parameter":
            p = self.model.parameters[self.over]
            if not p.lower <= low <= high <= p.upper:
                raise ConfigurationError(
                    f"{list(given)} given, and {self.over} lies between {p.lower:g} and "
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
            rest = {
                name: float(self.model.rest()[self.model.state_index(name)])
                for name in self.model.controlled
                if name not in self._given
            }
            begin = self.balance.first(self.at | rest)
            self.at |= rest
            self.began = self.at[self.over]
            self._base = self.balance.held(self.at)
            return begin

    def _within(self, point: OperatingPoint) -> bool:
        return self.kind != "angle" or self.balance.within_limits(point)


def swept(path: Path, low: float, high: float, points: int, also: tuple[float, ...] = ()) -> Sweep:
    """Go through a range, by way of further values where they lie within.

    Raises TrmsError where there is no operating point to begin at.
    """
    begin = path.first(low, high)
    grid = np.linspace(low, high, points)
    grid = np.unique(np.concatenate([grid, [value for value in also if low < value < high]]))
    up, why_high = _one_way(path, begin, grid[grid > begin.value + 1e-12 * (high - low)])
    down, why_low = _one_way(path, begin, grid[grid < begin.value - 1e-12 * (high - low)][::-1])
    return Sweep((*down[::-1], begin, *up), why_low, why_high)


def _one_way(path: Path, begin: Place, values: FloatArray) -> tuple[list[Place], str]:
    found: list[Place] = []
    last = begin
    for value in values:
        between = _filled(path, last, float(value), 0)
        if between is None:
            end, why = _end(path, last, float(value))
            return [*found, *([end] if end is not None else [])], why
        found += between
        last = found[-1]
    return found, ""


def _filled(path: Path, last: Place, value: float, depth: int) -> list[Place] | None:
    """Places up to a value, with further ones between where the matching is unsure."""
    held = path.held(value)
    point = path.balance.advance(last.held, held, last.point)
    if point is None or not path._within(point):
        return None
    place = path.place(value, point)
    spectrum, sure = matched(last.spectrum, place.spectrum)
    if (sure < _SURE or _leaps(last.spectrum, spectrum)) and depth < _DEEPEST:
        first = _filled(path, last, 0.5 * (last.value + value), depth + 1)
        second = None if first is None else _filled(path, first[-1], value, depth + 1)
        if first is not None and second is not None:
            return [*first, *second]
    return [replace(place, spectrum=spectrum)]


def _leaps(before: Spectrum, after: Spectrum) -> bool:
    """Whether a curve through the eigenvalues would show corners."""
    pace = np.abs(before.values)
    typical = float(np.median(pace))
    slow = pace <= _SLOW * typical
    moves = np.abs(after.values - before.values)[slow]
    return bool(moves.max(initial=0.0) > _CORNER * typical)


def _end(path: Path, last: Place, value: float) -> tuple[Place | None, str]:
    """The last place before a value that is not reached, and why."""
    good, bad, span = last, value, abs(value - last.value)
    while abs(bad - good.value) > _END * span:
        middle = 0.5 * (good.value + bad)
        found = path.following(good, middle, 0.5)
        if found is None:
            bad = middle
        else:
            good = found
    beyond = path.balance.advance(good.held, path.held(bad), good.point, 0.5)
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


def usual_line(model: Model, last: bool = False) -> str:
    """What is varied when nothing is said: the first (or last) angle, or the command of a motor."""
    name = model.controlled[-1 if last else 0]
    angle = model.states[model.state_index(name)].unit == "rad"
    return name if angle else model.inputs[0].name


def _kind(model: Model, over: str) -> Kind:
    if over in model.controlled:
        return "angle"
    if over in names(model.inputs):
        return "command"
    if over in model.parameters:
        return "parameter"
    raise ConfigurationError(
        f"{over!r} is no controlled state, input or parameter of model {model.name!r}",
        where="study.over",
        remedy=nearest(over, (*model.controlled, *names(model.inputs), *model.parameters.names)),
    )
