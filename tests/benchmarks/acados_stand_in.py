"""In the place of ``acados_template``: what the benchmark uses of it, checked name by name.

The names, types and shapes are those that acados checks itself, read in its repository
(interfaces/acados_template/acados_template) at these commits:

- acados_ocp.py (names of ``AcadosOcp``, dimensions in ``make_consistent``, scaling of costs by the
  time steps): 00177a6a324cf56dd9910f0606fab9e0f8076630
- acados_ocp_options.py: 005826d4cd3036b141de9a729a4dc5d1f1ba006c
- acados_ocp_cost.py: 066c2f08d2271f54e57f07857bde8729291485a1
- acados_ocp_constraints.py: 0d9234ebe1d07eca240b7b3a2915a78674b1e4d4
- acados_model.py: 07841a70a63e1ecef9757688c52544e1c850778c
- acados_ocp_solver.py (fields of ``set``, ``get_stats``): 000bdc8fd42c229479b528196cc42967f135965f,
  ``set_flat`` and ``get_flat`` in a later one

What it solves is what acados says that such a description means: ½‖V_x x + V_u u − y_ref‖²_W at
each node, times the length of its interval, 1 at the last node; bounds; soft bounds at the last
node with slacks of a linear and a quadratic price. By full Gauss–Newton steps in multiple shooting,
as ``SQP_RTI`` and ``SQP`` with ``FIXED_STEP`` do. No line of acados is in here.
"""

from __future__ import annotations

from typing import Any, ClassVar

import casadi as ca
import numpy as np

from trms_cli.core.qp import Daqp, Qp


class _Checked:
    """Attributes of the names given, each of its kind; any other name is an error."""

    allowed: ClassVar[dict[str, Any]] = {}

    def __setattr__(self, name: str, value: Any) -> None:
        if name not in self.allowed:
            raise AttributeError(f"{type(self).__name__} has no {name!r} in acados")
        kind = self.allowed[name]
        if isinstance(kind, tuple):
            assert value in kind, (name, value)
        else:
            assert isinstance(value, kind), (name, type(value))
        object.__setattr__(self, name, value)


class AcadosModel(_Checked):
    allowed: ClassVar[dict[str, Any]] = {
        "name": str,
        "x": ca.SX,
        "u": ca.SX,
        "disc_dyn_expr": ca.SX,
    }


_COST_TYPES = ("EXTERNAL", "LINEAR_LS", "NONLINEAR_LS", "CONVEX_OVER_NONLINEAR", "AUTO")


class AcadosOcpCost(_Checked):
    allowed: ClassVar[dict[str, Any]] = {
        **dict.fromkeys(("cost_type_0", "cost_type", "cost_type_e"), _COST_TYPES),
        **dict.fromkeys(("W_0", "Vx_0", "Vu_0", "yref_0", "W", "Vx", "Vu", "yref"), np.ndarray),
        **dict.fromkeys(("W_e", "Vx_e", "yref_e", "zl_e", "zu_e", "Zl_e", "Zu_e"), np.ndarray),
    }


class AcadosOcpConstraints(_Checked):
    allowed: ClassVar[dict[str, Any]] = dict.fromkeys(
        ("x0", "idxbu", "lbu", "ubu", "idxbx_e", "lbx_e", "ubx_e", "idxsbx_e"), np.ndarray
    )


class AcadosOcpOptions(_Checked):
    allowed: ClassVar[dict[str, Any]] = {
        "N_horizon": int,
        "tf": float,
        "integrator_type": ("ERK", "IRK", "GNSF", "DISCRETE", "LIFTED_IRK"),
        "hessian_approx": ("GAUSS_NEWTON", "EXACT"),
        "qp_solver": (
            *("PARTIAL_CONDENSING_HPIPM", "FULL_CONDENSING_QPOASES", "FULL_CONDENSING_HPIPM"),
            *("PARTIAL_CONDENSING_QPDUNES", "PARTIAL_CONDENSING_OSQP", "FULL_CONDENSING_DAQP"),
        ),
        "qp_solver_cond_N": int,
        "nlp_solver_type": ("SQP", "SQP_RTI", "DDP", "SQP_WITH_FEASIBLE_QP"),
        "nlp_solver_max_iter": int,
    }
    qp_solver_cond_N = None
    nlp_solver_max_iter = 100


class AcadosOcp(_Checked):
    allowed: ClassVar[dict[str, Any]] = {
        "model": AcadosModel,
        "cost": AcadosOcpCost,
        "constraints": AcadosOcpConstraints,
        "solver_options": AcadosOcpOptions,
        "code_export_directory": str,
    }

    def __init__(self) -> None:
        self.model, self.cost = AcadosModel(), AcadosOcpCost()
        self.constraints, self.solver_options = AcadosOcpConstraints(), AcadosOcpOptions()

    def check_dimensions(self) -> None:
        """As ``make_consistent`` does."""
        cost, constraints, options = self.cost, self.constraints, self.solver_options
        n_x, n_u = self.model.x.numel(), self.model.u.numel()
        assert self.model.x.is_column() and self.model.u.is_column()
        assert self.model.disc_dyn_expr.shape == (n_x, 1)
        assert self.model.name.isidentifier()
        for suffix in ("_0", ""):
            w = getattr(cost, f"W{suffix}")
            n_y = len(w)
            assert w.shape == (n_y, n_y)
            assert getattr(cost, f"Vx{suffix}").shape == (n_y, n_x)
            assert getattr(cost, f"Vu{suffix}").shape == (n_y, n_u)
            assert getattr(cost, f"yref{suffix}").shape == (n_y,)
        n_e = len(cost.W_e)
        assert cost.W_e.shape == (n_e, n_e) and cost.Vx_e.shape == (n_e, n_x)
        assert cost.yref_e.shape == (n_e,)
        assert constraints.x0.shape == (n_x,)
        assert np.array_equal(constraints.idxbu, np.arange(n_u))  # all that is solved here
        assert len(constraints.idxbu) == len(constraints.lbu) == len(constraints.ubu)
        assert (constraints.idxbx_e < n_x).all()
        n_b = len(constraints.idxbx_e)
        assert len(constraints.lbx_e) == len(constraints.ubx_e) == n_b
        n_s = len(constraints.idxsbx_e)
        assert n_s <= n_b and (constraints.idxsbx_e < n_b).all()
        assert {getattr(cost, name).shape for name in ("zl_e", "zu_e", "Zl_e", "Zu_e")} == {(n_s,)}
        assert options.qp_solver_cond_N is None or options.qp_solver_cond_N <= options.N_horizon


