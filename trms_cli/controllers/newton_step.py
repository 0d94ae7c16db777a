"""One Newton iteration over the whole horizon: linearise, solve the QP, move as far as φ falls."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from time import perf_counter

import numpy as np
import numpy.typing as npt

from trms_cli.controllers.horizon import Horizon
from trms_cli.controllers.operating_point import Target
from trms_cli.controllers.qp.problem import Qp, QpResult, QpSolver
from trms_cli.core.compilation import BufferedFunction
from trms_cli.models.model import names

FloatArray = npt.NDArray[np.float64]

_ARMIJO = 1e-4
_STEP_LENGTHS = (1.0, 0.5, 0.25, 0.1, 0.03, 0.01)
#: Added to the Hessian's diagonal (1/V²): inputs without influence stay where they are.
_REGULARISATION = 1e-6


@dataclass
class Outcome:
    """How the iterations of a sample ended.

    Attributes
    ----------
    iterations : int
    converged : bool
        Whether the last Newton step moved no input by more than the tolerance.
    failed : bool
        Whether there is no usable answer; ``message`` says why.
    stalled : bool
        Whether no step along the Newton direction lowered the merit.
    objective, merit : float
        J and φ of the plan.
    violation, terminal_residual : float
        Largest violation of a soft limit, and of the scaled terminal equality.
    kkt_residual : float
        Largest component of the Lagrangian's gradient before the last step.
    message : str
    """

    iterations: int
    converged: bool
    failed: bool
    stalled: bool
    objective: float
    merit: float
    violation: float
    terminal_residual: float
    kkt_residual: float
    message: str = ""


class NewtonStep:
    """The iteration, with its plan and buffers.

    Parameters
    ----------
    horizon : Horizon
    qp : QpSolver
    largest_moves : (n_u,) array
        Largest change of an input in one control period, V; infinite for none.

    Attributes
    ----------
    plan : (n_u, n_blocks) array
        The present inputs; always within the bounds.
    reference : (n_r, N) array
        To be filled before :meth:`solve`.
    trajectory : (n_full, N) array
        States that the plan leads to.
    """

    def __init__(self, horizon: Horizon, qp: QpSolver, largest_moves: FloatArray) -> None:
        model = horizon.model
        self.horizon = horizon
        self._qp, self._workspace = qp, qp.start()
        self.lower, self.upper = model.input_bounds()
        n_u, n_blocks = model.n_u, horizon.n_blocks
        self.plan = np.zeros((n_u, n_blocks), order="F")
        self.reference = horizon.linearise.inputs[5]
        self.trajectory = horizon.linearise.outputs[0].copy()
        self.linearise_time = self.qp_time = 0.0
        self._arguments = horizon.linearise.inputs
        self._step = BufferedFunction(horizon.discrete.step)
        self._step.inputs[2][:] = model.parameters.values
        # The plan in the order of the unknowns: block by block, input by input.
        self._lower = np.tile(self.lower, n_blocks)
        self._upper = np.tile(self.upper, n_blocks)
        self._constant_terms()
        self._program_rows(largest_moves)
        self._u_previous = np.zeros(n_u)
        self._u_target = np.zeros(n_u)

    # -- set-up -----------------------------------------------------------------------------

    def _constant_terms(self) -> None:
        """The parts of the Hessian that do not depend on the trajectory: inputs and moves."""
        horizon = self.horizon
        inputs = names(horizon.model.inputs)
        n_u, n_blocks, n = len(inputs), horizon.n_blocks, horizon.n_z
        periods = np.bincount(horizon.blocks)
        rho = np.array([horizon.weights.inputs.get(name, 0.0) for name in inputs])
        s = np.array([horizon.weights.moves.get(name, 0.0) for name in inputs])
        self._input_weight = (periods[:, None] * rho).ravel()
        difference = np.eye(n) - np.eye(n, k=-n_u)
        self._difference = difference
        move_weight = np.tile(s, n_blocks)
        self._move_gradient = 2.0 * difference.T * move_weight
        self._constant_hessian = 2.0 * (
            np.diag(self._input_weight) + difference.T * move_weight @ difference
        ) + _REGULARISATION * np.eye(n)
        states = horizon.model.state_names
        rows = len(horizon.rows)
        weight = np.array([horizon.weights.states.get(name, 0.0) for name in horizon.rows])
        self._row_index = np.array([states.index(name) for name in horizon.rows])
        controlled = horizon.model.controlled
        #: Row of the reference for each weighted row, −1 for one that goes to the target.
        self._goal = [controlled.index(n) if n in controlled else -1 for n in horizon.rows]
        self._root_weight = np.sqrt(np.tile(weight, horizon.n_periods))
        self._n_rows = rows
        self._goals = np.zeros((rows, horizon.n_periods), order="F")
        limits = horizon.soft_limits.states
        self._limited = [i for i, name in enumerate(horizon.rows) if name in limits]
        self._limits = np.array([limits[horizon.rows[i]] for i in self._limited]).reshape(-1, 2)

    def _program_rows(self, largest_moves: FloatArray) -> None:
        """Rows of the QP that do not change, and room for those that do.

        First the terminal equality (soft, at its exact-penalty price), then the changes between
        blocks of the inputs whose rate is limited (hard).
        """
        horizon, n = self.horizon, self.horizon.n_z
        terminal = horizon.terminal
        n_terminal = horizon.model.n_x if terminal is not None else 0
        bound = np.tile(largest_moves, horizon.n_blocks)
        self._rate_chosen = np.isfinite(bound)
        self._largest_moves = largest_moves
        self._rate_limited = bool(self._rate_chosen.any())
        rate_bound = bound[self._rate_chosen]
        m = n_terminal + len(rate_bound)
        self._n_terminal, self._rate_bound = n_terminal, rate_bound
        self._rows = np.zeros((m, n))
        self._rows[n_terminal:] = self._difference[self._rate_chosen]
        self._row_lower, self._row_upper = np.zeros(m), np.zeros(m)
        self._linear, self._quadratic = np.full(m, np.inf), np.ones(m)
        if terminal is not None:
            self._linear[:n_terminal] = terminal.linear
            self._quadratic[:n_terminal] = terminal.quadratic

    # -- a sample ---------------------------------------------------------------------------

    def set_problem(
        self, full: FloatArray, u_previous: FloatArray, disturbance: FloatArray, target: Target
    ) -> None:
        """Initial state (with memory), last command, disturbances and target of this sample."""
        x0, _, previous, _, w, _, x_s, u_s = self._arguments[:8]
        x0[:] = full
        previous[:] = self._u_previous = u_previous
        w[:] = disturbance
        x_s[:] = target.x
        u_s[:] = self._u_target = target.u
        other = self.horizon.evaluate.inputs
        for i in (0, 2, 4, 5, 6, 7):
            other[i][...] = self._arguments[i]
        for row, goal in enumerate(self._goal):
            self._goals[row] = self.reference[goal] if goal >= 0 else target.x[self._row_index[row]]

    def advance(self, full: FloatArray, u: FloatArray) -> FloatArray:
        """The full state one control period later without disturbance, for its memory."""
        step = self._step
        step.inputs[0][:] = full
        step.inputs[1][:] = u
        step()
        return step.outputs[0]

    def choose_better(self, other: FloatArray) -> None:
        """Keep the plan with the lower merit."""
        present = self._merit(self.plan)
        if not present <= self._merit(other):
            self.plan[:] = other

    def _merit(self, plan: FloatArray) -> float:
        evaluate = self.horizon.evaluate
        evaluate.inputs[1][:] = plan
        evaluate()
        return float(evaluate.outputs[3][0])

    def solve(self, max_iterations: int, tolerance: float) -> Outcome:
        """Iterate from the present plan; the plan never gets worse in merit."""
        if self._rate_limited:
            self._limit_rates()
        outcome = Outcome(0, False, False, False, np.nan, np.nan, np.nan, np.nan, np.nan)
        for iteration in range(1, max_iterations + 1):
            outcome.iterations = iteration
            self._iterate(outcome, tolerance)
            if outcome.failed or outcome.converged or outcome.stalled:
                break
        return outcome

    def _iterate(self, outcome: Outcome, tolerance: float) -> None:
        begin = perf_counter()
        horizon = self.horizon
        linearise = horizon.linearise
        linearise.inputs[1][:] = self.plan
        linearise()
        trajectory, slopes, terminal_slope, terminal, _, merit, _ = linearise.outputs
        merit_now = float(merit[0])
        if not merit_now < np.inf:
            self.linearise_time += perf_counter() - begin
            outcome.failed, outcome.message = True, "the predicted trajectory is not finite"
            return
        z = self.plan.ravel(order="F")
        deviation = (trajectory[self._row_index] - self._goals).ravel(order="F")
        weighted = slopes * self._root_weight[:, None]
        hessian = 2.0 * (weighted.T @ weighted) + self._constant_hessian
        gradient = 2.0 * ((self._root_weight * deviation) @ weighted)
        n_u = len(self._u_previous)
        if self._input_weight.any():
            steady = np.tile(self._u_target, horizon.n_blocks)
            gradient += 2.0 * self._input_weight * (z - steady)
        moves = z.copy()
        moves[n_u:] -= z[:-n_u]
        moves[:n_u] -= self._u_previous
        gradient += self._move_gradient @ moves
        qp = self._program(hessian, gradient, z, moves, terminal_slope, terminal)
        middle = perf_counter()
        self.linearise_time += middle - begin
        result = self._qp.solve(self._workspace, qp)
        if result.solved and self._limited:
            values = trajectory[self._row_index[self._limited]]
            result = self._within_limits(qp, result, values, slopes)
        end = perf_counter()
        self.qp_time += end - middle
        if not result.solved:
            outcome.failed = True
            outcome.message = f"the QP was not solved: {result.message}"
            return
        step = result.z
        curvature = hessian @ step
        outcome.kkt_residual = float(np.abs(curvature).max())
        outcome.converged = float(np.abs(step).max()) <= tolerance
        self._move(z, step, float(step @ curvature), merit_now, outcome)

    def _program(
        self,
        hessian: FloatArray,
        gradient: FloatArray,
        z: FloatArray,
        moves: FloatArray,
        terminal_slope: FloatArray,
        terminal: FloatArray,
    ) -> Qp:
        n_t = self._n_terminal
        if n_t:
            self._rows[:n_t] = terminal_slope
            self._row_lower[:n_t] = -terminal
            self._row_upper[:n_t] = -terminal
        if self._rate_limited:
            present = moves[self._rate_chosen]
            self._row_lower[n_t:] = -self._rate_bound - present
            self._row_upper[n_t:] = self._rate_bound - present
        return Qp(
            hessian,
            gradient,
            self._lower - z,
            self._upper - z,
            self._rows,
            self._row_lower,
            self._row_upper,
            self._linear,
            self._quadratic,
        )

    def _within_limits(
        self, qp: Qp, result: QpResult, values: FloatArray, slopes: FloatArray
    ) -> QpResult:
        """Solve again with the soft state limits, if the solution without them breaks one.

        A solution that keeps them is the solution of both programs; most samples end here.
        """
        n, n_rows = self.horizon.n_periods, self._n_rows
        pick = (np.arange(n)[:, None] * n_rows + np.array(self._limited)).ravel()
        rows = slopes[pick]
        present = values.T.ravel()
        predicted = present + rows @ result.z
        lower = np.tile(self._limits[:, 0], n)
        upper = np.tile(self._limits[:, 1], n)
        if bool(((predicted >= lower) & (predicted <= upper)).all()):
            return result
        limits, m = self.horizon.soft_limits, len(rows)
        extended = Qp(
            qp.hessian,
            qp.gradient,
            qp.lower,
            qp.upper,
            np.concatenate([qp.rows, rows]),
            np.concatenate([qp.row_lower, lower - present]),
            np.concatenate([qp.row_upper, upper - present]),
            np.concatenate([qp.linear, np.full(m, limits.linear)]),
            np.concatenate([qp.quadratic, np.full(m, limits.quadratic)]),
        )
        return self._qp.solve(self._workspace, extended)

    def _move(
        self,
        z: FloatArray,
        step: FloatArray,
        curvature: float,
        merit_now: float,
        outcome: Outcome,
    ) -> None:
        """Go along the Newton direction until the merit falls (Armijo); else stay.

        The QP's model of the merit is convex, so that the full step lowers it by at least half of
        stepᵀ H step: a descent direction of the merit itself.
        """
        evaluate = self.horizon.evaluate
        trial = evaluate.inputs[1]
        slack = 1e-12 * (1.0 + abs(merit_now))
        for length in _STEP_LENGTHS:
            trial[:] = (z + length * step).reshape(trial.shape, order="F")
            evaluate()
            if float(evaluate.outputs[3][0]) <= merit_now - _ARMIJO * length * curvature + slack:
                # Rounding may leave a bound by a hair.
                np.clip(trial, self.lower[:, None], self.upper[:, None], out=self.plan)
                self._report(evaluate.outputs, outcome)
                return
        outcome.stalled = not outcome.converged
        linearised = self.horizon.linearise.outputs
        self._report((linearised[0], *linearised[3:]), outcome)

    def _report(self, outputs: Sequence[FloatArray], outcome: Outcome) -> None:
        trajectory, terminal, objective, merit, violation = outputs
        self.trajectory[:] = trajectory
        outcome.objective = float(objective[0])
        outcome.merit = float(merit[0])
        outcome.violation = float(violation[0])
        outcome.terminal_residual = float(np.abs(terminal).max()) if self._n_terminal else 0.0

    def _limit_rates(self) -> None:
        """Bring the plan within the rate limits, block after block from the last command."""
        previous = self._u_previous
        for block in range(self.horizon.n_blocks):
            previous = np.clip(
                self.plan[:, block],
                previous - self._largest_moves,
                previous + self._largest_moves,
            )
            self.plan[:, block] = previous
