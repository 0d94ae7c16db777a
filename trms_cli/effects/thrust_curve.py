"""Thrust that does not go with the square of the speed, or differs more by direction.

The model's thrust F(ω) is multiplied by a power of the speed, and by another factor in reverse::

    F′(ω) = F(ω) (|ω|/ω₀)ᵉ          ω ≥ 0
    F′(ω) = F(ω) (|ω|/ω₀)ᵉ (1 + r)  ω < 0

At the speed ω₀ the power changes nothing, so that ω₀ is where the model's coefficient was measured.
"""

from dataclasses import dataclass
from typing import Annotated

import casadi as ca
from msgspec import Meta

from trms_cli.core.ranges import Positive
from trms_cli.effects.effect import EffectContext
from trms_cli.effects.thrust import ThrustEffect
from trms_cli.models.parameters import Parameter

#: rad/s: below it the power no longer changes, or its derivative at zero would be infinite.
_SLOWEST = 1e-3


@dataclass(frozen=True, kw_only=True)
class ThrustCurve(ThrustEffect):
    """Another law of one rotor's thrust."""

    rotor: str  #: Name of a rotor of the model
    exponent: Annotated[float, Meta(ge=-1, le=1)]  #: e, added to the model's exponent (of about 2)
    #: r, share by which the thrust in reverse differs from the model's
    reverse: Annotated[float, Meta(ge=-1, le=1)]
    reference: Positive  #: ω₀, rad/s

    def parameters(self) -> tuple[Parameter, ...]:
        return (
            self.size("exponent", "1", (-0.3, 0.3), "e, beyond the model's exponent"),
            self.size("reverse", "1", (-0.3, 0.3), "r, share of the thrust in reverse"),
        )

    def disturbance(self, at: EffectContext) -> ca.SX:
        omega = at.speed(self.rotor)
        relative = ca.fmax(ca.fabs(omega), _SLOWEST) / self.reference
        direction = 1 + at.sizes["reverse"] * (omega < 0)
        factor = ca.exp(at.sizes["exponent"] * ca.log(relative)) * direction
        return self.torque(at, at.quantity(f"thrust_{self.rotor}") * (factor - 1))
