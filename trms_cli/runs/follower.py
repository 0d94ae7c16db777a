"""A run that is looked at while it is written, or again later, and what it is at any moment.

All figures until a moment are those that the score of the run up to there has: the same error,
RMSE, share of saturation, percentile and misses (:mod:`trms_cli.scoring.score`).
"""

import contextlib
import math
import platform
import re
from bisect import bisect_right
from collections import deque
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np
import numpy.typing as npt

from trms_cli.core.data_file import json_or_none
from trms_cli.core.errors import RecordingError
from trms_cli.recordings.log_head import read_log_head
from trms_cli.recordings.log_reader import LogPiece, LogTail
from trms_cli.simulation.pace import IN_TIME

FloatArray = npt.NDArray[np.float64]
NAN = float("nan")


@dataclass(frozen=True)
class AxisMoment:
    """A controlled angle, or one that is watched in a run without a reference.

    Values are NaN where the run has none.
    """

    name: str
    unit: str
    reference: float  #: Now; `state` is the simulated rig's true one
    measured: float  #: Now; `state` is the simulated rig's true one
    state: float  #: Now; `state` is the simulated rig's true one
    estimate: float  #: Now; `state` is the simulated rig's true one
    error: float  #: Reference minus state (or measurement, where no state is known), now
    rmse: float  #: Of the error, from the run's beginning until now
    time: FloatArray  #: (n,) array; s, of the last samples
    #: ``references``, ``outputs``: (n,) array; the reference, and the state or measurement, on them
    references: FloatArray
    outputs: FloatArray


@dataclass(frozen=True)
class Input:
    """A command as applied."""

    name: str
    unit: str
    value: float  #: Now
    lower: float  #: Its limits
    upper: float  #: infinite where the log has none
    saturated: bool  #: Whether it is at one of them now
    share: float  #: Share of the samples until now at a limit, 0 to 1


@dataclass(frozen=True)
class Solver:
    """The controller's own words."""

    #: ``now_ms``, ``p99_ms``: Wall time of the latest control step, and the 99th percentile of
    #: those until now
    now_ms: float
    p99_ms: float
    deadline_ms: float  #: The time of a sample
    #: ``steps``, ``misses``, ``fallbacks``: Control steps until now, those that took longer, those
    #: on which a fall-back acted or the solve failed
    steps: int
    misses: int
    fallbacks: int
    iterations: float  #: Of the latest step
    status: str  #: Of the latest step
    message: str  #: Of the latest step
    #: ``mode``, ``reasons``: Of the supervisor: normal, degraded or landing, and why
    mode: str
    reasons: str


@dataclass(frozen=True)
class Punctuality:
    """How well a real rig's samples keep their time, until now."""

    now_ms: float  #: Lateness of the latest sample
    worst_ms: float  #: Largest lateness
    late_share: float  #: Share of the samples over 1 ms late
    command_ms: float  #: From the latest reading to its command


@dataclass(frozen=True)
class Event:
    """Something that happened."""

    time: float  #: s
    kind: str
    source: str
    message: str


@dataclass(frozen=True)
class Moment:
    """A run at one moment."""

    time: float  #: s
    #: How many times as fast as real time the run went, around this moment; NaN if unknown
    speed: float
    axes: tuple[AxisMoment, ...]
    inputs: tuple[Input, ...]
    solver: Solver | None  #: None before the first control step, and in recordings
    events: tuple[Event, ...]  #: The latest ones until now, the last one last
    event_count: int  #: All of them until now
    timing: Punctuality | None = None  #: None for a run that waits for no clock


class GrowingArray:
    """A float array that is appended to; doubling makes an append cheap however long it is."""

    def __init__(self) -> None:
        self._room = np.empty(256)
        self._size = 0

    def __len__(self) -> int:
        return self._size

    def append(self, values: FloatArray) -> None:
        """Add values at the end."""
        size = self._size + len(values)
        if size > len(self._room):
            room = np.empty(max(size, 2 * len(self._room)))
            room[: self._size] = self._room[: self._size]
            self._room = room
        self._room[self._size : size] = values
        self._size = size

    @property
    def values(self) -> FloatArray:
        """All of them, (n,); a view that the next append may leave behind."""
        return self._room[: self._size]


