"""Sweeps as typed: worker and driver killed, resumed, failing, refused; one record of it all."""

import json
import os
import re
import shutil
import signal
from collections import Counter
from pathlib import Path

import pytest

from tests.program import in_process, wait_for
from trms_cli.recordings.log_reader import read_log
from trms_cli.reporting.sweep_screen import say_outcome
from trms_cli.sweeps.outcome import outcome_of

REST = ["observer=full_state", "plant=ideal", "sim.duration=0.5"]
SHORT = ["controller=pid", *REST]


@pytest.fixture
def plugins(misbehaving) -> list[str]:
    return [*misbehaving, "--allow", "misbehaving"]


@pytest.fixture
def begun(tmp_path, monkeypatch):
    """Counts runs that have begun to write a log, by their folder."""
    ledger = tmp_path / "ledger"
    monkeypatch.setenv("TRMS_RUNS", str(ledger))

    def count() -> Counter[str]:
        lines = [file.read_text().splitlines() for file in ledger.glob("new-runs-*")]
        return Counter(Path(line).parent.name for each in lines for line in each)

    return count


def statuses(sweep: Path) -> dict[int, dict]:
    found = {}
    for file in sweep.glob("*/status.json"):
        found[int(file.parent.name)] = json.loads(file.read_text(encoding="utf-8"))
    return found


def running(sweep: Path) -> list[dict]:
    """Runs that write their log at present."""
    return [
        status
        for number, status in statuses(sweep).items()
        if status["state"] == "running" and (sweep / str(number) / "run.mcap").exists()
    ]


def states(sweep: Path) -> Counter[str]:
    return Counter(status["state"] for status in statuses(sweep).values())


class TestAWholeSweep:
    @pytest.fixture(scope="class")
    @classmethod
    def made(cls, tmp_path_factory):
        folder = tmp_path_factory.mktemp("lab")
        varied = ["plant=simulated", "plant.parameters.k_g=0.19,0.2", "seed=1,2"]
        result = in_process(folder, "run", "-m", *SHORT, *varied, "out=s")
        return folder / "s", result

    def test_its_screen(self, made):
        folder, result = made
        assert "4 of 4 runs done" in result.stdout and result.stdout.count("RMSE") == 4
        assert f"folder     {folder}" in result.stdout and "compare" in result.stdout
        assert result.stderr == ""

    def test_its_runs(self, made):
        folder, _ = made
        for number in range(4):
            status = statuses(folder)[number]
            assert status["schema"] == "trms.status/1" and status["state"] == "done"
            assert status["job"] == number
            assert status["attempt"] == 1 and status["begin"] < status["end"]
            assert status["host"] == os.uname().nodename and status["pid"] != os.getpid()
            score = json.loads((folder / str(number) / "score.json").read_text())
            assert status["figures"]["rmse_alpha_h"] == score["channels"]["alpha_h"]["rmse"]
            assert status["objective"] == status["figures"]["rmse"]
            log = read_log(folder / str(number) / "run.mcap")
            assert log.complete and log.run["command"].startswith("trms run ")
            typed = json.loads(log.run["overrides"])
            assert typed == status["overrides"] and "picture=false" in typed
            assert not (folder / str(number) / "run.png").exists()

    def test_its_record(self, made):
        folder, _ = made
        record = json.loads((folder / "sweep.json").read_text(encoding="utf-8"))
        assert record["schema"] == "trms.sweep/1" and record["primary"] == "run"
        assert (record["state"], record["total"], record["counts"]["done"]) == ("done", 4, 4)
        assert record["directory"] == str(folder.parent) and "numpy" in record["versions"]
        assert not list(folder.rglob(".hydra"))
        points = [json.loads(line) for line in (folder / "points.jsonl").read_text().splitlines()]
        assert points[2]["values"] == {"plant.parameters.k_g": "0.2", "seed": "1"}
        told = [(point["number"], point["overrides"]) for point in points]
        assert told == [(n, statuses(folder)[n]["overrides"]) for n in range(4)]

    def test_other_commands_know_it(self, made, trms):
        folder, _ = made
        assert len(json.loads(trms("runs", "--in", str(folder), "--json").stdout)["runs"]) == 4
        trms("compare", str(folder))
        assert "4 / 4 done" in trms("watch", str(folder), "--once").stdout
        assert "4 of 4 runs done" in trms("sweep", "status", str(folder)).stdout
        document = json.loads(trms("sweep", "status", str(folder), "--json").stdout)
        assert document["schema"] == "trms.sweep-status/1"
        assert document["counts"]["done"] == document["total"] == 4
        assert document["failures"] == [] and document["best"]["run"] in range(4)
        best = statuses(folder)[document["best"]["run"]]["objective"]
        assert best == min(status["objective"] for status in statuses(folder).values())

    def test_resuming_it_does_nothing(self, made, trms, begun):
        folder, _ = made
        before = {file: file.stat().st_mtime_ns for file in folder.rglob("*.mcap")}
        assert "4 of 4 runs done" in trms("sweep", "resume", str(folder)).stdout
        assert before == {file: file.stat().st_mtime_ns for file in folder.rglob("*.mcap")}
        assert not begun()


