"""What rotors do beyond what a model has of them: a pack for models that have rotors."""

from dataclasses import dataclass
from typing import Annotated, ClassVar

import casadi as ca
from msgspec import Meta

from trms_cli.core.ranges import NotNegative, Positive
from trms_cli.effects.effect import Effect, EffectContext, axis_of, require_quantities, speed_row
from trms_cli.models.model import Model
from trms_cli.models.parameters import Parameter

#: rad/s: below it a power of the speed no longer changes, or its derivative at zero would be
#: infinite.
_SLOWEST = 1e-3
#: (rad/s)²: keeps F/ω, which is zero at rest, free of a division by zero.
_AT_REST = 1e-6
#: m: a thinner cushion would be a step for the integrator.
_THINNEST = 1e-2
#: Axis that a rotor does not thrust on.
_OTHER_AXIS = {"main": "yaw", "tail": "pitch"}
#: 1 to 10 % of the torque of the rotor's thrust; the inertia of the rotor itself.
_TYPICAL_DRAG = {"main": (4e-8, 5e-7), "tail": (5e-9, 1e-7)}
_TYPICAL_INERTIA = {"main": (-2e-4, 2e-4), "tail": (-3e-5, 3e-5)}


class ThrustEffect(Effect):
    """A change of one rotor's thrust; the model has to name the thrust and its arm."""

    rotor: str

    @property
    def locations(self) -> tuple[str, ...]:
        return (f"{self.rotor}_thrust",)

    def check(self, model: Model) -> None:
        speed_row(model, self.rotor)
        axis_of(model, model.rotors[self.rotor].axis)
        require_quantities(model, f"thrust_{self.rotor}", f"arm_{self.rotor}")

    def torque(self, at: EffectContext, thrust: ca.SX) -> ca.SX:
        """The disturbance vector (n_w, 1) of an additional thrust (N) at its arm."""
        return at.on(
            at.axis(at.model.rotors[self.rotor].axis).moment,
            at.quantity(f"arm_{self.rotor}") * thrust,
        )


@dataclass(frozen=True, kw_only=True)
class ThrustCurve(ThrustEffect):
    """Thrust that does not go with the square of the speed, or differs more by direction.

    The model's thrust F(ω) is multiplied by a power of the speed, and by another factor in
    reverse::

        F′(ω) = F(ω) (|ω|/ω₀)ᵉ          ω ≥ 0
        F′(ω) = F(ω) (|ω|/ω₀)ᵉ (1 + r)  ω < 0

    At the speed ω₀ the power changes nothing, so that ω₀ is where the model's coefficient was
    measured.
    """

    rotor: str  #: Name of a rotor of the model
    exponent: Annotated[float, Meta(ge=-1, le=1)]  #: e, added to the model's exponent (of about 2)
    #: r, share by which the thrust in reverse differs from the model's
    reverse: Annotated[float, Meta(ge=-1, le=1)]
    reference: Positive  #: ω₀, rad/s

    def parameters(self) -> tuple[Parameter, ...]:
        return (
            self.size("exponent", "1", (-0.3, 0.3), "e, beyond the model's exponent"),
            self.size("reverse", "1", (-0.3, 0.3), "r, share of the thrust in reverse"),
        )

    def disturbance(self, at: EffectContext) -> ca.SX:
        omega = at.speed(self.rotor)
        relative = ca.fmax(ca.fabs(omega), _SLOWEST) / self.reference
        direction = 1 + at.sizes["reverse"] * (omega < 0)
        factor = ca.exp(at.sizes["exponent"] * ca.log(relative)) * direction
        return self.torque(at, at.quantity(f"thrust_{self.rotor}") * (factor - 1))


@dataclass(frozen=True, kw_only=True)
class Inflow(ThrustEffect):
    """Inflow: a rotor that moves along its own axis in the direction of its thrust thrusts less.

    The angle of attack of the blades falls by the axial speed v over that of the blades, to first
    order (the advance ratio; Leishman, Principles of Helicopter Aerodynamics, 2006, ch. 2)::

        ΔF = −k (v/ω) F(ω),   v = ℓ Ω

    with the arm ℓ and the rate Ω of the rotor's own axis. As F goes with ω|ω|, this damps the axis
    in proportion to the speed of the rotor, whichever way it turns.
    """

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


