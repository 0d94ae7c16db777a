"""Stribeck friction of an axis: it takes more torque to break away than to keep turning.

::

    τ = −F(Ω) sgn(Ω),   F(Ω) = F_c (1 + e exp(−(Ω/v_s)²)),   |τ| ≤ F_c (1 + e) at rest

(Armstrong-Hélouvry, Dupont & Canudas de Wit 1994, Automatica 30). An impulse like Coulomb
friction, of the size that belongs to the mean rate of each integration step: exact at break-away,
without creep, of second order while the axis turns.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, ClassVar

import casadi as ca
from msgspec import Meta

from trms_cli.core.ranges import NotNegative
from trms_cli.effects.coulomb_friction import CoulombFriction
from trms_cli.effects.effect import Effect, EffectContext, resisting_impulse
from trms_cli.models.parameters import Parameter

#: Below this rate (rad/s) the falling branch would be too steep for any integration step.
_SLOWEST = 1e-3


@dataclass(frozen=True, kw_only=True)
class StribeckFriction(Effect):
    """Stribeck friction; with no excess it is Coulomb friction, bit for bit."""

    #: Bristles alone hold a tenth more at rest than they resist in motion, and do so while they
    #: bend: an excess that is gone at a few mrad/s is theirs
    special_case: ClassVar[tuple[type[Effect], Mapping[str, float]] | None] = (
        CoulombFriction,
        {"excess": 2.0, "velocity": 0.6},
    )

    axis: str  #: Name of an axis of the model
    torque: NotNegative | None = None  #: F_c, N m: friction of the turning axis
    excess: NotNegative | None = None  #: e = F_s/F_c − 1: break-away torque over it
    #: v_s, rad/s: rate at which the excess has fallen to 1/e
    velocity: Annotated[float, Meta(ge=_SLOWEST)] | None = None

    def parameters(self) -> tuple[Parameter, ...]:
        return (
            self.size("torque", "N*m", (0.002, 0.02), "Coulomb torque F_c"),
            self.size("excess", "1", (0.1, 1.0), "F_s/F_c − 1"),
            self.size("velocity", "rad/s", (0.01, 0.1), "Stribeck velocity v_s"),
        )

    def impulse(self, at: EffectContext, duration: float) -> ca.SX:
        torque, excess, velocity = (at.sizes[key] for key in ("torque", "excess", "velocity"))

        def friction(rate: ca.SX) -> ca.SX:
            return torque * (1 + excess * ca.exp(-((rate / velocity) ** 2)))

        return resisting_impulse(at, self.axis, friction, duration)