def kill_a_worker(started, tmp_path, begun, words: list[str]) -> dict:
    """Kill the worker of a run that waits, then let all go: the run's status, and the screen."""
    process = started("run", *words, "-m", *REST, "controller=held", "seed=range(3)", "out=s")
    sweep = tmp_path / "s"
    victim = wait_for(lambda: [run for run in running(sweep) if begun()[str(run["job"])]])[0]
    os.kill(victim["pid"], signal.SIGKILL)
    (tmp_path / "go").touch()
    out, err = process.communicate(timeout=200)
    assert process.returncode == 0, err
    assert "3 of 3 runs done" in out and states(sweep) == {"done": 3}
    assert begun() == Counter(map(str, range(3))) + Counter([str(victim["job"])])
    return victim | {"screen": out}


@pytest.mark.slow
def test_a_killed_worker_costs_one_attempt(started, tmp_path, begun, plugins):
    sweep = tmp_path / "s"
    victim = kill_a_worker(started, tmp_path, begun, [*plugins, "launcher.workers=2"])
    assert "1 tried again" in victim["screen"]
    assert statuses(sweep)[victim["job"]]["attempt"] == 2
    kept = sweep / str(victim["job"]) / "attempt-1"
    assert {"run.mcap.dead", "status.json.dead"} <= set(os.listdir(kept))
    assert all(read_log(log).complete for log in sweep.glob("*/run.mcap"))
    assert len(list(sweep.rglob("*.mcap"))) == 3


@pytest.mark.parametrize(
    "how",
    [
        signal.SIGKILL,
        *(pytest.param(each, marks=pytest.mark.slow) for each in (signal.SIGINT, signal.SIGTERM)),
    ],
)
@pytest.mark.slow
def test_resumed_after_its_driver_has_gone(started, trms, tmp_path, begun, plugins, how):
    sweep = tmp_path / "s"
    words = [*plugins, "-m", *REST, "controller=pid,held", "seed=1,2", "launcher.workers=2"]
    process = started("run", *words, "out=s")
    wait_for(lambda: states(sweep)["done"] == 2 and len(running(sweep)) == 2)
    process.send_signal(how)
    assert process.wait(60) == {2: 130, 15: 143, 9: -9}[how]
    before = {
        number: status for number, status in statuses(sweep).items() if status["state"] == "done"
    }
    if how != signal.SIGKILL:
        err = process.stderr.read()
        assert "sweep resume" in err and "Traceback" not in err
        assert states(sweep) == {"done": 2, "interrupted": 2}
        record = json.loads((sweep / "sweep.json").read_text())
        assert record["state"] == "interrupted"
        assert "stopped before its end" in trms("sweep", "status", "s").stdout
    (tmp_path / "go").touch()
    result = trms("sweep", "resume", "s", "launcher.workers=1", "--allow", "misbehaving")
    assert "4 of 4 runs done" in result.stdout
    after = statuses(sweep)
    assert len(after) == 4 and states(sweep) == {"done": 4}
    for number, status in before.items():  # nothing that was done is repeated
        assert after[number] == status
        assert begun()[str(number)] == 1
    assert sum(begun().values()) <= 4 + 2
    assert all(read_log(log).complete for log in sweep.glob("*/run.mcap"))


def test_a_second_process_is_refused(started, trms, tmp_path, plugins):
    words = ["run", *plugins, "-m", *REST, "controller=held", "seed=1,2", "out=s"]
    process = started(*words, "launcher.workers=1")
    wait_for(lambda: running(tmp_path / "s"))
    result = trms("sweep", "resume", "s", code=2)
    assert f"process {process.pid}" in result.stderr
    assert "going on" in trms("sweep", "status", "s").stdout
    trms(*words, code=2)
    process.send_signal(signal.SIGTERM)
    process.communicate(timeout=60)