@dataclass(frozen=True, kw_only=True)
class GroundEffect(ThrustEffect):
    """Ground effect: on its cushion of air near the table the main rotor thrusts more.

    ``F′ = F (1 + g exp(−h/h₀))`` while it blows down, with its height over the table
    ``h = h_level + ℓ sin α``.
    """

    may_begin: ClassVar[bool] = False

    rotor = "main"

    gain: NotNegative  #: g: share of the thrust that is added at the table itself
    scale: Annotated[float, Meta(ge=_THINNEST)]  #: h₀, m: height over which it falls to 1/e
    #: h_level, m: height of the rotor over the table with the beam level
    level_height: NotNegative

    def parameters(self) -> tuple[Parameter, ...]:
        return (
            self.size("gain", "1", (0.1, 0.6), "g, at the table"),
            self.size("scale", "m", (0.03, 0.2), "height h₀ of the cushion"),
        )

    def disturbance(self, at: EffectContext) -> ca.SX:
        height = self.level_height + at.quantity("arm_main") * ca.sin(at.angle("pitch"))
        thrust = ca.fmax(at.quantity("thrust_main"), 0)
        more = at.sizes["gain"] * ca.exp(-height / at.sizes["scale"])
        return self.torque(at, thrust * more)


@dataclass(frozen=True, kw_only=True)
class RotorReaction(Effect):
    """Reaction of a rotor on the other axis: what turns the air and the rotor turns the beam.

    The motor drives the rotor against the drag of the air and against its inertia; the beam bears
    the same torque. The main rotor's axis is upright with the beam level, the tail rotor's is the
    pitch axis::

        main:  τ_yaw   = (c ω_v|ω_v| + J dω_v/dt) cos α
        tail:  τ_pitch =  c ω_h|ω_h| + J dω_h/dt

    This is beyond what the model has of it (``k_m`` and ``k_t`` of the Newtonian model are inertias
    of this kind), and may therefore have either sign.
    """

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


@dataclass(frozen=True, kw_only=True)
class GyroscopicCoupling(Effect):
    """Gyroscopic coupling of the axes by the angular momentum of the main rotor.

    A rotor of inertia J whose axis leans by α + β from the vertical (α the pitch, β how far it
    leans on the level beam) has the kinetic energy ``½ J (ω − Ω_yaw cos(α + β))²``. Lagrange's
    equations for a speed ω that its motor governs give::

        τ_pitch =  J ω Ω_yaw   sin(α + β)
        τ_yaw   = −J ω Ω_pitch sin(α + β)

    which together do no work. The sign of ω is that of the model, whose rotor turns the beam the
    other way (``k_m`` > 0). The term of ``dω/dt`` is that of :class:`RotorReaction`. The tail
    rotor's axis is the pitch axis: it turns with the yaw only, and couples nothing.
    """

    may_begin: ClassVar[bool] = False

    #: J, kg m², beyond what the model has; either sign
    inertia: Annotated[float, Meta(ge=-1e-2, le=1e-2)]
    #: β, rad: 0 for a rotor whose axis is upright on the level beam
    lean: Annotated[float, Meta(ge=-1.6, le=1.6)]

    def parameters(self) -> tuple[Parameter, ...]:
        return (
            self.size(
                "inertia", "kg*m^2", (1e-05, 6e-05), "inertia J of the rotor, beyond the model's"
            ),
        )

    def check(self, model: Model) -> None:
        speed_row(model, "main")
        for axis in ("pitch", "yaw"):
            axis_of(model, axis)

    def disturbance(self, at: EffectContext) -> ca.SX:
        momentum = at.sizes["inertia"] * at.speed("main") * ca.sin(at.angle("pitch") + self.lean)
        return at.on(at.axis("pitch").moment, momentum * at.rate("yaw")) + at.on(
            at.axis("yaw").moment, -momentum * at.rate("pitch")
        )
