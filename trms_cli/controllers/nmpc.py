"""Nonlinear model predictive control: each sample solved to convergence, by interior points.

The problem is that of :class:`~trms_cli.controllers.newton_mpc.NewtonMpc` key by key: the same
discretised model, weights, horizon, blocks of inputs, limits, and exact penalty of the terminal
equality (see :mod:`trms_cli.controllers.ocp`). What differs is how it is solved: all states are
unknowns, the second derivatives are exact, and the iterations go on until the optimality
conditions hold. It is what to compare with, and a second opinion where Newton's iteration stalls,
at many times its price.

Each solve starts from the last plan shifted in time and rolled out. A problem that is not convex
may have a better minimum elsewhere: where the reference is new, or a solve failed, the sample is
also solved from the steady state.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta

from trms_cli.controllers.controller import Command, ControlSample, ControlSetup, Status
from trms_cli.controllers.fallback import NOT_FINITE, Policy
from trms_cli.controllers.horizon import HorizonSettings, Positive
from trms_cli.controllers.newton.state import NewtonMpcState
from trms_cli.controllers.newton_mpc import NewtonMpc
from trms_cli.controllers.ocp import InteriorPoint, Method, OcpSolution, build
from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import ConfigurationError

#: Keys that have another meaning than those of ``newton_mpc``.
_OWN = {"max_iterations", "tolerance", "fallback"}
#: Rounding of a rate limit, V.
_HAIR = 1e-6


@dataclass(frozen=True, kw_only=True)
class Nmpc(HorizonSettings):
    """Nonlinear MPC by IPOPT or fatrop."""

    #: Whether the predicted trajectory must end in the steady state of the reference
    terminal: Literal["equality", "none"] = "equality"
    #: ``terminal_linear``, ``terminal_quadratic``: Exact penalty of that, relative to typical sizes
    #: of the states
    terminal_linear: Positive = 100.0
    terminal_quadratic: Positive = 1000.0
    solver: Method = "ipopt"
    #: Of a solve. A sample that runs into it takes what it has if that is better than the last
    #: plan, and falls back otherwise. There is no limit in time: a run would depend on the machine.
    max_iterations: Annotated[int, Meta(ge=1)] = 200
    #: Scaled residual of the optimality conditions
    tolerance: Annotated[float, Meta(gt=0, le=1e-2)] = 1e-8
    #: When a sample is also solved from the steady state; the better minimum counts.
    #: ``new_reference`` does so after a failure, too.
    second_start: Literal["new_reference", "always", "never"] = "new_reference"
    #: Whether derivatives run as compiled C, built once for each structure of the problem
    machine_code: bool = True
    #: What acts when a solve fails: the last plan shifted in time, the last command, the
    #: steady-state input of the reference, or the end of the run
    fallback: Policy = "shifted_plan"

    def problem(self) -> NewtonMpc:
        """The ``newton_mpc`` whose problem this is.

        Raises ConfigurationError for a horizon that is shorter than the preview.
        """
        field_names = {f.name for f in fields(NewtonMpc)} - _OWN
        return NewtonMpc(
            **{f.name: getattr(self, f.name) for f in fields(self) if f.name in field_names}
        )

    @classmethod
    def of(cls, problem: NewtonMpc, **own: Any) -> Nmpc:
        """The same problem as a ``newton_mpc`` poses, with keys of this class besides.

        Raises ConfigurationError for a terminal region, which this problem does not have.
        """
        if problem.terminal not in ("equality", "none"):
            raise ConfigurationError(
                f"terminal={problem.terminal} has no counterpart here",
                where="terminal",
                remedy="equality or none",
            )
        field_names = {f.name for f in fields(cls)} - _OWN
        shared = {
            f.name: getattr(problem, f.name) for f in fields(problem) if f.name in field_names
        }
        return cls(**{**shared, **own})

    def init(self, setup: ControlSetup) -> NmpcState:
        """Compiled functions, the solver and the first plan."""
        return NmpcState(self, setup)

    def step(self, state: NmpcState, sample: ControlSample, *, want_prediction: bool) -> Command:
        """One sample: target, solves, command."""
        shared = state.shared
        shared.begin_sample(sample)
        if not shared.inputs_finite:
            return state.fall_back(NOT_FINITE)
        candidate, message = state.solved()
        if candidate is None:
            return state.fall_back(message)
        newton, evaluate = shared.newton, shared.newton.horizon.evaluate
        newton.plan[:] = candidate.plan
        newton.merit(newton.plan)
        trajectory, terminal, objective, _, violation = evaluate.outputs
        newton.trajectory[:] = trajectory
        missed = float(np.abs(terminal).max()) if newton.horizon.terminal is not None else 0.0
        status = Status.OK if candidate.converged else Status.BUDGET
        if missed > shared.relaxed_above:
            status = Status.RELAXED
        return Command(
            newton.plan[:, 0].copy(),
            status,
            state.iterations,
            float(objective[0]),
            max(float(violation[0]), missed),
            qp_time=state.seconds,
            message=state.words(status, message),
            prediction=shared.prediction() if want_prediction else None,
            out_of_reach=shared.target is not None and shared.target.projected,
        )


@dataclass(frozen=True)
class _Candidate:
    """A plan (n_u, n_blocks), its merit, whether it is a minimum, and the multipliers there."""

    plan: FloatArray
    merit: float
    converged: bool
    multipliers: tuple[FloatArray, FloatArray]

    def better_than(self, other: _Candidate) -> bool:
        """A minimum before what is none; then the lower merit."""
        return (not self.converged, self.merit) < (not other.converged, other.merit)


class NmpcState:
    """What changes during a run: the plan with its target, and the solver's multipliers.

    ``shared``: sample, target, plan and memory of the input path, as of ``newton_mpc``.
    ``iterations``, ``seconds``: of the last sample's solves.
    """

    def __init__(self, config: Nmpc, setup: ControlSetup) -> None:
        self.config = config
        self.shared = NewtonMpcState(config.problem(), setup)
        self.ocp = build(self.shared.newton.horizon, self.shared.newton.largest_moves)
        self.solver = InteriorPoint(
            self.ocp, config.solver, config.max_iterations, config.tolerance, config.machine_code
        )
        self._multipliers: tuple[FloatArray, FloatArray] | None = None
        self.iterations, self.seconds = 0, 0.0
        self._merit_before = np.inf

    def solved(self) -> tuple[_Candidate | None, str]:
        """The best plan that there is, or why there is none."""
        shared, second = self.shared, self.config.second_start
        shifted = self._within_rates(shared.newton.plan)
        multipliers, self._multipliers = self._multipliers, None
        new = shared.other_start is not None or multipliers is None
        self.iterations, self.seconds = 0, 0.0
        self._merit_before = shared.newton.merit(shifted)
        best, message = self._from(shifted, multipliers)
        is_due = second == "always" or (second == "new_reference" and (new or best is None))
        if is_due and shared.target is not None:
            steady = np.broadcast_to(shared.target.u[:, None], shifted.shape)
            other, _ = self._from(self._within_rates(steady), None)
            if best is None or (other is not None and other.better_than(best)):
                best = other
        if best is None:
            return None, message
        self._multipliers = best.multipliers if best.converged else None
        return best, ""

    def _from(
        self, start: FloatArray, multipliers: tuple[FloatArray, FloatArray] | None
    ) -> tuple[_Candidate | None, str]:
        """What the solver finds from a plan, or why that is of no use."""
        if not self.shared.newton.merit(start) < np.inf:
            return None, "the predicted trajectory is not finite"
        trajectory = self.shared.newton.horizon.evaluate.outputs[0]
        solution = self.solver.solve(self.ocp.guess(trajectory, start), multipliers)
        self.iterations += solution.iterations
        self.seconds += solution.seconds
        return self._usable(solution), f"{self.config.solver}: {solution.message}"

    def _usable(self, solution: OcpSolution) -> _Candidate | None:
        """A minimum; or, where the iterations ran out, a plan that is better than the last one."""
        if not (solution.converged or solution.at_cap):
            return None
        lower, upper = self.shared.newton.lower, self.shared.newton.upper
        plan = np.clip(self.ocp.plan(solution.unknowns), lower[:, None], upper[:, None])
        merit = self.shared.newton.merit(plan)
        if not merit < np.inf:
            return None
        if solution.converged:
            return _Candidate(plan, merit, True, solution.multipliers)
        correction = np.abs(self._within_rates(plan) - plan).max()
        if merit < self._merit_before and correction < _HAIR:
            return _Candidate(plan, merit, False, solution.multipliers)
        return None

    def _within_rates(self, plan: FloatArray) -> FloatArray:
        limited = np.array(plan)
        if np.isfinite(self.shared.newton.largest_moves).any():
            self.shared.newton.limit_rates(limited)
        return limited

    def words(self, status: Status, message: str) -> str:
        """What a person should know of a sample."""
        solved = [status.meaning] if status is not Status.OK else []
        return "; ".join([*solved, *self.shared.target_words(), *([message] if message else [])])

    def fall_back(self, reason: str) -> Command:
        """The declared command of a sample that has no solution."""
        self._multipliers = None
        return self.shared.fall_back("nmpc", self.config.fallback, reason)
