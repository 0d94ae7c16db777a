"""Robust model predictive control by linear matrix inequalities, solved online.

After Kothare, Balakrishnan & Morari 1996 (Automatica 32). The nonlinear model is, around the
steady state of the reference, a linear one whose coefficients depend on the state; over the region
in which the state is, they lie in a polytope (:mod:`trms_cli.controllers.robust.polytope`). At each
sample the law v = v_s + K (z − z_s) is found whose worst cost over all models in it is least, with
the inputs within their limits and the angles within their stops for all time
(:mod:`trms_cli.controllers.robust.lmi`). A law acts only if its certificate holds
(:mod:`trms_cli.controllers.robust.lmi`).

With ``polytope: sub`` the region shrinks with the state: the sub-polytope. The coordinates, in
which the yaw has a gain where the tail rotor stands still, are those of
:mod:`trms_cli.controllers.robust.coordinates`.
"""

from dataclasses import dataclass
from time import perf_counter
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta

from trms_cli.controllers.controller import Command, ControlSample, ControlSetup, Status
from trms_cli.controllers.fallback import NOT_FINITE, are_finite, hold_command
from trms_cli.controllers.robust.lmi import Certificate, Inequalities, LmiSolution, Task, certify
from trms_cli.controllers.robust.polytope import StateBox, box
from trms_cli.controllers.robust.regulation import (
    LAW_NOT_FINITE,
    Aim,
    Positive,
    Regulation,
    RegulationDesign,
    no_law,
)
from trms_cli.core.arrays import FloatArray


@dataclass(frozen=True)
class Law:
    """A law that acts."""

    solution: LmiSolution
    certificate: Certificate
    task: Task  #: What it was designed for
    region: StateBox  #: Over which its polytope was taken


@dataclass
class RobustMpcState:
    """What changes during a run."""

    regulation: Regulation
    inequalities: Inequalities  #: The problem, parametrised once
    aim: Aim | None = None  #: The target of the last sample
    law: Law | None = None  #: The last whose certificate held


