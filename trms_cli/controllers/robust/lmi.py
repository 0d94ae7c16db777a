"""The linear matrix inequalities of robust MPC, parametrised once.

After Kothare, Balakrishnan & Morari 1996 (Automatica 32): of all linear laws v = K z, K = Y G⁻¹,
the one with the least bound γ on the worst cost  Σ z'C'C z + v'R v  that any sequence of models
from the polytope can run up from the present z,

    minimise γ + ρ Σ s   subject to, at every vertex j (and l),

    [1  z'; z  Q_j] ⪰ 0                                   z is in the ellipsoid z'Q⁻¹z ≤ 1
    [G + G' − Q_j − T  (A_j G + B_j Y)'; ·  Q_l] ⪰ 0      the cost to go falls by the stage's cost
    [T  S'; S  γ I] ⪰ 0,  S = [C G; R^½ Y]
    [ū_i² + s_i  Y_i; ·  G + G' − Q_j] ⪰ 0                |v_i| ≤ ū_i in the whole ellipsoid
    (Q_j)_ii ≤ z̄_i² + s_i                                 |z_i| ≤ z̄_i in the whole ellipsoid

With ``common`` there is one Q = G for all vertices: Kothare's LMIs. T is the stage's cost brought
out of them: the same set of Q, Y, γ, and the blocks shrink from 3n + m to 2n rows, which a solver's
time goes with the sixth power of. With ``parameter_dependent`` each vertex has its own Q_j and G is
free (Cuzzola, Geromel & Morari 2002, Automatica 38); the vertex of the next sample may be any
other, so that the inequality must hold for all pairs (j, l): that is the correction of Mao 2003
(Automatica 39), without which the cost need not fall when the model varies in time.

The slacks s are nought wherever the constraints can be met (an exact penalty); otherwise they say
by how much they cannot.

A law's certificate needs nothing but eigenvalues, whatever solver found the law. For V(z) = γ
z'Q⁻¹z the cost to go falls by the stage's cost at every vertex where

    Q_j^½ ( Q_j⁻¹ − (A_j + B_j K)' Q_l⁻¹ (A_j + B_j K) ) Q_j^½ ⪰ (1/γ) Q_j^½ (C'C + K'R K) Q_j^½

which is linear in the model, so that it holds in the whole polytope once it does at the vertices.
The left side is the margin of stability; the least γ for which the right side fits under it is the
cost that is certified, whatever the solver claimed.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from trms_cli.core.arrays import FloatArray

Lyapunov = Literal["common", "parameter_dependent"]

#: ρ, relative to γ in units in which the stage cost of typical deviations is about one.
_PENALTY = 1e4
_TOLERANCE = 1e-6
#: Of what is dimensionless: eigenvalues of scaled residuals, constraints relative to their bounds.
TOLERANCE = 1e-4
#: A certified cost this many times the claimed one means that the solver went wrong.
WORSE = 1.5


@dataclass(frozen=True)
class Certificate:
    """What holds of a law, measured."""

    #: Largest eigenvalue of Q_j^½ (A_j + B_j K)' Q_l⁻¹ (A_j + B_j K) Q_j^½ over all vertices: below
    #: 1, V falls by at least that factor each sample
    contraction: float
    gamma: float  #: The certified bound on the cost from the border of the ellipsoid
    claimed: float  #: The solver's γ
    #: (L, J) array; least eigenvalue of the scaled inequality at each vertex j and next vertex l
    #: with the solver's γ; not below −tolerance
    residuals: FloatArray
    state: float  #: max z'Q_j⁻¹z of the states that the law was made for; at most 1
    #: (m,) array; largest |v_i| in the ellipsoid relative to its bound; at most 1
    inputs: FloatArray
    #: (n,) array; largest |z_i| in the ellipsoid relative to its bound; at most 1
    states: FloatArray

    @property
    def stable(self) -> bool:
        """Whether V falls at every vertex, with a cost not far from what the solver claimed."""
        return bool(self.contraction < 1.0 and self.gamma <= WORSE * self.claimed + TOLERANCE)

    @property
    def constrained(self) -> bool:
        """Whether the ellipsoid holds the state and keeps to all bounds."""
        worst = max(self.state, float(self.inputs.max()), float(self.states.max()))
        return bool(worst <= 1.0 + 10 * TOLERANCE)

    def __str__(self) -> str:
        decrease = "holds" if self.stable else "FAILS"
        bounds = "kept" if self.constrained else "NOT kept"
        return (
            f"decrease {decrease}: largest contraction {self.contraction:.5f}, least eigenvalue "
            f"{self.residuals.min():+.1e} over {self.residuals.size} inequalities; "
            f"gamma {self.gamma:.4g} certified, {self.claimed:.4g} claimed; "
            f"bounds {bounds}: inputs {np.round(self.inputs, 3).tolist()}, "
            f"states {self.states.max():.3f}, state at {self.state:.4f} of the ellipsoid"
        )


def certify(task: Task, solution: LmiSolution) -> Certificate:
    """Check a solution against its task."""
    Q, K = solution.Q, solution.K
    count = len(Q)
    roots = np.array([_root(matrix) for matrix in Q])
    inverses = np.array([np.linalg.pinv(matrix, hermitian=True) for matrix in Q])
    stage = task.C.T @ task.C + K.T * task.R @ K
    closed = task.A + task.B @ K
    own = np.arange(len(task.A)) % count
    root = roots[own]
    # Over all pairs of the vertex now (axis 0) and the Lyapunov matrix of the next (axis 1).
    images = closed @ root
    after = np.einsum("jab,lac,jcd->jlbd", images, inverses, images)
    price = root @ stage @ root
    n = Q.shape[1]
    rest = np.eye(n) - after
    residuals = np.linalg.eigvalsh(rest - price[:, None] / solution.gamma)[..., 0]
    contraction = float(1.0 - np.linalg.eigvalsh(rest)[..., 0].min())
    sizes = np.sqrt(np.einsum("ia,jab,ib->ji", K, Q, K)).max(axis=0)
    extents = np.sqrt(np.maximum(np.einsum("jii->ji", Q), 0.0)).max(axis=0)
    positive = all(np.linalg.eigvalsh(matrix)[0] > 0 for matrix in Q)
    return Certificate(
        contraction if positive else float("inf"),
        _least_gamma(rest, price) if positive else float("inf"),
        solution.gamma,
        residuals,
        float(np.einsum("ka,jab,kb->jk", task.z, inverses, task.z).max()),
        sizes / np.maximum(task.input_bounds, 1e-12),
        np.where(np.isfinite(task.state_bounds), extents / task.state_bounds, 0.0),
    )


def _root(matrix: FloatArray) -> FloatArray:
    values, vectors = np.linalg.eigh(matrix)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)) @ vectors.T)


def _least_gamma(rest: FloatArray, price: FloatArray) -> float:
    """Least γ with ``rest ⪰ price/γ`` for all pairs; infinite where rest is not positive."""
    try:
        factor = np.linalg.cholesky(rest)
    except np.linalg.LinAlgError:
        return float("inf")
    half = np.linalg.solve(factor, np.broadcast_to(price[:, None], rest.shape))
    whole = np.linalg.solve(factor, half.swapaxes(-1, -2))
    return float(np.linalg.eigvalsh(whole)[..., -1].max())


@dataclass(frozen=True)
class Task:
    """The data of one problem, in units of the scales."""

    A: FloatArray  #: (L, n, n) array
    B: FloatArray  #: (L, n, m) array
    C: FloatArray  #: (q, n) array; C'C weighs z
    R: FloatArray  #: (m,) array; weighs v
    z: FloatArray  #: (k, n) array; where the bound is to be least: the worst of these states counts
    input_bounds: FloatArray  #: (m,) array; ū
    state_bounds: FloatArray  #: (n,) array; z̄; infinite for none


@dataclass(frozen=True)
class LmiSolution:
    """A solver's answer, believed after :func:`certify`."""

    Q: FloatArray  #: (1 or L, n, n) array
    K: FloatArray  #: (m, n) array
    gamma: float  #: γ, the bound on the cost
    slack: float  #: Largest s, relative to the squared bounds
    iterations: int
    status: str  #: The solver's word


