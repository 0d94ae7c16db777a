"""Dead zone of a rotor's drive: a command below a size has no effect.

``v = u − clip(u, −d, d)``: what is beyond the dead zone reaches the motor, less its width (a drive
that needs ``d`` before it moves), so that the drive stays continuous.
"""

from dataclasses import dataclass

import casadi as ca

from trms_cli.core.ranges import NotNegative
from trms_cli.effects.effect import Effect, EffectContext, rotor_input
from trms_cli.models.model import Window
from trms_cli.models.parameters import Parameter


@dataclass(frozen=True, kw_only=True)
class DeadZone(Effect):
    """Dead zone of one command."""

    rotor: str  #: Name of a rotor of the model, or of an input
    width: NotNegative | None = None  #: d, V: to either side of zero

    def parameters(self) -> tuple[Parameter, ...]:
        return (self.size("width", "V", (0.025, 0.15), "half width d"),)

    def input_path(self, at: EffectContext, window: Window, step: float) -> tuple[ca.SX, ca.SX]:
        channel = rotor_input(at.model, self.rotor)
        width = at.sizes["width"]
        u = ca.SX(at.u)
        u[channel] = u[channel] - ca.fmin(ca.fmax(u[channel], -width), width)
        return u, at.own
