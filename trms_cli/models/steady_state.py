"""Steady states of a model: where it can rest with given controlled angles and disturbances.

Solves

    minimise  ½ Σ_i q_i (x_c(i) − r_i)²   over x, u     subject to   f(x, u, p, w) = 0,  |u| ≤ u_max

which is ``f = 0, x_c = r`` wherever the reference is reachable, and the closest reachable reference
in weighted least squares where it is not. (f of a model that only steps is its change over a step,
in the states s that the others follow from; see :mod:`trms_cli.models.rest`.) Each iteration is
one Newton step on the optimality conditions, as one compiled function; bounds are held by an active
set around it. The second derivatives of f are left out at first: they vanish with the multipliers
where the reference is reached, and with them the iteration is drawn to saddles. Where the closest
reachable reference is far and the first iteration swings, they are put in to finish.

Where a search begins at a target that was reached with no input at its bound, as that of the last
sample mostly is, ``f = 0`` alone is tried first, with the controlled angles at the reference: the
multipliers vanish, and a step costs a ninth.

Two degeneracies of the rig are met by a proximal term that is far below every physical scale:

- The thrust goes as ω|ω|. A target that needs no thrust is a double root, to which Newton's method
  converges linearly (each step halves ω): the iteration runs until the residual is small instead
  of a fixed number of times.
- A row without any slope (a state that integrates nothing, a command inside a dead zone) leaves
  its unknown where it is.

A state that remembers the path of another (the hysteresis of a cable) rests at any value: a
reference has a steady state for each. It stays where the search begins, and the inputs hold the
reference against it.
"""

import itertools
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.core.compilation import BufferedFunction
from trms_cli.core.errors import ModelError
from trms_cli.core.process_cache import call_memoised
from trms_cli.models.model import Model
from trms_cli.models.rest import RestEquations, rest_equations, static_motor_command

#: Largest residual of the dynamics (in the states' units per s) and of the reference (rad).
TOLERANCE = 1e-8
REACHED = 1e-6  # rad, reference errors below this count as reached
_ITERATIONS = 40
_RUNAWAY = 1e6  # rad in one iteration: it will not come back
_BOUND_TOLERANCE = 1e-9  # V
_SLOPE_TOLERANCE = 1e-12  # rad²/V
_BESIDE = 0.05  # rad between two references that share their closest reachable point
#: On the diagonal of the Newton system, far below every physical scale.
_PROXIMAL = 1e-12
#: Of a search with the angles at the reference: largest residual, steps, and the share of its limit
#: that an input moves at most in one of them. Beyond these, the search over all unknowns goes on.
_QUICK_TOLERANCE, _QUICK_ITERATIONS, _QUICK_SHARE = 1e-10, 6, 0.5


@dataclass(frozen=True)
class Target:
    """A steady state."""

    x: FloatArray  #: (n_x,) array
    u: FloatArray  #: (n_u,) array
    reference_reached: FloatArray  #: (n_r,) array; controlled angles in it, rad
    residual: float  #: Largest rate that is left in it, in the states' units per s
    projected: bool  #: Whether the reference asked for is out of reach
    #: Whether ``residual`` is below the tolerance. Otherwise there is no steady state near.
    converged: bool
    active: tuple[int, ...]  #: Bound that each input is at: −1, 0 for none, 1
    reference: tuple[float, ...]  #: The reference that it was solved for, rad
    #: (n_s,) array; of the dynamics, in rad² over their units: zero where the reference is reached.
    #: One for each unknown of :mod:`trms_cli.models.rest`.
    multiplier: FloatArray

    @property
    def exact(self) -> bool:
        """Whether the model rests there, and at the reference asked for."""
        return self.converged and not self.projected


