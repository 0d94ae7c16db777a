"""Model form: laws of an axis that are of another form than the model's, by small departures.

No rig follows its model's laws to the letter, and what they leave looks like many small causes at
once. Each term is what the model's own law becomes when its form changes a little, as a share of
what that law does::

    damping   −c Ω (|Ω|/Ω₀)ᵈ
    thrust    l F (|ω|/ω₀)ᵉ
    spring    −k α (1 + h α²)
    inertia   (1 + i) J Ω̇ = all moments

with ``−c`` the slope of the model's moments in the axis' rate and ``−k`` in its angle, both while
the beam stands still, and ``l F`` the moment of the axis' own rotor. At the rate Ω₀ and the speed
ω₀ another exponent changes nothing: what it changes there is the coefficient's matter. Impulses
(dry friction, stops) meet the inertia of the model beneath.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, ClassVar

import casadi as ca
from msgspec import Meta

from trms_cli.effects.effect import Effect, EffectContext, axis_of, require_quantities, speed_row
from trms_cli.models.beam_rig import AXES, ROTORS, USUAL_SPANS
from trms_cli.models.dry_friction import moment_index
from trms_cli.models.model import Model
from trms_cli.models.parameters import Parameter

#: rad/s. Ω₀; below these shares of Ω₀ and ω₀ an exponent no longer changes anything.
_USUAL_RATE, _LEAST_RATE, _LEAST_SPEED = 0.3, 3e-3, 3e-3

#: By how much a law's form may differ.
Departure = Annotated[float, Meta(ge=-0.6, le=0.6)]


@dataclass(frozen=True, kw_only=True)
class ModelForm(Effect):
    """Departures of an axis' laws from the model's."""

    #: It says by how much a model errs, and is no candidate unless it is asked for
    explains: ClassVar[bool] = False
    axis: str  #: Name of an axis of the model
    damping: Departure = 0.0  #: d, added to the exponent of damping
    thrust: Departure = 0.0  #: e, added to the exponent of thrust
    spring: Departure = 0.0  #: h, 1/rad²
    inertia: Departure = 0.0  #: i, share by which the moment of inertia is larger

    @property
    def rotor(self) -> str:
        """The rotor whose thrust turns the axis; empty: none of a beam's does."""
        turning = (name for name, rotor in ROTORS.items() if rotor.axis == self.axis)
        return next(turning, "")

    @property
    def locations(self) -> tuple[str, ...]:
        return (f"{self.axis}_moment",)

    def parameters(self) -> tuple[Parameter, ...]:
        usual, axis, rotor = (-0.1, 0.1), self.axis, self.rotor
        return (
            self.size("damping", "1", usual, f"exponent of {axis} damping, beyond the model's"),
            self.size("thrust", "1", usual, f"exponent of {rotor} thrust, beyond the model's"),
            self.size("spring", "1/rad^2", usual, f"hardening of what pulls {axis} back"),
            self.size("inertia", "1", usual, f"share of {axis} inertia beyond the model's"),
        )

    def check(self, model: Model) -> None:
        axis_of(model, self.axis)
        moment_index(model, self.axis)
        speed_row(model, self.rotor)
        require_quantities(model, f"thrust_{self.rotor}", f"arm_{self.rotor}")

    def disturbance(self, at: EffectContext) -> ca.SX:
        sizes, rotor = at.sizes, self.rotor
        usual_speed = USUAL_SPANS[f"{rotor}_speed"][1]  # ω₀, where another exponent changes nothing
        moment, in_rate, in_angle = _own_laws(at, self.axis)
        rate, angle = at.rate(self.axis), at.angle(self.axis)
        thrust = at.quantity(f"arm_{rotor}") * at.quantity(f"thrust_{rotor}")
        added = in_rate * rate * _departure(rate / _USUAL_RATE, _LEAST_RATE, sizes["damping"])
        added += thrust * _departure(at.speed(rotor) / usual_speed, _LEAST_SPEED, sizes["thrust"])
        added += in_angle * angle**3 * sizes["spring"]
        # with more inertia all moments do less
        added -= sizes["inertia"] / (1 + sizes["inertia"]) * (moment + added)
        return at.on(at.axis(self.axis).moment, added)


def _departure(ratio: ca.SX, least: float, exponent: ca.SX) -> ca.SX:
    """By which share a law changes with its exponent."""
    return ca.exp(exponent * 0.5 * ca.log(ratio**2 + least**2)) - 1


def _own_laws(at: EffectContext, axis: str) -> tuple[ca.SX, ca.SX, ca.SX]:
    """All moments on an axis, N m, and their slopes in its rate and angle with the beam at rest.

    In motion the slope in a rate is that of Coriolis' moment as well.
    """
    model, axes = at.model, list(at.model.axes)
    x, u, p, w = model.symbols()
    here = EffectContext(model, x, u, p, w, ca.SX.zeros(0), {})
    acceleration, mobility = here.accelerations(axis)
    moment = acceleration / mobility
    # rates are affine in the states that torques on the axes push: momenta, or the rates themselves
    rates = ca.vertcat(*(here.rate(name) for name in axes))
    torques = [moment_index(model, name) for name in axes]
    pushed = ca.jacobian(model.dynamics(x, u, p, w), w)[:, torques]
    in_state = ca.jacobian(rates, x)
    momentum_rows = [i for i in range(model.n_x) if in_state[:, i].nnz() and pushed[i, :].nnz()]
    per_rate = ca.inv(ca.densify(in_state[:, momentum_rows]))
    still = ca.SX(x)
    still[momentum_rows] = x[momentum_rows] - per_rate @ rates
    in_rate = ca.jacobian(moment, x[momentum_rows]) @ per_rate[:, axes.index(axis)]
    in_angle = ca.jacobian(moment, x[model.state_index(axis_of(model, axis).angle)])
    symbols = [x, u, p, w]
    at_rest = ca.Function("at_rest", symbols, [still])(at.x, at.u, at.p, at.w)
    slopes = ca.Function("slopes", symbols, [in_rate, in_angle])(at_rest, at.u, at.p, at.w)
    return ca.Function("moment", symbols, [moment])(at.x, at.u, at.p, at.w), *slopes


#: The laws of both axes, as the model has them.
MODEL_FORM: Mapping[str, ModelForm] = {f"{axis}_model_form": ModelForm(axis=axis) for axis in AXES}
