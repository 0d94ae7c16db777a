"""``trms run plant=replay`` as a person types it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Two seconds of a rig at rest under normalised commands, with two rows lost."""
    path = tmp_path / "mine.csv"
    rows = [
        f"{k / 100:.2f},0.0,0.0,{-0.4888 + 0.0015 * (k % 2)},0.0,0.1,{-0.49 * (k % 2)},-0.5\n"
        for k in range(200)
        if k not in (50, 51)
    ]
    header = "t[s],u_v[1],u_h[1],alpha_v[rad],alpha_h[rad],omega_v[rad/s],omega_h[rad/s],r_v[rad]\n"
    path.write_text("# rig: mine\n" + header + "".join(rows), encoding="utf-8")
    return path


def test_a_recording_is_replayed_scored_and_drawn(trms, recording, tmp_path):
    done = trms(
        "run", "plant=replay", "plant.file=mine.csv", "model=tras", "controller=pid", "out=here"
    )
    assert done.returncode == 0, done.stderr
    printed = " ".join(done.stdout.split())
    assert "cannot be steered" in printed and "(controller=pid)" in printed
    assert "a gap in t" in printed
    folder = tmp_path / "here"
    assert (folder / "run.png").stat().st_size > 20_000
    table = json.loads((folder / "innovations.json").read_text(encoding="utf-8"))
    assert table["schema"] == "trms.innovations/1"
    assert table["channels"]["alpha_v"]["samples"] == 198
    scored = trms("score", "here/run.mcap", "--json")
    score = json.loads(scored.stdout)
    assert score["complete"] and score["duration_s"] == pytest.approx(2.0, abs=0.011)
    assert score["estimate"]["prediction_rmse"]["omega_h"] < 1.0


def test_the_log_is_a_recording_again(trms, recording):
    assert (
        trms(
            "run", "plant=replay", "plant.file=mine.csv", "model=tras", "out=a", "picture=false"
        ).returncode
        == 0
    )
    again = trms(
        "run", "plant=replay", "plant.file=a/run.mcap", "model=tras", "out=b", "picture=false"
    )
    assert again.returncode == 0, again.stderr


def test_the_wrong_model_is_told_with_the_right_one(trms, recording):
    done = trms("run", "plant=replay", "plant.file=mine.csv")
    assert done.returncode == 2
    assert "model=tras" in done.stderr and "plant.input_scale" in done.stderr
    assert not (recording.parent / "outputs").exists()


def test_a_recording_that_is_not_there(trms):
    done = trms("run", "plant=replay", "plant.file=none.csv", "model=tras")
    assert done.returncode == 2 and "none.csv" in done.stderr


def test_no_recording_at_all(trms):
    done = trms("run", "plant=replay")
    assert done.returncode == 2 and "plant.file" in done.stderr


def test_an_observer_that_looks_inside_has_nothing_to_look_at(trms, recording):
    done = trms("run", "plant=replay", "plant.file=mine.csv", "model=tras", "observer=full_state")
    assert done.returncode == 2 and "observer=ukf" in done.stderr
