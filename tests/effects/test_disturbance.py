"""A coloured torque: its statistics in the rig, its estimate in an observer."""

import numpy as np
import pytest

from trms_cli.effects.disturbance import Disturbance
from trms_cli.observers.observer import ObserverSetup
from trms_cli.observers.ukf import Ukf
from trms_cli.plants.plant import PlantSetup
from trms_cli.plants.sensors import Sensors
from trms_cli.plants.simulated import SimulatedRig

STATE = "yaw_disturbance.torque"


def run(rig, effects, samples=200, seed=0, sample_time=0.02):
    """The rig at each sample: states by name, measurements."""
    plant = SimulatedRig(
        model=rig.newtonian(), effects=effects, sensors=Sensors(), integration_step=0.02
    )
    simulated = plant.init(PlantSetup(sample_time, samples, seed))
    states, seen = [], []
    for _ in range(samples):
        states.append(simulated.state.copy())
        seen.append(simulated.measure())
        simulated.advance(np.zeros(2))
    names = [signal.name for signal in simulated.states]
    return dict(zip(names, np.array(states).T, strict=True)), np.array(seen), simulated


@pytest.mark.parametrize("sample_time", [0.02, 0.1])
def test_it_has_its_standard_deviation_and_its_memory(rig, sample_time):
    effect = {"yaw_disturbance": Disturbance(axis="yaw", torque=0.004, time=0.5)}
    torque = run(rig, effect, 20_000, sample_time=sample_time)[0][STATE]
    independent = 20_000 * sample_time / (2 * 0.5)  # as many values as have their own fortune
    assert torque.std() == pytest.approx(0.004, rel=4 / np.sqrt(2 * independent))
    assert abs(torque.mean()) < 4 * 0.004 / np.sqrt(independent)
    lag = round(0.4 / sample_time)
    memory = np.mean(torque[lag:] * torque[:-lag]) / np.mean(torque**2)
    assert memory == pytest.approx(np.exp(-0.4 / 0.5), abs=4 / np.sqrt(independent))


def test_a_seed_repeats_it_and_other_effects_do_not_change_it(rig):
    both = {
        name: rig.effect(name)
        for name in ("pitch_disturbance", "yaw_disturbance", "main_input_delay")
    }
    alone = {"yaw_disturbance": both["yaw_disturbance"]}
    first, again, other = (run(rig, alone, seed=s)[0][STATE] for s in (3, 3, 4))
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 1e-3
    np.testing.assert_array_equal(run(rig, both, seed=3)[0][STATE], first)


def test_an_observer_takes_the_noise_from_the_effect_and_estimates_the_torque(rig):
    effect = {"yaw_disturbance": Disturbance(axis="yaw", torque=0.02, time=1.5)}
    samples = 1500
    states, seen, plant = run(rig, effect, samples)
    model = rig.extended(rig.newtonian(), effect)
    outputs = tuple(signal.name for signal in plant.outputs)
    setup = ObserverSetup(
        model,
        0.02,
        outputs,
        {n: 1e-3 if "alpha" in n else 0.5 for n in outputs},
        seen[0],
        np.zeros(2),
    )
    observer = Ukf(disturbances=("pitch_moment",))
    state = observer.init(setup)
    row = model.state_index(STATE)
    estimates = []
    for y in seen:
        estimates.append(observer.step(state, np.zeros(2), y, None).x[row])
    true, estimated = states[STATE][100:], np.array(estimates)[100:]
    assert np.corrcoef(true, estimated)[0, 1] > 0.9
    assert np.sqrt(np.mean((true - estimated) ** 2)) < 0.5 * np.std(true)
