"""Coulomb friction of a rotor: brushes and bearing hold it until the motor is stronger.

``τ = −F_c sgn(ω)`` on the rotor while it turns; at rest any torque in [−F_c, F_c] that keeps it
there, by the same impulses as the friction of an axis (:mod:`trms_cli.models.dry_friction`).
"""

from dataclasses import dataclass

import casadi as ca

from trms_cli.core.ranges import NotNegative
from trms_cli.effects.effect import (
    Effect,
    EffectContext,
    motor_disturbance,
    resisting_impulse,
    speed_row,
)
from trms_cli.models.model import Model
from trms_cli.models.parameters import Parameter


@dataclass(frozen=True, kw_only=True)
class RotorFriction(Effect):
    """Coulomb friction of one rotor."""

    rotor: str  #: Name of a rotor of the model
    torque: NotNegative  #: F_c, N m

    def parameters(self) -> tuple[Parameter, ...]:
        return (self.size("torque", "N*m", (0.0005, 0.002), "Coulomb torque F_c"),)

    def check(self, model: Model) -> None:
        speed_row(model, self.rotor)
        motor_disturbance(model, self.rotor)

    def impulse(self, at: EffectContext, duration: float) -> ca.SX:
        return resisting_impulse(at, self.rotor, at.sizes["torque"], duration)
