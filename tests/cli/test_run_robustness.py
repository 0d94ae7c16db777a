"""Runs that are watched, and that end otherwise than meant: killed, out of room, by a plugin."""

import json
import os
import re
import shlex
import shutil
import signal
import subprocess
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from tests.program import INSTALLED, wait_for
from trms_cli.recordings.log_reader import LoggedRun, read_log

posix = pytest.mark.skipif(os.name != "posix", reason="signals and limits of POSIX")


@pytest.fixture
def own(misbehaving: list[str]) -> list[str]:
    """Words that choose the misbehaving controller."""
    words = [*misbehaving, "controller=own", "picture=false"]
    return [*words, "observer=full_state", "plant=ideal"]


@pytest.fixture
def slow(started, tmp_path: Path, own: list[str]) -> tuple[subprocess.Popen[str], Path]:
    """A long, slow run that has passed its fourth second, and its log."""
    words = [*own, "controller.how=slow", "sim.duration=600", "out=there"]
    process = started("run", *words)
    wait_for(lambda: _reached(tmp_path) >= 4.0)
    return process, tmp_path / "there" / "run.mcap"


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
def test_a_killed_run_s_log_holds_everything_up_to_the_last_second(slow, tmp_path):
    process, path = slow
    process.send_signal(signal.SIGKILL)
    process.communicate(timeout=30)
    log = read_log(path)
    assert not log.complete and log.outcome == "died"
    # One second more than the controller saw would be two flushes ahead of it.
    _holds_all_until(log, int(_reached(tmp_path)))
    assert log.config and log.run["seed"] == "0"


