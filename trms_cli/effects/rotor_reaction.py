"""Reaction of a rotor on the other axis: what turns the air and the rotor turns the beam.

The motor drives the rotor against the drag of the air and against its inertia; the beam bears the
same torque. The main rotor's axis is upright with the beam level, the tail rotor's is the pitch
axis::

    main:  τ_yaw   = (c ω_v|ω_v| + J dω_v/dt) cos α
    tail:  τ_pitch =  c ω_h|ω_h| + J dω_h/dt

This is beyond what the model has of it (``k_m`` and ``k_t`` of the Newtonian model are inertias of
this kind), and may therefore have either sign.
"""

from dataclasses import dataclass
from typing import Annotated, ClassVar

import casadi as ca
from msgspec import Meta

from trms_cli.effects.effect import Effect, EffectContext, axis_of, speed_row
from trms_cli.models.model import Model
from trms_cli.models.parameters import Parameter

_OTHER_AXIS = {"main": "yaw", "tail": "pitch"}
#: 1 to 10 % of the torque of the rotor's thrust; the inertia of the rotor itself.
_TYPICAL_DRAG = {"main": (4e-8, 5e-7), "tail": (5e-9, 1e-7)}
_TYPICAL_INERTIA = {"main": (-2e-4, 2e-4), "tail": (-3e-5, 3e-5)}


@dataclass(frozen=True, kw_only=True)
class RotorReaction(Effect):
    """Drag and acceleration torque of one rotor on the other axis."""

    may_begin: ClassVar[bool] = False

    rotor: str  #: Name of a rotor of the model
    drag: Annotated[float, Meta(ge=-1e-4, le=1e-4)]  #: c, N m s²/rad²
    inertia: Annotated[float, Meta(ge=-1e-2, le=1e-2)]  #: J, kg m²

    def parameters(self) -> tuple[Parameter, ...]:
        return (
            self.size("drag", "N*m*s^2/rad^2", _TYPICAL_DRAG[self.rotor], "drag coefficient c"),
            self.size(
                "inertia",
                "kg*m^2",
                _TYPICAL_INERTIA[self.rotor],
                "inertia J that the acceleration of the rotor meets",
            ),
        )

    def check(self, model: Model) -> None:
        speed_row(model, self.rotor)
        axis_of(model, _OTHER_AXIS[self.rotor])

    def disturbance(self, at: EffectContext) -> ca.SX:
        omega = at.speed(self.rotor)
        torque = at.sizes["drag"] * omega * ca.fabs(omega)
        torque += at.sizes["inertia"] * at.spin_up(self.rotor)
        if self.rotor == "main":
            torque *= at.cosine_of_pitch()
        return at.on(at.axis(_OTHER_AXIS[self.rotor]).moment, torque)
