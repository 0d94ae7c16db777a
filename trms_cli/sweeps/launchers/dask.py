"""Workers of Dask: a scheduler that runs already, on any machines, or a cluster of this machine.

Dask hands a task of a worker that died to another one by itself. It does not get run twice: the
attempt has been begun, so the second worker leaves it, and the driver decides about the next
attempt. Where the scheduler is ours it is told not to try.
"""

import contextlib
import itertools
import logging
import queue
import time
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from typing import Annotated, Any

from msgspec import Meta

from trms_cli.core.errors import ConfigurationError, TrmsError, first_line
from trms_cli.core.threads import ONE_THREAD
from trms_cli.sweeps.launchers.local import collect_arrivals
from trms_cli.sweeps.plugins import Attempt, EndedAttempt, Work, Workers

INSTALL = "pip install 'trms-cli[cluster]'"
_EVERY = 2.0  # s between two counts of the workers
_numbers = itertools.count()


@dataclass(frozen=True, kw_only=True)
class DaskLauncher:
    """Workers of Dask."""

    #: Of a scheduler that runs, ``tcp://head:8786``; None: a cluster of processes on this machine,
    #: for this sweep
    address: str | None = None
    #: Processes of the cluster on this machine; None: one for each core. A scheduler that runs has
    #: the workers that it has.
    workers: Annotated[int, Meta(ge=1, le=4096)] | None = None
    #: Time that a scheduler, and its first worker, have to answer, s
    patience: Annotated[float, Meta(gt=0)] = 30.0

    @contextmanager
    def crew(self, work: Work) -> Iterator[Workers]:
        """Connect to the scheduler, or start a cluster."""
        dask = require_package("distributed", "dask")
        if self.address is not None and self.workers is not None:
            raise ConfigurationError(
                f"{self.workers} given, and the scheduler at {self.address} has its own workers",
                where="launcher.workers",
                remedy="leave one of the two out",
            )
        with contextlib.ExitStack() as stack:
            target: Any = self.address
            if target is None:
                from joblib import cpu_count

                target = stack.enter_context(cluster(self.workers or max(1, cpu_count())))
            client = stack.enter_context(connect_client(dask, target, self.patience))
            if self.address is None:
                client.register_plugin(worker_plugin())
            wait_for_workers(client, self.patience, str(self.address or "this machine"))
            crew = DaskWorkers(client, work, str(self.address or "this machine"))
            stack.callback(crew.end)
            yield crew


def require_package(name: str, launcher: str) -> Any:
    """A package of the extra ``cluster``.

    Raises ConfigurationError if it is not installed; it tells the line that installs it.
    """
    try:
        return import_module(name)
    except ImportError as error:
        raise ConfigurationError(
            f"launcher={launcher} needs the package {name}, which is not installed",
            where="launcher",
            remedy=f"{INSTALL}, or launcher=local for the cores of this machine",
        ) from error


@contextmanager
def cluster(workers: int, **more: Any) -> Iterator[Any]:
    """A scheduler in this process, and worker processes of it on this machine."""
    import dask
    from distributed import LocalCluster

    # A worker that dies takes its task with it: the driver decides whether it is tried again.
    with dask.config.set(
        {
            "distributed.scheduler.allowed-failures": 0,
            "distributed.nanny.pre-spawn-environ": ONE_THREAD,
            "distributed.logging.distributed": "critical",
        }
    ):
        started = LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            processes=True,
            memory_limit=0,
            dashboard_address=None,
            # Any free port: another scheduler of this machine may have the usual one.
            scheduler_kwargs={"dashboard_address": "127.0.0.1:0"},
            silence_logs=logging.CRITICAL,
            **more,
        )
        try:
            yield started
        finally:
            with contextlib.suppress(Exception):
                started.close(timeout=10)


@contextmanager
def connect_client(distributed: Any, target: Any, patience: float, **more: Any) -> Iterator[Any]:
    """A client of a scheduler; raises ConfigurationError if it does not answer."""
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    try:
        client = distributed.Client(
            target, timeout=patience, set_as_default=False, name="trms", **more
        )
    except (OSError, ValueError, TimeoutError, ImportError) as error:
        reason = first_line(error, type(error).__name__)
        raise ConfigurationError(
            f"the Dask scheduler {target} does not answer ({reason})",
            where="launcher.address",
            remedy="start one (`dask scheduler`, and `dask worker ADDRESS --nthreads 1` on each "
            "machine), or leave the address out for this machine alone",
        ) from error
    try:
        yield client
    finally:
        with contextlib.suppress(Exception), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            client.close(timeout=5)


