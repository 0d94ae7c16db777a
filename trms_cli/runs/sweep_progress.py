"""How far a sweep is, from the ``status.json`` (``trms.status/1``) that each job keeps."""

from __future__ import annotations

import contextlib
import json
import math
import os
import platform
import re
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from trms_cli.core.data_file import read_bytes
from trms_cli.core.errors import RecordingError
from trms_cli.runs.driving import has_driver
from trms_cli.runs.entry import STATUS_NAME, status_document

_DEEPEST = 3  # folders between a sweep and its jobs
_RECENT = 60  # ended jobs that the throughput is told over
_ENDED = ("done", "failed", "interrupted", "lost")
_RECORD_NAME, _RECORD_SCHEMA = "sweep.json", "trms.sweep/1"
_LONGEST_RECORD = 2**26  # bytes


@dataclass(frozen=True)
class Job:
    """A job of a sweep."""

    name: str  #: Its folder, from that of the sweep
    #: ``running``, ``done``, ``failed``, ``interrupted``, ``lost`` (its worker died each time), or
    #: ``gone``: it says that it runs, and this machine has no such process
    state: str
    overrides: tuple[str, ...]  #: What was typed for it
    objective: float  #: What the sweep minimises; NaN if it has none (yet)
    problem: str  #: Why it failed
    changed: float  #: When it last said something, seconds since the epoch


@dataclass(frozen=True)
class SweepState:
    """A sweep at one moment."""

    folder: Path
    overrides: tuple[str, ...]  #: What was typed; empty if that is not known
    total: int | None  #: Jobs that there will be; None if nobody knows
    jobs: tuple[Job, ...]  #: Those that have begun
    rate: float  #: Jobs that ended per second, of late; NaN before two have
    now: float  #: Seconds since the epoch
    #: What its record says: ``running`` while a process drives it, ``done``, or ``interrupted``
    #: where that process has gone before the end; empty for a sweep without a record
    state: str = ""

    def count(self, *states: str) -> int:
        """The number of jobs in any of some states."""
        return sum(job.state in states for job in self.jobs)

    @property
    def ended(self) -> bool:
        """Nothing more will come: nobody drives it, or nothing runs and all has ended or died."""
        if self.state:
            return self.state != "running"
        if self.count("running"):
            return False
        return self.count("gone") > 0 or (self.total is not None and len(self.jobs) >= self.total)

    @property
    def stopped(self) -> bool:
        """Whether the process that drove it has gone before the end."""
        return self.state == "interrupted"

    @property
    def left_s(self) -> float:
        """Seconds until the end if it goes on as of late; NaN if nobody knows."""
        if self.total is None or math.isnan(self.rate) or self.rate <= 0:
            return math.nan
        return (self.total - self.count(*_ENDED)) / self.rate

    @property
    def best(self) -> list[Job]:
        """Jobs with an objective, the best (smallest) first."""
        scored = [job for job in self.jobs if math.isfinite(job.objective)]
        return sorted(scored, key=lambda job: job.objective)

    @property
    def failures(self) -> list[Job]:
        """Jobs that did not end well, the latest first."""
        states = ("failed", "lost", "interrupted", "gone")
        failed = [job for job in self.jobs if job.state in states]
        return sorted(failed, key=lambda job: -job.changed)


class _Plan(NamedTuple):
    """What the record of a sweep says."""

    overrides: tuple[str, ...]
    total: int | None
    state: str = ""  #: as it was written; empty without a record


@dataclass
class SweepFollower:
    """A sweep's folder, followed as its jobs begin and end; only what has changed is read again."""

    folder: Path
    _jobs: dict[str, tuple[int, Job]] = field(default_factory=dict)
    _plan: _Plan | None = None
    _planned: int = 0

    def now(self) -> SweepState:
        """The sweep as it is."""
        # The lock is looked at first: who drives the sweep writes its end before he lets go.
        driven = has_driver(self.folder)
        self._look_at_plan()
        assert self._plan is not None
        for file, changed in _status_files(self.folder):
            known = self._jobs.get(file)
            if known is None or known[0] != changed or known[1].state in ("running", "gone"):
                job = _read(Path(file), self.folder, changed)
                if job is not None:
                    self._jobs[file] = changed, job
        jobs = tuple(job for _, (_, job) in sorted(self._jobs.items(), key=_by_number))
        overrides, total, state = self._plan
        if total is not None and len(jobs) > total:
            total = None  # not the sweep that the plan is of
        if state:
            state = "running" if driven else "done" if state == "done" else "interrupted"
        return SweepState(self.folder, overrides, total, jobs, _rate(jobs), time.time(), state)

    def _look_at_plan(self) -> None:
        """Read the plan where it is new: what there is to be is written after it has begun."""
        try:
            changed = (self.folder / _RECORD_NAME).stat().st_mtime_ns
        except OSError:
            changed = 0
        if self._plan is None or changed != self._planned:
            self._planned, self._plan = changed, _plan(self.folder)


def is_sweep(folder: Path) -> bool:
    """Whether a folder holds jobs of a sweep."""
    return any(_document(Path(file)) is not None for file, _ in _status_files(folder))


def sweep_of(log: Path) -> Path | None:
    """The folder of the sweep that a run is a job of; None if it is none."""
    if _document(log.with_name(STATUS_NAME)) is None:
        return None
    return log.parent.parent


def _by_number(item: tuple[str, Any]) -> tuple[Any, ...]:
    return tuple(int(part) if part.isdigit() else part for part in re.split(r"(\d+)", item[0]))


