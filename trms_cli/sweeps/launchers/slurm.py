"""Jobs of SLURM: a job array of workers, each of which takes many runs.

submitit submits the jobs; each is a worker of a Dask scheduler in this process, so that runs are
handed out one by one and a job that is preempted, out of time or killed costs the run that it was
at. A job that is told to go (SIGTERM, or submitit's signal before the time limit) ends its run as
interrupted, which is then made again elsewhere. Where jobs have ended while there is work, others
are submitted.
"""

import asyncio
import contextlib
import logging
import os
import signal
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from msgspec import Meta

from trms_cli.core.errors import ConfigurationError, TrmsError
from trms_cli.core.threads import ONE_THREAD
from trms_cli.sweeps.launchers.dask import (
    DaskWorkers,
    cluster,
    connect_client,
    require_package,
    wait_for_workers,
)
from trms_cli.sweeps.launchers.local import InProcess
from trms_cli.sweeps.plugins import EndedAttempt, Work, Workers

#: s between two looks at jobs that have ended.
_LOOK = 10.0
#: s that a run has to end in, in a job that is told to go.
_GRACE = 20.0


@dataclass(frozen=True, kw_only=True)
class SlurmLauncher:
    """Jobs of SLURM."""

    #: Jobs of the array, each making one run at a time
    workers: Annotated[int, Meta(ge=1, le=10000)] = 8
    #: "slurm", "local" or "debug"; ``local``: the jobs are processes on this machine, ``debug``:
    #: the runs are made in this process; both to try a sweep before it goes to the cluster
    cluster: Literal["slurm", "local", "debug"] = "slurm"
    partition: str | None = None  #: Of SLURM; None: its default
    timeout_min: Annotated[int, Meta(ge=1)] = 60  #: Time limit of a job, min
    cpus: Annotated[int, Meta(ge=1)] = 1  #: Processors of a job
    #: Memory of a job, GB; None: SLURM's default
    mem_gb: Annotated[float, Meta(gt=0)] | None = None
    #: Jobs of the array that run at once at most; None: all
    parallelism: Annotated[int, Meta(ge=1)] | None = None
    #: Further parameters of submitit: ``slurm_account``, ``slurm_qos``, …
    parameters: dict[str, Any] = field(default_factory=dict)
    #: Name or address of this machine as the jobs reach it; None: by its host name
    host: str | None = None
    #: Folder for what the jobs print, seen by all machines; None: ``slurm-logs`` in the sweep's own
    #: folder
    logs: str | None = None
    #: Time that the first job may wait in the queue, s
    patience: Annotated[float, Meta(gt=0)] = 86400.0

    @contextmanager
    def crew(self, work: Work) -> Iterator[Workers]:
        """Submit the jobs, and wait for the first of them."""
        if self.cluster == "debug":
            yield InProcess(work)
            return
        distributed = require_package("distributed", "slurm")
        executor = self._executor(self._logs(work))
        host = self.host or ("127.0.0.1" if self.cluster == "local" else _own_address())
        with contextlib.ExitStack() as stack:
            started = stack.enter_context(cluster(0, host=host))
            client = stack.enter_context(connect_client(distributed, started, 30.0))
            jobs = _Jobs(
                executor, started.scheduler_address, self.workers, played=self.cluster == "local"
            )
            stack.callback(jobs.cancel)
            jobs.submit(self.workers)
            jobs.wait_for_first(client, self.patience)
            crew = _SlurmCrew(client, work, jobs)
            stack.callback(crew.end)
            yield crew

    def _logs(self, work: Work) -> Path:
        """Where the jobs print to: with the runs, unless it is typed."""
        if self.logs is not None:
            return Path(self.logs).absolute()
        return Path(getattr(work, "folder", "")).absolute() / "slurm-logs"

    def _executor(self, folder: Path) -> Any:
        submitit = require_package("submitit", "slurm")
        # Without SLURM's accounting it warns again and again; ended jobs are found all the same.
        logging.getLogger("submitit").setLevel(logging.CRITICAL)
        try:
            executor = submitit.AutoExecutor(folder=folder, cluster=self.cluster)
        except RuntimeError as error:
            raise ConfigurationError(
                f"there is no SLURM on this machine ({error})",
                where="launcher.cluster",
                remedy="start the sweep where `sbatch` is, or try it with launcher.cluster=local",
            ) from error
        settings: dict[str, Any] = {
            "name": "trms-sweep",
            "timeout_min": self.timeout_min,
            "cpus_per_task": self.cpus,
            "mem_gb": self.mem_gb,
            "slurm_partition": self.partition,
            "slurm_array_parallelism": self.parallelism,
        }
        try:
            executor.update_parameters(
                **{key: value for key, value in settings.items() if value is not None},
                **self.parameters,
            )
        except (NameError, TypeError, ValueError, AssertionError) as error:
            raise ConfigurationError(
                f"submitit refuses it: {error}",
                where="launcher.parameters",
                remedy="its parameters of SLURM begin with slurm_: slurm_account, slurm_qos, …",
            ) from error
        return executor


