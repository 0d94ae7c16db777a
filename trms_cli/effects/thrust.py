"""Torque on the beam by a change of a rotor's thrust."""

from __future__ import annotations

import casadi as ca

from trms_cli.effects.effect import EffectContext, axis_of, require_quantities, speed_row
from trms_cli.models.model import Model

#: The axis that a rotor's thrust turns.
AXIS = {"main": "pitch", "tail": "yaw"}


def check_thrust(model: Model, rotor: str) -> None:
    """Raise :class:`ModelError` if a model lacks a rotor, its axis, or its thrust by name."""
    speed_row(model, rotor)
    axis_of(model, AXIS[rotor])
    require_quantities(model, f"thrust_{rotor}", f"arm_{rotor}")


def thrust_torque(at: EffectContext, rotor: str, thrust: ca.SX) -> ca.SX:
    """The disturbance vector (n_w, 1) of an additional thrust (N) at its arm."""
    return at.on(at.axis(AXIS[rotor]).moment, at.quantity(f"arm_{rotor}") * thrust)