class TestFailures:
    def test_are_told_by_their_reason_and_made_again_when_asked(self, trms, tmp_path, plugins):
        words = ["run", *plugins, "-m", *SHORT, "out=s", "launcher.workers=1"]
        result = trms(*words, "controller=pid,deadly", "++controller.how=bad,", "seed=1", code=2)
        assert not (tmp_path / "s").exists()
        result = trms(*words, "controller=deadly", "controller.how=bad", "seed=1,2,3", code=1)
        assert "0 of 3 runs done, 3 failed" in result.stdout
        assert "3×" in result.stdout and "no such gain" in result.stdout
        assert "--retry-failed" in result.stdout
        assert "RuntimeError: no such gain" in statuses(tmp_path / "s")[0]["error"]["trace"]
        trms("sweep", "resume", "s", "--allow", "misbehaving", code=1)
        assert statuses(tmp_path / "s")[0]["attempt"] == 1
        trms("sweep", "resume", "s", "--retry-failed", "--allow", "misbehaving", code=1)
        assert statuses(tmp_path / "s")[0]["attempt"] == 2
        document = json.loads(trms("sweep", "status", "s", "--json").stdout)
        assert [(f["count"], f["runs"]) for f in document["failures"]] == [(3, [0, 1, 2])]

    @pytest.mark.slow
    def test_a_run_that_kills_its_worker_each_time_is_lost(self, trms, tmp_path, plugins):
        words = ["run", *plugins, "-m", *REST, "controller=deadly", "controller.how=dies,bad"]
        result = trms(*words, "retries=2", "out=s", "--json", code=1)
        document = json.loads(result.stdout)
        assert document["counts"]["lost"] == 1 and document["counts"]["failed"] == 1
        status = statuses(tmp_path / "s")[0]
        assert status["state"] == "lost" and status["attempt"] == 3
        assert "died 3 times" in status["error"]["problem"]


@pytest.mark.parametrize(
    ("words", "hints"),
    [
        (["hydra/launcher=joblib"], ["hydra/launcher", "launcher=local"]),
        (["hydra.sweep.dir=x"], ["out=FOLDER"]),
        (["sampler=gird"], ["did you mean grid?"]),
        (["launcher=dusk"], ["did you mean dask?"]),
        (["launcher.wrokers=2"], ["did you mean workers?"]),
        (["launcher.workers=-1"], ["launcher.workers"]),
        (["launcher=local,dask"], ["a sweep has one"]),
        (["sim.duration=interval(1,2)"], ["range of numbers"]),
        (["retries=-1"], ["retries", "whole number"]),
        (["retries=much"], ["retries"]),
        (["seed=range(3"], ["'seed=range(3'", "bracket or a quote is not closed"]),
        (["out=/dev/null"], ["'/dev/null' is a file", "out=FOLDER"]),
        (
            ["plant.parameters=prior", "sampler=random", "sampler.limits.rmsee_yaw=1"],
            ["did you mean rmse_yaw", "trms runs --help"],
        ),
        (["sim.duration=3,abc"], ["sim.duration", "in the runs with sim.duration=abc"]),
        (
            [
                "controller=lqr,pid",
                "controller.output_weights.alpha_v=interval(1,10)",
                "sampler=random",
                "sampler.samples=15",
            ],
            ["output_weights", "in the runs with controller=pid"],
        ),
        (["controller=pid", "controller.sample_time=0.1,-1"], ["controller.sample_time=-1"]),
    ],
    ids=lambda value: " ".join(value),
)
def test_bad_input_is_answered_before_anything_is_made(refused, words, hints):
    refused("run", "-m", "seed=1,2", "out=s", *words, words=hints)


@pytest.mark.parametrize("word", ["sampler=random", "launcher.workers=2", "retries=3"])
def test_what_steers_a_sweep_is_refused_without_one(refused, word):
    refused("run", "controller=pid", word, words="add -m")


@pytest.mark.parametrize(
    ("argv", "hint"),
    [
        ([], "trms sweep resume FOLDER"),
        (["resmue", "x"], "trms sweep resume FOLDER"),
        (["resume"], "no folder named"),
        (["resume", "nowhere"], "there is no folder"),
        (["status", "."], "sweep.json"),
        (["resume", ".", "--retry"], "did you mean --retry-failed"),
        (["resume", ".", "seed=3"], "sweep.json"),
        (["status", ".", "seed=3"], "usage"),
    ],
)
def test_bad_input_of_the_command(refused, argv, hint):
    refused("sweep", *argv, words=hint)


def swept_folder(folder: Path, statuses: list[dict], **words) -> Path:
    """A sweep's folder, as one that has ended leaves it."""
    folder.mkdir()
    record = {
        "schema": "trms.sweep/1", "primary": "run", "overrides": [], "state": "done",
        "total": len(statuses), "space": {"fixed": ["controller=pid"]},
    }  # fmt: skip
    (folder / "sweep.json").write_text(json.dumps(record | words))
    points = []
    for number, status in enumerate(statuses):
        overrides = status.get("overrides", [])
        points.append({"number": number, "overrides": overrides, "values": {}, "trial": None})
        (folder / str(number)).mkdir()
        status = {"schema": "trms.status/1", "job": number, "overrides": overrides} | status
        (folder / str(number) / "status.json").write_text(json.dumps(status))
    (folder / "points.jsonl").write_text("".join(json.dumps(each) + "\n" for each in points))
    return folder


