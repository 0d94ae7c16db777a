"""Observers of black-box models: what is remembered, what is estimated, where they start; the
full-state observer maps truth to the model by name, and says when it cannot.
"""

import numpy as np
import pytest

from trms_cli.core.errors import ConfigurationError
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.rest import resting_state
from trms_cli.models.state_kinds import kinds_of_disturbances, kinds_of_states
from trms_cli.observers.full_state import FullState
from trms_cli.observers.observer import ObserverSetup
from trms_cli.observers.ukf import Ukf

from ..models.network_case import rig_like
from .observed_rigs import NOISE_SD, Rig, followed, setup_for

CHANNELS = tuple(NOISE_SD)


@pytest.fixture(autouse=True)
def interpreted(monkeypatch):
    """Without the C compiler: a network is evaluated a few thousand times here."""
    monkeypatch.setattr("trms_cli.core.compilation.compiler", lambda: None)


def setup(model, sample_time=0.02):
    return ObserverSetup(model, sample_time, CHANNELS, NOISE_SD, model.rest()[:4], np.zeros(2))


def truth(rig):
    return dict(zip(CHANNELS, rig.x[:4].tolist(), strict=True))


def steps(n):
    rng = np.random.default_rng(2)
    return np.repeat(rng.uniform(-1.5, 1.5, (n // 10 + 1, 2)), 10, axis=0)[:n]


def test_kinds_of_states_are_read_off_the_step_and_of_what_pushes_off_its_units():
    kinds = kinds_of_states(rig_like((1, 2), (1, 2)))
    assert kinds == ("angle",) * 2 + ("speed",) * 2 + ("past",) * 6
    for model, kind in ((rig_like(), "acceleration"), (Newtonian(), "disturbance")):
        assert kinds_of_disturbances(model) == (kind,) * 2 + (f"rotor_{kind}",) * 2


class TestRestingState:
    def test_remembers_the_outputs_and_finds_the_rotors_speeds_without_tachos_by_the_command(self):
        model = rig_like((1, 3), (1, 2))
        measured = dict(zip(CHANNELS, [0.1, -0.2, 30.0, -40.0], strict=True))
        x = resting_state(model, measured, np.array([0.3, 0.4]))
        for i, name in enumerate(model.state_names):
            root = name.split("_lag")[0]
            expected = measured.get(root, {"u_v": 0.3, "u_h": 0.4}.get(root))
            assert x[i] == expected, name
        model = rig_like(bend=0.0)
        x = resting_state(model, {"alpha_v": 0.1, "alpha_h": -0.2}, np.array([0.5, -0.3]))
        np.testing.assert_allclose(x[:4], [0.1, -0.2, 140 * 0.5, -250 * 0.3], rtol=1e-6)


class TestFullState:
    def test_remembers_what_it_saw_and_was_commanded_but_not_between_samples(self):
        model = rig_like((1, 3), (1, 3))
        rig, observer = Rig(model, CHANNELS), FullState()
        state, u = observer.init(setup(model)), np.zeros(2)
        for following in steps(40):
            estimate = observer.step(state, u, rig.x[:4], truth(rig))
            np.testing.assert_array_equal(estimate.x, rig.x)
            u = following
            rig.advance(u)
        with pytest.raises(ConfigurationError, match=r"sim\.sample_time=0\.02"):
            FullState().init(setup(rig_like(), 0.1))

    def test_of_another_rig_takes_its_outputs(self):
        """The rig is not the network: what is remembered is what the rig did."""
        model, rig = rig_like(seed=1), Rig(rig_like(seed=2, bend=1.0), CHANNELS)
        observer = FullState()
        state, u, before = observer.init(setup(model)), np.zeros(2), None
        for following in steps(20):
            estimate = observer.step(state, u, rig.x[:4], truth(rig))
            np.testing.assert_array_equal(estimate.x[:4], rig.x[:4])
            if before is not None:
                np.testing.assert_array_equal(estimate.x[4:], before)
            u, before = following, rig.x[:4].copy()
            rig.advance(u)


class TestUkf:
    def test_finds_a_constant_push_and_has_no_bias(self):
        model = rig_like((1, 2), (1, 2))
        push = np.array([0.3, -0.2, 25.0, -15.0])
        rig, observer, inputs = Rig(model, CHANNELS, seed=3), Ukf(), steps(900)
        state, errors, pushes = observer.init(setup(model)), [], []
        for k, estimate in followed(observer, state, rig, inputs, push):
            if k > 400:
                errors.append((estimate.x - rig.x)[:4])
                pushes.append(estimate.disturbance.copy())
                np.testing.assert_allclose(estimate.x[8:], inputs[k - 1], rtol=0, atol=1e-6)
        assert np.all(np.abs(np.mean(pushes, axis=0) - push) < [0.05, 0.05, 3.0, 3.0])
        assert np.all(np.std(errors, axis=0) < rig.sd)
        assert state.recoveries == 0

    def test_steps_over_several_samples_of_the_network(self):
        model = rig_like()
        rig, observer = Rig(model, CHANNELS), Ukf(disturbances=())
        state, u = observer.init(setup(model, 0.1)), np.zeros(2)
        for following in steps(200)[::5]:
            estimate = observer.step(state, u, rig.x[:4], None)
            u = following
            for _ in range(5):
                rig.advance(u)
        after = observer.step(state, u, rig.x[:4], None)
        off = np.abs(after.x - rig.x)
        assert np.all(off < [2e-3, 2e-3, 2.0, 2.0] * 2)
        assert np.abs(rig.x[2:4]).min() > 5.0  # the rig was not at rest
        assert estimate is after


SETUP = setup_for(Newtonian(), ("alpha_v", "omega_h"))
#: Of a rig with more states, in another order.
TRUTH = {
    name: 0.1 * (k + 1)
    for k, name in enumerate(["i_v", *sorted(SETUP.model.state_names), "effect.extra"])
}


def test_truth_is_mapped_by_name_also_from_a_rig_with_more_states_and_nothing_is_shared() -> None:
    observer = FullState()
    state = observer.init(SETUP)
    estimate = observer.step(state, np.zeros(2), np.array([TRUTH["alpha_v"] + 0.01, np.nan]), TRUTH)
    np.testing.assert_array_equal(estimate.x, [TRUTH[name] for name in SETUP.model.state_names])
    np.testing.assert_array_equal(estimate.predicted, [TRUTH["alpha_v"], TRUTH["omega_h"]])
    np.testing.assert_allclose(estimate.innovation, [0.01, np.nan], atol=1e-15)
    np.testing.assert_array_equal(estimate.innovation_sd, [5e-4, 1.6])
    assert not estimate.disturbance.any() and not estimate.sd.any()
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
