"""The quadratic program of the exported Newton MPC against DAQP's solution of the same, condensed.

Plans, states and references are drawn: near the solution, off it, and at random between the
limits, where most inputs end at a bound.
"""

import ctypes
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from trms_cli.controllers.newton.source import newton_source
from trms_cli.controllers.newton_mpc import NewtonMpc
from trms_cli.core.arrays import FloatArray
from trms_cli.core.compilation import compiler
from trms_cli.core.qp import Daqp, Qp
from trms_cli.effects.extended_model import extend_model
from trms_cli.effects.input_delay import InputDelay
from trms_cli.models.model import Model, names
from trms_cli.models.newtonian import Newtonian

from .closed_loop_case import setup_of

pytestmark = pytest.mark.skipif(compiler() is None, reason="needs a C compiler")

_SHIM = """
#include "rig.c"
size_t shim_size(void) { return sizeof(rig_ctx); }
double *shim_array(rig_ctx *c, int which) {
    switch (which) {
    case 0: return c->plan;
    case 1: return c->qp.F[0][0];
    case 2: return c->qp.dz;
    case 3: return c->trajectory;
    case 4: return c->rates;
    case 5: return c->reference;
    case 6: return c->target.x;
    case 7: return c->target.u;
    case 8: return c->full;
    case 9: return c->last_u;
    default: return c->qp.miss;
    }
}
void shim_begin(rig_ctx *c, const double *x, const double *reference) {
    rig_begin(c, x, reference);
}
int shim_solve(rig_ctx *c, double *out) {
    rig_cost cost;
    int solved;
    c->qp_iterations = 0;
    rig_linearise(c, c->plan, &cost);
    solved = rig_qp_solve(c);
    out[0] = rig_qp_curvature(c, out + 1);
    out[2] = c->qp_iterations;
    return solved;
}
"""
_PLAN, _SLOPES, _STEP, _TRAJECTORY, _RATES, _REFERENCE, _X, _U, _FULL, _LAST, _MISS = range(11)
_POINTER = ctypes.POINTER(ctypes.c_double)


def _pointer(array: FloatArray) -> Any:
    return array.ctypes.data_as(_POINTER)


