"""A rotor at a constant command: how fast it settles, what it stores, and what thrust it lacks.

The electrical rotor with quasi-static current is one equation in its own speed,

    ω̇ = −s(ω)        s(ω) = [b ω + k_t ω|ω| − k_φ v / R] / J,    b = k_φ²/R + B

s rises with ω and vanishes at one speed ω̄. What the rotor *stores* is

    ∫ s dω  from ω̄ to ω     ≥ 0, and falls as   d/dt ∫ s dω = s ω̇ = −s².

The thrust that it lacks is in proportion to how fast it settles: by Cauchy's mean value theorem

    F(ω) − F(ω̄) = ψ s(ω),    ψ = F'(ξ)/s'(ξ) for a ξ between ω̄ and ω
    F'/s' = 2 k_f |ω| J / (b + 2 k_t |ω|) = (k_f J / k_t) (1 − b/(b + 2 k_t |ω|)) < k_f J / k_t

so that ψ is bounded at all speeds: the lever by which global statements are possible.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca

from trms_cli.models.motor import Motor, by_direction

_ROTOR_OF_AXIS = {"v": "mr", "h": "tr"}


@dataclass(frozen=True)
class RotorAtRest:
    """Expressions of one rotor with its command held."""

    axis: str  #: ``h`` or ``v``
    omega: ca.SX  #: The speed, rad/s, of which the others are functions
    settling: ca.SX  #: s, rad/s²
    stored: ca.SX  #: An antiderivative of s, (rad/s)²/s
    thrust: ca.SX  #: F, N
    ratio: ca.SX  #: F'/s', N s²/rad, written so that the speed stands in it once
    bound: float  #: What the ratio stays below at all speeds; infinite without drag of the air


def rotor_at_rest(axis: str, volt: float, c: Mapping[str, float]) -> RotorAtRest:
    """The rotor of an axis at a motor voltage.

    Parameters
    ----------
    axis : str
        ``h`` or ``v``.
    volt : float
        v, V.
    c : dict of str to float
        The model's parameters.
    """
    motor, name = Motor(axis), _ROTOR_OF_AXIS[axis]
    omega = ca.SX.sym(f"omega_{axis}")
    constants = {key: ca.SX(value) for key, value in c.items()}
    current = motor.steady_current(ca.SX(volt), omega, constants)
    settling = -motor.acceleration(current, omega, ca.SX(0), constants)
    inertia = c[f"J_{name}"]
    resisting = c["kphi"] ** 2 / c["R"] + c[f"B_{name}"]
    driving = c["kphi"] * volt / c["R"]
    size = ca.fabs(omega)
    drag = by_direction(omega, constants[f"k_t{axis}p"], constants[f"k_t{axis}n"])
    stored = (0.5 * resisting * omega**2 + drag * size**3 / 3 - driving * omega) / inertia
    pieces = [
        _ratio(c[f"k_f{axis}{d}"], c[f"k_t{axis}{d}"], resisting, inertia, size) for d in "pn"
    ]
    bounds = [
        c[f"k_f{axis}{d}"] * inertia / c[f"k_t{axis}{d}"] if c[f"k_t{axis}{d}"] else float("inf")
        for d in "pn"
    ]
    return RotorAtRest(
        axis,
        omega,
        settling,
        stored,
        motor.thrust(omega, constants),
        ca.if_else(omega >= 0, *pieces),
        max(bounds),
    )


def _ratio(thrust: float, drag: float, resisting: float, inertia: float, size: ca.SX) -> ca.SX:
    if drag == 0.0:
        return 2 * thrust * inertia / resisting * size
    return thrust * inertia / drag * (1 - resisting / (resisting + 2 * drag * size))
