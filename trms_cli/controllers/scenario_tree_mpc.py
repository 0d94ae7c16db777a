"""Multistage MPC: linear MPC over a tree of parameter scenarios.

After Lucia, Finkler & Engell 2013 (J. Process Control 23). The rig may have any of a few sets of
parameters; the commands of now are one for all of them, those of later may be other ones for each,
since by then the states will have shown which it is. Minimised is the mean of all scenarios' costs,
and soft limits are those of every scenario.

The sets are the model's own and, along each of the most influential directions of the priors, one
to either side. With σ the priors' standard deviations these directions are the right singular
vectors of ``σ ∂(pulse responses of the weighted states)/∂p`` at the operating point.

The scenarios are linear: slopes of the nonlinear model with each set at the present estimate and
the last command. What the last command leads to is predicted by the model itself, with the
estimated disturbance, for all of them: they differ in what *changes* of state and command do. So
all of them rest where the model does, and there is no offset. One quadratic program has them all,
dense; DAQP solves it by default, OSQP may.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from time import perf_counter
from typing import Annotated, ClassVar

import numpy as np
from msgspec import Meta

from trms_cli.controllers.controller import Command, ControlSetup, Status
from trms_cli.controllers.fallback import NOT_FINITE
from trms_cli.controllers.linear_mpc import LinearMpc, LinearMpcState, LinearProblem, Way
from trms_cli.controllers.scenario_tree import (
    Outlook,
    Scenario,
    ScenarioBranch,
    ScenarioTree,
    operating_point,
)
from trms_cli.core.arrays import FloatArray
from trms_cli.core.compilation import BufferedFunction
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.qp import Daqp, Qp, QpResult, QpSolver, solve_or_fail
from trms_cli.models.parameters import DRAW_LIMIT_SD

#: Of a parameter's prior deviation, to take slopes by.
_STEP = 0.1


@dataclass(frozen=True, kw_only=True)
class ScenarioTreeMpc(LinearMpc):
    """Scenario-tree MPC."""

    #: Periods in which the tree branches
    robust_horizon: Annotated[int, Meta(ge=1, le=3)] = 1
    #: Directions of the priors with a set of parameters to either side
    directions: Annotated[int, Meta(ge=1, le=4)] = 1
    #: How far off these are, standard deviations
    spread: Annotated[float, Meta(gt=0, le=DRAW_LIMIT_SD)] = 2.0
    qp: QpSolver = field(default_factory=Daqp)

    #: The prediction is exact at the present.
    linearisation: ClassVar[Way] = "current"  # type: ignore[misc]

    def init(self, setup: ControlSetup) -> ScenarioTreeState:
        """The sets of parameters and the tree.

        Raises ConfigurationError as :class:`~trms_cli.controllers.linear_mpc.LinearMpc` does, for a
        model whose parameters have no priors, and for too many scenarios.
        """
        return ScenarioTreeState(self, setup)


class TreeState(LinearMpcState):
    """A law on a tree: besides the plan, its tree. What is planned is the scenarios' mean."""

    tree: ScenarioTree

    def branches(self) -> list[ScenarioBranch]:
        """The branches of this sample."""
        raise NotImplementedError

    def optimise(self, scenarios: Sequence[Scenario]) -> QpResult:
        """The best unknowns."""
        raise NotImplementedError

    def solve(self, *, want_prediction: bool) -> Command:
        """The command of the sample that was taken in."""
        newton, target, config = self.newton, self.target, self.config
        if not self.inputs_finite or target is None:
            return self.fall_back(self.problem.name, config.fallback, NOT_FINITE)
        begin = perf_counter()
        self.prepare_model()
        outlook = Outlook(self._full, newton.reference, target.x, target.u, self._last_command)
        branches = self.branches()
        scenarios = [
            self.tree.scenario(i, branches, outlook) for i in range(len(self.tree.scenarios))
        ]
        middle = perf_counter()
        result = self.optimise(scenarios)
        end = perf_counter()
        if not result.solved:
            reason = f"the program was not solved: {result.message}"
            return self.fall_back(self.problem.name, config.fallback, reason)
        z = np.clip(result.z, *self.bounds())
        parts = [z[scenario.columns] for scenario in scenarios]
        mean = np.mean(parts, axis=0).reshape(newton.plan.shape, order="F")
        newton.plan[:] = np.clip(mean, newton.lower[:, None], newton.upper[:, None])
        costs, worst = [], 0.0
        newton.trajectory[:] = 0.0
        lower, upper = self.tree.limits()
        for scenario, part in zip(scenarios, parts, strict=True):
            costs.append(float(np.square(scenario.root @ part + scenario.rest).sum()))
            states = scenario.trajectory[:, :, :-1] @ part + scenario.trajectory[:, :, -1]
            newton.trajectory[:] += states.T / len(scenarios)
            values = scenario.limited[:, :-1] @ part + scenario.limited[:, -1]
            beyond = np.maximum(lower - values, values - upper)
            worst = max(worst, float(beyond.max(initial=0.0)))
        return Command(
            newton.plan[:, 0].copy(),
            Status.OK,
            result.iterations,
            self.objective(costs),
            worst,
            linearise_time=middle - begin,
            qp_time=end - middle,
            message="; ".join(self.target_words()),
            prediction=self.prediction() if want_prediction else None,
            out_of_reach=target.projected,
        )

    def objective(self, costs: list[float]) -> float:
        """Of the costs of all scenarios: their mean."""
        return float(np.mean(costs))

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper bounds of the unknowns, (n,) each, V."""
        newton, count = self.newton, self.tree.n // self.model.n_u
        return np.tile(newton.lower, count), np.tile(newton.upper, count)

    def rate_rows(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Rows (m, n) of the changes whose rate is limited, and their bounds, (m,), V."""
        rows = self.tree.differences
        largest = np.tile(self.problem.largest_moves, len(rows) // self.model.n_u)
        limited = np.isfinite(largest)
        rows, largest = rows[limited], largest[limited]
        last = np.tile(self._last_command, self.tree.n // self.model.n_u)[limited] * -rows[:, -1]
        return rows[:, :-1], last - largest, last + largest

    def limit_rows(
        self, scenarios: Sequence[Scenario]
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Rows of the soft limits of all scenarios, and their bounds."""
        lower, upper = self.tree.limits()
        rows = np.zeros((len(scenarios) * len(lower), self.tree.n))
        bounds = []
        for i, scenario in enumerate(scenarios):
            at = np.arange(i * len(lower), (i + 1) * len(lower))
            rows[np.ix_(at, scenario.columns)] = scenario.limited[:, :-1]
            offset = scenario.limited[:, -1]
            bounds.append((lower - offset, upper - offset))
        least, most = zip(*bounds, strict=True)
        return rows, np.concatenate(least), np.concatenate(most)


class ScenarioTreeState(TreeState):
    """Sets of parameters besides.

    ``sets``: (m, n_p); the model's own first.
    """

    def __init__(self, config: ScenarioTreeMpc, setup: ControlSetup) -> None:
        super().__init__(config, setup)
        self.sets = parameter_sets(
            self.problem, config.operating_point, config.directions, config.spread
        )
        self.tree = ScenarioTree(self.problem, len(self.sets), config.robust_horizon)
        at, own = (
            operating_point(self.problem, config.operating_point),
            self.model.parameters.values,
        )
        A, B = self._slopes_of(at, own)
        stand_in = [self._slopes_of(at, p) for p in self.sets]
        # What differs from the model's own, whose slopes there are those of a finer integration.
        self._stand_in = [
            (self.problem.A + A_p - A, self.problem.B + B_p - B) for A_p, B_p in stand_in
        ]
        self._workspace = config.qp.start()

    def _slopes_of(
        self, at: tuple[FloatArray, FloatArray], p: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        x, u = at
        _, A, B = self._slopes.evaluate(x, u, p, self._disturbance)
        return A.copy(), B.copy().reshape(len(x), -1)

    def branches(self) -> list[ScenarioBranch]:
        """One a set of parameters; they agree where the last command leads to."""
        assert self.target is not None
        x, u = self._full, self._last_command
        p, w = self.model.parameters.values, self._disturbance
        after = self._step.evaluate(x, u, p, w)[0].ravel().copy()
        centre = self.newton.horizon.arguments["centre"].ravel().copy()
        branches = []
        for values, stand_in in zip(self.sets, self._stand_in, strict=True):
            A, B = self._slopes_of((x, u), values)
            usable = np.isfinite(A).all() and np.isfinite(B).all()
            if usable and (self.problem.effect(A, B) >= self.problem.least_effect).all():
                drift = after - A @ x - B @ u
            else:  # as linear_mpc: that of the operating point, which rests at the target
                A, B = stand_in
                drift = self._at_target - A @ self._at_target - B @ self.target.u
            branches.append(ScenarioBranch(A, B, drift, centre))
        return branches

    def optimise(self, scenarios: Sequence[Scenario]) -> QpResult:
        """The mean cost's minimum: without soft limits, and with them where that breaks one."""
        n = self.tree.n
        hessian, gradient = self.newton.horizon.regularisation * np.eye(n), np.zeros(n)
        for scenario in scenarios:
            columns, weight = scenario.columns, 2.0 / len(scenarios)
            hessian[np.ix_(columns, columns)] += weight * (scenario.root.T @ scenario.root)
            gradient[columns] += weight * (scenario.root.T @ scenario.rest)
        (rows, lower, upper), (low, high) = self.rate_rows(), self.bounds()
        hard = np.full(len(rows), np.inf)
        qp = Qp(
            hessian,
            gradient,
            rows,
            np.concatenate([low, lower]),
            np.concatenate([high, upper]),
            hard,
            np.ones(len(rows)),
        )
        result, self._workspace = solve_or_fail(self.config.qp, self._workspace, qp)
        if not self.newton.horizon.limited or not result.solved:
            return result
        soft_rows, least, most = self.limit_rows(scenarios)
        values = soft_rows @ result.z
        if ((values >= least) & (values <= most)).all():
            return result
        soft, m = self.newton.horizon.soft_limits, len(soft_rows)
        qp = Qp(
            hessian,
            gradient,
            np.vstack([rows, soft_rows]),
            np.concatenate([qp.lower, least]),
            np.concatenate([qp.upper, most]),
            np.concatenate([hard, np.full(m, soft.linear / len(scenarios))]),
            np.concatenate([qp.quadratic, np.full(m, soft.quadratic / len(scenarios))]),
        )
        result, self._workspace = solve_or_fail(self.config.qp, self._workspace, qp)
        return result


def parameter_sets(
    problem: LinearProblem, angles: Mapping[str, float], directions: int, spread: float
) -> FloatArray:
    """The model's own, then ``spread`` deviations to either side of each direction, (m, n_p).

    Raises ConfigurationError for a model without priors.
    """
    model = problem.model
    nominal = model.parameters.values
    sd = np.array([(p.prior_sd or 0.0) * abs(p.value) for p in model.parameters])
    uncertain = np.flatnonzero(sd)
    if not len(uncertain):
        raise ConfigurationError(
            f"no parameter of model {model.name!r} has a prior to make scenarios of",
            where="controller",
            remedy="choose a model with equations (model=newtonian), or linear_mpc",
        )
    slopes = BufferedFunction(problem.discrete.slopes())
    x, u = operating_point(problem, angles)
    root = np.sqrt([problem.horizon.weights.states[name] for name in problem.horizon.weighted])
    rows = [model.state_index(name) for name in problem.horizon.weighted]

    def responses(p: FloatArray) -> FloatArray:
        _, A, B = (value.copy() for value in slopes.evaluate(x, u, p, np.zeros(model.n_w)))
        moved, parts = B.reshape(len(x), -1), []
        for _ in range(problem.horizon.n_periods):
            parts.append(root[:, None] * moved[rows])
            moved = A @ moved
        return np.array(parts).ravel()

    columns = []
    for i in uncertain:
        step = _STEP * sd[i] * np.eye(len(nominal))[i]
        columns.append((responses(nominal + step) - responses(nominal - step)) / (2.0 * _STEP))
    _, _, ways = np.linalg.svd(np.array(columns).T, full_matrices=False)
    sets = [nominal]
    lower = np.array([p.lower for p in model.parameters])
    upper = np.array([p.upper for p in model.parameters])
    for way in ways[:directions]:
        for side in (spread, -spread):
            moved = nominal.copy()
            moved[uncertain] += side * sd[uncertain] * way
            sets.append(np.clip(moved, lower, upper))
    return np.array(sets)
