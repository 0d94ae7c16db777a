"""What acts on an axis: friction, springs, drag, a weight, a pull, draughts."""

import math
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, ClassVar

import casadi as ca
from msgspec import Meta

from trms_cli.core.ranges import NotNegative, Positive
from trms_cli.effects.effect import (
    Effect,
    EffectContext,
    axis_of,
    motor_disturbance,
    resisting_impulse,
    speed_row,
)
from trms_cli.models.model import Model, Signal
from trms_cli.models.parameters import Parameter

#: What is faster (rad/s), narrower (rad) or briefer (s) than this is nothing that an integration
#: step resolves: the falling branch of Stribeck friction, a hysteresis loop, coloured noise.
_SLOWEST, _NARROWEST, _SHORTEST = 1e-3, 1e-3, 0.05
#: m/s², for a model that has no ``g`` among its parameters (CGPM 1901).
_STANDARD_GRAVITY = 9.80665
_Signed = Annotated[float, Meta(ge=-1e6, le=1e6)]


@dataclass(frozen=True, kw_only=True)
class CoulombFriction(Effect):
    """Coulomb friction of an axis: a constant torque against the motion, set-valued at rest.

    ``τ = −F_c sgn(Ω)`` while the axis turns; at rest any torque in [−F_c, F_c] that keeps it there.
    """

    axis: str  #: Name of an axis of the model
    torque: NotNegative | None = None  #: F_c, N m

    def parameters(self) -> tuple[Parameter, ...]:
        return (self.size("torque", "N*m", (0.002, 0.02), "Coulomb torque F_c"),)

    def impulse(self, at: EffectContext, duration: float) -> ca.SX:
        return resisting_impulse(at, self.axis, at.sizes["torque"], duration)


@dataclass(frozen=True, kw_only=True)
class StribeckFriction(Effect):
    """Stribeck friction of an axis: it takes more torque to break away than to keep turning.

    ::

        τ = −F(Ω) sgn(Ω),   F(Ω) = F_c (1 + e exp(−(Ω/v_s)²)),   |τ| ≤ F_c (1 + e) at rest

    (Armstrong-Hélouvry, Dupont & Canudas de Wit 1994, Automatica 30). An impulse like Coulomb
    friction, of the size that belongs to the mean rate of each integration step: exact at
    break-away, without creep, of second order while the axis turns. With no excess it is Coulomb
    friction, bit for bit.
    """

    #: Bristles alone hold a tenth more at rest than they resist in motion, and do so while they
    #: bend: an excess that is gone at a few mrad/s is theirs
    special_case: ClassVar[tuple[type[Effect], Mapping[str, float]] | None] = (
        CoulombFriction,
        {"excess": 2.0, "velocity": 0.6},
    )

    axis: str  #: Name of an axis of the model
    torque: NotNegative | None = None  #: F_c, N m: friction of the turning axis
    excess: NotNegative | None = None  #: e = F_s/F_c − 1: break-away torque over it
    #: v_s, rad/s: rate at which the excess has fallen to 1/e
    velocity: Annotated[float, Meta(ge=_SLOWEST)] | None = None

    def parameters(self) -> tuple[Parameter, ...]:
        return (
            self.size("torque", "N*m", (0.002, 0.02), "Coulomb torque F_c"),
            self.size("excess", "1", (0.1, 1.0), "F_s/F_c − 1"),
            self.size("velocity", "rad/s", (0.01, 0.1), "Stribeck velocity v_s"),
        )

    def impulse(self, at: EffectContext, duration: float) -> ca.SX:
        torque, excess, velocity = (at.sizes[key] for key in ("torque", "excess", "velocity"))

        def friction(rate: ca.SX) -> ca.SX:
            return torque * (1 + excess * ca.exp(-((rate / velocity) ** 2)))

        return resisting_impulse(at, self.axis, friction, duration)


