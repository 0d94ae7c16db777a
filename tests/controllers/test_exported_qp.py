"""The quadratic programs of exported controllers: C against DAQP itself, cold and warm."""

from __future__ import annotations

import ctypes
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import trms_cli.code_generation as code
from trms_cli.core.compilation import compiler
from trms_cli.core.qp import Daqp, Qp

from .exported_controller import STRICT, contiguous, pointer

pytestmark = pytest.mark.skipif(compiler() is None, reason="needs a C compiler")

_DRIVER = """
enum { N = 40, M = 240, K = 320 };
static double rows[M * N], du[K], dl[K], rinv[N * (N + 1) / 2], v[N], scaling[K], u[N];
static double lam[K], lam_star[K], l[K * (K + 1) / 2], d[K], xldl[K], zldl[K], waiting_lam[K];
static int ws[K], waiting[K];
int solve(int n, int m, const double *H, const double *f, const double *A, const double *upper,
          const double *lower, const double *rho, const double *w, int *sense, double *x,
          int *iterations) {
    qp_work q = {0};
    int flag;
    q.n = q.ms = n; q.m = n + m; q.iteration_limit = 1000;
    q.H = H; q.f = f; q.A = A; q.upper = upper; q.lower = lower; q.rho = rho; q.w = w;
    q.sense = sense; q.M = rows; q.dupper = du; q.dlower = dl; q.Rinv = rinv; q.v = v;
    q.scaling = scaling; q.x = x; q.lam = lam; q.lam_star = lam_star; q.u = u; q.L = l; q.D = d;
    q.xldl = xldl; q.zldl = zldl; q.WS = ws; q.waiting = waiting; q.waiting_lam = waiting_lam;
    flag = qp_solve(&q);
    *iterations = q.iterations;
    return flag;
}
"""


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    folder = tmp_path_factory.mktemp("qp")
    source = (Path(code.__file__).parent / "daqp.c").read_text()
    includes = "#include <float.h>\n#include <math.h>\n#include <string.h>\n"
    prototype = _DRIVER[_DRIVER.index("int solve") : _DRIVER.index(" {\n    qp_work")] + ";\n"
    (folder / "qp.c").write_text(includes + source + prototype + _DRIVER)
    command = [str(compiler()), *STRICT, "-O1", "-fPIC", "-shared", "-o", "qp.so", "qp.c", "-lm"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return ctypes.CDLL(str(folder / "qp.so"))


class Solver:
    """Keeps the active set from solve to solve, as an exported controller does."""

    def __init__(self, library: ctypes.CDLL) -> None:
        self._solve, self._sense = library.solve, np.zeros(0, dtype=np.intc)

    def __call__(self, qp: Qp) -> tuple[int, np.ndarray]:
        n, m = len(qp.gradient), len(qp.linear)
        soft = np.isfinite(qp.linear)
        if len(self._sense) != n + m:
            self._sense = np.zeros(n + m, dtype=np.intc)
            self._sense[n:][soft] = 8
        rho = np.concatenate([np.ones(n), np.where(soft, 0.5 / qp.quadratic, 1.0)])
        w = np.concatenate([np.zeros(n), np.where(soft, qp.linear, 0.0)])
        given = [
            contiguous(value)
            for value in (qp.hessian, qp.gradient, qp.rows, qp.upper, qp.lower, rho, w)
        ]
        x, iterations = np.zeros(n), ctypes.c_int()
        flag = self._solve(
            n, m, *map(pointer, given), self._sense.ctypes.data_as(ctypes.c_void_p), pointer(x),
            ctypes.byref(iterations),
        )  # fmt: skip
        if flag not in (1, 2):
            self._sense = np.zeros(0, dtype=np.intc)
        return flag, x


def program(draw: np.random.Generator, n: int, terminal: int, limits: int, hard: int) -> Qp:
    """As a Newton step makes them: soft equalities, soft ranges, hard moves."""
    m = terminal + hard + limits
    root = draw.standard_normal((2 * n, n)) * np.exp(draw.uniform(-2, 1, n))
    rows = draw.standard_normal((m, n))
    rows[terminal : terminal + hard] = 0.0
    for i in range(hard):
        rows[terminal + i, i % n] = 1.0
        if i % n:
            rows[terminal + i, i % n - 1] = -1.0
    # Rows of neighbouring periods are nearly equal.
    for i in range(terminal + hard + 1, m):
        rows[i] = 0.9 * rows[i - 1] + 0.1 * rows[i]
    width = draw.uniform(0.1, 1.0, n + m)
    centre = 0.3 * draw.standard_normal(n + m)
    centre[n + terminal : n + terminal + hard] = 0.0
    lower, upper = centre - width, centre + width
    lower[:n], upper[:n] = -np.abs(width[:n]), np.abs(width[:n])
    target = 0.5 * draw.standard_normal(terminal)
    lower[n : n + terminal] = upper[n : n + terminal] = target
    linear = np.concatenate([np.full(terminal, 100.0), np.full(hard, np.inf), np.full(limits, 50)])
    return Qp(
        root.T @ root + 1e-6 * np.eye(n),
        3.0 * draw.standard_normal(n),
        rows,
        lower,
        upper,
        linear,
        np.concatenate([np.full(terminal, 1000.0), np.ones(hard), np.full(limits, 500.0)]),
    )


def merit(qp: Qp, z: np.ndarray) -> float:
    n, soft = len(z), np.isfinite(qp.linear)
    beyond = np.maximum(qp.lower[n:] - qp.rows @ z, qp.rows @ z - qp.upper[n:])
    v = np.maximum(beyond, 0.0)[soft]
    prices = qp.linear[soft] @ v + qp.quadratic[soft] @ v**2
    return float(0.5 * z @ qp.hessian @ z + qp.gradient @ z + prices)


@pytest.mark.parametrize(
    ("n", "terminal", "limits", "hard"),
    [(8, 0, 0, 0), (40, 6, 0, 0), (20, 6, 40, 0), (20, 6, 0, 20), (40, 6, 80, 40), (1, 1, 3, 1)],
)
def test_it_finds_what_daqp_finds(library, n, terminal, limits, hard):
    draw, worst = np.random.default_rng(n + limits), 0.0
    for _ in range(40):
        qp = program(draw, n, terminal, limits, hard)
        cold, reference = Solver(library), Daqp()
        workspace = reference.start()
        for _ in range(4):
            flag, x = cold(qp)
            expected = reference.solve(workspace, replace(qp))
            assert (flag in (1, 2)) == expected.solved
            if expected.solved:
                worst = max(worst, float(np.abs(x - expected.z).max()))
                assert merit(qp, x) <= merit(qp, expected.z) + 1e-7 * (1 + abs(merit(qp, x)))
            # The next one is near: warm starts.
            qp = replace(qp, gradient=qp.gradient + 0.1 * draw.standard_normal(n))
    assert worst <= 1e-8


def test_bounds_that_cross_and_a_hessian_without_a_root_fail(library):
    qp = program(np.random.default_rng(0), 8, 2, 0, 4)
    crossed = replace(qp, lower=qp.upper + 1.0)
    flag, _ = Solver(library)(crossed)
    assert flag == -1
    flat: Any = replace(qp, hessian=np.diag([1.0] * 7 + [0.0]))
    flag, _ = Solver(library)(flat)
    assert flag == -5
