"""Logs as figures of them see them: signals cut to a window, and names that tell logs apart."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

#: Where the truth of a signal is looked for, best first, and what its curve is called.
_TRUTH = (("/plant/state", "rig"), ("/measurement", "measured"), ("/estimate", "estimate"))
#: Keys of a configuration that say where files go and how much is kept, not what was run.
_ASIDE = ("out", "picture", "sim.prediction_every", "sim.scene_every")
#: Options that follow from others, as a log's choices have them.
_IMPLIED = ("@", "experiment")


class LogTable(Protocol):
    """The messages of a topic: :class:`trms_cli.recordings.log_reader.TopicTable` is one."""

    @property
    def time(self) -> Any:
        """(n,), s."""
        ...

    @property
    def columns(self) -> Mapping[str, Any]:
        """By name, each (n,); text and arrays as objects."""
        ...

    @property
    def units(self) -> Mapping[str, str]:
        """By name."""
        ...


class PlottedLog(Protocol):
    """What is drawn: :class:`trms_cli.recordings.log_reader.LoggedRun` is one."""

    @property
    def path(self) -> Path:
        """Its file."""
        ...

    @property
    def tables(self) -> Mapping[str, Any]:
        """:class:`LogTable` by topic."""
        ...

    @property
    def run(self) -> Mapping[str, str]:
        """What the run says of itself."""
        ...

    @property
    def score(self) -> Mapping[str, Any]:
        """``trms.score/1``, or empty."""
        ...


@dataclass(frozen=True)
class LogSignal:
    """A curve over time."""

    time: FloatArray  #: (n,) array; s, and in the unit
    values: FloatArray  #: (n,) array; s, and in the unit
    unit: str
    source: str = ""  #: What it is: ``rig`` (the true state), ``measured``, ``estimate``


@dataclass(frozen=True)
class Plotted:
    """A log under its name, seen through a window."""

    log: PlottedLog
    name: str
    start: float = -np.inf  #: s; what is outside is not drawn
    end: float = np.inf  #: s; what is outside is not drawn

    def names(self, topic: str) -> list[str]:
        """Fields of a topic; empty where the topic is absent or silent."""
        table = self.log.tables.get(topic)
        return list(table.columns) if table is not None and len(table.time) else []

    def within(self, topic: str) -> npt.NDArray[np.bool_]:
        """Which messages of a topic lie in the window, (n,)."""
        time = self.log.tables[topic].time
        inside: npt.NDArray[np.bool_] = (time >= self.start) & (time <= self.end)
        return inside

    def signal(self, topic: str, name: str, source: str = "") -> LogSignal | None:
        """A column of numbers; None where it is absent, or has no value in the window."""
        if name not in self.names(topic):
            return None
        table, inside = self.log.tables[topic], self.within(topic)
        values = np.asarray(table.columns[name][inside], dtype=float)
        if not np.isfinite(values).any():
            return None
        return LogSignal(np.asarray(table.time)[inside], values, table.units.get(name, ""), source)

    def truth(self, name: str) -> LogSignal | None:
        """The best that the log knows of a signal: the true state, else what was measured."""
        found = (self.signal(topic, name, source) for topic, source in _TRUTH)
        return next((signal for signal in found if signal is not None), None)

    def angles(self) -> list[str]:
        """Pitch and yaw, as far as there are such: in the order in which people name them."""
        return [name for name in ("alpha_v", "alpha_h") if self.truth(name) is not None]

    def limits(self) -> dict[str, tuple[float, float]]:
        """Of the commands and angles, by name."""
        try:
            found = json.loads(self.log.run.get("limits", "{}"))
            return {name: (float(low), float(high)) for name, (low, high) in found.items()}
        except (AttributeError, TypeError, ValueError):  # a stranger's log may hold anything
            return {}


def rate_of(signal: LogSignal) -> FloatArray:
    """Rate of change by central differences, 1/s."""
    if len(signal.time) < 2:
        return np.full(len(signal.time), np.nan)
    with np.errstate(invalid="ignore", divide="ignore"):
        rate: FloatArray = np.gradient(signal.values, signal.time)
    return rate


def names_of(logs: Sequence[PlottedLog]) -> list[str]:
    """What tells logs apart: the options and values in which they differ, else their folders."""
    if len(logs) == 1:
        return [_place(logs[0])]
    told = [_told(log) for log in logs]
    keys = dict.fromkeys(key for one in told for key in one)
    differing = [key for key in keys if len({one.get(key) for one in told}) > 1]
    names = []
    for one in told:
        parts = [
            str(one.get(key)) if _names_itself(key) else f"{key} {one.get(key)}"
            for key in differing
            if one.get(key) not in (None, "none")
        ]
        names.append(", ".join(parts))
    if len(set(names)) == len(names) and all(names):
        return names
    places = [_place(log) for log in logs]
    if len(set(places)) < len(places):
        places = [str(log.path) for log in logs]
    return places


def _told(log: PlottedLog) -> dict[str, str]:
    """Options and typed values of a run; empty for a log without such words."""
    try:
        choices = json.loads(log.run.get("choices", "{}"))
        typed = json.loads(log.run.get("overrides", "[]"))
        told = {
            key: ", ".join(map(str, value)) if isinstance(value, list) else str(value)
            for key, value in choices.items()
            if value not in (None, []) and not any(sign in key for sign in _IMPLIED)
        }
        for word in typed:
            key, equals, value = str(word).lstrip("+").partition("=")
            if equals and "." in key and key not in _ASIDE and "@" not in key:
                told[key.rpartition(".")[2]] = value
    except (AttributeError, TypeError, ValueError):
        return {}
    if log.run.get("seed"):
        told["seed"] = str(log.run["seed"])
    if log.run.get("recording.file"):
        told["recording"] = Path(log.run["recording.file"]).name
    return told


def _names_itself(key: str) -> bool:
    """Whether an option is told by its name alone: `lqr` is a controller, `3` may be anything."""
    return key in ("controller", "observer", "model", "effect", "fault", "recording")


def _place(log: PlottedLog) -> str:
    """Where a log lies: its folder's name for ``run.mcap``, its own otherwise."""
    path = Path(log.path)
    return path.resolve().parent.name if path.name == "run.mcap" else path.stem
