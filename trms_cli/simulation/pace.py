"""When a sample is due: at once in a simulation, at its time on the clock beside a real rig.

Deadlines are absolute: sample k is due at k sample times after the first, whatever the samples
before it took, so that nothing drifts over an hour.
"""

from __future__ import annotations

import ctypes
import gc
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Annotated, Literal, Protocol

from msgspec import Meta

#: s before a deadline from which on the clock is asked again and again: a sleep ends late by some
#: tens of µs on an idle machine, by ten times that on a loaded one.
_SPIN = 0.3e-3
_MCL_CURRENT, _MCL_FUTURE = 1, 2
#: s after its time, from which on a sample counts as late.
IN_TIME = 1e-3


class Clock(Protocol):
    """Counts seconds from a moment of its own, and never runs back."""

    def now(self) -> float:
        """The time, s."""

    def sleep_until(self, moment: float) -> None:
        """Come back at a moment (s), or at once where it has passed."""


class WallClock:
    """The monotonic clock of the machine."""

    def now(self) -> float:
        """The time, s."""
        return time.perf_counter()

    def sleep_until(self, moment: float) -> None:
        """Sleep, and spin the last part."""
        now = time.perf_counter
        left = moment - now() - _SPIN
        if left > 0:
            time.sleep(left)
        while now() < moment:
            pass


class VirtualClock:
    """A clock that stands still unless somebody sleeps: hours of tests in seconds."""

    def __init__(self) -> None:
        self.time = 0.0  #: s

    def now(self) -> float:
        """The time, s."""
        return self.time

    def sleep_until(self, moment: float) -> None:
        """Be there."""
        self.time = max(self.time, moment)


@dataclass(frozen=True, kw_only=True)
class LatePolicy:
    """What is done with samples that are not in time."""

    #: What is done where a whole period has passed: the command is held and the sample read
    #: without asking the controller, or the sample is left out
    policy: Literal["hold", "skip"] = "hold"
    #: Samples in a row, each late by a whole period, after which the rig is landed; None: never
    land_after: Annotated[int, Meta(ge=1)] | None = 25


class Pace:
    """Keeps the deadlines of one run.

    ``sample_time``: s. ``clock``: a virtual one in tests.
    """

    def __init__(self, sample_time: float, late: LatePolicy, clock: Clock | None = None) -> None:
        self.late, self.clock = late, clock or WallClock()
        self._period = sample_time
        self._start = self.clock.now()
        self._next = 0
        self.lateness = 0.0  #: s, of the present sample: when it began less when it was due
        self._behind = 0

    def begin(self) -> None:
        """The next sample is due now, and counts as the first."""
        self._start, self._next, self._behind = self.clock.now(), 0, 0

    def step(self) -> None:
        """Come back when the next sample is due, and take down how late that was."""
        due = self._start + self._next * self._period
        self._next += 1
        self.clock.sleep_until(due)
        self.lateness = self.clock.now() - due
        self._behind = self._behind + 1 if self.is_behind else 0

    def skip(self) -> None:
        """Leave the next sample out."""
        self._next += 1

    def elapsed(self) -> float:
        """s since the first sample was due."""
        return self.clock.now() - self._start

    @property
    def is_behind(self) -> bool:
        """Whether the present sample is late by a whole period."""
        return self.lateness >= self._period

    @property
    def periods_behind(self) -> int:
        """Whole periods by which the present sample is late."""
        return int(self.lateness / self._period)

    @property
    def lost(self) -> bool:
        """Whether so many samples in a row were behind that the rig has to land."""
        return self.late.land_after is not None and self._behind >= self.late.land_after


@contextmanager
def undisturbed() -> Iterator[list[str]]:
    """No garbage collection inside, and as much of the machine as it lets us have.

    Gives what was refused, in words. Of what is allowed: memory that is not paged out
    (``mlockall``) and a place before ordinary processes (``SCHED_FIFO``).
    """
    gc.collect()
    was_enabled = gc.isenabled()
    gc.disable()
    refused = [words for words in (_lock_memory(), _first_in_line()) if words]
    try:
        yield refused
    finally:
        if was_enabled:
            gc.enable()
        if hasattr(os, "sched_setscheduler"):
            with suppress(OSError):
                os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        with suppress(OSError, AttributeError, TypeError):
            ctypes.CDLL(None).munlockall()


def _lock_memory() -> str:
    try:
        library = ctypes.CDLL(None, use_errno=True)
        if library.mlockall(_MCL_CURRENT | _MCL_FUTURE) == 0:
            return ""
        reason = os.strerror(ctypes.get_errno())
    except (OSError, AttributeError, TypeError) as error:  # the last where there is no libc
        reason = str(error)
    return f"memory may be paged out (mlockall: {reason})"


def _first_in_line() -> str:
    if not hasattr(os, "sched_setscheduler"):
        return "no real-time scheduling on this system"
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(50))
    except OSError as error:
        return f"scheduled like any process (SCHED_FIFO: {error.strerror})"
    return ""
