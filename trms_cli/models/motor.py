"""A DC motor with a propeller, as expressions.

L i̇ = v − R i − kφ ω                       or, quasi-static, i = (v − kφ ω)/R
J ω̇ = kφ i − B ω − k_t ω|ω| + w            k_t by direction of rotation
F   = k_f ω|ω|                              k_f by direction of rotation
"""

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca

#: Inertia and bearing friction are named after the rotor, all else after the axis that it moves.
_ROTOR_OF_AXIS = {"v": "mr", "h": "tr"}


def by_direction(x: ca.SX, positive: ca.SX, negative: ca.SX) -> ca.SX:
    """A coefficient that depends on the sign of a quantity."""
    return ca.if_else(x >= 0, positive, negative)


@dataclass(frozen=True)
class Motor:
    """The main or the tail motor with its propeller."""

    axis: str  #: Suffix of its parameters: ``v`` for the main, ``h`` for the tail rotor

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """What it takes from a parameter set."""
        a, r = self.axis, _ROTOR_OF_AXIS[self.axis]
        drag_and_thrust = (f"k_t{a}p", f"k_t{a}n", f"k_f{a}p", f"k_f{a}n")
        return ("R", "L", "kphi", f"J_{r}", f"B_{r}", *drag_and_thrust)

    def steady_current(self, volt: ca.SX, omega: ca.SX, c: Mapping[str, ca.SX]) -> ca.SX:
        """Armature current without its dynamics, A."""
        return (volt - c["kphi"] * omega) / c["R"]

    def current_rate(
        self, volt: ca.SX, current: ca.SX, omega: ca.SX, c: Mapping[str, ca.SX]
    ) -> ca.SX:
        """di/dt, A/s."""
        return (volt - c["R"] * current - c["kphi"] * omega) / c["L"]

    def acceleration(
        self, current: ca.SX, omega: ca.SX, torque: ca.SX, c: Mapping[str, ca.SX]
    ) -> ca.SX:
        """dω/dt, rad/s², with a further torque on the shaft (N m)."""
        rotor = _ROTOR_OF_AXIS[self.axis]
        driving = c["kphi"] * current - c[f"B_{rotor}"] * omega - self.drag(omega, c)
        return (driving + torque) / c[f"J_{rotor}"]

    def drag(self, omega: ca.SX, c: Mapping[str, ca.SX]) -> ca.SX:
        """Torque of the air against the propeller, N m."""
        return self._quadratic("k_t", omega, c)

    def thrust(self, omega: ca.SX, c: Mapping[str, ca.SX]) -> ca.SX:
        """F, N."""
        return self._quadratic("k_f", omega, c)

    def _quadratic(self, name: str, omega: ca.SX, c: Mapping[str, ca.SX]) -> ca.SX:
        a = self.axis
        return by_direction(omega, c[f"{name}{a}p"], c[f"{name}{a}n"]) * omega * ca.fabs(omega)
