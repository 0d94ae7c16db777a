"""A flexible mode between the beam and the sensor: a lightly damped oscillator in series.

What the encoder sits on hangs on the axis by a spring of its own; its deflection δ is driven by the
acceleration of the axis, as that of a mass on a moving base::

    δ̈ + 2 ζ ω₀ δ̇ + ω₀² δ = −α̈        y = α + c δ

With c = 1 the whole of it is seen, y/α = (2ζω₀ s + ω₀²)/(s² + 2ζω₀ s + ω₀²). The angle is taken as
linear in time over each integration step, for which the oscillator is solved exactly: no frequency
is too high for the step.
"""

import math
from dataclasses import dataclass
from typing import Annotated

import casadi as ca
from msgspec import Meta

from trms_cli.effects.effect import EffectContext, SensorEffect
from trms_cli.models.model import Signal, Window
from trms_cli.models.parameters import Parameter

#: Hz: a slower mode is a motion of the rig; and at zero it would not exist.
_SLOWEST = 0.1


@dataclass(frozen=True, kw_only=True)
class FlexibleMode(SensorEffect):
    """A flexible mode in one measured angle."""

    axis: str  #: Name of an axis of the model, or of an output
    #: c: how much of the deflection is seen
    share: Annotated[float, Meta(ge=0, le=10)] | None = None
    frequency: Annotated[float, Meta(ge=_SLOWEST)] | None = None  #: ω₀/2π, Hz
    damping: Annotated[float, Meta(ge=0, le=0.9)] | None = None  #: ζ

    def parameters(self) -> tuple[Parameter, ...]:
        return (
            self.size("share", "1", (0.2, 2.0), "share c seen"),
            self.size("frequency", "Hz", (2.0, 12.0), "frequency ω₀/2π"),
            self.size("damping", "1", (0.01, 0.05), "damping ratio ζ"),
        )

    def sensor_memory(self, step: float) -> tuple[Signal, ...]:
        return (
            Signal("deflection", "rad", "deflection δ of the mode"),
            Signal("rate", "rad/s", "rate of the mode's own angle α + δ"),
        )

    def sensor_path(
        self, at: EffectContext, before: ca.SX, after: ca.SX, window: Window, step: float
    ) -> ca.SX:
        row = self.row(at.model)
        duration = (window[1] - window[0]) * step
        axis_rate = (after[row] - before[row]) / duration
        deflection, slope = at.sensor_memory[0], at.sensor_memory[1] - axis_rate
        # δ̈ + 2 ζ ω₀ δ̇ + ω₀² δ = 0 from here to the end of the part.
        zeta, natural = at.sizes["damping"], 2 * math.pi * at.sizes["frequency"]
        damped = natural * ca.sqrt(1 - zeta**2)
        decay = ca.exp(-zeta * natural * duration)
        cosine, sine = ca.cos(damped * duration), ca.sin(damped * duration) / damped
        damping_term = zeta * natural * sine
        return ca.vertcat(
            decay * (deflection * (cosine + damping_term) + slope * sine),
            decay * (slope * (cosine - damping_term) - deflection * natural**2 * sine) + axis_rate,
        )

    def reading(self, at: EffectContext, y: ca.SX, step: float, since: float) -> ca.SX:
        return self.add_to_channel(at, y, at.sizes["share"] * at.sensor_memory[0])
