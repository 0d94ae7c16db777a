"""How a sweep stands (``trms.sweep-status/1``), or how far it is as it goes on: from its folder."""

import contextlib
import math
import os
import platform
import re
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

from trms_cli.core.data_file import read_bytes
from trms_cli.core.errors import ConfigurationError, RecordingError
from trms_cli.core.uncollected import uncollected
from trms_cli.runs.entry import STATUS_NAME
from trms_cli.sweeps import record
from trms_cli.sweeps.space import SweepPoint

SCHEMA = "trms.sweep-status/1"
#: A number, or what a message says was given: one cause is not many because values differ.
_GIVEN = re.compile(r"\(given: [^)]*\)|(?<![\w.])[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?(?!\w)")
#: Overrides of a run that are shown of it.
MOST_WORDS = 4
_MOST_LINES = 30  # a line for each run of a sweep that has no more


class _Failure(NamedTuple):
    """Runs that failed of one reason."""

    reason: tuple[str, ...]  #: of the first of them
    runs: list[int]
    bad_input: bool  #: to try again cannot help


@uncollected()
def outcome_of(folder: Path, points: Sequence[SweepPoint] | None = None) -> dict[str, Any]:
    """Counts, failures by their reason, the rate and the best.

    `points`: that were proposed, where they are known; else the record is read.
    Returns ``counts`` by state, among them ``running`` and ``left`` (proposed, and not begun or
    left by a worker that died); ``failures``: state, problem, where, remedy (of the first of those
    that differ in values only), count, runs and whether what was typed is the reason; ``rate`` in
    runs per second of late; ``best``: the run with the smallest objective; ``told``: what each run
    says of itself, for a sweep of few. Raises RecordingError if there is no sweep.
    """
    sweep = record.Record(folder)
    document = sweep.document()
    points = sweep.points() if points is None else points
    counts = dict.fromkeys(("done", "failed", "lost", "interrupted", "running", "left"), 0)
    failures: dict[tuple[str, ...], _Failure] = {}
    ends: list[float] = []
    retried = 0
    best: tuple[float, int] | None = None
    common_overrides: Sequence[str] = document["overrides"]
    for point in points:
        run = record.RunFolder(folder, point.number)
        status = run.status()
        state = _state(run, status)
        counts[state] += 1
        retried += max(0, int(status.get("attempt", 1)) - 1) if status else 0
        if state in ("failed", "lost"):
            reason = _reason(state, status)
            alike = tuple(_GIVEN.sub("…", words) for words in reason)
            failures.setdefault(alike, _Failure(reason, [], _of_input(status)))
            failures[alike].runs.append(point.number)
        if state == "done":
            ends.append(_seconds(status.get("end")))
            value = record.objective_of(status)
            if value is not None and math.isfinite(value) and (not best or value < best[0]):
                best = value, point.number
    total = document.get("total")
    lines = [_line(folder, point.number, document) for point in points[:_MOST_LINES]]
    if isinstance(total, int):
        counts["left"] += max(0, total - len(points))
    state = document["state"]
    driven = record.has_driver(folder)
    return {
        "schema": SCHEMA,
        "folder": str(folder),
        "primary": document["primary"],
        "state": "running" if driven else "interrupted" if state == "running" else state,
        "driven": driven,
        "overrides": list(common_overrides),
        "total": total,
        "counts": counts,
        "retried": retried,
        "rate": rate_of(ends, latest=200, least=3),
        "failures": [
            dict(zip(("state", "problem", "where", "remedy"), each.reason, strict=True))
            | {"count": len(each.runs), "runs": each.runs, "bad_input": each.bad_input}
            for each in sorted(failures.values(), key=lambda each: -len(each.runs))
        ],
        "best": None
        if best is None
        else {
            "run": best[1],
            "objective": best[0],
            "overrides": [w for w in points[best[1]].overrides if w not in set(common_overrides)],
        },
        "told": [line for line in lines if line] if len(points) <= _MOST_LINES else [],
        "summary": document.get("summary") or {},
    }


def _line(folder: Path, number: int, document: Mapping[str, Any]) -> str:
    """What a run says of itself, without what all runs share, on a line of a screen."""
    status = record.RunFolder(folder, number).status()
    line = str(status.get("told") or "")
    space = document.get("space")
    fixed = set(space.get("fixed", ()) if isinstance(space, Mapping) else ())
    overrides = [str(word) for word in status.get("overrides", ())]
    own = [word for word in overrides if word not in fixed]
    typed = " ".join(overrides)
    if typed and typed in line:
        return line.replace(typed, few(own), 1)
    for word in fixed:
        line = line.replace(f" {word}", "", 1)
    return line


def few(words: Sequence[str]) -> str:
    """Overrides for reading: the first few, numbers with six digits, long keys by their end.

    What is to be typed again stands in full in ``status.json`` and in ``points.jsonl``.
    """
    if len(words) <= MOST_WORDS:
        return " ".join(map(_readable, words))
    first_words = [_readable(word) for word in words[:MOST_WORDS]]
    return f"{' '.join(first_words)} … and {len(words) - MOST_WORDS} more"