class _Jobs:
    """The jobs of a scheduler, `wanted` at once: others take the place of those that have ended.

    Those that are `played` are processes on this machine. Submitit ends them by SIGINT, as a
    terminal's Ctrl-C also does, and each prints a traceback; so they do not hear it, and are told
    by SIGTERM.
    """

    def __init__(self, executor: Any, address: str, wanted: int, *, played: bool = False) -> None:
        self._executor, self._address, self._job_count = executor, address, wanted
        self._played = played
        self._jobs: list[Any] = []
        self._looked = time.monotonic()
        self.in_vain = 0  #: Jobs that have ended since a run was finished

    def submit(self, count: int) -> None:
        """Submit jobs as one array; raises TrmsError if SLURM does not take them."""
        try:
            with _deaf_to_interrupts(self._played), self._executor.batch():
                new = [self._executor.submit(serve, self._address) for _ in range(count)]
        except Exception as error:
            raise TrmsError(
                f"the jobs cannot be submitted: {_said_by_slurm(error)}",
                where="launcher",
                remedy="if SLURM answers (`sinfo`), mend launcher.partition, launcher.timeout_min, "
                "launcher.mem_gb or launcher.parameters; else go on without it: "
                "trms sweep resume FOLDER launcher=local",
            ) from error
        self._jobs += new

    def wait_for_first(self, client: Any, patience: float) -> None:
        """Wait for a worker, and look meanwhile whether jobs end before they have begun.

        Raises TrmsError if none comes.
        """
        until = time.monotonic() + patience
        while time.monotonic() < until:
            with contextlib.suppress(ConfigurationError):
                wait_for_workers(client, 2.0, "this machine")
                return
            if all(job.done() for job in self._jobs):
                raise self._failed()
        raise TrmsError(
            f"no job has begun within {patience:g} s",
            where="launcher.patience",
            remedy="see `squeue`; the sweep can be gone on with at any time",
        )

    def replace(self) -> None:
        """Submit jobs for those that have ended, preempted, out of time or killed.

        Raises TrmsError if they end again and again without a finished run.
        """
        if time.monotonic() - self._looked < _LOOK:
            return
        self._looked = time.monotonic()
        ended = [job for job in self._jobs if job.done()]
        if not ended:
            return
        self.in_vain += len(ended)
        if self.in_vain > 3 * self._job_count:
            raise self._failed()
        self._jobs = [job for job in self._jobs if job not in ended]
        self.submit(len(ended))

    def cancel(self) -> None:
        """End all jobs."""
        for job in self._jobs:
            with contextlib.suppress(Exception):
                if self._played:
                    os.kill(int(job.job_id), signal.SIGTERM)
                else:
                    job.cancel()
        until = time.monotonic() + _GRACE
        while self._played and time.monotonic() < until:
            if all(job.done() for job in self._jobs):
                return
            time.sleep(0.1)

    def _failed(self) -> TrmsError:
        words = ""
        for job in self._jobs:
            with contextlib.suppress(Exception):
                lines = [line for line in (job.stderr() or "").splitlines() if line.strip()]
                words = lines[-1].strip() if lines else ""
                if words:
                    break
        return TrmsError(
            f"the jobs end before they have finished a run{f': {words}' if words else ''}",
            where="launcher",
            remedy=f"see what they print in {self._executor.folder}",
        )


class _SlurmCrew(DaskWorkers):
    """Dask's crew, whose workers are jobs."""

    def __init__(self, client: Any, work: Work, jobs: _Jobs) -> None:
        super().__init__(client, work, "this process")
        self._jobs = jobs

    def collect(self, timeout_s: float) -> list[EndedAttempt]:
        attempts = super().collect(timeout_s)
        if any(each.result is not None for each in attempts):
            self._jobs.in_vain = 0
        self._jobs.replace()
        return attempts


@contextmanager
def _deaf_to_interrupts(is_enabled: bool) -> Iterator[None]:
    """Processes that are started inside do not hear Ctrl-C."""
    if not is_enabled or threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _said_by_slurm(error: Exception) -> str:
    """What a program of SLURM printed, without the command line that submitit quotes."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    error_lines = [line for line in lines if line.startswith(("sbatch: error:", "srun: error:"))]
    return error_lines[-1] if error_lines else lines[0] if lines else type(error).__name__


def serve(address: str) -> None:
    """What a job does: it is a worker of the scheduler until that ends, or the job is told to."""
    os.environ.update(ONE_THREAD)
    asyncio.run(_served(address))


async def _served(address: str) -> None:
    from distributed import Worker

    from trms_cli.sweeps.record import leaving

    worker = Worker(
        address, nthreads=1, memory_limit=0, dashboard=False, death_timeout=60, heartbeat_interval=2
    )
    await worker
    departure = asyncio.Event()

    async def leave() -> None:
        leaving.set()  # the run notices
        until = time.monotonic() + _GRACE
        while worker.state.executing_count and time.monotonic() < until:
            await asyncio.sleep(0.1)
        await asyncio.sleep(0.5)  # for the message to get out
        await worker.close(reason="the job was told to go")
        departure.set()

    loop = asyncio.get_running_loop()
    leaves: list[asyncio.Task[None]] = []
    for number in (signal.SIGTERM, signal.SIGUSR1, signal.SIGUSR2):
        loop.add_signal_handler(number, lambda: leaves.append(asyncio.ensure_future(leave())))
    await worker.finished()
    if leaves:
        await departure.wait()


def _own_address() -> str:
    """The address of this machine by which others reach it."""
    try:
        return socket.gethostbyname(socket.gethostname())
    except OSError as error:
        raise ConfigurationError(
            f"this machine's name leads to no address ({error})",
            where="launcher.host",
            remedy="name the address by which the jobs reach this machine",
        ) from error