class Program:
    """Programs of one controller, as they come and condensed."""

    def __init__(
        self, folder: Path, controller: NewtonMpc, model: Model, optimise: str = "-O1"
    ) -> None:
        self.model, setup = model, setup_of(model)
        problem = controller.problem(setup)
        source = newton_source(problem, controller.preview(setup), "rig", "under test")
        self.sizes, self.period = source.sizes, source.period
        for name, text in (("rig.c", source.source), ("rig.h", source.header), ("s.c", _SHIM)):
            (folder / name).write_text(text)
        command = [str(compiler()), "-std=c99", optimise, "-fPIC", "-shared", "-o", "s.so", "s.c"]
        subprocess.run([*command, "-lm"], cwd=folder, check=True)
        self.library = ctypes.CDLL(str(folder / "s.so"))
        self.library.shim_size.restype = ctypes.c_size_t
        self.library.shim_array.restype = _POINTER
        self.context = ctypes.create_string_buffer(self.library.shim_size())
        self.problem = problem
        self.lower, self.upper = model.input_bounds()

    def array(self, which: int, *shape: int) -> FloatArray:
        return np.ctypeslib.as_array(self.library.shim_array(self.context, which), shape)

    def draw(self, draw: np.random.Generator) -> None:
        """Another state, reference, last command and plan, these within their limits."""
        model, n_z, n_u = self.model, self.sizes["N_Z"], self.model.n_u
        self.library.rig_init(self.context)
        sizes = np.where([name.startswith("omega") for name in model.state_names], 50.0, 0.3)
        x = model.rest() + sizes * draw.standard_normal(model.n_x)
        last = draw.uniform(self.lower, self.upper)
        reference = draw.uniform(-0.5, 0.5, (self.sizes["PREVIEW"] + 1, len(model.controlled)))
        self.library.shim_begin(self.context, _pointer(x), _pointer(reference))
        self.array(_LAST, n_u)[:] = last
        plan = self.array(_PLAN, n_z)
        plan += draw.choice([0.1, 1.0, 3.0]) * draw.standard_normal(n_z)
        most = self.problem.largest_moves
        for k in range(0, n_z, n_u):
            before = last if k == 0 else plan[k - n_u : k]
            allowed = np.clip(plan[k : k + n_u], before - most, before + most)
            plan[k : k + n_u] = np.clip(allowed, self.lower, self.upper)

    def solve(self) -> tuple[FloatArray, float, float]:
        """The step, its curvature and the gradient's largest component."""
        out = np.zeros(3)
        assert self.library.shim_solve(self.context, _pointer(out))
        self.recursions = int(out[2])
        assert self.recursions <= self.sizes["RECURSIONS"]
        return self.array(_STEP, self.sizes["N_Z"]).copy(), out[0], out[1]

    def condensed(self) -> Qp:
        """The same program in the inputs alone, from the same slopes."""
        horizon, model, s = self.problem.horizon, self.model, self.sizes
        n, n_full, n_u, n_z = s["N"], s["N_FULL"], model.n_u, s["N_Z"]
        slopes = self.array(_SLOPES, n, n_full, s["N_F"])
        trajectory, plan = self.array(_TRAJECTORY, n, n_full), self.array(_PLAN, n_z)
        rates = self.array(_RATES, n, len(model.controlled))
        reference = self.array(_REFERENCE, n, len(model.controlled))
        x_s, u_s, last = self.array(_X, model.n_x), self.array(_U, n_u), self.array(_LAST, n_u)
        hessian, gradient = 1e-6 * np.eye(n_z), np.zeros(n_z)

        def add(weight: float, slope: FloatArray, error: float) -> None:
            nonlocal hessian, gradient
            hessian = hessian + 2 * weight * np.outer(slope, slope)
            gradient = gradient + 2 * weight * error * slope

        state, before, limited, values = np.zeros((n_full, n_z)), self.array(_FULL, n_full), [], []
        for k in range(n):
            at = int(horizon.blocks[k]) * n_u
            following = slopes[k, :, :n_full] @ state
            following[:, at : at + n_u] += slopes[k, :, n_full : n_full + n_u]
            now = trajectory[k]
            for name in horizon.weighted:
                row = model.state_index(name)
                tracked = name in model.controlled
                goal = reference[k, model.controlled.index(name)] if tracked else x_s[row]
                add(horizon.weights.states[name], following[row], now[row] - goal)
            for name in horizon.damped:
                row, wanted = model.state_index(name), rates[k, model.controlled.index(name)]
                slope = (following[row] - state[row]) / self.period
                add(
                    horizon.weights.rates[name],
                    slope,
                    (now[row] - before[row]) / self.period - wanted,
                )
            for name in horizon.limited:
                limited.append(following[model.state_index(name)])
                values.append((now[model.state_index(name)], *horizon.soft_limits.states[name]))
            state, before = following, now
        difference = np.eye(n_z) - np.eye(n_z, k=-n_u)
        moves = difference @ plan
        moves[:n_u] -= last
        for at in range(n_z):
            name = names(model.inputs)[at % n_u]
            add(horizon.weights.moves.get(name, 0.0), difference[at], moves[at])
        periods = np.bincount(horizon.blocks)
        for at in range(n_z):
            weight = horizon.weights.inputs.get(names(model.inputs)[at % n_u], 0.0)
            unit, deviation = np.eye(n_z)[at], plan[at] - u_s[at % n_u]
            add(weight * periods[at // n_u], unit, deviation)
        most = np.tile(self.problem.largest_moves, n_z // n_u)
        hard, n_t, n_l = np.isfinite(most), s["N_TERMINAL"], len(limited)
        miss = self.array(_MISS, max(n_t, 1))[:n_t]
        held = np.array(values).reshape(-1, 3)
        bounds = [np.tile(bound, n_z // n_u) - plan for bound in (self.lower, self.upper)]
        soft = horizon.soft_limits
        terminal = horizon.terminal
        return Qp(
            hessian,
            gradient,
            np.vstack(
                [
                    state[:n_t] / horizon.scale[:n_t, None],
                    difference[hard],
                    np.array(limited).reshape(-1, n_z),
                ]
            ),
            np.concatenate([bounds[0], -miss, (-most - moves)[hard], held[:, 1] - held[:, 0]]),
            np.concatenate([bounds[1], -miss, (most - moves)[hard], held[:, 2] - held[:, 0]]),
            np.repeat(
                [terminal.linear if terminal else 0.0, np.inf, soft.linear],
                [n_t, int(hard.sum()), n_l],
            ),
            np.repeat(
                [terminal.quadratic if terminal else 1.0, 1.0, soft.quadratic],
                [n_t, int(hard.sum()), n_l],
            ),
        )


def merit(qp: Qp, z: FloatArray) -> float:
    """The program's value, and infinity beyond its hard limits."""
    n, soft = len(z), np.isfinite(qp.linear)
    beyond = np.maximum(qp.lower[n:] - qp.rows @ z, qp.rows @ z - qp.upper[n:])
    if max((qp.lower[:n] - z).max(), (z - qp.upper[:n]).max(), *beyond[~soft], 0.0) > 1e-8:
        return np.inf
    v = np.maximum(beyond, 0.0)[soft]
    prices = qp.linear[soft] @ v + qp.quadratic[soft] @ v**2
    return float(0.5 * z @ qp.hessian @ z + qp.gradient @ z + prices)


SHORT: dict[str, Any] = {"prediction_horizon": 20, "move_blocks": (1,) * 20}
RATES: dict[str, Any] = {"input_rate_limits": {"u_v": 4.0, "u_h": 6.0}}
LIMITS: dict[str, Any] = {"soft_limits": {"alpha_v": (-0.2, 0.25), "alpha_h": (-0.4, 0.4)}}
#: By name: options of the controller, and the model.
CASES: dict[str, tuple[dict[str, Any], Any]] = {
    "bounds": (SHORT, Newtonian),
    "blocks": ({}, Newtonian),
    "no_terminal": ({**SHORT, "terminal": "none"}, Newtonian),
    "rates": ({**SHORT, **RATES}, Newtonian),
    "limits": ({**SHORT, **LIMITS, "input_weights": {"u_v": 0.05}}, Newtonian),
    "all": ({**RATES, **LIMITS, "preview_horizon": 5}, Newtonian),
    "vertical": (SHORT, lambda: Newtonian(freedom="vertical")),
    "delay": (
        {**SHORT, "soft_limits": {"alpha_v": (-np.inf, 0.2)}},
        lambda: extend_model(Newtonian(), {"d": InputDelay(rotor="main", delay=0.13)}),
    ),
}


@pytest.fixture(scope="module", params=CASES)
def programs(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Program:
    options, model = CASES[request.param]
    return Program(tmp_path_factory.mktemp(request.param), NewtonMpc(**options), model())


def compare(programs: Program, count: int, seed: int) -> None:
    """Each solution is as good as DAQP's, to rounding, and within the hard limits."""
    draw, solver = np.random.default_rng(seed), Daqp()
    for _ in range(count):
        programs.draw(draw)
        z, curvature, gradient = programs.solve()
        qp = programs.condensed()
        assert curvature == pytest.approx(z @ qp.hessian @ z, rel=1e-7, abs=1e-9)
        assert gradient == pytest.approx(np.abs(qp.hessian @ z).max(), rel=1e-7, abs=1e-9)
        expected = solver.solve(solver.start(), qp)
        assert expected.solved
        mine, others = (
            merit(qp, z),
            merit(qp, np.clip(expected.z, qp.lower[: len(z)], qp.upper[: len(z)])),
        )
        assert mine <= others + 1e-8 * (1 + abs(others))


def test_it_is_solved_as_well_as_by_daqp(programs: Program) -> None:
    compare(programs, 40, 1)


@pytest.mark.slow
def test_many_are_solved_as_well_as_by_daqp(programs: Program) -> None:
    compare(programs, 1500, 2)
