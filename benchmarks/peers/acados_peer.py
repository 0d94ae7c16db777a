"""acados (Verschueren et al. 2022, Math. Program. Comput. 14) as a controller of the same loop.

Its own way of stating the problem of a ``newton_mpc``, in multiple shooting over the same
discretised step. The state x is augmented by what the stage costs look back on,

    ξ_k = (x_k, α_{k−1} of the damped angles, u_{k−1})

so that every error is linear in (ξ, u): ``LINEAR_LS``, whose Hessian is that of Gauss and Newton.
acados takes ½‖V_x ξ + V_u u − y_ref‖²_W at each node, times the length of its interval: W is twice
the weights, and the intervals have length one (the step is discrete, time does not enter it). The
states are weighed from node 1 on, the inputs up to node N − 1. The terminal equality is a pair of
soft bounds at node N with a linear and a quadratic price, the exact penalty of ``newton_mpc``.

Written after the Python interface of acados 0.5 (``acados_template``); older ones state some of it
otherwise and have another reading of soft bounds in their interface to DAQP.
"""

from __future__ import annotations

import importlib
import importlib.util
import itertools
import os
import tempfile
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from trms_cli.controllers.controller import Command, ControlSample, ControlSetup, Status
from trms_cli.controllers.newton.problem import NewtonProblem
from trms_cli.controllers.newton_mpc import NewtonMpc
from trms_cli.core.arrays import FloatArray
from trms_cli.core.compilation import BufferedFunction
from trms_cli.core.errors import ConfigurationError
from trms_cli.models.model import names

#: Where acados says how it is built, and how Python gets at it.
INSTALLATION = "https://docs.acados.org/installation"
PYTHON_INTERFACE = "https://docs.acados.org/python_interface"
#: What acados solves its quadratic programs with here.
FULL_CONDENSING, PARTIAL_CONDENSING = "FULL_CONDENSING_DAQP", "PARTIAL_CONDENSING_HPIPM"
#: Control periods that partial condensing makes one of.
CONDENSED_PERIODS = 4
#: Half of the distance between the two soft bounds at the end, in the states' units. DAQP takes
#: bounds that are nearer than 1e-11 for an equality and makes it hard.
BOUND_GAP = 1e-9
#: Of ``AcadosOcpSolver.solve``.
_SUCCESS, _ITERATION_LIMIT = 0, 2
_SETTLED = 1e-9  # V, between two solves of one sample
#: Names of generated code: a library of the same name would be taken for one that is loaded.
_serial_number = itertools.count()


def missing_part() -> str:
    """What there is to install before acados runs here, and where that is told; empty for nothing.

    Looked at beforehand: acados would ask for its template renderer, or fetch it, in the middle of
    a benchmark.
    """
    package = importlib.util.find_spec("acados_template")
    if package is None:
        return f"not installed (acados_template): {INSTALLATION}, then {PYTHON_INTERFACE}"
    given = os.environ.get("ACADOS_SOURCE_DIR")
    # acados itself takes the tree that its Python package lies in.
    root = Path(given) if given else Path(str(package.origin)).resolve().parents[3]
    where = f"{root} (ACADOS_SOURCE_DIR{'' if given else ' is not set'})"
    if not any(file for folder in ("lib", "bin") for file in (root / folder).glob("*acados.*")):
        return f"its library is missing in {where}: {INSTALLATION}"
    renderer = os.environ.get("TERA_PATH")
    if not (Path(renderer).exists() if renderer else any((root / "bin").glob("t_renderer*"))):
        return f"its t_renderer is missing in {where}: {PYTHON_INTERFACE}"
    return ""


