"""Which models have an energy function here, and what effects on them leave it one."""

from __future__ import annotations

from dataclasses import dataclass

from trms_cli.core.errors import ModelError
from trms_cli.effects.coulomb_friction import CoulombFriction
from trms_cli.effects.quadratic_damping import QuadraticDamping
from trms_cli.effects.stribeck_friction import StribeckFriction
from trms_cli.models.lagrangian import Lagrangian
from trms_cli.models.model import Model
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.twin_rotor import TwinRotor
from trms_cli.stability.subject import Subject, effects_of

#: Effects that only take energy from an axis: power −F_c|Ω| and the like.
_RESISTING = (CoulombFriction, StribeckFriction, QuadraticDamping)
_DRY = (CoulombFriction, StribeckFriction)
_INSTEAD = "study=region_of_attraction finds functions by computation for any model with equations"


@dataclass(frozen=True)
class Rig:
    """What the energy is of."""

    model: TwinRotor  #: Without effects
    #: ``resisting``, ``dry``: Names of the effects that resist motion, and of those among them that
    #: hold it at rest
    resisting: tuple[str, ...]
    dry: tuple[str, ...]


def rig_of(subject: Subject) -> Rig:
    """The rig beneath a subject.

    Raises ModelError for a model whose energy is not stated here, and for an effect that changes
    it.
    """
    model: Model = subject.require_equations("a Lyapunov function")
    resisting: list[str] = []
    dry: list[str] = []
    for name, effect in effects_of(model):
        if isinstance(effect, _RESISTING):
            resisting.append(name)
            if isinstance(effect, _DRY):
                dry.append(name)
        else:
            raise ModelError(
                f"effect {name!r} changes the motion in a way that the energy does not follow",
                where=f"effect.{name}",
                remedy="leave it out; friction and damping of an axis may stay. " + _INSTEAD,
            )
    model = model.without_effects()
    if not isinstance(model, Newtonian | Lagrangian):
        raise ModelError(
            f"the energy of model {subject.name!r} is not stated here, only that of the Newtonian "
            "and the Lagrangian TRMS",
            where="model",
            remedy="choose model=newtonian, newtonian_vertical, newtonian_horizontal or lagrangian "
            f"(lagrangian_…) with any parameters; {_INSTEAD}",
        )
    if model.stiff:
        raise ModelError(
            "the functions are those of rotors with quasi-static currents, and this model has the "
            "currents as states",
            where="model.currents",
            remedy="model.currents=quasi_static (it differs by less than 1e-4 rad)",
        )
    _require_friction_and_cable(model)
    return Rig(model, tuple(resisting), tuple(dry))


def _require_friction_and_cable(model: TwinRotor) -> None:
    c = {p.name: p.value for p in model.parameters}
    for axis, name in (("h", "yaw"), ("v", "pitch")):
        if f"alpha_{axis}" in model.state_names and not c[f"k_o{axis}"] > 0.0:
            raise ModelError(
                f"k_o{axis} = {c[f'k_o{axis}']:g}: without viscous friction of {name} its energy "
                "has nothing to fall by",
                where=f"model.parameters.k_o{axis}",
                remedy="give it a value above 0",
            )
    if "alpha_h" in model.state_names and not min(c["k_chp"], c["k_chn"]) > 0.0:
        raise ModelError(
            "without a cable that pulls back (k_chp, k_chn > 0) yaw rests anywhere: there is no "
            "single equilibrium to prove",
            where="model.parameters.k_chp",
            remedy="give both a value above 0, or choose model=newtonian_vertical",
        )
