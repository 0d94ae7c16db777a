"""What each state of a model is: the kind by which an observer sets its noise."""

from typing import Literal

import casadi as ca

from trms_cli.core.process_cache import call_memoised
from trms_cli.models.discrete import copied_states
from trms_cli.models.model import Model, names

Kind = Literal["angle", "momentum", "rotor", "speed", "current", "past", "other"]
DisturbanceKind = Literal["disturbance", "rotor_disturbance", "acceleration", "rotor_acceleration"]
#: Unit of the disturbances of a black box, which knows no torques.
_ACCELERATION = "rad/s^2"


def kinds_of_states(model: Model) -> tuple[Kind, ...]:
    """The kind of each state, read off the model's structure.

    An axis names its angle; a momentum is the state that the axis' moment pushes; a rotor's speed
    is the state that another torque pushes; a current is in ampere. A black box has
    speeds in place of rotors, and states that a step only copies: the past of another or of an
    input.
    """
    return call_memoised(_kinds_of_states, model)


def _kinds_of_states(model: Model) -> tuple[Kind, ...]:
    x, u, p, w = model.symbols()
    follow = model.dynamics if model.sample_time is None else model.transition
    pushes = ca.jacobian(follow(x, u, p, w), w)
    copies = copied_states(model)
    moments = {axis.moment for axis in model.axes.values()}
    angles = {axis.angle for axis in model.axes.values()}
    kinds: list[Kind] = []
    for i, state in enumerate(model.states):
        pushed_by = {
            name for j, name in enumerate(names(model.disturbances)) if pushes[i, j].nnz() > 0
        }
        if state.name in angles:
            kinds.append("angle")
        elif i in copies:
            kinds.append("past")
        elif pushed_by & moments:
            kinds.append("momentum")
        elif pushed_by:
            kinds.append("rotor" if model.sample_time is None else "speed")
        elif state.unit == "A":
            kinds.append("current")
        else:
            kinds.append("other")
    return tuple(kinds)


def kinds_of_disturbances(model: Model) -> tuple[DisturbanceKind, ...]:
    """The kind of each disturbance: torques and accelerations, on the axes and elsewhere."""
    moments = {axis.moment for axis in model.axes.values()}
    kinds: list[DisturbanceKind] = []
    for signal in model.disturbances:
        if signal.unit == _ACCELERATION:
            kinds.append("acceleration" if signal.name in moments else "rotor_acceleration")
        else:
            kinds.append("disturbance" if signal.name in moments else "rotor_disturbance")
    return tuple(kinds)
