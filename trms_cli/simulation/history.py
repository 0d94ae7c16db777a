"""What happened in a run, in memory and in the log: the same rows go to both."""

import time
from array import array
from collections.abc import Callable, Mapping, Sequence
from operator import itemgetter
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from trms_cli.core.arrays import FloatArray

#: Takes a time (ns) and a topic's values at that time.
Writer = Callable[[int, Sequence[Any]], None]
#: Takes a time (ns) and the arrays that make up a sample's signals.
SignalWriter = Callable[[int, Sequence[FloatArray]], None]
#: Rows of a topic: of numbers (n, fields), or of whatever its fields hold.
Rows = FloatArray | Sequence[Sequence[Any]]

#: Topics whose fields are all numbers.
_SIGNALS = frozenset({"/reference", "/command", "/measurement", "/plant/state", "/estimate"})
#: Samples between two flushes for which there is room from the first on.
_ROOM = 128


class Sink(Protocol):
    """Where a run's rows go; a :class:`trms_cli.recordings.run_log.RunLog` is one."""

    def write_rows(
        self, times_ns: Sequence[int], wall_ns: Sequence[int], rows: Mapping[str, Rows]
    ) -> None: ...

    def event(
        self, time_ns: int, kind: str, source: str, message: str, value: float = ...
    ) -> None: ...

    def flush(self) -> None: ...


class History:
    """Keeps the rows of a run by topic, and passes them on.

    Writers only note what they are given: rows are in the history, and in the log, after
    :meth:`flush`. To look after each topic at each sample would be a fifth of a run's time.

    ``units``: unit of each field of each topic, the fields in the order of the rows. ``sink``: the
    log; None keeps the rows in memory only.
    """

    def __init__(self, units: dict[str, dict[str, str]], sink: Sink | None) -> None:
        self.units = units
        self.fields = {topic: tuple(fields) for topic, fields in units.items()}
        self._sink = sink
        self._rows: dict[str, _Numbers | _Mixed] = {
            name: _Numbers(len(fields)) if name in _SIGNALS else _Mixed(len(fields))
            for name, fields in self.fields.items()
        }
        self._pending: list[_PendingRows | _PendingSignals] = []
        self.events: list[tuple[int, str, str, str, float]] = []

    def writer(self, topic: str) -> Writer:
        """What takes the rows of one topic; it does nothing with a topic that is not kept."""
        if topic not in self.fields:
            return _nothing
        pending = _PendingRows(topic)
        self._pending.append(pending)
        return pending.note

    def signal_writer(
        self, parts: Mapping[str, int], order: Mapping[str, npt.ArrayLike] | None = None
    ) -> SignalWriter:
        """What takes the signals of all topics of numbers at a sample.

        ``parts``: how many arrays (1-D) make up a topic's row, by topic, in the order in which they
        are given; those of a topic that is not kept are left. ``order``: positions in a topic's
        arrays, one after another, of the fields of its row, where that is another order.
        """
        places: list[int] = []
        widths: dict[str, int] = {}
        start = 0
        for topic, count in parts.items():
            if topic in self.fields:
                places += range(start, start + count)
                widths[topic] = len(self.fields[topic])
            start += count
        if not places:
            return _nothing
        pending = _PendingSignals(places, widths, dict(order or {}))
        self._pending.append(pending)
        return pending.note

    def event(
        self, time_ns: int, kind: str, source: str, message: str, value: float = float("nan")
    ) -> None:
        """Something happened; ``value`` in the unit that the message names."""
        self.events.append((time_ns, kind, source, message, value))
        if "/event" in self._rows:
            self._rows["/event"].keep([time_ns], [(kind, source, message, value)])
        if self._sink is not None:
            self._sink.event(time_ns, kind, source, message, value)

    def flush(self) -> None:
        """Make everything so far safe."""
        for pending in self._pending:
            times_ns, wall_ns, rows = pending.take()
            if not times_ns:
                continue
            for topic, new in rows.items():
                self._rows[topic].keep(times_ns, new)
            if self._sink is not None:
                self._sink.write_rows(times_ns, wall_ns, rows)
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


