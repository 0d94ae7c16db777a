"""Drives a sweep: asks the sampler for points, has them run, and sees that none is lost.

What counts is what lies in the folders. A worker's word may be lost (it died, the scheduler is
gone, the message came twice); then the status of the run tells. A run whose worker died is tried
again up to its number of retries; one that another worker is still at, left by a driver that was
killed, is waited for.
"""

import contextlib
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from trms_cli.core.errors import TrmsError
from trms_cli.sweeps.plugins import Attempt, EndedAttempt, Launcher, Proposals, Work, Workers
from trms_cli.sweeps.record import (
    SILENT_AFTER,
    Claim,
    Record,
    RunFolder,
    is_alive,
    lost_status,
    now,
)
from trms_cli.sweeps.space import RunResult, SweepPoint

#: Problem of a result that ends the whole sweep: every other run would fail of it too.
DISK_FULL = "the disk is full"
#: Runs that wait at each worker, so that it need not wait for this process.
_AHEAD = 1
#: s between two looks at runs of workers that do not answer to this process, and at the clock.
_LOOK = 0.5
#: s that running ones have to end when the sweep is interrupted.
_GRACE = 30.0
#: A worker that is told to go (a job out of time, preempted) has not failed at its run.
_MOST_INTERRUPTIONS = 20
_NOBODY = Claim(0, "", 0, "")


@dataclass
class SweepProgress:
    """How far a sweep is."""

    total: int | None = None  #: Points that there will be; None where nobody knows
    workers: int = 0  #: Runs that are made at once
    before: int = 0  #: Runs that had ended before this process began
    #: By the number of the point, of all that have ended
    results: dict[int, RunResult] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)  #: Of results by state
    retried: int = 0  #: Attempts that were made again
    running: int = 0  #: Points that have been handed out
    #: Of this process's part, s of the monotonic clock
    begin: float = field(default_factory=time.monotonic)

    def take(self, result: RunResult) -> None:
        """Count a result; one that is known already is not counted twice."""
        if result.number not in self.results:
            self.counts[result.state] = self.counts.get(result.state, 0) + 1
        self.results[result.number] = result

    @property
    def ended_count(self) -> int:
        """Runs that have ended, however."""
        return len(self.results)

    @property
    def rate(self) -> float:
        """Runs that ended per second since this process began."""
        spent = time.monotonic() - self.begin
        return (self.ended_count - self.before) / spent if spent > 0 else 0.0


@dataclass(frozen=True)
class SweepOutcome:
    """A sweep that has been driving to its end."""

    folder: Path
    points: tuple[SweepPoint, ...]  #: That were proposed
    results: dict[int, RunResult]  #: By the number of the point
    counts: dict[str, int]  #: Runs ``done``, ``failed``, ``lost``, ``interrupted``
    summary: dict[str, Any] = field(default_factory=dict)  #: What the sampler has to say

    @property
    def all_done(self) -> bool:
        """Whether every run ended well."""
        return len(self.points) == self.counts.get("done", 0)


#: Called with the progress and, after each run, with its result.
Tell = Callable[[SweepProgress, RunResult | None], None]


