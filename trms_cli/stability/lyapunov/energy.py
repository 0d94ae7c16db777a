"""A rotor at a constant command: how fast it settles, what it stores, and what thrust it lacks.

The electrical rotor with quasi-static current is one equation in its own speed,

    ω̇ = −s(ω)        s(ω) = [b ω + k_t ω|ω| − k_φ v / R] / J,    b = k_φ²/R + B

s rises with ω and vanishes at one speed ω̄. What the rotor *stores* is

    ∫ s dω  from ω̄ to ω     ≥ 0, and falls as   d/dt ∫ s dω = s ω̇ = −s².

The thrust that it lacks is in proportion to how fast it settles: by Cauchy's mean value theorem

    F(ω) − F(ω̄) = ψ s(ω),    ψ = F'(ξ)/s'(ξ) for a ξ between ω̄ and ω
    F'/s' = 2 k_f |ω| J / (b + 2 k_t |ω|) = (k_f J / k_t) (1 − b/(b + 2 k_t |ω|)) < k_f J / k_t

so that ψ is bounded at all speeds: the lever by which global statements are possible.

The beam's equations in the form that energies speak of, for both models.

With q = (α_h, α_v), what settles in the rotors s = −ω̇, and balances at the equilibrium taken off,

    M(α_v) q̈ = N(q, q̇, ω) q̇ − Λ α̃ + Ξ s

Newtonian: M = diag(J_h(α_v), J_v), and N has the friction, the cross moment k_g F_v Ω_h cos α_v,
the centrifugal moment −½ H Ω_h² sin 2α_v, and the yaw moment W Ω_v by which pitching turns the main
rotor's momentum, from the derivative of Ω_h = S_h + k_m ω_v cos α_v / J_h::

    N = [[−k_oh, W], [k_g F_v cos α_v − ½ H Ω_h sin 2α_v, −k_ov]]
    W = k_m ω_v J_h d/dα_v (cos α_v / J_h)

It lacks −J_h' Ω_v Ω_h, the moment by which a yawing beam speeds up when it is drawn in.

Lagrangian: M and C from the energies of the rig's bodies, N = −C + friction and cross moment.

The energy-like function V of a rig at a constant command, and its decay as a quadratic form.

With q̇ = Ω, α̃ = α − ᾱ, and s what settles in the rotors (above)::

    V = ½ q̇ᵀΓM q̇ + Σ γ_i U_i(α_i) + Σ c_i ∫s_i dω_i          kinetic, potential, stored
        + α̃ᵀΓE M q̇ + ½ α̃ᵀΓE K α̃                                with E ≠ 0: a strict function

K holds the friction coefficients, Γ = diag(γ, 1) weighs yaw against pitch (Newtonian model), and
the wells are

    U_h = cable energy − l_t F̄_h cos ᾱ_v α_h,    U_v = potential energy − l_m F̄_v α_v.

Every difference from the equilibrium is a slope times a deviation (mean value theorem), the
slopes being θ = (ψ_h, ψ_v, λ_h, λ_v, σ): lacking thrust F − F̄ = ψ s, moment of the wells
U' = λ α̃, and cos α_v − cos ᾱ_v = −σ α̃_v. So, exactly,

    V̇ = −zᵀ Q(Ω, ω, α; θ) z,      z = (q̇, s, α̃)

    zᵀQz = −q̇ᵀΓ(N + ½Ṁ) q̇ + q̇ᵀΓ(Λ − Λ_d) α̃ − q̇ᵀΓΞ s − q̇ᵀΓE M q̇ + sᵀC s
           + α̃ᵀΓE [Λ α̃ − (N + Ṁ + K) q̇ − Ξ s]

and V falls wherever Q is positive definite: no neighbourhood of the equilibrium is left out.
Squares completed, V = ½ yᵀΓM y + Σ γU + ½ α̃ᵀΓE(K − M E) α̃ + Σ c∫s with y = q̇ + E α̃.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
import numpy.typing as npt

from trms_cli.core.arrays import FloatArray
from trms_cli.models.lagrangian import Lagrangian
from trms_cli.models.motor import Motor, by_direction
from trms_cli.models.newtonian import geometry
from trms_cli.models.rig_bodies import Energies, bodies, energies
from trms_cli.models.twin_rotor import TwinRotor

_ROTOR_OF_AXIS = {"v": "mr", "h": "tr"}


@dataclass(frozen=True)
class RotorAtRest:
    """Expressions of one rotor with its command held."""

    omega: ca.SX  #: The speed, rad/s, of which the others are functions
    settling: ca.SX  #: s, rad/s²
    stored: ca.SX  #: An antiderivative of s, (rad/s)²/s
    thrust: ca.SX  #: F, N
    ratio: ca.SX  #: F'/s', N s²/rad, written so that the speed stands in it once
    bound: float  #: What the ratio stays below at all speeds; infinite without drag of the air


def rotor_at_rest(axis: str, volt: float, c: Mapping[str, float]) -> RotorAtRest:
    """The rotor of an axis (``h`` or ``v``) at a motor voltage v; c are the model's parameters."""
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
    pieces, bounds = zip(
        *(_ratio(c[f"k_f{axis}{d}"], c[f"k_t{axis}{d}"], resisting, inertia, size) for d in "pn"),
        strict=True,
    )
    thrust, ratio = motor.thrust(omega, constants), ca.if_else(omega >= 0, *pieces)
    return RotorAtRest(omega, settling, stored, thrust, ratio, max(bounds))