class AcadosOcpSolver:
    """Full Gauss–Newton steps; the QP in the inputs alone."""

    def __init__(self, acados_ocp: AcadosOcp, json_file: str, verbose: bool = True) -> None:
        acados_ocp.check_dimensions()
        self.ocp, self.N = acados_ocp, acados_ocp.solver_options.N_horizon
        model, cost, constraints = acados_ocp.model, acados_ocp.cost, acados_ocp.constraints
        x, u, after = model.x, model.u, model.disc_dyn_expr
        self._slopes = ca.Function(
            "slopes", [x, u], [after, ca.jacobian(after, x), ca.jacobian(after, u)]
        )
        self._x = np.zeros((self.N + 1, x.numel()))
        self._u = np.zeros((self.N, u.numel()))
        self._references = [cost.yref_0, *([cost.yref] * (self.N - 1)), cost.yref_e]
        self._x0 = {"lbx": constraints.x0, "ubx": constraints.x0}
        self._end = {"lbx": constraints.lbx_e, "ubx": constraints.ubx_e}
        self._iterations, self._qp = 0, Daqp()

    def set(self, stage_: int, field_: str, value_: np.ndarray) -> None:
        assert isinstance(stage_, int) and 0 <= stage_ <= self.N
        assert isinstance(value_, np.ndarray)
        if field_ == "yref":
            assert value_.shape == self._references[stage_].shape
            self._references[stage_] = value_.copy()
            return
        assert field_ in ("lbx", "ubx") and stage_ in (0, self.N)
        bounds = self._end if stage_ else self._x0
        assert value_.shape == bounds[field_].shape
        bounds[field_] = value_.copy()

    def set_flat(self, field_: str, value_: np.ndarray) -> None:
        array = {"x": self._x, "u": self._u}[field_]
        assert len(value_) == array.size
        array[...] = value_.reshape(array.shape)

    def get_flat(self, field_: str) -> np.ndarray:
        return {"x": self._x, "u": self._u}[field_].ravel().copy()

    def get_stats(self, field_: str) -> float | int:
        return {"sqp_iter": self._iterations, "time_tot": 1e-4}[field_]

    def solve(self) -> int:
        options = self.ocp.solver_options
        if options.nlp_solver_type == "SQP_RTI":
            self._full_step()
            return 0
        for self._iterations in range(1, options.nlp_solver_max_iter + 1):
            if self._full_step() < 1e-7:
                return 0
        return 2

    def _full_step(self) -> float:
        ocp, n, n_u = self.ocp, self.N, self._u.shape[1]
        cost, constraints = ocp.cost, ocp.constraints
        assert np.array_equal(self._x0["lbx"], self._x0["ubx"])
        interval = ocp.solver_options.tf / n
        # x_k = offset + slope z, z all inputs.
        offset, slope = self._x0["lbx"].copy(), np.zeros((self._x.shape[1], n * n_u))
        hessian, gradient = np.zeros((n * n_u, n * n_u)), np.zeros(n * n_u)
        states = [(offset, slope)]
        for k in range(n):
            columns = slice(k * n_u, (k + 1) * n_u)
            first = "_0" if k == 0 else ""
            w = interval * getattr(cost, f"W{first}")
            error = getattr(cost, f"Vx{first}") @ slope
            error[:, columns] += getattr(cost, f"Vu{first}")
            rest = getattr(cost, f"Vx{first}") @ offset - self._references[k]
            hessian += error.T @ w @ error
            gradient += error.T @ w @ rest
            after, a, b = (np.array(value) for value in self._slopes(self._x[k], self._u[k]))
            offset = after.ravel() + a @ (offset - self._x[k]) - b @ self._u[k]
            slope = a @ slope
            slope[:, columns] += b
            states.append((offset, slope))
        error, rest = cost.Vx_e @ slope, cost.Vx_e @ offset - self._references[n]
        hessian += error.T @ cost.W_e @ error
        gradient += error.T @ cost.W_e @ rest
        soft = constraints.idxbx_e
        assert np.array_equal(constraints.idxsbx_e, np.arange(len(soft)))
        assert np.array_equal(cost.zl_e, cost.zu_e) and np.array_equal(cost.Zl_e, cost.Zu_e)
        result = self._qp.solve(
            self._qp.start(),
            Qp(
                hessian,
                gradient,
                slope[soft],
                np.concatenate([np.tile(constraints.lbu, n), self._end["lbx"] - offset[soft]]),
                np.concatenate([np.tile(constraints.ubu, n), self._end["ubx"] - offset[soft]]),
                cost.zl_e,
                cost.Zl_e / 2,
            ),
        )
        assert result.solved, result.message
        before = self._u.copy()
        self._u[...] = result.z.reshape(n, n_u)
        for k, (offset, slope) in enumerate(states):
            self._x[k] = offset + slope @ result.z
        return float(np.abs(self._u - before).max())
