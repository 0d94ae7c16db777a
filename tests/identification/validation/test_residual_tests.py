"""The residual tests and their engine: levels, bands, missing samples, what each kind finds."""

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import binom, kstest

from trms_cli.identification.validation.residual_tests import (
    MEANING,
    chi2_tail,
    geometric_lags,
    ljung_box,
    moment_test,
    residual_tests,
)

N = 800


def inputs(rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Two commands in steps of 0.16 s at 50 Hz, with several levels."""
    return {name: np.repeat(rng.uniform(-1, 1, N // 8), 8)[:N] for name in ("u_v", "u_h")}


def response(u: dict[str, np.ndarray], e: np.ndarray) -> np.ndarray:
    return lfilter([0.0, 0.1], [1.0, -0.9], u["u_v"] + 0.5 * u["u_h"]) + e


@pytest.mark.parametrize("noise", ["white", "coloured, whitened by the tests"])
def test_false_alarms_in_the_whole_family_come_at_the_nominal_rate(noise):
    """The residuals of the very model that made the data; Holm is a bound, not an equality."""
    seeds, alarms = 200, 0
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        u, e = inputs(rng), rng.standard_normal((2, N))
        if noise != "white":
            e = lfilter([1.0], [1.0, -0.5], e)
        y = {"alpha_v": response(u, e[0]), "alpha_h": response(u, e[1])}
        tests = residual_tests({"alpha_v": e[0], "alpha_h": e[1]}, u, y, lags=10, longest_lag=30)
        failed = tests.failures()
        if noise != "white":
            failed = [test for test in failed if test.kind not in ("auto", "ljung_box")]
        alarms += bool(failed)
    low, high = binom.interval(0.999, seeds, 0.05)
    assert alarms <= high
    assert noise != "white" or alarms >= max(1, low)


DEFECTS = {
    "auto": lambda rng, u, e: lfilter([1.0, 0.4], [1.0], e),
    "input": lambda rng, u, e: e + 0.4 * np.roll(u["u_v"], 2),
    "square": lambda rng, u, e: e + 1.0 * np.roll(u["u_v"], 1) ** 2,
    "product": lambda rng, u, e: e + 0.8 * np.roll(u["u_v"] * u["u_h"], 1),
    "bilinear": lambda rng, u, e: e + 0.6 * np.roll(e * u["u_h"], 1),
    "square_square": lambda rng, u, e: e * (0.5 + 1.5 * np.roll(u["u_h"], 1) ** 2),
    "mean": lambda rng, u, e: e + 0.3,
}


@pytest.mark.parametrize("kind", DEFECTS)
def test_each_defect_is_found_by_its_own_test_and_even_ones_by_no_linear_correlation(kind):
    """The latter is why there are nonlinear tests at all."""
    found = missed = 0
    for seed in range(10):
        rng = np.random.default_rng(seed)
        u, e = inputs(rng), rng.standard_normal(N)
        residual = DEFECTS[kind](rng, u, e)
        residual[:3] = e[:3]
        y = response(u, residual)
        tests = residual_tests({"alpha_v": residual}, u, {"alpha_v": y}, lags=10, longest_lag=30)
        kinds = {test.kind for test in tests.failures()}
        found += kind in kinds
        missed += "input" not in kinds
    assert found >= 8
    assert missed >= 8 or kind not in ("square", "product")


def test_every_kind_has_its_meaning_and_every_name_is_unique():
    rng = np.random.default_rng(0)
    u, e = inputs(rng), rng.standard_normal((2, N))
    y = {"alpha_v": response(u, e[0]), "alpha_h": response(u, e[1])}
    tests = residual_tests(dict(zip(y, e, strict=True)), u, y)
    assert {test.kind for test in tests.tests} == set(MEANING)
    assert len({(test.channel, test.name) for test in tests.tests}) == len(tests.tests)
    # An input that never moves has none.
    u["u_h"] = np.ones(N)
    tests = residual_tests({"alpha_v": e[0]}, u, {"alpha_v": response(u, e[0])})
    assert {name for test in tests.tests for name in test.inputs} == {"u_v"}


def test_lags_grow_geometrically():
    lags = geometric_lags(100)
    assert lags[:4] == [1, 2, 3, 4] or lags[:3] == [1, 2, 3]
    assert lags == sorted(set(lags)) and lags[-1] <= 100 and len(lags) < 15


SEEDS = 300


@pytest.mark.parametrize("case", ["constant spread", "it follows the input", "feedback"])
def test_p_values_are_uniform_for_any_input_and_spread(case):
    p = []
    for seed in range(SEEDS):
        rng = np.random.default_rng(seed)
        # Neighbours resemble each other, as every command's do.
        u, e = lfilter([1.0], [1.0, -0.97], rng.standard_normal(1500)), rng.standard_normal(1500)
        if case == "it follows the input":
            e[1:] *= 0.3 + np.abs(u[:-1])
        elif case == "feedback":
            u = lfilter([0.0, 1.0], [1.0, -0.9], e)  # of the output, noise and all
        p.append(moment_test(e, u, [1, 2, 3, 5, 8, 13, 20]).p_value)
    assert kstest(p, "uniform").pvalue > 1e-3


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