class RunningSum:
    """Sums from the beginning to each sample, NaN left out, with the number of what was summed."""

    def __init__(self) -> None:
        self._sums, self._counts = GrowingArray(), GrowingArray()

    def append(self, values: FloatArray) -> None:
        """Add samples at the end."""
        present = ~np.isnan(values)
        before, count = self.until(len(self._sums))
        self._sums.append(before + np.cumsum(np.where(present, values, 0.0)))
        self._counts.append(count + np.cumsum(present))

    def until(self, index: int) -> tuple[float, float]:
        """The sum of the samples before `index`, and their number."""
        if index <= 0 or not len(self._sums):
            return 0.0, 0.0
        return float(self._sums.values[index - 1]), float(self._counts.values[index - 1])

    def mean_until(self, index: int) -> float:
        """The mean of the samples before `index`; NaN without any."""
        total, count = self.until(index)
        return total / count if count else float("nan")


class TopicSamples:
    """The samples of a topic: a time and columns of equal length.

    Columns that have no unit are texts or truth values.
    """

    def __init__(self, units: dict[str, str]) -> None:
        self.units = units
        self.time = GrowingArray()
        self.numbers: dict[str, GrowingArray] = {}
        self.texts: dict[str, list[str]] = {}

    def append(self, time: FloatArray, columns: dict[str, np.ndarray]) -> None:
        """Add the rows of a table."""
        self.time.append(time)
        for name, column in columns.items():
            if column.dtype == object:
                self.texts.setdefault(name, []).extend(
                    v if isinstance(v, str) else "" for v in column
                )
            else:
                self.numbers.setdefault(name, GrowingArray()).append(column)

    def count_until(self, time: float) -> int:
        """The number of samples until a time (s), it included."""
        return int(np.searchsorted(self.time.values, time + 1e-9, side="right"))

    def number(self, name: str, count: int) -> float:
        """A column's last value of the first `count` samples; NaN if there is none."""
        column = self.numbers.get(name)
        return float(column.values[count - 1]) if column is not None and count else float("nan")

    def text(self, name: str, count: int) -> str:
        """The same of a text; empty if there is none."""
        column = self.texts.get(name)
        return column[count - 1] if column and count else ""

    def last_values(self, name: str, time: FloatArray) -> FloatArray:
        """A column at other times: its last sample until then, NaN before the first one."""
        column = self.numbers.get(name)
        if column is None or not len(column):
            return np.full(len(time), np.nan)
        index = np.searchsorted(self.time.values, time + 1e-9, side="right") - 1
        return np.where(index >= 0, column.values[np.maximum(index, 0)], np.nan)


_MOST_EVENTS = 20_000  # kept, of a run that does not end to complain
_SPEED_OVER = 2e9  # ns of wall time that the run's speed is told over
_WALL = 10**17  # ns; a publish time below it is no wall clock but a recording's own time
_EVENT = ("kind", "source", "message")
_FAR = 2**63


