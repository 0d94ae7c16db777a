"""Metrics are what their formulas say, of errors, of steps and of innovations."""

import math

import numpy as np
import pytest
import scipy.signal
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from trms_cli.composition.composer import compose
from trms_cli.core.plugins import build
from trms_cli.scoring import metrics
from trms_cli.scoring.metrics import (
    LAGS,
    chi_square_interval,
    chi_square_tail,
    holds,
    joint_p,
    nees,
    steady_state_error,
    steps,
    whiteness_p,
)

from .conftest import second_order

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


TIME = np.arange(0, 30, 0.002)
sizes = st.floats(0.05, 2.0).flatmap(lambda a: st.sampled_from([a, -a]))


@given(st.floats(0.1, 2.0), sizes, st.floats(-1, 1), st.floats(1.0, 5.0))
def test_a_first_order_response(tau, size, offset, start):
    start = round(start / 0.002) * 0.002
    after = np.maximum(TIME - start, 0.0)
    reference = offset + np.where(start - 1e-9 <= TIME, size, 0.0)
    response = offset + size * (1 - np.exp(-after / tau))
    (step,) = steps(TIME, reference, response)
    assert step.overshoot_percent == 0.0
    assert step.rise_time == pytest.approx(tau * math.log(9), abs=2e-3)
    assert step.settling_time == pytest.approx(tau * math.log(50), abs=5e-3)
    assert steady_state_error(TIME, reference, response) < abs(size) * 1e-3


@given(st.floats(0.3, 0.85), st.floats(1.0, 6.0), sizes, st.floats(-1, 1), st.floats(1.0, 5.0))
def test_a_second_order_response(damping, frequency, size, offset, start):
    start = round(start / 0.002) * 0.002

    def step_of(size: float, offset: float, start: float) -> metrics.StepMetrics:
        reference = offset + np.where(start - 1e-9 <= TIME, size, 0.0)
        response = offset + size * second_order(TIME - start, damping, frequency)
        (step,) = steps(TIME, reference, response)
        return step

    step, unit = step_of(size, offset, start), step_of(1.0, 0.0, 2.0)
    root = math.sqrt(1 - damping**2)
    expected = 100 * math.exp(-math.pi * damping / root)
    assert step.overshoot_percent == pytest.approx(expected, abs=0.01)
    # the envelope settles no earlier
    assert step.settling_time <= -math.log(0.02 * root) / (damping * frequency) + 0.01
    assert 0.5 / frequency < step.rise_time < 3.5 / frequency
    # size, sign, offset and start do not matter
    assert step.rise_time == pytest.approx(unit.rise_time, abs=5e-3)
    assert step.settling_time == pytest.approx(unit.settling_time, abs=5e-3)


def square(half: float, count: int) -> tuple[np.ndarray, np.ndarray]:
    time = np.arange(round(half * count * 100)) * 0.01
    return time, np.where(np.floor(time / half + 1e-9) % 2 == 0, 0.3, -0.3)


def test_a_square_has_a_step_at_each_edge_and_one_at_the_start_of_the_run():
    time, reference = square(5.0, 4)
    lagged = np.concatenate([np.zeros(1), reference[:-1]])
    found = steps(time, reference, lagged)
    assert len(found) == 4
    assert [step.settling_time for step in found] == pytest.approx([0.01] * 4)
    # a rig that is where the first hold wants it makes no step of the begin
    assert len(steps(time, reference, np.concatenate([[0.3], reference[:-1]]))) == 3


def test_what_never_arrives_is_infinitely_slow_and_a_hold_cut_short_not_judged():
    time, reference = square(5.0, 2)
    stuck = steps(time, reference, np.zeros(time.size))
    assert all(math.isinf(step.settling_time) and math.isinf(step.rise_time) for step in stuck)
    assert all(step.overshoot_percent == 0 for step in stuck[:1])
    assert steady_state_error(time, reference, np.zeros(time.size)) == pytest.approx(0.3)
    time, reference = square(5.0, 3)
    keep = time < 10.5
    assert len(steps(time[keep], reference[keep], np.zeros(keep.sum()))) == 2


def test_a_response_that_leaves_the_band_once_more_has_not_settled_before():
    time = np.arange(0, 10, 0.01)
    reference = np.where(time >= 1.0, 1.0, 0.0)
    response = reference.copy()
    response[600:650] = 1.03
    (step,) = steps(time, reference, response)
    assert step.settling_time == pytest.approx(time[650] - time[100])
    response[600:650] = 1.019
    (step,) = steps(time, reference, response)
    assert step.settling_time == 0.0


@pytest.mark.parametrize("kind", ["sine", "ramp", "sawtooth", "prbs", "shaped"])
def test_references_that_only_move_have_no_steps(kind):
    time = np.arange(0, 20, 0.01)
    reference = {
        "sine": 0.5 * np.sin(time),
        "ramp": np.clip(0.1 * (time - 3), 0, 1.0),
        "sawtooth": 0.2 * (time % 5),
        "prbs": np.where(np.random.default_rng(1).random(40) < 0.5, 0.1, -0.1).repeat(50),
        "shaped": np.clip(0.9 * (time - 3), 0, 0.3),
    }[kind]
    if kind == "prbs":
        reference[1::100] += 0.05  # no two bits alike for a second
    assert steps(time, reference, np.full(time.size, reference[0])) == []
    at_rest = bool(holds(time, reference))
    error = steady_state_error(time, reference, np.zeros(time.size))
    assert math.isnan(error) != at_rest


