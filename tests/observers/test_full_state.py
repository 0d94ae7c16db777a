"""The full-state observer maps truth to the model by name, and says when it cannot."""

from __future__ import annotations

import numpy as np
import pytest

from trms_cli.core.errors import ConfigurationError
from trms_cli.models.newtonian import Newtonian
from trms_cli.observers.full_state import FullState

from .observed_rigs import setup_for

TRUTH = {
    "i_v": 9.0,
    "alpha_v": 0.3,
    "omega_h": 50.0,
    "S_h": 0.1,
    "alpha_h": 0.5,
    "omega_v": 200.0,
    "S_v": -0.2,
    "effect.extra": 7.0,
}


SETUP = setup_for(Newtonian(), ("alpha_v", "omega_h"))


def test_truth_is_mapped_by_name_also_from_a_rig_with_more_states() -> None:
    observer = FullState()
    state = observer.init(SETUP)
    estimate = observer.step(state, np.zeros(2), np.array([0.31, np.nan]), TRUTH)
    np.testing.assert_array_equal(estimate.x, [TRUTH[name] for name in SETUP.model.state_names])
    np.testing.assert_array_equal(estimate.predicted, [0.3, 50.0])
    np.testing.assert_allclose(estimate.innovation, [0.01, np.nan], atol=1e-15)
    np.testing.assert_array_equal(estimate.innovation_sd, [5e-4, 1.6])
    assert not estimate.disturbance.any() and not estimate.sd.any()


def test_two_states_share_nothing() -> None:
    observer = FullState()
    first, second = observer.init(SETUP), observer.init(SETUP)
    x = observer.step(first, np.zeros(2), np.zeros(2), TRUTH).x
    before = x.copy()
    observer.step(second, np.zeros(2), np.zeros(2), dict.fromkeys(TRUTH, 1.0))
    np.testing.assert_array_equal(x, before)


@pytest.mark.parametrize(
    ("truth", "problem", "remedy"),
    [
        (None, "recording", "observer=ukf"),
        ({"alpha_v": 0.0}, "no state 'omega_h'", "the same states"),
    ],
)
def test_what_is_not_there_is_named(truth, problem, remedy) -> None:
    observer = FullState()
    state = observer.init(SETUP)
    with pytest.raises(ConfigurationError, match=problem) as caught:
        observer.step(state, np.zeros(2), np.zeros(2), truth)
    assert remedy in caught.value.remedy
