"""Where a model rests, asked for by its angles or by its commands, and how that changes.

:func:`operating_point` finds one from nowhere; :func:`refine_operating_point` and
:class:`TrimSolver` go on from one nearby, without bounds on commands. Where an angle may be out of
reach, :class:`trms_cli.models.steady_state.SteadyState` finds the closest that can be held.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import ConfigurationError, ModelError
from trms_cli.core.plugins import require_known
from trms_cli.models.continuation import follow
from trms_cli.models.model import Model, names
from trms_cli.models.rest import rest_equations
from trms_cli.models.steady_state import SteadyState
from trms_cli.models.vector_field import VectorField

#: Rates (in the states' units per s) and errors of what is held (rad, V) below this are none.
TOLERANCE = 1e-9
#: Directions with less than this share of the largest slope, in states and commands, are flat.
_FLAT = 1e-13
_NEAR_ZERO = 5e-4  # of the command's range
_SAME_ANGLE = 1e-6  # rad
#: Steps in which the commands go from zero to where they are asked for: the branch that begins at
#: the rest without command is followed, not one that lies across.
_STEPS = 25
#: A step of the line that fails is halved until it is this share of itself.
_SHORTEST = 2.0**-10
#: V: a smaller command is none if no angle then moves by `_SAME_ANGLE`.
_STANDSTILL = 1e-3
#: rad: an angle that moves by more in a step is on another branch.
_JUMP = 0.5


@dataclass(frozen=True)
class OperatingPoint:
    """An equilibrium."""

    x: FloatArray  #: (n_x,) array
    u: FloatArray  #: (n_u,) array

    def value(self, model: Model, name: str) -> float:
        """A state or a command by its name."""
        if name in model.state_names:
            return float(self.x[model.state_index(name)])
        return float(self.u[names(model.inputs).index(name)])

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

    Raises ConfigurationError for names that are neither, and where the model has no such
    equilibrium.

    ``model``: with equations. ``at``: controlled states by name (rad), or inputs (V); what is not
    named is zero. Nothing named: the rest without command. For commands, the equilibrium is taken
    that the rest without command turns into when they are raised. ``where``: configuration key of
    ``at``, for messages.
    """
    by_angle = prescribes_angles(model, at, where)
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


def prescribes_angles(model: Model, at: Mapping[str, float], where: str = "at") -> bool:
    """Whether a request names angles, and not commands.

    Raises ConfigurationError for a name that is no input and no controlled state, or names of both
    kinds.
    """
    inputs = names(model.inputs)
    for name in at:
        words = f"{name!r} is neither a controlled state nor an input"
        require_known(name, (*model.controlled, *inputs), words, f"{where}.{name}")
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
    start = np.concatenate([plain.x, model.rest()[plain.x.size :], plain.u])
    if by_angle:
        rows = [model.state_index(name) for name in model.controlled]
        fixed_values = np.array([at.get(name, 0.0) for name in model.controlled])
    else:
        rows, fixed_values = list(range(n_x, start.size)), plain.u
    pins = np.eye(start.size)[rows]

    def balance(z: FloatArray) -> tuple[FloatArray, FloatArray]:
        rate, a, b = field.with_slopes(z[:n_x], z[n_x:])
        return np.concatenate([rate, pins @ z - fixed_values]), np.vstack([np.hstack([a, b]), pins])

    z = newton(balance, start, _FLAT)
    return None if z is None else OperatingPoint(z[:n_x], z[n_x:])


