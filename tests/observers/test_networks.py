"""Observers of black-box models: what is remembered, what is estimated, where they start."""

from __future__ import annotations

import numpy as np
import pytest

from trms_cli.core.compilation import BufferedFunction
from trms_cli.core.errors import ConfigurationError
from trms_cli.models.discretisation import discretise
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.rest import resting_state
from trms_cli.models.state_kinds import kinds_of_disturbances, kinds_of_states
from trms_cli.observers.full_state import FullState
from trms_cli.observers.observer import ObserverSetup
from trms_cli.observers.ukf import Ukf

from ..models.network_case import rig_like
from .observed_rigs import NOISE_SD

CHANNELS = tuple(NOISE_SD)


@pytest.fixture(autouse=True)
def interpreted(monkeypatch):
    """Without the C compiler: a network is evaluated a few thousand times here."""
    monkeypatch.setattr("trms_cli.core.compilation.compiler", lambda: None)


class Rig:
    """A network as the rig, with a constant push, sampled as a run samples it."""

    def __init__(self, model, push=None):
        self.model = model
        self.step = BufferedFunction(discretise(model, 0.02).step)
        self.x, self.push = model.rest(), np.zeros(4) if push is None else push

    def advance(self, u):
        self.x = self.step.evaluate(self.x, u, [], self.push)[0].copy()

    def truth(self):
        return dict(zip(CHANNELS, self.x[:4].tolist(), strict=True))


def setup(model, sample_time=0.02, first=None, channels=CHANNELS):
    first = model.rest()[:4] if first is None else first
    return ObserverSetup(model, sample_time, channels, NOISE_SD, first, np.zeros(2))


def commands(n):
    rng = np.random.default_rng(2)
    return np.repeat(rng.uniform(-1.5, 1.5, (n // 10 + 1, 2)), 10, axis=0)[:n]


class TestKinds:
    def test_of_states_are_read_off_the_step(self):
        kinds = kinds_of_states(rig_like((1, 2), (1, 2)))
        assert kinds == ("angle",) * 2 + ("speed",) * 2 + ("past",) * 6

    @pytest.mark.parametrize(
        ("model", "kind"), [(rig_like(), "acceleration"), (Newtonian(), "disturbance")]
    )
    def test_of_what_pushes_follow_from_its_units(self, model, kind):
        assert kinds_of_disturbances(model) == (kind,) * 2 + (f"rotor_{kind}",) * 2


class TestRestingState:
    def test_of_all_outputs_known_remembers_them(self):
        model = rig_like((1, 3), (1, 2))
        measured = dict(zip(CHANNELS, [0.1, -0.2, 30.0, -40.0], strict=True))
        x = resting_state(model, measured, np.array([0.3, 0.4]))
        for i, name in enumerate(model.state_names):
            root = name.split("_lag")[0]
            expected = measured.get(root, {"u_v": 0.3, "u_h": 0.4}.get(root))
            assert x[i] == expected, name

    def test_without_tachos_finds_the_rotors_speeds_by_the_command(self):
        model = rig_like(bend=0.0)
        x = resting_state(model, {"alpha_v": 0.1, "alpha_h": -0.2}, np.array([0.5, -0.3]))
        np.testing.assert_allclose(x[:4], [0.1, -0.2, 140 * 0.5, -250 * 0.3], rtol=1e-6)


class TestFullState:
    def test_remembers_what_it_saw_and_what_was_commanded(self):
        model = rig_like((1, 3), (1, 3))
        rig, observer = Rig(model), FullState()
        state, u = observer.init(setup(model)), np.zeros(2)
        for following in commands(40):
            estimate = observer.step(state, u, rig.x[:4], rig.truth())
            np.testing.assert_array_equal(estimate.x, rig.x)
            u = following
            rig.advance(u)

    def test_of_another_rig_takes_its_outputs(self):
        """The rig is not the network: what is remembered is what the rig did."""
        model, rig, observer = rig_like(seed=1), Rig(rig_like(seed=2, bend=1.0)), FullState()
        state, u, before = observer.init(setup(model)), np.zeros(2), None
        for following in commands(20):
            estimate = observer.step(state, u, rig.x[:4], rig.truth())
            np.testing.assert_array_equal(estimate.x[:4], rig.x[:4])
            if before is not None:
                np.testing.assert_array_equal(estimate.x[4:], before)
            u, before = following, rig.x[:4].copy()
            rig.advance(u)

    def test_cannot_remember_between_samples(self):
        with pytest.raises(ConfigurationError, match=r"sim\.sample_time=0\.02"):
            FullState().init(setup(rig_like(), 0.1))


class TestUkf:
    def test_finds_a_constant_push_and_has_no_bias(self):
        model = rig_like((1, 2), (1, 2))
        push = np.array([0.3, -0.2, 25.0, -15.0])
        rig, observer, rng = Rig(model, push), Ukf(), np.random.default_rng(3)
        sd = np.array([NOISE_SD[name] for name in CHANNELS])
        state, u = observer.init(setup(model)), np.zeros(2)
        errors, pushes = [], []
        for k, following in enumerate(commands(900)):
            estimate = observer.step(state, u, rig.x[:4] + sd * rng.normal(size=4), None)
            if k > 400:
                errors.append((estimate.x - rig.x)[:4])
                pushes.append(estimate.disturbance.copy())
                np.testing.assert_allclose(estimate.x[8:], u, rtol=0, atol=1e-6)
            u = following
            rig.advance(u)
        assert np.all(np.abs(np.mean(pushes, axis=0) - push) < [0.05, 0.05, 3.0, 3.0])
        assert np.all(np.std(errors, axis=0) < sd)
        assert state.recoveries == 0

    def test_steps_over_several_samples_of_the_network(self):
        model = rig_like()
        rig, observer = Rig(model), Ukf(disturbances=())
        state, u = observer.init(setup(model, 0.1)), np.zeros(2)
        for following in commands(200)[::5]:
            estimate = observer.step(state, u, rig.x[:4], None)
            u = following
            for _ in range(5):
                rig.advance(u)
        after = observer.step(state, u, rig.x[:4], None)
        off = np.abs(after.x - rig.x)
        assert np.all(off < [2e-3, 2e-3, 2.0, 2.0] * 2)
        assert np.abs(rig.x[2:4]).min() > 5.0  # the rig was not at rest
        assert estimate is after