@dataclass(frozen=True, kw_only=True)
class RotorFriction(Effect):
    """Coulomb friction of a rotor: brushes and bearing hold it until the motor is stronger.

    ``τ = −F_c sgn(ω)`` on the rotor while it turns; at rest any torque in [−F_c, F_c] that keeps it
    there, by the same impulses as the friction of an axis (:mod:`trms_cli.models.dry_friction`).
    """

    rotor: str  #: Name of a rotor of the model
    torque: NotNegative  #: F_c, N m

    def parameters(self) -> tuple[Parameter, ...]:
        return (self.size("torque", "N*m", (0.0005, 0.002), "Coulomb torque F_c"),)

    def check(self, model: Model) -> None:
        speed_row(model, self.rotor)
        motor_disturbance(model, self.rotor)

    def impulse(self, at: EffectContext, duration: float) -> ca.SX:
        return resisting_impulse(at, self.rotor, at.sizes["torque"], duration)


@dataclass(frozen=True, kw_only=True)
class AxisForce(Effect):
    """A force on the equation of an axis."""

    axis: str  #: Name of an axis of the model

    def disturbance(self, at: EffectContext) -> ca.SX:
        return at.on(at.axis(self.axis).moment, self.force(at))

    @abstractmethod
    def force(self, at: EffectContext) -> ca.SX:
        """N m, or N where the axis slides."""


@dataclass(frozen=True, kw_only=True)
class ConstantTorque(AxisForce):
    """A torque on an axis that does not change: a weight at one holding point, a pull, a spring.

    ``τ = c``. What makes it is not said, so that it explains nothing: a comparison with a known
    state tells it, and it corrects a model.
    """

    explains: ClassVar[bool] = False

    torque: Annotated[float, Meta(ge=-1e3, le=1e3)] | None = None  #: N m

    def parameters(self) -> tuple[Parameter, ...]:
        return (self.size("torque", "N*m", (-0.02, 0.02), "constant torque"),)

    def force(self, at: EffectContext) -> ca.SX:
        return at.sizes["torque"]


@dataclass(frozen=True, kw_only=True)
class QuadraticDamping(AxisForce):
    """Quadratic damping of an axis: air drag of the moving beam, ``τ = −c Ω|Ω|``."""

    coefficient: NotNegative | None = None  #: c, N m s²/rad²

    def parameters(self) -> tuple[Parameter, ...]:
        return (self.size("coefficient", "N*m*s^2/rad^2", (0.002, 0.02), "damping coefficient c"),)

    def force(self, at: EffectContext) -> ca.SX:
        rate = at.rate(self.axis)
        return -at.sizes["coefficient"] * rate * ca.fabs(rate)


@dataclass(frozen=True, kw_only=True)
class CableStiffness(AxisForce):
    """Stiffness of the cable that an axis drags along, beyond what the model has of it.

    ``τ = −k (α − α₀) − k₃ (α − α₀)³``: the cubic part is a cable that tightens towards the ends of
    its travel; ``α₀`` is where it hangs free.
    """

    stiffness: NotNegative | None = None  #: k, N m/rad
    cubic: NotNegative = 0.0  #: k₃, N m/rad³
    neutral: Annotated[float, Meta(ge=-3.2, le=3.2)] = 0.0  #: α₀, rad

    def parameters(self) -> tuple[Parameter, ...]:
        return (
            self.size("stiffness", "N*m/rad", (0.002, 0.02), "k"),
            self.size("cubic", "N*m/rad^3", (0.0, 0.01), "k₃"),
            self.size("neutral", "rad", (-0.3, 0.3), "free angle α₀"),
        )

    def force(self, at: EffectContext) -> ca.SX:
        stretch = at.angle(self.axis) - at.sizes["neutral"]
        return -at.sizes["stiffness"] * stretch - at.sizes["cubic"] * stretch**3


