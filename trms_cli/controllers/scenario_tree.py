"""The prediction of a linear model along a tree of scenarios, condensed.

In each of the first ``robust_horizon`` periods the rig may be any of a few branches ``x⁺ = A x +
B u + δ``; the branch of the last of them lasts to the end of the horizon. That the future is not
known makes inputs equal where the past is: the input of a period is that of all scenarios with the
same branches before it (Lucia, Finkler & Engell 2013, J. Process Control 23; Scokaert & Mayne 1998,
IEEE TAC 43). All such inputs, node by node and block by block, are the unknowns z. The objective of
a scenario is that of :class:`~trms_cli.controllers.linear_mpc.LinearMpc`, as a sum of squares

    J_s(z) = ‖R_s z_s + r_s‖²,   z_s = z[columns_s]
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from trms_cli.controllers.linear_mpc import LinearProblem
from trms_cli.core.arrays import FloatArray, IntArray
from trms_cli.core.errors import ConfigurationError

#: Scenarios beyond which a control period does not suffice.
_MOST = 32


@dataclass(frozen=True)
class ScenarioBranch:
    """``x⁺ = A x + B u + δ``, and where its cost beyond the horizon is centred."""

    A: FloatArray  #: (n, n) array
    B: FloatArray  #: (n, n_u) array
    drift: FloatArray  #: (n,) array; δ
    centre: FloatArray  #: (n + n_u,) array; state and input that it rests at


@dataclass(frozen=True)
class Outlook:
    """What a sample adds to all scenarios alike."""

    x: FloatArray  #: (n,) array; the present state, memory of the input path included
    reference: FloatArray  #: (n_r, N) array
    x_s: FloatArray  #: (n_x,) array; steady state
    u_s: FloatArray  #: (n_u,) array; V
    previous: FloatArray  #: (n_u,) array; the last command, V


@dataclass(frozen=True)
class Scenario:
    """A scenario's part of the program."""

    columns: IntArray  #: (n_z,) array; of its inputs among the unknowns
    root: FloatArray  #: (m, n_z) array; R
    rest: FloatArray  #: (m,) array; r
    #: (N, n, n_z + 1) array; states by its inputs, and without them
    trajectory: FloatArray
    limited: FloatArray  #: (n_limited·N, n_z + 1) array; the same of the limited states


