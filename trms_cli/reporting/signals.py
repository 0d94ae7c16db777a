"""A run's signals as charts and pages see them: from a log, or from a run's memory.

Who reads logs fills it in; nothing here knows files.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from trms_cli.core.arrays import stretches
from trms_cli.scoring.metrics import Columns

FloatArray = npt.NDArray[np.float64]

#: Where the truth of a signal is looked for, best first, and what its curve is called.
_TRUTH = (("/plant/state", "rig"), ("/measurement", "measured"), ("/estimate", "estimate"))


@dataclass(frozen=True)
class TimeSeries:
    """A curve over time."""

    time: FloatArray  #: (n,) s
    values: FloatArray  #: (n,) in the unit
    unit: str = ""
    source: str = ""  #: What it is: ``rig`` (the true state), ``measured``, ``estimate``

    def scaled(self, factor: float, unit: str) -> TimeSeries:
        """The same in another unit."""
        return TimeSeries(self.time, factor * self.values, unit, self.source)

    @property
    def rate(self) -> TimeSeries:
        """Rate of change by central differences."""
        rate = np.full(len(self.time), np.nan)
        if len(self.time) > 1:
            with np.errstate(invalid="ignore", divide="ignore"):
                rate = np.gradient(self.values, self.time)
        return TimeSeries(self.time, rate, f"{self.unit}/s", self.source)


@dataclass(frozen=True)
class RunEvent:
    """Something that happened: what, to what, in a sentence."""

    time: float  #: s
    kind: str
    source: str = ""
    message: str = ""
    #: A number that belongs to it, in the unit the message names; NaN for none
    value: float = float("nan")

    @property
    def alarming(self) -> bool:
        """Whether it is neither the end of something nor a note."""
        return not self.kind.endswith("_end") and self.kind not in ("fault_removed", "note")


@dataclass(frozen=True, kw_only=True)
class RunSignals:
    """Signals of a run by topic, seen through a window of the time."""

    name: str = ""  #: What the run is called among others
    #: Signals by topic (``/measurement``); arrays of arrays for ``/prediction``
    tables: Mapping[str, Columns]
    limits: Mapping[str, tuple[float, float]] = field(default_factory=dict)  #: By input and channel
    window: tuple[float, float] = (-math.inf, math.inf)  #: s; what is outside is not drawn

    def names(self, topic: str) -> list[str]:
        """Fields of a topic; empty where the topic is absent or silent."""
        table = self.tables.get(topic)
        return list(table.columns) if table is not None and len(table.time) else []

    def time(self, topic: str) -> FloatArray:
        """Times of a topic within the window, s."""
        table = self.tables.get(topic)
        times = np.asarray(() if table is None else table.time, dtype=float)
        return times[self._inside(times)]

    def column(self, topic: str, name: str) -> Any:
        """What a field of a topic holds within the window, (n,); empty where it is absent."""
        if name not in self.names(topic):
            return np.zeros(0)
        table = self.tables[topic]
        return np.asarray(table.columns[name])[self._inside(np.asarray(table.time, dtype=float))]

    def numbers(self, topic: str, name: str) -> FloatArray:
        """A field as floats; NaN where it holds something else."""
        array = np.asarray(self.column(topic, name))
        if array.dtype == object:
            values = [v if isinstance(v, (int, float)) else np.nan for v in array]
            return np.array(values, dtype=float)
        return array.astype(float)

    def signal(self, topic: str, name: str, source: str = "") -> TimeSeries | None:
        """A column of numbers; None where it is absent, or has no value in the window."""
        values = self.numbers(topic, name)
        if not np.isfinite(values).any():
            return None
        return TimeSeries(self.time(topic), values, self.unit(topic, name), source)

    def unit(self, topic: str, name: str) -> str:
        """Unit of a field; "" for text and plain numbers."""
        table = self.tables.get(topic)
        unit = table.units.get(name, "") if table is not None else ""
        return "" if unit == "1" else unit.replace("N*m", "N m").replace("^2", "²")

    def truth(self, name: str) -> TimeSeries | None:
        """The best that is known of a signal: the true state, else measured, else estimated."""
        candidates = (self.signal(topic, name, source) for topic, source in _TRUTH)
        return next((signal for signal in candidates if signal is not None), None)

    def smooth(self, name: str) -> TimeSeries | None:
        """The same, fit to be differentiated: the difference of an encoder's steps is noise."""
        signal = self.truth(name)
        if signal is not None and signal.source == "measured":
            return self.signal("/estimate", name, "estimate") or signal
        return signal

    def estimated(self, name: str) -> tuple[TimeSeries, FloatArray] | None:
        """An estimate and its standard deviation; None for what no observer is unsure of."""
        guess, deviation = self.signal("/estimate", name), self.numbers("/estimate", f"sd_{name}")
        if guess is None or not np.any(deviation > 0):
            return None
        return guess, deviation

    def error(self, name: str) -> TimeSeries | None:
        """Reference minus what was, at the times of the latter; None without one of them."""
        response, reference = self.truth(name), self.signal("/reference", name)
        if response is None or reference is None:
            return None
        at = np.searchsorted(reference.time, response.time, side="right") - 1
        setpoints = reference.values[np.clip(at, 0, None)]
        return TimeSeries(
            response.time, np.where(at >= 0, setpoints - response.values, np.nan), response.unit
        )

    def channels(self) -> list[str]:
        """What is controlled; without references, the measured angles, or all that is measured."""
        measured = self.names("/measurement")
        angles = [name for name in measured if name.startswith("alpha")]
        return self.names("/reference") or angles or measured

    def inputs(self) -> list[str]:
        """Names of the commands."""
        return self.names("/command")

    def torques(self) -> dict[str, list[str]]:
        """Torques that are estimated at all, by where they act."""
        groups: dict[str, list[str]] = {}
        for place, ending in (("axes", "_moment"), ("rotors", "_motor"), ("pushes", "_push")):
            names = [name for name in self.names("/estimate") if name.endswith(ending)]
            names = [name for name in names if not name.startswith("sd_")]
            estimated_names = [name for name in names if self.estimated(name) is not None]
            groups |= {place: estimated_names} if estimated_names else {}
        return groups

    @cached_property
    def events(self) -> list[RunEvent]:
        """What happened, in order."""
        count = len(self.time("/event"))
        texts = [
            [str(text or "") for text in self.column("/event", key)] or [""] * count
            for key in ("kind", "source", "message")
        ]
        values = self.numbers("/event", "value")
        values = values if len(values) else np.full(count, np.nan)
        rows = zip(self.time("/event").tolist(), *texts, values.tolist(), strict=True)
        return [RunEvent(*row) for row in rows]

    def saturated(self, name: str) -> Iterator[tuple[float, float]]:
        """Times (s) in which an input was at its limit."""
        begin = None
        for event in self.events:
            if event.source == name and event.kind == "saturation_begin":
                begin = event.time
            elif event.source == name and event.kind == "saturation_end" and begin is not None:
                yield begin, event.time
                begin = None
        if begin is not None:
            yield begin, self.end

    def mode(self, mode: str) -> Iterator[tuple[float, float]]:
        """Times (s) of the control samples in a mode: ``degraded``, ``landing``."""
        time, modes = self.time("/controller"), self.column("/controller", "mode")
        for begin, end in stretches(np.asarray(modes, dtype=object) == mode):
            yield float(time[begin]), float(time[min(end, len(time) - 1)])

    def step_times(self) -> FloatArray | None:
        """Time of each control step, ms; None for a run without a controller's words.

        A microsecond at least: a law of one line takes less than the clock can tell.
        """
        milliseconds = 1e3 * self.numbers("/controller", "solve_time_s")
        if not np.isfinite(milliseconds).any():
            return None
        return np.maximum(milliseconds, 1e-3)  # NaN stays

    @property
    def deadline(self) -> float | None:
        """The time of a sample, in which a control step has to be done, ms."""
        time = self.time("/command")
        return float(f"{1e3 * np.median(np.diff(time)):.4g}") if len(time) > 1 else None

    def deadline_misses(self) -> npt.NDArray[np.bool_]:
        """Which control steps took longer than their deadline, (n,)."""
        return self._controller_column("deadline_missed") > 0

    def fell_back(self) -> npt.NDArray[np.bool_]:
        """On which control steps a fall-back acted, or the solver failed, (n,)."""
        failed = self.column("/controller", "status")
        failed = np.asarray(failed, dtype=object) == "failed" if len(failed) else False
        result: npt.NDArray[np.bool_] = (self._controller_column("fallback") > 0) | failed
        return result

    @property
    def is_empty(self) -> bool:
        """Whether no topic but that of events has a sample."""
        return not any(self._times())

    @property
    def begin(self) -> float:
        """The first sample's time, s."""
        return min((time[0] for time in self._times()), default=0.0)

    @property
    def end(self) -> float:
        """Until when the last sample holds, s."""
        ends = (
            time[-1] + (np.median(np.diff(time)) if len(time) > 1 else 0.0)
            for time in self._times()
        )
        return min(float(max(ends, default=0.0)), self.window[1])

    def _times(self) -> Iterator[list[float]]:
        for topic in self.tables:
            times = self.time(topic)
            if topic != "/event" and len(times):
                yield times.tolist()

    def _controller_column(self, name: str) -> FloatArray:
        values = self.numbers("/controller", name)
        return values if len(values) else np.zeros(len(self.time("/controller")))

    def _inside(self, times: FloatArray) -> npt.NDArray[np.bool_]:
        inside: npt.NDArray[np.bool_] = (times >= self.window[0]) & (times <= self.window[1])
        return inside


@dataclass(frozen=True, kw_only=True)
class RunReport(RunSignals):
    """A run with its score and the words about it."""

    #: ``trms.score/1``; empty for a run that cannot be scored
    score: Mapping[str, Any] = field(default_factory=dict)
    outcome: str = "completed"  #: ``completed``, ``interrupted``, ``failed`` or ``died``
    duration: float = 0.0  #: s
    problems: Sequence[str] = ()  #: What is missing or damaged, as sentences
    #: Option of each group: ``controller``, ``ref``, ….
    choices: Mapping[str, str] = field(default_factory=dict)
    #: What else is worth a line: seed, when, versions
    facts: Mapping[str, str] = field(default_factory=dict)
    command: str = ""  #: What was typed
    repeat: str = ""  #: What to type to have the same again; "" if nobody knows
    config: str = ""  #: The resolved configuration as YAML


def limits_in(log: Any) -> dict[str, tuple[float, float]]:
    """Limits of commands and angles that a run wrote; a stranger's log may hold anything."""
    from trms_cli.scoring.score import limits_of

    try:
        return limits_of(log)
    except (AttributeError, TypeError, ValueError):
        return {}
