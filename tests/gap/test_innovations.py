"""The filter that makes residuals white: compiled and not, against what theory says."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag

from trms_cli.gap import discrepancy as filters
from trms_cli.gap.discrepancy import (
    FLOOR,
    Discrepancy,
    LinearSystem,
    TrajectoryLinearisation,
    equation_channels,
    likely_shares,
    log_likelihood,
)
from trms_cli.identification.greybox.windows import Windows
from trms_cli.identification.problem import FitProblem
from trms_cli.models.newtonian import Newtonian

from .recorded import recording


def random_system(seed: int = 0, m: int = 3, c: int = 40, n: int = 4, n_y: int = 2) -> LinearSystem:
    random = np.random.default_rng(seed)
    f = 0.6 * np.eye(n) + 0.15 * random.standard_normal((m, c, n, n))
    h = random.standard_normal((m, c, n_y, n))
    measured_mask = random.random((m, c, n_y)) > 0.1
    start = np.diag(random.uniform(0.5, 2.0, n))
    return LinearSystem(f, h, measured_mask, random.uniform(0.1, 0.5, n_y), start)


Q = np.diag([0.3, 0.1, 0.2, 0.05])


def simulated(system: LinearSystem, seed: int) -> np.ndarray:
    random = np.random.default_rng(seed)
    m, c, n_y, n = system.h.shape
    x = random.standard_normal((m, n)) @ np.sqrt(system.start)
    y = np.empty((m, c, n_y))
    for t in range(c):
        noise = np.sqrt(system.r) * random.standard_normal((m, n_y))
        y[:, t] = np.einsum("myn,mn->my", system.h[:, t], x) + noise
        x = np.einsum("mij,mj->mi", system.f[:, t], x)
        x += random.standard_normal((m, n)) @ np.sqrt(Q)
    return y


def dense(system: LinearSystem, j: int) -> tuple[np.ndarray, ...]:
    """By definition, of a window: the states' covariance, theirs with the outputs, the outputs'."""
    _, c, _, n = system.h.shape
    # All states x solve (I − F) x = w, with F below the diagonal.
    steps = np.eye(c * n)
    steps[n:, :-n] -= block_diag(*system.f[j, :-1])
    noise = block_diag(system.start, *[Q] * (c - 1))
    states = np.linalg.solve(steps, np.linalg.solve(steps, noise).T)
    measured_mask = system.measured[j].ravel()
    h, r = block_diag(*system.h[j])[measured_mask], np.tile(system.r, c)[measured_mask]
    return states, states @ h.T, h @ states @ h.T + np.diag(r)


def test_innovations_have_the_density_of_the_whole_covariance():
    system = random_system()
    y = simulated(system, 1)
    filter_ = filters.gains(system, Q)
    z = filters.whiten(system, filter_, y[..., None])[..., 0]
    for j in range(3):
        *_, covariance = dense(system, j)
        observations = y[j].ravel()[system.measured[j].ravel()]
        assert np.sum(z[j] ** 2) == pytest.approx(
            observations @ np.linalg.solve(covariance, observations)
        )
        assert filter_.logdet[j] == pytest.approx(np.linalg.slogdet(covariance)[1])


def test_compiled_and_plain_loops_agree(monkeypatch):
    system = random_system(2)
    y = simulated(system, 3)[..., None]
    compiled = filters.gains(system, Q, covariances=True)
    z = filters.whiten(system, compiled, y)
    scores = filters.scores(system, compiled, z[..., 0])
    monkeypatch.setattr(filters, "_library", lambda: None)
    plain = filters.gains(system, Q, covariances=True)
    for one, other in zip(compiled, plain, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(filters.whiten(system, plain, y), z, rtol=1e-8, atol=1e-10)
    for one, other in zip(filters.scores(system, plain, z[..., 0]), scores, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-8)


def test_scores_are_the_likelihoods_slope():
    system = random_system(4)
    y = simulated(system, 5)

    def likelihood(start: np.ndarray, q: np.ndarray) -> float:
        begun = replace(system, start=start)
        filter_ = filters.gains(begun, q)
        z = filters.whiten(begun, filter_, y[..., None])
        return float(-0.5 * np.sum(z**2) - 0.5 * filter_.logdet.sum())

    filter_ = filters.gains(system, Q)
    z = filters.whiten(system, filter_, y[..., None])[..., 0]
    squares, variances = filters.scores(system, filter_, z)
    for i in range(4):
        step = np.zeros((4, 4))
        step[i, i] = 1e-5
        both = [
            likelihood(system.start + step, Q) - likelihood(system.start - step, Q),
            likelihood(system.start, Q + step) - likelihood(system.start, Q - step),
        ]
        slopes = 0.5 * (squares[:, i] - variances[:, i])
        np.testing.assert_allclose(slopes, np.array(both) / 2e-5, rtol=1e-4, atol=1e-3)


def test_the_smoother_is_the_conditional_mean():
    system = random_system(6, m=1, c=12)
    y = simulated(system, 7)
    filter_ = filters.gains(system, Q, covariances=True)
    x, variance = filters.smooth(system, filter_, y)
    states, shared, outputs = dense(system, 0)
    gain = np.linalg.solve(outputs, shared.T).T
    mean = gain @ y[0].ravel()[system.measured[0].ravel()]
    np.testing.assert_allclose(x[0].ravel(), mean, atol=1e-9)
    np.testing.assert_allclose(variance[0].ravel(), np.diag(states - gain @ shared.T), rtol=1e-9)


@pytest.fixture(scope="module")
def windows() -> Windows:
    problem = FitProblem(
        model=Newtonian(), datasets=(recording(seconds=20.0),), window_length=10.0, jobs=1
    )
    return Windows(problem)


@pytest.fixture(scope="module")
def discrepancy(windows) -> Discrepancy:
    """Along the model's own simulation."""
    model = windows.problem.model
    p = model.parameters.values
    trajectory = TrajectoryLinearisation(windows).along(p, windows.starts(p))
    return Discrepancy(windows, trajectory, equation_channels(model))


