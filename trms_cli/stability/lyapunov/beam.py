"""The beam's equations in the form that energies speak of, for both models.

With q = (α_h, α_v), what settles in the rotors s = −ω̇, and balances at the equilibrium taken off,

    M(α_v) q̈ = N(q, q̇, ω) q̇ − Λ α̃ + Ξ s

Newtonian: M = diag(J_h(α_v), J_v), and N has the friction, the cross moment k_g F_v Ω_h cos α_v,
the centrifugal moment −½ H Ω_h² sin 2α_v, and the yaw moment W Ω_v by which pitching turns the main
rotor's momentum, from the derivative of Ω_h = S_h + k_m ω_v cos α_v / J_h::

    N = [[−k_oh, W], [k_g F_v cos α_v − ½ H Ω_h sin 2α_v, −k_ov]]
    W = k_m ω_v J_h d/dα_v (cos α_v / J_h)

It lacks −J_h' Ω_v Ω_h, the moment by which a yawing beam speeds up when it is drawn in.

Lagrangian: M and C from the energies of the rig's bodies, N = −C + friction and cross moment.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca

from trms_cli.models.lagrangian import Lagrangian
from trms_cli.models.newtonian import geometry
from trms_cli.models.rig_bodies import Energies, bodies, energies
from trms_cli.models.twin_rotor import TwinRotor


@dataclass(frozen=True)
class Place:
    """Symbols of the beam's motion; zero for what is locked."""

    rate_h: ca.SX  #: Ω, rad/s
    rate_v: ca.SX  #: Ω, rad/s
    omega_v: ca.SX  #: Speed of the main rotor, rad/s
    thrust_v: ca.SX  #: F_v, N
    alpha_v: ca.SX  #: rad


@dataclass(frozen=True)
class Beam:
    """Matrices of the form above, (2, 2), yaw first."""

    mass: ca.SX  #: M(α_v), kg m²
    #: P with q̇ᵀP q̇ = q̇ᵀΓ(N + ½Ṁ) q̇, the power of the motion itself, N m s; Γ = diag(γ, 1)
    power: ca.SX
    drift: ca.SX  #: N + Ṁ, N m s
    arms: ca.SX  #: Lever of each thrust, m, (2, 1)
    reaction: ca.SX  #: Moments by the rotors' accelerations, kg m²


def beam_of(model: TwinRotor, c: Mapping[str, float], at: Place, yaw_weight: ca.SX) -> Beam:
    """The form of a model's beam.

    Parameters
    ----------
    model : TwinRotor
        Newtonian or Lagrangian.
    c : dict of str to float
        Its parameters.
    at : Place
    yaw_weight : casadi.SX
        γ; of the Newtonian model only, whose M is diagonal.
    """
    cosine = ca.cos(at.alpha_v)
    cross = c["k_g"] * at.thrust_v * cosine
    friction = ca.blockcat([[-c["k_oh"], 0], [0, -c["k_ov"]]])
    arms = ca.vertcat(c["l_t"] * cosine, c["l_m"])
    reaction = ca.blockcat([[0, c["k_m"] * cosine], [c["k_t"], 0]])
    if isinstance(model, Lagrangian):
        rig = energies(bodies(c, model.shields), c["g"])
        turn = [rig.angles, rig.rates]
        here = [ca.vertcat(0, at.alpha_v), ca.vertcat(at.rate_h, at.rate_v)]
        inertia = rig.inertia
        mass, coriolis = ca.substitute([inertia, rig.coriolis(inertia)], turn, here)
        resisting = friction + ca.blockcat([[0, 0], [cross, 0]])
        # Ṁ = C + Cᵀ: the Coriolis terms have no power, and N + Ṁ = Cᵀ + friction + cross.
        return Beam(mass, resisting, resisting + coriolis.T, arms, reaction)
    g = geometry(c)
    inertia_h = g["D"] * cosine**2 + g["E"] * ca.sin(at.alpha_v) ** 2 + g["F"]
    slope = (g["E"] - g["D"]) * ca.sin(2 * at.alpha_v)
    # J_h d/dα (cos α/J_h) = −sin α − cos α J_h'/J_h
    turning = -c["k_m"] * at.omega_v * (ca.sin(at.alpha_v) + cosine * slope / inertia_h)
    double = ca.sin(2 * at.alpha_v)
    # ½ γ J_h' Ω_v Ω_h² and −½ H sin 2α Ω_h² Ω_v are the same monomial.
    swinging = 0.5 * double * (yaw_weight * (g["E"] - g["D"]) - g["H"]) * at.rate_h
    power = ca.blockcat(
        [[-yaw_weight * c["k_oh"], yaw_weight * turning], [cross + swinging, -c["k_ov"]]]
    )
    drift = ca.blockcat(
        [
            [slope * at.rate_v - c["k_oh"], turning],
            [cross - 0.5 * g["H"] * double * at.rate_h, -c["k_ov"]],
        ]
    )
    mass = ca.blockcat([[inertia_h, 0], [0, g["J_v"]]])
    return Beam(mass, power, drift, arms, reaction)


def gravity_of(model: TwinRotor, c: Mapping[str, float]) -> tuple[float, float]:
    """(a, b) of the moment of gravity on pitch, ``a cos α_v + b sin α_v``, N m."""
    if isinstance(model, Lagrangian):
        rig: Energies = energies(bodies(c, model.shields), c["g"])
        moment = ca.Function("moment", [rig.angles], [-rig.gravity[1]])
        return float(moment([0.0, 0.0])), float(moment([0.0, ca.pi / 2]))
    g = geometry(c)
    return c["g"] * (g["A"] - g["B"]), -c["g"] * g["C"]
