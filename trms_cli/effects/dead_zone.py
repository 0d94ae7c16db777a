"""Dead zone of a rotor's drive: a command below a size has no effect.

``v = u − clip(u, −d, d)``: what is beyond the dead zone reaches the motor, less its width (a drive
that needs ``d`` before it moves), so that the drive stays continuous.
"""

from dataclasses import dataclass

import casadi as ca

from trms_cli.core.ranges import NotNegative
from trms_cli.effects.effect import EffectContext, InputEffect
from trms_cli.models.parameters import Parameter


@dataclass(frozen=True, kw_only=True)
class DeadZone(InputEffect):
    """Dead zone of one command."""

    width: NotNegative | None = None  #: d, V: to either side of zero

    def parameters(self) -> tuple[Parameter, ...]:
        return (self.size("width", "V", (0.025, 0.15), "half width d"),)

    def command(self, at: EffectContext, u: ca.SX, duration: float) -> tuple[ca.SX, ca.SX]:
        width = at.sizes["width"]
        return u - ca.fmin(ca.fmax(u, -width), width), at.own
