"""Multiplicity, whitening, metrics, regions, block bootstrap, spectra, characteristics."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import signal
from scipy.stats import binom, false_discovery_control, kstest

from trms_cli.identification.validation.findings import worst_quarter
from trms_cli.identification.validation.metrics import (
    BlockSums,
    autocorrelation,
    characteristics,
    coherence,
    fit_percent,
    mean_log_ratio,
    ratio_interval,
    region_tables,
    reverse_arrangements,
    rms,
    rms_interval,
    segments_of,
    spectrum,
    vaf_percent,
)
from trms_cli.identification.validation.residual_tests import (
    benjamini_hochberg,
    holm,
    whiten_residual,
)

p_values = st.lists(st.floats(0.0, 1.0), min_size=1, max_size=12)


class TestMultiplicity:
    @given(p_values)
    def test_benjamini_hochberg_is_scipys(self, p):
        assert benjamini_hochberg(p) == pytest.approx(false_discovery_control(p))

    @given(p_values)
    def test_holm_lies_between_the_p_values_and_bonferroni(self, p):
        adjusted = holm(p)
        assert np.all(adjusted >= np.array(p) - 1e-15)
        assert np.all(adjusted <= np.minimum(1.0, len(p) * np.array(p)) + 1e-15) or np.all(
            np.diff(adjusted[np.argsort(p, kind="stable")]) >= 0
        )
        assert min(adjusted) == pytest.approx(min(1.0, len(p) * min(p)))

    def test_holm_by_hand_and_what_could_not_be_tested_does_not_count(self):
        assert holm([0.01, 0.04, 0.03]) == pytest.approx([0.03, 0.06, 0.06])
        assert holm([np.nan, 0.02]) == pytest.approx([np.nan, 0.02], nan_ok=True)
        assert np.isnan(benjamini_hochberg([np.nan])).all()


class TestWhitening:
    def test_takes_an_autoregression_out(self):
        rng = np.random.default_rng(0)
        e = rng.standard_normal(4000)
        white, order = whiten_residual(signal.lfilter([1.0], [1.0, -0.8, 0.3], e), 20)
        assert order == 2
        assert white[100:] == pytest.approx(e[100:], abs=0.15)

    def test_leaves_white_as_it_is(self):
        orders = [
            whiten_residual(np.random.default_rng(s).standard_normal(800))[1] for s in range(40)
        ]
        assert sum(order == 0 for order in orders) >= 36

    def test_missing_samples_spread_no_further_than_the_order(self):
        rng = np.random.default_rng(1)
        e = signal.lfilter([1.0], [1.0, -0.8], rng.standard_normal(3000))
        e[1000] = np.nan
        white, order = whiten_residual(e, 5)
        assert np.isnan(white[1000 : 1001 + order]).all()
        assert not np.isnan(white[1001 + order :]).any()


class TestMetrics:
    def test_no_error_is_a_hundred_percent_and_the_mean_none(self):
        y = np.random.default_rng(0).standard_normal(200)
        assert fit_percent(0 * y, y) == vaf_percent(0 * y, y) == 100.0
        assert fit_percent(y - y.mean(), y) == pytest.approx(0.0)
        # Only FIT counts a constant error.
        assert vaf_percent(0 * y + 0.5, y) == 100.0
        assert fit_percent(0 * y + 0.5, y) < 60.0

    def test_missing_and_overflown(self):
        assert rms(np.array([3.0, np.nan, 4.0])) == pytest.approx(np.sqrt(12.5))
        assert np.isnan(rms(np.full(3, np.nan)))
        assert rms(np.array([1e200, 1.0])) == np.inf
        assert np.isnan(fit_percent(np.ones(5), np.ones(5)))


class TestRegions:
    def test_finds_where_the_error_lies(self):
        rng = np.random.default_rng(0)
        x = rng.uniform(-1, 1, 8000)
        error = np.where(x > 0.5, 5.0, 1.0) * rng.standard_normal(8000)
        (table,) = region_tables({"pitch": error}, {"x": x})
        low, high, time, share = worst_quarter(vars(table))
        assert low == pytest.approx(0.5, abs=0.05) and high == pytest.approx(1.0, abs=0.05)
        assert time == pytest.approx(0.25, abs=0.01) and share > 0.85
        assert table.error_share.sum() == pytest.approx(1.0)
        # What does not move tells nothing.
        assert region_tables({"pitch": np.ones(500)}, {"x": np.ones(500)}) == []


class TestBlocks:
    def test_the_interval_covers_the_truth_at_its_rate(self):
        """Forty blocks of normal errors: the RMS is known."""
        covered, trials = 0, 150
        for seed in range(trials):
            e = np.random.default_rng(seed).standard_normal((40, 25))
            sums = BlockSums((e**2).sum(axis=1), np.full(40, 25.0))
            interval = rms_interval(sums, seed)
            covered += interval.lower <= 1.0 <= interval.upper
        assert covered >= binom.ppf(1e-3, trials, 0.92)
        # Few blocks have none.
        assert np.isnan(rms_interval(BlockSums(np.ones(3), np.ones(3)), 0).lower)

    def test_pairing_sees_what_is_common_to_both(self):
        rng = np.random.default_rng(0)
        common = rng.uniform(0.1, 10.0, 30)
        one, other = BlockSums(common, np.ones(30)), BlockSums(1.21 * common, np.ones(30))
        interval = ratio_interval(one, other, 0)
        assert interval.value == pytest.approx(1 / 1.1)
        assert (interval.lower, interval.upper) == pytest.approx((1 / 1.1, 1 / 1.1))
        assert mean_log_ratio({("a", 1.0): one}, {("a", 1.0): other}, 0).upper < 1.0


class TestSpectra:
    def test_spectrum_and_coherence_are_scipys(self):
        rng = np.random.default_rng(0)
        x = rng.standard_normal(4096)
        f, density = signal.welch(x, 50.0, "hann", 256, 128, detrend="constant")
        ours = spectrum(segments_of(x, 0.02, 256))
        assert ours.frequencies == pytest.approx(f[1:])
        # the last frequency has no negative twin; scipy halves it
        assert ours.density[:-1] == pytest.approx(density[1:-1])
        y = signal.lfilter([1.0, 0.5], [1.0, -0.5], x) + rng.standard_normal(4096)
        _, c = signal.coherence(x, y, 50.0, "hann", 256, 128, detrend="constant")
        ours = coherence(segments_of(x, 0.02, 256), segments_of(y, 0.02, 256))
        assert ours.squared == pytest.approx(c[1:])

    def test_bands_hold_at_their_rate(self):
        inside, chance, of = 0, 0, 0
        for seed in range(40):
            x, y = np.random.default_rng(seed).standard_normal((2, 4096))
            a, b = segments_of(x, 1.0, 128), segments_of(y, 1.0, 128)
            s = spectrum(a)
            # every third frequency: neighbours share the window's width
            density = s.density[2:-2:3]
            inside += np.count_nonzero((density * s.lower <= 2.0) & (density * s.upper >= 2.0))
            c = coherence(a, b)
            chance += np.count_nonzero(c.squared[2:-2:3] > c.by_chance)
            of += len(density)
        assert inside / of == pytest.approx(0.95, abs=0.02)
        assert chance / of == pytest.approx(0.05, abs=0.02)

    def test_segments_with_a_missing_sample_are_left_out(self):
        x = np.random.default_rng(0).standard_normal(1024)
        whole = spectrum(segments_of(x, 1.0, 128)).segments
        x[500] = np.nan
        assert spectrum(segments_of(x, 1.0, 128)).segments == whole - 2


class TestCharacteristics:
    def test_of_a_sine(self):
        t = np.arange(3000) * 0.02
        c = characteristics("y", "rad", 0.3 + np.sin(2 * np.pi * 0.5 * t), 0.02)
        assert c.mean == pytest.approx(0.3, abs=1e-3)
        assert c.sd == pytest.approx(np.sqrt(0.5), rel=1e-3)
        assert c.skewness == pytest.approx(0.0, abs=1e-2)
        assert c.kurtosis == pytest.approx(1.5, rel=1e-2)
        assert c.peak_frequency == pytest.approx(0.5, abs=0.05)
        # cos falls below 1/e at 1.194 rad
        assert c.correlation_time == pytest.approx(1.194 / np.pi, abs=0.03)

    def test_autocorrelation_in_spite_of_missing_samples(self):
        rng = np.random.default_rng(0)
        x = signal.lfilter([1.0], [1.0, -0.9], rng.standard_normal(20000))
        x[rng.random(20000) < 0.2] = np.nan
        assert autocorrelation(x)[:4] == pytest.approx(0.9 ** np.arange(4), abs=0.03)

    def test_reverse_arrangements_find_a_trend_and_are_calibrated(self):
        assert reverse_arrangements(np.arange(20.0)) < 1e-6
        p = [reverse_arrangements(np.random.default_rng(s).standard_normal(20)) for s in range(300)]
        assert kstest(p, "uniform").pvalue > 1e-3

    @pytest.mark.parametrize("values", [np.ones(200), np.full(200, np.nan)])
    def test_nothing_to_say(self, values):
        c = characteristics("y", "rad", values, 0.02)
        assert np.isnan(c.correlation_time) and np.isnan(c.trend_of_mean)
