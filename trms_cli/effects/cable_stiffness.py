"""Stiffness of the cable that an axis drags along, beyond what the model has of it.

``τ = −k (α − α₀) − k₃ (α − α₀)³``: the cubic part is a cable that tightens towards the ends of its
travel; ``α₀`` is where it hangs free.
"""

from dataclasses import dataclass
from typing import Annotated

import casadi as ca
from msgspec import Meta

from trms_cli.core.ranges import NotNegative
from trms_cli.effects.effect import Effect, EffectContext
from trms_cli.models.parameters import Parameter


@dataclass(frozen=True, kw_only=True)
class CableStiffness(Effect):
    """A spring that may harden."""

    axis: str  #: Name of an axis of the model
    stiffness: NotNegative | None = None  #: k, N m/rad
    cubic: NotNegative = 0.0  #: k₃, N m/rad³
    neutral: Annotated[float, Meta(ge=-3.2, le=3.2)] = 0.0  #: α₀, rad

    def parameters(self) -> tuple[Parameter, ...]:
        return (
            self.size("stiffness", "N*m/rad", (0.002, 0.02), "k"),
            self.size("cubic", "N*m/rad^3", (0.0, 0.01), "k₃"),
            self.size("neutral", "rad", (-0.3, 0.3), "free angle α₀"),
        )

    def disturbance(self, at: EffectContext) -> ca.SX:
        stretch = at.angle(self.axis) - at.sizes["neutral"]
        torque = -at.sizes["stiffness"] * stretch - at.sizes["cubic"] * stretch**3
        return at.on(at.axis(self.axis).moment, torque)
