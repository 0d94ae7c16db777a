"""Multilevel random signals: seeded, within their levels, held within their times."""

from __future__ import annotations

import numpy as np
import pytest

from trms_cli.core.errors import ConfigurationError
from trms_cli.references.multilevel import Multilevel

TIMES = np.arange(0, 400, 0.01)


def test_the_answer_for_a_time_does_not_depend_on_the_other_times():
    signal = Multilevel(amplitude=0.3, shortest=0.05, longest=0.4, seed=4, start=1.0)
    together = signal.sample(TIMES)
    order = np.random.default_rng(0).permutation(TIMES.size)
    np.testing.assert_array_equal(signal.sample(TIMES[order]), together[order])
    alone = [signal.sample(np.array([t]))[0] for t in TIMES[::4001]]
    np.testing.assert_array_equal(alone, together[::4001])
    assert np.all(signal.sample(np.array([-5.0, 0.99])) == 0)


def test_holding_times_lie_between_the_shortest_and_the_longest():
    values = Multilevel(amplitude=1.0, shortest=0.5, longest=2.0).sample(TIMES)
    holds = np.diff(np.flatnonzero(np.diff(values) != 0)) * 0.01
    assert holds.min() >= 0.49 and holds.max() <= 2.01
    assert np.mean(holds) == pytest.approx(1.25, abs=0.1)


@pytest.mark.parametrize("levels", [2, 5, 9])
def test_all_levels_occur_at_equal_distances(levels):
    values = Multilevel(amplitude=0.4, shortest=0.1, longest=0.1, levels=levels, offset=0.1).sample(
        TIMES
    )
    expected = 0.1 + np.linspace(-0.4, 0.4, levels)
    np.testing.assert_allclose(np.unique(values.round(12)), expected, atol=1e-12)


def test_any_value_is_drawn_evenly_and_seeds_differ():
    a = Multilevel(amplitude=1.0, shortest=0.01, longest=0.01, seed=1).sample(TIMES)
    b = Multilevel(amplitude=1.0, shortest=0.01, longest=0.01, seed=2).sample(TIMES)
    assert np.abs(a).max() <= 1.0
    assert np.std(a) == pytest.approx(3**-0.5, rel=0.02)
    assert abs(np.corrcoef(a, b)[0, 1]) < 0.02


def test_times_in_the_wrong_order_are_refused():
    with pytest.raises(ConfigurationError, match="below the shortest"):
        Multilevel(amplitude=1.0, shortest=2.0, longest=1.0)
