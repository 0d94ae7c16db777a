"""Decentralised PID: the main rotor holds pitch, the tail rotor holds yaw.

For each axis, with reference r, angle α and control period T,

    e = r̃ − α
    v = k_p (b r̃ − α) + I + D
    m = m_ff + (1 + τ s)/(1 + τ_f s) v      torque asked for, cut to what the rotor has
    u = φ(m)                                φ: the input that gives a torque in steady state
    I⁺ = I + k_i T e + (T/T_t)(m_cut − m)   back-calculation against windup
    D  = a D₋ + k_d (1 − a)/T (e − e₋)      a = T_f/(T_f + T)

after Åström & Murray, "Feedback Systems", ch. 11 and 12.5, with what a rig of rotors needs:

- The inverse φ of the rotor's curve (:mod:`trms_cli.controllers.pid_feed_forward`) takes the
  square of the propeller out of the loop. Gains are thus in N m, not in V.
- The lead makes up for the rotor's lag τ.
- r̃ is the reference behind three equal lags. Its derivatives are known without differencing, and

      m_ff = h(r̃) + c_1 dr̃/dt + c_2 d²r̃/dt² + c_3 d³r̃/dt³

  is the torque with which the model follows it: h what holds the axis there, c the inverse of its
  linear dynamics, rotor included. The third derivative is cut so that m_ff stays within the
  rotor's torque: r̃ never asks for what cannot be followed. As r̃ is smooth, D may act on r̃ − α
  without a kick; with ``reference_lag=0`` there is no r̃ to differentiate, and D acts on −α.
- Of a model with dry friction, v has the friction of the rate that the axis is to have, r̃'s and
  e/5 s. Without it an axis that stops short of its reference waits until the integral has grown
  over the friction; with it, and inside the friction's cone, it gets there or stays.
- A rotor that speeds up turns the rig the other way round. Yaw is told what the torque fed forward
  to pitch will do to it: d m_ff,pitch/dt, times a number from the model. Nothing measured passes
  from one axis to the other, so that this cannot make the loops unstable.

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
from trms_cli.controllers.pid_feed_forward import ROTOR_OF_AXIS, PiecewiseLinear
from trms_cli.controllers.pid_tuning import AxisDesign, AxisMargins, Gains, PidDesign
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import require_known
from trms_cli.core.ranges import NotNegative, Positive
from trms_cli.models.model import Model

#: s in which an axis that friction stopped beside its reference is to get there.
_CLOSING = 5.0


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
    keep: float  #: a, the share that the filter of D keeps
    derivative_gain: float  #: k_d (1 − a)/T
    tracking: float  #: T/T_t, at most τ_f/τ
    coupling: list[float]  #: Torque by the rate of m_ff of each axis before this one, s
    #: ``lead``, ``slow``: τ/τ_f, and the part that the lead's lag keeps over a period
    lead: float
    slow: float
    reference_rate: float  #: One over the reference's lag, 1/s; 0 for none
    least: float  #: Torque at the lower limit of the input, N m
    most: float  #: At the upper one, N m
    integral: float = 0.0  #: I, N m
    derivative: float = 0.0  #: D, N m
    lagged: float = 0.0  #: v behind τ_f, N m
    forward_lag: float = 0.0  #: m_ff behind τ_f, N m
    forward_rate: float = 0.0  #: and so its rate, N m/s
    last_error: float = math.nan  #: α − r̃ (or α), rad; NaN before the first sample
    #: r̃ and its two derivatives, rad, rad/s, rad/s²
    guide: tuple[float, float, float] = (0.0, 0.0, 0.0)


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
        for name in self.smoothness:
            require_known(name, ROTOR_OF_AXIS, f"{name!r} is not an axis", "smoothness")

    def init(self, setup: ControlSetup) -> PidState:
        model, T = setup.model, setup.sample_time
        designs = PidDesign(
            requested_gains={"pitch": self.pitch, "yaw": self.yaw},
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
            keep=keep,
            derivative_gain=gains.kd * (1 - keep) / T,
            tracking=min(1.0 / filters.ratio, T / tracking),
            coupling=list(design.coupling) if self.feed_forward else [],
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
        for axis in state.axes:
            angle, gains = x[axis.state], axis.gains
            if math.isnan(axis.last_error):
                _start(axis, angle, float(u[axis.channel]), weight)
            goal, forward = _guided(axis, reference[axis.reference])
            behind = angle - goal if axis.reference_rate else angle
            axis.derivative = axis.keep * axis.derivative - axis.derivative_gain * (
                behind - axis.last_error
            )
            axis.last_error = behind
            terms = gains.kp * (weight * goal - angle) + axis.integral + axis.derivative
            if axis.friction is not None:
                terms += axis.friction.at(axis.guide[1] + (goal - angle) / _CLOSING)
            axis.lagged = terms + axis.slow * (axis.lagged - terms)
            ahead = forward - axis.forward_lag
            axis.forward_rate = ahead / self.lead_filter
            axis.forward_lag += axis.step / (axis.step + self.lead_filter) * ahead
            for other, strength in zip(state.axes, axis.coupling, strict=False):
                forward += strength * other.forward_rate
            demand = forward + axis.lagged + axis.lead * (terms - axis.lagged)
            torque = min(max(demand, axis.least), axis.most)
            axis.integral += gains.ki * axis.step * (goal - angle)
            axis.integral += axis.tracking * (torque - demand)
            u[axis.channel] = axis.curve.at(torque)
        return Command(u)


def _guided(axis: AxisState, reference: float) -> tuple[float, float]:
    """The reference that the axis can follow, and the torque fed forward for it.

    Advances the reference's filter, with its jerk cut so that the torque stays within the
    rotor's.
    """
    f, T, (y, rate, acceleration) = axis.reference_rate, axis.step, axis.guide
    if not f:
        return reference, axis.holding.at(reference) if axis.holding is not None else 0.0
    jerk = f * (f * (f * (reference - y) - 3 * rate) - 3 * acceleration)
    forward = 0.0
    if axis.holding is not None:
        c1, c2, c3 = axis.inverse
        calm = axis.holding.at(y) + c1 * rate + c2 * acceleration
        if c3 > 0:
            jerk = min(max(jerk, (axis.least - calm) / c3), (axis.most - calm) / c3)
        forward = calm + c3 * jerk
    acceleration += T * jerk
    rate += T * acceleration
    axis.guide = (y + T * rate, rate, acceleration)
    return y, forward


def _start(axis: AxisState, angle: float, command: float, weight: float) -> None:
    """Bumpless: if the reference were where the rig is, the command in force would go on."""
    at_rest = (angle, 0.0, 0.0)
    axis.guide = at_rest
    forward = _guided(axis, angle)[1]
    axis.guide = at_rest
    axis.last_error = 0.0 if axis.reference_rate else angle
    axis.forward_lag = forward
    axis.lagged = axis.torque_of.at(command) - forward
    axis.integral = axis.lagged - axis.gains.kp * (weight - 1) * angle
