"""A sample of the PID law as one CasADi function. Its equations: :mod:`trms_cli.controllers.pid`.

The function takes the estimate, the reference, the command in force, what the law remembers, and
all numbers and tables of the design as one vector. It thus follows from a :class:`LawLayout` alone:
how many axes and tables there are and which terms they have. Rigs that differ in numbers share it,
and so its compiled code. Where there is no compiler, it is interpreted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from types import SimpleNamespace

import casadi as ca
import numpy as np

from trms_cli.controllers.pid_feed_forward import PathMemory, PiecewiseLinear
from trms_cli.controllers.pid_tuning import Gains
from trms_cli.core.arrays import FloatArray

#: s in which an axis that friction stopped beside its reference is to get there.
_CLOSING = 5.0
#: Part of the friction that closes an error: with all of it, lags make the axis swing about its
#: reference, as a relay would.
_FOR_CLOSING = 0.7
#: Part of the rotor's torque that a reference may ask for, the rest is left to the feedback; and of
#: what holding the axis leaves, where that takes most of it.
_FOR_REFERENCE, _AT_LEAST = 0.5, 0.25
#: Samples that a jump of the reference spoils: the difference to it, and that from it.
_JUMP = 2
#: Tables are filled up to a multiple of this many rows, so that rigs of other numbers share code.
_ROWS = 16


def _nothing() -> ca.MX:
    return ca.MX(0.0)


#: What the law remembers of an axis, beside the values of its memories along r̃:
#: I (N m), D (N m), φ(m) behind τ_f (V), m_ff without what other axes ask for (N m), m_ff behind
#: τ_f (N m) and so its rate (N m/s), α − r̃ or α (rad), r̃ and its derivatives (rad, rad/s,
#: rad/s²), the last reference (rad) and whether there was one, the difference of the last two by T
#: (rad/s), the rate of the reference without its jumps (rad/s), samples since it was smooth.
STATE = (
    *("integral", "derivative", "lagged", "forward", "forward_lag", "forward_rate", "last_error"),
    *("goal", "goal_rate", "goal_acceleration", "last_reference", "has_last"),
    *("reference_difference", "followed_rate", "jumping"),
)
_NUMBERS = (
    *("kp", "ki", "step", "keep", "derivative_gain", "tracking", "lead", "slow", "lead_filter"),
    *("weight", "reference_rate", "least", "most", "lowest", "highest"),
    *("c1", "c2", "c3", "a1", "a2", "a3"),
)


@dataclass(frozen=True)
class AxisLaw:
    """The law of one axis: all that does not change during a run."""

    #: ``state``, ``reference``, ``channel``: Positions of the angle in x, of its reference, and of
    #: its input in u
    state: int
    reference: int
    channel: int
    gains: Gains
    step: float  #: T, s
    weight: float  #: b
    curve: PiecewiseLinear  #: Input by torque, V by N m
    holding: PiecewiseLinear | None  #: Torque by angle, N m by rad; None without feed-forward
    friction: PiecewiseLinear | None  #: Torque by rate, N m by rad/s; None without
    #: (c_1, c_2, c_3); torque by the derivatives of the reference, N m s/rad and so on
    inverse: tuple[float, ...]
    ahead: tuple[float, ...]  #: The same before the lead
    memories: tuple[PathMemory, ...]  #: of the axis' path
    keep: float  #: a, the share that the filter of D keeps
    derivative_gain: float  #: k_d (1 − a)/T
    tracking: float  #: T/T_t τ/τ_f, at most 1
    coupling: tuple[float, ...]  #: Torque by the rate of m_ff of each axis before this one, s
    burdens: tuple[PiecewiseLinear, ...]  #: Torque by m_ff of each axis before, N m by N m
    #: ``lead``, ``slow``: τ/τ_f, and the part that the lead's lag keeps over a period
    lead: float
    slow: float
    lead_filter: float  #: τ_f, s
    reference_rate: float  #: One over the reference's lag, 1/s; 0 for none

    @property
    def torque_of(self) -> PiecewiseLinear:
        """Torque by input, N m by V."""
        return self.curve.inverse()

    @property
    def least(self) -> float:
        """Torque at the lower limit of the input, N m."""
        return self.curve.x[0]

    @property
    def most(self) -> float:
        """Torque at the upper limit of the input, N m."""
        return self.curve.x[-1]

    def tables(self) -> list[PiecewiseLinear]:
        """All tables of the axis, in the order of its numbers."""
        single = [self.curve, self.torque_of, self.holding, self.friction, *self.burdens]
        remembered = [
            t for memory in self.memories for t in (memory.rise, memory.fall, memory.torque)
        ]
        return [table for table in [*single, *remembered] if table is not None]

    def numbers(self) -> FloatArray:
        """Numbers and tables, in the order in which :func:`law` takes them."""
        own = {
            "kp": self.gains.kp,
            "ki": self.gains.ki,
            "lowest": self.curve.y[0],
            "highest": self.curve.y[-1],
            **dict(zip(("c1", "c2", "c3"), self.inverse, strict=True)),
            **dict(zip(("a1", "a2", "a3"), self.ahead, strict=True)),
        }
        plain = [own[name] if name in own else getattr(self, name) for name in _NUMBERS]
        tables = [_filled(table) for table in self.tables()]
        return np.concatenate([plain, self.coupling, *tables])

    @property
    def layout(self) -> AxisLayout:
        """What the law's expressions are made of."""
        return AxisLayout(
            places=(self.state, self.reference, self.channel),
            is_guided=self.reference_rate > 0,
            is_cut=self.inverse[2] > 0,
            holds=self.holding is not None,
            knows_friction=self.friction is not None,
            others=len(self.coupling),
            memories=len(self.memories),
            rows=tuple(_rows(table) for table in self.tables()),
        )