class Inequalities:
    """The problem for given sizes.

    ``n``, ``m``, ``q``: coordinates, inputs, rows of C. ``bounded``: coordinates whose bounds may
    be finite. ``states``: k, for which the bound is to be least. ``max_iterations``: of an
    interior-point method; a first-order one has a thousand times as many. ``soft``: whether the
    constraints may be relaxed. ``nested``: whether the ellipsoid is to lie within another:
    :meth:`solve`'s ``inside``.
    """

    def __init__(
        self,
        n: int,
        m: int,
        q: int,
        vertices: int,
        bounded: Sequence[int] = (),
        states: int = 1,
        lyapunov: Lyapunov = "common",
        solver: Literal["clarabel", "scs"] = "clarabel",
        max_iterations: int = 60,
        *,
        soft: bool = True,
        nested: bool = False,
    ) -> None:
        import cvxpy as cp

        self.n, self.m, self.vertices = n, m, vertices
        self._bounded = list(bounded)
        n_bounded = len(self._bounded)
        self._options = _options(solver, max_iterations)
        own = vertices if lyapunov == "parameter_dependent" else 1
        self._Q = [cp.Variable((n, n), symmetric=True) for _ in range(own)]
        self._G = cp.Variable((n, n)) if own > 1 else self._Q[0]
        self._Y = cp.Variable((m, n))
        self._gamma = cp.Variable()
        T = cp.Variable((n, n), symmetric=True)
        self._slack = cp.Variable(m + n_bounded, nonneg=True)
        self._A = [cp.Parameter((n, n)) for _ in range(vertices)]
        self._B = [cp.Parameter((n, m)) for _ in range(vertices)]
        self._C, self._R = cp.Parameter((q, n)), cp.Parameter((m, m))
        self._z = [cp.Parameter((n, 1)) for _ in range(states)]
        self._input = cp.Parameter(m, nonneg=True)
        self._state = cp.Parameter(n_bounded, nonneg=True) if n_bounded else None
        self._inside = cp.Parameter((n, n), symmetric=True) if nested else None

        Q, G, Y = self._Q, self._G, self._Y
        wide = [G + G.T - Qj if own > 1 else Qj for Qj in Q]
        S = cp.vstack([self._C @ G, self._R @ Y])
        constraints = [cp.bmat([[T, S.T], [S, self._gamma * np.eye(q + m)]]) >> 0]
        for Qj in Q:
            one = np.ones((1, 1))
            constraints += [cp.bmat([[one, z.T], [z, Qj]]) >> 0 for z in self._z]
            if self._state is not None:
                diagonal = cp.hstack([Qj[i, i] for i in self._bounded])
                constraints.append(diagonal <= self._state + self._slack[m:])
            if self._inside is not None:
                constraints.append(self._inside - Qj >> 0)
        for j in range(vertices):
            after = self._A[j] @ G + self._B[j] @ Y
            now = wide[j % own] - T
            for Ql in Q:
                constraints.append(cp.bmat([[now, after.T], [after, Ql]]) >> 0)
        for i in range(m):
            limit = cp.reshape(self._input[i] + self._slack[i], (1, 1), order="C")
            row = Y[i : i + 1, :]
            constraints += [cp.bmat([[limit, row], [row.T, block]]) >> 0 for block in wide]
        if not soft:
            constraints.append(self._slack == 0)
        self.problem = cp.Problem(
            cp.Minimize(self._gamma + _PENALTY * cp.sum(self._slack)), constraints
        )

    def solve(self, task: Task, inside: FloatArray | None = None) -> LmiSolution | None:
        """The best law for a task; None where the solver found none.

        ``inside``: (n, n) array; Q of the ellipsoid to lie within.
        """
        import cvxpy as cp

        # The stage's cost is brought to the order of one, that the tolerances mean the same to all.
        unit = max(float((np.abs(task.z @ task.C.T) ** 2).sum(axis=1).max()), 1e-12)
        if not unit < math.inf:  # a deviation whose square is no number any more
            return None
        size = math.sqrt(unit)
        for j in range(self.vertices):
            self._A[j].value, self._B[j].value = task.A[j], task.B[j]
        self._C.value = task.C
        self._R.value = np.diag(np.sqrt(task.R))
        for z, value in zip(self._z, task.z, strict=True):
            z.value = value[:, None] / size
        input_bounds = np.minimum(task.input_bounds / size, _FAR)
        state_bounds = np.minimum(task.state_bounds[self._bounded] / size, _FAR)
        self._input.value = input_bounds**2
        if self._state is not None:
            self._state.value = state_bounds**2
        if self._inside is not None:
            self._inside.value = inside / unit if inside is not None else _FAR**2 * np.eye(self.n)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # what is inaccurate is found by the certificate
                self.problem.solve(**self._options)
        except (cp.error.SolverError, ArithmeticError, ValueError):
            return None
        values = [v.value for v in (self._Y, self._gamma, self._G, self._slack, *self._Q)]
        arrays = [np.asarray(value) for value in values if value is not None]
        if len(arrays) < len(values) or not all(np.isfinite(value).all() for value in arrays):
            return None
        Y, gamma, G, relaxed, *Qs = arrays
        try:
            K = np.linalg.solve(G.T, Y.T).T
        except np.linalg.LinAlgError:
            return None
        Q = np.array([(Qj + Qj.T) / 2 for Qj in Qs]) * unit
        bounds = np.concatenate([input_bounds, state_bounds]) ** 2
        slack = np.maximum(relaxed, 0.0) / bounds
        stats: Any = self.problem.solver_stats
        return LmiSolution(
            Q,
            np.ascontiguousarray(K),
            float(gamma) * unit,
            float(slack.max()),
            int(stats.num_iters or 0),
            str(self.problem.status),
        )


#: Bounds this many times the present deviation bind nowhere.
_FAR = 1e3


def _options(solver: str, max_iterations: int) -> dict[str, Any]:
    if solver == "clarabel":
        tolerances = dict.fromkeys(("tol_gap_abs", "tol_gap_rel", "tol_feas"), _TOLERANCE)
        return {
            "solver": "CLARABEL",
            "warm_start": True,
            "max_iter": max_iterations,
            "max_threads": 1,
            "presolve_enable": False,
            "chordal_decomposition_enable": False,
            **tolerances,
        }
    return {
        "solver": "SCS",
        "warm_start": True,
        "max_iters": 1000 * max_iterations,
        "eps_abs": 1e-5,
        "eps_rel": 1e-5,
    }
