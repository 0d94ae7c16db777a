"""Gyroscopic coupling of the axes by the angular momentum of the main rotor.

A rotor of inertia J whose axis leans by α + β from the vertical (α the pitch, β how far it leans
on the level beam) has the kinetic energy ``½ J (ω − Ω_yaw cos(α + β))²``. Lagrange's equations for
a speed ω that its motor governs give::

    τ_pitch =  J ω Ω_yaw   sin(α + β)
    τ_yaw   = −J ω Ω_pitch sin(α + β)

which together do no work. The sign of ω is that of the model, whose rotor turns the beam the
other way (``k_m`` > 0). The term of ``dω/dt`` is that of the effect ``main_reaction_on_yaw``. The
tail rotor's axis is the pitch axis: it turns with the yaw only, and couples nothing.
"""

from dataclasses import dataclass
from typing import Annotated, ClassVar

import casadi as ca
from msgspec import Meta

from trms_cli.effects.effect import Effect, EffectContext, axis_of, speed_row
from trms_cli.models.model import Model
from trms_cli.models.parameters import Parameter


@dataclass(frozen=True, kw_only=True)
class GyroscopicCoupling(Effect):
    """Gyroscopic torques of the main rotor."""

    may_begin: ClassVar[bool] = False

    #: J, kg m², beyond what the model has; either sign
    inertia: Annotated[float, Meta(ge=-1e-2, le=1e-2)]
    #: β, rad: 0 for a rotor whose axis is upright on the level beam
    lean: Annotated[float, Meta(ge=-1.6, le=1.6)]

    def parameters(self) -> tuple[Parameter, ...]:
        return (
            self.size(
                "inertia", "kg*m^2", (1e-05, 6e-05), "inertia J of the rotor, beyond the model's"
            ),
        )

    def check(self, model: Model) -> None:
        speed_row(model, "main")
        for axis in ("pitch", "yaw"):
            axis_of(model, axis)

    def disturbance(self, at: EffectContext) -> ca.SX:
        momentum = at.sizes["inertia"] * at.speed("main") * ca.sin(at.angle("pitch") + self.lean)
        return at.on(at.axis("pitch").moment, momentum * at.rate("yaw")) + at.on(
            at.axis("yaw").moment, -momentum * at.rate("pitch")
        )
