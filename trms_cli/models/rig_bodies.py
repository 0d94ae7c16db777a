"""The bodies of a TRMS as particles, and the energies of a system of particles.

The rig is a rigid body on two axes. A frame is fixed to its beam: ``ξ`` along the beam towards the
main rotor, ``η`` along the axis of pitch, ``ζ`` along the counterweight's rod, down when the beam
is level. The yaw axis passes at the distance h, so that all of the beam lies at η = h. In the
room, with yaw α_h and pitch α_v,

    e_ξ = (cos α_v cos α_h, cos α_v sin α_h, sin α_v)
    e_η = (−sin α_h, cos α_h, 0)
    e_ζ = (sin α_v cos α_h, sin α_v sin α_h, −cos α_v)

A body's particles enter its energies through their mass, their centre and their mean squares
about it, which rods and rings have in closed form: ``l²/12`` along a uniform rod, ``r²/2`` along
any diameter of a thin ring.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import casadi as ca

Shields = Literal["rings", "as_printed"]


@dataclass(frozen=True)
class Body:
    """Particles that are fixed to the beam, as far as energies see them."""

    name: str
    mass: Any  #: kg
    centre: tuple[Any, Any, Any]  #: Centre of mass in the beam's frame, m
    #: Mean squares of the particles' distances from it along the axes, m²
    spread: tuple[Any, Any, Any] = (0.0, 0.0, 0.0)


def bodies(c: Mapping[str, Any], shields: Shields = "rings") -> tuple[Body, ...]:
    """The rig's named bodies.

    ``c``: masses (kg) and lengths (m) by the names of the parameter sets; ``h`` among them.
    ``shields``: the guards of the propellers: thin rings around them, the main one around an axis
    along ζ and the tail one around an axis along η; or spread along the beam alone, so as to give
    the published J1, J2 and J3 (see ``docs/lagrangian.md``).
    """
    h, l_t, l_m, l_b = c["h"], c["l_t"], c["l_m"], c["l_b"]
    main, tail = c["r_ms"] ** 2 / 2, c["r_ts"] ** 2 / 2
    if shields == "rings":
        main_spread, tail_spread = (main, main, 0.0), (tail, 0.0, tail)
    else:
        main_spread, tail_spread = (main, 0.0, 0.0), (2 * tail, 0.0, 0.0)
    return (
        Body("tail", c["m_t"], (-l_t / 2, h, 0.0), (l_t**2 / 12, 0.0, 0.0)),
        Body("tail rotor and motor", c["m_tr"], (-l_t, h, 0.0)),
        Body("tail shield", c["m_ts"], (-l_t, h, 0.0), tail_spread),
        Body("beam", c["m_m"], (l_m / 2, h, 0.0), (l_m**2 / 12, 0.0, 0.0)),
        Body("main rotor and motor", c["m_mr"], (l_m, h, 0.0)),
        Body("main shield", c["m_ms"], (l_m, h, 0.0), main_spread),
        Body("counterweight's rod", c["m_b"], (0.0, h, l_b / 2), (0.0, 0.0, l_b**2 / 12)),
        Body("counterweight", c["m_cb"], (0.0, h, c["l_cb"])),
    )


@dataclass(frozen=True)
class Energies:
    """Energies of particles on the two axes, and what follows from them by differentiation."""

    angles: ca.SX  #: q = (α_h, α_v), symbols, (2, 1)
    rates: ca.SX  #: q̇, symbols, (2, 1)
    kinetic: ca.SX  #: T, J
    potential: ca.SX  #: V, J

    @property
    def inertia(self) -> ca.SX:
        """M = ∂²T/∂q̇², (2, 2)."""
        # The second derivative of a quadratic form by its first, at rates of one: a constant rate
        # folds into the expression, which a general second derivative leaves twice as long.
        n = self.rates.numel()
        momenta = ca.jacobian(self.kinetic, self.rates).T
        return ca.horzcat(
            *(
                ca.substitute(momenta, self.rates, ca.SX(ca.densify(ca.DM.eye(n)[:, j])))
                for j in range(n)
            )
        )

    @property
    def gravity(self) -> ca.SX:
        """G = ∂V/∂q, (2, 1)."""
        return ca.gradient(self.potential, self.angles)

    def coriolis(self, inertia: ca.SX) -> ca.SX:
        """C of Christoffel's symbols of the first kind, (2, 2).

        ``C_ij = ½ Σ_k (∂M_ij/∂q_k + ∂M_ik/∂q_j − ∂M_jk/∂q_i) q̇_k``, the choice for which Ṁ − 2C
        is skew-symmetric.
        """
        n = self.angles.numel()
        slopes = [ca.reshape(ca.jacobian(ca.vec(inertia), self.angles[k]), n, n) for k in range(n)]
        c = ca.SX.zeros(n, n)
        for i in range(n):
            for j in range(n):
                for k in range(n):
                    symbol = slopes[k][i, j] + slopes[j][i, k] - slopes[i][j, k]
                    c[i, j] += 0.5 * symbol * self.rates[k]
        return c


def energies(rig: Sequence[Body], g: Any) -> Energies:
    """T and V of bodies fixed to the beam.

    With the position ``r = R(q) b`` of a particle, its velocity in the beam's own frame is
    ``Rᵀ Ṙ b = W b``, and ``T = ½ Σ m |W b|² = ½ tr(W S Wᵀ)`` with ``S = Σ m b bᵀ``, the same at all
    angles; ``V = g e_z·R Σ m b``. Neither changes when the whole rig turns about the vertical, so
    that both are written at yaw 0. The part of W that pitching gives does not change with the pitch
    either, since the beam pitches about an axis that is fixed in it.

    ``g``: m/s².
    """
    q, rates = ca.SX.sym("q", 2), ca.SX.sym("q_dot", 2)
    frame = _frame(q[0], q[1])
    first, second = ca.SX(3, 1), ca.SX(3, 3)
    for body in rig:
        centre = ca.sparsify(ca.vertcat(*body.centre))
        spread = ca.sparsify(ca.diag(ca.vertcat(*body.spread)))
        first += body.mass * centre
        second += body.mass * (centre @ centre.T + spread)
    yawing, pitching = (
        frame.T @ ca.reshape(ca.jacobian(ca.vec(frame), angle), 3, 3) for angle in (q[0], q[1])
    )
    pitching = ca.substitute(pitching, q, ca.SX.zeros(2))
    frame, yawing = (ca.substitute(part, q[0], 0) for part in (frame, yawing))
    moving = ca.sparsify(yawing * rates[0] + pitching * rates[1])
    kinetic = 0.5 * sum(
        second[i, j] * ca.dot(moving[:, i], moving[:, j]) for i in range(3) for j in range(3)
    )
    potential = g * (frame[2, :] @ first)
    return Energies(q, rates, kinetic, potential)


def _frame(yaw: ca.SX, pitch: ca.SX) -> ca.SX:
    """R: the columns e_ξ, e_η, e_ζ in the room."""
    cos_h, sin_h, cos_v, sin_v = ca.cos(yaw), ca.sin(yaw), ca.cos(pitch), ca.sin(pitch)
    along = ca.vertcat(cos_v * cos_h, cos_v * sin_h, sin_v)
    across = ca.vertcat(-sin_h, cos_h, 0)
    down = ca.vertcat(sin_v * cos_h, sin_v * sin_h, -cos_v)
    return ca.horzcat(along, across, down)
