"""The engine of the residual tests: its level, its bands, what it does with missing samples."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import binom, kstest

from trms_cli.identification.validation.residual_tests import (
    chi2_tail,
    correlation,
    ljung_box,
    mean_test,
    moment_test,
)

SEEDS = 300


def smooth(rng: np.random.Generator, n: int) -> np.ndarray:
    """An input whose neighbours resemble each other, as every command's do."""
    return lfilter([1.0], [1.0, -0.97], rng.standard_normal(n))


@pytest.mark.parametrize("spread", ["constant", "follows the input"])
def test_p_values_are_uniform_for_any_input_and_spread(spread):
    p = []
    for seed in range(SEEDS):
        rng = np.random.default_rng(seed)
        u = smooth(rng, 1500)
        e = rng.standard_normal(1500)
        if spread != "constant":
            e[1:] *= 0.3 + np.abs(u[:-1])
        p.append(moment_test(e, u, [1, 2, 3, 5, 8, 13, 20]).p_value)
    assert kstest(p, "uniform").pvalue > 1e-3


def test_holds_where_the_input_carries_past_errors():
    p = []
    for seed in range(SEEDS):
        rng = np.random.default_rng(seed)
        e = rng.standard_normal(1500)
        u = lfilter([0.0, 1.0], [1.0, -0.9], e)  # feedback of the output, noise and all
        p.append(moment_test(e, u, [1, 2, 3, 5, 8]).p_value)
    assert kstest(p, "uniform").pvalue > 1e-3


def test_finds_what_is_there():
    rng = np.random.default_rng(0)
    u = smooth(rng, 1500)
    e = rng.standard_normal(1500)
    e[3:] += 0.1 * u[:-3]
    result = moment_test(e, u, [1, 2, 3, 5])
    assert result.p_value < 1e-6
    assert np.all(np.abs(result.correlations) > result.band())


def test_the_band_holds_all_lags_of_a_right_model():
    inside = 0
    for seed in range(SEEDS):
        rng = np.random.default_rng(seed)
        result = moment_test(rng.standard_normal(1000), rng.standard_normal(1000), range(1, 21))
        inside += bool(np.all(np.abs(result.correlations) <= result.band(0.95)))
    low, high = binom.interval(0.999, SEEDS, 0.95)
    assert low <= inside <= high


def test_ljung_box_is_the_textbook_formula():
    rng = np.random.default_rng(1)
    e = rng.standard_normal(700)
    a = e - e.mean()
    r = np.array([a[k:] @ a[:-k] for k in range(1, 11)]) / (a @ a)
    q = 700 * 702 * np.sum(r**2 / (700 - np.arange(1, 11)))
    result = ljung_box(e, 10)
    assert result.statistic == pytest.approx(q)
    assert result.p_value == pytest.approx(chi2_tail(q, 10))


@pytest.mark.parametrize("test", ["ljung_box", "moment"])
def test_missing_samples_do_not_break_the_level(test):
    p = []
    for seed in range(SEEDS):
        rng = np.random.default_rng(seed)
        e = rng.standard_normal(2500)
        e[rng.random(2500) < 0.1] = np.nan
        p.append(
            (ljung_box(e, 6) if test == "ljung_box" else moment_test(e, e, range(1, 7))).p_value
        )
    assert kstest(p, "uniform").pvalue > 1e-3


def test_a_mean_is_found_and_none_is_not():
    rng = np.random.default_rng(2)
    e = rng.standard_normal(1000)
    assert mean_test(e + 0.3).p_value < 1e-6
    assert mean_test(e - e.mean()).p_value == pytest.approx(1.0)


@pytest.mark.parametrize(
    "present, past",
    [
        (np.zeros(500), np.ones(500)),
        (np.full(500, np.nan), np.arange(500.0)),
        (np.arange(10.0), np.arange(10.0)),
    ],
    ids=["nothing varies", "nothing is there", "too short"],
)
def test_says_nothing_where_nothing_can_be_said(present, past):
    assert np.isnan(moment_test(present, past, [1, 2, 3]).p_value)


def test_correlations_of_either_sign_of_lag():
    rng = np.random.default_rng(3)
    u = rng.standard_normal(4000)
    e = np.concatenate([[0.0, 0.0], u[:-2]])
    found = correlation(e, u, [-2, 0, 2])
    assert found == pytest.approx([0.0, 0.0, 1.0], abs=0.06)