class ScenarioTree:
    """The tree of a problem.

    ``n``: unknowns. ``scenarios``: branches of each, (robust_horizon,). ``columns``: of each.
    ``differences``: (n, n + 1); changes of each unknown from the one before it in time, in terms of
    the unknowns; the last column is how often the last command counts.

    Raises ConfigurationError for too many scenarios, and for blocks that hold an input while the
    tree branches.
    """

    def __init__(self, problem: LinearProblem, branches: int, robust_horizon: int) -> None:
        horizon, model = problem.horizon, problem.model
        if branches**robust_horizon > _MOST:
            raise ConfigurationError(
                f"{branches} branches in {robust_horizon} periods are "
                f"{branches**robust_horizon} scenarios, and {_MOST} are the most",
                where="controller.robust_horizon",
                remedy="choose 1, or fewer branches",
            )
        if (horizon.blocks[: robust_horizon + 1] != np.arange(robust_horizon + 1)).any():
            raise ConfigurationError(
                f"the first {robust_horizon} blocks hold an input for longer than a period",
                where="controller.move_blocks",
                remedy="begin with as many ones as controller.robust_horizon",
            )
        self.problem, self.horizon = problem, horizon
        self.scenarios = list(itertools.product(range(branches), repeat=robust_horizon))
        node: dict[tuple[int, ...], int] = {}
        places: list[list[int]] = []
        before: list[int] = []  # node of the input before each node's, −1 for the last command
        for scenario in self.scenarios:
            places.append([])
            for block in range(horizon.n_blocks):
                key = (block, *scenario[:block])
                if key not in node:
                    node[key] = len(node)
                    before.append(places[-1][-1] if block else -1)
                places[-1].append(node[key])
        n_u = model.n_u
        each = np.arange(n_u)
        self.n = len(node) * n_u
        self.columns = [(np.array(place)[:, None] * n_u + each).ravel() for place in places]
        self.differences = np.eye(self.n, self.n + 1)
        for i, earlier in enumerate(before):
            for j in range(n_u):
                if earlier >= 0:
                    self.differences[i * n_u + j, earlier * n_u + j] = -1.0
                else:
                    self.differences[i * n_u + j, self.n] = -1.0
        self._input_rows()

    def _input_rows(self) -> None:
        """Roots of the inputs' and moves' prices, of one scenario: (m, n_z)."""
        horizon, n_u = self.horizon, self.problem.model.n_u
        n_z, arguments = horizon.n_z, horizon.arguments
        periods = np.repeat(np.bincount(horizon.blocks), n_u)
        inputs = np.sqrt(periods * np.tile(arguments["rho"].ravel(), horizon.n_blocks))
        moves = np.sqrt(np.tile(arguments["s"].ravel(), horizon.n_blocks))
        self._deviations = np.diag(inputs)[inputs > 0.0]
        self._moves = moves[:, None] * (np.eye(n_z) - np.eye(n_z, k=-n_u))

    def scenario(self, at: int, branches: Sequence[ScenarioBranch], outlook: Outlook) -> Scenario:
        """The ``at``-th scenario's part."""
        horizon, model = self.horizon, self.problem.model
        n, n_u, n_z = len(outlook.x), model.n_u, horizon.n_z
        way = [branches[i] for i in self.scenarios[at]]
        state, states = np.zeros((n, n_z + 1)), np.zeros((horizon.n_periods, n, n_z + 1))
        state[:, -1] = outlook.x
        for k, block in enumerate(horizon.blocks):
            branch = way[min(k, len(way) - 1)]
            state = branch.A @ state
            state[:, -1] += branch.drift
            state[:, block * n_u : (block + 1) * n_u] += branch.B
            states[k] = state
        parts = []
        goals = {name: outlook.reference[i] for i, name in enumerate(model.controlled)}
        for name in horizon.weighted:
            row = model.state_index(name)
            error = states[:, row].copy()
            error[:, -1] -= goals.get(name, outlook.x_s[row])
            parts.append(np.sqrt(horizon.weights.states[name]) * error)
        for name in horizon.damped:
            row = model.state_index(name)
            rate = states[:, row].copy()
            rate[1:] -= states[:-1, row]
            rate[0, -1] -= outlook.x[row]
            price = np.sqrt(horizon.weights.rates[name]) / horizon.discrete.step_length
            parts.append(price * rate)
        end = np.zeros((n + n_u, n_z + 1))
        end[:n], end[n:, n_z - n_u : n_z] = states[-1], np.eye(n_u)
        end[:, -1] -= way[-1].centre
        parts.append(self.problem.root @ end)
        steady, first = np.tile(outlook.u_s, horizon.n_blocks), np.zeros(n_z)
        first[:n_u] = np.diag(self._moves)[:n_u] * outlook.previous
        parts.append(np.column_stack([self._deviations, -self._deviations @ steady]))
        parts.append(np.column_stack([self._moves, -first]))
        matrix = np.vstack(parts)
        limits = [states[:, model.state_index(name)] for name in horizon.limited]
        limited = np.vstack(limits) if limits else np.zeros((0, n_z + 1))
        return Scenario(self.columns[at], matrix[:, :-1], matrix[:, -1], states, limited)

    def limits(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper limits of a scenario's limited states, (n_limited·N,) each."""
        horizon = self.horizon
        given = np.array([horizon.soft_limits.states[name] for name in horizon.limited])
        lower, upper = np.repeat(given.reshape(-1, 2), horizon.n_periods, axis=0).T
        return lower, upper


def operating_point(
    problem: LinearProblem, angles: Mapping[str, float]
) -> tuple[FloatArray, FloatArray]:
    """State (n,), memory of the input path included, and input (n_u,) at controlled angles, rad."""
    model = problem.model
    target = problem.steady_state.solve(
        np.array([angles.get(name, 0.0) for name in model.controlled])
    )
    return problem.discrete.initial(target.x, target.u), target.u
