"""Operating points along a line: angles, commands or a parameter changed step by step.

Each point starts Newton's method from the one before, so that a branch of equilibria is followed
and its end is met, not jumped over. Unknown are states and commands; as many of the commands or
of the controlled angles are held as there are inputs.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np
import numpy.typing as npt

from trms_cli.core.errors import ConfigurationError
from trms_cli.models.model import Model, names
from trms_cli.models.operating_point import (
    OperatingPoint,
    asked_by_angle,
    operating_point,
)
from trms_cli.models.rest import rest_equations
from trms_cli.models.steady_state import SteadyState

FloatArray = npt.NDArray[np.float64]

#: Rates (in the states' units per s) and errors of what is held (rad, V) below this are none.
TOLERANCE = 1e-9
_ITERATIONS = 60
_STALLED = 6
#: A step of the line that fails is halved until it is this share of itself.
_SHORTEST = 2.0**-10
#: V, rad: a command below the first is none if no angle then moves by the second.
_NEARLY_ZERO, _SAME_ANGLE = 1e-3, 1e-6
#: rad: an angle that moves by more in a step is on another branch.
_JUMP = 0.5


@dataclass(frozen=True)
class Held:
    """What is held at an operating point."""

    by_angle: bool  #: Whether the controlled states are held, and not the commands
    values: FloatArray  #: (n,) array; theirs, in the order of ``model.controlled`` or of the inputs
    p: FloatArray  #: (n_p,) array; the parameters


class Balance:
    """Operating points of one model.

    Parameters
    ----------
    model : Model
        With equations, or with a step of its own.
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

    def held(self, at: Mapping[str, float], where: str = "at") -> Held:
        """What a request holds.

        Raises ConfigurationError for a name that is no input and no controlled state, or names of
        both kinds.
        """
        model = self.model
        by_angle = asked_by_angle(model, at, where)
        order = model.controlled if by_angle else names(model.inputs)
        values = np.array([float(at.get(name, 0.0)) for name in order])
        return Held(by_angle, values, model.parameters.values)

    def first(self, at: Mapping[str, float], where: str = "at") -> OperatingPoint:
        """The operating point of a request, from nowhere.

        Raises TrmsError for a wrong request, and where there is none.
        """
        held = self.held(at, where)
        if self.model.sample_time is None:
            point = operating_point(self.model, at, where)
            return self.solve(held, point) or point
        rest = OperatingPoint(self.model.rest(), np.zeros(self.model.n_u))
        if not held.by_angle:
            start = Held(False, np.zeros(self.model.n_u), held.p)
            found = self.advance(start, held, self.solve(start, rest) or rest)
        else:
            target = SteadyState(self.model).solve(held.values)
            settled = target.converged and not target.projected
            found = OperatingPoint(target.x, target.u) if settled else None
        if found is None:
            asked = ", ".join(f"{name}={value:g}" for name, value in at.items())
            raise ConfigurationError(
                f"model {self.model.name!r} has no rest at {asked or 'no command'} within its "
                "inputs and stops",
                where=where,
                remedy="ask for a smaller angle or command",
            )
        return found

    def solve(self, held: Held, guess: OperatingPoint) -> OperatingPoint | None:
        """Newton's method from a point nearby; None where it does not converge."""
        n_s, n_u = self._n_s, self.model.n_u
        z = np.concatenate([guess.x[self._unknowns], guess.u])
        pins = np.zeros((len(held.values), n_s + n_u))
        columns = self._controlled if held.by_angle else range(n_s, n_s + n_u)
        pins[np.arange(len(held.values)), list(columns)] = 1.0
        least, stalled = np.inf, 0
        for _ in range(_ITERATIONS):
            rates, slope, _ = (np.array(value) for value in self._equations(z, held.p))
            error = np.concatenate([rates[:, 0], pins @ z - held.values])
            if not np.all(np.isfinite(error)):
                return None
            if np.abs(error).max() <= TOLERANCE:
                u = z[n_s:]
                return OperatingPoint(np.array(self._state(z[:n_s], u))[:, 0], u.copy())
            # A double root halves the error each time; what does not shrink at all has no root.
            largest = float(np.abs(error).max())
            least, stalled = (largest, 0) if largest < 0.9 * least else (least, stalled + 1)
            if stalled > _STALLED:
                return None
            system = np.vstack([slope, pins])
            if not np.all(np.isfinite(system)):
                return None
            z = z - np.linalg.lstsq(system, error, rcond=1e-13)[0]
        return None

    def advance(
        self,
        last: Held,
        following: Held,
        point: OperatingPoint,
        shortest: float = _SHORTEST,
    ) -> OperatingPoint | None:
        """The point after another on the same branch; None where the branch ends between.

        ``shortest`` is the share of the way that a step is halved down to.
        """
        share, step = 0.0, 1.0
        while share < 1.0:
            goal = min(1.0, share + step)
            held = Held(
                last.by_angle,
                (1 - goal) * last.values + goal * following.values,
                (1 - goal) * last.p + goal * following.p,
            )
            found = self.solve(held, point)
            if found is None or self._jumps(point, found):
                found = self._across_standstill(held)
            if found is None or self._jumps(point, found):
                step /= 2.0
                if step < shortest:
                    return None
                continue
            point, share = self._without_rounding(held, found), goal
        return point

    def _across_standstill(self, held: Held) -> OperatingPoint | None:
        """The point at some angles where Newton's method fails: a rotor begins or ceases to turn.

        Its thrust goes as ω|ω| and has no slope there; :class:`SteadyState` starts from several
        commands instead.
        """
        if not held.by_angle:
            return None
        key = held.p.tobytes()
        if self._robust is None or self._robust[0] != key:
            self._robust = (key, SteadyState(self.model, parameters=held.p))
        target = self._robust[1].solve(held.values)
        if not target.converged or target.projected:
            return None
        point = OperatingPoint(target.x, target.u)
        return self.solve(held, point) or point

    def _without_rounding(self, held: Held, point: OperatingPoint) -> OperatingPoint:
        """The point with a command of exactly zero where that holds the same angles.

        A double root is met to the square root of the tolerance only.
        """
        nearly = (np.abs(point.u) < _NEARLY_ZERO) & (point.u != 0.0)
        if not held.by_angle or not nearly.any():
            return point
        exact = self.solve(Held(False, np.where(nearly, 0.0, point.u), held.p), point)
        rows = [self.model.state_index(name) for name in self.model.controlled]
        if exact is None or np.abs(exact.x[rows] - held.values).max() > _SAME_ANGLE:
            return point
        return exact

    def tangent(self, held: Held, point: OperatingPoint, direction: Held) -> FloatArray:
        """How x and u follow what is held, (n_x + n_u,): by the implicit function theorem.

        ``direction`` holds the rates of change of the held values and of the parameters. Where
        an unknown has no slope (a rotor at rest that need not turn) it stays.
        """
        n_s, n_u = self._n_s, self.model.n_u
        z = np.concatenate([point.x[self._unknowns], point.u])
        _, slope, by_p = (np.array(value) for value in self._equations(z, held.p))
        columns = self._controlled if held.by_angle else list(range(n_s, n_s + n_u))
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
