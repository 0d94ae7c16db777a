"""The Newton iteration in NumPy, its quadratic programs by a solver of choice.

It acts where there is no compiler, or where another solver than the engine's own is chosen; a test
holds it equal to the engine (:mod:`trms_cli.controllers.newton.engine`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from time import perf_counter

import numpy as np

from trms_cli.controllers.horizon import Horizon
from trms_cli.core.arrays import FloatArray
from trms_cli.core.qp import Qp, QpResult, QpSolver, solve_or_fail
from trms_cli.models.model import names
from trms_cli.models.steady_state import Target

_ARMIJO = 1e-4
_STEP_LENGTHS = (1.0, 0.5, 0.25, 0.1, 0.03, 0.01)
#: Share of the tolerance that a converged plan is expected to be off.
_EXPECTED = 0.1
#: Exponent of what is known of the convergence, from sample to sample.
_DOUBT = 0.8
#: That a step is believed to leave: one of a plan against its bounds leaves none.
_LEAST_SHARE = 0.01
#: A step that goes a smaller share of the way to the steady-state input leaves it where it is.
_STUCK = 0.02


@dataclass
class NewtonResult:
    """How the iterations of a sample ended."""

    iterations: int
    #: Whether the last Newton step moved no input by more than the tolerance, or the next one is
    #: expected to move none by more than a tenth of it
    converged: bool
    failed: bool  #: Whether there is no usable answer; ``message`` says why
    stalled: bool  #: Whether no step along the Newton direction lowered the merit
    objective: float  #: J of the plan
    merit: float  #: φ of the plan
    violation: float  #: Largest, of a soft limit
    terminal_residual: float  #: Largest, of the terminal constraint
    kkt_residual: float  #: Largest component of the Lagrangian's gradient before the last step
    #: Whether the first step left an input all but where it is, far from that of the steady state
    is_stuck: bool = False
    #: Largest of the last step, V; 0 where there was none, or a shortened one
    largest_move: float = 0.0
    message: str = ""


class NewtonStep:
    """The iteration, with its plan and buffers.

    ``largest_moves``: (n_u,); largest change of an input in one control period, V; infinite for
    none. ``plan``: (n_u, n_blocks); the present inputs; always within the bounds. ``reference``:
    (n_r, N); to be filled before :meth:`solve`. ``trajectory``: (n_full, N); states that the plan
    leads to.
    """

    def __init__(self, horizon: Horizon, qp: QpSolver, largest_moves: FloatArray) -> None:
        model = horizon.model
        self.horizon = horizon
        self._qp, self._workspace = qp, qp.start()
        self.lower, self.upper = model.input_bounds()
        self.plan = np.zeros((model.n_u, horizon.n_blocks), order="F")
        self.reference = horizon.arguments["r"]
        self.trajectory = horizon.linearise.outputs[0].copy()
        self._evaluate = horizon.evaluate  # compiled before the first sample
        self.linearise_time = self.qp_time = 0.0
        self._tolerance = 0.0
        self.remaining_share = np.inf
        self._constant_terms()
        self._program_rows(largest_moves)

    def _constant_terms(self) -> None:
        """The part of the Hessian that does not depend on the trajectory: inputs and moves."""
        horizon = self.horizon
        inputs = names(horizon.model.inputs)
        n_u, n_blocks, n = len(inputs), horizon.n_blocks, horizon.n_z
        periods = np.bincount(horizon.blocks)
        rho = np.array([horizon.weights.inputs.get(name, 0.0) for name in inputs])
        s = np.array([horizon.weights.moves.get(name, 0.0) for name in inputs])
        self._difference = difference = np.eye(n) - np.eye(n, k=-n_u)
        self._constant_hessian = 2.0 * (
            np.diag((periods[:, None] * rho).ravel())
            + difference.T * np.tile(s, n_blocks) @ difference
        ) + horizon.regularisation * np.eye(n)
        limits = [horizon.soft_limits.states[name] for name in horizon.limited]
        self._limits = np.array(limits).reshape(-1, 2)
        self._limited = [horizon.model.state_index(name) for name in horizon.limited]

    def _program_rows(self, largest_moves: FloatArray) -> None:
        """Rows of the QP that do not change, and room for those that do.

        First the terminal equality, or the one row of a terminal region (soft, at their
        exact-penalty price), then the changes between blocks of the inputs whose rate is limited
        (hard).
        """
        horizon, n = self.horizon, self.horizon.n_z
        terminal = horizon.terminal
        n_terminal = horizon.n_terminal
        bound = np.tile(largest_moves, horizon.n_blocks)
        self._rate_chosen = np.isfinite(bound)
        self.largest_moves = largest_moves
        self._rate_limited = bool(self._rate_chosen.any())
        rate_bound = bound[self._rate_chosen]
        m = n_terminal + len(rate_bound)
        self._n_terminal = n_terminal
        self._rows = np.zeros((m, n))
        self._rows[n_terminal:] = self._difference[self._rate_chosen]
        # Bounds of the unknowns (block by block, input by input), then of the rows. They are for
        # the inputs and moves themselves; a QP is about their change.
        self._lowest = np.concatenate([np.tile(self.lower, horizon.n_blocks), np.zeros(m)])
        self._highest = np.concatenate([np.tile(self.upper, horizon.n_blocks), np.zeros(m)])
        self._lowest[n + n_terminal :] = -rate_bound
        self._highest[n + n_terminal :] = rate_bound
        if horizon.has_region:  # inside is as good as on its edge
            self._lowest[n : n + n_terminal] = -np.inf
        self._present = np.zeros(n + m)
        self._linear, self._quadratic = np.full(m, np.inf), np.ones(m)
        if terminal is not None:
            self._linear[:n_terminal] = terminal.linear
            self._quadratic[:n_terminal] = terminal.quadratic

    def set_problem(
        self, full: FloatArray, u_previous: FloatArray, disturbance: FloatArray, target: Target
    ) -> None:
        """Initial state (with memory), last command, disturbances and target of this sample."""
        arguments = self.horizon.arguments
        arguments["x0"][:] = full
        arguments["u_previous"][:] = u_previous
        arguments["w"][:] = disturbance
        arguments["x_s"][:] = target.x
        arguments["u_s"][:] = target.u

    def set_region(self, centre: FloatArray, root: FloatArray, level: float) -> None:
        """The terminal region of this sample, for a horizon that ends in one."""
        arguments = self.horizon.arguments
        arguments["centre"][:] = centre
        arguments["root"][:] = root
        arguments["radius"][:] = np.sqrt(level)

    def merit(self, plan: FloatArray) -> float:
        """φ of a plan; the outputs of ``horizon.evaluate`` are then those of it."""
        self.horizon.arguments["z"][:] = plan
        self.horizon.evaluate()
        return float(self.horizon.evaluate.outputs[3][0])

    def solve(
        self, max_iterations: int, tolerance: float, other: FloatArray | None = None
    ) -> NewtonResult:
        """Iterate from the present plan; the plan never gets worse in merit.

        ``tolerance``: V. ``other``: (n_u, n_blocks) array; a second plan to start from where the
        first one sees no way: a rotor at rest has no thrust slope, so that the Newton step leaves
        its input where it is. The better end is kept.
        """
        first = self._solve(max_iterations, tolerance)
        if other is None or not (first.failed or first.is_stuck):
            return first
        plan, trajectory = self.plan.copy(), self.trajectory.copy()
        self.plan[:] = other
        second = self._solve(max_iterations, tolerance)
        if second.failed or (second.merit >= first.merit and not first.failed):
            # The second's end is the worse: go back to the first's.
            self.plan[:], self.trajectory[:] = plan, trajectory
            first.iterations += second.iterations
            return first
        second.iterations += first.iterations
        return second

    def _solve(self, max_iterations: int, tolerance: float) -> NewtonResult:
        self._tolerance = tolerance
        self.remaining_share = max(self.remaining_share, _LEAST_SHARE) ** _DOUBT
        if self._rate_limited:
            self.limit_rates(self.plan)
        outcome = NewtonResult(0, False, False, False, np.nan, np.nan, np.nan, np.nan, np.nan)
        for iteration in range(1, max_iterations + 1):
            outcome.iterations = iteration
            self._iterate(outcome, tolerance)
            if outcome.failed or outcome.converged or outcome.stalled:
                break
        return outcome

    def _iterate(self, outcome: NewtonResult, tolerance: float) -> None:
        begin = perf_counter()
        horizon = self.horizon
        horizon.arguments["z"][:] = self.plan
        horizon.linearise()
        trajectory, terminal, _, merit, _, gradient, root, terminal_slope, limited_slopes = (
            horizon.linearise.outputs
        )
        merit_now = float(merit[0])
        if not merit_now < np.inf:
            self.linearise_time += perf_counter() - begin
            outcome.failed, outcome.message = True, "the predicted trajectory is not finite"
            return
        hessian = root.T @ root
        hessian *= 2.0
        hessian += self._constant_hessian
        z = self.plan.ravel(order="F")
        qp = self._program(hessian, gradient, z, terminal_slope, terminal)
        middle = perf_counter()
        self.linearise_time += middle - begin
        result, self._workspace = solve_or_fail(self._qp, self._workspace, qp)
        if result.solved and self._limited:
            result = self._within_limits(qp, result, trajectory[self._limited], limited_slopes)
        self.qp_time += perf_counter() - middle
        if not result.solved:
            outcome.failed = True
            outcome.message = f"the QP was not solved: {result.message}"
            return
        step = result.z
        if outcome.iterations == 1:
            outcome.is_stuck = self._is_stuck(step)
        curvature = hessian @ step
        outcome.kkt_residual = _largest(curvature)
        largest = _largest(step)
        outcome.converged = largest <= tolerance
        is_full = self._move(z, step, float(step @ curvature), merit_now, outcome) >= 1.0
        if not is_full:
            self.remaining_share = np.inf
        elif self._is_last(outcome.largest_move, largest):
            outcome.converged = True
        outcome.largest_move = largest if is_full else 0.0

    def _is_last(self, before: float, now: float) -> bool:
        """Whether what is left after a full step is negligible.

        Steps that shrink by θ leave θ/(1 − θ) of the last one. The first step of a sample has no θ
        yet; that of the last sample stands in, believed a little less each time (Hairer & Wanner,
        Solving ODEs II, IV.8). ``before``, ``now``: V; largest moves of the last two full steps,
        ``before`` 0 for a first one.
        """
        if before > 0.0:
            self.remaining_share = now / (before - now) if now < before else np.inf
        return now * self.remaining_share <= _EXPECTED * self._tolerance

    def _is_stuck(self, step: FloatArray) -> bool:
        way = np.abs(self.plan - self.horizon.arguments["u_s"][:, None]).max(axis=1)
        moved = np.abs(step.reshape(self.plan.shape, order="F")).max(axis=1)
        return bool(((way > self._tolerance) & (moved < _STUCK * way)).any())

    def _program(
        self,
        hessian: FloatArray,
        gradient: FloatArray,
        z: FloatArray,
        terminal_slope: FloatArray,
        terminal: FloatArray,
    ) -> Qp:
        n, n_t, present = len(z), self._n_terminal, self._present
        present[:n] = z
        if n_t:
            self._rows[:n_t] = terminal_slope
            present[n : n + n_t] = terminal
        if self._rate_limited:
            moves = self._difference @ z
            moves[: len(self.lower)] -= self.horizon.arguments["u_previous"]
            present[n + n_t :] = moves[self._rate_chosen]
        return Qp(
            hessian,
            gradient,
            self._rows,
            self._lowest - present,
            self._highest - present,
            self._linear,
            self._quadratic,
        )

    def _within_limits(
        self, qp: Qp, result: QpResult, values: FloatArray, slopes: FloatArray
    ) -> QpResult:
        """Solve again with the soft state limits, if the solution without them breaks one.

        A solution that keeps them is the solution of both programs; most samples end here.
        """
        present = values.ravel(order="F")
        predicted = present + slopes @ result.z
        lower = np.tile(self._limits[:, 0], self.horizon.n_periods)
        upper = np.tile(self._limits[:, 1], self.horizon.n_periods)
        if bool(((predicted >= lower) & (predicted <= upper)).all()):
            return result
        limits, m = self.horizon.soft_limits, len(present)
        extended = Qp(
            qp.hessian,
            qp.gradient,
            np.concatenate([qp.rows, slopes]),
            np.concatenate([qp.lower, lower - present]),
            np.concatenate([qp.upper, upper - present]),
            np.concatenate([qp.linear, np.full(m, limits.linear)]),
            np.concatenate([qp.quadratic, np.full(m, limits.quadratic)]),
        )
        result, self._workspace = solve_or_fail(self._qp, self._workspace, extended)
        return result

    def _move(
        self,
        z: FloatArray,
        step: FloatArray,
        curvature: float,
        merit_now: float,
        outcome: NewtonResult,
    ) -> float:
        """Go along the Newton direction until the merit falls (Armijo); else stay.

        Returns the share of the step that was gone.

        The QP's model of the merit is convex, so that the full step lowers it by at least half of
        stepᵀ H step: a descent direction of the merit itself.
        """
        evaluate, trial = self._evaluate, self.horizon.arguments["z"]
        slack = 1e-12 * (1.0 + abs(merit_now))
        for length in _STEP_LENGTHS:
            trial[:] = (z + length * step).reshape(trial.shape, order="F")
            evaluate()
            if float(evaluate.outputs[3][0]) <= merit_now - _ARMIJO * length * curvature + slack:
                # Rounding may leave a bound by a hair.
                np.clip(trial, self.lower[:, None], self.upper[:, None], out=self.plan)
                self._report(evaluate.outputs, outcome)
                return length
        outcome.stalled = not outcome.converged
        self._report(self.horizon.linearise.outputs[:5], outcome)
        return 0.0

    def _report(self, outputs: Sequence[FloatArray], outcome: NewtonResult) -> None:
        trajectory, terminal, objective, merit, violation = outputs
        self.trajectory[:] = trajectory
        outcome.objective = float(objective[0])
        outcome.merit = float(merit[0])
        outcome.violation = float(violation[0])
        if not self._n_terminal:
            outcome.terminal_residual = 0.0
        elif self.horizon.has_region:
            outcome.terminal_residual = max(0.0, float(terminal[0]))
        else:
            outcome.terminal_residual = float(np.abs(terminal).max())

    def limit_rates(self, plan: FloatArray) -> None:
        """Bring a plan within the rate limits, block after block from the last command."""
        previous = self.horizon.arguments["u_previous"]
        for block in range(self.horizon.n_blocks):
            previous = np.clip(
                plan[:, block], previous - self.largest_moves, previous + self.largest_moves
            )
            plan[:, block] = previous


def _largest(vector: FloatArray) -> float:
    """Largest absolute component; cheaper than an array of absolute values."""
    return max(float(vector.max()), -float(vector.min()))
