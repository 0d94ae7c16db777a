"""Runs that end otherwise than meant: killed, interrupted, out of room, by a plugin's fault."""

from __future__ import annotations

import json
import os
import shlex
import shutil
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from trms_cli.recordings.log_reader import LoggedRun, read_log

posix = pytest.mark.skipif(os.name != "posix", reason="signals and limits of POSIX")

#: A controller that does what a plugin should not, as a user might write it.
MODULE = r"""
import math
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from trms_cli.controllers.controller import Command


@dataclass(frozen=True, kw_only=True)
class Own:
    how: str = ""
    after: float = 1.0
    sample_time: float | None = None

    def preview(self, setup):
        return 0

    def init(self, setup):
        if self.how == "refuse":
            raise ValueError("cannot start")
        return len(setup.model.inputs)

    def step(self, state, sample, *, want_prediction):
        if self.how == "slow":
            time.sleep(0.002)
            with Path("reached.txt").open("a") as file:
                file.write(f"{sample.time!r}\n")
        elif sample.time >= self.after:
            if self.how == "raise":
                raise ZeroDivisionError("a slip of mine")
            if self.how == "garbage":
                return Command(np.full(state, math.nan))
            if self.how == "nothing":
                return None
            if self.how == "words":
                return Command(["up", "down"])
        return Command(np.full(state, 0.1))


class Bare:
    # the least that a controller is: not even a sample time
    def preview(self, setup):
        return 0

    def init(self, setup):
        return len(setup.model.inputs)

    def step(self, state, sample, *, want_prediction):
        return Command(np.full(state, 0.1))


class Unfinished:
    def preview(self, setup):
        return 0

    def init(self, setup):
        return None
"""


@pytest.fixture
def own(tmp_path: Path) -> list[str]:
    """Words that choose the misbehaving controller."""
    configs = tmp_path / "lab" / "configs"
    (configs / "controller").mkdir(parents=True)
    (configs / "controller" / "own.yaml").write_text(
        "# holds 0.1 V, or misbehaves\n_target_: misbehaving.Own\n"
        'how: ""     # refuse, raise, garbage, slow\nafter: 1.0  # s\n',
        encoding="utf-8",
    )
    (tmp_path / "lab" / "misbehaving.py").write_text(MODULE, encoding="utf-8")
    words = ["--config-dir", str(configs), "controller=own", "picture=false"]
    return [*words, "observer=full_state", "plant=ideal"]


@pytest.fixture
def started(
    executable: Path, tmp_path: Path, own: list[str]
) -> Callable[[], tuple[subprocess.Popen[str], Path]]:
    """Start a long, slow run and wait until it has passed its fourth second."""

    def start() -> tuple[subprocess.Popen[str], Path]:
        words = [*own, "controller.how=slow", "sim.duration=600", "out=there"]
        process = subprocess.Popen(
            [str(executable), "run", *words],
            cwd=tmp_path,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            encoding="utf-8",
        )
        deadline = time.monotonic() + 60
        while _reached(tmp_path) < 4.0:
            assert process.poll() is None, process.communicate()
            assert time.monotonic() < deadline
            time.sleep(0.02)
        return process, tmp_path / "there" / "run.mcap"

    return start


def _reached(folder: Path) -> float:
    """Simulated time (s) that the controller saw last."""
    file = folder / "reached.txt"
    lines = file.read_text().splitlines() if file.exists() else []
    return float(lines[-2]) if len(lines) > 1 else 0.0


def _holds_all_until(log: LoggedRun, second: int) -> None:
    for topic in ("/reference", "/command", "/measurement", "/plant/state", "/estimate"):
        ticks = log.table(topic).time_ns[log.table(topic).time_ns < second * 10**9]
        assert np.array_equal(ticks, np.arange(second * 50) * 20_000_000), topic


@posix
def test_a_killed_run_s_log_holds_everything_up_to_the_last_second(started, tmp_path):
    process, path = started()
    process.send_signal(signal.SIGKILL)
    process.communicate(timeout=30)
    log = read_log(path)
    assert not log.complete
    assert log.outcome == "died"
    # One second more than the controller saw would be two flushes ahead of it.
    _holds_all_until(log, int(_reached(tmp_path)))
    assert log.config
    assert log.run["seed"] == "0"


