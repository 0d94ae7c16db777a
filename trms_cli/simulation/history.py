"""What happened in a run, in memory and in the log: the same rows go to both."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np

#: Takes a time (ns) and a topic's values at that time.
Writer = Callable[[int, Sequence[Any]], None]


class Sink(Protocol):
    """Where a run's rows go; a :class:`trms_cli.recordings.run_log.RunLog` is one."""

    def writer(self, topic: str) -> Writer: ...

    def event(
        self, time_ns: int, kind: str, source: str, message: str, value: float = ...
    ) -> None: ...

    def flush(self) -> None: ...


class History:
    """Keeps the rows of a run by topic, and passes them on.

    Parameters
    ----------
    units : dict of str to dict of str to str
        Unit of each field of each topic, the fields in the order of the rows.
    sink : Sink or None
        The log; None keeps the rows in memory only.
    """

    def __init__(self, units: dict[str, dict[str, str]], sink: Sink | None) -> None:
        self.units = units
        self.fields = {topic: tuple(fields) for topic, fields in units.items()}
        self._sink = sink
        self._rows: dict[str, list[tuple[int, Sequence[Any]]]] = {name: [] for name in units}
        self.events: list[tuple[int, str, str, str, float]] = []

    def writer(self, topic: str) -> Writer:
        """What takes the rows of one topic; it does nothing with a topic that is not kept."""
        if topic not in self.fields:
            return lambda time_ns, values: None
        rows = self._rows[topic]
        if self._sink is None:
            return lambda time_ns, values: rows.append((time_ns, values))
        write = self._sink.writer(topic)

        def both(time_ns: int, values: Sequence[Any]) -> None:
            rows.append((time_ns, values))
            write(time_ns, values)

        return both

    def event(
        self, time_ns: int, kind: str, source: str, message: str, value: float = float("nan")
    ) -> None:
        """Something happened; ``value`` in the unit that the message names."""
        self.events.append((time_ns, kind, source, message, value))
        if self._sink is not None:
            self._sink.event(time_ns, kind, source, message, value)

    def flush(self) -> None:
        """Make everything so far safe."""
        if self._sink is not None:
            self._sink.flush()

    def times(self, topic: str) -> np.ndarray:
        """Times of a topic's rows, shape (n,), s."""
        return np.array([row[0] for row in self._rows.get(topic, ())], dtype=float) * 1e-9

    def columns(self, topic: str) -> dict[str, np.ndarray]:
        """Columns of a topic by field name, each (n,); text and arrays as objects."""
        rows = [row[1] for row in self._rows.get(topic, ())]
        names = self.fields.get(topic, ())
        if not rows:
            return {name: np.zeros(0) for name in names}
        return {
            name: _column(values)
            for name, values in zip(names, zip(*rows, strict=True), strict=True)
        }


def _column(values: tuple[Any, ...]) -> np.ndarray:
    if isinstance(values[0], (str, np.ndarray, list)):
        column = np.empty(len(values), dtype=object)
        column[:] = values
        return column
    return np.array(values, dtype=float)
