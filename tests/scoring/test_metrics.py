"""Metrics are what their formulas say, on signals whose metrics are known on paper."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from trms_cli.scoring import metrics

signals = hnp.arrays(float, st.integers(2, 60), elements=st.floats(-10, 10, width=32))
FINE = np.arange(0, 20, 0.001)


def clock(values: np.ndarray) -> np.ndarray:
    return np.arange(values.size) * 0.1


@given(st.floats(0.1, 2.0), st.floats(0.1, 2.0))
def test_integrals_of_an_exponential_error(amplitude: float, tau: float) -> None:
    error = amplitude * np.exp(-FINE / tau)
    left = math.exp(-20 / tau)  # of the tail beyond the record
    assert metrics.iae(FINE, error) == pytest.approx(amplitude * tau * (1 - left), rel=1e-4)
    assert metrics.ise(FINE, error) == pytest.approx(
        amplitude**2 * tau / 2 * (1 - left**2), rel=1e-4
    )
    weighted = amplitude * tau**2 * (1 - left * (1 + 20 / tau))
    assert metrics.itae(FINE, error) == pytest.approx(weighted, rel=1e-3)


def test_a_sine_has_the_rmse_and_integrals_of_a_sine() -> None:
    sine = 0.3 * np.sin(2 * np.pi * FINE)
    assert metrics.rmse(sine) == pytest.approx(0.3 / math.sqrt(2), rel=1e-6)
    assert metrics.iae(FINE, sine) == pytest.approx(0.3 * 2 / math.pi * 20, rel=1e-3)
    assert metrics.max_abs_error(sine) == pytest.approx(0.3, rel=1e-5)


@given(signals, st.floats(0.1, 10), st.floats(-100, 100))
def test_metrics_scale_with_the_error_and_the_clock_may_start_anywhere(error, factor, shift):
    time = clock(error)
    for power, metric in (
        (1, lambda e: metrics.rmse(e)),
        (1, lambda e: metrics.max_abs_error(e)),
        (1, lambda e: metrics.iae(time, e)),
        (2, lambda e: metrics.ise(time, e)),
        (1, lambda e: metrics.itae(time, e)),
        (2, lambda e: metrics.input_effort(time, e)),
        (1, lambda e: metrics.total_variation(e)),
    ):
        base = metric(error)
        assert metric(-factor * error) == pytest.approx(factor**power * base, rel=1e-9, abs=1e-12)
    for metric in (metrics.iae, metrics.ise, metrics.itae, metrics.input_effort):
        assert metric(time + shift, error) == pytest.approx(metric(time, error), abs=1e-9)


@given(signals)
def test_orders_between_metrics_whatever_the_rate_of_the_sensor(error: np.ndarray) -> None:
    time = clock(error)
    assert metrics.rmse(error) <= metrics.max_abs_error(error) * (1 + 1e-12)
    # Cauchy–Schwarz, which the trapezoidal sums inherit
    assert metrics.iae(time, error) ** 2 <= time[-1] * metrics.ise(time, error) * (1 + 1e-9) + 1e-12
    # a slower sensor does not change what is integrated
    sparse = np.full(3 * error.size, np.nan)
    sparse[::3] = error
    dense_time = np.arange(sparse.size) * (0.1 / 3)
    assert metrics.rmse(sparse) == pytest.approx(metrics.rmse(error))
    assert metrics.iae(dense_time, sparse) == pytest.approx(metrics.iae(time, error), abs=1e-9)


def test_a_command_is_held_between_samples_and_saturates_at_either_limit() -> None:
    time = np.array([0.0, 1.0, 3.0])
    assert metrics.input_effort(time, np.array([1.0, 2.0, 99.0])) == 1.0 + 4.0 * 2
    assert metrics.total_variation(np.array([0.0, 1.0, -1.0, -1.0])) == 3.0
    command = np.array([-2.5, -2.5 + 1e-7, 0.0, 2.4, 2.5, 2.6, np.nan])
    assert metrics.saturation_share(command, -2.5, 2.5) == pytest.approx(4 / 6)
    assert metrics.saturation_share(command, -math.inf, math.inf) == 0.0
    np.testing.assert_allclose(
        metrics.excess(command, -2.4, 2.5), [0.1, 0.1, 0, 0, 0, 0.1], atol=1e-6
    )


def test_what_does_not_exist_is_nan() -> None:
    nothing = np.full(5, np.nan)
    assert math.isnan(metrics.rmse(nothing))
    assert math.isnan(metrics.max_abs_error(np.zeros(0)))
    assert math.isnan(metrics.iae(clock(nothing), nothing))
    assert math.isnan(metrics.itae(np.zeros(0), np.zeros(0)))
    assert math.isnan(metrics.input_effort(np.zeros(1), np.zeros(1)))
    assert math.isnan(metrics.total_variation(nothing))
    assert math.isnan(metrics.saturation_share(nothing, -1, 1))