@posix
@pytest.mark.parametrize(("ending", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_an_interrupted_run_leaves_a_complete_and_marked_log(started, trms, ending, code):
    process, path = started()
    process.send_signal(ending)
    output, error = process.communicate(timeout=30)
    assert process.returncode == code
    assert "Traceback" not in error
    assert "there/run.mcap" in error
    assert "interrupted at" in error
    assert output == ""
    log = read_log(path)
    assert log.complete
    assert log.outcome == "interrupted"
    assert log.score["complete"] is False
    _holds_all_until(log, 4)
    result = trms("score", "there/run.mcap")
    assert result.returncode == 0
    assert "interrupted" in result.stdout


@posix
def test_ctrl_c_ends_a_sweep_and_not_only_its_job(executable, own, tmp_path):
    words = [*own, "controller.how=slow", "sim.duration=600", "seed=1,2", "out=swept"]
    words += ["launcher.workers=1"]
    process = subprocess.Popen(
        [str(executable), "run", "-m", *words],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        encoding="utf-8",
    )
    deadline = time.monotonic() + 60
    while _reached(tmp_path) < 2.0:
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=30)
    assert process.returncode == 130, error
    assert "Traceback" not in error
    assert read_log(tmp_path / "swept" / "0" / "run.mcap").outcome == "interrupted"
    status = json.loads((tmp_path / "swept" / "0" / "status.json").read_text())
    assert status["state"] == "interrupted"
    assert not (tmp_path / "swept" / "1").exists()


def test_an_exception_in_a_plugin_names_it_and_marks_the_log(trms, own, tmp_path):
    result = trms("run", *own, "controller.how=raise", "sim.duration=3", "out=there")
    assert result.returncode == 1
    assert "Traceback" not in result.stderr
    words = " ".join(result.stderr.split())
    for part in (
        "the controller misbehaving.Own failed at 1.00 s",
        "ZeroDivisionError: a slip of mine",
        "misbehaving.py, line",
        "--debug",
        "there/run.mcap",
    ):
        assert part in words
    log = read_log(tmp_path / "there" / "run.mcap")
    assert log.complete
    assert log.outcome == "failed"
    assert len(log.table("/command")) == 50  # all before the sample that failed


def test_its_trace_can_be_had(trms, own):
    result = trms("run", *own, "controller.how=raise", "sim.duration=3", "--debug")
    assert "Traceback" in result.stderr
    assert "raise ZeroDivisionError" in result.stderr


@pytest.mark.parametrize(
    ("how", "told"),
    [("nothing", "step returned None, not a Command"), ("words", "no array of numbers")],
)
def test_what_is_no_command_is_told_with_the_log(trms, own, how, told):
    result = trms("run", *own, f"controller.how={how}", "sim.duration=3", "out=there")
    words = " ".join(result.stderr.split())
    assert result.returncode == 1
    for part in (told, "one value (V) for each", "the log up to 1.00 s", "there/run.mcap"):
        assert part in words


def _without_keys(tmp_path: Path, name: str) -> None:
    file = tmp_path / "lab" / "configs" / "controller" / "own.yaml"
    file.write_text(f"# {name}\n_target_: misbehaving.{name}\n", encoding="utf-8")


def test_a_controller_without_a_sample_time_takes_every_sample(trms, own, tmp_path):
    _without_keys(tmp_path, "Bare")
    result = trms("run", *own, "sim.duration=1", "out=there")
    assert result.returncode == 0, result.stderr
    assert len(read_log(tmp_path / "there" / "run.mcap").table("/controller")) == 50


def test_a_controller_that_lacks_a_method_is_refused_before_the_run(trms, own, tmp_path):
    _without_keys(tmp_path, "Unfinished")
    result = trms("run", *own, "out=there")
    words = " ".join(result.stderr.split())
    assert result.returncode == 2
    assert "controller misbehaving.Unfinished lacks step" in words
    assert "docs/writing-a-plugin.md" in words
    assert not (tmp_path / "there").exists()


@posix
def test_that_there_is_no_compiler_is_said_once(trms, own, tmp_path):
    words = [*own, "sim.duration=0.2"]
    for more in (["out=one"], ["-m", "seed=1,2", "out=many"]):
        result = trms("run", *words, *more, PATH=str(tmp_path), CC="")
        assert result.returncode == 0, result.stderr
        assert result.stderr.count("no C compiler") == 1
        assert "trms doctor" in result.stderr
    result = trms("run", *words, "out=asked", TRMS_COMPILE="0")
    assert result.stderr == ""


def test_a_run_s_folder_stands_for_its_log(trms, own):
    assert trms("run", *own, "sim.duration=1", "out=there").returncode == 0
    assert trms("score", "there").stdout == trms("score", "there/run.mcap").stdout
    assert trms("export", "there").returncode == 0
    result = trms("run", "--from", "there", "out=again")
    assert result.returncode == 0, result.stderr


def test_a_plugin_that_cannot_start_leaves_nothing_behind(trms, own, tmp_path):
    result = trms("run", *own, "controller.how=refuse", "out=there")
    assert result.returncode == 1
    assert "the controller misbehaving.Own failed at the start" in " ".join(result.stderr.split())
    assert not (tmp_path / "there").exists()


def test_commands_that_are_no_numbers_never_reach_the_rig(trms, own, tmp_path):
    result = trms("run", *own, "controller.how=garbage", "sim.duration=3", "out=there")
    assert result.returncode == 0, result.stderr
    log = read_log(tmp_path / "there" / "run.mcap")
    for name in ("u_v", "u_h"):
        assert np.all(log.table("/command").columns[name] == 0.1)
    assert all(np.isfinite(column).all() for column in log.table("/plant/state").columns.values())
    kinds = list(log.table("/event").columns["kind"])
    assert kinds[:2] == ["fault", "fault"] and "degraded_begin" in kinds


@posix
def test_a_file_that_may_not_grow_keeps_what_it_holds(executable, own, tmp_path):
    import resource

    def limited() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (150_000, 150_000))

    result = subprocess.run(
        [str(executable), "run", *own, "sim.duration=60", "out=there"],
        cwd=tmp_path,
        preexec_fn=limited,
        capture_output=True,
        text=True,
        encoding="utf-8",
        timeout=60,
    )
    assert result.returncode == 2
    words = " ".join(result.stderr.split())
    assert "no room" in words
    assert "Traceback" not in words
    safe = float(words.partition("the log is safe up to ")[2].partition(" s")[0])
    log = read_log(tmp_path / "there" / "run.mcap")
    assert not log.complete
    assert safe > 1.0
    _holds_all_until(log, int(safe))


