"""Logs that earlier versions wrote are read as ever, by every command that reads logs.

``logs/`` keeps one log of each form that the program has written: the first; the one before the
loop had modes; the one before the 3D view. They are of 1.5 s of ``newton_mpc`` with a friction
that its model does not know. A form that is new gets a log of its own here; none is taken out.
"""

import json
import shutil
from pathlib import Path

import pytest

from trms_cli.cli import main
from trms_cli.recordings.log_reader import read_log

LOGS = sorted(Path(__file__).with_name("logs").glob("*.mcap"))


@pytest.fixture
def log(request, tmp_path, monkeypatch) -> Path:
    """A copy: what reads a log may write beside it."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TRMS_RUNS", str(tmp_path / "index"))
    folder = tmp_path / "old"
    folder.mkdir()
    return Path(shutil.copyfile(request.param, folder / "run.mcap")).relative_to(tmp_path)


def test_there_are_some():
    assert len(LOGS) >= 3


@pytest.mark.parametrize("log", LOGS, indirect=True, ids=lambda path: path.stem)
class TestOldLog:
    """What a user does with a log of last year."""

    def test_its_samples_its_score_and_its_row_in_the_index(self, log, capsys):
        read = read_log(log)
        assert read.complete
        yaw = read.tables["/plant/state"].columns["alpha_h"]
        assert len(yaw) == 30 and 0.1 < max(yaw) < 0.2  # a step under way
        assert main(["score", str(log), "--json"]) == 0
        score = json.loads(capsys.readouterr().out)
        assert score["schema"] == "trms.score/1" and score["complete"]
        assert 0.05 < score["channels"]["alpha_h"]["rmse"] < 0.2
        assert main(["runs", "controller == 'newton_mpc' and rmse_yaw < 0.2", "--json"]) == 0
        (row,) = json.loads(capsys.readouterr().out)["runs"]
        assert row["controller"] == "newton_mpc" and row["complete"]

    @pytest.mark.parametrize(
        "words",
        [
            ["export", "LOG", "--out", "old.csv"],
            ["watch", "LOG", "--once"],
            ["compare", "LOG", "LOG"],
            ["report", "LOG", "--out", "old.html"],
            ["plot", "LOG", "--out", "old.pdf"],
        ],
        ids=lambda words: words[0],
    )
    def test_the_commands(self, log, words):
        if words[0] == "compare":
            other = Path(shutil.copytree(log.parent, "other")) / log.name
            words = ["compare", str(log), str(other)]
        assert main([str(log) if word == "LOG" else word for word in words]) == 0

    def test_the_run_can_be_made_again(self, log):
        assert main(["run", "--from", str(log), "out=again"]) == 0
        assert read_log(Path("again/run.mcap")).complete


def test_a_log_of_a_version_to_come_is_told(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with monkeypatch.context() as later:
        later.setattr("trms_cli.recordings.run_log.RUN_SCHEMA", "trms.run/9")
        assert main(["run", "controller=pid", "sim.duration=0.2", "picture=false", "out=new"]) == 0
    capsys.readouterr()
    assert main(["score", "new/run.mcap"]) != 0
    said = capsys.readouterr().err
    assert "trms.run/9" in said and "update" in said
