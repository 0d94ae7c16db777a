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
    """Something that happened.

    Attributes
    ----------
    time : float
        s
    kind, source, message : str
        What, to what, in a sentence.
    value : float
        A number that belongs to it, in the unit the message names; NaN for none.
    """

    time: float
    kind: str
    source: str = ""
    message: str = ""
    value: float = float("nan")


@dataclass(frozen=True, kw_only=True)
class ReportedRun:
    """A run.

    Attributes
    ----------
    name : str
        What it is called among others.
    times : dict of str to (n,) array
        By topic (``/measurement``), s.
    columns : dict of str to dict of str to (n,) array
        By topic and field; arrays of arrays for ``/prediction``.
    units : dict of str to dict of str to str
        By topic and field.
    events : sequence of RunEvent
    score : dict
        ``trms.score/1``; empty for a run that cannot be scored.
    limits : dict of str to (float, float)
        By input and channel.
    outcome : str
        ``completed``, ``interrupted``, ``failed`` or ``died``.
    duration : float
        s
    problems : sequence of str
        What is missing or damaged, as sentences.
    choices : dict of str to str
        Option of each group: ``controller``, ``ref``, ….
    facts : dict of str to str
        What else is worth a line: seed, when, versions.
    command, repeat : str
        What was typed, and what to type to have the same again; "" if nobody knows.
    config : str
        The resolved configuration as YAML.
    """

    name: str
    times: Mapping[str, FloatArray]
    columns: Mapping[str, Mapping[str, Any]]
    units: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    events: Sequence[RunEvent] = ()
    score: Mapping[str, Any] = field(default_factory=dict)
    limits: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    outcome: str = "completed"
    duration: float = 0.0
    problems: Sequence[str] = ()
    choices: Mapping[str, str] = field(default_factory=dict)
    facts: Mapping[str, str] = field(default_factory=dict)
    command: str = ""
    repeat: str = ""
    config: str = ""

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
