"""Inflow: a rotor that moves along its own axis in the direction of its thrust thrusts less.

The angle of attack of the blades falls by the axial speed v over that of the blades, to first
order (the advance ratio; Leishman, Principles of Helicopter Aerodynamics, 2006, ch. 2)::

    ΔF = −k (v/ω) F(ω),   v = ℓ Ω

with the arm ℓ and the rate Ω of the rotor's own axis. As F goes with ω|ω|, this damps the axis in
proportion to the speed of the rotor, whichever way it turns.
"""

from dataclasses import dataclass
from typing import ClassVar

import casadi as ca

from trms_cli.core.ranges import NotNegative
from trms_cli.effects.effect import EffectContext
from trms_cli.effects.thrust import ThrustEffect
from trms_cli.models.parameters import Parameter

#: (rad/s)²: keeps F/ω, which is zero at rest, free of a division by zero.
_AT_REST = 1e-6


@dataclass(frozen=True, kw_only=True)
class Inflow(ThrustEffect):
    """Loss of thrust by the rotor's own axial speed."""

    may_begin: ClassVar[bool] = False

    rotor: str  #: Name of a rotor of the model
    #: k, rad/m: speed of the rotor over the axial speed that would take all its thrust
    coefficient: NotNegative

    def parameters(self) -> tuple[Parameter, ...]:
        return (self.size("coefficient", "rad/m", (5.0, 60.0), "inflow k"),)

    def disturbance(self, at: EffectContext) -> ca.SX:
        omega = at.speed(self.rotor)
        per_speed = at.quantity(f"thrust_{self.rotor}") * omega / ca.fmax(omega**2, _AT_REST)
        axial = at.quantity(f"arm_{self.rotor}") * at.rate(at.model.rotors[self.rotor].axis)
        return self.torque(at, -at.sizes["coefficient"] * axial * per_speed)