@pytest.mark.parametrize("kind", ["ConfigurationError", "TrmsError"])
def test_one_cause_with_many_values_is_one_reason(tmp_path, capsys, kind):
    errors = [
        (f"there is no key 'output_weights' (given: {{'alpha_v': {value}}})", "output_weights")
        for value in (1.5, 2.25, 3)
    ]
    errors.append(("there is no key 'weights' (given: 3)", "weights"))
    failed = [
        {"state": "failed", "error": {"problem": told, "where": f"controller.{key}", "type": kind}}
        for told, key in errors
    ]
    document = outcome_of(swept_folder(tmp_path / "s", failed))
    assert [each["runs"] for each in document["failures"]] == [[0, 1, 2], [3]]
    assert "1.5" in document["failures"][0]["problem"]
    say_outcome(document)
    told = capsys.readouterr().out
    assert ("--retry-failed" in told) == (kind == "TrmsError")
    assert ("make the sweep anew" in told) == (kind == "ConfigurationError")


def test_the_line_of_a_run_with_many_parameters_tells_its_figures(tmp_path):
    drawn = [f"plant.parameters.k_{i}=0.06290000000000001" for i in range(25)]
    words = ["controller=pid", *drawn, "seed=1"]
    told = f"0  {' '.join(words)}  RMSE alpha_v 0.7 rad"
    folder = swept_folder(tmp_path / "s", [{"state": "done", "overrides": words, "told": told}])
    (line,) = outcome_of(folder)["told"]
    assert line.endswith("… and 22 more  RMSE alpha_v 0.7 rad") and len(line) < 120
    assert "k_0=0.0629 " in line and "controller=pid" not in line


class TestResuming:
    @pytest.fixture(scope="class")
    @classmethod
    def made(cls, tmp_path_factory):
        """A sweep of three, as a driver leaves it that was killed at once."""
        folder = tmp_path_factory.mktemp("lab")
        words = [*SHORT, "seed=1,2,3", "out=s", "launcher.workers=0"]
        in_process(folder, "run", "-m", *words)
        sweep = folder / "s"
        record = json.loads((sweep / "sweep.json").read_text())
        (sweep / "sweep.json").write_text(json.dumps(record | {"state": "running"}))
        for name in (".attempt-1", "status.json", "score.json", "run.mcap"):
            (sweep / "2" / name).unlink()
        return sweep

    @pytest.fixture
    def stopped(self, made, tmp_path) -> Path:
        return Path(shutil.copytree(made, tmp_path / "s"))

    def test_from_another_folder(self, stopped, tmp_path_factory):
        elsewhere = tmp_path_factory.mktemp("elsewhere")
        in_process(elsewhere, "sweep", "resume", str(stopped), "launcher.workers=0")
        assert states(stopped) == {"done": 3} and not list(elsewhere.iterdir())

    @pytest.mark.parametrize(
        ("words", "hint"),
        [
            (["sampler=random"], "make it anew"),
            (["seed=5"], "only launcher"),
            (["retries=x"], "retries"),
        ],
    )
    def test_only_where_it_runs_may_change(self, stopped, trms, words, hint):
        assert hint in trms("sweep", "resume", "s", *words, code=2).said

    @pytest.mark.parametrize(
        ("old", "new", "code", "words"),
        [
            (r'"numpy": "[^"]+"', '"numpy": "0.1"', 0, "numpy 0.1 →"),
            # no code of others
            ("trms_cli.commands.run:perform", "os:system", 2, "no command of this program"),
            (r'"directory": "[^"]+"', '"directory": "/nowhere"', 2, "is gone"),
        ],
    )
    def test_what_has_changed_is_told(self, stopped, trms, old, new, code, words):
        record = (stopped / "sweep.json").read_text()
        changed, count = re.subn(old, new, record)
        assert count
        (stopped / "sweep.json").write_text(changed)
        assert words in trms("sweep", "resume", "s", "launcher.workers=0", code=code).stderr


@pytest.mark.slow
@pytest.mark.parametrize(
    "words",
    [
        ["launcher=dask", "launcher.workers=2"],
        ["launcher=slurm", "launcher.cluster=local", "launcher.workers=2"],
    ],
    ids=lambda words: words[0],
)
def test_a_worker_of_a_cluster_is_killed(started, tmp_path, begun, plugins, words):
    kill_a_worker(started, tmp_path, begun, [*plugins, *words])


@pytest.mark.slow
def test_a_thousand_runs(trms, begun):
    result = trms("run", "-m", *SHORT, "seed=range(1000)", "out=s")
    assert "1000 of 1000 runs done" in result.stdout
    assert begun() == Counter(map(str, range(1000)))
