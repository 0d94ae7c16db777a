"""What happened in a run, in memory and in the log: the same rows go to both."""

from array import array
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np

#: Takes a time (ns) and a topic's values at that time.
Writer = Callable[[int, Sequence[Any]], None]


#: Topics whose fields are all numbers.
_SIGNALS = frozenset({"/reference", "/command", "/measurement", "/plant/state", "/estimate"})


class Sink(Protocol):
    """Where a run's rows go; a :class:`trms_cli.recordings.run_log.RunLog` is one."""

    def writer(self, topic: str) -> Writer: ...

    def event(
        self, time_ns: int, kind: str, source: str, message: str, value: float = ...
    ) -> None: ...

    def flush(self) -> None: ...


class History:
    """Keeps the rows of a run by topic, and passes them on.

    ``units``: unit of each field of each topic, the fields in the order of the rows. ``sink``: the
    log; None keeps the rows in memory only. ``every``: topics of which each so many-th row, from
    the first on, is passed on; all are kept.
    """

    def __init__(
        self,
        units: dict[str, dict[str, str]],
        sink: Sink | None,
        every: Mapping[str, int] | None = None,
    ) -> None:
        self._every = every or {}
        self.units = units
        self.fields = {topic: tuple(fields) for topic, fields in units.items()}
        self._sink = sink
        self._rows: dict[str, _Rows] = {
            name: _Numbers(len(fields)) if name in _SIGNALS else _Mixed(len(fields))
            for name, fields in self.fields.items()
        }
        self.events: list[tuple[int, str, str, str, float]] = []

    def writer(self, topic: str) -> Writer:
        """What takes the rows of one topic; it does nothing with a topic that is not kept."""
        if topic not in self.fields:
            return _nothing
        rows = self._rows[topic]
        keep_time, keep = rows.times.append, rows.keep
        if self._sink is None:
            write: Writer = _nothing
        else:
            write = self._sink.writer(topic)

        every = self._every.get(topic, 1)
        if every != 1 and self._sink is not None:
            write = _thinned(write, every) if every else _nothing

        def both(time_ns: int, values: Sequence[Any]) -> None:
            keep(values)  # before its time: Ctrl-C between the two leaves no time without values
            keep_time(time_ns)
            write(time_ns, values)

        return both

    def event(
        self, time_ns: int, kind: str, source: str, message: str, value: float = float("nan")
    ) -> None:
        """Something happened; ``value`` in the unit that the message names."""
        self.events.append((time_ns, kind, source, message, value))
        rows = self._rows.get("/event")
        if isinstance(rows, _Mixed):
            rows.keep((kind, source, message, value))
            rows.times.append(time_ns)
        if self._sink is not None:
            self._sink.event(time_ns, kind, source, message, value)

    def flush(self) -> None:
        """Make everything so far safe."""
        if self._sink is not None:
            self._sink.flush()

    def times(self, topic: str) -> np.ndarray:
        """Times of a topic's rows, shape (n,), s."""
        rows = self._rows.get(topic)
        # Division, not a product with 1e-9: decimal times then come out exactly.
        return np.array(rows.times if rows else (), dtype=float) / 1e9

    def columns(self, topic: str) -> dict[str, np.ndarray]:
        """Columns of a topic by field name, each (n,); text and arrays as objects."""
        rows = self._rows.get(topic)
        return dict(zip(self.fields[topic], rows.columns(), strict=True)) if rows else {}


def _thinned(write: Writer, every: int) -> Writer:
    """Pass on each so many-th row, from the first on."""
    count = -1

    def thinned(time_ns: int, values: Sequence[Any]) -> None:
        nonlocal count
        count += 1
        if not count % every:
            write(time_ns, values)

    return thinned


class _Numbers:
    """Rows of floats, packed: an hour of them fits into memory."""

    def __init__(self, width: int) -> None:
        self.times = array("q")
        self._values = array("d")
        self._width = width
        self.keep = self._values.extend

    def columns(self) -> list[np.ndarray]:
        # A copy: an array that others look into could not grow.
        whole = len(self.times) * self._width
        table = np.array(self._values)[:whole].reshape(-1, self._width)
        return list(np.ascontiguousarray(table.T))


class _Mixed:
    """Rows of numbers, text and arrays."""

    def __init__(self, width: int) -> None:
        self.times = array("q")
        self._rows: list[Sequence[Any]] = []
        self._width = width
        self.keep = self._rows.append

    def columns(self) -> list[np.ndarray]:
        if not self.times:
            return [np.zeros(0)] * self._width
        return [_column(values) for values in zip(*self._rows[: len(self.times)], strict=True)]


_Rows = _Numbers | _Mixed


def _nothing(time_ns: int, values: Sequence[Any]) -> None:
    """What a history without a log writes."""


def _column(values: tuple[Any, ...]) -> np.ndarray:
    if isinstance(values[0], (str, np.ndarray, list)):
        column = np.empty(len(values), dtype=object)
        column[:] = values
        return column
    return np.array(values, dtype=float)