def _readable(word: str) -> str:
    key, sign, value = word.partition("=")
    try:
        number = float(value)
    except ValueError:
        return word
    short = key.removeprefix("plant.parameters.")
    whole = re.fullmatch(r"[-+]?\d+", value) is not None
    return f"{short}{sign}{value if whole or not math.isfinite(number) else f'{number:.6g}'}"


def _state(run: record.RunFolder, status: Mapping[str, Any]) -> str:
    if not status:
        return "left"
    if status["state"] == "running":
        holder = run.holder()
        return "left" if holder is not None and record.is_alive(holder) is False else "running"
    return str(status["state"]) if status["state"] in ("done", "failed", "lost") else "interrupted"


def _reason(state: str, status: Mapping[str, Any]) -> tuple[str, ...]:
    error = status.get("error")
    if not isinstance(error, Mapping):
        code = status.get("exit_code")
        return state, f"it ended with exit code {code}", "", ""
    first = str(error.get("problem", "")).strip().splitlines()
    return (
        state,
        first[0] if first else "no reason given",
        str(error.get("where") or ""),
        str(error.get("remedy") or ""),
    )


def _of_input(status: Mapping[str, Any]) -> bool:
    """Whether the run failed of what was typed."""
    error = status.get("error")
    return isinstance(error, Mapping) and error.get("type") == ConfigurationError.__name__


def _seconds(moment: Any) -> float:
    try:
        return datetime.fromisoformat(moment).timestamp()
    except (TypeError, ValueError):
        return math.nan


def rate_of(ends: Iterable[float], *, latest: int, least: int) -> float | None:
    """Runs per second over the latest that ended; None before so many have."""
    times = sorted(each for each in ends if math.isfinite(each))[-latest:]
    if len(times) < least or times[-1] <= times[0]:
        return None
    return (len(times) - 1) / (times[-1] - times[0])


_DEEPEST = 3  # folders between a sweep and its jobs
_RECENT = 60  # ended jobs that the throughput is told over


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
    last_change: float  #: When it last said something, seconds since the epoch


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
    def has_ended(self) -> bool:
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
        return (self.total - self.count(*record.ENDED)) / self.rate

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
        return sorted(failed, key=lambda job: -job.last_change)


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
        driven = record.has_driver(self.folder)
        self._look_at_plan()
        assert self._plan is not None
        for file, changed in _status_files(self.folder):
            entry = self._jobs.get(file)
            if entry is None or entry[0] != changed or entry[1].state in ("running", "gone"):
                job = _job(Path(file), self.folder, changed)
                if job is not None:
                    self._jobs[file] = changed, job
        jobs = tuple(job for _, (_, job) in sorted(self._jobs.items(), key=_by_number))
        overrides, total, state = self._plan
        if total is not None and len(jobs) > total:
            total = None  # not the sweep that the plan is of
        if state:
            state = "running" if driven else "done" if state == "done" else "interrupted"
        ends = [job.last_change for job in jobs if job.state in record.ENDED]
        rate = rate_of(ends, latest=_RECENT, least=2)
        now = time.time()
        return SweepState(
            self.folder, overrides, total, jobs, math.nan if rate is None else rate, now, state
        )

    def _look_at_plan(self) -> None:
        """Read the plan where it is new: what there is to be is written after it has begun."""
        try:
            changed = (self.folder / record.RECORD_NAME).stat().st_mtime_ns
        except OSError:
            changed = 0
        if self._plan is None or changed != self._planned:
            self._planned, self._plan = changed, _plan(self.folder)


def is_sweep(folder: Path) -> bool:
    """Whether a folder holds jobs of a sweep."""
    return any(record.status_of(Path(file)) for file, _ in _status_files(folder))


def sweep_of(log: Path) -> Path | None:
    """The folder of the sweep that a run is a job of; None if it is none."""
    return log.parent.parent if record.status_of(log.with_name(STATUS_NAME)) else None


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


def _job(file: Path, folder: Path, changed: int) -> Job | None:
    status = record.status_of(file)
    if not status:
        return None
    state = str(status.get("state"))
    if state == "running" and not _may_live(status.get("pid"), status.get("host")):
        state = "gone"
    overrides, objective = status.get("overrides"), record.objective_of(status)
    return Job(
        name=str(file.parent.relative_to(folder)),
        state=state,
        overrides=tuple(map(str, overrides)) if isinstance(overrides, list) else (),
        objective=math.nan if objective is None else objective,
        problem=record.problem_of(status),
        last_change=changed / 1e9,
    )


def _may_live(pid: Any, host: Any) -> bool:
    if not isinstance(pid, int) or isinstance(pid, bool) or not 0 < pid < 2**31:
        return True  # it does not say: believe it
    here = host if isinstance(host, str) and host else platform.node()
    return record.is_alive(record.Claim(0, here, pid, "")) is not False


def _plan(folder: Path) -> _Plan:
    """What was typed for a sweep, and how many jobs that makes, from the record of the sweep."""
    if not (folder / record.RECORD_NAME).exists():
        return _plan_of_hydra(folder)
    try:
        document = record.Record(folder).document()
    except RecordingError:
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
    valid_counts = [count for count in counts if count is not None]
    return _Plan(overrides, math.prod(valid_counts) if len(valid_counts) == len(counts) else None)


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