class RunSamples:
    """What a run has logged so far; each piece of it is taken once."""

    def __init__(self) -> None:
        self._run: dict[str, str] = {}
        self._topics: dict[str, TopicSamples] = {}
        self._events: deque[Event] = deque(maxlen=_MOST_EVENTS)
        self._forgotten = 0
        self._squares: dict[str, RunningSum] = {}
        self._limited: dict[str, RunningSum] = {}
        self._misses, self._fell_back = RunningSum(), RunningSum()
        self._limits: dict[str, tuple[float, float]] | None = None
        self._progress: list[tuple[int, int]] = []  # (log time, wall time) of chunks, ns

    @property
    def latest(self) -> float:
        """Time of the last sample so far (s); 0 before the first one."""
        aside = ("/event", "/landing")
        times = [
            t.time.values[-1] for n, t in self._topics.items() if n not in aside and len(t.time)
        ]
        return float(max(times, default=0.0))

    def at(self, time: float, span: float, events: int = 8) -> Moment:
        """The run at `time` (s): curves over the `span` (s) before it, and its latest `events`."""
        happened = bisect_right(self._events, time + 1e-9, key=lambda event: event.time)
        last = [self._events[i] for i in range(max(0, happened - events), happened)]
        return Moment(
            time=time,
            speed=self._speed(time),
            axes=tuple(self._axis(name, time, span) for name in self._axis_names()),
            inputs=tuple(self._inputs(time)),
            solver=self._solver(time),
            timing=self._timing(time),
            events=tuple(last),
            event_count=self._forgotten + happened,
        )

    def recent(
        self, topic: str, time: float, span: float
    ) -> tuple[FloatArray, dict[str, FloatArray]]:
        """Times (s) and numbers by column of a topic, over the `span` (s) before `time`."""
        samples = self._topics.get(topic)
        if samples is None:
            return np.empty(0), {}
        begin, end = samples.count_until(time - span - 2e-9), samples.count_until(time)
        columns = {name: own.values[begin:end].copy() for name, own in samples.numbers.items()}
        return samples.time.values[begin:end].copy(), columns

    def add(self, piece: LogPiece, run: dict[str, str]) -> None:
        """Take what is new, and what the run says of itself."""
        self._run = run
        for topic, table in piece.tables.items():
            if topic not in self._topics:
                self._topics[topic] = TopicSamples(table.units)
            self._topics[topic].append(table.time, table.columns)
        self._progress += [pair for pair in piece.progress if pair[1] > _WALL]
        if "/reference" in piece.tables:
            self._add_errors(piece.tables["/reference"].time, piece.tables["/reference"].columns)
        if "/command" in piece.tables:
            for name, values in piece.tables["/command"].columns.items():
                at_limit = _at_limit(values, *self._limits_of(name))
                self._limited.setdefault(name, RunningSum()).append(at_limit)
        if "/controller" in piece.tables:
            self._add_words(piece.tables["/controller"].columns)
        if "/event" in piece.tables:
            events = piece.tables["/event"]
            words = (events.columns.get(name, [""] * len(events)) for name in _EVENT)
            rows = [
                Event(float(t), *map(str, row)) for t, *row in zip(events.time, *words, strict=True)
            ]
            self._forgotten += max(0, len(self._events) + len(rows) - _MOST_EVENTS)
            self._events.extend(rows)

    def _add_errors(self, time: FloatArray, references: dict[str, np.ndarray]) -> None:
        for name, reference in references.items():
            source = self._source(name)
            if source is not None:
                error = reference - source.last_values(name, time)
                self._squares.setdefault(name, RunningSum()).append(error**2)

    def _add_words(self, words: dict[str, np.ndarray]) -> None:
        count = len(next(iter(words.values())))
        nothing = np.zeros(count)
        fell_back = np.nan_to_num(words.get("fallback", nothing)) > 0
        if "status" in words:
            fell_back |= words["status"] == "failed"
        self._fell_back.append(fell_back.astype(float))
        self._misses.append(np.nan_to_num(words.get("deadline_missed", nothing)))

    def _limits_of(self, name: str) -> tuple[float, float]:
        """Lower and upper limit of a command; infinite where the log has none."""
        if self._limits is None:
            limits = json_or_none(self._run.get("limits"))
            self._limits = {
                str(key): (
                    -math.inf if pair[0] is None else float(pair[0]),
                    math.inf if pair[1] is None else float(pair[1]),
                )
                for key, pair in (limits.items() if isinstance(limits, dict) else ())
                if isinstance(pair, list) and len(pair) == 2
            }
        return self._limits.get(name, (-math.inf, math.inf))

    def _source(self, name: str) -> TopicSamples | None:
        """The topic that tells a channel best: the true state, else the measurement."""
        for topic in ("/plant/state", "/measurement"):
            samples = self._topics.get(topic)
            if samples is not None and name in samples.numbers:
                return samples
        return None

    def _axis_names(self) -> list[str]:
        """What has a reference; without any, the measured angles, or what is measured first."""
        if "/reference" in self._topics:
            return list(self._topics["/reference"].numbers)
        measured = self._topics.get("/measurement") or self._topics.get("/plant/state")
        if measured is None:
            return []
        angles = [name for name in measured.numbers if measured.units.get(name) == "rad"]
        return (angles or list(measured.numbers))[:2]

    def _axis(self, name: str, time: float, span: float) -> AxisMoment:
        def now(topic: str) -> float:
            samples = self._topics.get(topic)
            return NAN if samples is None else samples.number(name, samples.count_until(time))

        source, reference = self._source(name), self._topics.get("/reference")
        base = source if reference is None else reference
        if base is None:
            none = np.empty(0)
            return AxisMoment(name, "", NAN, NAN, NAN, NAN, NAN, NAN, none, none, none)
        last = base.count_until(time)
        first = int(np.searchsorted(base.time.values, time - span - 1e-9))
        times = base.time.values[first:last].copy()
        none = np.full(len(times), np.nan)
        outputs = none if source is None else source.last_values(name, times)
        references = none if reference is None else reference.last_values(name, times)
        rmse = math.sqrt(self._squares[name].mean_until(last)) if name in self._squares else NAN
        return AxisMoment(
            name=name,
            unit=base.units.get(name, ""),
            reference=now("/reference"),
            measured=now("/measurement"),
            state=now("/plant/state"),
            estimate=now("/estimate"),
            error=float(references[-1] - outputs[-1]) if len(times) else NAN,
            rmse=rmse,
            time=times,
            references=references,
            outputs=outputs,
        )

    def _inputs(self, time: float) -> list[Input]:
        samples = self._topics.get("/command")
        if samples is None:
            return []
        count = samples.count_until(time)
        inputs = []
        for name in samples.numbers:
            value, (lower, upper) = samples.number(name, count), self._limits_of(name)
            share = self._limited[name].mean_until(count)
            saturated = bool(_at_limit(np.array([value]), lower, upper)[0] > 0)
            unit = samples.units.get(name, "")
            inputs.append(Input(name, unit, value, lower, upper, saturated, share))
        return inputs

    def _solver(self, time: float) -> Solver | None:
        words = self._topics.get("/controller")
        count = 0 if words is None else words.count_until(time)
        if words is None or not count:
            return None
        spent = words.numbers.get("solve_time_s")
        present = np.empty(0) if spent is None else spent.values[:count]
        present = present[~np.isnan(present)]
        commands = self._topics.get("/command", words).time.values[:50]
        return Solver(
            now_ms=1e3 * words.number("solve_time_s", count),
            p99_ms=1e3 * float(np.percentile(present, 99)) if present.size else NAN,
            deadline_ms=1e3 * float(np.median(np.diff(commands))) if len(commands) > 1 else NAN,
            steps=count,
            misses=int(self._misses.until(count)[0]),
            fallbacks=int(self._fell_back.until(count)[0]),
            iterations=words.number("iterations", count),
            status=words.text("status", count),
            message=words.text("message", count),
            mode=words.text("mode", count),
            reasons=words.text("reasons", count),
        )

    def _timing(self, time: float) -> Punctuality | None:
        samples = self._topics.get("/timing")
        count = 0 if samples is None else samples.count_until(time)
        if samples is None or not count or "lateness_s" not in samples.numbers:
            return None
        lateness = 1e3 * samples.numbers["lateness_s"].values[:count]
        return Punctuality(
            now_ms=float(lateness[-1]),
            worst_ms=float(np.max(lateness)),
            late_share=float(np.mean(lateness > 1e3 * IN_TIME)),
            command_ms=1e3 * samples.number("command_s", count),
        )

    def _speed(self, time: float) -> float:
        """Over the last seconds of wall time until the chunk that holds a moment."""
        progress = self._progress
        here = min(bisect_right(progress, (round(time * 1e9) - 1, _FAR)), len(progress) - 1)
        if here < 0:
            return NAN
        reached, wall = progress[here]
        before = here
        while before > 0 and wall - progress[before][1] < _SPEED_OVER:
            before -= 1
        begin, begin_wall = progress[before]
        if before == 0 and wall - begin_wall < _SPEED_OVER:  # the run's first seconds
            begin, begin_wall = 0, _start_ns(self._run) or begin_wall
        return (reached - begin) / (wall - begin_wall) if wall > begin_wall else NAN