class SteadyState:
    """Solver for the steady states of one model; keeps nothing between two calls but buffers.

    ``model``: continuous part and input path are used; impulses (dry friction, stops) are not,
    since they hold an axis at rest anywhere. References are cut to the mechanical stops.
    ``weights``: q by controlled angle, for references out of reach; 1 where none is given.
    ``parameters``: (n_p,); defaults to the model's values. ``function``, ``unknowns``,
    ``controlled``, ``weights``: one iteration, uncompiled; positions of the unknowns among the
    states, and of the controlled angles among them; q. ``reaching``: one iteration with the angles
    at the reference; None where that does not settle the inputs.
    """

    def __init__(
        self,
        model: Model,
        weights: Mapping[str, float] | None = None,
        parameters: FloatArray | None = None,
    ) -> None:
        self.model = model
        equations = rest_equations(model)
        self.unknowns = list(equations.unknowns)
        self.controlled = controlled_rows(model, equations)
        self.weights = np.array([(weights or {}).get(name, 1.0) for name in model.controlled])
        if not np.all(self.weights > 0):
            raise ModelError(
                f"weights {self.weights.tolist()} given for the steady state",
                remedy="every weight is above 0",
            )
        self._stops = [model.stops.get(name, np.inf) for name in model.controlled]
        self._upper = model.input_bounds()[1].tolist()
        self.function = call_memoised(newton_step, model, equations)
        self.reaching = call_memoised(reaching_step, model, equations)
        self._quick = self.reaching and BufferedFunction(self.reaching)
        self._newton = BufferedFunction(self.function)
        (self._z, self._r, self._w, p, q, self._active, self._bound, reach, self._curved) = (
            self._newton.inputs
        )
        n_s = len(self.unknowns)
        n = n_s + model.n_u
        self._s, self._u = self._z[:n_s], self._z[n_s:n]  # views
        self._multiplier = self._z[n:]
        self._z_next, self._report, self._x = self._newton.outputs
        p[:] = model.parameters.values if parameters is None else parameters
        if self._quick is not None:
            self._quick.inputs[2][:] = p
        q[:] = self.weights
        reach[:] = self._upper
        self._rest = model.rest()[self.unknowns]
        self._memory = [self.unknowns.index(i) for i in model.path_memory]

    def solve(
        self,
        reference: FloatArray,
        disturbance: FloatArray | None = None,
        guess: Target | None = None,
        path_memory: FloatArray | None = None,
    ) -> Target:
        """The steady state for a reference.

        ``reference``: (n_r,); of ``model.controlled``, rad. ``disturbance``: (n_w,); constant
        torques on the model's equations, N m. ``guess``: where to start: the last sample's target
        leaves two or three iterations. ``path_memory``: (n_m,); values of the states
        ``model.path_memory``, in their units; by default the guess's, or those of ``model.rest()``.
        Returns Target: check ``converged`` before use: a disturbance that no input can hold has no
        target.
        """
        goal = reference.tolist()
        for i, value in enumerate(goal):
            self._r[i] = min(max(value, -self._stops[i]), self._stops[i])
        self._w[:] = 0.0 if disturbance is None else disturbance
        if self._memory:
            guess = self._remembering(path_memory, guess)
        if guess is not None:
            target = self._reached_from(guess, goal)
            if target is not None:
                return target
            bounds_met = self._from(guess)
            if bounds_met is not None:
                target = self._target(goal, bounds_met)
                # The closest point found from nearby may be closest in its neighbourhood only:
                # it is believed where the search over all starts led to just before, unless the
                # disturbance that kept the reference out of reach has gone.
                if not target.projected:
                    return target
                beside = (abs(a - b) < _BESIDE for a, b in zip(goal, guess.reference, strict=True))
                if guess.projected and all(beside):
                    return self._within_reach(goal) or target
        return self._from_afar(goal)

    def _remembering(self, values: FloatArray | None, guess: Target | None) -> Target | None:
        """Where the search begins, with the values of the states that remember a path."""
        rows = list(self.model.path_memory)
        if values is None:
            values = (self.model.rest() if guess is None else guess.x)[rows]
        self._rest[self._memory] = values
        if guess is None:
            return None
        x = guess.x.copy()
        x[rows] = values
        return replace(guess, x=x)

    def _within_reach(self, goal: list[float]) -> Target | None:
        """The reference itself where it can be held with no input at its bound."""
        free = (0,) * self.model.n_u
        for s, u in itertools.islice(self._starts(), 2**self.model.n_u):
            self._s[:], self._u[:], self._multiplier[:] = s, u, 0.0
            if self._converge(free, False) and not self._outside(free):
                target = self._target(goal, free)
                if not target.projected:
                    return target
        return None

    def _reached_from(self, guess: Target, goal: list[float]) -> Target | None:
        """The target of a reference that is reached with no input at its bound; None elsewhere."""
        quick, upper = self._quick, self._upper
        if quick is None or guess.projected or any(guess.active) or goal != self._r.tolist():
            return None
        n_s = len(self.unknowns)
        z, w = quick.inputs[:2]
        z_next, rate, x = quick.outputs
        z[:n_s], z[n_s:], w[:] = guess.x[self.unknowns], guess.u, self._w
        z[self.controlled] = goal
        for _ in range(_QUICK_ITERATIONS):
            quick()
            if rate[0] <= _QUICK_TOLERANCE:
                break
            moves = zip(z_next[n_s:].tolist(), z[n_s:].tolist(), upper, strict=True)
            if not all(abs(after - now) <= _QUICK_SHARE * most for after, now, most in moves):
                return None
            z[:] = z_next
        else:
            return None
        u = z[n_s:].copy()
        if any(abs(v) > most + _BOUND_TOLERANCE for v, most in zip(u.tolist(), upper, strict=True)):
            return None
        residual, free = float(rate[0]), (0,) * len(u)
        reached = np.array(goal)
        no_price = np.zeros(n_s)
        return Target(x.copy(), u, reached, residual, False, True, free, tuple(goal), no_price)

    def _from(self, guess: Target) -> tuple[int, ...] | None:
        """Iterate from a target; the active set at the solution, or None when there is none."""
        self._s[:] = guess.x[self.unknowns]
        self._u[:] = guess.u
        self._multiplier[:] = guess.multiplier
        active = guess.active
        for _ in range(3**self.model.n_u):
            if not self._converge(active, curved=guess.projected):
                return None
            following = self._corrected(active)
            if following == active:
                return None if self._beyond_stops() else active
            active = following
        return None

    def _converge(self, active: tuple[int, ...], curved: bool) -> bool:
        """Newton's method with the active inputs at their bounds."""
        for i, side in enumerate(active):
            self._active[i] = abs(side)
            self._bound[i] = side * self._upper[i]
        self._curved[0] = curved
        evaluate, report, state = self._newton, self._report, self._z
        for _ in range(_ITERATIONS):
            evaluate()
            rate, move = report[0], report[1]
            if rate <= TOLERANCE and move <= TOLERANCE:
                return True
            if not move < _RUNAWAY:
                return False
            state[:] = self._z_next
        return False

    def _corrected(self, active: tuple[int, ...]) -> tuple[int, ...]:
        """The active set after violated bounds are added and pulling ones released."""
        after = list(active)
        for i, value in enumerate(self._u.tolist()):
            if active[i] == 0:
                high = self._upper[i] + _BOUND_TOLERANCE
                after[i] = int(value > high) - int(value < -high)
            elif self._report[2 + i] * active[i] > _SLOPE_TOLERANCE:
                after[i] = 0
        return tuple(after)

    def _from_afar(self, goal: list[float]) -> Target:
        """The best over several starts and all active sets."""
        best: tuple[float, Target] | None = None
        sets = itertools.product((0, 1, -1), repeat=self.model.n_u)
        for active in sets:
            for s, u in self._starts():
                self._s[:], self._u[:] = s, u
                self._multiplier[:] = 0.0
                if not self._converge(active, False) and not self._converge(active, True):
                    continue
                if self._outside(active):
                    continue
                target = self._target(goal, active)
                if not target.projected:
                    return target
                error = self._s[self.controlled] - self._r
                cost = float(error @ (self.weights * error))
                if best is None or cost < best[0] - _SLOPE_TOLERANCE:
                    best = (cost, target)
        if best is not None:
            return best[1]
        self._s[:], self._u[:], self._multiplier[:] = self._rest, 0.0, 0.0
        self._newton()
        return self._target(goal, (0,) * self.model.n_u)

    def _outside(self, active: tuple[int, ...]) -> bool:
        """Whether an input that is free is beyond its bound, or an angle beyond its stop."""
        return self._beyond_stops() or any(
            side == 0 and abs(value) > upper + _BOUND_TOLERANCE
            for side, value, upper in zip(active, self._u.tolist(), self._upper, strict=True)
        )

    def _beyond_stops(self) -> bool:
        return any(
            abs(self._s[i]) > stop + REACHED
            for i, stop in zip(self.controlled, self._stops, strict=True)
        )

    def _starts(self) -> Iterable[tuple[FloatArray, FloatArray]]:
        """Points to start from: at the reference and at rest, the inputs at several levels.

        None at zero, where a thrust has no slope.
        """
        at_reference = self._rest.copy()
        at_reference[self.controlled] = self._r
        for s in (at_reference, self._rest):
            for shares in itertools.product((0.4, -0.4), repeat=self.model.n_u):
                yield s, np.array(shares) * self._upper

    def _target(self, goal: list[float], active: tuple[int, ...]) -> Target:
        x, u = self._x.copy(), self._u.copy()
        for i, side in enumerate(active):
            if side:
                u[i] = side * self._upper[i]
        reached = [float(self._s[i]) for i in self.controlled]
        residual = float(self._report[0])
        return Target(
            x,
            u,
            np.array(reached),
            residual,
            any(abs(a - b) > REACHED for a, b in zip(goal, reached, strict=True)),
            residual <= TOLERANCE,
            active,
            tuple(goal),
            self._multiplier.copy(),
        )


