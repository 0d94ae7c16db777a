"""A score: its document, the same from a log as from memory, and what `trms score` prints."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from tests.program import loaded_by
from trms_cli.commands import score as score_command
from trms_cli.core import wording
from trms_cli.core.errors import ConfigurationError, RecordingError
from trms_cli.recordings.log_reader import read_log
from trms_cli.scoring.findings import innovation_sentences
from trms_cli.scoring.score import Series, score_log, score_tables

from .conftest import LIMITS, response_tables


def test_the_document_has_the_keys_of_the_schema(score):
    assert list(score) == [
        "schema", "log", "complete", "duration_s", "channels", "inputs", "estimate", "solver",
        "constraint_violations", "degraded",
    ]  # fmt: skip
    assert score["schema"] == "trms.score/1"
    for channel in ("alpha_v", "alpha_h"):
        assert set(score["channels"][channel]) >= {
            "rmse", "iae", "ise", "itae", "max_abs_error", "overshoot_percent", "rise_time_s",
            "settling_time_s", "steady_state_error", "unit",
        }  # fmt: skip
    assert set(score["inputs"]["u_h"]) >= {"effort", "total_variation", "saturation_share"}
    assert set(score["estimate"]) >= {"rmse", "nees_mean", "innovation_whiteness_p"}
    assert set(score["solver"]) == {
        "time_ms", "deadline_misses", "iterations_mean", "failures", "objective_total",
    }  # fmt: skip
    assert set(score["solver"]["time_ms"]) == {"median", "p99", "max"}
    json.dumps(score, allow_nan=False)


def test_the_figures_are_those_of_the_run(score):
    pitch = score["channels"]["alpha_v"]
    overshoot = 100 * math.exp(-math.pi * 0.6 / 0.8)
    assert pitch["steps"] == 4 and pitch["unsettled_steps"] == 0
    assert pitch["overshoot_percent"] == pytest.approx(overshoot, abs=0.05)
    assert pitch["steady_state_error"] < 1e-4
    assert pitch["unit"] == "rad" and pitch["scored_on"] == "state"
    # yaw is pitch times 5/3
    yaw = score["channels"]["alpha_h"]
    assert yaw["rmse"] == pytest.approx(pitch["rmse"] * 5 / 3)
    assert yaw["ise"] == pytest.approx(pitch["ise"] * 25 / 9)
    assert yaw["settling_time_s"] == pitch["settling_time_s"]
    assert score["inputs"]["u_h"]["total_variation"] == pytest.approx(3.0)
    assert score["inputs"]["u_v"]["saturation_share"] > 0
    estimate = score["estimate"]
    assert estimate["rmse"]["alpha_v"] == pytest.approx(0.01, rel=0.05)
    assert estimate["nees_mean"] == pytest.approx(2.0, rel=0.1)
    assert estimate["nees_expected"] == 2
    assert estimate["innovation_whiteness_p"] > 0.01
    assert estimate["prediction_rmse"]["alpha_h"] == pytest.approx(0.002, rel=0.05)
    assert estimate["innovations"]["alpha_v"]["normalised_square"] == pytest.approx(1.0, rel=0.1)
    assert abs(estimate["innovations"]["alpha_v"]["correlation"]) < 0.05
    assert score["solver"]["time_ms"]["median"] == pytest.approx(0.1)
    assert score["solver"]["time_ms"]["max"] == pytest.approx(5.0)
    assert score["solver"]["deadline_misses"] == 1
    assert score["solver"]["failures"] == 1
    assert score["solver"]["objective_total"] == pytest.approx(400.0)
    assert score["constraint_violations"]["u_v"] == {"samples": 0, "worst": 0.0, "unit": "V"}


def test_a_log_scores_as_its_run_did_in_memory(make_log):
    from_file = score_log(read_log(make_log()))
    tables = response_tables()
    from_memory = score_tables(
        tables, limits=LIMITS, duration_s=from_file["duration_s"], log=from_file["log"]
    )
    assert from_file == from_memory


def test_without_truth_the_measurement_is_scored_and_without_references_the_predictions():
    tables = response_tables()
    del tables["/plant/state"]
    score = score_tables(tables, limits={}, duration_s=40.0)
    assert score["channels"]["alpha_v"]["scored_on"] == "measurement"
    assert score["estimate"]["rmse"] == {}
    assert score["estimate"]["nees_mean"] is None
    assert score["inputs"]["u_v"]["saturation_share"] is None
    assert score["constraint_violations"] == {}
    replay = {topic: tables[topic] for topic in ("/measurement", "/command", "/estimate")}
    score = score_tables(replay, limits={}, duration_s=40.0)
    assert score["channels"] == {}
    assert score["solver"]["failures"] is None
    assert score["solver"]["time_ms"] == {"median": None, "p99": None, "max": None}
    assert score["estimate"]["prediction_rmse"]["alpha_v"] == pytest.approx(0.002, rel=0.05)


def test_a_run_of_nothing_is_all_null():
    score = score_tables({}, limits=LIMITS, duration_s=0.0, complete=False)
    assert score["channels"] == score["inputs"] == score["constraint_violations"] == {}
    assert score["solver"]["deadline_misses"] is None
    empty = Series(np.zeros(0), {"alpha_v": np.zeros(0)})
    topics = ("/reference", "/plant/state", "/measurement", "/estimate", "/controller")
    also = score_tables(dict.fromkeys(topics, empty), limits=LIMITS, duration_s=0.0, complete=False)
    assert also == score


def test_what_a_sine_or_a_step_that_never_settles_does_not_have_is_null():
    tables = response_tables()
    time = tables["/reference"].time
    tables["/reference"] = Series(time, {"alpha_v": 0.3 * np.sin(time)})
    channel = score_tables(tables, limits={}, duration_s=40.0)["channels"]["alpha_v"]
    for key in ("overshoot_percent", "rise_time_s", "settling_time_s", "steady_state_error"):
        assert channel[key] is None
    assert channel["steps"] == 0
    assert channel["rmse"] > 0
    tables = response_tables()
    time = tables["/reference"].time
    state = {
        name: np.where(time < 10, values, 0.0)
        for name, values in tables["/plant/state"].columns.items()
    }
    tables["/plant/state"] = Series(time, state)
    channel = score_tables(tables, limits={}, duration_s=40.0)["channels"]["alpha_v"]
    assert channel["settling_time_s"] is None
    assert channel["unsettled_steps"] == 3


def test_channels_of_different_rates_are_brought_together(score):
    tables, whole = response_tables(), score["channels"]["alpha_v"]
    reference = tables["/reference"]
    slow = {name: values[::10] for name, values in reference.columns.items()}
    tables["/reference"] = Series(reference.time[::10], slow)
    coarse = score_tables(tables, limits={}, duration_s=40.0)["channels"]["alpha_v"]
    assert coarse["rmse"] == pytest.approx(whole["rmse"], rel=0.1)
    assert coarse["steps"] == whole["steps"]


def test_limits_are_counted_where_they_are_exceeded():
    limits = {"alpha_v": (-0.2, 0.2), "u_h": (-0.5, 0.5), "elsewhere": (0.0, 1.0)}
    found = score_tables(response_tables(), limits=limits, duration_s=40.0)["constraint_violations"]
    assert set(found) == {"alpha_v", "u_h"}
    assert found["u_h"]["samples"] == 0
    assert found["alpha_v"]["samples"] > 3000
    assert found["alpha_v"]["worst"] == pytest.approx(0.1 + 0.6 * math.exp(-math.pi * 0.75), 0.01)


def test_scoring_needs_no_library_that_is_slow_to_import(tmp_path):
    loaded = loaded_by("import trms_cli.scoring.score, trms_cli.scoring.baseline", tmp_path)
    assert not loaded & {"scipy", "mcap", "casadi", "pyarrow", "rich"}


def test_units_are_those_of_the_schema_not_of_the_name():
    tables = response_tables()
    time = tables["/reference"].time
    spin = {"S_h": np.ones(time.size)}
    tables["/plant/state"] = Series(time, spin, {"S_h": "rad/s"})
    tables["/estimate"] = Series(
        time,
        spin | {"innovation_alpha_h": np.ones(time.size)},
        {"S_h": "rad/s", "innovation_alpha_h": "rad"},
    )
    tables["/command"] = Series(time, {"u_v": np.ones(time.size)}, {"u_v": "1"})
    score = score_tables(tables, limits={}, duration_s=40.0)
    assert score["estimate"]["units"] == {"S_h": "rad/s", "alpha_h": "rad"}
    assert score["inputs"]["u_v"]["unit"] == "1"
    tables["/command"] = Series(time, {"u_v": np.ones(time.size)})
    assert score_tables(tables, limits={}, duration_s=40.0)["inputs"]["u_v"]["unit"] == ""


def test_nis_is_what_a_consistent_filter_makes(score):
    estimate = score["estimate"]
    assert estimate["nis_expected"] == 2
    assert estimate["nis_mean"] == pytest.approx(2.0, rel=0.1)
    assert estimate["nis_interval"] == pytest.approx([0.0506, 7.3778], abs=1e-4)
    assert estimate["nis_share_inside"] == pytest.approx(0.95, abs=0.02)
    tables = response_tables()
    for name in ("alpha_v", "alpha_h"):
        tables["/estimate"].columns[f"innovation_sd_{name}"][:] = 0.001
    doubtful = score_tables(tables, limits=LIMITS, duration_s=40.0)["estimate"]
    assert doubtful["nis_mean"] == pytest.approx(8.0, rel=0.1)
    assert doubtful["nis_share_inside"] < 0.7


def test_missing_and_rejected_samples_are_counted_and_left_out(score):
    tables, before = response_tables(), score["estimate"]
    time = tables["/estimate"].time
    columns = {name: np.array(values) for name, values in tables["/estimate"].columns.items()}
    columns["innovation_alpha_v"][[500, 700, 900]] = 0.3
    columns["innovation_alpha_h"][[600, 601]] = np.nan
    tables = {**tables, "/estimate": Series(time, columns)}
    spoilt = score_tables(tables, limits=LIMITS, duration_s=40.0)["estimate"]
    assert spoilt["prediction_rmse"]["alpha_v"] > 3 * before["prediction_rmse"]["alpha_v"]
    events = Series(
        time[[10, 500, 700, 900]],
        {
            "kind": np.array(["fault", "outlier", "outlier", "outlier"], dtype=object),
            "source": np.array(["alpha_v"] * 4, dtype=object),
            "message": np.array([""] * 4, dtype=object),
            "value": np.zeros(4),
        },
    )
    told = score_tables({**tables, "/event": events}, limits=LIMITS, duration_s=40.0)["estimate"]
    assert (told["missing_samples"], told["rejected_samples"]) == (2, 3)
    assert told["innovations"]["alpha_v"]["rejected"] == 3
    assert told["innovations"]["alpha_h"]["missing"] == 2
    assert told["nis_mean"] == pytest.approx(before["nis_mean"], rel=0.02)
    assert told["prediction_rmse"]["alpha_v"] == pytest.approx(
        before["prediction_rmse"]["alpha_v"], rel=0.02
    )


def test_a_table_and_a_json_with_its_figures(make_log, capsys):
    log = str(make_log())
    assert score_command.main([log]) == 0
    printed = capsys.readouterr().out
    assert "40 s, completed, scored on the true state" in printed
    for word in ("RMSE", "overshoot, worst of 4 steps", "effort", "NEES", "deadlines missed"):
        assert word in printed
    score_command.main([log, "--json"])
    document = json.loads(capsys.readouterr().out)
    assert document["schema"] == "trms.score/1" and document["log"] == log
    assert wording.number(document["channels"]["alpha_h"]["ise"]) in printed
    score_command.main([log, log, "--json"])
    both = json.loads(capsys.readouterr().out)
    assert both == {"schema": "trms.scores/1", "scores": [document, document]}


def test_the_log_of_a_run_that_died_is_called_incomplete(make_log, capsys):
    log = make_log(killed=True)
    assert score_command.main([str(log)]) == 0
    printed = capsys.readouterr().out
    assert "died" in printed and "incomplete" in printed
    score_command.main([str(log), "--json"])
    assert json.loads(capsys.readouterr().out)["complete"] is False


def test_a_slower_run_is_worse_than_the_baseline(make_log, capsys, tmp_path):
    good, slow = str(make_log("good.mcap")), str(make_log("slow.mcap", frequency=1.5))
    baseline = str(tmp_path / "baseline.json")
    assert score_command.main([good, "--write-baseline", baseline, "--reason", "first"]) == 0
    assert json.loads(Path(baseline).read_text())["reason"] == "first"
    assert score_command.main([good, "--baseline", baseline]) == 0
    assert "Not worse than the baseline baseline.json: no figure worse" in capsys.readouterr().out
    assert score_command.main([slow, "--baseline", baseline]) == 1
    printed = capsys.readouterr().out
    assert "Worse than the baseline" in printed and "alpha_h settling_time" in printed
    assert score_command.main([good, slow, "--baseline", baseline, "--json"]) == 1
    scores = json.loads(capsys.readouterr().out)["scores"]
    assert [one["comparison"]["worse"] for one in scores] == [False, True]
    assert score_command.main([good, "--baseline", baseline, "--all"]) == 0
    assert "alpha_v rmse" in capsys.readouterr().out
    # a printed score is a baseline too
    score_command.main([good, "--json"])
    saved = tmp_path / "score.json"
    saved.write_text(capsys.readouterr().out)
    assert score_command.main([good, "--baseline", str(saved)]) == 0


def test_a_baseline_is_not_overwritten_unasked(make_log, tmp_path):
    log, baseline = str(make_log()), tmp_path / "baseline.json"
    baseline.write_text("mine")
    with pytest.raises(RecordingError, match="already"):
        score_command.main([log, "--write-baseline", str(baseline)])
    assert baseline.read_text() == "mine"
    assert score_command.main([log, "--write-baseline", str(baseline), "--force"]) == 0
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
            score_command.main(wrong)


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
        score_command.main(given)
    assert remedy in raised.value.remedy and "Errno" not in str(raised.value)