def _in_own_mount(script: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run a shell script where it may mount: as root of a namespace of its own."""
    unshare = shutil.which("unshare")
    allowed = unshare and not subprocess.run(
        [unshare, "-rm", "sh", "-c", "mount -t tmpfs none /mnt"], capture_output=True
    ).returncode  # fmt: skip
    if not allowed:
        pytest.skip("this machine lets nobody mount")
    return subprocess.run(
        [str(unshare), "-rm", "sh", "-c", script],
        cwd=folder,
        env=os.environ | {"NO_COLOR": "1"},
        capture_output=True,
        text=True,
        encoding="utf-8",
        timeout=120,
    )


@posix
def test_a_full_disk(executable, own, tmp_path):
    program, words = shlex.quote(str(executable)), shlex.join([*own, "sim.duration=60"])
    (tmp_path / "small").mkdir()
    result = _in_own_mount(
        "mount -t tmpfs -o size=192k none small && "
        f"{program} run {words} out=small/there; echo exit $?; "
        f"{program} score small/there/run.mcap",
        tmp_path,
    )
    assert "exit 2" in result.stdout
    assert "no room" in result.stderr
    assert "the log is safe up to" in " ".join(result.stderr.split())
    assert "incomplete" in result.stdout
    assert "Traceback" not in result.stderr


@posix
def test_a_folder_that_cannot_be_written_to(executable, own, tmp_path):
    program, words = shlex.quote(str(executable)), shlex.join([*own, "sim.duration=1"])
    (tmp_path / "fixed").mkdir()
    result = _in_own_mount(
        "mount -t tmpfs -o ro none fixed && "
        f"{program} run {words} out=fixed/there; echo exit $?; "
        f"cd fixed && {program} run {words}; echo exit $?",
        tmp_path,
    )
    assert result.stdout.split() == ["exit", "2", "exit", "2"]
    assert result.stderr.count("name a folder that you can write to: out=FOLDER") == 2
    assert "Traceback" not in result.stderr


def test_a_folder_that_holds_something_is_refused(trms, own, tmp_path):
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "mine.txt").write_text("mine")
    result = trms("run", *own, "sim.duration=1", "out=there")
    assert result.returncode == 2
    assert "not empty" in result.stderr
    assert [file.name for file in (tmp_path / "there").iterdir()] == ["mine.txt"]
