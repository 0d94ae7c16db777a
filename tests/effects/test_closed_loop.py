"""Each effect in the rig and in the model of UKF and MPC at once, in a closed loop."""

from dataclasses import replace

import numpy as np
import pytest

from ..simulation.looping import composed, looped
from .conftest import NAMES

SETTINGS = ["controller=newton_mpc", "observer=ukf", "ref=square", "sim.duration=6"]
#: rad, RMS error of both angles over these 6 s, most of it the steps themselves.
WITHOUT_ANY = 0.293
#: Effects that are chosen for the fast run: a sensor with memory, a noise-driven state.
FAST = {"pitch_sensor_delay", "yaw_disturbance"}


@pytest.mark.parametrize(
    "tested", [pytest.param(n, marks=() if n in FAST else pytest.mark.slow) for n in NAMES]
)
def test_rig_and_model_with_the_effect_track(rig, tested):
    experiment, effects = composed(*SETTINGS), {tested: rig.effect(tested)}
    plant = replace(experiment.plant, effects=effects)
    model = rig.extended(experiment.model, effects)
    loop = looped(replace(experiment, plant=plant, model=model))
    assert not [event for event in loop.history.events if event[1] == "fault"]
    state, reference = (loop.history.columns(t) for t in ("/plant/state", "/reference"))
    errors = [state[name] - reference[name] for name in ("alpha_v", "alpha_h")]
    assert np.sqrt(np.mean(np.square(errors))) < 1.1 * WITHOUT_ANY
