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

import casadi as ca
import numpy as np
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
from trms_cli.controllers.pid_feed_forward import ROTOR_OF_AXIS
from trms_cli.controllers.pid_law import AxisLaw, LawLayout, law
from trms_cli.controllers.pid_tuning import AxisMargins, Gains
from trms_cli.core.arrays import FloatArray
from trms_cli.core.compilation import BufferedFunction
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import require_known
from trms_cli.core.ranges import NotNegative, Positive
from trms_cli.models.model import Model

#: Keys that are times, s.
_TIMES = ("derivative_filter", "lead_filter", "reference_lag", "tracking_time", "sample_time")


@dataclass
class PidState:
    """All axes."""

    axes: tuple[AxisLaw, ...]
    #: Robustness of each axis' loop, the worst of the operating points
    margins: Mapping[str, AxisMargins]
    sample: BufferedFunction  #: Of the law, with arrays of its own; see :func:`.pid_law.law`
    begin: ca.Function  #: What is remembered at first
    has_begun: bool = False

    @property
    def remembered(self) -> FloatArray:
        """What the law remembers; see :data:`trms_cli.controllers.pid_law.STATE`."""
        return self.sample.inputs[3]


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
        given = {name: getattr(self, name) for name in _TIMES}
        loops = {"pitch": self.pitch, "yaw": self.yaw}
        for key, gains in (loops | {f"loops.{axis}": g for axis, g in self.loops.items()}).items():
            if isinstance(gains, Gains):
                given |= {f"{key}.{name}": getattr(gains, name) for name in ("kp", "ki", "kd")}
        for name, value in given.items():
            if value is not None and not math.isfinite(value):
                raise ConfigurationError(
                    f"{value!r} given", where=name, remedy="give a number that is not infinite"
                )
        for axis, gains in loops.items():
            if axis in self.loops and isinstance(gains, Gains):
                raise ConfigurationError(
                    f"the gains of {axis} are given twice, as {axis} and in loops",
                    where=f"loops.{axis}",
                    remedy="leave one of them out",
                )

    def init(self, setup: ControlSetup) -> PidState:
        model, T = setup.model, setup.sample_time
        for key, entries in (("smoothness", self.smoothness), ("loops", self.loops)):
            for name in entries:
                if name not in ROTOR_OF_AXIS:
                    known = model.axes or ROTOR_OF_AXIS
                    require_known(name, known, f"{name!r} is not an axis", f"controller.{key}")
        self._check_names(model)
        designs = PidDesign(
            requested_gains={"pitch": self.pitch, "yaw": self.yaw, **self.loops},
            operating_points=self.operating_points,
            max_sensitivity=self.max_sensitivity,
            smoothness=self.smoothness,
            derivative_filter=self.derivative_filter,
            lead_filter=self.lead_filter,
        ).of(model, T)
        axes = tuple(self._axis(model, design, T) for design in designs.values())
        sizes = (model.n_x, len(model.controlled), model.n_u)
        layout = LawLayout(sizes, tuple(axis.layout for axis in axes), self.reference_rates)
        functions = law(layout)
        sample = BufferedFunction(functions["sample"])
        sample.inputs[4][:] = np.concatenate([axis.numbers() for axis in axes])
        margins = {name: design.margins for name, design in designs.items()}
        return PidState(axes, margins, sample, functions["begin"])

    def _check_names(self, model: Model) -> None:
        """Refuse gains and angles of what the model does not have."""
        for axis in ("pitch", "yaw"):
            if isinstance(getattr(self, axis), Gains) and model.axes and axis not in model.axes:
                words = f"{model.name} has no axis {axis!r}"
                require_known(axis, model.axes, words, f"controller.{axis}")
        # Those that are not typed are the TRMS's, and ignored by any other rig.
        if model.bench_sizes or self.operating_points == Pid.operating_points:
            return
        for i, point in enumerate(self.operating_points):
            for name in point:
                words = f"{name!r} is not controlled"
                where = f"controller.operating_points[{i}]"
                require_known(name, model.controlled, words, where)

    def _axis(self, model: Model, design: AxisDesign, T: float) -> AxisLaw:
        gains, filters, curve = design.gains, design.filters, design.curve
        keep = filters.derivative / (filters.derivative + T)
        tracking = self.tracking_time
        if tracking is None:
            # Without an integral or a derivative the gains have no time of their own.
            tracking = math.sqrt(gains.kd / gains.ki) if gains.ki and gains.kd else 1.0
        lag = self.reference_lag
        if lag is None:
            lag = max(design.rotor_lag, 10 * T)
        feeds = self.feed_forward
        return AxisLaw(
            state=model.state_index(design.angle),
            reference=model.controlled.index(design.angle),
            channel=design.channel,
            gains=gains,
            step=T,
            weight=self.setpoint_weight,
            curve=curve,
            holding=design.holding if feeds else None,
            friction=design.friction if feeds else None,
            inverse=design.inverse[1:],
            ahead=design.forward[1:],
            memories=design.memories if feeds else (),
            keep=keep,
            derivative_gain=gains.kd * (1 - keep) / T,
            tracking=min(1.0, T / tracking * filters.ratio),
            coupling=design.coupling if feeds else (),
            burdens=design.burdens if feeds else (),
            lead=filters.ratio,
            slow=filters.lead_filter / (filters.lead_filter + T),
            lead_filter=self.lead_filter,
            reference_rate=1 / lag if lag > 0 else 0.0,
        )

    def step(self, state: PidState, sample: ControlSample, *, want_prediction: bool) -> Command:
        x, reference, u, remembered, numbers = state.sample.inputs
        x[:] = sample.estimate.x
        reference[:] = sample.reference[0]
        u[:] = sample.previous_command
        if not state.has_begun and np.isfinite(x).all() and np.isfinite(reference).all():
            remembered[:] = np.array(state.begin(x, u, numbers))[:, 0]
            state.has_begun = True
        state.sample()
        command, following, health = state.sample.outputs
        if not math.isfinite(health[0]):
            return hold_command(u.copy(), NOT_FINITE)
        remembered[:] = following
        return Command(command.copy())
