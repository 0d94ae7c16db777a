"""Scores of correlated residuals; covariance and identifiability from information by hand."""

import numpy as np
import pytest
from scipy.linalg import toeplitz
from scipy.signal import lfilter

from trms_cli.identification.greybox.map_fit import (
    COLLINEAR,
    Identifiability,
    Information,
    autocovariance,
    correlations,
    identifiability,
    parzen,
    score_covariances,
)


def information(columns: np.ndarray, prior: float = 1.0, inflation: float = 1.0) -> Information:
    """Of white residuals with these sensitivities (rows, n_f), in two outputs of equal share."""
    fisher = columns.T @ columns / 2
    n = columns.shape[1]
    return Information(
        curvature=np.array([fisher, fisher]),
        score=inflation * np.array([fisher, fisher]),
        trust=np.ones(2),
        prior=np.full(n, prior),
        scales=np.full(n, 2.0),
        size=np.ones(2),
    )


@pytest.fixture
def columns() -> np.ndarray:
    return np.random.default_rng(0).standard_normal((200, 4))


def test_white_residuals_give_the_inverse_curvature(columns: np.ndarray) -> None:
    wanted = 4.0 * np.linalg.inv(columns.T @ columns + np.eye(4))
    np.testing.assert_allclose(information(columns).covariance(), wanted, rtol=1e-9)
    # A parameter that is held has no variance and passes none on.
    free = np.array([True, False, True, True])
    found = information(columns).covariance(~free)
    assert not found[1].any() and not found[:, 1].any()
    wanted = information(columns[:, free]).covariance()
    np.testing.assert_allclose(found[np.ix_(free, free)], wanted)


def test_correlated_residuals_widen_what_comes_from_the_data_but_no_prior(columns: np.ndarray):
    """With φ times the variance of the score, and no prior, deviations grow by √φ."""
    white = information(columns, prior=0.0).covariance()
    wide = information(columns, prior=0.0, inflation=9.0).covariance()
    np.testing.assert_allclose(wide, 9 * white, rtol=1e-9)
    known = information(columns, prior=0.0, inflation=9.0).samples_per_sample()
    np.testing.assert_allclose(known, 9.0, rtol=1e-9)
    silent = information(0.0 * columns, inflation=50.0)
    np.testing.assert_allclose(silent.covariance(), 4.0 * np.eye(4))


def identified(columns: np.ndarray) -> Identifiability:
    names = [f"p{i}" for i in range(columns.shape[1])]
    known = information(columns)
    return identifiability(known, names, known.covariance())


def test_the_smallest_sets_that_imitate_each_other_are_named(columns: np.ndarray) -> None:
    independent = identified(columns)
    assert independent.confounded == () and independent.silent == ()
    three, two = columns.copy(), columns.copy()
    two[:, 1] = 3 * columns[:, 0] + 0.01 * columns[:, 1]
    three[:, 2] = columns[:, 0] - columns[:, 1] + 0.01 * columns[:, 2]
    for imitating, names in ((two, ("p0", "p1")), (three, ("p0", "p1", "p2"))):
        (found,) = identified(imitating).confounded
        assert found.names == names and found.index > COLLINEAR


def test_a_parameter_of_little_effect_is_uninformed_and_of_none_silent(columns: np.ndarray) -> None:
    little, none = columns.copy(), columns.copy()
    little[:, 1] *= 0.01  # 200 samples of 0.01 against a prior of 1: 0.99 of its deviation stay
    found = identified(little)
    assert found.silent == () and found.uninformed == ("p1",)
    none[:, 3] = 0.0
    found = identified(none)
    assert found.silent == found.uninformed == ("p3",)
    assert found.prior_remaining["p3"] == pytest.approx(1.0)


def test_correlations_are_between_minus_one_and_one(columns: np.ndarray) -> None:
    columns[:, 1] = -2 * columns[:, 0] + 0.001 * columns[:, 1]
    found = correlations(information(columns, prior=0.0).covariance())
    assert np.all(np.abs(found) <= 1 + 1e-12)
    assert found[0, 1] > 0.99  # what one takes the other gives


def test_score_is_the_double_sum() -> None:
    generator = np.random.default_rng(0)
    slopes = generator.standard_normal((3, 50, 2, 4))
    gamma = np.array([[2.0, 0.7, -0.3], [1.0, 0.0, 0.1]])
    found = score_covariances(slopes, gamma)
    for c in range(2):
        covariance = toeplitz(np.pad(gamma[c], (0, 47)))
        wanted = sum(slopes[j, :, c].T @ covariance @ slopes[j, :, c] for j in range(3))
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
    noise = np.random.default_rng(2).standard_normal((60, 1000, 1))
    z = lfilter([1], [1, -kept], noise, axis=1)
    gamma = autocovariance(z, np.ones(z.shape, dtype=bool), 100)
    long_run = gamma[0, 0] + 2 * gamma[0, 1:].sum()
    # Parzen's window costs a few percent; 60 000 samples scatter by two more.
    assert long_run == pytest.approx(1 / (1 - kept) ** 2, rel=0.1)
    # It falls from one to nothing.
    window = parzen(10)
    assert window[0] == 1 and window[-1] < 0.01
    assert np.all(np.diff(window) < 0)
