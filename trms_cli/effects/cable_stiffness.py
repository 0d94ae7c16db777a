"""Stiffness of the cable that an axis drags along, beyond what the model has of it.

``τ = −k (α − α₀) − k₃ (α − α₀)³``: the cubic part is a cable that tightens towards the ends of its
travel; ``α₀`` is where it hangs free.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import casadi as ca
from msgspec import Meta

from trms_cli.core.ranges import NotNegative
from trms_cli.effects.effect import Effect, EffectContext, axis_of
from trms_cli.models.model import Model
from trms_cli.models.parameters import Parameter


@dataclass(frozen=True, kw_only=True)
class CableStiffness(Effect):
    """A spring that may harden."""

    axis: Literal["pitch", "yaw"]
    stiffness: NotNegative  #: k, N m/rad
    cubic: NotNegative = 0.0  #: k₃, N m/rad³
    neutral: Annotated[float, Meta(ge=-3.2, le=3.2)] = 0.0  #: α₀, rad

    def parameters(self) -> tuple[Parameter, ...]:
        return (
            Parameter(
                "stiffness",
                self.stiffness,
                "N*m/rad",
                lower=0.0,
                typical=(0.002, 0.02),
                description="k",
            ),
            Parameter(
                "cubic", self.cubic, "N*m/rad^3", lower=0.0, typical=(0.0, 0.01), description="k₃"
            ),
            Parameter(
                "neutral",
                self.neutral,
                "rad",
                lower=-3.2,
                upper=3.2,
                typical=(-0.3, 0.3),
                description="free angle α₀",
            ),
        )

    def check(self, model: Model) -> None:
        axis_of(model, self.axis)

    def disturbance(self, at: EffectContext) -> ca.SX:
        stretch = at.angle(self.axis) - at.sizes["neutral"]
        torque = -at.sizes["stiffness"] * stretch - at.sizes["cubic"] * stretch**3
        return at.on(at.axis(self.axis).moment, torque)
