"""Dry friction at rest: the band of angles in which it holds an axis.

Friction acts as impulses, which are no part of f(x, u). What it can hold is read from the impulse
itself: an axis at rest is pushed by a torque T for a moment, and what the impulse takes from the
rate that it would gain is the break-away torque,

    F = T (1 − rate with friction / rate without).

Every angle is held at which the static torques leave no more than F: the equilibria with a constant
torque between −F and F, which one curve of equilibria over that torque passes through.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from trms_cli.models.model import Model, names
from trms_cli.models.vector_field import VectorField
from trms_cli.stability.equilibria.continuation import curve_through
from trms_cli.stability.equilibria.curve_equations import CurveEquations
from trms_cli.stability.equilibria.rest_system import rest_system
from trms_cli.stability.equilibria.search_box import bounds_of

FloatArray = npt.NDArray[np.float64]

#: s, of the push: so short that no rate comes near the velocities on which friction depends.
_MOMENTS = (1e-7, 1e-6)
_PUSH = 1.0  # N m
_LEAST = 1e-9  # N m


@dataclass(frozen=True)
class Band:
    """Angles at which friction holds an axis."""

    axis: str
    angle: str  #: The state
    torque: float  #: F, N m
    #: ``lower``, ``upper``: rad; None where nothing else acts on the angle: any will do
    lower: float | None
    upper: float | None
    #: Where the angle is free: the input that balances it, and between what values it is held
    command: tuple[str, float, float] | None = None


def breakaway(model: Model, x: FloatArray, u: FloatArray, axis: str) -> float:
    """The torque that dry friction holds at rest, N m; 0 without any, and for one that creeps.

    Parameters
    ----------
    x : (n_x,)
        An equilibrium.
    u : (n_u,)
        What reaches the motors.
    """
    short, longer = (_taken(model, x, u, axis, moment) for moment in _MOMENTS)
    # What resists in proportion to the rate takes ten times as much in ten times the time.
    return longer if longer > _LEAST and abs(longer - short) < 0.1 * longer else 0.0


def _taken(model: Model, x: FloatArray, u: FloatArray, axis: str, moment: float) -> float:
    import casadi as ca

    symbols = model.symbols()
    impulse = ca.Function("impulse", list(symbols), [model.impulse(*symbols, moment)])
    field = VectorField(model)
    p, w = field.parameters, np.zeros(model.n_w)
    push = w.copy()
    push[names(model.disturbances).index(model.axes[axis].moment)] = _PUSH
    row = model.state_index(model.axes[axis].angle)

    def rate(state: FloatArray) -> float:
        return float(np.array(field.function(state, u, p, w))[row, 0])

    pushed = x + moment * np.array(field.function(x, u, p, push))[:, 0]
    held = np.array(impulse(pushed, u, p, push))[:, 0]
    without, rest = rate(pushed), rate(x)
    if without == rest:
        return 0.0
    return _PUSH * (1.0 - (rate(held) - rest) / (without - rest))


def bands(model: Model, x: FloatArray, u: FloatArray, reached: FloatArray) -> list[Band]:
    """The bands of all axes around an equilibrium, one axis at a time.

    Parameters
    ----------
    x : (n_x,)
        The equilibrium.
    u, reached : (n_u,)
        Its commands, and what of them reaches the motors.
    """
    found: list[Band] = []
    for axis, place in model.axes.items():
        torque = breakaway(model, x, reached, axis)
        if torque == 0.0:
            continue
        system = rest_system(model, names(model.inputs)[:1], torques_too=True)
        free = place.angle in system.free
        if not free and not system.released:
            system = rest_system(model, names(model.inputs), torques_too=True)
        box, scale = bounds_of(system, {})
        v = np.concatenate([u, np.zeros(model.n_w)])
        index = system.given_index(place.moment)
        limits = (-torque, torque)
        equations = CurveEquations(system, index, v, box, scale, limits)
        known = {**dict(zip(model.state_names, x, strict=True))}
        known |= dict(zip(names(model.inputs), u, strict=True))
        seed = np.array([*(known[signal.name] for signal in system.unknowns), 0.0])
        start = equations.pinned(seed, equations.n, 0.0)
        if start is None:
            continue
        curve = curve_through(equations, start)
        if free:
            command = None
            for name in system.released:
                values = curve.y[:, names(system.unknowns).index(name)]
                if np.ptp(values) > 1e-9:
                    command = (name, float(values.min()), float(values.max()))
            found.append(Band(axis, place.angle, torque, None, None, command))
        else:
            values = curve.y[:, names(system.unknowns).index(place.angle)]
            found.append(Band(axis, place.angle, torque, float(values.min()), float(values.max())))
    return found