#: Steps of pitch in a minute from a rest at −0.62 rad, by what configs/signal says of each.
STEPS_OF_A_MINUTE = {
    "constant": 1,  # the rise from rest
    "square": 3,  # the rise, and edges at 20 and 40 s
    "per_axis": 3,
    "step": 1,  # at 1 s; what the reference waits for until then is no step
    "schedule": 1,  # at 1 s; a sine from 20 s on
    "ramp": 0,
    "sawtooth": 0,
    "sine": 0,
    "chirp": 0,
    "multisine": 0,
    "sum": 0,
    "prbs": None,  # one where two bits differ; counted from the sequence
    "multilevel": None,
}
LAG, BIAS = 0.1, 0.004  # s, rad


@pytest.mark.parametrize("kind", STEPS_OF_A_MINUTE)
def test_references_of_all_kinds_score_as_a_lag_with_a_bias(kind):
    time = np.arange(0, 60, 0.002)
    signal = build(compose([f"ref={kind}"]).config["ref"], "ref").alpha_v
    reference = np.asarray(signal.sample(time))
    keep = math.exp(-0.002 / LAG)
    start, response = -0.62, np.empty_like(reference)
    response[0] = start
    for k in range(time.size - 1):
        response[k + 1] = keep * response[k] + (1 - keep) * reference[k]
    scored = steps(time, reference, response)
    count = STEPS_OF_A_MINUTE[kind]
    if count is None:
        judged = time[1:] < 59.0  # what is held for less than a second is no hold
        count = 1 + np.count_nonzero((np.abs(np.diff(reference)) > 1e-9) & judged)
    assert len(scored) == count
    for step in scored:
        assert step.overshoot_percent == pytest.approx(0.0, abs=0.1)
        assert step.rise_time == pytest.approx(LAG * math.log(9), abs=3e-3)
        assert step.settling_time == pytest.approx(LAG * math.log(50), abs=5e-3)
    steady = steady_state_error(time, reference, response + BIAS)
    rests = count > 0 or kind == "ramp"
    assert steady == pytest.approx(BIAS, abs=1e-4) if rests else math.isnan(steady)


@pytest.mark.parametrize(("first", "is_step"), [(1.0, False), (9.9, False), (10.0, True)])
def test_a_first_level_is_a_step_if_it_lasts_as_long_as_another_and_else_a_wait(first, is_step):
    time = np.arange(0, first + 25, 0.01)
    levels = [(time >= first + 15 - 1e-9), (time >= first - 1e-9)]  # held 10 and 15 s
    reference = np.select(levels, [0.1, 0.3], -0.3)
    response = np.where(levels[1], reference, -0.6)  # first at rest
    assert len(holds(time, reference)) == 3
    assert len(steps(time, reference, response)) == (3 if is_step else 2)
    expected = 0.3 if is_step else 0.0
    assert steady_state_error(time, reference, response) == pytest.approx(expected, abs=1e-9)


def test_noise_and_the_end_of_a_coarse_ramp_are_no_steps():
    time = np.arange(0, 10, 0.01)
    noise = np.random.default_rng(0).normal(0, 2e-3, time.size)
    assert steps(time, np.zeros(time.size), noise) == []
    assert steady_state_error(time, np.zeros(time.size), noise) < 1e-3
    time = np.arange(0, 20, 0.1)
    reference = np.clip(0.2 * (time - 3), 0, 1.0)
    assert steps(time, reference, reference) == []


def test_missing_samples_are_stepped_over():
    reference = np.where(TIME >= 2.0, 1.0, 0.0)
    response = second_order(TIME - 2.0, 0.6, 2.0)
    (whole,) = steps(TIME, reference, response)
    response[np.arange(TIME.size) % 5 > 0] = np.nan
    (sparse,) = steps(TIME, reference, response)
    assert sparse.overshoot_percent == pytest.approx(whole.overshoot_percent, abs=0.1)
    assert sparse.rise_time == pytest.approx(whole.rise_time, abs=0.01)
    assert sparse.settling_time == pytest.approx(whole.settling_time, abs=0.02)
    assert steps(TIME, reference, np.full(TIME.size, np.nan)) == []
    assert steps(TIME, np.full(TIME.size, np.nan), response) == []
    assert steps(np.zeros(1), np.zeros(1), np.zeros(1)) == []


def test_the_steady_state_error_is_that_of_the_worst_hold():
    time, reference = square(5.0, 4)
    response = reference - np.where(time >= 15.0, -0.02, 0.01)
    assert steady_state_error(time, reference, response) == pytest.approx(0.02)


@given(st.floats(0, 2000), st.sampled_from([1, 2, 3, 4, 9, 10, 20, 50]))
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
    rho = np.correlate(centred, centred, "full")[n:] / (centred @ centred)
    total = sum(rho[lag - 1] ** 2 / (n - lag) for lag in range(1, LAGS + 1))
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
    white = np.random.default_rng(7).normal(size=3000)
    assert whiteness_p(scipy.signal.lfilter([1.0], [1.0, -correlation], white)) < 1e-4


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


def test_the_mean_nees_is_the_number_of_states_also_for_correlated_ones():
    rng = np.random.default_rng(1)
    mixing = np.array([[1.0, 0.0, 0.0], [0.9, 0.3, 0.0], [0.5, 0.2, 2.0]])
    error = rng.normal(size=(200_000, 3)) @ mixing.T
    deviation = np.broadcast_to(np.linalg.norm(mixing, axis=1), error.shape)
    assert np.mean(nees(error, deviation)) == pytest.approx(3.0, rel=0.02)
    assert np.mean(nees(2 * error, deviation)) == pytest.approx(12.0, rel=0.02)
