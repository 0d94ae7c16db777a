"""What a polytope leaves out of the coefficients that it was made for, and whether a law minds."""

from __future__ import annotations

import numpy as np

from trms_cli.controllers.robust.lmi import LmiSolution, Task
from trms_cli.controllers.robust.polytope import Polytope
from trms_cli.core.arrays import BoolArray, FloatArray


def independent_cube(points: int, dimensions: int, seed: int) -> FloatArray:
    """Uniform random points of [−1, 1]^d, to judge a polytope by others than those it is from."""
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (points, dimensions))


def remainder(polytope: Polytope, coefficients: FloatArray) -> FloatArray:
    """Distance of coefficients (N, n, n + m) to a polytope, spectral norm, shape (N,).

    To the point that is nearest in the components: an upper bound.
    """
    flat = (coefficients - polytope.centre).reshape(len(coefficients), -1)
    theta = np.clip(flat @ polytope.directions.T, polytope.lower, polytope.upper)
    residual = flat - theta @ polytope.directions
    return np.asarray(np.linalg.norm(residual.reshape(coefficients.shape), 2, axis=(1, 2)))


def are_inside(polytope: Polytope, coefficients: FloatArray) -> BoolArray:
    """Whether the components of coefficients (N, n, n + m) are within the box, shape (N,)."""
    flat = (coefficients - polytope.centre).reshape(len(coefficients), -1)
    theta = flat @ polytope.directions.T
    return np.all((theta >= polytope.lower) & (theta <= polytope.upper), axis=1)


def decrease_on(
    coefficients: FloatArray, solution: LmiSolution, task: Task
) -> tuple[FloatArray, FloatArray]:
    """A common law's decrease on coefficients that need not be in the polytope.

    ``coefficients``: (N, n, n + m). Returns the contraction, (N,), as in :class:`Certificate`, and
    the slack, (N,): least eigenvalue of the scaled inequality, stage cost included.
    """
    n = task.A.shape[1]
    Q = solution.Q[0]
    values, vectors = np.linalg.eigh(Q)
    root, inverse = vectors * np.sqrt(np.maximum(values, 0.0)) @ vectors.T, np.linalg.inv(Q)
    closed = (coefficients[:, :, :n] + coefficients[:, :, n:] @ solution.K) @ root
    rest = np.eye(n) - np.einsum("kba,bc,kcd->kad", closed, inverse, closed)
    stage = task.C.T @ task.C + solution.K.T * task.R @ solution.K
    price = root @ stage @ root
    contraction = 1.0 - np.linalg.eigvalsh(rest)[:, 0]
    slack = np.linalg.eigvalsh(rest - price / solution.gamma)[:, 0]
    return np.asarray(contraction), np.asarray(slack)
