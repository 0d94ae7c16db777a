"""Each effect in the rig and in the model of UKF and MPC at once, in a closed loop."""

from dataclasses import replace

import numpy as np
import pytest

from trms_cli.composition.composer import compose
from trms_cli.library.tasks.experiment import experiment_of
from trms_cli.simulation.closed_loop import Loop
from trms_cli.simulation.history import History

SETTINGS = ["controller=newton_mpc", "observer=ukf", "ref=square", "sim.duration=6"]
#: Effects that are chosen for the fast run: a sensor with memory, a noise-driven state.
#: rad, RMS error over these 6 s, most of it the steps themselves: without any effect 0.293.
WITHOUT_ANY = 0.293
FAST = {"pitch_sensor_delay", "yaw_disturbance"}


def keep(plant):
    """A history in memory of what the test looks at."""
    angles = {"alpha_v": "rad", "alpha_h": "rad"}
    states = {signal.name: signal.unit for signal in plant.states}
    return History({"/reference": angles, "/plant/state": states}, None)


def closed_loop(rig, effects, in_model=True):
    """RMS tracking error of both angles, rad, and the loop."""
    experiment = experiment_of(compose(SETTINGS).config)
    plant = replace(experiment.plant, effects=effects)
    model = rig.extended(experiment.model, effects if in_model else {})
    loop = Loop.start(replace(experiment, plant=plant, model=model), keep)
    loop.run()
    reference = loop.history.columns("/reference")
    state = loop.history.columns("/plant/state")
    errors = [state[name] - reference[name] for name in ("alpha_v", "alpha_h")]
    return np.sqrt(np.mean(np.square(errors))), loop


def pytest_generate_tests(metafunc):
    if "tested" in metafunc.fixturenames:
        from tests.effects.conftest import NAMES

        marks = {name: () if name in FAST else pytest.mark.slow for name in NAMES}
        metafunc.parametrize("tested", [pytest.param(n, marks=m) for n, m in marks.items()])


def test_rig_and_model_with_the_effect_track(rig, tested):
    error, loop = closed_loop(rig, {tested: rig.effect(tested)})
    assert not [event for event in loop.history.events if event[1] == "fault"]
    assert error < 1.1 * WITHOUT_ANY
