"""A law's certificate, by nothing but eigenvalues: independent of the solver that found the law.

For V(z) = γ z'Q⁻¹z the cost to go falls by the stage's cost at every vertex where

    Q_j^½ ( Q_j⁻¹ − (A_j + B_j K)' Q_l⁻¹ (A_j + B_j K) ) Q_j^½ ⪰ (1/γ) Q_j^½ (C'C + K'R K) Q_j^½

which is linear in the model, so that it holds in the whole polytope once it does at the vertices.
The left side is the margin of stability; the least γ for which the right side fits under it is the
cost that is certified, whatever the solver claimed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from trms_cli.controllers.robust.lmi import Solution, Task

FloatArray = npt.NDArray[np.float64]

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
        held = "holds" if self.stable else "FAILS"
        kept = "kept" if self.constrained else "NOT kept"
        return (
            f"decrease {held}: largest contraction {self.contraction:.5f}, least eigenvalue "
            f"{self.residuals.min():+.1e} over {self.residuals.size} inequalities; "
            f"gamma {self.gamma:.4g} certified, {self.claimed:.4g} claimed; "
            f"bounds {kept}: inputs {np.round(self.inputs, 3).tolist()}, "
            f"states {self.states.max():.3f}, state at {self.state:.4f} of the ellipsoid"
        )


def certify(task: Task, solution: Solution) -> Certificate:
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
    moved = closed @ root
    after = np.einsum("jab,lac,jcd->jlbd", moved, inverses, moved)
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


def decrease_on(
    coefficients: FloatArray, solution: Solution, task: Task
) -> tuple[FloatArray, FloatArray]:
    """A common law's decrease on coefficients that need not be in the polytope.

    Parameters
    ----------
    coefficients : (N, n, n + m) array

    Returns
    -------
    contraction : (N,) array
        As in :class:`Certificate`.
    slack : (N,) array
        Least eigenvalue of the scaled inequality, stage cost included.
    """
    n = task.A.shape[1]
    Q = solution.Q[0]
    root, inverse = _root(Q), np.linalg.inv(Q)
    closed = (coefficients[:, :, :n] + coefficients[:, :, n:] @ solution.K) @ root
    rest = np.eye(n) - np.einsum("kba,bc,kcd->kad", closed, inverse, closed)
    stage = task.C.T @ task.C + solution.K.T * task.R @ solution.K
    price = root @ stage @ root
    contraction = 1.0 - np.linalg.eigvalsh(rest)[:, 0]
    slack = np.linalg.eigvalsh(rest - price / solution.gamma)[:, 0]
    return np.asarray(contraction), np.asarray(slack)


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
