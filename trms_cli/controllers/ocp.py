"""The optimal control problem of a :class:`~trms_cli.controllers.horizon.Horizon` as a sparse NLP.

Multiple shooting over the same discretised step, with the same weights, input blocks, limits and
exact penalties: no equation is written a second time. The unknowns are ordered stage by stage,

    z_0, u_0, z_1, u_1, b_1, …, z_N, b_N, v⁺, v⁻    x_N − x_s = scale · (v⁺ − v⁻),  v⁺, v⁻, b ≥ 0

z is the state x and, as soon as moves are weighted or limited or inputs are held over blocks, the
last command; within a block a stage has no input of its own. That is the structure that fatrop
asks for. With v⁺ and v⁻ the exact penalty μ|v| + νv² is smooth; b are the violations of soft
limits.

Stages are evaluated by mapped functions, so that the code that is generated for the derivatives
does not grow with the horizon.

It is solved by interior-point methods of CasADi's wheel, compiled and cached. IPOPT: Wächter &
Biegler 2006 (Math. Prog. 106). fatrop: Vanroye, Sathya, De Schutter & Decré 2023 (IROS), which
takes the problem stage by stage and is linear in their number. Both take exact second derivatives,
as generated C where there is a compiler.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any, Literal

import casadi as ca
import numpy as np

from trms_cli.controllers.horizon import ARGUMENTS, Horizon
from trms_cli.controllers.reference_forecast import smooth_rates
from trms_cli.core.arrays import FloatArray, IntArray
from trms_cli.core.compilation import COMPILER_FLAGS, build_library
from trms_cli.core.errors import ConfigurationError

Method = Literal["fatrop", "ipopt"]

#: A barrier that starts low does not throw the last plan away.
_FIRST_BARRIER = 1e-6
_CLOSE = 1e-8
_IPOPT = {
    "print_level": 0,
    "sb": "yes",
    "mu_init": _FIRST_BARRIER,
    "warm_start_init_point": "yes",
    "warm_start_bound_push": _CLOSE,
    "warm_start_bound_frac": _CLOSE,
    "warm_start_slack_bound_push": _CLOSE,
    "warm_start_slack_bound_frac": _CLOSE,
    "warm_start_mult_bound_push": _CLOSE,
}


@dataclass(frozen=True)
class OcpSolution:
    """How a solve ended."""

    unknowns: FloatArray  #: (n,) array; the last iterate
    objective: float  #: There
    #: ``converged``, ``at_cap``: Whether it is a local minimum, and whether the iterations ran out
    #: before
    converged: bool
    at_cap: bool
    iterations: int
    message: str  #: The solver's word
    multipliers: tuple[FloatArray, FloatArray]  #: Of the bounds and of g, for a next start
    seconds: float  #: Time that it took, s


class InteriorPoint:
    """A method on a problem; keeps nothing between two solves.

    ``tolerance``: scaled residual of the optimality conditions. ``machine_code``: whether the
    derivatives run as compiled C; CasADi's virtual machine takes several times as long, and needs
    no compiler. Raises ConfigurationError if this CasADi came without the method.
    """

    def __init__(
        self, ocp: Ocp, method: Method, max_iterations: int, tolerance: float, machine_code: bool
    ) -> None:
        if not ca.has_nlpsol(method):
            raise ConfigurationError(
                f"this CasADi ({ca.__version__}) was built without {method}",
                where="controller.solver",
                remedy="install CasADi from its wheel (pip install casadi), or take the other one",
            )
        self.ocp, self._takes_multipliers = ocp, method == "ipopt"
        options = _options(ocp, method, max_iterations, tolerance)
        library = _library(ocp, method) if machine_code else None
        # A name of a library in place of the problem: its functions are loaded from there.
        self._solve = ca.nlpsol("nmpc", method, str(library) if library else ocp.nlp, options)
        self._bounds = {"lbx": ocp.lower, "ubx": ocp.upper, "lbg": ocp.g_lower, "ubg": ocp.g_upper}

    def solve(
        self, guess: FloatArray, multipliers: tuple[FloatArray, FloatArray] | None = None
    ) -> OcpSolution:
        """Solve at the horizon's present arguments; an exception of the library is a failure."""
        begin = perf_counter()
        start: dict[str, FloatArray] = {}
        if multipliers is not None and self._takes_multipliers:
            start = {"lam_x0": multipliers[0], "lam_g0": multipliers[1]}
        try:
            result = self._solve(x0=guess, p=self.ocp.parameters(), **self._bounds, **start)
            stats: dict[str, Any] = self._solve.stats()
        except RuntimeError as error:
            reason = str(error).strip().splitlines()[-1]
            none, spent = np.zeros(0), perf_counter() - begin
            return OcpSolution(guess, np.inf, False, False, 0, reason, (none, none), spent)
        unknowns = result["x"].full().ravel()
        objective = float(result["f"])
        finite = bool(np.isfinite(unknowns).all()) and np.isfinite(objective)
        word = str(stats.get("return_status", "not solved"))
        return OcpSolution(
            unknowns,
            objective,
            bool(stats["success"]) and finite,
            "iter" in word.lower() and finite,
            int(stats["iter_count"]),
            word.replace("_", " "),
            (result["lam_x"].full().ravel(), result["lam_g"].full().ravel()),
            perf_counter() - begin,
        )


