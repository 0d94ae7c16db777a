"""A cable that couples the axes: it hangs from the beam to the base, and is pulled by both angles.

With the potential energy ``k α_v α_h`` the torques are ``−k α_h`` on pitch and
``−k α_v`` on yaw: the only bilinear coupling that conserves energy. An effect of this study's own,
which shows that one need not live in the program to be fitted by it.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from trms_cli.effects.effect import Effect, EffectContext, axis_of
from trms_cli.models.model import Model
from trms_cli.models.parameters import Parameter


@dataclass(frozen=True, kw_only=True)
class CableCoupling(Effect):
    """Bilinear stiffness between pitch and yaw.

    Attributes
    ----------
    stiffness : float
        k, N m/rad, of either sign.
    """

    stiffness: float

    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter("stiffness", self.stiffness, "N*m/rad", description="k"),)

    def check(self, model: Model) -> None:
        for axis in ("pitch", "yaw"):
            axis_of(model, axis)

    def disturbance(self, at: EffectContext) -> ca.SX:
        k = at.sizes["stiffness"]
        pitch = at.on(at.axis("pitch").moment, -k * at.angle("yaw"))
        return pitch + at.on(at.axis("yaw").moment, -k * at.angle("pitch"))