def _status_files(folder: Path) -> Iterator[tuple[str, int]]:
    waiting = [(str(folder), 0)]
    while waiting:
        place, depth = waiting.pop()
        with contextlib.suppress(OSError), os.scandir(place) as entries:
            for entry in entries:
                with contextlib.suppress(OSError):
                    if entry.name == STATUS_NAME and depth > 0:
                        yield entry.path, entry.stat().st_mtime_ns
                    elif depth < _DEEPEST and entry.is_dir(follow_symlinks=False):
                        waiting.append((entry.path, depth + 1))


def _document(file: Path) -> Mapping[str, Any] | None:
    try:
        return status_document(file)
    except OSError:
        return None


def _read(file: Path, folder: Path, changed: int) -> Job | None:
    document = _document(file)
    if document is None:
        return None
    state = str(document.get("state"))
    if state == "running" and not _is_alive(document.get("pid"), document.get("host")):
        state = "gone"
    overrides = document.get("overrides")
    objective = document.get("objective")
    if isinstance(objective, bool) or not isinstance(objective, (int, float)):
        objective = math.nan
    error = document.get("error")
    problem = error.get("problem") if isinstance(error, Mapping) else error
    return Job(
        name=str(file.parent.relative_to(folder)),
        state=state,
        overrides=tuple(map(str, overrides)) if isinstance(overrides, list) else (),
        objective=float(objective),
        problem=str(problem or ""),
        changed=changed / 1e9,
    )


def _is_alive(pid: Any, host: Any) -> bool:
    if isinstance(host, str) and host != platform.node():
        return True  # nobody here can tell
    if not isinstance(pid, int) or isinstance(pid, bool) or not 0 < pid < 2**31:
        return True  # it does not say: believe it
    try:
        os.kill(pid, 0)  # asks; sends nothing
    except ProcessLookupError:
        return False
    except OSError:
        pass  # somebody else's process
    return True


def _rate(jobs: tuple[Job, ...]) -> float:
    times = sorted(job.changed for job in jobs if job.state in _ENDED)[-_RECENT:]
    if len(times) < 2 or times[-1] <= times[0]:
        return math.nan
    return (len(times) - 1) / (times[-1] - times[0])


def _plan(folder: Path) -> _Plan:
    """What was typed for a sweep, and how many jobs that makes, from the record of the sweep."""
    if (folder / _RECORD_NAME).exists():
        return _recorded_plan(folder / _RECORD_NAME)
    return _plan_of_hydra(folder)


def _recorded_plan(file: Path) -> _Plan:
    try:
        document = json.loads(read_bytes(file, _LONGEST_RECORD))
    except (OSError, RecordingError, ValueError, RecursionError):
        return _Plan((), None)
    if not isinstance(document, Mapping) or document.get("schema") != _RECORD_SCHEMA:
        return _Plan((), None)
    overrides, total = document.get("overrides"), document.get("total")
    return _Plan(
        tuple(map(str, overrides)) if isinstance(overrides, list) else (),
        total if isinstance(total, int) and not isinstance(total, bool) else None,
        str(document.get("state", "interrupted")),
    )


def _plan_of_hydra(folder: Path) -> _Plan:
    """The same of a sweep that Hydra made, as earlier versions did."""
    import yaml

    from trms_cli.core.yaml_data import MOST_BYTES, load_yaml

    try:
        text = read_bytes(folder / "multirun.yaml", MOST_BYTES).decode()
    except (OSError, RecordingError, UnicodeDecodeError):
        return _Plan((), None)
    # The sweep's own settings stand at the top; the experiment below is not looked at.
    block = re.match(r"hydra:\n(?:[ \n].*\n?|\n)*", text)
    try:
        hydra = load_yaml(block[0] if block else "")["hydra"]
        overrides = tuple(str(word) for word in hydra["overrides"]["task"])
        sweeper = str(hydra["sweeper"]["_target_"])
    except (yaml.YAMLError, TypeError, KeyError):
        return _Plan((), None)
    if not sweeper.endswith("BasicSweeper") or hydra["sweeper"].get("params"):
        return _Plan(overrides, None)
    counts = [_values(word.partition("=")[2]) for word in overrides]
    known = [count for count in counts if count is not None]
    return _Plan(overrides, math.prod(known) if len(known) == len(counts) else None)


def _values(text: str) -> int | None:
    """How many values an override has: those that commas part, outside of brackets and quotes.

    None for what only Hydra can count: globs, intervals, and lists that are sorted or shuffled.
    """
    text = text.strip()
    function = re.match(r"([a-z_]+)\((.*)\)$", text, re.DOTALL)
    if function and function[1] == "range":
        return _range(function[2])
    if function and function[1] == "choice":
        text = function[2]
    elif function:
        return None
    count, depth, quote, previous = 1, 0, "", ""
    for sign in text:
        if quote:
            quote = "" if sign == quote and previous != "\\" else quote
        elif sign in "'\"":
            quote = sign
        elif sign in "([{":
            depth += 1
        elif sign in ")]}":
            depth -= 1
        elif sign == "," and depth == 0:
            count += 1
        previous = sign
    return count


def _range(arguments: str) -> int | None:
    """The length of ``range(stop)``, ``range(start, stop)``, ``range(start, stop, step)``."""
    try:
        numbers = [float(part.rpartition("=")[2]) for part in arguments.split(",")]
    except ValueError:
        return None
    if "=" in arguments or not 1 <= len(numbers) <= 3 or not all(map(math.isfinite, numbers)):
        return None
    start, stop, step = (0.0, numbers[0], 1.0) if len(numbers) == 1 else (*numbers, 1.0)[:3]
    count = (stop - start) / step - 1e-9 if step else math.nan
    return max(0, math.ceil(count)) if math.isfinite(count) else None
