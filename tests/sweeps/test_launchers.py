"""Launchers: real worker processes, killed amid a sweep; every run made once, none lost."""

import functools
import os
import signal
import sys
import time
from collections import Counter
from pathlib import Path

import pytest

from trms_cli.core.errors import ConfigurationError, TrmsError
from trms_cli.sweeps.driver import Driver
from trms_cli.sweeps.launchers.dask import DaskLauncher
from trms_cli.sweeps.launchers.local import LocalLauncher
from trms_cli.sweeps.launchers.slurm import SlurmLauncher, _said_by_slurm
from trms_cli.sweeps.record import Record, RunFolder
from trms_cli.sweeps.space import RunResult

from .listed import Listed

RUNS, DEADLY, ALWAYS_DEADLY = 14, 5, 9


def make_run(folder: str, deadly: tuple[int, ...], always: tuple[int, ...], attempt):
    """Note that it has begun, and die by SIGKILL where that is asked for."""
    run = RunFolder(Path(folder), attempt.point.number)
    if not run.claim(attempt.number):
        return run.result()
    with open(Path(folder) / "begun", "ab", buffering=0) as stream:
        stream.write(f"{run.number} {os.getpid()}\n".encode())
    status = {"schema": "trms.status/1", "state": "running"}
    run.write(status)
    time.sleep(0.03)
    if run.number in always or (run.number in deadly and attempt.number == 1):
        os.kill(os.getpid(), signal.SIGKILL)
    run.write(status | {"state": "done"})
    return RunResult(run.number, "done")


def drive(folder: Path, launcher, deadly=(), always=(), retries=1):
    work = functools.partial(make_run, str(folder), tuple(deadly), tuple(always))
    driver = Driver(Record(folder), Listed(RUNS), work, retries=retries)
    driver.drive(launcher)
    begun = [tuple(map(int, line.split())) for line in (folder / "begun").read_text().splitlines()]
    return driver.progress, Counter(number for number, _ in begun), {pid for _, pid in begun}


LAUNCHERS = {"local": LocalLauncher(workers=2), "dask": DaskLauncher(workers=2)}


def cluster_of(workers: int):
    from distributed import LocalCluster

    return LocalCluster(workers, threads_per_worker=1, dashboard_address=None, silence_logs=50)


@pytest.mark.slow
@pytest.mark.parametrize("launcher", LAUNCHERS.values(), ids=LAUNCHERS)
def test_killed_workers(tmp_path, launcher):
    """One run kills its worker once, another one each time."""
    progress, begun, pids = drive(tmp_path, launcher, [DEADLY], [ALWAYS_DEADLY])
    assert progress.counts == {"done": RUNS - 1, "lost": 1}
    twice = {number for number, times in begun.items() if times > 1}
    assert twice == {DEADLY, ALWAYS_DEADLY} and set(begun) == set(range(RUNS))
    assert begun[DEADLY] == begun[ALWAYS_DEADLY] == 2
    assert "died 2 times" in RunFolder(tmp_path, ALWAYS_DEADLY).status()["error"]["problem"]
    assert os.getpid() not in pids
    # The others go on at the same workers: only the dead are replaced.
    assert len(pids) <= 2 + 3


@pytest.mark.parametrize(("workers", "processes"), [(0, 1), (2, 2)])  # 0: the debugger's
def test_runs_are_shared_out(tmp_path, workers, processes):
    progress, _, pids = drive(tmp_path, LocalLauncher(workers=workers))
    assert progress.counts == {"done": RUNS} and len(pids) == processes
    assert (os.getpid() in pids) == (workers == 0)


def test_a_scheduler_that_runs_and_hands_tasks_out_again_by_itself(tmp_path):
    """It retries what its dead worker had; nothing is made twice all the same."""
    with cluster_of(2) as cluster:
        launcher = DaskLauncher(address=cluster.scheduler_address)
        progress, begun, _ = drive(tmp_path, launcher, [DEADLY])
    assert progress.counts == {"done": RUNS}
    assert begun == Counter(range(RUNS)) + Counter([DEADLY])


def test_a_scheduler_that_goes(tmp_path):
    cluster = cluster_of(1)
    launcher = DaskLauncher(address=cluster.scheduler_address)
    work = functools.partial(make_run, str(tmp_path), (), ())
    ended = []

    def tell(progress, result):
        if result is not None and not ended:
            ended.append(result)
            cluster.close()

    with pytest.raises(TrmsError, match="is gone") as told:
        Driver(Record(tmp_path), Listed(RUNS), work, retries=1, tell=tell).drive(launcher)
    assert "sweep resume" in told.value.remedy


def test_what_slurm_says_is_told_without_the_command_line():
    told = "sbatch failed\nsbatch --array=0-7 x.sh\nsbatch: error: Unable to contact the controller"
    assert _said_by_slurm(RuntimeError(told)) == "sbatch: error: Unable to contact the controller"


@pytest.mark.slow
def test_jobs_of_slurm_played_on_this_machine(tmp_path, capfd):
    launcher = SlurmLauncher(workers=2, cluster="local", logs=str(tmp_path / "logs"))
    progress, begun, _ = drive(tmp_path, launcher, [DEADLY])
    assert "Traceback" not in capfd.readouterr().err
    assert progress.counts == {"done": RUNS}
    assert begun == Counter(range(RUNS)) + Counter([DEADLY])


@pytest.mark.parametrize(
    ("launcher", "words"),
    [
        (DaskLauncher(address="tcp://127.0.0.1:9", patience=0.5), "does not answer"),
        (DaskLauncher(address="tcp://127.0.0.1:9", workers=2), "has its own workers"),
        (DaskLauncher(address="nonsense://", patience=0.5), "does not answer"),
        (SlurmLauncher(), "no SLURM on this machine"),
        (SlurmLauncher(cluster="local", parameters={"slurm_colour": 1}), "submitit refuses it"),
    ],
)
def test_what_cannot_be_had_is_told(tmp_path, monkeypatch, launcher, words):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", "/nowhere")
    with pytest.raises(ConfigurationError, match=words) as told:
        drive(tmp_path, launcher)
    assert told.value.remedy


@pytest.mark.parametrize(("launcher", "package"), [("dask", "distributed"), ("slurm", "submitit")])
def test_a_package_that_is_missing_is_told_with_the_line_that_installs_it(
    tmp_path, monkeypatch, launcher, package
):
    monkeypatch.setitem(sys.modules, package, None)
    chosen = DaskLauncher() if launcher == "dask" else SlurmLauncher(cluster="local")
    with pytest.raises(ConfigurationError, match=package) as told:
        drive(tmp_path, chosen)
    assert "pip install 'trms-cli[cluster]'" in told.value.remedy
