"""Min–max feedback MPC: linear MPC against the worst of a few constant torques.

After Scokaert & Mayne 1998 (IEEE TAC 43): the disturbance takes any vertex of a box in each of the
first ``robust_horizon`` periods, and the last one goes on; inputs may depend on the vertices that
were, not on those to come. Minimised is the worst cost of all such sequences, and soft limits are
those of every one. The disturbances are torques on the rig's axes, or on its rotors, beside those
that the observer has estimated.

Costs are quadratic, in place of the paper's norms that make a linear program, so that the minimum
is one of a second-order cone program,

    min  t + ε mean_s J_s(z) + prices of soft limits     s.t.  ‖R_s z_s + r_s‖² ≤ t  for every s

which Clarabel solves (Goulart & Chen 2024); ε makes inputs of scenarios that are not the worst
unique. The model is the linear one of :mod:`trms_cli.controllers.linear_mpc` at the present. The
cost beyond the horizon is centred at each vertex' own steady state, of the linear model at the
operating point, so that a torque that can be held has no price for ever.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, ClassVar

import numpy as np
from msgspec import Meta

from trms_cli.controllers.controller import ControlSetup
from trms_cli.controllers.linear_mpc import LinearMpc, Way
from trms_cli.controllers.scenario_tree import (
    Scenario,
    ScenarioBranch,
    ScenarioTree,
    operating_point,
)
from trms_cli.controllers.scenario_tree_mpc import TreeState
from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import require_known
from trms_cli.core.qp import Daqp, QpResult, QpSolver
from trms_cli.core.ranges import NotNegative
from trms_cli.models.model import Model, names
from trms_cli.models.state_scales import state_scales

#: Torques of a model of a user's as a share of what full command does.
_SHARE = 0.05
#: ε, of the mean cost beside the worst.
_MEAN = 1e-3
#: Violation of a soft limit that counts as none, the state's unit.
_HAIR = 1e-7
#: Names of the 2 DOF rig's torques, so that one configuration also serves its 1 DOF models.
_OF_BOTH_AXES = {"pitch_moment", "yaw_moment", "main_motor", "tail_motor"}


@dataclass(frozen=True, kw_only=True)
class MinMaxMpc(LinearMpc):
    """Min–max MPC."""

    #: Fewer than others take: the work goes with the cube of inputs times scenarios
    move_blocks: tuple[int, ...] = (1, 1, 1, 1, 2, 2, 4, 4, 8, 16)
    #: Periods in which the torques may change
    robust_horizon: Annotated[int, Meta(ge=1, le=3)] = 1
    #: Largest torque to either side by equation of the model, N m (of a black box: rad/s²)
    torques: Mapping[str, NotNegative] = field(
        default_factory=lambda: {"pitch_moment": 0.005, "yaw_moment": 0.002}
    )
    max_iterations: Annotated[int, Meta(ge=1)] = 60  # type: ignore[misc]  #: Of the interior point

    #: The prediction is exact at the present.
    linearisation: ClassVar[Way] = "current"  # type: ignore[misc]
    #: Its programs are cones, which no quadratic program's solver takes.
    qp: ClassVar[QpSolver] = Daqp()  # type: ignore[misc]

    def init(self, setup: ControlSetup) -> MinMaxState:
        """Vertices and tree.

        Raises ConfigurationError as :class:`~trms_cli.controllers.linear_mpc.LinearMpc` does, for a
        torque that the model does not have, for none, and for too many scenarios.
        """
        return MinMaxState(self, setup)


class MinMaxState(TreeState):
    """Vertices besides.

    ``vertices``: (m, n_w); torques. ``shifts``: (m, n + n_u); of the steady states under them.
    """

    def __init__(self, config: MinMaxMpc, setup: ControlSetup) -> None:
        super().__init__(config, setup)
        import clarabel  # before the first sample, not at it

        self._clarabel, self._iterations = clarabel, config.max_iterations
        self.vertices = _vertices(_torques(config, self.model), names(self.model.disturbances))
        self.tree = ScenarioTree(self.problem, len(self.vertices), config.robust_horizon)
        self.shifts = self._shifts(*operating_point(self.problem, config.operating_point))

    def _effects(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """What each vertex adds to the next state, (m, n)."""
        p, w = self.model.parameters.values, self._disturbance
        after = self._step.evaluate(x, u, p, w)[0].ravel().copy()
        pushed = [
            self._step.evaluate(x, u, p, w + each)[0].ravel().copy() for each in self.vertices
        ]
        with np.errstate(invalid="ignore"):  # far out of reach both are infinite: it falls back
            return np.array(pushed) - after

    def _shifts(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Of state and input at rest, angles kept, by the linear model of the operating point."""
        problem, model = self.problem, self.model
        n, n_u = problem.B.shape
        angles = np.zeros((len(model.controlled), n + n_u))
        for i, name in enumerate(model.controlled):
            angles[i, model.state_index(name)] = 1.0
        matrix = np.vstack([np.hstack([problem.A - np.eye(n), problem.B]), angles])
        effects = self._effects(x, u)
        sides = np.hstack([-effects, np.zeros((len(effects), len(angles)))])
        return np.asarray(np.linalg.lstsq(matrix, sides.T, rcond=None)[0].T)

    def branches(self) -> list[ScenarioBranch]:
        """One a vertex."""
        arguments, n = self.newton.horizon.arguments, len(self._full)
        A, B, drift = np.split(arguments["p"].ravel(), [n * n, n * (n + self.model.n_u)])
        A, B = A.reshape(n, n).copy(), B.reshape(n, -1).copy()
        centre = arguments["centre"].ravel()
        effects = self._effects(self._full, self._last_command)
        return [
            ScenarioBranch(A, B, drift + effect, centre + shift)
            for effect, shift in zip(effects, self.shifts, strict=True)
        ]

    def objective(self, costs: list[float]) -> float:
        """Of the costs of all scenarios: the worst."""
        return max(costs)

    def optimise(self, scenarios: Sequence[Scenario]) -> QpResult:
        """The worst cost's minimum: without soft limits, and with them where that breaks one."""
        none = np.zeros((0, self.tree.n)), np.zeros(0), np.zeros(0)
        # Numbers near one, whatever is left to go.
        scale = 1.0 / max(1e-6, *(float(np.linalg.norm(each.rest)) for each in scenarios))
        # A scenario's cost by as many rows as it has inputs.
        roots = [_triangle(scenario, scale) for scenario in scenarios]
        result = self._solved(scenarios, roots, scale, none)
        if not self.newton.horizon.limited or not result.solved:
            return result
        rows, least, most = self.limit_rows(scenarios)
        values = rows @ result.z
        if ((values >= least - _HAIR) & (values <= most + _HAIR)).all():
            return result
        return self._solved(scenarios, roots, scale, (rows, least, most))

    def _solved(
        self,
        scenarios: Sequence[Scenario],
        roots: list[tuple[FloatArray, FloatArray]],
        scale: float,
        soft_rows: tuple[FloatArray, FloatArray, FloatArray],
    ) -> QpResult:
        """The program with soft rows, whose unknowns are (z, t, largest violations by scenario)."""
        from scipy import sparse

        horizon = self.newton.horizon
        n, soft, count = self.tree.n, horizon.soft_limits, len(scenarios)
        m = count if len(soft_rows[0]) else 0
        hessian = scale**2 * horizon.regularisation * np.eye(n)
        gradient = np.zeros(n)
        for scenario, (root, rest) in zip(scenarios, roots, strict=True):
            columns, weight = scenario.columns, 2.0 * _MEAN / count
            hessian[np.ix_(columns, columns)] += weight * (root.T @ root)
            gradient[columns] += weight * (root.T @ rest)
        # The largest violation of a scenario stands for those of all its periods.
        price = scale**2 * horizon.n_periods
        width = 1 + m
        P = np.zeros((n + width, n + width))
        P[:n, :n] = np.triu(hessian)
        P[range(n + 1, n + width), range(n + 1, n + width)] = 2.0 * price * soft.quadratic
        q = np.concatenate([gradient, [1.0], np.full(m, price * soft.linear)])
        rows, lower, upper = self.rate_rows()
        low, high = self.bounds()
        bounded = np.pad(np.vstack([np.eye(n), rows]), ((0, 0), (0, width)))
        parts, sides = (
            [bounded, -bounded],
            [
                np.concatenate([high, upper]),
                -np.concatenate([low, lower]),
            ],
        )
        if m:
            slack = np.zeros((len(soft_rows[0]), width))
            each = len(slack) // count
            slack[range(len(slack)), 1 + np.arange(len(slack)) // each] = -1.0
            positive = np.pad(-np.eye(m), ((0, 0), (n + 1, 0)))
            parts += [np.hstack([sign * soft_rows[0], slack]) for sign in (1.0, -1.0)] + [positive]
            sides += [soft_rows[2], -soft_rows[1], np.zeros(m)]
        cones = [self._clarabel.NonnegativeConeT(sum(map(len, sides)))]
        for scenario, (root, rest) in zip(scenarios, roots, strict=True):
            # ‖R z + r‖² ≤ t  ⇔  ‖(2 (R z + r), t − 1)‖ ≤ t + 1
            cone = np.zeros((len(root) + 2, n + width))
            cone[:2, n] = -1.0
            cone[2:, scenario.columns] = -2.0 * root
            parts.append(cone)
            sides.append(np.concatenate([[1.0, -1.0], 2.0 * rest]))
            cones.append(self._clarabel.SecondOrderConeT(len(cone)))
        settings = self._clarabel.DefaultSettings()
        settings.verbose, settings.max_iter = False, self._iterations
        solver = self._clarabel.DefaultSolver(
            sparse.csc_matrix(P),
            q,
            sparse.csc_matrix(np.vstack(parts)),
            np.concatenate(sides),
            cones,
            settings,
        )
        solution = solver.solve()
        z, status = np.array(solution.x[:n]), str(solution.status)
        solved = status in ("Solved", "AlmostSolved") and bool(np.isfinite(z).all())
        return QpResult(z, solved, int(solution.iterations), "" if solved else status)


def _torques(config: MinMaxMpc, model: Model) -> Mapping[str, float]:
    """Those given, or of a model of a user's that has none of them, a share of what its inputs do.

    On each of its axes.
    """
    moments = [axis.moment for axis in model.axes.values()]
    given = set(names(model.disturbances)) & {*config.torques}
    if model.bench_sizes or given or not config.torques:
        return config.torques
    scales = dict(zip(names(model.disturbances), state_scales(model).disturbances, strict=True))
    return {**config.torques, **{name: _SHARE * float(scales[name]) for name in moments}}


def _vertices(torques: Mapping[str, float], known: tuple[str, ...]) -> FloatArray:
    """All combinations of the torques' ends, (m, n_w)."""
    for name in torques:
        if name not in _OF_BOTH_AXES:
            require_known(name, known, f"the model has no {name!r}", f"controller.torques.{name}")
    sizes = [(known.index(name), size) for name, size in torques.items() if name in known]
    sizes = [(row, size) for row, size in sizes if size > 0.0]
    if not sizes:
        raise ConfigurationError(
            "no torque of this model to be robust against",
            where="controller.torques",
            remedy=f"give one of {', '.join(known)}, or take linear_mpc",
        )
    vertices = []
    for signs in itertools.product((1.0, -1.0), repeat=len(sizes)):
        torque = np.zeros(len(known))
        for sign, (row, size) in zip(signs, sizes, strict=True):
            torque[row] = sign * size
        vertices.append(torque)
    return np.array(vertices)


def _triangle(scenario: Scenario, scale: float) -> tuple[FloatArray, FloatArray]:
    """The same cost, ``scale² ‖R z + r‖²``, with at most a row more than inputs."""
    rows = scale * np.column_stack([scenario.root, scenario.rest])
    joint = np.asarray(np.linalg.qr(rows, mode="r"), dtype=np.float64)
    return joint[:, :-1], joint[:, -1]
