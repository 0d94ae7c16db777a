"""The cores of this machine: worker processes of joblib's loky, which stay up.

loky needs no ``if __name__ == "__main__"`` in a script or notebook and notices a worker that was
killed, but then gives up the whole pool. So each worker is a pool of its own: the death of one
costs the run that it was at, and a new one takes its place.
"""

import contextlib
import os
import queue
import signal
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Annotated, Any, TypeVar

from msgspec import Meta

from trms_cli.core.errors import TrmsError, first_line
from trms_cli.core.threads import ONE_THREAD
from trms_cli.sweeps.plugins import Attempt, EndedAttempt, Work, Workers

#: Workers that may die one after another without having finished a single run.
_MOST_DEATHS = 20
_GRACE = 15.0  # s
_T = TypeVar("_T")


@dataclass(frozen=True, kw_only=True)
class LocalLauncher:
    """Worker processes on this machine."""

    #: Processes; None: as many as this process may use cores (affinity and the limits of its
    #: control group count). 0: no process is started, the runs are made in this one, one after
    #: another, as a debugger needs it.
    workers: Annotated[int, Meta(ge=0, le=4096)] | None = None

    @contextmanager
    def crew(self, work: Work) -> Iterator[Workers]:
        """Start the workers; they are up when the first run needs them."""
        if self.workers == 0:
            yield InProcess(work)
            return
        from joblib import cpu_count

        crew = _LokyCrew(work, self.workers or max(1, cpu_count()))
        try:
            yield crew
        finally:
            crew.end()


@dataclass
class InProcess:
    """Makes the runs in this process, when it is asked for what has ended."""

    work: Work  #: Makes one run
    _waiting: list[Attempt] = field(default_factory=list)

    @property
    def workers(self) -> int:
        """One at a time."""
        return 1

    def submit(self, attempts: Sequence[Attempt]) -> None:
        """Note what is to be done."""
        self._waiting += attempts

    def collect(self, timeout_s: float) -> list[EndedAttempt]:
        """Make one run."""
        if not self._waiting:
            return []
        attempt = self._waiting.pop(0)
        return [EndedAttempt(attempt, self.work(attempt))]


@dataclass
class _Worker:
    """A pool of one process, and what it has been given."""

    pool: Any
    attempts: dict[Future[Any], Attempt] = field(default_factory=dict)


class _LokyCrew:
    """Pools of one process each."""

    def __init__(self, work: Work, workers: int) -> None:
        self._work = work
        self._team = [_Worker(_pool()) for _ in range(workers)]
        self._came: queue.SimpleQueue[tuple[_Worker, Future[Any]]] = queue.SimpleQueue()
        self._deaths = 0  # since a run was finished

    @property
    def workers(self) -> int:
        return len(self._team)

    def submit(self, attempts: Sequence[Attempt]) -> None:
        for attempt in attempts:
            worker = min(self._team, key=lambda each: len(each.attempts))
            try:
                future = worker.pool.submit(self._work, attempt)
            except Exception:  # the pool has broken, and its futures are on their way to `collect`
                self._replace(worker)
                future = worker.pool.submit(self._work, attempt)
            worker.attempts[future] = attempt
            future.add_done_callback(
                lambda ended_future, worker=worker: self._came.put((worker, ended_future))
            )

    def collect(self, timeout_s: float) -> list[EndedAttempt]:
        return [
            each for came in collect_arrivals(self._came, timeout_s) for each in self._take(*came)
        ]

    def end(self) -> None:
        """End the processes, whatever they are at."""
        for worker in self._team:
            _kill(worker.pool)

    def _take(self, worker: _Worker, future: Future[Any]) -> list[EndedAttempt]:
        attempt = worker.attempts.pop(future, None)
        if attempt is None:
            return []
        error = future.exception() if not future.cancelled() else None
        if error is None and not future.cancelled():
            self._deaths = 0
            return [EndedAttempt(attempt, future.result())]
        from joblib.externals.loky.process_executor import BrokenProcessPool

        if error is not None and not isinstance(error, BrokenProcessPool):
            raise error  # of the program itself: a run's own are in its result
        self._deaths += 1
        if self._deaths > _MOST_DEATHS * len(self._team):
            raise TrmsError(
                f"workers die before they finish a run: {first_line(error)}",
                where="launcher",
                remedy="run one of them alone to see why: launcher.workers=0",
            )
        if worker.pool._flags.broken is not None:
            self._replace(worker)
        return [EndedAttempt(attempt, None, first_line(error))]

    def _replace(self, worker: _Worker) -> None:
        _kill(worker.pool)
        worker.pool = _pool()


def _pool() -> Any:
    from joblib.externals.loky.process_executor import ProcessPoolExecutor

    return ProcessPoolExecutor(max_workers=1, initializer=prepare_process, env=ONE_THREAD)


def _kill(pool: Any) -> None:
    with contextlib.suppress(Exception):
        pool.shutdown(wait=False, kill_workers=True)


def prepare_process() -> None:
    """Make a process of its own into a worker: Ctrl-C is its parent's, output is nobody's."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.close(nowhere)
    threading.Thread(target=_end_with_parent, args=(os.getppid(),), daemon=True).start()


def _end_with_parent(parent: int) -> None:
    """Leave no worker behind when the sweep's process is killed; a run has time to end before."""
    while os.getppid() == parent:
        time.sleep(1.0)
    time.sleep(_GRACE)
    os._exit(1)


def collect_arrivals(came: queue.SimpleQueue[_T], timeout_s: float) -> list[_T]:
    """What a queue holds, after waiting up to a time for the first."""
    arrivals: list[_T] = []
    with contextlib.suppress(queue.Empty):
        arrivals.append(came.get(timeout=timeout_s))
        while True:
            arrivals.append(came.get_nowait())
    return arrivals
