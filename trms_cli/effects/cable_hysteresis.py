"""Hysteresis of the cable of an axis: a torque that remembers where it came from.

Bouc–Wen (Bouc 1967; Wen 1976, J. Eng. Mech. Div. 102; Ismail, Ikhouane & Rodellar 2009, Arch.
Comput. Methods Eng. 16), normalised so that the memory ``z`` stays in [−1, 1]::

    τ = −T z        ż = [Ω − β |Ω| |z|ⁿ⁻¹ z − (1 − β) Ω |z|ⁿ] / width

It depends on the path of the angle and not on the speed at which it is travelled. At small strokes
it is a spring of stiffness ``T/width``, at large ones a friction of ``T``. With ``1/2 ≤ β ≤ 1`` it
takes energy out of every closed cycle.
"""

from dataclasses import dataclass
from typing import Annotated

import casadi as ca
from msgspec import Meta

from trms_cli.core.ranges import NotNegative
from trms_cli.effects.effect import Effect, EffectContext
from trms_cli.models.model import Signal
from trms_cli.models.parameters import Parameter

#: rad: narrower loops would be stiffer than any integration step allows.
_NARROWEST = 1e-3


@dataclass(frozen=True, kw_only=True)
class CableHysteresis(Effect):
    """Bouc–Wen hysteresis."""

    axis: str  #: Name of an axis of the model
    torque: NotNegative | None = None  #: T, N m: half the height of the loop
    #: rad: the travel after a reversal over which the torque turns
    width: Annotated[float, Meta(ge=_NARROWEST)] | None = None
    #: β: 1/2 unloads along a straight line, 1 along the same exponential as it loads (Dahl)
    beta: Annotated[float, Meta(ge=0.5, le=1)] = 0.5
    exponent: Annotated[float, Meta(ge=1)] = 1.0  #: n: how sharply the loop bends into saturation

    def parameters(self) -> tuple[Parameter, ...]:
        return (
            self.size("torque", "N*m", (0.002, 0.01), "half height T"),
            self.size("width", "rad", (0.05, 0.3), "turning travel"),
        )

    def states(self) -> tuple[Signal, ...]:
        share = "share of the hysteresis torque, −1 to 1"
        return (Signal("memory", "1", share, path_memory=True),)

    def derivative(self, at: EffectContext) -> ca.SX:
        rate, z = at.rate(self.axis), at.own[0]
        fullness = ca.fabs(z) ** self.exponent
        # |z|ⁿ⁻¹ z is written by the sign: a power n − 1 < 1 has no derivative at zero.
        against = self.beta * ca.fabs(rate) * fullness * ca.sign(z)
        return (rate - against - (1 - self.beta) * rate * fullness) / at.sizes["width"]

    def disturbance(self, at: EffectContext) -> ca.SX:
        return at.on(at.axis(self.axis).moment, -at.sizes["torque"] * at.own[0])
