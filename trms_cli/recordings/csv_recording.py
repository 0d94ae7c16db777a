"""Recordings as CSV: ``# key: value`` lines, a header of ``name[unit]``, then numbers.

Any lab can write one, so anything can be wrong with one. Every fault is an error that names
the line, what was found there and what to do; nothing is repaired in silence.
"""

import re
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from trms_cli.core.data_file import MEBIBYTE, how_to_raise, largest, recorded_bytes
from trms_cli.core.errors import RecordingError
from trms_cli.core.printable import printable
from trms_cli.core.whole_file import whole_file
from trms_cli.recordings.channels import CHANNELS, Channel, Vocabulary, to_si
from trms_cli.recordings.recording import (
    Recording,
    refuse,
    require_channels,
    require_values,
    unit_fields,
)

_HEADER_CELL = re.compile(r"^(?P<name>[^\[\]]+?)\s*\[(?P<unit>[^\[\]]*)\]$")
_TIME = Channel("t", "time", ("s",), "time")
_EXAMPLE = "t[s],u_v[V],u_h[V],alpha_v[rad],alpha_h[rad]"
_COMMAS = "separate columns by commas and write decimals with a point: 0.25"
_MISSING = float("nan")
#: What recorders write where there is no sample.
_NO_VALUE = ("", "nan", "-nan", "+nan")
#: Of a file: eight channels at 100 Hz for some three hours.
_USUAL_MOST = 64 * MEBIBYTE
_LEAST_LINE = 8  # bytes; shorter lines hold no recording
_MOST_COLUMNS = 1000
_BLOCK = 10_000  # rows


@dataclass(frozen=True)
class _Column:
    name: str  #: As it stands in the file
    unit: str
    channel: Channel | None  #: None: it is left out


def read_csv(path: Path | str, vocabulary: Vocabulary | None = None) -> Recording:
    """Read a CSV recording into SI units.

    ``vocabulary``: of the model that it is read for; None: the file's own. Returns empty cells are
    NaN; gaps in ``t`` stay gaps. Raises RecordingError: whatever is wrong, at its line.
    """
    path = Path(path)
    lines, ends_with_newline = _lines(path)
    metadata, header_index = _preamble(path, lines)
    header_at = f"{path}:{header_index + 1}"
    cells = _header_cells(lines[header_index], header_at)
    if vocabulary is None:
        vocabulary = Vocabulary.declared(metadata, [_parts(cell)[0] for cell in cells], header_at)
    columns, remarks = _columns(cells, vocabulary, header_at)
    first = header_index + 1
    table, line_numbers = _numbers(path, lines, first, columns, ends_with_newline)
    if not ends_with_newline and len(table):
        remarks.append(_check_last_line(path, lines, line_numbers, table, columns))

    time = np.empty(0)
    channels, units = {}, {}
    for column, values in zip(columns, table.T, strict=True):
        if column.channel is None:
            continue
        converted, unit = _in_si(values, column, header_at)
        if column.channel is _TIME:
            time = np.ascontiguousarray(converted)
        else:
            channels[column.channel.name] = np.ascontiguousarray(converted)
            units[column.channel.name] = unit
    _check_time(path, time, line_numbers)
    require_values(channels, header_at, vocabulary)
    return Recording(time, channels, units, metadata, path, tuple(remarks), vocabulary)


def write_csv(recording: Recording, path: Path | str, *, force: bool = False) -> None:
    """Write a recording so that reading it gives the same numbers, bit for bit.

    ``recording``: NaN becomes an empty cell. ``path``: appears when it is whole; an existing file
    is refused unless ``force``.
    """
    names = list(recording.channels)
    header = ["t[s]", *(unit_fields(recording.units)[name] for name in names)]
    columns = [recording.time, *(recording.channels[name] for name in names)]
    with (
        whole_file(Path(path), force=force) as temporary,
        temporary.open("w", encoding="utf-8", newline="") as file,
    ):
        declarations = recording.vocabulary.declarations(names)
        for key, value in {**recording.metadata, **declarations}.items():
            file.write(f"# {_one_line(key).replace(':', ' ')}: {_one_line(value)}\n")
        file.write(",".join(header) + "\n")
        for row in zip(*(np.asarray(c, dtype=float).tolist() for c in columns), strict=True):
            # repr is the shortest text that reads back as the same number
            file.write(",".join("" if x != x else repr(x) for x in row) + "\n")


def _one_line(text: str) -> str:
    return " ".join(str(text).split())