def wait_for_workers(client: Any, patience: float, where: str) -> None:
    """Wait for the first worker; raises ConfigurationError if none comes."""
    try:
        client.wait_for_workers(1, timeout=patience)
    except TimeoutError as error:
        raise ConfigurationError(
            f"no worker has joined the Dask scheduler ({where}) within {patience:g} s",
            where="launcher",
            remedy="start workers: `dask worker ADDRESS --nthreads 1`; or raise launcher.patience",
        ) from error


class DaskWorkers:
    """What is submitted to a scheduler (`where` it is, for messages), and comes back from it."""

    def __init__(self, client: Any, work: Work, where: str) -> None:
        self._client, self._work, self._where = client, work, where
        self._submissions: dict[str, tuple[Any, Attempt]] = {}
        self._came: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._workers, self._count_time = 1, -_EVERY
        self._name = f"trms-{time.time_ns():x}-{next(_numbers)}"

    @property
    def workers(self) -> int:
        """Worker processes that the scheduler has at present; at least one, for there may come."""
        here = time.monotonic()
        if here - self._count_time >= _EVERY:
            self._count_time = here
            with contextlib.suppress(Exception):
                self._workers = max(1, len(self._client.nthreads()))
        return self._workers

    def submit(self, attempts: Sequence[Attempt]) -> None:
        """Have runs made."""
        keys = [f"{self._name}-{each.point.number}-{next(_numbers)}" for each in attempts]
        try:
            futures = self._client.map(self._work, attempts, key=keys, pure=False, retries=0)
        except Exception as error:
            raise self._scheduler_error(error) from error
        for key, future, attempt in zip(keys, futures, attempts, strict=True):
            self._submissions[key] = (future, attempt)
            future.add_done_callback(lambda ended_future: self._came.put(ended_future.key))

    def collect(self, timeout_s: float) -> list[EndedAttempt]:
        """Those that have ended since the last call."""
        attempts = [
            each for key in collect_arrivals(self._came, timeout_s) for each in self._take(key)
        ]
        if not attempts and self._client.status not in ("running", "newly-created"):
            raise self._scheduler_error(None)
        return attempts

    def end(self) -> None:
        """Take back what has not ended."""
        futures = [future for future, _ in self._submissions.values()]
        with contextlib.suppress(Exception):
            self._client.cancel(futures, force=True)

    def _take(self, key: str) -> list[EndedAttempt]:
        future, attempt = self._submissions.pop(key, (None, None))
        if attempt is None or future is None:
            return []
        if future.status == "finished":
            result = future.result(timeout=30)
            reason = "" if result is not None else "another worker had begun it"
            return [EndedAttempt(attempt, result, reason)]
        if future.status == "error":
            error = future.exception(timeout=30)
            if type(error).__name__ in ("KilledWorker", "CancelledError", "WorkerClosedError"):
                return [EndedAttempt(attempt, None, "the process that ran it died")]
            return [EndedAttempt(attempt, None, first_line(error, type(error).__name__))]
        if self._client.status != "running":  # taken back, since the connection is lost
            raise self._scheduler_error(None)
        return [EndedAttempt(attempt, None, f"Dask has {future.status} it")]

    def _scheduler_error(self, error: Exception | None) -> TrmsError:
        reason = f" ({first_line(error, type(error).__name__)})" if error is not None else ""
        return TrmsError(
            f"the Dask scheduler ({self._where}) is gone{reason}",
            where="launcher",
            remedy="start it again, then `trms sweep resume FOLDER`",
        )


def worker_plugin() -> Any:
    """Ctrl-C is this process's to handle, not that of each worker."""
    from distributed import WorkerPlugin

    class Apart(WorkerPlugin):
        name = "trms: apart from the terminal"

        def setup(self, worker: Any) -> None:
            import signal

            with contextlib.suppress(ValueError):  # not in the main thread
                signal.signal(signal.SIGINT, signal.SIG_IGN)

    return Apart()