@posix
@pytest.mark.parametrize(("ending", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_an_interrupted_run_leaves_a_complete_and_marked_log(slow, trms, ending, code):
    process, path = slow
    process.send_signal(ending)
    output, error = process.communicate(timeout=30)
    assert process.returncode == code and output == ""
    assert "interrupted at" in error and "there/run.mcap" in error and "Traceback" not in error
    log = read_log(path)
    assert log.complete and log.outcome == "interrupted" and log.score["complete"] is False
    _holds_all_until(log, 4)
    assert "interrupted" in trms("score", "there/run.mcap").stdout


@pytest.mark.slow
@posix
def test_progress_is_shown_on_a_terminal(in_terminal, own):
    words = ("run", *own, "controller.how=slow", "sim.duration=20")
    screen = in_terminal(*words, size=(24, 100))
    assert screen.end(60.0) == 0
    for words in (rb"\d+ / 20 s", "× real time".encode(), rb"error 0\.\d+ rad"):
        assert re.search(words, screen.shown)


@pytest.mark.slow
@posix
def test_ctrl_c_ends_a_sweep_and_not_only_its_job(started, own, tmp_path):
    words = [*own, "controller.how=slow", "sim.duration=600", "seed=1,2", "out=swept"]
    process = started("run", "-m", *words, "launcher.workers=1")
    wait_for(lambda: _reached(tmp_path) >= 2.0)
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=30)
    assert process.returncode == 130 and "Traceback" not in error, error
    assert read_log(tmp_path / "swept" / "0" / "run.mcap").outcome == "interrupted"
    status = json.loads((tmp_path / "swept" / "0" / "status.json").read_text())
    assert status["state"] == "interrupted"
    assert not (tmp_path / "swept" / "1").exists()


def test_an_exception_in_a_plugin_names_it_and_marks_the_log(trms, own, tmp_path):
    words = trms("run", *own, "controller.how=raise", "sim.duration=3", "out=there", code=1).said
    for part in (
        *("the controller misbehaving.Own failed at 1.00 s", "ZeroDivisionError: a slip of mine"),
        *("misbehaving.py, line", "--debug", "there/run.mcap"),
    ):
        assert part in words
    log = read_log(tmp_path / "there" / "run.mcap")
    assert log.complete and log.outcome == "failed"
    assert len(log.table("/command")) == 50  # all before the sample that failed


@pytest.mark.parametrize(
    ("how", "told"),
    [("nothing", "step returned None, not a Command"), ("words", "no array of numbers")],
)
def test_what_is_no_command_is_told_with_the_log(trms, own, how, told):
    words = trms("run", *own, f"controller.how={how}", "sim.duration=3", "out=there", code=1).said
    for part in (told, "one value (V) for each", "the log up to 1.00 s", "there/run.mcap"):
        assert part in words


def test_the_least_controller_takes_every_sample_and_one_that_lacks_a_method_is_refused(
    trms, refused, own, tmp_path
):
    option = tmp_path / "lab" / "configs" / "controller" / "own.yaml"
    option.write_text("# no sample time\n_target_: misbehaving.Bare\n", encoding="utf-8")
    trms("run", *own, "sim.duration=1", "out=there")
    assert len(read_log(tmp_path / "there" / "run.mcap").table("/controller")) == 50
    option.write_text("# no step\n_target_: misbehaving.Unfinished\n", encoding="utf-8")
    words = ["controller misbehaving.Unfinished lacks step", "docs/writing-a-plugin.md"]
    refused("run", *own, "out=elsewhere", words=words)


@pytest.mark.slow
@posix
def test_that_there_is_no_compiler_is_said_once(program, own, tmp_path):
    words = [*own, "sim.duration=0.2"]
    for more in (["out=one"], ["-m", "seed=1,2", "out=many"]):
        result = program("run", *words, *more, PATH=str(tmp_path), CC="")
        assert result.stderr.count("no C compiler") == 1
        assert "trms doctor" in result.stderr
    result = program("run", *words, "out=asked", TRMS_COMPILE="0")
    assert result.stderr == ""


def test_a_run_s_folder_stands_for_its_log(trms, own):
    trms("run", *own, "sim.duration=1", "out=there")
    assert trms("score", "there").stdout == trms("score", "there/run.mcap").stdout
    trms("export", "there")
    trms("run", "--from", "there", "out=again")


def test_a_plugin_that_cannot_start_leaves_nothing_behind(trms, own, tmp_path):
    result = trms("run", *own, "controller.how=refuse", "out=there", code=1)
    assert "the controller misbehaving.Own failed at the start" in result.said
    assert not (tmp_path / "there").exists()


def test_commands_that_are_no_numbers_never_reach_the_rig(trms, own, tmp_path):
    trms("run", *own, "controller.how=garbage", "sim.duration=3", "out=there")
    log = read_log(tmp_path / "there" / "run.mcap")
    for name in ("u_v", "u_h"):
        assert np.all(log.table("/command").columns[name] == 0.1)
    assert all(np.isfinite(column).all() for column in log.table("/plant/state").columns.values())
    kinds = list(log.table("/event").columns["kind"])
    assert kinds[:2] == ["fault", "fault"] and "degraded_begin" in kinds


@posix
def test_a_file_that_may_not_grow_keeps_what_it_holds(own, tmp_path):
    import resource

    def limited() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (150_000, 150_000))

    result = subprocess.run(
        [str(INSTALLED), "run", *own, "sim.duration=60", "out=there"],
        cwd=tmp_path,
        preexec_fn=limited,
        capture_output=True,
        text=True,
        encoding="utf-8",
        timeout=60,
    )
    words = " ".join(result.stderr.split())
    assert result.returncode == 2 and "no room" in words and "Traceback" not in words
    safe = float(words.partition("the log is safe up to ")[2].partition(" s")[0])
    log = read_log(tmp_path / "there" / "run.mcap")
    assert not log.complete and safe > 1.0
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
def test_a_full_disk(own, tmp_path):
    program, words = shlex.quote(str(INSTALLED)), shlex.join([*own, "sim.duration=60"])
    (tmp_path / "small").mkdir()
    result = _in_own_mount(
        "mount -t tmpfs -o size=192k none small && "
        f"{program} run {words} out=small/there; echo exit $?; "
        f"{program} score small/there/run.mcap",
        tmp_path,
    )
    assert "exit 2" in result.stdout and "incomplete" in result.stdout
    assert "no room" in result.stderr and "Traceback" not in result.stderr
    assert "the log is safe up to" in " ".join(result.stderr.split())


@posix
def test_a_folder_that_cannot_be_written_to(own, tmp_path):
    program, words = shlex.quote(str(INSTALLED)), shlex.join([*own, "sim.duration=1"])
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


def test_a_fast_run_is_made_safe_every_five_simulated_seconds_at_the_latest(trms, tmp_path):
    """It simulates a second in some milliseconds; a killed one loses no more than that."""
    quick = ("controller=pid", "picture=false", "sim.duration=23")
    assert trms("run", *quick, "out=there").returncode == 0
    with (tmp_path / "there" / "run.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    spans = [(c.message_start_time, c.message_end_time) for c in summary.chunk_indexes]
    seconds = [(end - begin) / 1e9 for begin, end in spans]
    assert all(second <= 5.0 for second in seconds) and len(seconds) >= 5