def _lines(path: Path) -> tuple[list[str], bool]:
    data = recorded_bytes(path, _USUAL_MOST)
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        refuse(f"{path}:1", "the text is UTF-16, as some spreadsheets save it", "save it as UTF-8")
    if b"\0" in data:
        line = data[: data.index(b"\0")].count(b"\n") + 1
        refuse(f"{path}:{line}", "this is a binary file, not text", "give a CSV file")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        problem = f"the byte 0x{data[error.start]:02x} is not UTF-8 text"
        refuse(f"{path}:{line}", problem, "save the file as UTF-8")
    text = text.replace("\r\n", "\n").replace("\r", "\n")
    count, most = text.count("\n"), largest(_USUAL_MOST) // _LEAST_LINE
    if count > most:
        problem = f"it has {count:,} lines, and {most:,} are read"
        refuse(path, problem, how_to_raise(count * _LEAST_LINE))
    if not text.strip():
        refuse(path, "the file is empty", f"it needs a header as {_EXAMPLE}")
    return text.split("\n"), text.endswith("\n")


def _preamble(path: Path, lines: list[str]) -> tuple[dict[str, str], int]:
    """Return the metadata and the index of the header line."""
    metadata: dict[str, str] = {}
    for index, line in enumerate(lines):
        text = line.strip()
        if text.startswith("#"):
            key, colon, value = text[1:].partition(":")
            if not colon:
                key, value = "comment", f"{metadata.get('comment', '')} {key.strip()}"
            metadata[printable(key.strip())] = printable(value.strip())
        elif text:
            return metadata, index
    refuse(path, "there is no header, only # lines", f"write one as {_EXAMPLE}")


def _header_cells(line: str, where: str) -> list[str]:
    if line.count(",") >= _MOST_COLUMNS:
        remedy = f"a recording has up to {_MOST_COLUMNS}; is a line end missing?"
        refuse(where, f"it has {line.count(',') + 1:,} columns", remedy)
    cells = [cell.strip().strip('"').strip() for cell in line.split(",")]
    for separator, name in ((";", "semicolons"), ("\t", "tabs")):
        if separator in line:
            refuse(where, f"the columns are separated by {name}", _COMMAS)
    if all(_is_number(cell) for cell in cells):
        problem = "the first line holds numbers; the header is missing"
        refuse(where, problem, f"write the names and units above, as {_EXAMPLE}")
    return cells


def _columns(
    cells: list[str], vocabulary: Vocabulary, where: str
) -> tuple[list[_Column], list[str]]:
    """The columns, and what there is to say of them."""
    columns: list[_Column] = []
    for position, cell in enumerate(cells, start=1):
        columns.append(_header_cell(cell, position, vocabulary, where))
        earlier = [column.name for column in columns[:-1]]
        if columns[-1].name in earlier:
            places = f"in places {earlier.index(columns[-1].name) + 1} and {position}"
            problem = f"the column {columns[-1].name!r} stands twice, {places}"
            refuse(where, problem, "keep one of them")
    others = vocabulary.left_out([column.name for column in columns], where)
    require_channels([c.channel.name for c in columns if c.channel], where, vocabulary, others)
    return columns, [f"not used: {', '.join(others)}"] if others else []


def _parts(cell: str) -> tuple[str, str | None]:
    """Name and unit of a cell of the header."""
    match = _HEADER_CELL.match(cell)
    return (match["name"].strip(), match["unit"].strip()) if match else (cell, None)


def _header_cell(cell: str, position: int, vocabulary: Vocabulary, where: str) -> _Column:
    name, unit = _parts(cell)
    if not cell:
        refuse(where, f"column {position} has no name", "name it, or remove the comma too many")
    own = vocabulary.name_of(name)
    channel = _TIME if own == "t" else vocabulary.find(own) if own else None
    if own is None and (vocabulary.origin == "model" or name in vocabulary.columns):
        return _Column(name, unit or "", None)
    if channel is None:
        suggestion = vocabulary.nearest(name)
        name_list = ", ".join(("t", *CHANNELS, "d_*"))
        raise RecordingError(
            f"column {position}: the name {name!r} is not known"
            + (f"; did you mean {suggestion!r}?" if suggestion else ""),
            where=where,
            remedy=f"names are {name_list}; of a rig with others the lines `# inputs: NAME, …` "
            "and `# outputs: NAME, …` above the header tell which is which",
        )
    if unit is None:
        usual = channel.units[0] if channel.units else "1"
        remedy = f"write {name}[{usual}], with the unit that the numbers are in"
        refuse(where, f"column {position}: {cell!r} has no unit", remedy)
    column = _Column(name, unit, channel)
    _in_si(np.empty(0), column, where)  # a wrong unit is told before any wrong number
    return column


def _in_si(values: np.ndarray, column: _Column, where: str) -> tuple[np.ndarray, str]:
    assert column.channel is not None
    return to_si(values, column.unit, column.channel.units, where=where, name=column.name)