@dataclass(frozen=True, kw_only=True)
class CableHysteresis(AxisForce):
    """Hysteresis of the cable of an axis: a torque that remembers where it came from.

    Bouc–Wen (Bouc 1967; Wen 1976, J. Eng. Mech. Div. 102; Ismail, Ikhouane & Rodellar 2009, Arch.
    Comput. Methods Eng. 16), normalised so that the memory ``z`` stays in [−1, 1]::

        τ = −T z        ż = [Ω − β |Ω| |z|ⁿ⁻¹ z − (1 − β) Ω |z|ⁿ] / width

    It depends on the path of the angle and not on the speed at which it is travelled. At small
    strokes it is a spring of stiffness ``T/width``, at large ones a friction of ``T``. With
    ``1/2 ≤ β ≤ 1`` it takes energy out of every closed cycle.
    """

    torque: NotNegative | None = None  #: T, N m: half the height of the loop
    #: rad: the travel after a reversal over which the torque turns
    width: Annotated[float, Meta(ge=_NARROWEST)] | None = None
    #: β: 1/2 unloads along a straight line, 1 along the same exponential as it loads (Dahl)
    beta: Annotated[float, Meta(ge=0.5, le=1)] = 0.5
    exponent: Annotated[float, Meta(ge=1)] = 1.0  #: n: how sharply the loop bends into saturation

    def parameters(self) -> tuple[Parameter, ...]:
        return (
            self.size("torque", "N*m", (0.002, 0.01), "half height T"),
            self.size("width", "rad", (0.05, 0.3), "turning travel"),
        )

    def states(self) -> tuple[Signal, ...]:
        share = "share of the hysteresis torque, −1 to 1"
        return (Signal("memory", "1", share, path_memory=True),)

    def derivative(self, at: EffectContext) -> ca.SX:
        rate, z = at.rate(self.axis), at.own[0]
        fullness = ca.fabs(z) ** self.exponent
        # |z|ⁿ⁻¹ z is written by the sign: a power n − 1 < 1 has no derivative at zero.
        against = self.beta * ca.fabs(rate) * fullness * ca.sign(z)
        return (rate - against - (1 - self.beta) * rate * fullness) / at.sizes["width"]

    def force(self, at: EffectContext) -> ca.SX:
        return -at.sizes["torque"] * at.own[0]


@dataclass(frozen=True, kw_only=True)
class Cogging(AxisForce):
    """Cogging of an axis: a force that returns along its way, as of a motor's teeth or a screw.

    ``τ = −a sin(2π α/L) − b cos(2π α/L)`` with the period L of the way.
    """

    sine: _Signed | None = None  #: a, N m
    cosine: _Signed = 0.0  #: b, N m
    period: Positive | None = None  #: L, rad

    def parameters(self) -> tuple[Parameter, ...]:
        return (
            self.size("sine", "N*m", (-0.01, 0.01), "amplitude a of the sine"),
            self.size("cosine", "N*m", (-0.01, 0.01), "amplitude b of the cosine"),
            self.size("period", "rad", (0.05, 0.5), "period L of the way"),
        )

    def force(self, at: EffectContext) -> ca.SX:
        phase = 2 * math.pi * at.angle(self.axis) / at.sizes["period"]
        return -(at.sizes["sine"] * ca.sin(phase) + at.sizes["cosine"] * ca.cos(phase))