def _at_limit(values: FloatArray, lower: float, upper: float) -> FloatArray:
    """1 where a command is within 1e-6 of the range of a limit, or beyond; NaN where it is not."""
    close = 1e-6 * (upper - lower) if math.isfinite(upper - lower) else 0.0
    at = ((values <= lower + close) | (values >= upper - close)).astype(float)
    return np.where(np.isnan(values), np.nan, at)


def _start_ns(run: dict[str, str]) -> int | None:
    try:
        return int(datetime.fromisoformat(run.get("start", "")).timestamp() * 1e9)
    except (ValueError, OverflowError):
        return None


_WHOLE = ("/reference", "/command", "/measurement", "/plant/state", "/event", "/timing")
_TIMES = ("solve_time_s", "iterations", "fallback", "deadline_missed")
_CONTROLLER = (*_TIMES, "status", "message", "mode", "reasons")
_DERIVED = ("sd_", "predicted_", "innovation_")
_WRITER_EVERY = 0.2  # s between two questions whether the run is still there


class RunFollower(RunSamples):
    """A run's log, followed as it grows.

    Raises RecordingError when the log cannot be read, also from :meth:`look`.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path = path
        self.has_ended = False  #: Nothing more will come, and all that there is has been read
        self.last_growth = monotonic()  #: Wall time when the log last grew
        #: What the run says of itself, its configuration, and what of the log is damaged
        self.tail = LogTail(path, _is_wanted)
        self._last_check = -math.inf
        self._last, outcome = _last_words(path)
        #: ``running``; ``completed``, ``interrupted`` or ``failed``, as the run said at its end;
        #: ``died``: no end, and nobody writes; ``unfinished``: no end, and the system does not
        #: tell whether anybody writes
        self.state = outcome or self._of_writer()

    @property
    def choices(self) -> dict[str, Any]:
        """The option of each group; empty for what is no run of the loop."""
        options = json_or_none(self.tail.run.get("choices"))
        return options if isinstance(options, dict) else {}

    @property
    def process(self) -> int | None:
        """The process of a run that drives a real rig on this machine now; None for any other."""
        run = self.tail.run
        if self.has_ended or run.get("machine") != platform.node() or not self.tail.has_writer():
            return None
        number = run.get("process", "")
        return int(number) if number.isdecimal() else None

    @property
    def total(self) -> float | None:
        """How long the run is meant to last (s); for a recording, how long it does."""
        if "recording.file" in self.tail.run:  # `sim.duration` does not lengthen it
            return self._last
        duration = re.search(
            r"^sim:\n(?: .*\n)*? +duration: +([\d.eE+-]+)\s", self.tail.config, re.M
        )
        with contextlib.suppress(ValueError):
            if duration is not None:
                return float(duration[1])
        return self._last

    @property
    def going_on(self) -> bool:
        """Whether the log is being written, or may be."""
        return self.state in ("running", "unfinished")

    def look(self) -> bool:
        """Take what is new; whether there was anything. The state is right once there is not."""
        if self.has_ended:
            return False
        piece = self.tail.read()
        if piece is None and not self.tail.finished:
            now = monotonic()
            if now - self._last_check < _WRITER_EVERY:
                return False
            self._last_check = now
            state = self._of_writer()
            if state != "died":
                self.state = state
                return False
            piece = self.tail.read()  # what came between the two
            if piece is None and not self.tail.finished:
                self.state, self.has_ended = state, True
                return False
        if piece is not None:
            self._check_origin()
            try:
                self.add(piece, self.tail.run)
            except (TypeError, ValueError, KeyError) as error:  # a stranger's log may hold anything
                raise RecordingError(
                    f"its messages are not as trms writes them ({error})", where=str(self.path)
                ) from error
            self.last_growth = monotonic()
        if self.tail.finished:
            self.has_ended, self.state = True, str(self.tail.run.get("outcome") or "completed")
        return piece is not None

    def look_until(self, time: float, budget: float = math.inf) -> bool:
        """Look until samples at `time` (s) are there, or nothing is new, or `budget` s are over.

        Returns whether more may be there to be read at once.
        """
        begin = monotonic()
        while self.latest < time:
            if not self.look():
                return False
            if monotonic() - begin > budget:
                return True
        return True

    def close(self) -> None:
        """Close the log."""
        self.tail.close()

    def _check_origin(self) -> None:
        if not self.tail.of_trms:
            raise RecordingError(
                f"this MCAP file is of another program ({self.tail.library or 'unnamed'})",
                where=str(self.path),
                remedy="name a log that trms has written",
            )

    def _of_writer(self) -> str:
        """The state of a log without an end."""
        return {True: "running", False: "died", None: "unfinished"}[self.tail.has_writer()]


def _is_wanted(topic: str, column: str) -> bool:
    if topic in _WHOLE:
        return True
    if topic == "/controller":
        return column in _CONTROLLER
    return topic == "/estimate" and not column.startswith(_DERIVED)


def _last_words(path: Path) -> tuple[float | None, str]:
    """Time of a finished log's last sample (s), and its outcome; empty for one without an end."""
    with contextlib.suppress(RecordingError):
        head = read_log_head(path)
        if head.finished:
            outcome = head.run.get("outcome") or "completed"
            with contextlib.suppress(KeyError, ValueError):
                return float(head.run["last_time_s"]), outcome
            return None, outcome
    return None, ""
