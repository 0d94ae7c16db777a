"""Signals over time as the scores read them: a log's tables, or what a run has in memory."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from trms_cli.scoring.metrics import Array


class Columns(Protocol):
    """Signals over time, as a log's table has them."""

    @property
    def time(self) -> Array:
        """(n,) s, rising."""
        ...

    @property
    def columns(self) -> Mapping[str, Any]:
        """(n,) arrays by name."""
        ...

    @property
    def units(self) -> Mapping[str, str]:
        """Units by name; a signal that it lacks is scored without one."""
        ...


@dataclass(frozen=True)
class Series:
    """Signals over time that were never in a file: what the closed loop has in memory."""

    time: Array  #: (n,) s
    columns: Mapping[str, Any]  #: dict of str to (n,) arrays
    units: Mapping[str, str] = field(default_factory=dict)


def held(table: Columns, name: str, time: Array) -> Array:
    """A signal at other times: its last sample until then, NaN before the first one."""
    values = floats(table, name)
    if np.array_equal(table.time, time):
        return values
    index = np.searchsorted(table.time, time + 1e-9, side="right") - 1
    return np.where(index >= 0, values[np.maximum(index, 0)], np.nan)


def floats(table: Columns, name: str) -> Array:
    return np.asarray(table.columns[name], dtype=float)


def unit(table: Columns, name: str) -> str:
    """The unit that the log's schema tells; a name alone tells none."""
    return table.units.get(name, "")
