"""NEES and the Ljung–Box test do on known processes what theory says."""

import math

import numpy as np
import pytest
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st

from trms_cli.scoring.metrics import (
    LAGS,
    chi_square_interval,
    chi_square_tail,
    joint_p,
    nees,
    whiteness_p,
)


@given(st.floats(0, 2000), st.sampled_from([2, 4, 10, 20, 50]))
def test_the_tail_is_scipys(statistic, degrees):
    assert chi_square_tail(statistic, degrees) == pytest.approx(
        float(scipy.stats.chi2.sf(statistic, degrees)), rel=1e-9, abs=1e-300
    )


@pytest.mark.parametrize("degrees", [1, 2, 3, 4, 6, 9, 40])
@pytest.mark.parametrize("share", [0.5, 0.95, 0.997])
def test_the_interval_is_scipys(degrees, share):
    expected = scipy.stats.chi2.ppf([(1 - share) / 2, (1 + share) / 2], degrees)
    assert chi_square_interval(degrees, share) == pytest.approx(expected, rel=1e-9)


def test_the_statistic_is_that_of_the_definition():
    values = np.random.default_rng(3).normal(size=300)
    centred = values - values.mean()
    n = values.size
    total = 0.0
    for lag in range(1, LAGS + 1):
        rho = sum(centred[i] * centred[i - lag] for i in range(lag, n)) / sum(centred**2)
        total += rho**2 / (n - lag)
    assert whiteness_p(values) == pytest.approx(
        float(scipy.stats.chi2.sf(n * (n + 2) * total, LAGS)), rel=1e-9
    )


def test_white_noise_is_called_white_as_often_as_promised():
    rng = np.random.default_rng(5)
    p = [whiteness_p(rng.normal(size=1000)) for _ in range(400)]
    assert 0.02 < np.mean(np.array(p) < 0.05) < 0.09
    assert scipy.stats.kstest(p, "uniform").pvalue > 0.01


@given(st.floats(0.15, 0.9))
def test_correlated_noise_is_found_out(correlation):
    rng = np.random.default_rng(7)
    values = rng.normal(size=3000)
    for k in range(1, values.size):
        values[k] += correlation * values[k - 1]
    assert whiteness_p(values) < 1e-4


def test_whiteness_does_not_depend_on_scale_mean_or_missing_samples():
    values = np.random.default_rng(2).normal(size=500)
    sparse = np.full(1500, np.nan)
    sparse[::3] = 1e-3 * values + 7.0
    assert whiteness_p(sparse) == pytest.approx(whiteness_p(values), rel=1e-6)


def test_what_says_nothing_has_no_p_and_odd_degrees_no_closed_form():
    assert math.isnan(whiteness_p(np.random.default_rng(0).normal(size=99)))
    assert math.isnan(whiteness_p(np.full(1000, 0.3)))
    assert math.isnan(whiteness_p(np.zeros(1000)))
    assert math.isnan(joint_p([]))
    assert math.isnan(joint_p([math.nan]))
    assert joint_p([0.01, math.nan, 0.4]) == pytest.approx(0.02)
    assert joint_p([0.9, 0.8]) == 1.0
    with pytest.raises(ValueError, match="even"):
        chi_square_tail(1.0, 3)


def test_the_mean_nees_is_the_number_of_states_also_for_correlated_ones():
    rng = np.random.default_rng(1)
    mixing = np.array([[1.0, 0.0, 0.0], [0.9, 0.3, 0.0], [0.5, 0.2, 2.0]])
    error = rng.normal(size=(200_000, 3)) @ mixing.T
    deviation = np.broadcast_to(np.linalg.norm(mixing, axis=1), error.shape)
    assert np.mean(nees(error, deviation)) == pytest.approx(3.0, rel=0.02)
    assert np.mean(nees(2 * error, deviation)) == pytest.approx(12.0, rel=0.02)
