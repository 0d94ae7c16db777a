"""Each effect in the rig and in the model of UKF and MPC at once, in a closed loop."""

from dataclasses import replace

import numpy as np
import pytest

from ..simulation.looping import composed, looped
from .conftest import NAMES

SETTINGS = ["controller=newton_mpc", "observer=ukf", "ref=square", "sim.duration=6"]
#: Effects that are chosen for the fast run: a sensor with memory, a noise-driven state.
#: rad, RMS error over these 6 s, most of it the steps themselves: without any effect 0.293.
WITHOUT_ANY = 0.293
FAST = {"pitch_sensor_delay", "yaw_disturbance"}


def closed_loop(rig, effects):
    """RMS tracking error of both angles, rad, and the loop."""
    experiment = composed(*SETTINGS)
    plant = replace(experiment.plant, effects=effects)
    model = rig.extended(experiment.model, effects)
    loop = looped(replace(experiment, plant=plant, model=model))
    state, reference = (loop.history.columns(t) for t in ("/plant/state", "/reference"))
    errors = [state[name] - reference[name] for name in ("alpha_v", "alpha_h")]
    return np.sqrt(np.mean(np.square(errors))), loop


def pytest_generate_tests(metafunc):
    if "tested" in metafunc.fixturenames:
        marks = {name: () if name in FAST else pytest.mark.slow for name in NAMES}
        metafunc.parametrize("tested", [pytest.param(n, marks=m) for n, m in marks.items()])


def test_rig_and_model_with_the_effect_track(rig, tested):
    error, loop = closed_loop(rig, {tested: rig.effect(tested)})
    assert not [event for event in loop.history.events if event[1] == "fault"]
    assert error < 1.1 * WITHOUT_ANY
