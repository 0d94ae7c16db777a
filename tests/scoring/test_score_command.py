"""``trms score``: what it prints, writes and returns."""

import json
import re
from pathlib import Path

import pytest

from trms_cli.commands import score
from trms_cli.core import wording
from trms_cli.core.errors import ConfigurationError, RecordingError
from trms_cli.recordings.run_log import RunLog
from trms_cli.recordings.topics import Field, standard_topics
from trms_cli.scoring.findings import innovation_sentences


def test_a_table_of_eighty_columns_and_a_json_with_its_figures(make_log, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    log = str(make_log())
    assert score.main([log]) == 0
    printed = capsys.readouterr().out
    assert "40 s, completed, scored on the true state" in printed
    for word in ("RMSE", "overshoot, worst of 4 steps", "effort", "NEES", "deadlines missed"):
        assert word in printed
    # the path may be longer; nothing else, and nothing is cut off
    assert all(len(line) <= 80 for line in printed.splitlines() if "run.mcap" not in line)
    assert "…" not in printed
    score.main([log, "--json"])
    document = json.loads(capsys.readouterr().out)
    assert document["schema"] == "trms.score/1" and document["log"] == log
    assert wording.number(document["channels"]["alpha_h"]["ise"]) in printed
    score.main([log, log, "--json"])
    both = json.loads(capsys.readouterr().out)
    assert both == {"schema": "trms.scores/1", "scores": [document, document]}


def test_the_log_of_a_run_that_died_is_called_incomplete(make_log, capsys):
    log = make_log(killed=True)
    assert score.main([str(log)]) == 0
    printed = capsys.readouterr().out
    assert "died" in printed and "incomplete" in printed
    score.main([str(log), "--json"])
    assert json.loads(capsys.readouterr().out)["complete"] is False


def test_a_slower_run_is_worse_than_the_baseline(make_log, capsys, tmp_path):
    good, slow = str(make_log("good.mcap")), str(make_log("slow.mcap", frequency=1.5))
    baseline = str(tmp_path / "baseline.json")
    assert score.main([good, "--write-baseline", baseline, "--reason", "first"]) == 0
    assert json.loads(Path(baseline).read_text())["reason"] == "first"
    assert score.main([good, "--baseline", baseline]) == 0
    assert "Not worse than the baseline baseline.json: no figure worse" in capsys.readouterr().out
    assert score.main([slow, "--baseline", baseline]) == 1
    printed = capsys.readouterr().out
    assert "Worse than the baseline" in printed and "alpha_h settling_time" in printed
    assert score.main([good, slow, "--baseline", baseline, "--json"]) == 1
    scores = json.loads(capsys.readouterr().out)["scores"]
    assert [one["comparison"]["worse"] for one in scores] == [False, True]
    assert score.main([good, "--baseline", baseline, "--all"]) == 0
    assert "alpha_v rmse" in capsys.readouterr().out
    # a printed score is a baseline too
    score.main([good, "--json"])
    saved = tmp_path / "score.json"
    saved.write_text(capsys.readouterr().out)
    assert score.main([good, "--baseline", str(saved)]) == 0


def test_a_baseline_is_not_overwritten_unasked(make_log, tmp_path):
    log, baseline = str(make_log()), tmp_path / "baseline.json"
    baseline.write_text("mine")
    with pytest.raises(RecordingError, match="already"):
        score.main([log, "--write-baseline", str(baseline)])
    assert baseline.read_text() == "mine"
    assert score.main([log, "--write-baseline", str(baseline), "--force"]) == 0
    assert json.loads(baseline.read_text())["schema"] == "trms.baseline/1"


def test_wrong_options_are_told():
    for wrong in (
        [],
        ["--jsn", "a"],
        ["a", "b", "--write-baseline", "c"],
        ["a", "--reason", "x"],
        ["a", "--all"],
    ):
        with pytest.raises(ConfigurationError):
            score.main(wrong)


def test_units_are_those_that_the_log_tells(tmp_path, capsys):
    states = [Field("S_h", "rad/s"), Field("alpha_h", "rad")]
    topics = standard_topics(inputs=[Field("u_h", "V")], states=states, estimates=states)
    with RunLog(tmp_path / "run.mcap", topics, {}) as log:
        for k in range(10):
            log.write("/plant/state", k * 10**7, (0.1, 0.2))
            log.write("/estimate", k * 10**7, (0.2, 0.3, 0.1, 0.1))
    assert score.main([str(tmp_path / "run.mcap")]) == 0
    printed = capsys.readouterr().out
    assert re.search(r"S_h \[rad/s\] +0\.1\b", printed) and "N*m*s" not in printed


@pytest.mark.parametrize(
    ("p", "correlation", "square", "said", "warned"),
    [
        (0.3, 0.01, 1.0, "innovations white\nNIS 0.90 to 1.00 a channel (1 is consistent", False),
        # an encoder's steps: certain, and no reason to doubt the model
        (0.0, 0.32, 1.1, "innovations not white (lag-1 correlation 0.32 at most)\nNIS", False),
        (0.0, -0.5, None, "not white (lag-1 correlation -0.50 at most)\nNIS 0.90 a", False),
        (0.0, 0.95, 1.0, "not white (lag-1 correlation 0.95 at most)", True),
        (0.0, 0.1, 7.3, "NIS 0.90 to 7.30", True),
    ],
)
def test_innovations_are_doubted_by_size_not_by_number_of_samples(
    p, correlation, square, said, warned
):
    estimate = {
        "innovation_whiteness_p": p,
        "innovations": {
            "alpha_v": {"normalised_square": 0.9, "correlation": 0.0},
            "alpha_h": {"normalised_square": square, "correlation": correlation},
        },
    }
    lines = innovation_sentences(estimate)
    assert said in "\n".join(lines)
    assert any("misses something" in line for line in lines) is warned


def test_without_innovations_nothing_is_said_of_them():
    assert innovation_sentences({"innovation_whiteness_p": None, "innovations": {}}) == []


@pytest.mark.parametrize(
    ("given", "problem", "remedy"),
    [
        (["fit"], "no log of a run in it", "runs lists them"),
        (["nothing.mcap"], "no such file", "runs lists the runs there are"),
        (["run.mcap", "--baseline", "nope.json"], "read: No such file", "--write-baseline FILE"),
        (["run.mcap", "--write-baseline", "run.mcap/b.json"], "is a file", "--write-baseline"),
    ],
)
def test_a_place_that_is_wrong_is_told_with_what_to_do(
    make_log, tmp_path, monkeypatch,
    given, problem, remedy
):  # fmt: skip
    make_log("run.mcap").rename(tmp_path / "run.mcap")
    (tmp_path / "fit").mkdir()
    monkeypatch.chdir(tmp_path)
    with pytest.raises(RecordingError, match=problem) as raised:
        score.main(given)
    assert remedy in raised.value.remedy and "Errno" not in str(raised.value)
