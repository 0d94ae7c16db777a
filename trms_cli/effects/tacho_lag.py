"""Lag of a tacho: the measured speed of a rotor is filtered, ``τ ẏ = ω − y``.

The speed is taken as linear in time over each integration step, for which the filter is solved
exactly; no time constant is too short.
"""

from dataclasses import dataclass

import casadi as ca

from trms_cli.core.ranges import NotNegative
from trms_cli.effects.effect import EffectContext, SensorEffect
from trms_cli.effects.first_order import first_order_ramp
from trms_cli.models.model import Signal, Window
from trms_cli.models.parameters import Parameter


@dataclass(frozen=True, kw_only=True)
class TachoLag(SensorEffect):
    """Low-pass filter of one measured rotor speed."""

    rotor: str  #: Name of a rotor of the model, or of an output
    time_constant: NotNegative | None = None  #: τ, s

    def parameters(self) -> tuple[Parameter, ...]:
        return (self.size("time_constant", "s", (0.005, 0.1), "time constant τ"),)

    def sensor_memory(self, step: float) -> tuple[Signal, ...]:
        return (Signal("lag", "rad", "what is shown less what is there"),)

    def sensor_path(
        self, at: EffectContext, before: ca.SX, after: ca.SX, window: Window, step: float
    ) -> ca.SX:
        row = self.row(at.model)
        duration = (window[1] - window[0]) * step
        return first_order_ramp(
            at.sensor_memory, after[row] - before[row], at.sizes["time_constant"], duration
        )

    def reading(self, at: EffectContext, y: ca.SX, step: float, since: float) -> ca.SX:
        return self.add_to_channel(at, y, at.sensor_memory[0])
