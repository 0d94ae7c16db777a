"""Covariance of the score under correlated residuals, against the textbook's double sum."""

from __future__ import annotations

import numpy as np
import pytest

from trms_cli.identification.greybox.information import (
    autocovariance,
    parzen,
    score_covariances,
)


def test_score_is_the_double_sum() -> None:
    generator = np.random.default_rng(0)
    slopes = generator.standard_normal((3, 50, 2, 4))
    gamma = np.array([[2.0, 0.7, -0.3], [1.0, 0.0, 0.1]])
    found = score_covariances(slopes, gamma)
    for c in range(2):
        lag = np.abs(np.subtract.outer(np.arange(50), np.arange(50)))
        toeplitz = np.where(lag < 3, gamma[c][np.minimum(lag, 2)], 0.0)
        wanted = sum(slopes[j, :, c].T @ toeplitz @ slopes[j, :, c] for j in range(3))
        np.testing.assert_allclose(found[c], wanted, rtol=1e-9, atol=1e-9)


def test_no_direction_gets_a_negative_variance() -> None:
    generator = np.random.default_rng(1)
    z = np.cumsum(generator.standard_normal((4, 200, 2)), axis=1)
    measured = generator.random(z.shape) > 0.1
    gamma = autocovariance(np.where(measured, z, 0.0), measured, 60)
    for matrix in score_covariances(generator.standard_normal((4, 200, 2, 3)), gamma):
        assert np.linalg.eigvalsh(matrix)[0] > -1e-8


@pytest.mark.parametrize("kept", [0.0, 0.8])
def test_long_run_variance_of_an_autoregression(kept: float) -> None:
    """The sum of its autocovariances is ``1/(1 − a)²`` times its innovations' variance."""
    generator = np.random.default_rng(2)
    z = generator.standard_normal((60, 1000, 1))
    for k in range(1, z.shape[1]):
        z[:, k] += kept * z[:, k - 1]
    gamma = autocovariance(z, np.ones(z.shape, dtype=bool), 100)
    long_run = gamma[0, 0] + 2 * gamma[0, 1:].sum()
    # Parzen's window costs a few percent; 60 000 samples scatter by two more.
    assert long_run == pytest.approx(1 / (1 - kept) ** 2, rel=0.1)


def test_parzen_falls_from_one_to_nothing() -> None:
    window = parzen(10)
    assert window[0] == 1 and window[-1] < 0.01
    assert np.all(np.diff(window) < 0)