@dataclass(frozen=True, kw_only=True)
class RobustMpc(RegulationDesign):
    """Robust MPC, its inequalities solved at each sample."""

    #: Whether the coefficients are taken around the present state, or over a region about the
    #: target that does not change
    polytope: Literal["sub", "region"] = "sub"
    region_size: Positive = 0.7  #: Half-width of that region, in typical sizes of the states
    #: ``reach``, ``least_reach``: Half-width of the sub-polytope's region: ``reach`` times the
    #: present deviation, and at least ``least_reach`` typical sizes, in each state
    reach: Annotated[float, Meta(ge=1)] = 1.3
    least_reach: Positive = 0.3
    #: One Lyapunov matrix for all vertices, or one for each
    lyapunov: Literal["common", "parameter_dependent"] = "common"
    #: A law goes on while the state is in its ellipsoid and at more than this level of it; 1
    #: designs one at each sample
    redesign_below: Annotated[float, Meta(ge=0, le=1)] = 1.0
    solver: Literal["clarabel", "scs"] = "clarabel"
    #: Of the solver; beyond it the last law goes on
    max_iterations: Annotated[int, Meta(ge=5)] = 40
    #: What acts where no law is certified: the last certified one, cut to the limits (the steady
    #: input of the target if there was none), the steady input, or the last command
    fallback: Literal["last_law", "steady_input", "hold"] = "last_law"

    def init(self, setup: ControlSetup) -> RobustMpcState:
        """The coordinates, compiled, and the inequalities, canonicalised."""
        regulation = Regulation(self, setup)
        inequalities = Inequalities(
            regulation.n,
            regulation.m,
            2 * len(setup.model.controlled),
            2**self.principal_components,
            bounded=regulation.bounded,
            lyapunov=self.lyapunov,
            solver=self.solver,
            max_iterations=self.max_iterations,
        )
        state = RobustMpcState(regulation, inequalities)
        self._require_a_law(state, setup)
        return state

    def _require_a_law(self, state: RobustMpcState, setup: ControlSetup) -> None:
        """Refuse a model for which there is no law even near the level steady state."""
        model, regulation = setup.model, state.regulation
        aim = regulation.aim_at(np.zeros(len(model.controlled)))
        for size in _PROBES:
            z = size * regulation.angles(np.ones(len(model.controlled)))
            task = self.task(regulation, aim, z, self.region(regulation, aim, z))
            solution = state.inequalities.solve(task)
            if solution is not None and certify(task, solution).contraction < 1.0:
                return
            if self.polytope == "region":
                break
        raise no_law(model)

    def step(
        self, state: RobustMpcState, sample: ControlSample, *, want_prediction: bool
    ) -> Command:
        """One sample: target, polytope, law, certificate, command."""
        regulation = state.regulation
        x, w = sample.estimate.x, sample.estimate.disturbance
        last = regulation.limited(sample.previous_command)
        if not are_finite(x, w, sample.reference):
            return hold_command(last, NOT_FINITE)
        if not self.disturbance_compensation:
            w = np.zeros_like(w)
        aim = regulation.aim(sample, state.aim, w)
        if aim.is_new and aim is not state.aim:
            state.law = None
        state.aim = aim
        z = regulation.deviation(x, aim.target)
        law = state.law
        if law is not None and self.redesign_below < _level(law.solution, z) <= 1.0:
            return self._acting(state, x, aim, z, law)
        began = perf_counter()
        region = self.region(regulation, aim, z)
        task = self.task(regulation, aim, z, region)
        solve_begin = perf_counter()
        solution = state.inequalities.solve(task)
        command: Command
        if solution is None:
            command = self._fall_back(state, last, x, aim, z, "no law was found")
        else:
            certificate = certify(task, solution)
            if certificate.stable:
                state.law = Law(solution, certificate, task, region)
                command = self._acting(state, x, aim, z, state.law)
            else:
                reason = "the solution's certificate does not hold"
                command = self._fall_back(state, last, x, aim, z, reason)
            command.iterations = solution.iterations
        command.linearise_time, command.qp_time = solve_begin - began, perf_counter() - solve_begin
        if not np.isfinite(command.u).all():
            instead = hold_command(last, LAW_NOT_FINITE)
            command.u, command.status = instead.u, instead.status
            command.fallback, command.message = instead.fallback, instead.message
        return command

    def region(self, regulation: Regulation, aim: Aim, z: FloatArray) -> StateBox:
        """Where the coefficients are taken for a deviation z (n,) from the target."""
        if self.polytope == "region":
            extents = np.full(regulation.n, self.region_size)
            return regulation.region_of(aim.target, extents)
        return regulation.region_of(aim.target, self.reach * np.abs(z) + self.least_reach)

    def task(self, regulation: Regulation, aim: Aim, z: FloatArray, region: StateBox) -> Task:
        """The inequalities' data over a region."""
        coefficients = regulation.coefficients.over(aim.target, region)
        polytope = box(coefficients, self.principal_components, self.margin)
        return regulation.task(polytope, aim, z)

    def _acting(
        self, state: RobustMpcState, x: FloatArray, aim: Aim, z: FloatArray, law: Law
    ) -> Command:
        u = state.regulation.command(x, aim, z, law.solution.K @ z)
        words = [aim.message] if aim.message else []
        certain = law.certificate.constrained
        if not certain:
            words.append(_CUT)
        return Command(
            u,
            Status.OK if certain else Status.RELAXED,
            objective=law.certificate.gamma * _level(law.solution, z),
            slack=law.solution.slack,
            message="; ".join(words),
            out_of_reach=aim.steady.projected,
        )

    def _fall_back(
        self,
        state: RobustMpcState,
        last: FloatArray,
        x: FloatArray,
        aim: Aim,
        z: FloatArray,
        reason: str,
    ) -> Command:
        """The declared command where no law is certified."""
        regulation, law, policy = state.regulation, state.law, self.fallback
        if policy == "last_law" and law is not None:
            u = regulation.command(x, aim, z, law.solution.K @ z)
        elif policy == "hold":
            u = last
        else:
            policy = "steady_input"
            u = regulation.limited(aim.steady.u)
        words = f"{reason}; {policy.replace('_', ' ')} acts"
        return Command(u, Status.FAILED, fallback=policy, message=words)


_CUT = "no law keeps to the limits for all time from here; this one is cut to them"
#: Deviations of all angles, rad, for one of which there must be a law.
_PROBES = (0.3, 0.1, 0.03)


def _level(solution: LmiSolution, z: FloatArray) -> float:
    """Largest z'Q⁻¹z over the Lyapunov matrices."""
    return float(max(z @ np.linalg.solve(Q, z) for Q in solution.Q))