def _options(ocp: Ocp, method: Method, max_iterations: int, tolerance: float) -> dict[str, Any]:
    options: dict[str, Any] = {
        "print_time": False,
        "calc_lam_p": False,
        "show_eval_warnings": False,
    }
    if method == "ipopt":
        own = {**_IPOPT, "max_iter": max_iterations, "tol": tolerance}
        return {**options, "ipopt": own}
    own = {"print_level": 0, "mu_init": _FIRST_BARRIER}
    own |= {"max_iter": max_iterations, "tolerance": tolerance}
    stages: dict[str, Any] = {
        "structure_detection": "manual",
        "equality": ocp.equality,
        **ocp.stages,
    }
    stages["N"] = len(ocp.stages["nx"]) - 1
    return {**options, **stages, "fatrop": own}


def _library(ocp: Ocp, method: Method) -> Path | None:
    """The problem's functions as a shared library in the cache; None without a compiler.

    The key is the content of the problem: its structure, not its weights, which are parameters.
    """

    def write(folder: Path) -> Path:
        solver = ca.nlpsol("nmpc", method, ocp.nlp, _options(ocp, method, 1, 1.0))
        here = os.getcwd()
        os.chdir(folder)  # the generator writes beside itself
        try:
            return folder / str(solver.generate_dependencies("nmpc.c"))
        finally:
            os.chdir(here)

    problem = ca.Function("nlp", [ocp.nlp[k] for k in "xp"], [ocp.nlp[k] for k in "fg"])
    return build_library("nmpc", [problem.serialize(), method], COMPILER_FLAGS, write)


@dataclass(frozen=True)
class Layout:
    """Where the unknowns are; all by position."""

    #: (N + 1, n_s) array; x with the memory of the input path, then the last command if
    #: ``remembers``
    states: IntArray
    inputs: IntArray  #: (n_blocks, n_u) array
    #: (N, n_limited) array; violations of the soft limits from the second stage on
    beyond: IntArray
    terminal_slack: IntArray  #: (2 n_x,) array; v⁺ and v⁻; empty without terminal equality
    size: int
    remembers: bool

    def unknowns(self, trajectory: FloatArray, plan: FloatArray, last: FloatArray) -> FloatArray:
        """A guess from a trajectory (n_full, N + 1), a plan (n_u, N) and the last command."""
        guess = np.zeros(self.size)
        states = trajectory.T
        if self.remembers:
            states = np.hstack([states, np.vstack([last, plan.T])])
        guess[self.states] = states
        return guess


