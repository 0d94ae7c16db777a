"""Where a model rests, asked for by its angles or by its commands."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from trms_cli.core.errors import ConfigurationError, ModelError
from trms_cli.core.plugins import nearest
from trms_cli.models.model import Model, names
from trms_cli.models.steady_state import SteadyState
from trms_cli.models.vector_field import VectorField

FloatArray = npt.NDArray[np.float64]

#: Rates below this, in the states' units per s, count as none.
TOLERANCE = 1e-9
_ITERATIONS = 50
_NEAR_ZERO = 5e-4  # of the command's range
_SAME_ANGLE = 1e-6  # rad
#: Steps in which the commands go from zero to where they are asked for: the branch that begins at
#: the rest without command is followed, not one that lies across.
_STEPS = 25


@dataclass(frozen=True)
class OperatingPoint:
    """An equilibrium."""

    x: FloatArray  #: (n_x,) array
    u: FloatArray  #: (n_u,) array

    def words(self, model: Model) -> str:
        """``u_v = 1.41 V, u_h = 0.2 V: alpha_v = 0, alpha_h = 0.1 rad``."""
        commands = ", ".join(
            f"{signal.name} = {_short(value)} {signal.unit}".removesuffix(" 1")
            for signal, value in zip(model.inputs, self.u, strict=True)
        )
        angles = ", ".join(
            f"{name} = {_short(self.x[model.state_index(name)])}" for name in model.controlled
        )
        unit = model.states[model.state_index(model.controlled[0])].unit
        return f"{commands}: {angles} {unit}"


def operating_point(model: Model, at: Mapping[str, float], where: str = "at") -> OperatingPoint:
    """The equilibrium at given controlled angles, or at given commands.

    Parameters
    ----------
    model : Model
        With equations.
    at : dict of str to float
        Controlled states by name (rad), or inputs (V); what is not named is zero. Nothing named:
        the rest without command. For commands, the equilibrium is taken that the rest without
        command turns into when they are raised.
    where : str
        Configuration key of ``at``, for messages.

    Raises
    ------
    ConfigurationError
        For names that are neither, and where the model has no such equilibrium.
    """
    by_angle = asked_by_angle(model, at, where)
    plain = model.without_effects()
    if plain.n_x < model.n_x:
        # An effect with a memory (a hysteresis) rests at any of a line of points: this is the one
        # that a rig without a past has.
        beside = _beside(model, at, by_angle, operating_point(plain, at, where))
        if beside is not None:
            return beside
    if by_angle:
        return _at_angles(model, at, where)
    return at_command(model, np.array([at.get(name, 0.0) for name in names(model.inputs)]), where)


def asked_by_angle(model: Model, at: Mapping[str, float], where: str = "at") -> bool:
    """Whether a request names angles, and not commands.

    Raises ConfigurationError for a name that is no input and no controlled state, or names of both
    kinds.
    """
    inputs = names(model.inputs)
    for name in at:
        if name not in (*inputs, *model.controlled):
            raise ConfigurationError(
                f"{name!r} is neither a controlled state nor an input",
                where=f"{where}.{name}",
                remedy=nearest(name, (*model.controlled, *inputs)),
            )
    by_angle = [name in model.controlled for name in at]
    if any(by_angle) and not all(by_angle):
        raise ConfigurationError(
            f"angles and commands given together: {', '.join(at)}",
            where=where,
            remedy=f"give angles ({', '.join(model.controlled)}) or commands "
            f"({', '.join(inputs)}); the others follow",
        )
    return any(by_angle)


def _beside(
    model: Model, at: Mapping[str, float], by_angle: bool, plain: OperatingPoint
) -> OperatingPoint | None:
    """The point next to that of the model without effects, by Newton's method in x and u."""
    field, n_x = VectorField(model), model.n_x
    z = np.concatenate([plain.x, model.rest()[plain.x.size :], plain.u])
    if by_angle:
        rows = [model.state_index(name) for name in model.controlled]
        held = np.array([at.get(name, 0.0) for name in model.controlled])
    else:
        rows, held = list(range(n_x, z.size)), plain.u
    pins = np.eye(z.size)[rows]
    for _ in range(_ITERATIONS):
        rate, a, b = field.with_slopes(z[:n_x], z[n_x:])
        error = np.concatenate([rate, pins @ z - held])
        if not (np.all(np.isfinite(error)) and np.all(np.isfinite(a))):
            return None
        if np.abs(error).max() <= TOLERANCE:
            return OperatingPoint(z[:n_x], z[n_x:])
        system = np.vstack([np.hstack([a, b]), pins])
        z = z - np.linalg.lstsq(system, error, rcond=1e-13)[0]
    return None


