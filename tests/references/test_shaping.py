"""A shaped reference keeps its limits, arrives, and does not depend on who asks."""

import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trms_cli.core.errors import ConfigurationError
from trms_cli.references.constant import Constant
from trms_cli.references.prbs import Prbs
from trms_cli.references.shaping import GRID, Shaping
from trms_cli.references.signal import Array
from trms_cli.references.sine import Sine
from trms_cli.references.square import Square
from trms_cli.references.step import Step

from .conftest import needs_planner

pytestmark = needs_planner

limit = st.one_of(st.none(), st.floats(0.05, 20.0))
limits = st.tuples(limit, limit, limit).filter(any)


def shaping(given: tuple[float | None, float | None, float | None], **more: float) -> Shaping:
    return Shaping(max_rate=given[0], max_acceleration=given[1], max_jerk=given[2], **more)


@settings(max_examples=60)
@given(
    limits, st.sampled_from(["square", "prbs", "sine"]), st.floats(0.01, 1.0), st.floats(-0.5, 0.5)
)
def test_limits_are_kept(given_limits, kind, amplitude, initial):
    signal = {
        "square": Square(amplitude=amplitude, frequency=0.3),
        "prbs": Prbs(amplitude=amplitude, hold=0.37, bits=6),
        "sine": Sine(amplitude=amplitude, frequency=0.5),
    }[kind]
    shaped = shaping(given_limits, initial=initial).apply(signal)
    # every second point of the grid: the differences of any motion within the limits are too
    step = 2 * GRID
    values = shaped.sample(np.arange(3000) * step)
    assert values[0] == initial
    for order, bound in enumerate(given_limits, start=1):
        if bound is not None:
            # rounding of the positions, 1e-15, is divided by a power of the step
            slack = 1e-6 * bound + 2**order * 2e-15 / step**order
            assert np.max(np.abs(np.diff(values, order))) / step**order <= bound + slack


@settings(max_examples=60)
@given(limits, st.floats(-1.0, 1.0), st.floats(-1.0, 1.0))
def test_a_constant_target_is_reached_without_overshoot(given_limits, target, initial):
    shaped = shaping(given_limits, initial=initial).apply(Constant(offset=target))
    values = shaped.sample(np.arange(0, 60, 0.01))
    assert values[-1] == pytest.approx(target, abs=1e-9)
    direction = np.sign(target - initial)
    assert np.all(np.diff(values) * direction >= -1e-9)
    assert np.all((target - values) * direction >= -1e-9)


def test_a_step_takes_the_least_time_there_is():
    # bang-bang: a distance d within the acceleration a takes 2·sqrt(d/a)
    shaped = Shaping(max_acceleration=0.5).apply(Constant(offset=0.5))
    times = np.arange(0, 4, GRID)
    arrival = times[np.argmax(shaped.sample(times) >= 0.5 - 1e-9)]
    assert arrival == pytest.approx(2.0, abs=2 * GRID)


def test_a_slow_signal_is_followed_closely():
    signal = Sine(amplitude=0.3, frequency=0.05)
    times = np.arange(0, 40, 0.01)
    rate_only = Shaping(max_rate=0.5).apply(signal)
    np.testing.assert_allclose(rate_only.sample(times), signal.sample(times), atol=1e-9)
    # at the distance that is needed for stopping: v²/2a
    shaped = Shaping(max_acceleration=1.0).apply(signal)
    largest_rate = 0.3 * 2 * np.pi * 0.05
    error = np.abs(shaped.sample(times) - signal.sample(times))
    assert np.max(error) < 1.1 * largest_rate**2 / 2


@settings(max_examples=20)
@given(st.lists(st.floats(-1.0, 30.0), min_size=1, max_size=8))
def test_the_answer_does_not_depend_on_what_was_asked_before(times):
    shape = Shaping(max_rate=0.5, max_acceleration=1.0, max_jerk=5.0)
    signal = Square(amplitude=0.3, frequency=0.1)
    together = shape.apply(signal).sample(np.array(times))
    one_by_one = shape.apply(signal)
    np.testing.assert_array_equal([one_by_one.sample(np.array([t]))[0] for t in times], together)
    assert shape.apply(signal).sample(np.zeros(0)).shape == (0,)


def test_a_shaped_signal_begins_where_it_is_told_to_and_travels_to_another_process():
    shaped = Shaping(max_rate=0.5, max_jerk=3.0).apply(Step(amplitude=0.3))
    times = np.arange(0, 3, 0.1)
    before = shaped.sample(times)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(shaped)).sample(times), before)
    signal = Constant(offset=0.4)
    now = np.array([0.0])
    assert Shaping(max_rate=0.5, initial=-0.2).apply(signal).sample(now) == -0.2
    assert Shaping(max_rate=0.5, initial=None).apply(signal).sample(now) == 0.4


def test_mistakes_are_named():
    class Broken:
        def sample(self, times: Array) -> Array:
            return np.full(times.shape, np.nan)

    with pytest.raises(ConfigurationError, match="without any limit"):
        Shaping()
    with pytest.raises(ConfigurationError, match="not finite"):
        Shaping(max_rate=1.0).apply(Broken()).sample(np.array([0.0]))
