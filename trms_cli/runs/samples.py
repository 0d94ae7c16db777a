"""Columns that grow while a run goes on, with running sums that make any moment of it cheap."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]


class Growing:
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
        self._sums, self._counts = Growing(), Growing()

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


class Samples:
    """The samples of a topic: a time and columns of equal length.

    Parameters
    ----------
    units : dict of str to str
        By column; those without a unit are texts or truth values.
    """

    def __init__(self, units: dict[str, str]) -> None:
        self.units = units
        self.time = Growing()
        self.numbers: dict[str, Growing] = {}
        self.texts: dict[str, list[str]] = {}

    def append(self, time: FloatArray, columns: dict[str, np.ndarray]) -> None:
        """Add the rows of a table."""
        self.time.append(time)
        for name, column in columns.items():
            if column.dtype == object:
                self.texts.setdefault(name, []).extend(_texts(column))
            else:
                self.numbers.setdefault(name, Growing()).append(column)

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

    def held(self, name: str, time: FloatArray) -> FloatArray:
        """A column at other times: its last sample until then, NaN before the first one."""
        column = self.numbers.get(name)
        if column is None or not len(column):
            return np.full(len(time), np.nan)
        index = np.searchsorted(self.time.values, time + 1e-9, side="right") - 1
        return np.where(index >= 0, column.values[np.maximum(index, 0)], np.nan)


def _texts(column: Iterable[object]) -> list[str]:
    return [value if isinstance(value, str) else "" for value in column]
