"""Ground effect: near the table the main rotor thrusts more.

``F′ = F (1 + g exp(−h/h₀))`` while it blows down, with its height over the table
``h = h_level + ℓ sin α``.
"""

from dataclasses import dataclass
from typing import Annotated, ClassVar

import casadi as ca
from msgspec import Meta

from trms_cli.core.ranges import NotNegative
from trms_cli.effects.effect import EffectContext
from trms_cli.effects.thrust import ThrustEffect
from trms_cli.models.parameters import Parameter

#: m: a thinner cushion would be a step for the integrator.
_THINNEST = 1e-2


@dataclass(frozen=True, kw_only=True)
class GroundEffect(ThrustEffect):
    """Cushion of air under the main rotor."""

    may_begin: ClassVar[bool] = False

    rotor = "main"

    gain: NotNegative  #: g: share of the thrust that is added at the table itself
    scale: Annotated[float, Meta(ge=_THINNEST)]  #: h₀, m: height over which it falls to 1/e
    #: h_level, m: height of the rotor over the table with the beam level
    level_height: NotNegative

    def parameters(self) -> tuple[Parameter, ...]:
        return (
            self.size("gain", "1", (0.1, 0.6), "g, at the table"),
            self.size("scale", "m", (0.03, 0.2), "height h₀ of the cushion"),
        )

    def disturbance(self, at: EffectContext) -> ca.SX:
        height = self.level_height + at.quantity("arm_main") * ca.sin(at.angle("pitch"))
        thrust = ca.fmax(at.quantity("thrust_main"), 0)
        more = at.sizes["gain"] * ca.exp(-height / at.sizes["scale"])
        return self.torque(at, thrust * more)
