"""Places of a rig's block diagram, from the command to the sensor, as a model has them.

An equation's place is the disturbance that is a force on it (``yaw_moment``, ``main_motor``). The
others are named for what they belong to: the actuator for its rotor, a sensor for the axis whose
angle, or the rotor whose speed it shows; where there is neither, for the signal itself.
"""

import casadi as ca

from trms_cli.effects.effect import EffectContext, SensorEffect
from trms_cli.effects.extended_model import ExtendedModel
from trms_cli.models.model import Model, names


def actuator_place(model: Model, name: str) -> str:
    """Place on the path of an input of that name."""
    rotors = {rotor.input: own for own, rotor in model.rotors.items()}
    return f"{rotors.get(name, name)}_actuator"


def sensor_place(model: Model, name: str) -> str:
    """Place of the sensor of an output of that name."""
    axes = {axis.angle: own for own, axis in model.axes.items()}
    rotors = {rotor.speed: own for own, rotor in model.rotors.items()}
    return f"{rotors[name]}_tacho" if name in rotors else f"{axes.get(name, name)}_sensor"


def places_of(model: ExtendedModel) -> tuple[str, ...]:
    """Where the effect acts that a model has last.

    An effect says so itself, by its ``locations``; else it is read from what it overrides: the path
    of its rotor's input, its sensor, or the equation on which it puts an impulse or a torque.
    """
    base, effect = model.base, model.effect
    if effect.locations:
        return tuple(effect.locations)
    axis = base.axes.get(getattr(effect, "axis", ""))
    rotor = base.rotors.get(getattr(effect, "rotor", ""))
    if effect.overrides("input_path", "memory"):
        inputs = tuple(effect.port(base).values()) or names(base.inputs)
        return tuple(actuator_place(base, name) for name in inputs)
    if effect.overrides("output", "reading", "sensor_path"):
        outputs = names(base.outputs)
        if isinstance(effect, SensorEffect):
            outputs = (outputs[effect.row(base)],)
        return tuple(sensor_place(base, name) for name in outputs)
    if effect.overrides("disturbance") and (equations := _disturbed_equations(model)):
        return equations
    if rotor is not None:
        return (rotor.torque,)
    return () if axis is None else (axis.moment,)


def _disturbed_equations(model: ExtendedModel) -> tuple[str, ...]:
    """Equations on which an effect puts a torque, as its expressions say."""
    base, effect = model.base, model.effect
    x, u, p, w = base.symbols()
    sizes = {q.name: ca.SX.sym(q.name) for q in effect.parameters()}
    own = ca.SX.sym("own", len(effect.states()))
    torque = effect.disturbance(EffectContext(base, x, u, p, w, own, sizes))
    return tuple(
        signal.name for i, signal in enumerate(base.disturbances) if not torque[i].is_zero()
    )