def residuals(discrepancy: Discrepancy) -> np.ndarray:
    windows = discrepancy.windows
    return np.where(windows.measured, windows.target - discrepancy.trajectory.y, 0.0)


def test_a_rig_without_a_gap_has_white_innovations_and_no_discrepancy(discrepancy):
    r = residuals(discrepancy)
    filter_ = discrepancy.filter(np.full(4, FLOOR))
    z = discrepancy.whitened(filter_, r[..., None])[..., 0]
    assert np.all(np.mean(z**2, axis=(0, 1)) < 1.15)
    assert np.all(np.mean(z**2, axis=(0, 1)) > 0.75)
    assert np.all(likely_shares(discrepancy, r, np.full(4, 0.1)) < 0.03)


def test_a_force_that_is_missing_is_found_on_its_equation(discrepancy):
    r = residuals(discrepancy)
    # a sine of 30 percent of what acts on yaw, through the linear system itself
    system, n = discrepancy.system, discrepancy.trajectory.x.shape[-1]
    x = np.zeros((len(discrepancy.windows), n + 4))
    for t in range(r.shape[1]):
        r[:, t] += np.einsum("myn,mn->my", system.h[:, t], x)
        x[:, n:] = 0.0
        x[:, n + 1] = 0.3 * np.sin(2 * np.pi * 0.4 * t * 0.02)
        x = np.einsum("mij,mj->mi", system.f[:, t], x)
    shares = likely_shares(discrepancy, r, np.full(4, 0.05))
    assert shares[1] > 0.1
    assert np.all(shares[[0, 2, 3]] < 0.04)
    assert log_likelihood(discrepancy, r, shares).sum() > (
        log_likelihood(discrepancy, r, np.full(4, FLOOR)).sum() + 50
    )
    smoothed, _ = discrepancy.smoothed(shares, r)
    wave = np.sin(2 * np.pi * 0.4 * 0.02 * np.arange(r.shape[1]))
    force = smoothed[0, :, n + 1] / discrepancy.scales[1]
    assert np.corrcoef(force[50:-50], wave[50:-50])[0, 1] > 0.9
