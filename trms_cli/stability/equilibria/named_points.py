"""Rest, hover and other equilibria that have a name, with the physical quantities there.

Dry friction holds an axis in a band of angles around them. Friction acts as impulses, which are no
part of f(x, u). What it can hold is read from the impulse itself: an axis at rest is pushed by a
torque T for a moment, and what the impulse takes from the rate that it would gain is the break-away
torque,

    F = T (1 − rate with friction / rate without).

Every angle is held at which the static torques leave no more than F: the equilibria with a constant
torque between −F and F, which one curve of equilibria over that torque passes through.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import TrmsError
from trms_cli.models.model import Model, names
from trms_cli.models.operating_point import OperatingPoint, operating_point, refined
from trms_cli.models.rest import arriving
from trms_cli.models.vector_field import VectorField
from trms_cli.stability.equilibria.curves import CurveEquations, EquilibriumPoint, equilibrium_point
from trms_cli.stability.equilibria.rest_system import rest_system
from trms_cli.stability.equilibria.survey import bounds_of
from trms_cli.stability.local.linear import Linear

_NEAR_ZERO = 1e-3  # V
_SAME_ANGLE = 1e-6  # rad


@dataclass(frozen=True)
class NamedPoint(EquilibriumPoint):
    """An equilibrium with a name."""

    name: str
    #: What the model names: thrusts (N), currents (A), torques (N m), inertias (kg m²)…
    quantities: Mapping[str, float]
    bands: tuple[FrictionBand, ...]  #: Where dry friction holds the axes around it


def named_points(
    model: Model, more: Mapping[str, Mapping[str, float]], where: str = "study.special"
) -> tuple[list[NamedPoint], list[str]]:
    """Rest, hover, and what is asked for; and why the first two may be missing.

    ``more``: angles or commands by name, as of :func:`operating_point`. Raises TrmsError for a
    point that is asked for and does not exist.
    """
    points: list[NamedPoint] = []
    missing: list[str] = []
    usual: dict[str, Mapping[str, float]] = {"rest": {}}
    if "pitch" in model.axes:
        usual["hover"] = dict.fromkeys(model.controlled, 0.0)
    for name, at in usual.items():
        # A rig without command that rests with all controlled angles at zero: that is its hover.
        level = points and all(abs(points[0].value(model, n)) < 1e-9 for n in model.controlled)
        if name in more or (name == "hover" and level):
            continue
        try:
            points.append(_named(model, name, operating_point(model, at)))
        except TrmsError as error:
            missing.append(
                f"no {name}: {error.problem}" + (f" ({error.remedy})" if error.remedy else "")
            )
    for name, at in more.items():
        points.append(_named(model, name, operating_point(model, at, f"{where}.{name}")))
    return points, missing


def _named(model: Model, name: str, point: OperatingPoint) -> NamedPoint:
    u, p = ca.SX.sym("u", model.n_u), ca.SX.sym("p", len(model.parameters))
    path = ca.Function("path", [u, p], [arriving(model, u, p)])
    field = VectorField(model)

    def arrives(commands: FloatArray) -> FloatArray:
        return np.array(path(commands, field.parameters))[:, 0]

    # Commands of exactly zero where that changes no angle: as of :func:`operating_point`, for
    # commands that pass a dead zone on their way too.
    u = np.where(np.abs(point.u) < _NEAR_ZERO, 0.0, point.u)
    if not np.array_equal(u, point.u):
        settled = refined(field, point.x, arrives(u))
        rows = [model.state_index(name) for name in model.controlled]
        if settled is not None and np.abs(settled - point.x)[rows].max() <= _SAME_ANGLE:
            point = OperatingPoint(settled, u)
    reached = arrives(point.u)
    at = equilibrium_point(Linear(model), point.x, point.u, reached)
    x, u, p, _ = model.symbols()
    expressions = model.quantities(x, u, p)
    evaluate = ca.Function("quantities", [x, u, p], [ca.vertcat(*expressions.values())])
    numbers = np.array(evaluate(point.x, reached, field.parameters)).ravel().tolist()
    return NamedPoint(
        **vars(at),
        name=name,
        quantities=dict(zip(expressions, numbers, strict=False)),
        bands=tuple(friction_bands(model, point.x, point.u, reached)),
    )


#: s, of the push: so short that no rate comes near the velocities on which friction depends.
_MOMENTS = (1e-7, 1e-6)
_PUSH = 1.0  # N m
_LEAST = 1e-9  # N m


@dataclass(frozen=True)
class FrictionBand:
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

    ``x``: (n_x,); an equilibrium. ``u``: (n_u,); what reaches the motors.
    """
    short, longer = (_taken(model, x, u, axis, moment) for moment in _MOMENTS)
    # What resists in proportion to the rate takes ten times as much in ten times the time.
    return longer if longer > _LEAST and abs(longer - short) < 0.1 * longer else 0.0


def _taken(model: Model, x: FloatArray, u: FloatArray, axis: str, moment: float) -> float:
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


def friction_bands(
    model: Model, x: FloatArray, u: FloatArray, reached: FloatArray
) -> list[FrictionBand]:
    """The bands of all axes around an equilibrium, one axis at a time.

    ``x``: (n_x,); the equilibrium. ``u``, ``reached``: (n_u,); its commands, and what of them
    reaches the motors.
    """
    bands: list[FrictionBand] = []
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
        point = OperatingPoint(x, u)
        seed = np.array([*(point.value(model, s.name) for s in system.unknowns), 0.0])
        start = equations.pinned(seed, equations.n, 0.0)
        if start is None:
            continue
        curve = equations.through(start)
        reach = {
            signal.name: (float(curve.y[:, k].min()), float(curve.y[:, k].max()))
            for k, signal in enumerate(system.unknowns)
        }
        if free:
            moving = [name for name in system.released if reach[name][1] - reach[name][0] > 1e-9]
            command = (moving[-1], *reach[moving[-1]]) if moving else None
            bands.append(FrictionBand(axis, place.angle, torque, None, None, command))
        else:
            bands.append(FrictionBand(axis, place.angle, torque, *reach[place.angle]))
    return bands
