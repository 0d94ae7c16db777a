"""A reference out of a table of numbers: a recording, or a file with nothing but references.

The header is that of a recording, ``t[s],r_v[rad],r_h[rad]``; the strict reader of recordings
is not used, because a reference needs no inputs and outputs beside it.
"""

import csv
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np

from trms_cli.core.data_file import MEBIBYTE, largest, read_bytes
from trms_cli.core.errors import RecordingError
from trms_cli.references.signal import EDGE, Array

#: Of a file: its rows are taken apart in memory.
_USUAL_MOST = 32 * MEBIBYTE
_MOST_COLUMNS = 1000


@dataclass(frozen=True, kw_only=True)
class FromCsv:
    """A column of a CSV file, its time counted from the first row.

    Before the first row the first value holds, after the last row the last one.
    """

    file: str  #: Path of the CSV file
    column: str  #: Name of the column without its unit, e.g. ``r_v``.
    #: Whether a value holds until the next row, or a straight line joins the two
    interpolation: Literal["hold", "linear"] = "hold"
    start: float = 0.0  #: Time of the first row in the run, s
    scale: float = 1.0  #: Factor on the values
    offset: float = 0.0  #: Added to the scaled values, rad

    def __post_init__(self) -> None:
        # read now: a wrong file is to be reported before the run begins
        _ = self._table

    @cached_property
    def _table(self) -> tuple[Array, Array]:
        """Time since the first row, s, and values, rad, ``(n,)`` each."""
        time, values = read_columns(Path(self.file), self.column)
        return time - time[0], values

    def sample(self, times: Array) -> Array:
        time, values = self._table
        elapsed = np.asarray(times, dtype=float) - self.start
        if self.interpolation == "linear":
            sampled = np.interp(elapsed, time, values)
        else:
            row = np.searchsorted(time, elapsed + EDGE, side="right") - 1
            sampled = values[np.maximum(row, 0)]
        return self.offset + self.scale * sampled


def read_columns(path: Path, column: str) -> tuple[Array, Array]:
    """Time and one column of a CSV file, in SI units: an angle, a command, or of another rig any.

    Returns the times, (n,) s and strictly rising, and the values, (n,) rad, or V or 1 for a
    command, or what the unit of another rig's converts to. Raises RecordingError if the file cannot
    be read, has no such column, an unknown unit, or a cell that is not a finite number; it names
    the file and the line.
    """
    from trms_cli.recordings.channels import STANDARD, to_si

    channel = STANDARD.find(column)
    fitting: tuple[str, ...] = () if channel is None else ("rad",)
    if channel is not None and channel.role == "input":
        fitting = channel.units
    usual = (*fitting, "rad")[0]
    example = f"t[s],{column}[{usual}]"
    if not path.exists():
        raise RecordingError(
            f"there is no file {str(path)!r}",
            where="file",
            remedy=f"give the path of a CSV file whose header is like {example}",
        )
    try:
        text = read_bytes(path, largest(_USUAL_MOST)).decode("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise RecordingError(
            f"{str(path)!r} cannot be read: {getattr(error, 'strerror', None) or error}",
            where="file",
            remedy=f"give the path of a CSV file whose header is like {example}",
        ) from error
    rows = _rows(text)
    header_line, header = next(rows, (0, []))
    where = f"{path}:{header_line}"
    if not header:
        raise RecordingError(
            "the file is empty",
            where=str(path),
            remedy=f"write a header like {example} and rows of numbers below it",
        )
    units = dict(_name_and_unit(cell, where, usual) for cell in header)
    names = list(units)
    for name in ("t", column):
        if name not in units:
            raise RecordingError(
                f"there is no column {name!r}",
                where=where,
                remedy=f"the file has: {', '.join(names)}",
            )
    if len(names) != len(header):
        raise RecordingError("a column occurs twice", where=where, remedy="name each once")
    indices = [names.index("t"), names.index(column)]
    numbers: list[list[float]] = []
    lines: list[int] = []
    for line, cells in rows:
        if len(cells) != len(header):
            raise RecordingError(
                f"{len(cells)} cells under a header of {len(header)}",
                where=f"{path}:{line}",
                remedy="complete the row, or delete it if the file was cut off",
            )
        numbers.append([_number(cells[i], names[i], path, line) for i in indices])
        lines.append(line)
    if not numbers:
        raise RecordingError("there are no rows", where=str(path), remedy="add rows of numbers")
    time, values = np.array(numbers).T
    back = np.flatnonzero(np.diff(time) <= 0)
    if back.size:
        raise RecordingError(
            f"time does not rise: {time[back[0] + 1]:g} after {time[back[0]]:g}",
            where=f"{path}:{lines[back[0] + 1]}",
            remedy="sort the rows by t, and give each time once",
        )
    seconds, _ = to_si(time, units["t"], ("s",), where=where, name="t")
    converted, _ = to_si(values, units[column], fitting, where=where, name=column)
    return seconds, converted


def _rows(text: str) -> Iterator[tuple[int, list[str]]]:
    """Line numbers (from 1) and cells, without metadata, comments and blank lines."""
    for line, content in enumerate(text.splitlines(), start=1):
        if content.strip() and not content.lstrip().startswith("#"):
            if content.count(",") > _MOST_COLUMNS or len(content) > csv.field_size_limit():
                raise RecordingError(f"line {line} is no row of a table", where="file")
            yield line, [cell.strip() for cell in next(csv.reader([content]), [])]


def _name_and_unit(cell: str, where: str, unit: str) -> tuple[str, str]:
    name, bracket, rest = cell.partition("[")
    unit = "s" if name == "t" else unit
    if not bracket or not rest.endswith("]"):
        raise RecordingError(
            f"the column {cell!r} has no unit",
            where=where,
            remedy=f"write the header as name[unit], e.g. {name or 'r_v'}[{unit}]",
        )
    return name.strip(), rest[:-1]


def _number(cell: str, name: str, path: Path, line: int) -> float:
    try:
        number = float(cell)
    except ValueError:
        number = float("nan")
    if not np.isfinite(number):
        raise RecordingError(
            f"column {name!r} holds {cell!r}, which is not a finite number",
            where=f"{path}:{line}",
            remedy="fill the cell; neither a reference nor a command has missing samples",
        )
    return number
