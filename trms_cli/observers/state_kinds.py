"""What each state of a model is: the kind by which an observer sets its noise."""

from __future__ import annotations

from typing import Literal

import casadi as ca

from trms_cli.models.model import Model, names

Kind = Literal["angle", "momentum", "rotor", "current", "other"]


def kinds_of_states(model: Model) -> tuple[Kind, ...]:
    """The kind of each state, read off the model's structure.

    An axis names its angle; a momentum is the state that the axis' moment pushes; a rotor's speed
    is the state that another torque pushes; a current is in ampere.
    """
    x, u, p, w = model.symbols()
    pushes = ca.jacobian(model.dynamics(x, u, p, w), w)
    moments = {axis.moment for axis in model.axes.values()}
    angles = {axis.angle for axis in model.axes.values()}
    kinds: list[Kind] = []
    for i, state in enumerate(model.states):
        pushed_by = {
            name for j, name in enumerate(names(model.disturbances)) if pushes[i, j].nnz() > 0
        }
        if state.name in angles:
            kinds.append("angle")
        elif pushed_by & moments:
            kinds.append("momentum")
        elif pushed_by:
            kinds.append("rotor")
        elif state.unit == "A":
            kinds.append("current")
        else:
            kinds.append("other")
    return tuple(kinds)