def controlled_rows(model: Model, equations: RestEquations) -> list[int]:
    """Positions of the controlled angles among the unknowns."""
    rows = [model.state_index(name) for name in model.controlled]
    for name, row in zip(model.controlled, rows, strict=True):
        if row not in equations.unknowns:
            raise ModelError(
                f"{name!r} is controlled, and model {model.name!r} only copies it from another "
                "state or an input",
                where="model",
                remedy="control a state that the model computes",
            )
    return [equations.unknowns.index(row) for row in rows]


def reaching_step(model: Model, equations: RestEquations) -> ca.Function | None:
    """One step of Newton's method on ``f = 0`` with the controlled angles where they are.

    ``(z, w, p)`` → the next z = (s, u), the largest rate |f|, and the whole state x of the z given.
    None for a model in which the angles do not settle the inputs, one that steps (its step may be
    a large network) and one that remembers a path.
    """
    n_s, n_u = len(equations.unknowns), model.n_u
    if model.sample_time is not None or model.path_memory or len(model.controlled) != n_u:
        return None
    _, _, p, w = model.symbols()
    z = ca.SX.sym("z", n_s + n_u)
    reached = static_motor_command(model, z[n_s:], p)
    f = equations.residual(z[:n_s], reached, p, w)
    kept = controlled_rows(model, equations)
    moving = [i for i in range(n_s + n_u) if i not in kept]
    slopes = ca.jacobian(f, z)[:, moving]
    if ca.sprank(slopes) < n_s:
        return None
    z_next = ca.SX(z)
    z_next[moving] += ca.solve(slopes, -f)
    results = ca.cse([z_next, ca.mmax(ca.fabs(f)), equations.state(z[:n_s], reached)])
    return ca.Function(
        "reaching_step", [z, w, p], results, ["z", "w", "p"], ["z_next", "rate", "x"]
    )