class Driver:
    """One process's part in a sweep.

    `proposals` have been started with the points of the record, and `work` makes one run. `retries`
    are the times that a run is tried again after its worker died; with `retry_failed`, runs that
    failed or were lost before this process began are made again. `tell` is called after each
    result, and about twice a second with None.
    """

    def __init__(
        self,
        record: Record,
        proposals: Proposals,
        work: Work,
        *,
        retries: int,
        tell: Tell = lambda progress, result: None,
        retry_failed: bool = False,
    ) -> None:
        self.progress = SweepProgress(total=proposals.total)
        self._record, self._proposals, self._work = record, proposals, work
        self._retries, self._tell = retries, tell
        self.points: list[SweepPoint] = []  #: That have been proposed, also by earlier processes
        self._waiting: deque[Attempt] = deque()
        self._handed: dict[int, Attempt] = {}
        self._watched: dict[int, _Watched] = {}
        self._tries: dict[int, int] = {}
        self._new: list[RunResult] = []
        self._again = ("failed", "lost", "interrupted") if retry_failed else ("interrupted",)
        self._stopping = False

    def take_stock(self, earlier_points: Iterable[SweepPoint]) -> None:
        """Look at what earlier processes left of the points that they proposed."""
        for point in earlier_points:
            self.points.append(point)
            folder = RunFolder(self._record.folder, point.number)
            result = folder.result()
            if result is not None and result.state not in self._again:
                self._take(result)
                continue
            attempt = folder.last_attempt()
            if result is None and attempt and is_alive(folder.holder() or _NOBODY) is not False:
                self._watched[point.number] = _Watched(Attempt(point, attempt))
            else:
                self._waiting.append(Attempt(point, attempt + 1))
        self.progress.before = self.progress.ended_count

    def drive(self, launcher: Launcher) -> None:
        """Have all points run.

        Raises KeyboardInterrupt when it was interrupted (the runs have then ended, and the record
        tells so), and TrmsError if there are no workers to be had, or the disk is full.
        """
        with contextlib.suppress(FileNotFoundError):
            self._record.stop_file.unlink()
        self._fill(1)
        if not (self._waiting or self._watched):
            return
        with launcher.crew(self._work) as crew:
            self.progress.workers = crew.workers
            self.progress.begin = time.monotonic()
            try:
                while self._go_on(crew):
                    pass
            except (KeyboardInterrupt, TrmsError):
                self._stop(crew)
                raise

    def _go_on(self, crew: Workers) -> bool:
        """Hand out what there is, and take what has come; False when all is done."""
        room = crew.workers - len(self._handed)
        self._fill(room - len(self._waiting))
        ready = []
        while self._waiting and len(self._handed) < crew.workers * (1 + _AHEAD):
            attempt = self._waiting.popleft()
            self._handed[attempt.point.number] = attempt
            ready.append(attempt)
        if ready:
            crew.submit(ready)
        self.progress.running = len(self._handed)
        if not self._handed and not self._watched:
            return bool(self._waiting)
        if self._handed:
            for ended in crew.collect(_LOOK):
                self._settle(ended)
        else:
            time.sleep(_LOOK)
        self._look_at_watched()
        self._tell(self.progress, None)
        return True

    def _fill(self, count: int) -> None:
        """Ask the sampler for points, and write them down."""
        if count <= 0 and not self._new:
            return
        results, self._new = self._new, []
        points = self._proposals.more(results, max(0, count))
        if points:
            self._record.append(points)
            self.points.extend(points)
            self._waiting.extend(Attempt(point) for point in points)

    def _settle(self, ended: EndedAttempt) -> None:
        """Take a result, or find out what became of a run without one."""
        attempt = self._handed.pop(ended.attempt.point.number, None)
        if attempt is None:
            return  # told twice
        result = ended.result
        if result is not None and result.problem.startswith(DISK_FULL):
            raise TrmsError(
                result.problem,
                where=str(self._record.folder),
                remedy=f"free space, then go on: trms sweep resume {self._record.folder}",
            )
        if result is not None and result.state != "interrupted":
            self._take(result)
            return
        folder = RunFolder(self._record.folder, attempt.point.number)
        folder_result = folder.result()
        if folder_result is not None and folder_result.state != "interrupted":
            self._take(folder_result)
        elif folder.last_attempt() < attempt.number:
            self._waiting.appendleft(attempt)  # it left before it began with this one
        elif folder_result is None and is_alive(folder.holder() or _NOBODY) is not False:
            self._watched[attempt.point.number] = _Watched(attempt)
        elif folder_result is not None:
            self._try_again(attempt, "it was told to end each time", _MOST_INTERRUPTIONS)
        else:
            self._try_again(attempt, ended.reason or "no reason given", self._retries)

    def _try_again(self, attempt: Attempt, reason: str, most: int) -> None:
        if self._stopping:
            return
        point = attempt.point
        tries = self._tries[point.number] = self._tries.get(point.number, 0) + 1
        folder = RunFolder(self._record.folder, point.number)
        if tries <= most:
            self.progress.retried += 1
            self._waiting.append(Attempt(point, max(folder.last_attempt(), attempt.number) + 1))
            return
        status = lost_status(point, tries, reason, folder.status())
        folder.path.mkdir(exist_ok=True)
        folder.write(status)
        self._take(RunResult(point.number, "lost", problem=status["error"]["problem"]))

    def _take(self, result: RunResult) -> None:
        self.progress.take(result)
        self._new.append(result)
        self._tell(self.progress, result)

    def _look_at_watched(self) -> None:
        """Runs of workers that this process does not hear of: have they ended, do they live?"""
        for number, watched in list(self._watched.items()):
            folder = RunFolder(self._record.folder, number)
            result = folder.result()
            if result is not None and result.state != "interrupted":
                del self._watched[number]
                self._take(result)
            elif result is not None:
                del self._watched[number]
                self._try_again(watched.attempt, "it was ended", _MOST_INTERRUPTIONS)
            elif not watched.lives(folder):
                del self._watched[number]
                self._try_again(watched.attempt, "it gave no sign of life any more", self._retries)

    def _stop(self, crew: Workers) -> None:
        """Have the running ones end, and wait for them."""
        self._stopping = True
        self._waiting.clear()
        with contextlib.suppress(OSError):
            self._record.stop_file.write_text(now(), encoding="utf-8")
        until = time.monotonic() + _GRACE
        while self._handed and time.monotonic() < until:
            try:
                attempts = crew.collect(_LOOK)
            except TrmsError:
                break  # no workers any more
            for ended in attempts:
                with contextlib.suppress(TrmsError):
                    self._settle(ended)


@dataclass
class _Watched:
    """A run that somebody else's worker is at."""

    attempt: Attempt
    sign: float = -1.0
    since: float = 0.0

    def lives(self, folder: RunFolder) -> bool:
        """Whether its worker lives: the process is there, or it has given a sign of late.

        Times of the disk are compared only with each other, since hosts' clocks differ.
        """
        alive = is_alive(folder.holder() or _NOBODY)
        if alive is not None:
            return alive
        sign, here = folder.sign_of_life(), time.monotonic()
        if sign != self.sign:
            self.sign, self.since = sign, here
        return here - self.since < SILENT_AFTER


def counts_of(results: Mapping[int, RunResult]) -> dict[str, int]:
    """Results by state, each state named."""
    counts = dict.fromkeys(("done", "failed", "lost", "interrupted"), 0)
    for result in results.values():
        counts[result.state] += 1
    return counts
