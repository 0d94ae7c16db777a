"""Step metrics against the textbook's first- and second-order responses."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trms_cli.scoring.metrics import holds, steady_state_error, steps

TIME = np.arange(0, 30, 0.002)
sizes = st.floats(0.05, 2.0).flatmap(lambda a: st.sampled_from([a, -a]))


def second_order(time: np.ndarray, damping: float, frequency: float) -> np.ndarray:
    """Unit step response at time ≥ 0, 0 before."""
    root = math.sqrt(1 - damping**2)
    after = np.maximum(time, 0.0)
    phase = frequency * root * after
    decay = np.exp(-damping * frequency * after)
    return 1 - decay * (np.cos(phase) + damping / root * np.sin(phase))


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


@given(st.floats(0.3, 0.85), st.floats(1.0, 6.0), sizes, st.floats(-1, 1))
def test_a_second_order_response(damping, frequency, size, offset):
    reference = offset + np.where(TIME >= 2.0 - 1e-9, size, 0.0)
    response = offset + size * second_order(TIME - 2.0, damping, frequency)
    (step,) = steps(TIME, reference, response)
    root = math.sqrt(1 - damping**2)
    expected = 100 * math.exp(-math.pi * damping / root)
    assert step.overshoot_percent == pytest.approx(expected, abs=0.01)
    # the envelope settles no earlier
    assert step.settling_time <= -math.log(0.02 * root) / (damping * frequency) + 0.01
    assert 0.5 / frequency < step.rise_time < 3.5 / frequency


@given(st.floats(0.3, 0.85), sizes)
def test_size_sign_offset_and_start_do_not_matter(damping, size):
    def metrics_of(size: float, offset: float, start: float) -> tuple[float, ...]:
        reference = offset + np.where(start - 1e-9 <= TIME, size, 0.0)
        response = offset + size * second_order(TIME - start, damping, 2.0)
        (step,) = steps(TIME, reference, response)
        return step.overshoot_percent, step.rise_time, step.settling_time

    assert metrics_of(size, 0.3, 4.0) == pytest.approx(metrics_of(1.0, 0.0, 2.0), abs=5e-3)


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
