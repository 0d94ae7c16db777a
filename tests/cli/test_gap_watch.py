"""``trms watch --gap`` and ``gap_watch=standard``: a run whose yaw encoder slips at 12 s."""

import json
import shutil
from pathlib import Path

import pytest

from tests.program import in_process
from trms_cli.commands.watch.gap import GapScreen, line_of, summary_of
from trms_cli.library.tasks.gap_watch import GapReplay
from trms_cli.recordings.log_reader import read_log

RUN = ("run", "controller=lqr", "fault=yaw_encoder_slipped", "ref=sine", "sim.duration=40")


@pytest.fixture(scope="module")
def lab(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("lab")
    in_process(folder, *RUN, "gap_watch=standard", "picture=false", "out=one", TRMS_RUNS="off")
    return folder


@pytest.fixture(scope="module")
def replay(lab):
    whole = GapReplay(lab / "one" / "run.mcap")
    whole.advance()
    yield whole
    whole.close()


def test_a_log_is_watched_with_its_own_model(replay):
    (alarm,) = (alarm for alarm in replay.alarms if alarm.kind == "change")
    assert replay.has_ended
    assert replay.time == pytest.approx(39.98)
    assert replay.model == "newtonian"
    assert alarm.location == "yaw_sensor"
    assert alarm.since == pytest.approx(12.0, abs=0.05)
    assert alarm.size == pytest.approx(0.1, abs=0.005)
    assert alarm.time < 25.0


def test_lines_and_json_say_the_same(lab, replay):
    lines = in_process(lab, "watch", "--gap", "one").stdout.splitlines()
    assert lines == [*map(line_of, replay.alarms), summary_of(replay)]
    document = json.loads(in_process(lab, "watch", "--gap", "one/run.mcap", "--json").stdout)
    assert document["schema"] == "trms.gap_alarms/1"
    assert document["complete"] is True
    change = next(alarm for alarm in document["alarms"] if alarm["kind"] == "change")
    assert change["location"] == "yaw_sensor"
    assert change["unit"] == "rad"


def test_the_loop_says_what_its_log_says_later(lab, replay):
    score = json.loads((lab / "one" / "score.json").read_text())
    assert score["gap_alarms"] == len(replay.alarms)


def test_a_replay_has_the_alarms_in_its_log(lab):
    words = ("plant=replay", "plant.file=one/run.mcap", "observer=ekf", "gap_watch=standard")
    in_process(lab, "run", *words, "picture=false", "out=again", TRMS_RUNS="off")
    with_event = read_log(lab / "again" / "run.mcap").table("/event")
    kinds = list(with_event.columns["kind"])
    assert "gap_alarm" in kinds
    at = kinds.index("gap_alarm")
    assert "yaw_sensor" in list(with_event.columns["source"])[at:]


def test_a_log_that_ends_amid_a_chunk_is_watched_up_to_there(lab, replay, tmp_path):
    log = tmp_path / "cut.mcap"
    shutil.copy(lab / "one" / "run.mcap", log)
    with log.open("r+b") as stream:
        stream.truncate(3 * log.stat().st_size // 4)
    part = GapReplay(log)
    part.advance()
    assert part.has_ended
    assert 20.0 < part.time < replay.time
    part.close()


def test_the_picture_holds_the_alarms_and_fits(replay):
    screen = GapScreen(replay, plain=True)
    lines = [line.plain for line in screen.frame(80, 12, keys=False)]
    assert len(lines) <= 12
    assert all(len(line) <= 80 for line in lines)
    assert any("statistic [" in line for line in lines)
    alarm = " ".join(" ".join(lines).split())
    assert "yaw_sensor" in alarm and "threshold" in alarm  # whole, on as many lines as it takes
    assert screen.is_over(keys=True)
    assert not screen.press("q")


def test_what_cannot_be_watched_is_told(lab, tmp_path):
    assert "only what --gap" in in_process(lab, "watch", "one", "--json", code=2).said
    (tmp_path / "empty.mcap").write_bytes(b"")
    assert in_process(tmp_path, "watch", "--gap", "empty.mcap", code=None).returncode != 0
    assert in_process(tmp_path, "watch", "--gap", "none.mcap", code=None).returncode != 0


def test_a_wrong_key_is_told(lab):
    words = ("run", "gap_watch=standard", "gap_watch.treshold=3", "sim.duration=1")
    assert "threshold" in in_process(lab, *words, code=2).said
    words = ("run", "gap_watch=standard", "gap_watch.threshold=-3", "sim.duration=1")
    assert "gap_watch.threshold" in in_process(lab, *words, code=2).said
