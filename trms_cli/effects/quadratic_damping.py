"""Quadratic damping of an axis: air drag of the moving beam, ``τ = −c Ω|Ω|``."""

from dataclasses import dataclass

import casadi as ca

from trms_cli.core.ranges import NotNegative
from trms_cli.effects.effect import Effect, EffectContext
from trms_cli.models.parameters import Parameter


@dataclass(frozen=True, kw_only=True)
class QuadraticDamping(Effect):
    """Damping that grows with the square of the rate."""

    axis: str  #: Name of an axis of the model
    coefficient: NotNegative | None = None  #: c, N m s²/rad²

    def parameters(self) -> tuple[Parameter, ...]:
        return (self.size("coefficient", "N*m*s^2/rad^2", (0.002, 0.02), "damping coefficient c"),)

    def disturbance(self, at: EffectContext) -> ca.SX:
        rate = at.rate(self.axis)
        torque = -at.sizes["coefficient"] * rate * ca.fabs(rate)
        return at.on(at.axis(self.axis).moment, torque)
