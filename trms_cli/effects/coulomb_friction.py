"""Coulomb friction of an axis: a constant torque against the motion, set-valued at rest.

``τ = −F_c sgn(Ω)`` while the axis turns; at rest any torque in [−F_c, F_c] that keeps it there.
"""

from dataclasses import dataclass

import casadi as ca

from trms_cli.core.ranges import NotNegative
from trms_cli.effects.effect import Effect, EffectContext, resisting_impulse
from trms_cli.models.parameters import Parameter


@dataclass(frozen=True, kw_only=True)
class CoulombFriction(Effect):
    """Coulomb friction."""

    axis: str  #: Name of an axis of the model
    torque: NotNegative | None = None  #: F_c, N m

    def parameters(self) -> tuple[Parameter, ...]:
        return (self.size("torque", "N*m", (0.002, 0.02), "Coulomb torque F_c"),)

    def impulse(self, at: EffectContext, duration: float) -> ca.SX:
        return resisting_impulse(at, self.axis, at.sizes["torque"], duration)