def _at_angles(model: Model, at: Mapping[str, float], where: str) -> OperatingPoint:
    angles = np.array([at.get(name, 0.0) for name in model.controlled])
    target = SteadyState(model).solve(angles)
    if not target.exact:
        goal, reached = (
            ", ".join(
                f"{n}={round(v, 6) + 0.0:.4g}"
                for n, v in zip(model.controlled, values, strict=True)
            )
            for values in (angles, target.reference_reached)
        )
        raise ConfigurationError(
            f"model {model.name!r} has no equilibrium at {goal} within its inputs and stops",
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
    x = refine_operating_point(VectorField(model), point.x, u)
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
    x = refine_operating_point(field, model.rest(), np.zeros(model.n_u))
    if x is None:
        raise ModelError(
            f"model {model.name!r} finds no rest without command",
            where=where,
            remedy="ask for it by angles, as at.alpha_v=0",
        )

    def attempt(
        last: tuple[float, FloatArray], step: float
    ) -> tuple[tuple[float, FloatArray] | None, float]:
        goal = min(last[0] + step, 1.0)
        _, a, b = field.with_slopes(last[1], last[0] * u)
        # Along the tangent, which the branch leaves only slowly; another branch lies far from it.
        ahead = last[1] - (goal - last[0]) * np.linalg.lstsq(a, b @ u, rcond=1e-12)[0]
        following = refine_operating_point(field, ahead, goal * u)
        if following is None or not _as_foretold(following, ahead, last[1]):
            return None, step / 4.0
        return (goal, following), min(2.0 * step, 1.0 / _STEPS)

    share = 0.0
    for share, reached in follow((0.0, x), attempt, 1.0 / _STEPS, 1e-6):
        if share >= 1.0:
            return OperatingPoint(reached, u)
    ends = ", ".join(
        f"{name}={_short(share * value)}"
        for name, value in zip(names(model.inputs), u, strict=True)
    )
    raise ConfigurationError(
        f"the equilibrium that begins at rest ends at {ends}",
        where=where,
        remedy="ask for a smaller command, or by angles (at.alpha_v=0), which finds a command for "
        "each input; study=equilibria shows where they all end",
    )


def _as_foretold(solution: FloatArray, ahead: FloatArray, x: FloatArray) -> bool:
    """Whether a solution is the one that the tangent pointed at, state by state."""
    room = 0.5 * np.abs(ahead - x) + 0.02 * (1.0 + np.abs(x))
    return bool(np.all(np.abs(solution - ahead) <= room))


def refine_operating_point(field: VectorField, x: FloatArray, u: FloatArray) -> FloatArray | None:
    """Newton's method on f(x, u) = 0 from a guess; None where it does not converge.

    A direction in which nothing changes (a yaw that nothing pulls back) is left where it is.
    """
    return newton(lambda at: field.with_slopes(at, u)[:2], x, 1e-12)


def newton(
    equations: Callable[[FloatArray], tuple[FloatArray, FloatArray]],
    z: FloatArray,
    flat: float,
    *,
    iterations: int = 50,
    patience: int | None = None,
) -> FloatArray | None:
    """Newton's method on g(z) = 0 to :data:`TOLERANCE`; None where it does not converge.

    ``equations``: z → g (n,) and its slopes (n, n_z). ``z``: (n_z,); where it starts. ``flat``:
    directions whose slope is below this share of the largest are left where they are. ``patience``:
    it ends after so many iterations that do not shrink the error. A double root halves the error
    each time; what does not shrink at all has no root.
    """
    z, least, stalled = z.copy(), np.inf, 0
    for _ in range(iterations):
        error, slope = equations(z)
        if not (np.all(np.isfinite(error)) and np.all(np.isfinite(slope))):
            return None
        largest = float(np.abs(error).max())
        if largest <= TOLERANCE:
            return z
        least, stalled = (largest, 0) if largest < 0.9 * least else (least, stalled + 1)
        if patience is not None and stalled > patience:
            return None
        z = z - np.linalg.lstsq(slope, error, rcond=flat)[0]
    return None


@dataclass(frozen=True)
class TrimCondition:
    """What is held at an operating point, and the parameters that it is sought with."""

    by_angle: bool  #: Whether the controlled states are held, and not the commands
    values: FloatArray  #: (n,) array; theirs, in the order of ``model.controlled`` or of the inputs
    p: FloatArray  #: (n_p,) array; the parameters


class TrimSolver:
    """Operating points of one model, one after another along a line.

    Angles, commands or a parameter change step by step, and each point starts Newton's method from
    the one before, so that a branch of equilibria is followed and its end is met, not jumped over.
    Unknown are states and commands; as many of the commands or of the controlled angles are held
    as there are inputs.

    ``model``: with equations, or with a step of its own.
    """

    def __init__(self, model: Model) -> None:
        self.model = model
        equations = rest_equations(model)
        self._unknowns = list(equations.unknowns)
        self._controlled = [
            self._unknowns.index(model.state_index(name)) for name in model.controlled
        ]
        _, u, p, w = model.symbols()
        s = ca.SX.sym("s", len(self._unknowns))
        rates = ca.substitute(equations.residual(s, u, p, w), w, ca.SX.zeros(model.n_w))
        at = ca.vertcat(s, u)
        slopes = [ca.densify(ca.jacobian(rates, v)) for v in (at, p)]
        self._equations = ca.Function("balance", [at, p], [rates, *slopes])
        self._state = equations.state
        self._n_s = len(self._unknowns)
        self._angles = [model.state_index(name) for name in model.controlled if name in model.stops]
        self._robust: tuple[bytes, SteadyState] | None = None

    def condition(self, at: Mapping[str, float], where: str = "at") -> TrimCondition:
        """What a request holds.

        Raises ConfigurationError for a name that is no input and no controlled state, or names of
        both kinds.
        """
        model = self.model
        by_angle = prescribes_angles(model, at, where)
        order = model.controlled if by_angle else names(model.inputs)
        values = np.array([float(at.get(name, 0.0)) for name in order])
        return TrimCondition(by_angle, values, model.parameters.values)

    def first(self, at: Mapping[str, float], where: str = "at") -> OperatingPoint:
        """The operating point of a request, from nowhere.

        Raises TrmsError for a wrong request, and where there is none.
        """
        condition = self.condition(at, where)
        if self.model.sample_time is None:
            point = operating_point(self.model, at, where)
            return self.solve(condition, point) or point
        rest = OperatingPoint(self.model.rest(), np.zeros(self.model.n_u))
        if not condition.by_angle:
            start = TrimCondition(False, np.zeros(self.model.n_u), condition.p)
            settled = self.advance(start, condition, self.solve(start, rest) or rest)
        else:
            target = SteadyState(self.model).solve(condition.values)
            settled = OperatingPoint(target.x, target.u) if target.exact else None
        if settled is None:
            request = ", ".join(f"{name}={value:g}" for name, value in at.items())
            raise ConfigurationError(
                f"model {self.model.name!r} has no rest at {request or 'no command'} within its "
                "inputs and stops",
                where=where,
                remedy="ask for a smaller angle or command",
            )
        return settled

    def solve(self, condition: TrimCondition, guess: OperatingPoint) -> OperatingPoint | None:
        """Newton's method from a point nearby; None where it does not converge."""
        n_s, n_u = self._n_s, self.model.n_u
        columns = self._controlled if condition.by_angle else range(n_s, n_s + n_u)
        pins = np.eye(n_s + n_u)[list(columns)]

        def balance(z: FloatArray) -> tuple[FloatArray, FloatArray]:
            rates, slope, _ = (np.array(value) for value in self._equations(z, condition.p))
            return (
                np.concatenate([rates[:, 0], pins @ z - condition.values]),
                np.vstack([slope, pins]),
            )

        start = np.concatenate([guess.x[self._unknowns], guess.u])
        z = newton(balance, start, _FLAT, iterations=60, patience=6)
        if z is None:
            return None
        u = z[n_s:]
        return OperatingPoint(np.array(self._state(z[:n_s], u))[:, 0], u.copy())

    def advance(
        self,
        last: TrimCondition,
        following: TrimCondition,
        point: OperatingPoint,
        shortest: float = _SHORTEST,
    ) -> OperatingPoint | None:
        """The point after another on the same branch; None where the branch ends between.

        ``shortest`` is the share of the way that a step is halved down to.
        """

        def attempt(
            last_place: tuple[float, OperatingPoint], step: float
        ) -> tuple[tuple[float, OperatingPoint] | None, float]:
            goal = min(1.0, last_place[0] + step)
            condition = TrimCondition(
                last.by_angle,
                (1 - goal) * last.values + goal * following.values,
                (1 - goal) * last.p + goal * following.p,
            )
            after = self.solve(condition, last_place[1])
            if after is None or self._jumps(last_place[1], after):
                after = self._across_standstill(condition)
            if after is None or self._jumps(last_place[1], after):
                return None, step / 2.0
            return (goal, self._without_rounding(condition, after)), step

        for share, reached in follow((0.0, point), attempt, 1.0, shortest):
            if share >= 1.0:
                return reached
        return None

    def _across_standstill(self, condition: TrimCondition) -> OperatingPoint | None:
        """The point at some angles where Newton's method fails: a rotor begins or ceases to turn.

        Its thrust goes as ω|ω| and has no slope there; :class:`SteadyState` starts from several
        commands instead.
        """
        if not condition.by_angle:
            return None
        key = condition.p.tobytes()
        if self._robust is None or self._robust[0] != key:
            self._robust = (key, SteadyState(self.model, parameters=condition.p))
        target = self._robust[1].solve(condition.values)
        if not target.exact:
            return None
        point = OperatingPoint(target.x, target.u)
        return self.solve(condition, point) or point

    def _without_rounding(self, condition: TrimCondition, point: OperatingPoint) -> OperatingPoint:
        """The point with a command of exactly zero where that holds the same angles.

        A double root is met to the square root of the tolerance only.
        """
        nearly = (np.abs(point.u) < _STANDSTILL) & (point.u != 0.0)
        if not condition.by_angle or not nearly.any():
            return point
        exact = self.solve(TrimCondition(False, np.where(nearly, 0.0, point.u), condition.p), point)
        rows = [self.model.state_index(name) for name in self.model.controlled]
        if exact is None or np.abs(exact.x[rows] - condition.values).max() > _SAME_ANGLE:
            return point
        return exact

    def tangent(
        self, condition: TrimCondition, point: OperatingPoint, direction: TrimCondition
    ) -> FloatArray:
        """How x and u follow what is held, (n_x + n_u,): by the implicit function theorem.

        ``direction`` holds the rates of change of the held values and of the parameters. Where
        an unknown has no slope (a rotor at rest that need not turn) it stays.
        """
        n_s, n_u = self._n_s, self.model.n_u
        z = np.concatenate([point.x[self._unknowns], point.u])
        _, slope, by_p = (np.array(value) for value in self._equations(z, condition.p))
        columns = self._controlled if condition.by_angle else list(range(n_s, n_s + n_u))
        pins = np.eye(n_s + n_u)[columns]
        right = np.concatenate([-by_p @ direction.p, direction.values])
        dz = np.linalg.lstsq(np.vstack([slope, pins]), right, rcond=1e-13)[0]
        s, u = ca.SX.sym("s", n_s), ca.SX.sym("u", n_u)
        lifted = ca.Function("lift", [s, u], [ca.jacobian(self._state(s, u), ca.vertcat(s, u))])
        dx = np.array(ca.densify(lifted(z[:n_s], z[n_s:]))) @ dz
        return np.concatenate([dx, dz[n_s:]])

    def within_limits(self, point: OperatingPoint) -> bool:
        """Whether its commands and angles are within the rig's."""
        lower, upper = self.model.input_bounds()
        slack = 1e-9
        stops = all(
            abs(point.x[self.model.state_index(name)]) <= stop + slack
            for name, stop in self.model.stops.items()
        )
        return stops and bool(np.all((point.u >= lower - slack) & (point.u <= upper + slack)))

    def _jumps(self, before: OperatingPoint, after: OperatingPoint) -> bool:
        move = np.abs(after.x - before.x)[self._angles]
        return bool(move.max(initial=0.0) > _JUMP)


def _short(value: float) -> str:
    """Four digits; what is rounding is zero."""
    return f"{0.0 if abs(value) < 5e-8 else value:.4g}"
