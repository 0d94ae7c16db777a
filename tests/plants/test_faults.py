"""Faults: each does what it says, for as long as it says, and nothing else."""

from typing import Any

import numpy as np
import pytest

from trms_cli.core.errors import ConfigurationError
from trms_cli.models.newtonian import Newtonian
from trms_cli.plants.faults.delayed_commands import DelayedCommands
from trms_cli.plants.faults.fault import Fault
from trms_cli.plants.faults.frozen_sensor import FrozenSensor
from trms_cli.plants.faults.lost_samples import LostSamples
from trms_cli.plants.faults.outliers import Outliers
from trms_cli.plants.faults.shifted_sensor import ShiftedSensor
from trms_cli.plants.faults.stuck_command import StuckCommand
from trms_cli.plants.plant import PlantSetup
from trms_cli.plants.sensors import Sensors
from trms_cli.plants.simulated import SimulatedRig

SAMPLES, T = 200, 0.02
YAW = 1  # among the channels
SHORT: dict[str, Any] = {"start": 1.0, "duration": 1.0}
DURING = slice(50, 100)


def started(*faults: Fault, seed: int = 0, sensors: Sensors | None = None) -> Any:
    named = {f"fault_{i}": fault for i, fault in enumerate(faults)}
    rig = SimulatedRig(model=Newtonian(), sensors=sensors or Sensors(), faults=named)
    return rig.init(PlantSetup(T, SAMPLES, seed))


@pytest.fixture(scope="module")
def clean():
    """What is measured without faults."""
    return readings()[0]


def readings(*faults: Fault, seed: int = 0, noise: float = 0.01) -> tuple[np.ndarray, np.ndarray]:
    """What is measured and where the rig is under moving commands: (samples, n) each."""
    sensors = Sensors(noise_sd={"alpha_h": noise, "alpha_v": noise})
    run = started(*faults, seed=seed, sensors=sensors)
    measured, states = [], []
    for k in range(SAMPLES):
        measured.append(run.measure().copy())
        states.append(run.state.copy())
        run.advance(np.array([1.0 + 0.5 * np.sin(0.1 * k), np.cos(0.07 * k)]))
    return np.array(measured), np.array(states)


def test_without_faults_nothing_changes() -> None:
    late = readings(LostSamples(channel="alpha_h", start=1e3))
    for one, other in zip(readings(), late, strict=True):
        np.testing.assert_array_equal(one, other)


def test_lost_samples_are_lost_for_their_time_and_in_their_channel_only(clean) -> None:
    lost, _ = readings(LostSamples(channel="alpha_h", **SHORT))
    assert np.isnan(lost[DURING, YAW]).all()
    lost[DURING, YAW] = clean[DURING, YAW]
    np.testing.assert_array_equal(lost, clean)
    lost, _ = readings(LostSamples(channel="alpha_h", start=0.0, probability=0.3))
    assert 0.2 < np.isnan(lost[:, YAW]).mean() < 0.4


def test_a_frozen_sensor_shows_its_last_value_and_then_the_truth_again(clean) -> None:
    frozen, _ = readings(FrozenSensor(channel="alpha_h", **SHORT))
    assert np.unique(frozen[DURING, YAW]).size == 1
    assert frozen[50, YAW] == clean[50, YAW]
    np.testing.assert_array_equal(frozen[100:], clean[100:])
    np.testing.assert_array_equal(np.delete(frozen, YAW, 1), np.delete(clean, YAW, 1))


def test_outliers_and_shifts_have_their_size(clean) -> None:
    hit, _ = readings(Outliers(channel="alpha_h", probability=0.2, size=0.3, **SHORT))
    off = hit[:, YAW] - clean[:, YAW]
    assert set(np.round(np.unique(off), 9)) == {-0.3, 0.0, 0.3}
    assert not off[:50].any()
    assert not off[100:].any()
    slipped, _ = readings(ShiftedSensor(channel="alpha_h", start=1.0, shift=0.1))
    np.testing.assert_allclose(slipped[50:, YAW] - clean[50:, YAW], 0.1)


def test_delayed_commands_arrive_as_those_that_were_sent_later() -> None:
    """A rig that is told everything 5 samples late is the same rig 5 samples later."""
    delay = 5
    late = started(DelayedCommands(start=0.0, delay=delay * T))
    prompt = started()
    sent = [np.array([1.0 + 0.01 * k, -0.005 * k]) for k in range(60)]
    for k in range(60):
        late.advance(sent[k])
        prompt.advance(sent[max(0, k - delay)])
    np.testing.assert_array_equal(late.state, prompt.state)


@pytest.mark.parametrize("value", [None, 0.4])
def test_a_stuck_command_moves_the_rig_as_a_constant_one(value: float | None) -> None:
    stuck = started(StuckCommand(input="u_h", start=0.2, value=value))
    same = started()
    for k in range(40):
        u = np.array([1.0, 0.02 * k])
        stuck.advance(u)
        held = 0.02 * min(k, 9) if value is None or k < 10 else value
        same.advance(np.array([1.0, held]))
    np.testing.assert_array_equal(stuck.state, same.state)


def test_equal_seeds_give_equal_faults_and_one_fault_does_not_shift_another() -> None:
    outliers = Outliers(channel="alpha_h", start=0.0, size=0.3, probability=0.2)
    once, _ = readings(outliers)
    np.testing.assert_array_equal(once, readings(outliers)[0])
    assert not np.array_equal(once, readings(outliers, seed=1)[0])
    both, _ = readings(outliers, LostSamples(channel="alpha_v", start=0.0, probability=0.2))
    np.testing.assert_array_equal(both[:, YAW], once[:, YAW])


def test_a_fault_of_a_channel_that_is_not_measured_is_refused_with_its_place() -> None:
    with pytest.raises(ConfigurationError) as caught:
        readings(LostSamples(channel="alpha_x", start=0.0))
    assert caught.value.where == "faults.fault_0.channel"