def _ratio(
    thrust: float, drag: float, resisting: float, inertia: float, size: ca.SX
) -> tuple[ca.SX, float]:
    """F'/s' in one direction, and what it stays below."""
    if drag == 0.0:
        return 2 * thrust * inertia / resisting * size, float("inf")
    bound = thrust * inertia / drag
    return bound * (1 - resisting / (resisting + 2 * drag * size)), bound


@dataclass(frozen=True)
class Beam:
    """Matrices of the form above, (2, 2), yaw first."""

    mass: ca.SX  #: M(α_v), kg m²
    #: P with q̇ᵀP q̇ = q̇ᵀΓ(N + ½Ṁ) q̇, the power of the motion itself, N m s; Γ = diag(γ, 1)
    power: ca.SX
    drift: ca.SX  #: N + Ṁ, N m s
    arms: ca.SX  #: Lever of each thrust, m, (2, 1)
    reaction: ca.SX  #: Moments by the rotors' accelerations, kg m²


def beam_of(energy: Energy) -> Beam:
    """The form of a model's beam; γ is of the Newtonian model only, whose M is diagonal."""
    model, c, yaw_weight = energy.model, energy.c, energy.weights[2]
    rate_h, rate_v = energy.part("Omega", "h"), energy.part("Omega", "v")
    omega_v, alpha_v = energy.part("omega", "v"), energy.part("alpha", "v")
    cosine = ca.cos(alpha_v)
    cross = c["k_g"] * energy.thrust("v", omega_v) * cosine
    friction = ca.blockcat([[-c["k_oh"], 0], [0, -c["k_ov"]]])
    arms = ca.vertcat(c["l_t"] * cosine, c["l_m"])
    reaction = ca.blockcat([[0, c["k_m"] * cosine], [c["k_t"], 0]])
    if isinstance(model, Lagrangian):
        rig = energies(bodies(c, model.shields), c["g"])
        turn = [rig.angles, rig.rates]
        here = [ca.vertcat(0, alpha_v), ca.vertcat(rate_h, rate_v)]
        inertia = rig.inertia
        mass, coriolis = ca.substitute([inertia, rig.coriolis(inertia)], turn, here)
        resisting = friction + ca.blockcat([[0, 0], [cross, 0]])
        # Ṁ = C + Cᵀ: the Coriolis terms have no power, and N + Ṁ = Cᵀ + friction + cross.
        return Beam(mass, resisting, resisting + coriolis.T, arms, reaction)
    g = geometry(c)
    inertia_h = g["D"] * cosine**2 + g["E"] * ca.sin(alpha_v) ** 2 + g["F"]
    slope = (g["E"] - g["D"]) * ca.sin(2 * alpha_v)
    # J_h d/dα (cos α/J_h) = −sin α − cos α J_h'/J_h
    turning = -c["k_m"] * omega_v * (ca.sin(alpha_v) + cosine * slope / inertia_h)
    double = ca.sin(2 * alpha_v)
    # ½ γ J_h' Ω_v Ω_h² and −½ H sin 2α Ω_h² Ω_v are the same monomial.
    swinging = 0.5 * double * (yaw_weight * (g["E"] - g["D"]) - g["H"]) * rate_h
    power = ca.blockcat(
        [[-yaw_weight * c["k_oh"], yaw_weight * turning], [cross + swinging, -c["k_ov"]]]
    )
    drift = ca.blockcat(
        [
            [slope * rate_v - c["k_oh"], turning],
            [cross - 0.5 * g["H"] * double * rate_h, -c["k_ov"]],
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


#: Slopes θ, in this order.
SLOPES = ("psi_h", "psi_v", "lambda_h", "lambda_v", "sigma", "thrust_h")


@dataclass(frozen=True)
class EnergyWeights:
    """What is free in V."""

    rotor_h: float = 1.0  #: c, J per (rad/s)²/s
    rotor_v: float = 1.0  #: c, J per (rad/s)²/s
    yaw: float = 1.0  #: γ
    cross_h: float = 0.0  #: Diagonal of E, 1/s
    cross_v: float = 0.0  #: 0 is the plain energy

    @property
    def strict(self) -> bool:
        """Whether z has the angles."""
        return self.cross_h > 0.0 or self.cross_v > 0.0

    def array(self) -> FloatArray:
        """(5,), as the functions take them."""
        return np.array([self.rotor_h, self.rotor_v, self.yaw, self.cross_h, self.cross_v])


class Energy:
    """Expressions of V and Q of one model with quasi-static currents at one command u (n_u,), V.

    States of motion are ``y = (Ω…, ω…, α…)``, yaw before pitch, of the axes that move: k of each.
    Functions are of ``(y, ȳ, weights)``; nothing of them changes with the weights.
    """

    def __init__(self, model: TwinRotor, u: npt.ArrayLike) -> None:
        self.model = model
        self.u = np.asarray(u, dtype=float)
        self.axes = tuple(a for a in "hv" if f"alpha_{a}" in model.state_names)
        self.k = len(self.axes)
        self.c = {p.name: p.value for p in model.parameters}
        self.rotors = {a: self._rotor(a) for a in self.axes}
        self.gravity = gravity_of(model, self.c)
        #: Symbols of the state of motion, and of the equilibrium.
        self.y = ca.SX.sym("y", 3 * self.k)
        self.rest = ca.SX.sym("rest", 3 * self.k)
        self.theta = ca.SX.sym("theta", len(SLOPES))
        self.weights = ca.SX.sym("weights", 5)

    def _rotor(self, axis: str) -> RotorAtRest:
        """The rotor at the voltage that the command gives it, saturation and all."""
        x, u, p, _ = self.model.symbols()
        name = "current_main" if axis == "v" else "current_tail"
        blocked = ca.Function("current", [x, u, p], [self.model.quantities(x, u, p)[name]])
        still = np.zeros(self.model.n_x)
        current = float(blocked(still, self.u, self.model.parameters.values))
        return rotor_at_rest(axis, self.c["R"] * current, self.c)

    def names(self) -> tuple[str, ...]:
        """``Omega_h, …, omega_v, …, alpha_v`` in the order of y."""
        return tuple(f"{what}_{a}" for what in ("Omega", "omega", "alpha") for a in self.axes)

    def part(self, what: str, axis: str, of: ca.SX | None = None) -> ca.SX:
        """``Omega``, ``omega`` or ``alpha`` of an axis in y; zero where it is locked."""
        if axis not in self.axes:
            return ca.SX(0)
        return (self.y if of is None else of)[self.index(what, axis)]

    def index(self, what: str, axis: str) -> int:
        """Position in y."""
        return ("Omega", "omega", "alpha").index(what) * self.k + self.axes.index(axis)

    @property
    def weighted(self) -> bool:
        """Whether yaw may be weighed against pitch: both move, and M is diagonal."""
        return self.k == 2 and not isinstance(self.model, Lagrangian)

    @cached_property
    def to_motion(self) -> ca.Function:
        """``(x) → y``: rates by the model's own equations."""
        x, _, _, w = self.model.symbols()
        f = self.model.dynamics(x, ca.DM(self.u), ca.DM(self.model.parameters.values), w * 0)
        index = self.model.state_index
        rows = [f[index(f"alpha_{a}")] for a in self.axes]
        rows += [x[index(f"{what}_{a}")] for what in ("omega", "alpha") for a in self.axes]
        return ca.Function("to_motion", [x], [ca.vertcat(*rows)])

    @cached_property
    def to_state(self) -> ca.Function:
        """``(y) → x``, the inverse: rates are momenta plus what angles and speeds make of them."""
        index = self.model.state_index
        rows: list[ca.SX] = [ca.SX(0)] * self.model.n_x
        for a in self.axes:
            for what in ("omega", "alpha"):
                rows[index(f"{what}_{a}")] = self.part(what, a)
        without = self.to_motion(ca.vertcat(*rows))
        for i, a in enumerate(self.axes):
            rows[index(f"S_{a}")] = self.part("Omega", a) - without[i]
        return ca.Function("to_state", [self.y], [ca.vertcat(*rows)])

    def settling(self, axis: str, speed: ca.SX) -> ca.SX:
        """s at a speed."""
        rotor = self.rotors[axis]
        return ca.substitute(rotor.settling, rotor.omega, speed)

    def thrust(self, axis: str, speed: ca.SX) -> ca.SX:
        """F at a speed."""
        if axis not in self.axes:
            return ca.SX(0)
        rotor = self.rotors[axis]
        return ca.substitute(rotor.thrust, rotor.omega, speed)

    def potential(self, axis: str, angle: ca.SX) -> ca.SX:
        """Cable or gravity energy at an angle, without thrust, J."""
        if axis == "h":
            return 0.5 * self._cable(angle) * angle**2
        a, b = self.gravity
        return b * ca.cos(angle) - a * ca.sin(angle)

    def restoring(self, axis: str, angle: ca.SX) -> ca.SX:
        """Its derivative, N m."""
        if axis == "h":
            return self._cable(angle) * angle
        a, b = self.gravity
        return -a * ca.cos(angle) - b * ca.sin(angle)

    def stiffness(self, axis: str, angle: ca.SX) -> ca.SX:
        """Its second derivative, N m/rad."""
        if axis == "h":
            return self._cable(angle)
        a, b = self.gravity
        return a * ca.sin(angle) - b * ca.cos(angle)

    def _cable(self, angle: ca.SX) -> ca.SX:
        return by_direction(angle, ca.SX(self.c["k_chp"]), ca.SX(self.c["k_chn"]))

    def well(self, axis: str) -> ca.SX:
        """U of an axis, zero at the equilibrium, J.

        The thrust's moment is what the restoring moment is at the equilibrium, so that U' vanishes
        there by its form. Pitch is written by the deviation, α̃: ``U'' (1 − cos α̃) − U' (α̃ − sin
        α̃)`` with both at the equilibrium, without the thrust; near the fold, where the barrier is
        lower than what rounding leaves of a difference of potentials, nothing else has bounds.
        """
        at, rest = self.part("alpha", axis), self.part("alpha", axis, self.rest)
        if axis == "v":
            away = at - rest
            curved = 2.0 * self.stiffness(axis, rest) * ca.sin(0.5 * away) ** 2
            return curved - self.restoring(axis, rest) * (away - ca.sin(away))
        return (
            self.potential(axis, at)
            - self.potential(axis, rest)
            - self.restoring(axis, rest) * (at - rest)
        )

    def stored(self, axis: str) -> ca.SX:
        """∫ s dω of a rotor, zero at the equilibrium."""
        rotor = self.rotors[axis]
        ends = [
            ca.substitute(rotor.stored, rotor.omega, self.part("omega", axis, of))
            for of in (None, self.rest)
        ]
        return ends[0] - ends[1]

    @cached_property
    def _beam(self) -> Beam:
        """Of the axes that move."""
        beam, keep = beam_of(self), ["hv".index(a) for a in self.axes]
        square = (beam.mass, beam.power, beam.drift, beam.reaction)
        mass, power, drift, reaction = (matrix[keep, keep] for matrix in square)
        return Beam(mass, power, drift, beam.arms[keep], reaction)

    def mass(self, pitch: ca.SX) -> ca.SX:
        """M at a pitch angle, of the axes that move, kg m²."""
        if "v" not in self.axes:
            return self._beam.mass
        return ca.substitute(self._beam.mass, self.part("alpha", "v"), pitch)

    def _scales(self) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
        """Γ, E, K and C as diagonal matrices."""
        which = ["hv".index(a) for a in self.axes]
        gamma = ca.vertcat(self.weights[2], 1)[which]
        cross, rotor = self.weights[3:5][which], self.weights[0:2][which]
        friction = ca.SX([self.c[f"k_o{a}"] for a in self.axes])
        return ca.diag(gamma), ca.diag(cross), ca.diag(friction), ca.diag(rotor)

    @cached_property
    def moving(self) -> ca.Function:
        """``(y, ȳ, weights) →`` ½ yᵀΓM y and ½ α̃ᵀΓE(K − ME)α̃, (2, 1), J."""
        mass = self._beam.mass
        gamma, cross, friction, _ = self._scales()
        rates, away = self.y[: self.k], (self.y - self.rest)[2 * self.k :]
        swung = rates + cross @ away
        # Squares of single terms are never below zero in interval arithmetic either.
        kinetic = _quadratic(gamma @ mass, swung)
        cross_term = 0.5 * sum(
            gamma[i, i] * cross[i, i] * (friction[i, i] - mass[i, i] * cross[i, i]) * away[i] ** 2
            for i in range(self.k)
        )
        if self.k == 2:
            cross_term -= gamma[0, 0] * mass[0, 1] * cross[0, 0] * cross[1, 1] * away[0] * away[1]
        rows = ca.vertcat(kinetic, cross_term)
        return ca.Function("moving", [self.y, self.rest, self.weights], [rows])

    def alone(self, expression: ca.SX, what: str, axis: str) -> ca.Function:
        """An expression of one state and its value at rest, as ``(state, at rest) →``."""
        own = [self.part(what, axis, of) for of in (None, self.rest)]
        new = [ca.SX.sym("state"), ca.SX.sym("at_rest")]
        return ca.Function("alone", new, ca.substitute([expression], own, new))

    @cached_property
    def value(self) -> ca.Function:
        """``(y, ȳ, weights) → V``, J."""
        gamma, _, _, rotor = self._scales()
        v = ca.sum1(self.moving(self.y, self.rest, self.weights))
        for i, a in enumerate(self.axes):
            v += gamma[i, i] * self.well(a) + rotor[i, i] * self.stored(a)
        return ca.Function("V", [self.y, self.rest, self.weights], [v])

    @cached_property
    def inertia(self) -> ca.Function:
        """``(y) → M``, (k, k), kg m²."""
        return ca.Function("M", [self.y], [ca.densify(self._beam.mass)])

    @cached_property
    def decay(self) -> ca.Function:
        """``(y, θ, weights) → Q``, (3k, 3k), symmetric."""
        beam = self._beam
        gamma, cross, friction, rotor = self._scales()
        which = ["hv".index(a) for a in self.axes]
        wells = ca.diag(self.theta[2:4][which])
        coupled = wells
        if self.k == 2:
            turned = ca.SX(2, 2)
            turned[0, 1] = self.c["l_t"] * self.theta[5] * self.theta[4]
            coupled = wells + turned
        lacking = ca.diag(beam.arms * self.theta[0:2][which]) - beam.reaction
        rates = -beam.power - gamma @ cross @ beam.mass
        rates_speeds = -gamma @ lacking
        rates_angles = gamma @ (coupled - wells) - (gamma @ cross @ (beam.drift + friction)).T
        angles = gamma @ cross @ coupled
        speeds_angles = (-gamma @ cross @ lacking).T
        whole = ca.blockcat(
            [
                [rates, rates_speeds, rates_angles],
                [ca.SX(self.k, self.k), rotor, speeds_angles],
                [ca.SX(self.k, self.k), ca.SX(self.k, self.k), angles],
            ]
        )
        q = ca.densify(0.5 * (whole + whole.T))
        return ca.Function("Q", [self.y, self.theta, self.weights], [q])

    @cached_property
    def deviations(self) -> ca.Function:
        """``(y, ȳ) → z``, (3k, 1)."""
        speeds = [self.settling(a, self.part("omega", a)) for a in self.axes]
        away = (self.y - self.rest)[2 * self.k :]
        return ca.Function("z", [self.y, self.rest], [ca.vertcat(self.y[: self.k], *speeds, away)])

    @cached_property
    def slopes_between(self) -> ca.Function:
        """``(y, ȳ) → θ``, the slopes themselves, as quotients: not where a deviation is zero."""
        rows: list[ca.SX] = [ca.SX(0)] * len(SLOPES)
        for i, a in enumerate("hv"):
            if a not in self.axes:
                continue
            omega, rest = (self.part("omega", a, of) for of in (None, self.rest))
            rows[i] = (self.thrust(a, omega) - self.thrust(a, rest)) / self.settling(a, omega)
            alpha, zero = (self.part("alpha", a, of) for of in (None, self.rest))
            rows[2 + i] = (self.restoring(a, alpha) - self.restoring(a, zero)) / (alpha - zero)
        if self.k == 2:
            alpha, zero = (self.part("alpha", "v", of) for of in (None, self.rest))
            rows[4] = -(ca.cos(alpha) - ca.cos(zero)) / (alpha - zero)
            rows[5] = self.thrust("h", self.part("omega", "h", self.rest))
        return ca.Function("theta", [self.y, self.rest], [ca.vertcat(*rows)])

    @cached_property
    def derivative(self) -> ca.Function:
        """``(x, ȳ, weights) → V̇`` along the model's own equations, W."""
        x, _, _, w = self.model.symbols()
        f = self.model.dynamics(x, ca.DM(self.u), ca.DM(self.model.parameters.values), w * 0)
        v = self.value(self.to_motion(x), self.rest, self.weights)
        return ca.Function("V_dot", [x, self.rest, self.weights], [ca.jtimes(v, x, f)])


def _quadratic(matrix: ca.SX, z: ca.SX) -> ca.SX:
    """½ zᵀ A z of a symmetric matrix of one or two rows, as a sum of squares."""
    if z.numel() == 1:
        return 0.5 * matrix[0, 0] * z[0] ** 2
    if matrix[0, 1].is_zero():
        return 0.5 * (matrix[0, 0] * z[0] ** 2 + matrix[1, 1] * z[1] ** 2)
    beside = matrix[0, 1] / matrix[0, 0]
    rest = matrix[1, 1] - matrix[0, 1] * beside
    return 0.5 * (matrix[0, 0] * (z[0] + beside * z[1]) ** 2 + rest * z[1] ** 2)
