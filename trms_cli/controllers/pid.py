"""Decentralised PID: the main rotor holds pitch, the tail rotor holds yaw.

For each axis, with reference r, angle α and control period T,

    e = r̃ − α
    v = k_p (b r̃ − α) + I + D
    m = m_ff + v                            torque asked for
    u = (1 + τ s)/(1 + τ_f s) φ(m)          cut; φ: the input that gives a torque in steady state
    I⁺ = I + k_i T e + T/T_t τ/τ_f (m_cut − m)    back-calculation against windup
    D  = a D₋ + k_d (1 − a)/T (e − e₋)      a = T_f/(T_f + T)

after Åström & Murray, "Feedback Systems", ch. 11 and 12.5, with what a rig of rotors needs:

- The inverse φ of the rotor's curve (:mod:`trms_cli.controllers.pid_feed_forward`) takes the
  square of the propeller out of the loop. Gains are thus in N m, not in V.
- The lead makes up for the rotor's lag τ. It is behind φ as the lag is before the thrust: what lags
  is the speed, which goes as φ of the torque. For small motions the order makes no difference, but
  a rotor that turns round was left behind by a lead of the torque.
- r̃ is the reference behind three equal lags. Its derivatives are known without differencing, and

      m_ff = h(r̃) + (1 + τ_f s)/(1 + τ s) (c_1 s + c_2 s² + c_3 s³) r̃

  is the torque with which the model follows it: h what holds the axis there, c the inverse of its
  linear dynamics, rotor included; with the lead in front, it is again a polynomial of degree 3. The
  third derivative is cut so that h + c r̃ stays within a part of the rotor's torque, or c r̃ within
  a part of what h leaves: r̃ asks for nothing that cannot be followed, nor for all that there is,
  for then none is left to the feedback.
  As r̃ is smooth, D may act on r̃ − α without a kick; with ``reference_lag=0`` there is no r̃ to
  differentiate, and D acts on −α.
- A reference that moves so that the rotor's torque could follow it is followed with its rate and
  acceleration, differences of its samples, and the lags do not hold r̃ back. A jump is not such a
  motion: behind it, r̃ is three lags late.
- Of a model with dry friction, v has the friction of the rate that the axis is to have, r̃'s, and
  0.7 of what e/5 s adds to that. Without it an axis that stops short of its reference waits until
  the integral has grown over the friction; with it, and inside the friction's cone, it gets there
  or stays. Of a model with a path memory (a cable's hysteresis), m_ff has the torque that it would
  have along r̃.
- A rotor that speeds up turns the rig the other way round, and its drag does so while it turns. Yaw
  is told what the torque fed forward to pitch will do to it: a number from the model times
  d m_ff,pitch/dt, and the burden of m_ff,pitch in steady state. Nothing measured passes from one
  axis to the other, so that this cannot make the loops unstable.

What is left to the feedback is what the model misses. The main rotor's start from standstill, where
it is three times slower than in flight, is the largest part of that on the default references.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Literal

from msgspec import Meta

from trms_cli.controllers.controller import (
    Command,
    ControlSample,
    ControlSetup,
    Delay,
    PresentReference,
)
from trms_cli.controllers.fallback import NOT_FINITE, hold_command
from trms_cli.controllers.pid_design import AxisDesign, PidDesign
from trms_cli.controllers.pid_feed_forward import ROTOR_OF_AXIS, PathMemory, PiecewiseLinear
from trms_cli.controllers.pid_tuning import AxisMargins, Gains
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import require_known
from trms_cli.core.ranges import NotNegative, Positive
from trms_cli.models.model import Model

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


@dataclass(slots=True)
class AxisState:
    """One axis: its fixed numbers and what it remembers."""

    #: ``state``, ``reference``, ``channel``: Positions of the angle in x, of its reference, and of
    #: its input in u
    state: int
    reference: int
    channel: int
    gains: Gains
    step: float  #: T, s
    curve: PiecewiseLinear  #: Input by torque, V by N m
    torque_of: PiecewiseLinear  #: Its inverse
    holding: PiecewiseLinear | None  #: Torque by angle, N m by rad; None without feed-forward
    friction: PiecewiseLinear | None  #: Torque by rate, N m by rad/s; None without
    #: c_1, c_2, c_3: torque by the derivatives of the reference, N m s/rad and so on
    inverse: list[float]
    ahead: list[float]  #: The same before the lead
    memories: tuple[PathMemory, ...]  #: of the axis' path
    keep: float  #: a, the share that the filter of D keeps
    derivative_gain: float  #: k_d (1 − a)/T
    tracking: float  #: T/T_t τ/τ_f, at most 1
    coupling: list[float]  #: Torque by the rate of m_ff of each axis before this one, s
    burdens: list[PiecewiseLinear]  #: Torque by m_ff of each axis before this one, N m by N m
    #: ``lead``, ``slow``: τ/τ_f, and the part that the lead's lag keeps over a period
    lead: float
    slow: float
    reference_rate: float  #: One over the reference's lag, 1/s; 0 for none
    least: float  #: Torque at the lower limit of the input, N m
    most: float  #: At the upper one, N m
    integral: float = 0.0  #: I, N m
    derivative: float = 0.0  #: D, N m
    lagged: float = 0.0  #: φ(m) behind τ_f, V
    forward: float = 0.0  #: m_ff without what other axes ask for, N m
    forward_lag: float = 0.0  #: m_ff behind τ_f, N m
    forward_rate: float = 0.0  #: and so its rate, N m/s
    last_error: float = math.nan  #: α − r̃ (or α), rad; NaN before the first sample
    #: r̃ and its two derivatives, rad, rad/s, rad/s²
    guide: tuple[float, float, float] = (0.0, 0.0, 0.0)
    last_reference: float = math.nan  #: rad; NaN before the first sample
    reference_difference: float = 0.0  #: Of the last two references by T, rad/s
    followed_rate: float = 0.0  #: Of the reference, jumps left out, rad/s
    jumping: int = 0  #: Samples since the reference was smooth
    remembered: list[float] = field(default_factory=list)  #: Values of the memories along r̃


@dataclass
class PidState:
    """All axes."""

    axes: list[AxisState]
    #: Robustness of each axis' loop, the worst of the operating points
    margins: Mapping[str, AxisMargins]


@dataclass(frozen=True, kw_only=True)
class Pid(PresentReference):
    """PID on each axis."""

    #: ``pitch``, ``yaw``: "auto" or Gains; kp, ki and kd in N m/rad, N m/(rad s) and N m s/rad; kd
    #: is 0 where it is not given. ``auto`` tunes them for the model at the operating points; see
    #: :mod:`trms_cli.controllers.pid_tuning`.
    pitch: Literal["auto"] | Gains = "auto"
    yaw: Literal["auto"] | Gains = "auto"
    #: Gains of axes of other names, in their units of force and travel; those of the others are
    #: tuned
    loops: Mapping[str, Gains] = field(default_factory=dict)
    #: Controlled angles at which the model is linearised for tuning and for the inverse that is fed
    #: forward, rad. Yaw must need thrust there: the tail rotor has no slope where it stands still.
    operating_points: tuple[Mapping[str, float], ...] = (
        {"alpha_v": -0.3, "alpha_h": 0.3},
        {"alpha_v": 0.0, "alpha_h": 0.5},
        {"alpha_v": 0.3, "alpha_h": 1.0},
    )
    #: M, the bound on the peak of the sensitivity in tuning
    max_sensitivity: Annotated[float, Meta(gt=1)] = 1.6
    #: ρ by axis, s: weight of the rate against the angle in tuning; 3 where none is given
    smoothness: Mapping[str, Positive] = field(default_factory=dict)
    derivative_filter: Positive = 0.04  #: T_f, s
    #: τ_f, s; also of the rate that pitch passes to yaw. A rotor faster than this gets no lead.
    lead_filter: Positive = 0.07
    #: b, the part of the reference that the proportional term sees
    setpoint_weight: Annotated[float, Meta(ge=0, le=1)] = 1.0
    #: Time constant of each of the three lags on the reference, s; 0 for none, None for the rotor's
    #: τ, but at least 10 T
    reference_lag: NotNegative | None = None
    #: Whether a smooth reference is followed with its rate and acceleration, without these lags
    reference_rates: bool = True
    #: T_t, s, but not less than T τ/τ_f. None takes √(k_d/k_i), and 1 s where either is 0.
    tracking_time: Positive | None = None
    feed_forward: bool = True
    sample_time: Positive | None = None  #: Control period, s; None takes every sample
    delay: Delay = "none"

    def __post_init__(self) -> None:
        if not self.operating_points:
            raise ConfigurationError(
                "no operating point given",
                where="operating_points",
                remedy="give at least one, as [{alpha_v: 0.0, alpha_h: 0.5}]",
            )

    def init(self, setup: ControlSetup) -> PidState:
        model, T = setup.model, setup.sample_time
        for key, entries in (("smoothness", self.smoothness), ("loops", self.loops)):
            for name in entries:
                if name not in ROTOR_OF_AXIS:
                    known = model.axes or ROTOR_OF_AXIS
                    require_known(name, known, f"{name!r} is not an axis", f"controller.{key}")
        designs = PidDesign(
            requested_gains={"pitch": self.pitch, "yaw": self.yaw, **self.loops},
            operating_points=self.operating_points,
            max_sensitivity=self.max_sensitivity,
            smoothness=self.smoothness,
            derivative_filter=self.derivative_filter,
            lead_filter=self.lead_filter,
        ).of(model, T)
        return PidState(
            [self._axis(model, design, T) for design in designs.values()],
            {name: design.margins for name, design in designs.items()},
        )

    def _axis(self, model: Model, design: AxisDesign, T: float) -> AxisState:
        gains, filters, curve = design.gains, design.filters, design.curve
        keep = filters.derivative / (filters.derivative + T)
        tracking = self.tracking_time
        if tracking is None:
            # Without an integral or a derivative the gains have no time of their own.
            tracking = math.sqrt(gains.kd / gains.ki) if gains.ki and gains.kd else 1.0
        lag = self.reference_lag
        if lag is None:
            lag = max(design.rotor_lag, 10 * T)
        return AxisState(
            state=model.state_index(design.angle),
            reference=model.controlled.index(design.angle),
            channel=design.channel,
            gains=gains,
            step=T,
            curve=curve,
            torque_of=curve.inverse(),
            holding=design.holding if self.feed_forward else None,
            friction=design.friction if self.feed_forward else None,
            inverse=list(design.inverse[1:]),
            ahead=list(design.forward[1:]),
            memories=design.memories if self.feed_forward else (),
            remembered=[0.0] * len(design.memories),
            keep=keep,
            derivative_gain=gains.kd * (1 - keep) / T,
            tracking=min(1.0, T / tracking * filters.ratio),
            coupling=list(design.coupling) if self.feed_forward else [],
            burdens=list(design.burdens) if self.feed_forward else [],
            lead=filters.ratio,
            slow=filters.lead_filter / (filters.lead_filter + T),
            reference_rate=1 / lag if lag > 0 else 0.0,
            least=curve.x[0],
            most=curve.x[-1],
        )

    def step(self, state: PidState, sample: ControlSample, *, want_prediction: bool) -> Command:
        x = sample.estimate.x.tolist()
        reference = sample.reference[0].tolist()
        u = sample.previous_command.copy()
        if not math.isfinite(sum(x) + sum(reference)):
            return hold_command(u, NOT_FINITE)
        weight = self.setpoint_weight
        if math.isnan(state.axes[0].last_error):
            for axis in state.axes:
                beside = _from_others(state.axes, axis)
                _start(axis, x[axis.state], float(u[axis.channel]), weight, beside)
        for axis in state.axes:
            angle, gains = x[axis.state], axis.gains
            wanted = reference[axis.reference]
            slopes = _derivatives(axis, wanted) if self.reference_rates else (0.0, 0.0)
            goal, forward = _guided(axis, wanted, slopes)
            behind = angle - goal if axis.reference_rate else angle
            axis.derivative = axis.keep * axis.derivative - axis.derivative_gain * (
                behind - axis.last_error
            )
            axis.last_error = behind
            terms = gains.kp * (weight * goal - angle) + axis.integral + axis.derivative
            if axis.friction is not None:
                along = axis.friction.at(axis.guide[1])
                closing = axis.friction.at(axis.guide[1] + (goal - angle) / _CLOSING)
                terms += along + _FOR_CLOSING * (closing - along)
            ahead = forward - axis.forward_lag
            axis.forward = forward
            axis.forward_rate = ahead / self.lead_filter
            axis.forward_lag += axis.step / (axis.step + self.lead_filter) * ahead
            demand = forward + terms + _from_others(state.axes, axis)
            u[axis.channel], torque = _through_rotor(axis, demand)
            axis.integral += gains.ki * axis.step * (goal - angle)
            axis.integral += axis.tracking * (torque - demand)
        return Command(u)


def _from_others(axes: list[AxisState], axis: AxisState) -> float:
    """Torque that undoes what the torques fed forward to the axes before this one do to it, N m."""
    rates = burdens = 0.0
    for other, strength, burden in zip(axes, axis.coupling, axis.burdens, strict=False):
        rates += strength * other.forward_rate
        burdens += burden.at(other.forward)
    return rates + burdens


def _through_rotor(axis: AxisState, demand: float) -> tuple[float, float]:
    """The input for a torque asked for, V, and the torque to which limits cut that, N m."""
    volts, least, most = axis.curve.at(demand), axis.curve.y[0], axis.curve.y[-1]
    axis.lagged = volts + axis.slow * (axis.lagged - volts)
    uncut = axis.lagged + axis.lead * (volts - axis.lagged)
    u = min(max(uncut, least), most)
    if u != uncut:
        return u, axis.torque_of.at(axis.lagged + (u - axis.lagged) / axis.lead)
    return u, min(max(demand, axis.least), axis.most)


def _derivatives(axis: AxisState, reference: float) -> tuple[float, float]:
    """Rate and acceleration of the reference, rad/s and rad/s².

    Where it moves as no torque of the rotor could move the axis, the rate is that before, and 0 if
    that goes on.
    """
    last, axis.last_reference = axis.last_reference, reference
    if math.isnan(last):
        return 0.0, 0.0
    rate = (reference - last) / axis.step
    acceleration = (rate - axis.reference_difference) / axis.step
    axis.reference_difference = rate
    if abs(axis.inverse[1] * acceleration) <= axis.most - axis.least:
        axis.jumping, axis.followed_rate = 0, rate
        return rate, acceleration
    axis.jumping += 1
    if axis.jumping > _JUMP:
        axis.followed_rate = 0.0
    return axis.followed_rate, 0.0


def _guided(
    axis: AxisState, reference: float, slopes: tuple[float, float] = (0.0, 0.0)
) -> tuple[float, float]:
    """The reference that the axis can follow, and the torque fed forward for it.

    Advances the reference's filter, with its jerk cut so that the torque stays within the
    rotor's. ``slopes``: rate and acceleration with which the reference moves, rad/s and rad/s².
    """
    f, T, (y, rate, acceleration) = axis.reference_rate, axis.step, axis.guide
    if not f:
        return reference, axis.holding.at(reference) if axis.holding is not None else 0.0
    jerk = f * (f * (f * (reference - y) + 3 * (slopes[0] - rate)) + 3 * (slopes[1] - acceleration))
    forward = 0.0
    if axis.holding is not None:
        c1, c2, c3 = axis.inverse
        held = axis.holding.at(y)
        calm = held + c1 * rate + c2 * acceleration
        if c3 > 0:
            least = min(_FOR_REFERENCE * axis.least, held + _AT_LEAST * (axis.least - held))
            most = max(_FOR_REFERENCE * axis.most, held + _AT_LEAST * (axis.most - held))
            jerk = min(max(jerk, (least - calm) / c3), (most - calm) / c3)
        a1, a2, a3 = axis.ahead
        forward = held + a1 * rate + a2 * acceleration + a3 * jerk
    for i, memory in enumerate(axis.memories):
        value = axis.remembered[i]
        forward += memory.torque.at(value)
        change = memory.rise if rate > 0 else memory.fall
        axis.remembered[i] = min(max(value + T * rate * change.at(value), -1.0), 1.0)
    acceleration += T * jerk
    rate += T * acceleration
    axis.guide = (y + T * rate, rate, acceleration)
    return y, forward


def _start(axis: AxisState, angle: float, command: float, weight: float, beside: float) -> None:
    """Bumpless: if the reference were where the rig is, the command in force would go on.

    ``beside``: torque fed forward for other axes, N m.
    """
    at_rest = (angle, 0.0, 0.0)
    axis.guide = at_rest
    forward = _guided(axis, angle)[1]
    axis.guide = at_rest
    axis.last_error = 0.0 if axis.reference_rate else angle
    axis.forward = axis.forward_lag = forward
    axis.lagged = command
    axis.integral = axis.torque_of.at(command) - forward - beside
    axis.integral -= axis.gains.kp * (weight - 1) * angle
