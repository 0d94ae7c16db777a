"""Laws on their polytopes: what they cost, what they keep under the worst switching, how true."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from experiments.chapter8.judgement import decrease_on, independent_cube
from experiments.chapter8.study import FloatArray, Study, online, setup_of, start_state
from trms_cli.controllers.robust.lmi import (
    Certificate,
    Inequalities,
    LmiSolution,
    Lyapunov,
    Task,
    certify,
)
from trms_cli.controllers.robust.polytope import box
from trms_cli.controllers.robust.regulation import Aim, Regulation
from trms_cli.models.newtonian import Newtonian


@dataclass(frozen=True)
class Switching:
    """A run on the polytope."""

    cost: float  #: Spent, relative to the certified bound
    rise: float  #: Largest V(k+1) + stage cost over V(k): at most 1
    #: ``inputs``, ``states``: Largest |v_i| and |z_i| relative to their bounds
    inputs: float
    states: float
    values: FloatArray  #: (steps,) array; V relative to its start


@dataclass(frozen=True)
class LawResult:
    """One law."""

    start: tuple[float, float]
    kind: str
    region: str
    vertices: int
    certificate: Certificate | None
    slack: float
    covered: bool  #: Whether the ellipsoid lies in the region of the polytope
    #: Share of independent coefficients of the nonlinear model under which V falls
    decreasing: float
    greedy: Switching | None
    random: Switching | None


class Bench:
    """The regulation of the nominal rig to (0, 0), and problems by their sizes."""

    def __init__(self, **design: object) -> None:
        self.model = Newtonian()
        self.controller = online(**design)
        self.regulation = Regulation(self.controller, setup_of(self.model))
        self.aim: Aim = self.regulation.aim_at(np.zeros(2))
        self._problems: dict[tuple[int, str], Inequalities] = {}

    def deviation(self, start: tuple[float, float], *, hover: bool) -> FloatArray:
        """z of a start, the main rotor at the target's speed or at rest."""
        steady = self.aim.steady.x
        row = self.model.state_index("omega_v")
        x = start_state(self.model, start, float(steady[row]) if hover else 0.0)
        if hover:
            for name in ("S_h", "S_v"):
                x[self.model.state_index(name)] = steady[self.model.state_index(name)]
        return self.regulation.deviation(x, self.aim.target)

    def solve(self, task: Task, lyapunov: Lyapunov = "common") -> LmiSolution | None:
        """The law of a task."""
        key = (len(task.A), lyapunov)
        if key not in self._problems:
            r = self.regulation
            self._problems[key] = Inequalities(
                r.n, r.m, 4, len(task.A), bounded=r.bounded, lyapunov=lyapunov
            )
        return self._problems[key].solve(task)


def study_laws(study: Study) -> list[LawResult]:
    """Every start by every kind of law."""
    bench = Bench()
    cube = independent_cube(study.laws.points, bench.regulation.n + bench.regulation.m, study.seed)
    results = []
    for start in study.starts:
        z = bench.deviation(start, hover=True)
        for region_kind in ("sub", "region"):
            for components in study.laws.components:
                for lyapunov in ("common", "parameter_dependent"):
                    if lyapunov == "parameter_dependent" and components > 2:
                        continue  # 64 pairs: minutes for nothing new
                    results.append(
                        _law(study, bench, start, z, region_kind, components, lyapunov, cube)
                    )
    return results


def _law(
    study: Study,
    bench: Bench,
    start: tuple[float, float],
    z: FloatArray,
    region_kind: str,
    components: int,
    lyapunov: Lyapunov,
    cube: FloatArray,
) -> LawResult:
    r, c, target = bench.regulation, bench.controller, bench.aim.target
    extents = c.reach * np.abs(z) + c.least_reach
    if region_kind == "region":
        extents = np.full(r.n, c.region_size)
    region = r.region_of(target, extents)
    polytope = box(r.coefficients.over(target, region), components, c.margin)
    task = r.task(polytope, bench.aim, z)
    solution = bench.solve(task, lyapunov)
    if solution is None:
        return LawResult(
            start, lyapunov, region_kind, polytope.vertices, None, np.nan, False, np.nan, None, None
        )
    certificate = certify(task, solution)
    reached = np.sqrt(np.array([np.diag(Q) for Q in solution.Q]).max(axis=0))
    covered = region.contains(r.region_of(target, reached), 1e-6 * r.scale_z)
    decreasing = np.nan
    if len(solution.Q) == 1:
        contraction, _ = decrease_on(r.coefficients.over(target, region, cube), solution, task)
        decreasing = float(np.mean(contraction < 1.0))
    runs = [
        switching(task, solution, certificate, study.laws.steps, study.seed if chance else None)
        for chance in (False, True)
    ] if certificate.stable else [None, None]  # fmt: skip
    return LawResult(
        start, lyapunov, region_kind, polytope.vertices, certificate, solution.slack, covered,
        decreasing, runs[0], runs[1],
    )  # fmt: skip


def switching(
    task: Task, solution: LmiSolution, certificate: Certificate, steps: int, seed: int | None
) -> Switching:
    """Vertices chosen at each step to hurt most (no seed) or at random.

    V is that of the certified bound, from the first state of the task.
    """
    P = certificate.gamma * np.linalg.inv(solution.Q)
    own = np.arange(len(task.A)) % len(P)
    stage = task.C.T @ task.C + solution.K.T * task.R @ solution.K
    closed = task.A + task.B @ solution.K
    random = None if seed is None else np.random.default_rng(seed)
    z, vertex = task.z[0], 0
    values, spent, rise, inputs, states = [], 0.0, 0.0, 0.0, 0.0
    first = max(z @ P[k] @ z for k in own)
    for _ in range(steps):
        now, cost = float(z @ P[own[vertex]] @ z), float(z @ stage @ z)
        values.append(now / first)
        inputs = max(inputs, float((np.abs(solution.K @ z) / task.input_bounds).max()))
        states = max(states, float((np.abs(z) / task.state_bounds).max()))
        after = closed[vertex] @ z
        costs = [float(after @ P[k] @ after) for k in own]
        vertex = int(np.argmax(costs)) if random is None else int(random.integers(len(own)))
        rise = max(rise, (costs[vertex] + cost) / max(now, 1e-300))
        spent += cost
        z = after
    return Switching(spent / certificate.gamma, rise, inputs, states, np.array(values))