class Acados:
    """acados on the problem of a ``newton_mpc`` without blocks, limits on rates and soft limits.

    ``qp_solver``: one of the names above. ``max_iterations``: 1 for ``SQP_RTI``, else those of
    ``SQP``. Compiled once: a new run takes the solver of the last one over, so that there is one
    run at a time.
    """

    def __init__(self, problem: NewtonMpc, qp_solver: str, max_iterations: int) -> None:
        self.problem, self.qp_solver, self.max_iterations = problem, qp_solver, max_iterations
        self._state: AcadosState | None = None

    @property
    def sample_time(self) -> float:
        """Control period, s."""
        return self.problem.sample_time

    def preview(self, setup: ControlSetup) -> int:
        """The reference is taken as constant."""
        return 0

    def init(self, setup: ControlSetup) -> AcadosState:
        """The problem stated to acados, and its generated C compiled."""
        if self._state is None:
            self._state = AcadosState(self, setup)
        self._state.begin()
        return self._state

    def step(self, state: AcadosState, sample: ControlSample, *, want_prediction: bool) -> Command:
        """One sample."""
        return state.solve(sample)


class AcadosState:
    """acados' solver with its present iterate, and what is known of target and reference."""

    def __init__(self, controller: Acados, setup: ControlSetup) -> None:
        acados = importlib.import_module("acados_template")
        if not hasattr(acados.AcadosOcpSolver, "set_flat"):
            raise ConfigurationError(
                "acados is older than this benchmark can use",
                where="acados_template",
                remedy=f"acados 0.5 or newer: {INSTALLATION}",
            )
        self._is_real_time = controller.max_iterations == 1
        self._problem = problem = controller.problem.problem(setup)
        self._statement = Statement(problem)
        # acados writes C into a folder, and loads the library from there.
        self._folder = tempfile.TemporaryDirectory(prefix="acados_")
        ocp = self._statement.ocp(acados, controller.qp_solver, controller.max_iterations)
        ocp.code_export_directory = str(Path(self._folder.name) / "c")
        json_file = str(Path(self._folder.name) / "ocp.json")
        self.solver = acados.AcadosOcpSolver(ocp, json_file=json_file, verbose=False)
        self._step = BufferedFunction(problem.discrete.step)
        self._lower, self._upper = problem.model.input_bounds()
        self.begin()

    def begin(self) -> None:
        """Forget the last run."""
        self._target: Any = None
        self._reference: list[float] = []
        self._x: FloatArray | None = None  # (N + 1, n_ξ)
        self._u: FloatArray = np.zeros((0, 0))  # (N, n_u)

    def solve(self, sample: ControlSample, repeats: int = 1) -> Command:
        """One sample: target, shifted iterate, solve.

        ``repeats``: solves, each from the end of the one before; many of ``SQP_RTI`` are an SQP
        method with full steps.
        """
        self._take_reference(sample.reference[-1])
        statement, solver = self._statement, self.solver
        start = statement.augmented(sample.estimate.x, sample.previous_command)
        self._shift(sample.estimate.x, start)
        solver.set(0, "lbx", start)
        solver.set(0, "ubx", start)
        iterations, seconds = 0, 0.0
        for _ in range(repeats):
            status = solver.solve()
            iterations += 1 if self._is_real_time else int(solver.get_stats("sqp_iter"))
            seconds += float(solver.get_stats("time_tot"))
            before, self._u = self._u, solver.get_flat("u").reshape(statement.n, -1)
            if status != _SUCCESS or np.abs(self._u - before).max() < _SETTLED:
                break
        self._x = solver.get_flat("x").reshape(statement.n + 1, -1)
        u = self._u[0].clip(self._lower, self._upper)
        is_solved = status in (_SUCCESS, _ITERATION_LIMIT) and bool(np.isfinite(self._x).all())
        if not is_solved:
            u, self._x = sample.previous_command.copy(), None  # the next one starts afresh
        is_converged = status == _SUCCESS and not self._is_real_time
        of_solved = Status.OK if is_converged else Status.BUDGET
        return Command(
            u,
            of_solved if is_solved else Status.FAILED,
            iterations,
            linearise_time=0.0,
            qp_time=seconds,  # all that acados does in C
            message="" if is_solved else f"acados returned status {status}",
        )

    def _take_reference(self, reference: FloatArray) -> None:
        """Target and references, where they are new: acados is told by a call for each node."""
        if reference.tolist() == self._reference:
            return
        self._reference = reference.tolist()
        self._target = target = self._problem.steady_state.solve(reference, None, self._target)
        statement, solver, n = self._statement, self.solver, self._statement.n
        of_states, of_inputs = statement.references(target)
        solver.set(0, "yref", of_inputs)
        both = np.concatenate([of_states, of_inputs])
        for node in range(1, n):
            solver.set(node, "yref", both)
        solver.set(n, "yref", of_states)
        solver.set(n, "lbx", target.x - BOUND_GAP)
        solver.set(n, "ubx", target.x + BOUND_GAP)

    def _shift(self, state: FloatArray, start: FloatArray) -> None:
        """The last iterate a period later, or the steady-state input rolled out."""
        target, statement = self._target, self._statement
        if self._x is None:
            self._u = np.tile(target.u, (statement.n, 1))
            self._x = np.empty((statement.n + 1, len(start)))
            self._x[0], full = start, np.array(state)
            model = self._problem.model
            for node in range(statement.n):
                after = self._step.evaluate(
                    full, target.u, model.parameters.values, np.zeros(model.n_w)
                )[0]
                self._x[node + 1] = statement.augmented(after, target.u, before=full)
                full = np.array(after)
        else:
            self._x[:-1], self._u[:-1] = self._x[1:].copy(), self._u[1:].copy()
            # The plan ends in the steady state, and goes on there.
            self._u[-1] = target.u
            self._x[0] = start
        self.solver.set_flat("x", self._x.ravel())
        self.solver.set_flat("u", self._u.ravel())