@dataclass(frozen=True)
class Ocp:
    """The problem."""

    #: ``x, p, f, g`` for ``casadi.nlpsol``; p are the horizon's arguments but the plan, see
    #: :meth:`parameters`. f is the horizon's merit wherever all rows of g hold.
    nlp: dict[str, ca.MX]
    lower: FloatArray  #: (n,) arrays; of the unknowns
    upper: FloatArray  #: (n,) arrays; of the unknowns
    g_lower: FloatArray  #: (m,) arrays
    g_upper: FloatArray  #: (m,) arrays
    layout: Layout
    #: Of each of the N + 1 stages: states ``nx``, other unknowns ``nu``, and rows of g ``ng``
    #: besides those that lead to the next stage
    stages: dict[str, list[int]]
    horizon: Horizon

    @property
    def equality(self) -> list[bool]:
        """Which rows of g are equalities."""
        return (self.g_lower == self.g_upper).tolist()

    def parameters(self) -> FloatArray:
        """p, from what the horizon's arguments hold now."""
        arguments = self.horizon.arguments
        return np.concatenate([arguments[name].ravel(order="F") for name in _PARAMETERS])

    def guess(self, trajectory: FloatArray, plan: FloatArray) -> FloatArray:
        """Unknowns of a plan (n_u, n_blocks) and the trajectory (n_full, N) that it leads to."""
        arguments, horizon, layout = self.horizon.arguments, self.horizon, self.layout
        along = np.column_stack([arguments["x0"], trajectory])
        guess = layout.unknowns(along, plan[:, horizon.blocks], arguments["u_previous"])
        guess[layout.inputs] = plan.T
        n_x = horizon.model.n_x
        if layout.terminal_slack.size:
            slack = (trajectory[:n_x, -1] - arguments["x_s"]) / arguments["scale"]
            guess[layout.terminal_slack] = np.concatenate([slack, -slack]).clip(min=0.0)
        if layout.beyond.size:
            rows = [horizon.model.state_index(name) for name in horizon.limited]
            value, limits = trajectory[rows].T, arguments["limits"]
            beyond = np.maximum(limits[:, 0] - value, value - limits[:, 1])
            guess[layout.beyond] = beyond.clip(min=0.0)
        return guess

    def plan(self, unknowns: FloatArray) -> FloatArray:
        """The plan (n_u, n_blocks) in the unknowns."""
        return np.asarray(unknowns[self.layout.inputs].T)


_PARAMETERS = tuple(name for name in ARGUMENTS if name != "z")


def build(horizon: Horizon, largest_moves: FloatArray) -> Ocp:
    """State the problem of a horizon.

    ``largest_moves``: (n_u,) array; largest change of an input in one control period, V; infinite
    for none.
    """
    return _Builder(horizon, largest_moves).build()