def _at_angles(model: Model, at: Mapping[str, float], where: str) -> OperatingPoint:
    asked = np.array([at.get(name, 0.0) for name in model.controlled])
    target = SteadyState(model).solve(asked)
    if not target.exact:
        wanted, reached = (
            ", ".join(
                f"{n}={round(v, 6) + 0.0:.4g}"
                for n, v in zip(model.controlled, values, strict=True)
            )
            for values in (asked, target.reference_reached)
        )
        raise ConfigurationError(
            f"model {model.name!r} has no equilibrium at {wanted} within its inputs and stops",
            where=where,
            remedy=f"the closest that it has: {reached}" if target.converged else "",
        )
    return _without_rounding(model, OperatingPoint(target.x, target.u))


def _without_rounding(model: Model, point: OperatingPoint) -> OperatingPoint:
    """The point with commands of exactly zero where that changes no angle.

    A target that needs no thrust is a double root of ω|ω|, which the solver comes as near to as
    the square root of its tolerance.
    """
    u = np.where(np.abs(point.u) < _NEAR_ZERO * model.input_bounds()[1], 0.0, point.u)
    x = refined(VectorField(model), point.x, u)
    if x is None or np.abs(x - point.x)[[model.state_index(n) for n in model.controlled]].max() > (
        _SAME_ANGLE
    ):
        return point
    return OperatingPoint(x, u)


def at_command(model: Model, u: FloatArray, where: str = "at") -> OperatingPoint:
    """The equilibrium that the rest without command turns into at a command, (n_u,).

    Raises ConfigurationError if it ends before the command is reached: it tells where.
    """
    field = VectorField(model)
    x = refined(field, model.rest(), np.zeros(model.n_u))
    if x is None:
        raise ModelError(
            f"model {model.name!r} finds no rest without command",
            where=where,
            remedy="ask for it by angles, as at.alpha_v=0",
        )
    share, step = 0.0, 1.0 / _STEPS
    while share < 1.0:
        goal = min(share + step, 1.0)
        _, a, b = field.with_slopes(x, share * u)
        # Along the tangent, which the branch leaves only slowly; another branch lies far from it.
        ahead = x - (goal - share) * np.linalg.lstsq(a, b @ u, rcond=1e-12)[0]
        following = refined(field, ahead, goal * u)
        if following is None or not _as_foretold(following, ahead, x):
            step /= 4.0
            if step < 1e-6:
                reached = ", ".join(
                    f"{name}={_short(share * value)}"
                    for name, value in zip(names(model.inputs), u, strict=True)
                )
                raise ConfigurationError(
                    f"the equilibrium that begins at rest ends at {reached}",
                    where=where,
                    remedy="ask for a smaller command, or by angles (at.alpha_v=0), which finds a "
                    "command for each input; study=equilibria shows where they all end",
                )
            continue
        x, share, step = following, goal, min(2.0 * step, 1.0 / _STEPS)
    return OperatingPoint(x, u)


def _as_foretold(found: FloatArray, ahead: FloatArray, x: FloatArray) -> bool:
    """Whether a solution is the one that the tangent pointed at, state by state."""
    room = 0.5 * np.abs(ahead - x) + 0.02 * (1.0 + np.abs(x))
    return bool(np.all(np.abs(found - ahead) <= room))


def refined(field: VectorField, x: FloatArray, u: FloatArray) -> FloatArray | None:
    """Newton's method on f(x, u) = 0 from a guess; None where it does not converge.

    A direction in which nothing changes (a yaw that nothing pulls back) is left where it is.
    """
    x = x.copy()
    for _ in range(_ITERATIONS):
        rate, slope, _ = field.with_slopes(x, u)
        if not (np.all(np.isfinite(rate)) and np.all(np.isfinite(slope))):
            return None
        if np.abs(rate).max() <= TOLERANCE:
            return x
        x = x - np.linalg.lstsq(slope, rate, rcond=1e-12)[0]
    return None


def _short(value: float) -> str:
    """Four digits; what is rounding is zero."""
    return f"{0.0 if abs(value) < 5e-8 else value:.4g}"
