"""A run as a report sees it: its signals, its events, its score, and the words about it.

Who reads logs fills it in (``trms report`` does); nothing here knows files.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

#: Where the truth of a channel is looked for: topic, and what its curve is called.
_TRUTH = (("/plant/state", "rig"), ("/measurement", "measured"), ("/estimate", "estimate"))


@dataclass(frozen=True)
class RunEvent:
    """Something that happened."""

    time: float  #: s
    kind: str  #: What, to what, in a sentence
    source: str = ""  #: What, to what, in a sentence
    message: str = ""  #: What, to what, in a sentence
    #: A number that belongs to it, in the unit the message names; NaN for none
    value: float = float("nan")


@dataclass(frozen=True, kw_only=True)
class ReportedRun:
    """A run."""

    name: str  #: What it is called among others
    times: Mapping[str, FloatArray]  #: dict of str to (n,) array; by topic (``/measurement``), s
    #: dict of str to dict of str to (n,) array; by topic and field; arrays of arrays for
    #: ``/prediction``
    columns: Mapping[str, Mapping[str, Any]]
    units: Mapping[str, Mapping[str, str]] = field(default_factory=dict)  #: By topic and field
    events: Sequence[RunEvent] = ()
    #: ``trms.score/1``; empty for a run that cannot be scored
    score: Mapping[str, Any] = field(default_factory=dict)
    limits: Mapping[str, tuple[float, float]] = field(default_factory=dict)  #: By input and channel
    outcome: str = "completed"  #: ``completed``, ``interrupted``, ``failed`` or ``died``
    duration: float = 0.0  #: s
    problems: Sequence[str] = ()  #: What is missing or damaged, as sentences
    #: Option of each group: ``controller``, ``ref``, ….
    choices: Mapping[str, str] = field(default_factory=dict)
    #: What else is worth a line: seed, when, versions
    facts: Mapping[str, str] = field(default_factory=dict)
    command: str = ""  #: What was typed, and what to type to have the same again
    repeat: str = ""  #: "" if nobody knows
    config: str = ""  #: The resolved configuration as YAML

    def topic(self, name: str) -> Mapping[str, Any]:
        """Columns of a topic; empty where the run has none, or no sample of it."""
        return self.columns.get(name, {}) if len(self.time(name)) else {}

    def time(self, topic: str) -> FloatArray:
        """Times of a topic, s."""
        return np.asarray(self.times.get(topic, ()), dtype=float)

    def unit(self, topic: str, name: str) -> str:
        """Unit of a field; "" for text and plain numbers."""
        unit = self.units.get(topic, {}).get(name, "")
        return "" if unit == "1" else unit.replace("N*m", "N m").replace("^2", "²")

    def channels(self) -> list[str]:
        """What is controlled; without references, the measured angles, or all that is measured."""
        wanted = list(self.topic("/reference"))
        measured = list(self.topic("/measurement"))
        return wanted or [n for n in measured if n.startswith("alpha")] or measured

    def actual(self, channel: str) -> tuple[FloatArray, FloatArray, str] | None:
        """Where a channel really was: time, values, and whether that is true or measured."""
        for topic, word in _TRUTH:
            columns = self.topic(topic)
            if channel in columns:
                return self.time(topic), numbers(columns[channel]), word
        return None

    def error(self, channel: str) -> tuple[FloatArray, FloatArray] | None:
        """Reference minus what was, at the times of the latter; None without one of them."""
        found = self.actual(channel)
        wanted = self.topic("/reference").get(channel)
        if found is None or wanted is None:
            return None
        time, values, _ = found
        at = np.searchsorted(self.time("/reference"), time, side="right") - 1
        held = numbers(wanted)[np.clip(at, 0, None)]
        return time, np.where(at >= 0, held - values, np.nan)

    def inputs(self) -> list[str]:
        """Names of the commands."""
        return list(self.topic("/command"))

    @property
    def begin(self) -> float:
        """The first sample's time, s."""
        starts = [float(self.time(t)[0]) for t in self.times if t != "/event" and len(self.time(t))]
        return min(starts, default=0.0)

    @property
    def end(self) -> float:
        """The last sample's time, s."""
        ends = [float(self.time(t)[-1]) for t in self.times if t != "/event" and len(self.time(t))]
        return max(ends, default=0.0)


def numbers(values: Any) -> FloatArray:
    """A column as floats; NaN where it holds something else."""
    array = np.asarray(values)
    if array.dtype == object:
        return np.array([v if isinstance(v, (int, float)) else np.nan for v in array], dtype=float)
    return array.astype(float)
