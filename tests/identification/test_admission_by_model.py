"""A pitch that is counted from another zero than the level beam is told."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from trms_cli.identification.admission_by_model import findings_by_model
from trms_cli.identification.dataset import Dataset
from trms_cli.models.model import Model
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.tras import Tras
from trms_cli.recordings.for_model import Selection

sys.path.insert(0, str(Path(__file__).parents[1] / "recordings"))
from played_rig import BENCH, play

MODEL = Newtonian()


def moved(kind: str, by: float, model: Model = MODEL, **options: object) -> Dataset:
    run = Selection(sensors=BENCH).take(play(kind, model=model, **options), model)
    noise = np.array([run.noise_sd[signal.name] for signal in run.outputs])
    dataset = Dataset(
        "played", "played.csv", "", run.sample_time, run.time, run.inputs, run.outputs,
        run.commands, run.measurements, noise,
    )  # fmt: skip
    index = [signal.name for signal in run.outputs].index("alpha_v")
    measurements = dataset.measurements.copy()
    measurements[:, index] += by
    return replace(dataset, measurements=measurements)


@pytest.mark.parametrize("kind", ["prbs", "multilevel", "closed"])
def test_zero_at_the_hanging_rest_is_told_with_its_cure(kind):
    (finding,) = findings_by_model(moved(kind, 0.62, seed=2, prior_seed=2), MODEL)
    assert (finding.check, finding.channel, finding.certain) == ("zero", "alpha_v", False)
    assert "data.offset={alpha_v: -0.62}" in finding.remedy and "hung" in finding.problem


def test_another_zero_is_told_by_its_size():
    (finding,) = findings_by_model(moved("prbs", -0.5, seed=1), MODEL)
    added = float(finding.remedy.split("alpha_v: ")[1].split("}")[0])
    assert added == pytest.approx(0.5, abs=0.05)


def test_the_sister_rig_has_its_own_rest():
    model = Tras()
    rest = float(model.rest()[model.state_index("alpha_v")])
    rig = moved("closed", -rest, model, scale=(0.4, 0.4), step=0.01)
    (finding,) = findings_by_model(rig, model)
    assert f"data.offset={{alpha_v: {rest:.2f}}}" in finding.remedy


def test_what_the_priors_allow_is_no_zero():
    for seed in range(2):
        assert not findings_by_model(moved("multilevel", 0.05, seed=seed, prior_seed=seed), MODEL)


def test_weight_at_rest_vanishes_where_the_beam_hangs():
    from trms_cli.identification.admission_by_model import RecordedMotions

    rest = MODEL.rest()[MODEL.state_index("alpha_v")]
    left, there, right = RecordedMotions(MODEL).at_rest(
        "alpha_v", rest + np.array([-0.2, 0.0, 0.2])
    )
    assert left > 0 > right
    assert there == pytest.approx(0, abs=0.05 * left)