class Statement:
    """The problem of a ``newton_mpc`` in acados' terms: ξ, errors and weights.

    ``n``: nodes but the first, N. Raises ConfigurationError for what is not stated here.
    """

    def __init__(self, problem: NewtonProblem) -> None:
        horizon, model = problem.horizon, problem.model
        self._problem, self.n = problem, horizon.n_periods
        is_plain = (
            horizon.terminal is not None
            and not horizon.has_region
            and not horizon.limited
            and horizon.n_blocks == horizon.n_periods
            and not np.isfinite(problem.largest_moves).any()
            and problem.discrete.n_x == model.n_x
        )
        if not is_plain:
            raise ConfigurationError(
                "this problem is not stated to acados",
                where="benchmarks acados",
                remedy="terminal equality, no blocks, limits on rates, soft limits or delay",
            )
        self._damped = [model.state_index(name) for name in horizon.damped]
        self._goals = list(horizon.weighted)
        inputs, weights = names(model.inputs), horizon.weights
        self._priced = [j for j, name in enumerate(inputs) if weights.inputs.get(name)]
        moved = [j for j, name in enumerate(inputs) if weights.moves.get(name)]
        n_x, n_u, n_d = model.n_x, model.n_u, len(self._damped)
        self.n_augmented = n_x + n_d + n_u

        period, state = problem.discrete.step_length, np.eye(self.n_augmented)
        rows = [state[model.state_index(name)] for name in self._goals]
        rows += [(state[row] - state[n_x + i]) / period for i, row in enumerate(self._damped)]
        self._n_of_states = len(rows)
        of_inputs = [np.zeros(n_u)] * len(rows)
        rows += [np.zeros(self.n_augmented)] * len(self._priced)
        rows += [-state[n_x + n_d + j] for j in moved]
        of_inputs += [np.eye(n_u)[j] for j in (*self._priced, *moved)]
        #: Errors ``v_x ξ + v_u u``, those of the states and rates first.
        self.v_x, self.v_u = np.array(rows), np.array(of_inputs)
        self.weights = np.array(
            [weights.states[name] for name in horizon.weighted]
            + [weights.rates[name] for name in horizon.damped]
            + [weights.inputs[inputs[j]] for j in self._priced]
            + [weights.moves[inputs[j]] for j in moved]
        )

    def augmented(
        self, x: FloatArray, u_before: FloatArray, *, before: FloatArray | None = None
    ) -> FloatArray:
        """ξ, (n_ξ,). ``before``: x a period ago; what it is at node 0 does not matter."""
        return np.concatenate([x, (x if before is None else before)[self._damped], u_before])

    def references(self, target: Any) -> tuple[FloatArray, FloatArray]:
        """References of the errors at rest in a target: of states and rates, and of inputs."""
        model = self._problem.model
        controlled = [model.state_index(name) for name in model.controlled]
        reached = np.array(target.x)
        reached[controlled] = target.reference_reached if target.projected else target.reference
        of_states = np.zeros(self._n_of_states)
        of_states[: len(self._goals)] = reached[[model.state_index(name) for name in self._goals]]
        of_inputs = np.zeros(len(self.weights) - self._n_of_states)
        of_inputs[: len(self._priced)] = target.u[self._priced]
        return of_states, of_inputs

    def ocp(self, acados: Any, qp_solver: str, max_iterations: int) -> Any:
        """The ``AcadosOcp``."""
        # Functions of the model as those of newton_mpc are compiled, unless somebody knows better.
        os.environ.setdefault("ACADOS_EXT_FUN_COMPILE_FLAGS", "-O3")
        ocp = acados.AcadosOcp()
        self._set_model(ocp.model)
        self._set_cost(ocp.cost)
        self._set_constraints(ocp.constraints)
        options = ocp.solver_options
        options.N_horizon = self.n
        options.tf = float(self.n)  # intervals of length one, by which costs are multiplied
        options.integrator_type = "DISCRETE"
        options.hessian_approx = "GAUSS_NEWTON"
        options.qp_solver = qp_solver
        if qp_solver == PARTIAL_CONDENSING:
            options.qp_solver_cond_N = max(1, self.n // CONDENSED_PERIODS)
        options.nlp_solver_type = "SQP_RTI" if max_iterations == 1 else "SQP"
        if max_iterations > 1:
            options.nlp_solver_max_iter = max_iterations
        return ocp

    def _set_model(self, stated: Any) -> None:
        problem, model = self._problem, self._problem.model
        xi, u = ca.SX.sym("xi", self.n_augmented), ca.SX.sym("u", model.n_u)
        after = problem.discrete.step(
            xi[: model.n_x], u, model.parameters.values, np.zeros(model.n_w)
        )
        stated.name = f"trms_{next(_serial_number)}"
        stated.x, stated.u = xi, u
        stated.disc_dyn_expr = ca.cse(ca.vertcat(after, xi[self._damped], u))

    def _set_cost(self, cost: Any) -> None:
        w, n_s = 2.0 * np.diag(self.weights), self._n_of_states
        cost.cost_type_0 = cost.cost_type = cost.cost_type_e = "LINEAR_LS"
        cost.W_0, cost.Vx_0, cost.Vu_0 = w[n_s:, n_s:], self.v_x[n_s:], self.v_u[n_s:]
        cost.W, cost.Vx, cost.Vu = w, self.v_x, self.v_u
        cost.W_e, cost.Vx_e = w[:n_s, :n_s], self.v_x[:n_s]
        cost.yref_0 = np.zeros(len(w) - n_s)
        cost.yref, cost.yref_e = np.zeros(len(w)), np.zeros(n_s)
        # μ |v| + ν v² of v = (x_N − x_s) / scale, with acados' ½ at the square.
        terminal, scale = self._problem.horizon.terminal, self._problem.horizon.scale
        assert terminal is not None
        cost.zl_e = cost.zu_e = terminal.linear / scale
        cost.Zl_e = cost.Zu_e = 2.0 * terminal.quadratic / scale**2

    def _set_constraints(self, constraints: Any) -> None:
        model = self._problem.model
        lower, upper = model.input_bounds()
        constraints.x0 = np.zeros(self.n_augmented)
        constraints.idxbu, constraints.lbu, constraints.ubu = np.arange(model.n_u), lower, upper
        constraints.idxbx_e = constraints.idxsbx_e = np.arange(model.n_x)
        constraints.lbx_e = np.full(model.n_x, -BOUND_GAP)
        constraints.ubx_e = np.full(model.n_x, BOUND_GAP)
