"""The folder of a run and the record of a sweep: nothing is begun twice, nothing half-written."""

import json
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest

from trms_cli.core.errors import ConfigurationError, RecordingError
from trms_cli.sweeps.record import (
    POINTS_NAME,
    Claim,
    Record,
    RunFolder,
    SweepPlan,
    drive_sweep,
    has_driver,
    is_alive,
    lost,
)
from trms_cli.sweeps.space import Choice, PriorOfKey, Range, Space, SweepPoint


def test_of_many_that_claim_an_attempt_one_gets_it(tmp_path):
    with ThreadPoolExecutor(16) as pool:
        got = list(pool.map(lambda _: RunFolder(tmp_path, 7).claim(1), range(64)))
    assert got.count(True) == 1
    folder = RunFolder(tmp_path, 7)
    assert folder.last_attempt() == 1 and folder.holder().pid == os.getpid()
    assert folder.claim(2) and not folder.claim(1) and folder.last_attempt() == 2


def test_what_a_dead_attempt_left_is_kept_under_names_that_are_no_run(tmp_path):
    folder = RunFolder(tmp_path, 0)
    folder.claim(1)
    (folder.path / "run.mcap").write_bytes(b"half")
    folder.write({"schema": "trms.status/1", "state": "running"})
    (folder.path / "plots").mkdir()
    (folder.path / "plots" / "a.png").write_bytes(b"x")
    folder.claim(2)
    folder.put_aside(2)
    left = sorted(p.relative_to(tmp_path).as_posix() for p in tmp_path.rglob("*") if p.is_file())
    assert left == [
        "0/.attempt-1",
        "0/.attempt-2",
        "0/attempt-1/plots/a.png.dead",
        "0/attempt-1/run.mcap.dead",
        "0/attempt-1/status.json.dead",
    ]
    assert (folder.path / "attempt-1" / "run.mcap.dead").read_bytes() == b"half"


def test_who_lives():
    process = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    host = os.uname().nodename
    assert is_alive(Claim(1, host, process.pid, "")) is True
    assert is_alive(Claim(1, host, process.pid, "another birth")) is False
    assert is_alive(Claim(1, "another host", process.pid, "")) is None
    process.kill()
    if sys.platform == "linux":  # dead, and nobody has asked how: a zombie
        while is_alive(Claim(1, host, process.pid, "its birth")):
            pass
    process.wait()
    assert is_alive(Claim(1, host, process.pid, "")) is False


def test_a_lost_run_tells_what_is_known(tmp_path):
    before = {"begin": "then", "pid": 3, "host": "a", "state": "running"}
    status = lost(SweepPoint(4, ("seed=1",)), 2, "killed", before)
    assert status["state"] == "lost" and status["begin"] == "then"
    assert "died 2 times: killed" in status["error"]["problem"]


@pytest.fixture
def plan() -> SweepPlan:
    space = Space(
        ("controller=pid",),
        (Choice("seed", ("1", "2")),),
        (Range("a.b", 0.1, 1.0, True), PriorOfKey("plant.parameters.k_g", 0.2, 0.01, 0.1, 0.3)),
    )
    return SweepPlan(
        "run", "trms_cli.commands.run:perform", ("controller=pid",), (), space, {"a": 1}, {"b": 2}
    )


def test_the_plan_comes_back_as_it_was(tmp_path, plan):
    record = Record(tmp_path)
    record.begin(plan)
    record.note(total=12)
    assert record.plan() == plan
    assert record.document()["total"] == 12 and record.document()["schema"] == "trms.sweep/1"


def test_a_half_written_line_is_cut_off(tmp_path, plan):
    record = Record(tmp_path)
    record.append(
        [SweepPoint(0, ("seed=1",), {"seed": "1"}), SweepPoint(1, ("seed=2",), {}, trial=3)]
    )
    whole = (tmp_path / POINTS_NAME).read_bytes()
    with (tmp_path / POINTS_NAME).open("ab") as stream:
        stream.write(b'{"number": 2, "overr')
    assert len(record.points()) == 2
    assert record.points(mend=True)[1].trial == 3
    assert (tmp_path / POINTS_NAME).read_bytes() == whole


@pytest.mark.parametrize("line", ["{}", "[", json.dumps({"number": 5, "overrides": []})])
def test_points_that_cannot_be_read_are_told_with_their_line(tmp_path, line):
    (tmp_path / POINTS_NAME).write_text(line + "\n")
    with pytest.raises(RecordingError) as told:
        Record(tmp_path).points()
    assert "line 1" in told.value.where


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"schema": "trms.sweep/2"}', "\x00"])
def test_a_record_of_a_stranger(tmp_path, text):
    (tmp_path / "sweep.json").write_text(text)
    with pytest.raises(RecordingError):
        Record(tmp_path).plan()


def test_one_process_drives_a_sweep_and_a_dead_one_holds_nothing(tmp_path):
    code = (
        "import sys; from pathlib import Path; from trms_cli.sweeps.record import drive_sweep\n"
        "with drive_sweep(Path(sys.argv[1])): print('in', flush=True); input()"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code, str(tmp_path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    assert process.stdout.readline() == b"in\n"
    assert has_driver(tmp_path)
    with pytest.raises(ConfigurationError, match=f"process {process.pid}"), drive_sweep(tmp_path):
        pass
    process.kill()
    process.wait()
    with drive_sweep(tmp_path):
        assert has_driver(tmp_path)
    assert not has_driver(tmp_path)