class _PendingRows:
    """Rows of one topic that were noted since the last flush, with their times and wall clock."""

    def __init__(self, topic: str) -> None:
        self._topic = topic
        self._noted: list[tuple[int, int, Sequence[Any]]] = []

    def note(self, time_ns: int, values: Sequence[Any]) -> None:
        self._noted.append((time_ns, time.time_ns(), values))

    def take(self) -> tuple[list[int], list[int], Mapping[str, Rows]]:
        noted, self._noted = self._noted, []
        rows = [values for _, _, values in noted]
        return [row[0] for row in noted], [row[1] for row in noted], {self._topic: rows}


class _PendingSignals:
    """Samples of several topics of numbers that were noted since the last flush.

    ``places``: which of the arrays of a sample are kept; they make up the rows of the topics in
    ``widths``, one after another. ``order``: see :meth:`History.signal_writer`.
    """

    def __init__(
        self,
        places: Sequence[int],
        widths: Mapping[str, int],
        order: Mapping[str, npt.ArrayLike],
    ) -> None:
        # of one place alone itemgetter would give the array itself
        self._kept = itemgetter(*places) if len(places) > 1 else lambda parts: [parts[places[0]]]
        self._columns: dict[str, Any] = {}
        start = 0
        for topic, width in widths.items():
            columns: Any = slice(start, start + width)
            self._columns[topic] = start + np.asarray(order[topic]) if topic in order else columns
            start += width
        self._table = np.empty((_ROOM, start))
        self._noted: list[tuple[int, int]] = []  # time and wall clock, ns

    def note(self, time_ns: int, parts: Sequence[FloatArray]) -> None:
        count = len(self._noted)
        if count == len(self._table):
            self._table = np.concatenate([self._table, np.empty_like(self._table)])
        np.concatenate(self._kept(parts), out=self._table[count])
        self._noted.append((time_ns, time.time_ns()))  # Ctrl-C leaves no time without values

    def take(self) -> tuple[list[int], list[int], Mapping[str, Rows]]:
        noted, self._noted = self._noted, []
        table = self._table[: len(noted)]
        # copies: the table is written again
        rows = {topic: table[:, columns].copy() for topic, columns in self._columns.items()}
        return [time_ns for time_ns, _ in noted], [wall for _, wall in noted], rows


class _Numbers:
    """Rows of floats, packed: an hour of them fits into memory."""

    def __init__(self, width: int) -> None:
        self.times = array("q")
        self._blocks: list[FloatArray] = []
        self._width = width

    def keep(self, times_ns: Sequence[int], rows: Rows) -> None:
        self._blocks.append(np.asarray(rows, dtype=float))
        self.times.extend(times_ns)

    def columns(self) -> list[np.ndarray]:
        table = np.concatenate([np.zeros((0, self._width)), *self._blocks])
        return list(np.ascontiguousarray(table[: len(self.times)].T))


class _Mixed:
    """Rows of numbers, text and arrays."""

    def __init__(self, width: int) -> None:
        self.times = array("q")
        self._rows: list[Sequence[Any]] = []
        self._width = width

    def keep(self, times_ns: Sequence[int], rows: Rows) -> None:
        self._rows.extend(rows)
        self.times.extend(times_ns)

    def columns(self) -> list[np.ndarray]:
        if not self.times:
            return [np.zeros(0)] * self._width
        return [_column(values) for values in zip(*self._rows[: len(self.times)], strict=True)]


def _nothing(time_ns: int, values: Sequence[Any]) -> None:
    """What takes rows that are not kept."""


def _column(values: tuple[Any, ...]) -> np.ndarray:
    if isinstance(values[0], (str, np.ndarray, list)):
        column = np.empty(len(values), dtype=object)
        column[:] = values
        return column
    return np.array(values, dtype=float)
