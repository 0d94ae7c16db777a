"""Lagrangian model of the TRMS, 2 DOF and 1 DOF, with and without current dynamics.

After Rahideh & Shaheed 2007. The energies of the rig's particles are stated once, in
:mod:`trms_cli.models.rig_bodies`; inertia, Coriolis and gravity terms are their derivatives, taken
by CasADi. With q = (α_h, α_v) and the rotors' speeds ω = (ω_h, ω_v)::

    M(q) q̈ + C(q, q̇) q̇ + G(q) = τ + K(q) ω̇
    τ_h = l_t F_h cos α_v − k_oh α̇_h − k_ch α_h + w_yaw                k_ch by the sign of α_h
    τ_v = l_m F_v − k_ov α̇_v + k_g F_v α̇_h cos α_v + w_pitch
    K ω̇ = (k_m ω̇_v cos α_v, k_t ω̇_h)

Its states have the meaning of the Newtonian model's: S is what remains of the rates without the
rotors' momenta, and with it no equation of the beam needs a rotor's acceleration::

    q̇ = S + M⁻¹ K ω        M Ṡ = τ − G − C q̇ − K̇ ω + Ṁ M⁻¹ K ω

With one axis locked, its rows and columns are dropped and its rate is zero.
"""

from collections.abc import Mapping

import casadi as ca
import numpy as np

from trms_cli.core.errors import ModelError
from trms_cli.models.motor import by_direction
from trms_cli.models.newtonian import geometry
from trms_cli.models.rig_bodies import Shields, bodies, energies
from trms_cli.models.twin_rotor import BeamMotion, BeamPoint, Currents, Freedom, TwinRotor


class Lagrangian(TwinRotor):
    """Lagrangian TRMS.

    Raises ConfigurationError for an unknown set or parameter. Raises ModelError for a curve that
    cannot be used, or a set without the arm h.

    ``shields``: see :func:`trms_cli.models.rig_bodies.bodies`; the other arguments are explained in
    :class:`trms_cli.models.newtonian.Newtonian`.
    """

    OPTION = "lagrangian"

    def __init__(
        self,
        *,
        freedom: Freedom = "both",
        currents: Currents = "quasi_static",
        shields: Shields = "rings",
        parameter_set: str = "bench",
        parameters: Mapping[str, float] | None = None,
        main_interface: str | None = None,
        tail_interface: str | None = None,
        main_voltage_limit: float | None = None,
        tail_voltage_limit: float | None = None,
    ) -> None:
        super().__init__(
            freedom=freedom,
            currents=currents,
            parameter_set=parameter_set,
            parameters=parameters,
            main_interface=main_interface,
            tail_interface=tail_interface,
            main_voltage_limit=main_voltage_limit,
            tail_voltage_limit=tail_voltage_limit,
        )
        if "h" not in self.parameters:
            raise ModelError(
                f"the set {self.parameters.name!r} has no h, the arm from the yaw axis to the "
                "beam's plane",
                where="model.parameter_set",
                remedy="add it to the file: h: {value: 0.06, unit: m}; 0 is a beam on the axis",
            )
        self.shields: Shields = shields

    def pitch_at_rest(self) -> float:
        g = geometry({parameter.name: parameter.value for parameter in self.parameters})
        return float(-np.arctan2(g["B"] - g["A"], g["C"]))

    def beam(self, at: BeamPoint) -> BeamMotion:
        c = at.c
        rig = energies(bodies(c, self.shields), c["g"])
        moves = [i for i, free in enumerate((at.moves_h, at.moves_v)) if free]
        inertia = rig.inertia
        spin = ca.vertcat(c["k_m"] * at.omega_v * ca.cos(rig.angles[1]), c["k_t"] * at.omega_h)

        # Rates follow from the momenta at these angles.
        angles = ca.vertcat(at.alpha_h, at.alpha_v)
        inertia_here, spin_here = ca.substitute([inertia, spin], [rig.angles], [angles])
        inverse = _inverse(inertia_here[moves, moves])
        turned = ca.SX.zeros(2, 1)
        turned[moves] = inverse @ spin_here[moves]
        rates = ca.SX.zeros(2, 1)
        rates[moves] = ca.vertcat(at.S_h, at.S_v)[moves] + turned[moves]

        inertia_rate = ca.reshape(ca.jtimes(ca.vec(inertia), rig.angles, rig.rates), 2, 2)
        spin_rate = ca.jtimes(spin, rig.angles, rig.rates)  # K̇ ω
        coriolis, gravity, inertia_rate, spin_rate = ca.substitute(
            [rig.coriolis(inertia), rig.gravity, inertia_rate, spin_rate],
            [rig.angles, rig.rates],
            [angles, rates],
        )
        torque = self._torques(at, rates)
        balance = torque - gravity - coriolis @ rates - spin_rate + inertia_rate @ turned
        momentum_rates = ca.SX.zeros(2, 1)
        momentum_rates[moves] = inverse @ balance[moves]
        return BeamMotion(
            rate_h=rates[0],
            rate_v=rates[1],
            momentum_rate_h=momentum_rates[0],
            momentum_rate_v=momentum_rates[1],
            inertia_h=inertia_here[0, 0],
            inertia_v=inertia_here[1, 1],
            gravity=-gravity[1],
        )

    def _torques(self, at: BeamPoint, rates: ca.SX) -> ca.SX:
        """τ, without the rotors' accelerations."""
        c, cosine = at.c, ca.cos(at.alpha_v)
        cable = by_direction(at.alpha_h, c["k_chp"], c["k_chn"]) * at.alpha_h
        yaw = c["l_t"] * at.thrust_h * cosine - c["k_oh"] * rates[0] - cable + at.yaw_moment
        pitch = (
            c["l_m"] * at.thrust_v
            - c["k_ov"] * rates[1]
            + c["k_g"] * at.thrust_v * rates[0] * cosine
            + at.pitch_moment
        )
        return ca.vertcat(yaw, pitch)


def _inverse(matrix: ca.SX) -> ca.SX:
    """Of a symmetric matrix with one or two rows."""
    if matrix.shape[0] == 1:
        return 1 / matrix
    a, b, d = matrix[0, 0], matrix[0, 1], matrix[1, 1]
    return ca.blockcat([[d, -b], [-b, a]]) / (a * d - b * b)
