"""Eliminating the starts gives what one large least-squares problem would."""

import numpy as np
import pytest
from scipy.linalg import block_diag

from trms_cli.identification.greybox.objective import Joint, Quadratic, eliminate_starts, triangles

M, N, F, ROWS = 5, 3, 4, 40


def quadratic(seed: int, joined: bool) -> tuple[Quadratic, np.ndarray, np.ndarray]:
    generator = np.random.default_rng(seed)
    a_b, r = generator.standard_normal((M, ROWS, N + F)), generator.standard_normal((M, ROWS))
    generator = np.random.default_rng(seed + 1)
    joint = None
    if joined:
        follows = np.array([False, True, True, False, True])
        joint = Joint(
            follows,
            generator.standard_normal((M, N, N + F)),
            generator.uniform(1.0, 30.0, N),
            generator.standard_normal((M, N)),
        )
    made = Quadratic(
        triangles(np.concatenate([a_b, r[..., None]], axis=2)),
        generator.standard_normal((M, N)),
        generator.uniform(0.0, 2.0, F),
        generator.standard_normal(F),
        joint,
    )
    return made, a_b, r


def dense(made: Quadratic, a_b: np.ndarray, r: np.ndarray, damping: float) -> np.ndarray:
    """All rows of the problem in columns of all starts, then the parameters."""
    eye = np.eye(M * N + F)
    recorded = np.hstack([block_diag(*a_b[..., :N]), np.vstack(a_b[..., N:])])
    prior = made.prior_root[:, None] * eye[M * N :]
    rows = [recorded, eye[: M * N], np.sqrt(damping) * eye, prior]
    wanted = [-r.ravel(), -made.start_gap.ravel(), np.zeros(M * N + F), -made.prior_gap]
    if made.joint is not None:
        for j in np.flatnonzero(made.joint.follows):
            row = np.zeros((N, M * N + F))
            row[:, (j - 1) * N : j * N] = made.joint.from_before[j][:, :N]
            row[:, j * N : (j + 1) * N] = -np.diag(made.joint.weight)
            row[:, M * N :] = made.joint.from_before[j][:, N:]
            rows.append(row)
            wanted.append(-made.joint.gap[j])
    return np.linalg.lstsq(np.vstack(rows), np.concatenate(wanted), rcond=None)[0]


@pytest.mark.parametrize("joined", [False, True])
@pytest.mark.parametrize("damping", [0.0, 3.0])
def test_equals_the_whole_problem_whose_cost_is_least_there(joined: bool, damping: float) -> None:
    made, a_b, r = quadratic(3, joined)
    left = eliminate_starts(made, damping)
    rows = np.vstack([left.factor, np.diag(made.prior_root), np.sqrt(damping) * np.eye(F)])
    wanted = -np.concatenate([left.residual, made.prior_gap, np.zeros(F)])
    theta = np.linalg.lstsq(rows, wanted, rcond=None)[0]
    found = np.concatenate([left.starts(theta).ravel(), theta])
    np.testing.assert_allclose(found, dense(made, a_b, r, damping), atol=1e-10)
    if damping == 0.0:
        best = made.cost(left.starts(theta), theta)
        generator = np.random.default_rng(0)
        for _ in range(20):
            other = theta + 0.1 * generator.standard_normal(F)
            starts = left.starts(theta) + 0.1 * generator.standard_normal((M, N))
            assert made.cost(starts, other) > best


@pytest.mark.parametrize("rows", [4, 40, 3000])
def test_triangles_keep_the_normal_matrix(rows: int) -> None:
    generator = np.random.default_rng(1)
    a_b, r = generator.standard_normal((2, rows, 11)), generator.standard_normal((2, rows))
    whole = np.concatenate([a_b, r[..., None]], axis=2)
    found = triangles(np.concatenate([a_b, r[..., None]], axis=2))
    assert found.shape[1] <= max(rows, 8000)
    np.testing.assert_allclose(
        found.swapaxes(1, 2) @ found, whole.swapaxes(1, 2) @ whole, rtol=1e-10, atol=1e-9
    )