def _numbers(
    path: Path, lines: list[str], first: int, columns: list[_Column], ends_with_newline: bool
) -> tuple[np.ndarray, list[int]]:
    """Return the cells as (n, columns) floats, and the line number of each row."""
    width = len(columns)
    blocks: list[np.ndarray] = []
    rows: list[list[float]] = []
    line_numbers: list[int] = []
    for number, line in enumerate(islice(lines, first, None), start=first + 1):
        if not line or line.isspace():
            continue
        cell_count = line.count(",") + 1  # before it is cut up: it may be all of the file
        if cell_count != width:
            cut = number == len(lines) and not ends_with_newline and cell_count < width
            _refuse_width(path, number, line, cell_count, width, cut=cut)
        cells = line.split(",")
        try:
            rows.append([float(c) if c and not c.isspace() else _MISSING for c in cells])
        except ValueError:
            rows.append([_number(path, number, c, k) for c, k in zip(cells, columns, strict=True)])
        line_numbers.append(number)
        if len(rows) == _BLOCK:  # as numbers they take a quarter of the memory
            blocks.append(np.array(rows))
            rows = []
    if len(line_numbers) < 2:
        problem = (
            "there is a single row" if line_numbers else "there are no numbers below the header"
        )
        refuse(f"{path}:{first + 1}", problem, "a recording needs two samples or more")
    table = np.concatenate([*blocks, np.array(rows).reshape(-1, width)])
    # "nan" and "inf" pass float(), and so does an empty cell as our own NaN: only rows with
    # a value that is not finite are looked at again. float() also takes 1_0 for 10.
    suspects = set(np.flatnonzero(~np.isfinite(table).all(axis=1)).tolist())
    suspects |= {row for row, number in enumerate(line_numbers) if "_" in lines[number - 1]}
    for row in sorted(suspects):
        number = line_numbers[row]
        for cell, column in zip(lines[number - 1].split(","), columns, strict=True):
            value = _number(path, number, cell, column)
            if column.channel is _TIME and value != value:
                refuse(f"{path}:{number}", "the cell of 't' is empty", "every row needs its time")
    return table, line_numbers


def _number(path: Path, line: int, cell: str, column: _Column) -> float:
    text = cell.strip().strip('"').strip()
    if text.lower() in _NO_VALUE or column.channel is None:
        return _MISSING
    prefix = f"column {column.name!r} holds"
    empty = "leave the cell empty where a sample is missing"
    if not _is_number(text):
        problem = f"{prefix} {text[:40]!r}, which is not a number"
        refuse(f"{path}:{line}", problem, f"write numbers as 0.25 or 2.5e-1; {empty}")
    if not np.isfinite(float(text)):
        refuse(f"{path}:{line}", f"{prefix} {text!r}, which is not finite", empty)
    return float(text)


def _is_number(text: str) -> bool:
    if "_" in text:  # Python takes 1_000 for a number, nobody's recorder writes it
        return False
    try:
        float(text)
    except ValueError:
        return False
    return True


def _refuse_width(
    path: Path, line: int, text: str, cell_count: int, width: int, *, cut: bool
) -> None:
    if cut:
        refuse(
            f"{path}:{line}",
            f"the file ends in the middle of the line: {cell_count} of {width} cells",
            "the file was cut; copy it again, or delete its last line",
        )
    if ";" in text or cell_count >= 2 * width - 1 > 1:
        problem = f"{cell_count} cells where the header has {width}: decimal commas or semicolons?"
        refuse(f"{path}:{line}", problem, _COMMAS)
    if text.lstrip().startswith("#"):
        refuse(f"{path}:{line}", "a # line below the header", "metadata stand above the header")
    refuse(
        f"{path}:{line}",
        f"{cell_count} cells where the header has {width}",
        "give each line as many cells as the header; empty cells are missing samples",
    )


def _check_last_line(
    path: Path, lines: list[str], numbers: list[int], table: np.ndarray, columns: list[_Column]
) -> str:
    """Tell a last line that was cut inside its last cell from one that only lacks its end."""
    last = [lines[number - 1].rpartition(",")[2].strip() for number in numbers]
    decimals = {len(cell.partition(".")[2]) for cell in last[:-1] if cell}
    text = last[-1]
    # All other rows print the same number of decimals and this one prints fewer.
    fewer = len(decimals) == 1 and len(text.partition(".")[2]) < min(decimals)
    always_there = not np.isnan(table[:-1, -1]).any()
    if (text and fewer) or (not text and always_there):
        refuse(
            f"{path}:{numbers[-1]}",
            f"the file ends in the middle of the last cell, {columns[-1].name!r}: {text!r}",
            "if the file was cut, copy it again or delete its last line; if not, end it with a "
            "line break",
        )
    return "the last line has no line end: was the file cut there?"


def _check_time(path: Path, time: np.ndarray, line_numbers: list[int]) -> None:
    wrong = np.flatnonzero(np.diff(time) <= 0)
    if len(wrong):
        index = int(wrong[0]) + 1
        before, now = float(time[index - 1]), float(time[index])
        what = "repeats" if before == now else "runs back"
        more = f" (and at {len(wrong) - 1} more places)" if len(wrong) > 1 else ""
        refuse(
            f"{path}:{line_numbers[index]}",
            f"time {what}: {now:.9g} s after {before:.9g} s{more}",
            "sort the rows and keep one per time; split a file of several runs",
        )
