"""A run as a comparison sees it: where it stands, how it ended, and its figures."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

from trms_cli.scoring.figures import entries


class State(Enum):
    """How a run ended, with the words that tell it."""

    DONE = "done"
    FAILED = "failed"
    INCOMPLETE = "incomplete"

    @property
    def ranked(self) -> bool:
        """Whether it counts: one that somebody ended says nothing about who ran in it."""
        return self is not State.INCOMPLETE


@dataclass(frozen=True, kw_only=True)
class ComparedRun:
    """One run."""

    path: str  #: Its folder or file
    #: What it was a run of: ``controller``, ``observer``, ``ref``, …, ``seed``, and dotted keys of
    #: the configuration in which it differs from others
    coordinates: Mapping[str, str]
    state: State = State.DONE
    score: Mapping[str, Any] | None = None  #: ``trms.score/1``; None if there is none
    message: str = ""  #: Why it failed or is incomplete
    #: Times at which a command was not finite and the one before was held; None: not counted
    non_finite: int | None = None
    #: Why whoever ran here is not ranked ("knows the reference ahead"); "" if it is
    outside: str = ""
    config: Mapping[str, Any] = field(default_factory=dict, repr=False)
    """The resolved configuration, where the log has it."""
    typed: Mapping[str, str] = field(default_factory=dict, repr=False)
    """Of a job that left no log: dotted keys as typed, all that is known of its configuration."""

    def error(self, metric: str = "rmse") -> float:
        """Tracking error: a metric summed over the channels; NaN where there is none."""
        channels = (self.score or {}).get("channels", {}).values()
        values = [channel.get(metric) for channel in channels]
        if not values or any(value is None for value in values):
            return math.nan
        return float(sum(values))

    def channel(self, name: str, metric: str = "rmse") -> float:
        """One channel's metric; NaN where there is none."""
        return _number((self.score or {}).get("channels", {}).get(name, {}).get(metric))

    def input_sum(self, figure: str) -> float:
        """A figure of the inputs (``effort``, ``total_variation``), summed; NaN without one."""
        values = [_number(each.get(figure)) for each in self._inputs()]
        return sum(values) if values else math.nan

    def solver(self, figure: str) -> float:
        """A figure of the solver: ``failures``, ``deadline_misses``, …; NaN where there is none."""
        return _number((self.score or {}).get("solver", {}).get(figure))

    def step_time(self, figure: str) -> float:
        """``median``, ``p99`` or ``max`` of the time of a control step, ms."""
        return _number((self.score or {}).get("solver", {}).get("time_ms", {}).get(figure))

    def of_run(self, key: str) -> float:
        """A figure of the run as a whole: ``degraded`` (s), ``violations``; NaN without one."""
        found = next((e for e in entries(self.score or {}, "run") if e.key == key), None)
        return _number(None if found is None else found.value)

    def _inputs(self) -> list[Mapping[str, Any]]:
        return list((self.score or {}).get("inputs", {}).values())


def _number(value: Any) -> float:
    return float(value) if isinstance(value, (int, float)) else math.nan
