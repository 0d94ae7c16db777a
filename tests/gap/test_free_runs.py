"""Free runs of the gap: a right model leaves the noise only, starts know the past only."""

from dataclasses import replace

import numpy as np
import pytest

from tests.identification.greybox.rigs import measuring, recording
from trms_cli.effects.coulomb_friction import CoulombFriction
from trms_cli.effects.extended_model import extend_model
from trms_cli.effects.flexible_mode import FlexibleMode
from trms_cli.effects.input_delay import InputDelay
from trms_cli.effects.sensor_delay import SensorDelay
from trms_cli.gap.free_runs import expected_errors, free_run_errors, history
from trms_cli.identification.dataset import Dataset
from trms_cli.models.model import Model
from trms_cli.models.newtonian import Newtonian

RANGES = [(1.0, 1.5), (-0.8, 0.8)]
SPAN = (0, 1000, 2000)
EFFECTS = {
    "friction": CoulombFriction(axis="yaw", torque=0.004),
    "delay": InputDelay(rotor="main", delay=0.05),
    "mode": FlexibleMode(axis="pitch", frequency=4.0, damping=0.03, share=0.5),
    "late": SensorDelay(axis="pitch", delay=0.05),
}


def rig(name: str | None, seed: int = 0) -> tuple[Model, Dataset]:
    model = Newtonian() if name is None else extend_model(Newtonian(), {name: EFFECTS[name]})
    return model, recording(model, seconds=40.0, ranges=RANGES, seed=seed, substeps=1)[0]


@pytest.fixture(scope="module")
def plain() -> tuple[Model, Dataset]:
    return rig(None)


@pytest.mark.parametrize("name", [None, *EFFECTS])
def test_the_right_model_is_within_what_noise_explains(name: str | None) -> None:
    model, dataset = rig(name)
    errors_by_channel = free_run_errors(model, [dataset], [SPAN])
    expected = expected_errors(model, [dataset], [SPAN])
    for channel in errors_by_channel:
        for horizon, errors in errors_by_channel[channel].items():
            assert errors.rms < 1.6 * expected[channel][horizon].rms, (channel, horizon)
    assert errors_by_channel["alpha_h"][10.0].rms < 5e-3


def test_a_model_without_the_effect_leaves_a_gap_where_it_acts() -> None:
    model, dataset = rig("friction")
    right = free_run_errors(model, [dataset], [SPAN])
    wrong = free_run_errors(Newtonian(), [dataset], [SPAN])
    assert wrong["alpha_h"][2.0].rms > 5 * right["alpha_h"][2.0].rms
    assert wrong["omega_v"][2.0].rms < 1.1 * right["omega_v"][2.0].rms


def test_a_start_does_not_know_what_comes(plain: tuple[Model, Dataset]) -> None:
    model, dataset = plain
    span = (0, 1000, 1500)
    before = free_run_errors(model, [dataset], [span])
    changed = dataset.measurements.copy()
    changed[1500:] += 1.0
    after = free_run_errors(model, [replace(dataset, measurements=changed)], [span])
    for channel in before:
        np.testing.assert_array_equal(before[channel][0.5].squared, after[channel][0.5].squared)
    # Nor does the first start know its own run.
    changed[1000:] += 1.0
    after = free_run_errors(model, [replace(dataset, measurements=changed)], [span])
    first = np.sqrt(after["alpha_v"][0.1].squared[0])
    assert first == pytest.approx(1.0, abs=0.01)


def test_angles_alone_and_missing_samples(plain: tuple[Model, Dataset]) -> None:
    model, dataset = plain
    two = measuring(dataset, 2)
    two.measurements[1100:1200, 1] = np.nan
    errors = free_run_errors(model, [two], [SPAN])
    assert set(errors) == {"alpha_v", "alpha_h"}
    assert len(errors["alpha_h"][0.1].squared) < len(errors["alpha_v"][0.1].squared)
    assert errors["alpha_h"][10.0].rms < 0.01 and errors["alpha_v"][10.0].rms < 0.01


def test_blocks_are_counted_through_all_recordings(plain: tuple[Model, Dataset]) -> None:
    model, dataset = plain
    _, other = rig(None, seed=5)
    parts = [(0, 1000, 2000), (1, 0, 1250)]
    errors_by_channel = free_run_errors(model, [dataset, other], parts, block=10.0)
    errors = errors_by_channel["alpha_h"][2.0]
    assert sorted(set(errors.block.tolist())) == [0, 1, 2, 3]
    # 20 s of starts every 0.5 s, less the horizon; then 25 s less the history and the horizon
    assert len(errors.squared) == 37 + (1250 - 100 - history(0.02)) // 25 + 1
    assert 10.0 in errors_by_channel["alpha_h"]
    assert 10.0 not in free_run_errors(model, [dataset], [(0, 0, 400)])["alpha_h"]


def test_a_model_that_runs_away_counts_as_infinitely_wrong(plain: tuple[Model, Dataset]) -> None:
    model, dataset = Newtonian(), plain[1]
    model.parameters = model.parameters.replaced({"J_mr": 1e-9})
    errors = free_run_errors(model, [dataset], [SPAN])
    assert not np.isfinite(errors["omega_v"][2.0].rms)
