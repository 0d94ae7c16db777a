"""Cogging of an axis: a force that returns along its way, as of a motor's teeth or a lead screw.

``τ = −a sin(2π α/L) − b cos(2π α/L)`` with the period L of the way.
"""

import math
from dataclasses import dataclass
from typing import Annotated

import casadi as ca
from msgspec import Meta

from trms_cli.core.ranges import Positive
from trms_cli.effects.effect import Effect, EffectContext
from trms_cli.models.parameters import Parameter

_Signed = Annotated[float, Meta(ge=-1e6, le=1e6)]


@dataclass(frozen=True, kw_only=True)
class Cogging(Effect):
    """A periodic force."""

    axis: str  #: Name of an axis of the model
    sine: _Signed | None = None  #: a, N m
    cosine: _Signed = 0.0  #: b, N m
    period: Positive | None = None  #: L, rad

    def parameters(self) -> tuple[Parameter, ...]:
        return (
            self.size("sine", "N*m", (-0.01, 0.01), "amplitude a of the sine"),
            self.size("cosine", "N*m", (-0.01, 0.01), "amplitude b of the cosine"),
            self.size("period", "rad", (0.05, 0.5), "period L of the way"),
        )

    def disturbance(self, at: EffectContext) -> ca.SX:
        phase = 2 * math.pi * at.angle(self.axis) / at.sizes["period"]
        force = at.sizes["sine"] * ca.sin(phase) + at.sizes["cosine"] * ca.cos(phase)
        return at.on(at.axis(self.axis).moment, -force)