def newton_step(model: Model, equations: RestEquations) -> ca.Function:
    """One step on the optimality conditions from (s, u); s is x where x has a derivative.

    Active inputs go to their bound; the others are stationary. Returns the next s and u, a report
    (the largest rate |f|, the largest move of a controlled angle, and the slope of the cost in
    each input), and the whole state x of the s and u given.
    """
    n_s, n_u = len(equations.unknowns), model.n_u
    _, _, p, w = model.symbols()
    n = n_s + n_u
    z = ca.SX.sym("z", n + n_s)
    s, u, multiplier, curved = z[:n_s], z[n_s:n], z[n:], ca.SX.sym("curved")
    rows = controlled_rows(model, equations)
    n_r = len(rows)
    r, q = ca.SX.sym("r", n_r), ca.SX.sym("q", n_r)
    active, bound = ca.SX.sym("active", n_u), ca.SX.sym("bound", n_u)
    reach = ca.SX.sym("reach", n_u)

    reached = static_motor_command(model, u, p)
    f = equations.residual(s, reached, p, w)
    slopes = ca.jacobian(f, z[:n])
    f_s, f_u = slopes[:, :n_s], slopes[:, n_s:]
    curvature = curved * ca.jacobian(slopes.T @ multiplier, z[:n])
    select = ca.SX(ca.DM.eye(n_s)[rows, :])
    weigh = select.T @ ca.diag(q)

    free = ca.diag(1 - active)
    # Rows: stationarity in s, stationarity (or the bound) in u, the dynamics.
    in_s = weigh @ select + _PROXIMAL * ca.SX.eye(n_s) + curvature[:n_s, :n_s]
    in_u = _PROXIMAL * free + ca.diag(active) + free @ curvature[n_s:, n_s:]
    system = ca.blockcat(
        [
            [in_s, curvature[:n_s, n_s:], f_s.T],
            [free @ curvature[n_s:, :n_s], in_u, free @ f_u.T],
            [f_s, f_u, -_PROXIMAL * ca.SX.eye(n_s)],
        ]
    )
    for i in model.path_memory:  # it does not move: the inputs do
        row = equations.unknowns.index(i)
        system[row, :] = 0
        system[row, row] = 1
    right = ca.vertcat(-weigh @ (s[rows] - r), active * (bound - u), -f)
    solution = _solved(system, right)
    ds, du, following = solution[:n_s], solution[n_s:n], solution[n:]
    # Near the double root the slope is tiny and the step huge: no input moves by more than a
    # quarter of its range at once.
    largest = ca.mmax(ca.fabs(du) / reach)
    shorten = ca.if_else(largest > 0.5, 0.5 / largest, 1.0)
    report = ca.vertcat(ca.mmax(ca.fabs(f)), ca.mmax(ca.fabs(ds[rows])), f_u.T @ following)
    return ca.Function(
        "steady_state_step",
        [z, r, w, p, q, active, bound, reach, curved],
        [
            ca.vertcat(z[:n] + shorten * ca.vertcat(ds, du), following),
            report,
            equations.state(s, reached),
        ],
        ["z", "r", "w", "p", "q", "active", "bound", "reach", "curved"],
        ["z_next", "report", "x"],
    )


def _solved(matrix: ca.SX, right: ca.SX) -> ca.SX:
    """Solution of a square system whose conditioning is poor by nature.

    CasADi's QR is a modified Gram–Schmidt, accurate to the condition number squared; one step of
    iterative refinement brings that back to the condition number.
    """
    q, r = ca.qr(matrix)

    def solve(b: ca.SX) -> ca.SX:
        return ca.solve(r, q.T @ b)

    first = solve(right)
    return first + solve(right - matrix @ first)