class _Builder:
    def __init__(self, horizon: Horizon, largest_moves: FloatArray) -> None:
        self.horizon, self.model, self.discrete = horizon, horizon.model, horizon.discrete
        self.n, self.n_u = horizon.n_periods, horizon.model.n_u
        blocks = horizon.blocks
        self.begins = np.concatenate([[True], blocks[1:] != blocks[:-1]])
        self.limited_moves = np.flatnonzero(np.isfinite(largest_moves))
        self.largest_moves = largest_moves[self.limited_moves]
        moves = any(weight > 0 for weight in horizon.weights.moves.values())
        self.layout = self._layout(
            remembers=moves or self.limited_moves.size > 0 or not self.begins.all()
        )
        arguments = horizon.arguments
        self.at = {name: ca.MX.sym(name, *(*arguments[name].shape, 1)[:2]) for name in _PARAMETERS}
        self.x = ca.MX.sym("x", self.layout.size)

    def _layout(self, remembers: bool) -> Layout:
        n_s = self.discrete.n_x + (self.n_u if remembers else 0)
        n_limited = len(self.horizon.limited)
        n_slack = 2 * self.model.n_x if self.horizon.terminal is not None else 0
        position = 0

        def next_ones(count: int) -> IntArray:
            nonlocal position
            position += count
            return np.arange(position - count, position)

        states, inputs, beyond = [], [], []
        for k in range(self.n + 1):
            states.append(next_ones(n_s))
            if k < self.n and self.begins[k]:
                inputs.append(next_ones(self.n_u))
            if k > 0:
                beyond.append(next_ones(n_limited))
        slack = next_ones(n_slack)
        return Layout(
            np.array(states), np.array(inputs), np.array(beyond), slack, position, remembers
        )

    def _picked(self, positions: IntArray) -> ca.MX:
        """Unknowns as a matrix with one column for each row of positions."""
        rows, columns = positions.shape
        return ca.reshape(self.x[positions.ravel().tolist()], columns, rows)

    def build(self) -> Ocp:
        layout, n_full, n = self.layout, self.discrete.n_x, self.n
        states, plan = self._picked(layout.states), self._picked(layout.inputs)
        last = states[n_full:, :n]
        # Within a block the command is a part of the state, so that the stages stay apart.
        choice = np.where(self.begins, self.horizon.blocks, self.horizon.n_blocks + np.arange(n))
        acting = (ca.horzcat(plan, last) if layout.remembers else plan)[:, choice.tolist()]
        after = self._mapped()(states[:n_full, :n], acting, self.at["p"], self.at["w"])
        arriving = ca.vertcat(after, acting) if layout.remembers else after
        moves = plan - last[:, np.flatnonzero(self.begins).tolist()] if layout.remembers else None
        g, g_lower, g_upper, row_counts = self._rows(states, arriving, moves)
        lower, upper = self._bounds()
        return Ocp(
            {
                "x": self.x,
                "p": ca.vertcat(*(ca.vec(self.at[name]) for name in _PARAMETERS)),
                "f": self._objective(states, after, plan, moves),
                "g": g,
            },
            lower,
            upper,
            g_lower,
            g_upper,
            layout,
            {
                "nx": [n_full + last.shape[0]] * (n + 1),
                "nu": self._sizes().tolist(),
                "ng": row_counts.tolist(),
            },
            self.horizon,
        )

    def _mapped(self) -> ca.Function:
        """The step at all stages at once; parameters and disturbances are those of all."""
        discrete = self.discrete
        step = discrete.step
        if len(discrete.parts) == 1:
            at = discrete.symbols()
            # No slopes in p and w: their code would be most of it.
            options = {"is_diff_in": [True, True, False, False]}
            step = ca.Function("stage", list(at), ca.cse([discrete.step(*at)]), options)
        return step.map("stages", "serial", self.n, [2, 3], [])

    def _objective(self, states: ca.MX, after: ca.MX, plan: ca.MX, moves: ca.MX | None) -> ca.MX:
        horizon, at, model = self.horizon, self.at, self.model
        prices, layout = at["prices"], self.layout
        total = ca.MX(0)
        for i, name in enumerate(horizon.weighted):
            row = model.state_index(name)
            controlled = name in model.controlled
            goal = at["r"][model.controlled.index(name), :] if controlled else at["x_s"][row]
            total += at["q"][i] * ca.sumsqr(states[row, 1:] - goal)
        goal_rates = smooth_rates(at["r"], self.discrete.step_length)
        for i, name in enumerate(horizon.damped, start=len(horizon.weighted)):
            row = model.state_index(name)
            # From the step, not from the next state: the stages stay apart.
            rate = (after[row, :] - states[row, : self.n]) / self.discrete.step_length
            total += at["q"][i] * ca.sumsqr(rate - goal_rates[model.controlled.index(name), :])
        periods = ca.repmat(ca.DM(np.bincount(horizon.blocks)).T, self.n_u, 1)
        deviation = plan - ca.repmat(at["u_s"], 1, horizon.n_blocks)
        total += ca.dot(at["rho"], ca.sum2(periods * deviation**2))
        if moves is not None:
            total += ca.dot(at["s"], ca.sum2(moves**2))
        if layout.terminal_slack.size:
            slack = self.x[layout.terminal_slack.tolist()]
            half = layout.terminal_slack.size // 2
            total += prices[0] * ca.sum1(slack)
            total += prices[1] * ca.sumsqr(slack[:half] - slack[half:])
        if layout.beyond.size:
            beyond = self.x[layout.beyond.ravel().tolist()]
            total += prices[2] * ca.sum1(beyond) + prices[3] * ca.sumsqr(beyond)
        return total

    def _rows(
        self, states: ca.MX, arriving: ca.MX, moves: ca.MX | None
    ) -> tuple[ca.MX, FloatArray, FloatArray, IntArray]:
        """g and its bounds, stage by stage: first where the stage leads, then what it keeps.

        Last, how many rows each stage keeps.
        """
        at, layout, n, model = self.at, self.layout, self.n, self.model
        start = ca.vertcat(at["x0"], at["u_previous"]) if layout.remembers else at["x0"]
        # Each kind: values, its lower and upper bound, and the stage of each of its columns.
        kinds: list[tuple[ca.MX, FloatArray, FloatArray, IntArray]] = []

        def add(
            values: ca.MX, lower: float | FloatArray, upper: float | FloatArray, at: IntArray
        ) -> None:
            size = values.shape[0]
            kinds.append((values, np.broadcast_to(lower, size), np.broadcast_to(upper, size), at))

        stages = np.arange(n)
        add(states[:, 1:] - arriving, 0.0, 0.0, stages)
        add(states[:, 0] - start, 0.0, 0.0, np.zeros(1, dtype=np.int64))
        if moves is not None and self.limited_moves.size:
            limited = moves[self.limited_moves.tolist(), :]
            add(limited, -self.largest_moves, self.largest_moves, np.flatnonzero(self.begins))
        if layout.beyond.size:
            rows = [model.state_index(name) for name in self.horizon.limited]
            value, beyond = states[rows, 1:], self._picked(layout.beyond)
            lower, upper = (ca.repmat(at["limits"][:, i], 1, n) for i in (0, 1))
            add(value - beyond - upper, -np.inf, 0.0, stages + 1)
            add(value + beyond - lower, 0.0, np.inf, stages + 1)
        if layout.terminal_slack.size:
            half = layout.terminal_slack.size // 2
            slack = self.x[layout.terminal_slack.tolist()]
            residual = (states[: model.n_x, n] - at["x_s"]) / at["scale"]
            add(residual - slack[:half] + slack[half:], 0.0, 0.0, np.array([n]))
        stage = np.concatenate([np.repeat(k, values.shape[0]) for values, _, _, k in kinds])
        order = np.argsort(stage, kind="stable")
        g = ca.vertcat(*(ca.vec(values) for values, *_ in kinds))[order.tolist()]
        bounds = [
            np.concatenate([np.tile(kind[i], len(kind[3])) for kind in kinds])[order]
            for i in (1, 2)
        ]
        row_counts = np.bincount(stage[kinds[0][0].numel() :], minlength=n + 1)
        return g, bounds[0], bounds[1], row_counts

    def _sizes(self) -> IntArray:
        """Unknowns of each stage besides its state."""
        sizes = np.append(self.n_u * self.begins.astype(np.int64), 0)
        sizes[1:] += len(self.horizon.limited)
        sizes[-1] += self.layout.terminal_slack.size
        return sizes

    def _bounds(self) -> tuple[FloatArray, FloatArray]:
        lower, upper = np.full(self.layout.size, -np.inf), np.full(self.layout.size, np.inf)
        lower[self.layout.inputs], upper[self.layout.inputs] = self.model.input_bounds()
        lower[self.layout.beyond.ravel()] = 0.0
        lower[self.layout.terminal_slack] = 0.0
        return lower, upper
