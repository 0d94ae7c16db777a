"""The study of the network beside the equations: its tables, and a small run of all of it."""

import json
from pathlib import Path

import pytest

from experiments.gap.closing_loop import Tracking
from experiments.gap.network_correction import FreeRun, free_run_table, main, tracking_table
from experiments.gap.rigs import rig_of
from trms_cli.core.errors import EXIT_OK
from trms_cli.effects.model_file import load_model


def test_the_tables_are_root_mean_squares_over_the_rigs_of_an_effect(tmp_path: Path) -> None:
    rigs = [rig_of("none", {}, seed, 0.5) for seed in (1, 2)]
    for rig, kept in zip(rigs, (True, False), strict=True):
        folder = tmp_path / rig.name / "network"
        folder.mkdir(parents=True)
        document = {"details": {"network": {"kept": kept}}}
        (folder / "identification.json").write_text(json.dumps(document), encoding="utf-8")
    runs = [
        FreeRun("none", rig.name, "refit", length, {"pitch": 1e-3 * size, "yaw": 2e-3 * size})
        for rig, size in zip(rigs, (3.0, 4.0), strict=True)
        for length in (1.0, 4.0)
    ]
    head, pitch, yaw = free_run_table(runs, rigs, tmp_path)
    assert head[-1] == "parameters [mrad]"
    assert pitch == ["`none`", "pitch", "1 of 2", "3.5, 3.5"]
    assert yaw == ["", "yaw", "", "7.1, 7.1"]
    both = {"pitch": 3e-3, "yaw": 4e-3}
    tracking = Tracking("none-1", "none", 1, "squares", "network", both, both, both, both)
    assert tracking_table([tracking], ["network"])[1:] == [
        ["`none`", "pitch", "3.0"],
        ["", "yaw", "4.0"],
    ]


def test_a_rig_without_an_effect_has_a_true_model(tmp_path: Path) -> None:
    rig = rig_of("none", {}, 3, 0.5)
    model = load_model(str(rig.write_true_model(tmp_path / "true.yaml")))
    assert model.parameters["k_ov"].value == rig.parameters["k_ov"].value


@pytest.mark.slow
def test_a_part_of_the_study_runs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--quick", "--out", str(tmp_path)]) == EXIT_OK
    printed = capsys.readouterr().out
    for word in ("free_runs", "trajectory", "with network"):
        assert word in printed
