"""The driver and the record of a sweep: each point ends once, nothing is lost or half-written."""

import json
import os
import random
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trms_cli.core.errors import ConfigurationError, RecordingError, TrmsError
from trms_cli.sweeps.driver import DISK_FULL, Driver
from trms_cli.sweeps.plugins import Attempt, EndedAttempt
from trms_cli.sweeps.record import (
    POINTS_NAME,
    Claim,
    Record,
    RunFolder,
    SweepPlan,
    drive_sweep,
    has_driver,
    is_alive,
    lost_status,
)
from trms_cli.sweeps.space import Choice, PriorOfKey, Range, RunResult, Space, SweepPoint

from .listed import Listed

DEAD = subprocess.Popen(["true"])
DEAD.wait()


class Unreliable:
    """A crew whose workers die at every stage of a run, and whose messages are lost or doubled."""

    workers = 3

    def __init__(self, folder, chance, deaths):
        self.folder, self.chance, self.deaths = folder, chance, deaths
        self.begins: dict[int, int] = {}
        self.finished: dict[int, int] = {}
        self.given: list[Attempt] = []

    @contextmanager
    def crew(self, work):
        yield self

    def submit(self, attempts):
        self.given += attempts

    def collect(self, timeout_s):
        if not self.given:
            return []
        attempt = self.given.pop(self.chance.randrange(len(self.given)))
        fate = self.chance.choice(["good", *self.deaths])
        if fate == "before":
            return [EndedAttempt(attempt, None, "died")]
        found = self.work(attempt, dies=fate == "amid")
        if fate == "twice":  # the engine has handed it to a second worker
            assert self.work(attempt, dies=False) is None or found is not None
            found = found or RunFolder(self.folder, attempt.point.number).result()
        if fate in ("amid", "after"):
            return [EndedAttempt(attempt, None, "died")]
        return [EndedAttempt(attempt, found)] * (2 if fate == "told twice" else 1)

    def work(self, attempt, *, dies):
        run = RunFolder(self.folder, attempt.point.number)
        if not run.claim(attempt.number):
            return run.result()
        self.begins[run.number] = self.begins.get(run.number, 0) + 1
        status = {"schema": "trms.status/1", "state": "running"}
        run.write(status)
        if dies:
            claim = run.attempt_file(attempt.number)
            claim.write_text(claim.read_text().replace(str(os.getpid()), str(DEAD.pid)))
            return None
        run.write(status | {"state": "done", "objective": 1.0})
        self.finished[run.number] = self.finished.get(run.number, 0) + 1
        return RunResult(run.number, "done", objective=1.0)


def _driver(folder, count, begun=0, **more) -> Driver:
    proposals = Listed(count, begun)
    return Driver(Record(folder), proposals, lambda attempt: None, **{"retries": 1} | more)


FATES = ["before", "amid", "after", "twice", "told twice"]


@settings(max_examples=60)
@given(
    seed=st.integers(0, 10**6),
    count=st.integers(1, 12),
    retries=st.integers(0, 3),
    deaths=st.sets(st.sampled_from(FATES)),
)
def test_each_point_ends_once(tmp_path_factory, seed, count, retries, deaths):
    folder = tmp_path_factory.mktemp("sweep")
    record = Record(folder)
    proposals = Listed(count)
    crew = Unreliable(folder, random.Random(seed), sorted(deaths))
    driver = Driver(record, proposals, lambda attempt: None, retries=retries)
    driver.drive(crew)
    results = driver.progress.results
    assert sorted(results) == list(range(count))
    assert [point.number for point in record.points()] == list(range(count))
    assert all(times == 1 for times in crew.finished.values())  # none is made twice
    assert all(times <= retries + 1 for times in crew.begins.values())
    for number, result in results.items():
        assert RunFolder(folder, number).result().state == result.state
        assert (result.state == "done") == (number in crew.finished)
        assert result.state == "done" or crew.begins[number] == retries + 1
    if "amid" not in deaths:
        assert set(crew.finished) == set(range(count))
    assert {result.number for result in proposals.told} == set(range(count))