@dataclass(frozen=True)
class AxisLayout:
    """What the expressions of one axis are made of."""

    places: tuple[int, int, int]  #: of its angle in x, its reference, its input in u
    is_guided: bool  #: Whether a filter makes r̃ of the reference
    is_cut: bool  #: Whether the jerk of r̃ is held within what the rotor can
    holds: bool  #: Whether anything is fed forward
    knows_friction: bool
    others: int  #: Axes before this one whose m_ff it undoes
    memories: int
    rows: tuple[int, ...]  #: of each table

    @property
    def states(self) -> int:
        """Numbers that the law remembers of the axis."""
        return len(STATE) + self.memories

    @property
    def size(self) -> int:
        """Numbers of the axis in the design's vector."""
        return len(_NUMBERS) + self.others + 3 * sum(self.rows)


@dataclass(frozen=True)
class LawLayout:
    """What the law's expressions are made of."""

    sizes: tuple[int, int, int]  #: of x, reference and u
    axes: tuple[AxisLayout, ...]
    follows_rates: bool  #: Whether a smooth reference is followed with its rate and acceleration


def _rows(table: PiecewiseLinear) -> int:
    return (len(table.x) // _ROWS + 1) * _ROWS  # at least one more than it has points


def _filled(table: PiecewiseLinear) -> FloatArray:
    """Points, values and slopes; beyond the last point values stay what they are."""
    x, y = np.array(table.x), np.array(table.y)
    more = _rows(table) - len(x)
    beyond = x[-1] + (1.0 + abs(x[-1] - x[0])) * np.arange(1, more + 1)
    slopes = np.diff(y) / np.diff(x)
    flat = np.zeros(more + 1)
    return np.concatenate([x, beyond, y, np.full(more, y[-1]), slopes, flat])


class _Tables:
    """Tables in the design's vector p. Values and slopes are read where they stand, not copied."""

    def __init__(self, p: ca.MX, start: int, rows: Sequence[int]) -> None:
        self._p = p
        self._places = []
        for count in rows:
            self._places.append((start, count))
            start += 3 * count

    def at(self, which: int, value: ca.MX) -> ca.MX:
        """As :meth:`PiecewiseLinear.at`."""
        p, (start, count) = self._p, self._places[which]
        points = p[start : start + count]
        inside = ca.fmax(value, points[0])
        i = ca.low(points, inside, {"lookup_mode": "binary"})
        return p[start + count + i] + p[start + 2 * count + i] * (inside - p[start + i])


class AxisExpressions:
    """The terms of one axis at a sample; each advances what the law remembers.

    ``p``: the design's vector; ``start``: where the axis begins in it. ``state``: of the axis.
    """

    def __init__(self, layout: AxisLayout, p: ca.MX, start: int, state: ca.MX) -> None:
        self.layout = layout
        plain = len(_NUMBERS) + layout.others
        values = ca.vertsplit(p[start : start + plain])
        self.fixed = SimpleNamespace(**dict(zip(_NUMBERS, values, strict=False)))
        self._coupling = values[len(_NUMBERS) :]
        remembered = ca.vertsplit(state)
        self.state = SimpleNamespace(**dict(zip(STATE, remembered, strict=False)))
        self.remembered = remembered[len(STATE) :]
        self._tables = _Tables(p, start + plain, layout.rows)
        # in the order of AxisLaw.tables
        self._holding = 2
        self._friction = self._holding + layout.holds
        self._burdens = self._friction + layout.knows_friction
        self._memories = self._burdens + layout.others

    def after(self) -> ca.MX:
        """What is remembered now."""
        return ca.vertcat(*(getattr(self.state, name) for name in STATE), *self.remembered)

    def curve(self, torque: ca.MX) -> ca.MX:
        """Input for a torque in steady state, V."""
        return self._tables.at(0, torque)

    def torque_of(self, volts: ca.MX) -> ca.MX:
        """Torque of an input in steady state, N m."""
        return self._tables.at(1, volts)

    def derivatives(self, reference: ca.MX) -> tuple[ca.MX, ca.MX]:
        """Rate and acceleration of the reference, rad/s and rad/s².

        Where it moves as no torque of the rotor could move the axis, the rate is that before, and
        0 if that goes on.
        """
        s, fixed = self.state, self.fixed
        has_last = s.has_last
        rate = ca.if_else(has_last, (reference - s.last_reference) / fixed.step, 0.0)
        change = (rate - s.reference_difference) / fixed.step
        acceleration = ca.if_else(has_last, change, 0.0)
        is_smooth = ca.fabs(fixed.c2 * acceleration) <= fixed.most - fixed.least
        s.jumping = ca.if_else(is_smooth, 0.0, s.jumping + 1.0)
        kept = ca.if_else(s.jumping > _JUMP, 0.0, s.followed_rate)
        s.followed_rate = ca.if_else(is_smooth, rate, kept)
        s.reference_difference, s.last_reference = rate, reference
        s.has_last = ca.MX(1.0)
        return s.followed_rate, ca.if_else(is_smooth, acceleration, 0.0)

    def guided(self, reference: ca.MX, slopes: tuple[ca.MX, ca.MX]) -> tuple[ca.MX, ca.MX]:
        """The reference that the axis can follow, and the torque fed forward for it.

        Advances the reference's filter, with its jerk cut so that the torque stays within the
        rotor's. ``slopes``: rate and acceleration with which the reference moves, rad/s and rad/s².
        """
        layout, s, fixed = self.layout, self.state, self.fixed
        y = s.goal if layout.is_guided else reference
        held = self._tables.at(self._holding, y) if layout.holds else _nothing()
        if not layout.is_guided:
            return reference, held
        f, T = fixed.reference_rate, fixed.step
        rate, acceleration = s.goal_rate, s.goal_acceleration
        jerk = f * (f * (reference - y) + 3 * (slopes[0] - rate))
        jerk = f * (jerk + 3 * (slopes[1] - acceleration))
        forward = held
        if layout.holds and layout.is_cut:
            calm = held + fixed.c1 * rate + fixed.c2 * acceleration
            least = held + _AT_LEAST * (fixed.least - held)
            least = ca.fmin(_FOR_REFERENCE * fixed.least, least)
            most = held + _AT_LEAST * (fixed.most - held)
            most = ca.fmax(_FOR_REFERENCE * fixed.most, most)
            jerk = ca.fmax(jerk, (least - calm) / fixed.c3)
            jerk = ca.fmin(jerk, (most - calm) / fixed.c3)
        if layout.holds:
            forward = held + fixed.a1 * rate + fixed.a2 * acceleration + fixed.a3 * jerk
        for i, value in enumerate(self.remembered):
            rise, fall, torque = (self._memories + 3 * i + j for j in range(3))
            forward += self._tables.at(torque, value)
            change = ca.if_else(
                rate > 0, self._tables.at(rise, value), self._tables.at(fall, value)
            )
            self.remembered[i] = ca.fmin(ca.fmax(value + T * rate * change, -1.0), 1.0)
        s.goal_acceleration = acceleration + T * jerk
        s.goal_rate = rate + T * s.goal_acceleration
        s.goal = y + T * s.goal_rate
        return y, forward

    def against_friction(self, error: ca.MX) -> ca.MX:
        """The friction of the rate that the axis is to have, and of closing its error, N m."""
        rate = self.state.goal_rate
        along = self._tables.at(self._friction, rate)
        closing = self._tables.at(self._friction, rate + error / _CLOSING)
        return along + _FOR_CLOSING * (closing - along)

    def from_others(self, others: Sequence[AxisExpressions]) -> ca.MX:
        """Torque that undoes what the torques fed forward to other axes do to this one, N m."""
        torque = _nothing()
        for i, (other, strength) in enumerate(zip(others, self._coupling, strict=False)):
            torque += strength * other.state.forward_rate
            torque += self._tables.at(self._burdens + i, other.state.forward)
        return torque

    def through_rotor(self, demand: ca.MX) -> tuple[ca.MX, ca.MX]:
        """The input for a torque asked for, V, and the torque to which limits cut that, N m."""
        s, fixed = self.state, self.fixed
        volts = self.curve(demand)
        s.lagged = volts + fixed.slow * (s.lagged - volts)
        uncut = s.lagged + fixed.lead * (volts - s.lagged)
        u = ca.fmin(ca.fmax(uncut, fixed.lowest), fixed.highest)
        left = self.torque_of(s.lagged + (u - s.lagged) / fixed.lead)
        whole = ca.fmin(ca.fmax(demand, fixed.least), fixed.most)
        return u, ca.if_else(u == uncut, whole, left)

    def sample(
        self,
        angle: ca.MX,
        reference: ca.MX,
        others: Sequence[AxisExpressions],
        follows_rates: bool,
    ) -> ca.MX:
        """The input, V."""
        s, fixed = self.state, self.fixed
        slopes = self.derivatives(reference) if follows_rates else (_nothing(), _nothing())
        goal, forward = self.guided(reference, slopes)
        behind = angle - goal if self.layout.is_guided else angle
        s.derivative = fixed.keep * s.derivative - fixed.derivative_gain * (behind - s.last_error)
        s.last_error = behind
        terms = fixed.kp * (fixed.weight * goal - angle) + s.integral + s.derivative
        if self.layout.knows_friction:
            terms += self.against_friction(goal - angle)
        ahead = forward - s.forward_lag
        s.forward, s.forward_rate = forward, ahead / fixed.lead_filter
        s.forward_lag += fixed.step / (fixed.step + fixed.lead_filter) * ahead
        demand = forward + terms + self.from_others(others)
        u, torque = self.through_rotor(demand)
        s.integral += fixed.ki * fixed.step * (goal - angle) + fixed.tracking * (torque - demand)
        return u

    def begin(self, angle: ca.MX, command: ca.MX, others: Sequence[AxisExpressions]) -> None:
        """Bumpless: if the reference were where the rig is, the command in force would go on."""
        s, fixed = self.state, self.fixed
        self._rest_at(angle)
        forward = self.guided(angle, (_nothing(), _nothing()))[1]
        self._rest_at(angle)  # which has moved the filter on
        s.last_error = _nothing() if self.layout.is_guided else angle
        s.forward = s.forward_lag = forward
        s.lagged = command
        beside = self.from_others(others)
        s.integral = self.torque_of(command) - forward - beside
        s.integral -= fixed.kp * (fixed.weight - 1.0) * angle

    def _rest_at(self, angle: ca.MX) -> None:
        """Remember nothing but that the reference has been at an angle."""
        for name in STATE:
            setattr(self.state, name, _nothing())
        self.state.goal = angle
        self.remembered = [_nothing()] * self.layout.memories


@lru_cache(maxsize=32)
def law(layout: LawLayout) -> Mapping[str, ca.Function]:
    """The functions of a layout.

    ``begin``: ``(x, u, p) → state``. ``sample``: ``(x, r, u, state, p) → u⁺, state⁺, health``, with
    u the command in force, which inputs that hold no axis keep; ``health`` is finite exactly if x
    and r are.
    """
    n_x, n_r, n_u = layout.sizes
    x, r, u = ca.MX.sym("x", n_x), ca.MX.sym("r", n_r), ca.MX.sym("u", n_u)
    p = ca.MX.sym("p", sum(axis.size for axis in layout.axes))
    state = ca.MX.sym("state", sum(axis.states for axis in layout.axes))

    def axes() -> list[AxisExpressions]:
        result, start, first = [], 0, 0
        for axis in layout.axes:
            own = state[first : first + axis.states]
            result.append(AxisExpressions(axis, p, start, own))
            start, first = start + axis.size, first + axis.states
        return result

    beginning: list[AxisExpressions] = []
    for axis in axes():
        angle, _, channel = axis.layout.places
        axis.begin(x[angle], u[channel], beginning)
        beginning.append(axis)
    done: list[AxisExpressions] = []
    commands = ca.vertsplit(u)
    for axis in axes():
        angle, reference, channel = axis.layout.places
        commands[channel] = axis.sample(x[angle], r[reference], done, layout.follows_rates)
        done.append(axis)
    after = ca.vertcat(*(axis.after() for axis in done))
    return {
        "begin": ca.Function(
            "pid_begin", [x, u, p], [ca.vertcat(*(axis.after() for axis in beginning))]
        ),
        "sample": ca.Function(
            "pid_sample",
            [x, r, u, state, p],
            [ca.vertcat(*commands), after, ca.sum1(x) + ca.sum1(r)],
            ["x", "r", "u", "state", "p"],
            ["u_next", "state_next", "health"],
        ),
    }