@dataclass(frozen=True, kw_only=True)
class Disturbance(AxisForce):
    """An exogenous torque on an axis: draughts and pushes, of which only statistics are known.

    Coloured noise of the first order (Ornstein & Uhlenbeck 1930), with the torque d as a state that
    begins at zero::

        ḋ = −d/τ + white noise,      in the long run d has the standard deviation σ

    The rig draws the noise from its seed. A model has the same state; an observer estimates it,
    with the noise as its process noise; without one it decays. It is estimated, not explained.
    """

    torque: NotNegative | None = None  #: σ, N m: standard deviation in the long run
    #: τ, s: time over which it forgets itself
    time: Annotated[float, Meta(ge=_SHORTEST)] | None = None

    def parameters(self) -> tuple[Parameter, ...]:
        return (
            self.size("torque", "N*m", (0.002, 0.02), "standard deviation σ"),
            self.size("time", "s", (0.3, 3.0), "correlation time τ"),
        )

    def states(self) -> tuple[Signal, ...]:
        return (Signal("torque", "N*m", "exogenous torque"),)

    def derivative(self, at: EffectContext) -> ca.SX:
        return -at.own / at.sizes["time"]

    def force(self, at: EffectContext) -> ca.SX:
        return at.own[0]

    def noise_sd(self, at: EffectContext, step: float) -> ca.SX:
        """What keeps the variance of ``d⁺ = exp(−h/τ) d + noise`` at σ²."""
        forgotten = 1 - ca.exp(-2 * step / at.sizes["time"])
        return at.sizes["torque"] * ca.sqrt(forgotten)


@dataclass(frozen=True, kw_only=True)
class MassImbalance(Effect):
    """A mass on the beam that the model does not know: a shifted counterweight, a camera, a cable.

    A point mass ``m`` that sits ``l`` along the beam towards the tail and ``h`` above it is at the
    distance ``r(α) = l cos α + h sin α`` behind the yaw axis when the pitch is ``α``. With
    ``r′ = h cos α − l sin α`` (its height over the pitch axis) Lagrange's equations give::

        τ_pitch = m g r + m r r′ Ω_yaw² − m (l² + h²) dΩ_pitch/dt
        τ_yaw   = −2 m r r′ Ω_pitch Ω_yaw − m r² dΩ_yaw/dt

    The accelerations are those with the mass in place: the effect asks the model beneath for its
    accelerations without the mass and for the mobility of its axes, and solves the linear
    equations. An axis that is locked drops out.
    """

    mass: NotNegative  #: m, kg
    #: l, m: along the beam from the pitch axis, positive towards the tail (raises the nose)
    arm: Annotated[float, Meta(ge=-1, le=1)]
    #: h, m: above the beam; negative is below it, like the counterweight
    height: Annotated[float, Meta(ge=-1, le=1)] = 0.0

    def parameters(self) -> tuple[Parameter, ...]:
        return (
            self.size("mass", "kg", (0.002, 0.02), "added mass m"),
            self.size("arm", "m", (-0.28, 0.28), "l, positive towards the tail"),
            self.size("height", "m", (-0.28, 0.05), "h, above the beam"),
        )

    def check(self, model: Model) -> None:
        axis_of(model, "pitch")

    def disturbance(self, at: EffectContext) -> ca.SX:
        mass, arm, height = (at.sizes[name] for name in ("mass", "arm", "height"))
        alpha, pitch_rate = at.angle("pitch"), at.rate("pitch")
        behind = arm * ca.cos(alpha) + height * ca.sin(alpha)
        above = height * ca.cos(alpha) - arm * ca.sin(alpha)
        torques = [mass * _gravity(at) * behind]
        inertias = [mass * (arm**2 + height**2)]
        axes = ["pitch"]
        if "yaw" in at.model.axes:
            yaw_rate = at.rate("yaw")
            torques[0] += mass * behind * above * yaw_rate**2
            torques.append(-2 * mass * behind * above * pitch_rate * yaw_rate)
            inertias.append(mass * behind**2)
            axes.append("yaw")
        free, mobility = at.accelerations(*axes)
        inertia = ca.diag(ca.vertcat(*inertias))
        moments = ca.solve(
            ca.SX.eye(len(axes)) + inertia @ mobility, ca.vertcat(*torques) - inertia @ free
        )
        result = ca.SX.zeros(at.model.n_w)
        for k, axis in enumerate(axes):
            result += at.on(at.axis(axis).moment, moments[k])
        return result


def _gravity(at: EffectContext) -> ca.SX:
    parameters = at.model.parameters
    if "g" in parameters:
        return at.p[parameters.names.index("g")]
    return ca.SX(_STANDARD_GRAVITY)
