"""From the Newtonian to the Lagrangian model term by term, the beam on the yaw axis (h = 0).

The Newtonian equations of :mod:`trms_cli.models.newtonian`, with any of four terms put right:

- ``inertia``: the shields as rings, ``J_v + m_ts r_ts²/2`` and ``J_h − ½ m_ms r_ms² sin² α_v``;
- ``centrifugal``: ``½ J_h'(α_v) Ω_h²`` on pitch in place of ``−½ H Ω_h² sin 2α_v``;
- ``coriolis``: ``−J_h' Ω_v S_h`` on yaw, which the Newtonian form leaves out;
- ``turning``: ``k_m ω_v Ω_v sin α_v`` on yaw: the direction of the rotor's momentum turns with
  the beam.

With all four it is the Lagrangian model, written by hand; the tests and the study hold the two
to each other.
"""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca
import numpy as np

from trms_cli.models.motor import by_direction
from trms_cli.models.newtonian import geometry
from trms_cli.models.twin_rotor import BeamMotion, BeamPoint, TwinRotor

TERMS = ("inertia", "centrifugal", "coriolis", "turning")


class Bridge(TwinRotor):
    """Newtonian TRMS with some terms put right.

    Parameters
    ----------
    right : collection of str
        Of :data:`TERMS`.
    parameters : mapping
        Other values for some parameters, in SI.
    """

    OPTION, UNUSED = "newtonian", ("h",)

    def __init__(
        self, right: tuple[str, ...], parameters: Mapping[str, float] | None = None
    ) -> None:
        super().__init__(parameters=parameters)
        self._right = right

    def pitch_at_rest(self) -> float:
        g = geometry({parameter.name: parameter.value for parameter in self.parameters})
        return float(-np.arctan2(g["B"] - g["A"], g["C"]))

    def beam(self, at: BeamPoint) -> BeamMotion:
        c, pitch = at.c, at.alpha_v
        sine, cosine = ca.sin(pitch), ca.cos(pitch)
        g = geometry(c)
        inertia_v, inertia_h = g["J_v"], g["D"] * cosine**2 + g["E"] * sine**2 + g["F"]
        if "inertia" in self._right:
            inertia_v = inertia_v + c["m_ts"] * c["r_ts"] ** 2 / 2
            inertia_h = inertia_h - c["m_ms"] * c["r_ms"] ** 2 / 2 * sine**2
        slope_h = ca.jacobian(inertia_h, pitch)
        rate_h = at.S_h + c["k_m"] * at.omega_v * cosine / inertia_h
        rate_v = at.S_v + c["k_t"] * at.omega_h / inertia_v
        gravity = c["g"] * ((g["A"] - g["B"]) * cosine - g["C"] * sine)
        moment_v = (
            c["l_m"] * at.thrust_v
            + c["k_g"] * at.thrust_v * rate_h * cosine
            - c["k_ov"] * rate_v
            + gravity
        )
        if "centrifugal" in self._right:
            moment_v += 0.5 * slope_h * rate_h**2
        else:
            moment_v -= 0.5 * g["H"] * rate_h**2 * ca.sin(2 * pitch)
        cable = by_direction(at.alpha_h, c["k_chp"], c["k_chn"]) * at.alpha_h
        moment_h = c["l_t"] * at.thrust_h * cosine - c["k_oh"] * rate_h - cable
        if "coriolis" in self._right:
            moment_h -= slope_h * rate_v * at.S_h
        if "turning" in self._right:
            moment_h += c["k_m"] * at.omega_v * rate_v * sine
        return BeamMotion(
            rate_h=rate_h,
            rate_v=rate_v,
            momentum_rate_h=(moment_h + at.yaw_moment) / inertia_h,
            momentum_rate_v=(moment_v + at.pitch_moment) / inertia_v,
            inertia_h=inertia_h,
            inertia_v=inertia_v,
            gravity=gravity,
        )
