"""What readings alone tell: samples that were lost, and what is not taken for it."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trms_cli.gap.sensor_marks import repeated_readings, with_marked_sensors

TIME = 0.02 * np.arange(4000)
QUANTUM = 1e-3


def motion(speed: float, seed: int) -> np.ndarray:
    random = np.random.default_rng(seed)
    phases = random.uniform(0, 2 * np.pi, 5)
    lines = random.uniform(0.1, 1.5, 5)
    return speed * np.sin(2 * np.pi * np.outer(TIME, lines) + phases).sum(axis=1)


def rounded(values: np.ndarray) -> np.ndarray:
    return QUANTUM * np.round(values / QUANTUM)


def lost(values: np.ndarray, share: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Readings shown again, and which."""
    shown, random = values.copy(), np.random.default_rng(seed)
    is_lost = random.uniform(size=len(values)) < share
    is_lost[0] = False
    for k in np.flatnonzero(is_lost):
        shown[k] = shown[k - 1]
    return shown, is_lost


def nobody_sees(shown: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Readings of runs of equal ones in which the motion turns, or is four steps a sample at most.

    And of one with which the recording ends.
    """
    result = np.zeros(len(values), dtype=bool)
    edges = np.flatnonzero(np.diff(shown, prepend=np.nan, append=np.nan))
    for begin, after in itertools.pairwise(edges):
        steps = np.diff(values[max(begin - 1, 0) : after + 1])
        is_slow = np.abs(steps[-(after - begin) :].mean()) < 4 * QUANTUM
        result[begin:after] = after == len(values) or is_slow or np.ptp(np.sign(steps)) > 0
    return result


@settings(max_examples=30, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    share=st.floats(0.02, 0.6),
    is_rounded=st.booleans(),
)
def test_the_share_of_lost_readings_is_that_which_was_lost(seed, share, is_rounded) -> None:
    values = motion(1.0, seed)
    shown, is_lost = lost(rounded(values) if is_rounded else values, share, seed + 1)
    marked, estimate = repeated_readings(shown)
    assert estimate == pytest.approx(is_lost.mean(), abs=4 * np.sqrt(share / len(values)) + 0.01)
    # what is left is what was there, or about that where nobody sees more: in one of a hundred
    # draws, up to 6 readings of 4000 are off by as much
    wrong = ~marked & (np.abs(shown - values) >= 12 * QUANTUM)
    assert not (wrong & ~nobody_sees(shown, values)).any()
    assert wrong.sum() <= 0.004 * len(values)


@settings(max_examples=30, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    speed=st.sampled_from([0.003, 0.03, 0.3, 3.0]),
    noise=st.sampled_from([0.0, 0.3, 1.0, 5.0]),
)
def test_coarse_steps_and_noise_are_no_loss(seed, speed, noise) -> None:
    random = np.random.default_rng(seed + 1)
    values = motion(speed, seed) + noise * QUANTUM * random.standard_normal(len(TIME))
    marked, share = repeated_readings(rounded(values))
    assert share == 0.0 and not marked.any()


def test_what_sticks_and_slips_is_no_loss() -> None:
    values = rounded(np.repeat(motion(1.0, 3)[::40], 40) + 0.0)
    moving = np.minimum(np.arange(len(TIME)) % 40, 20) / 20
    values = rounded(values + moving * 0.5)
    assert repeated_readings(values)[1] == 0.0


def test_a_sensor_that_never_moves_or_was_never_read_has_lost_nothing() -> None:
    for values in (np.zeros(50), np.full(50, np.nan)):
        marked, share = repeated_readings(values)
        assert share == 0.0 and not marked.any()


def test_a_marked_sensor_is_part_of_every_answer_but_that_of_no_name() -> None:
    before = {("no_gap",): 0.5, ("u_lag",): 0.3, ("none_of_these",): 0.2}
    after = with_marked_sensors(before, ["y_dropout"])
    assert sum(after.values()) == pytest.approx(1.0)
    assert after["y_dropout",] == pytest.approx(0.475)
    assert after["u_lag", "y_dropout"] == pytest.approx(0.285)
    assert after["none_of_these",] == 0.2