@settings(max_examples=30)
@given(seed=st.integers(0, 10**6), stops=st.lists(st.integers(1, 6), max_size=4))
def test_a_driver_that_is_killed_again_and_again(tmp_path_factory, seed, stops):
    """Whatever it had handed out, the next one goes on, and nothing is made twice."""

    class Killed(BaseException):
        pass

    folder = tmp_path_factory.mktemp("sweep")
    record, chance, count = Record(folder), random.Random(seed), 9
    crew = Unreliable(folder, chance, ["amid", "after", "before"])
    for stop in [*stops, None]:
        known = record.points(mend=True)
        crew.given.clear()

        def tell(progress, result, left=[stop]):  # noqa: B006
            if result is not None and left[0] is not None:
                left[0] -= 1
                if left[0] < 0:
                    raise Killed

        driver = _driver(folder, count, len(known), retries=50, tell=tell)
        try:
            driver.take_stock(known)
            driver.drive(crew)
        except Killed:
            continue
    assert set(crew.finished) == set(range(count))
    assert all(times == 1 for times in crew.finished.values())
    assert sorted(driver.progress.results) == list(range(count))


class Scripted(Unreliable):
    """Ends each attempt as a script says."""

    def __init__(self, folder, script):
        super().__init__(folder, random.Random(0), [])
        self.script = script

    def collect(self, timeout_s):
        attempt = self.given.pop(0) if self.given else None
        return [] if attempt is None else [EndedAttempt(attempt, self.script(self, attempt))]


def test_a_full_disk_ends_the_sweep_with_what_to_do(tmp_path):
    script = lambda crew, a: RunResult(a.point.number, "interrupted", problem=f"{DISK_FULL}: x")  # noqa: E731
    with pytest.raises(TrmsError, match="disk is full") as told:
        _driver(tmp_path, 2).drive(Scripted(tmp_path, script))
    assert "sweep resume" in told.value.remedy


def test_a_worker_that_is_told_to_go_has_not_failed_at_its_run(tmp_path):
    times: dict[int, int] = {}

    def script(crew, attempt):
        number = attempt.point.number
        times[number] = times.get(number, 0) + 1
        if times[number] <= 3:
            RunFolder(tmp_path, number).claim(attempt.number)
            RunFolder(tmp_path, number).write({"schema": "trms.status/1", "state": "interrupted"})
            return RunResult(number, "interrupted")
        return crew.work(attempt, dies=False)

    driver = _driver(tmp_path, 2, retries=0)
    driver.drive(Scripted(tmp_path, script))
    assert driver.progress.counts == {"done": 2} and driver.progress.retried == 6


def test_failed_runs_are_made_again_only_when_asked(tmp_path):
    def fails(crew, attempt):
        RunFolder(tmp_path, attempt.point.number).claim(attempt.number)
        status = {"schema": "trms.status/1", "state": "failed", "error": {"problem": "bad"}}
        RunFolder(tmp_path, attempt.point.number).write(status)
        return RunResult(attempt.point.number, "failed", problem="bad")

    _driver(tmp_path, 3).drive(Scripted(tmp_path, fails))
    known = Record(tmp_path).points()
    for again, expected in ((False, {"failed": 3}), (True, {"done": 3})):
        driver = _driver(tmp_path, 3, 3, retry_failed=again)
        driver.take_stock(known)
        driver.drive(Scripted(tmp_path, lambda crew, a: crew.work(a, dies=False)))
        assert driver.progress.counts == expected


def test_thousands_of_points_are_handed_out_in_linear_time(tmp_path):
    """Counted in looks at the disk: a sweep must not go through its folders for each run."""
    looks = 0
    listed = os.listdir

    def counted(*args):
        nonlocal looks
        looks += 1
        return listed(*args)

    count = 400
    driver = _driver(tmp_path, count)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "listdir", counted)
        driver.drive(Scripted(tmp_path, lambda crew, a: crew.work(a, dies=False)))
    assert driver.progress.counts == {"done": count}
    assert looks <= 3 * count


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
    status = lost_status(SweepPoint(4, ("seed=1",)), 2, "killed", before)
    assert status["state"] == "lost" and status["begin"] == "then"
    assert "died 2 times: killed" in status["error"]["problem"]


def test_the_plan_comes_back_as_it_was(tmp_path):
    space = Space(
        ("controller=pid",),
        (Choice("seed", ("1", "2")),),
        (Range("a.b", 0.1, 1.0, True), PriorOfKey("plant.parameters.k_g", 0.2, 0.01, 0.1, 0.3)),
    )
    work = "trms_cli.commands.run:perform"
    plan = SweepPlan("run", work, ("controller=pid",), (), space, {"a": 1}, {"b": 2})
    record = Record(tmp_path)
    record.begin(plan)
    record.note(total=12)
    assert record.plan() == plan
    assert record.document()["total"] == 12 and record.document()["schema"] == "trms.sweep/1"


def test_a_half_written_line_is_cut_off(tmp_path):
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
