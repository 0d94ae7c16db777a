"""do-mpc (Fiedler et al. 2023, Control Eng. Practice 140) as a controller of the same loop.

Its own way of stating a discrete-time problem: stage cost, terminal cost, weighted moves and bounds
on the inputs, over the same discretised step, solved by IPOPT. Its soft constraints lend the slacks
of the terminal equality's exact penalty, whose row and price are added to its NLP, as it allows.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from trms_cli.controllers.controller import Command, ControlSample, ControlSetup, Status
from trms_cli.controllers.newton.problem import typical_sizes
from trms_cli.controllers.newton_mpc import NewtonMpc
from trms_cli.models.discretisation import discretise
from trms_cli.models.model import names
from trms_cli.models.steady_state import SteadyState


@dataclass(frozen=True, kw_only=True)
class DoMpc:
    """do-mpc on the problem of a ``newton_mpc``."""

    #: Without input blocks, soft limits and preview, which do-mpc states otherwise or not
    problem: NewtonMpc

    @property
    def sample_time(self) -> float:
        """Control period, s."""
        return self.problem.sample_time

    def preview(self, setup: ControlSetup) -> int:
        """The reference is taken as constant."""
        return 0

    def init(self, setup: ControlSetup) -> DoMpcState:
        """The problem stated to do-mpc."""
        return DoMpcState(self.problem, setup)

    def step(self, state: DoMpcState, sample: ControlSample, *, want_prediction: bool) -> Command:
        """Solve to convergence."""
        return state.solve(sample)


class DoMpcState:
    """do-mpc's own object, with its warm start inside."""

    def __init__(self, problem: NewtonMpc, setup: ControlSetup) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # it tells of extras that are not installed
            import do_mpc
        self.model = setup.model
        self.inputs = names(setup.model.inputs)
        weights = {name: q for name, q in problem.state_weights.items() if q > 0}
        self.steady_state = SteadyState(setup.model, weights)
        self.target: Any = None
        self.mpc = self._stated(do_mpc, problem, setup)

    def _stated(self, do_mpc: Any, problem: NewtonMpc, setup: ControlSetup) -> Any:
        model, n = self.model, problem.prediction_horizon
        discrete = discretise(model, setup.sample_time, problem.integration_steps)
        stated = do_mpc.model.Model("discrete", "SX")
        x = stated.set_variable("_x", "x", shape=(discrete.n_x, 1))
        u = stated.set_variable("_u", "u", shape=(model.n_u, 1))
        x_s = stated.set_variable("_tvp", "x_s", shape=(model.n_x, 1))
        u_s = stated.set_variable("_tvp", "u_s", shape=(model.n_u, 1))

        def after(x: ca.SX, u: ca.SX) -> ca.SX:
            return discrete.step(x, u, model.parameters.values, np.zeros(model.n_w))

        stated.set_rhs("x", after(x, u))
        stated.setup()
        # From here on do-mpc's own symbols count.
        x, u = stated.x["x"], stated.u["u"]
        x_s, u_s = stated.tvp["x_s"], stated.tvp["u_s"]

        mpc = do_mpc.controller.MPC(stated)
        mpc.settings.n_horizon = n
        mpc.settings.t_step = setup.sample_time
        mpc.settings.store_full_solution = False
        mpc.settings.nlpsol_opts = {
            "ipopt.print_level": 0,
            "ipopt.sb": "yes",
            "print_time": 0,
            "ipopt.tol": 1e-8,
            "ipopt.warm_start_init_point": "yes",
            "ipopt.mu_init": 1e-6,
        }
        q = ca.DM([problem.state_weights.get(name, 0.0) for name in model.state_names])
        rho = ca.DM([problem.input_weights.get(name, 0.0) for name in self.inputs])
        deviation = ca.dot(q, (x[: model.n_x] - x_s) ** 2)
        damping = ca.DM([problem.rate_weights.get(name, 0.0) for name in model.state_names])
        rate = (after(x, u) - x)[: model.n_x] / setup.sample_time
        stage = deviation + ca.dot(damping, rate**2) + ca.dot(rho, (u - u_s) ** 2)
        mpc.set_objective(lterm=stage, mterm=deviation)
        mpc.set_rterm(u=np.array([problem.move_weights.get(name, 0.0) for name in self.inputs]))
        if problem.terminal == "equality":
            # Constraints that always hold (0 ≤ 1 + slack): they only bring the slacks in.
            mpc.settings.nl_cons_single_slack = True
            for side in ("above", "below"):
                nothing = ca.SX.zeros(model.n_x)
                mpc.set_nl_cons(side, nothing, ub=1.0, soft_constraint=True, penalty_term_cons=0.0)
        lower, upper = model.input_bounds()
        mpc.bounds["lower", "_u", "u"] = lower
        mpc.bounds["upper", "_u", "u"] = upper
        self._horizon = mpc.get_tvp_template()
        self._n = n
        mpc.set_tvp_fun(lambda _: self._horizon)
        mpc.prepare_nlp()
        if problem.terminal == "equality":
            end = mpc.opt_x["_x", n, 0, -1][: model.n_x]
            above, below = (mpc.opt_x["_eps", 0, 0, side] for side in ("above", "below"))
            residual = (end - mpc.opt_p["_tvp", n, "x_s"]) / ca.DM(typical_sizes(discrete))
            mpc.nlp_cons.append(residual - above + below)
            mpc.nlp_cons_lb.append(np.zeros((model.n_x, 1)))
            mpc.nlp_cons_ub.append(np.zeros((model.n_x, 1)))
            mpc.nlp_obj += problem.terminal_linear * (ca.sum1(above) + ca.sum1(below))
            mpc.nlp_obj += problem.terminal_quadratic * ca.sumsqr(above - below)
        mpc.create_nlp()
        self._full = discrete.initial(model.rest(), setup.first_command)
        self._first = True
        return mpc

    def solve(self, sample: ControlSample) -> Command:
        """One sample; do-mpc shifts nothing, it starts from its last solution."""
        model, mpc = self.model, self.mpc
        self.target = self.steady_state.solve(sample.reference[-1], None, self.target)
        self._horizon["_tvp", :, "x_s"] = self.target.x
        self._horizon["_tvp", :, "u_s"] = self.target.u
        self._full[: model.n_x] = sample.estimate.x
        if self._first:
            mpc.x0, mpc.u0 = self._full, self.target.u
            mpc.set_initial_guess()
            mpc.u0 = sample.previous_command
            self._first = False
        u = np.asarray(mpc.make_step(self._full.reshape(-1, 1))).ravel()
        solved = bool(mpc.solver_stats["success"])
        return Command(
            u if solved else sample.previous_command.copy(),
            Status.OK if solved else Status.FAILED,
            int(mpc.solver_stats["iter_count"]),
            float(mpc.opt_f_num if hasattr(mpc, "opt_f_num") else np.nan),
            message="" if solved else str(mpc.solver_stats["return_status"]),
        )
