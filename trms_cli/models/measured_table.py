"""Tables that someone measured: CSV with ``name[unit]`` columns, in SI."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt

from trms_cli.core.data_file import MEBIBYTE, read_bytes
from trms_cli.core.errors import ModelError

FloatArray = npt.NDArray[np.float64]

#: Of a file; a measured curve has some kilobytes.
_MOST = MEBIBYTE
#: Factor to SI by unit, by column.
Columns = Mapping[str, Mapping[str, float]]


def read_table(
    path: str, where: str, *, what: str, header: str, columns: Columns, fewest: int
) -> dict[str, FloatArray]:
    """Read a table, its columns in any order; lines that begin with ``#`` are skipped.

    Parameters
    ----------
    path : str
    where : str
        The configuration key, for messages.
    what : str
        What the table holds, in words: ``a static curve``.
    header : str
        How its first line is usually written.
    columns : dict of str to dict of str to float
        Factor to SI by unit, of every column that there must be.
    fewest : int
        Least number of rows.

    Returns
    -------
    dict of str to (n,) array
        In SI, in the order of the file.

    Raises
    ------
    ModelError
        If there is no such file, or its content is not such a table; with the line.
    """
    try:
        text = read_bytes(Path(path), _MOST).decode("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is not UTF-8 text"
        raise ModelError(
            f"cannot read {path!r}: {reason}",
            where=where,
            remedy=f"give a CSV of steady values with the header {header}",
        ) from error
    lines = [
        (number, line)
        for number, line in enumerate(text.splitlines(), start=1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    if not lines:
        raise ModelError("the file is empty", where=path, remedy=f"it begins with {header}")
    place = f"{path}:{lines[0][0]}"
    factors, order = _columns(lines[0][1], place, what, header, columns)
    rows = [_row(line, len(order), f"{path}:{number}") for number, line in lines[1:]]
    if len(rows) < fewest:
        raise ModelError(
            f"{len(rows)} points given",
            where=path,
            remedy=f"a curve needs {fewest} points or more, over both directions",
        )
    table = np.array(rows)
    return {name: table[:, order[name]] * factors[name] for name in columns}


def _columns(
    text: str, where: str, what: str, header: str, columns: Columns
) -> tuple[dict[str, float], dict[str, int]]:
    """Factor to SI and position of each column."""
    factors: dict[str, float] = {}
    order: dict[str, int] = {}
    for position, cell in enumerate(text.split(",")):
        name, _, unit = cell.strip().rstrip("]").partition("[")
        allowed = columns.get(name, {})
        if unit not in allowed or name in order:
            raise ModelError(
                f"column {cell.strip()!r} is not part of {what}",
                where=where,
                remedy=f"write the header {header}{_other_units(columns)}",
            )
        factors[name], order[name] = allowed[unit], position
    if len(order) < len(columns):
        raise ModelError(
            f"the header {text.strip()!r} lacks a column",
            where=where,
            remedy=f"write the header {header}",
        )
    return factors, order


def _other_units(columns: Columns) -> str:
    """Words on columns that may have another unit than the usual one."""
    others = [
        f"{name} also in {next(iter(units))}" for name, units in columns.items() if len(units) > 1
    ]
    return f" ({', '.join(others)})" if others else ""


def _row(line: str, width: int, where: str) -> list[float]:
    try:
        row = [float(cell) for cell in line.split(",")]
    except ValueError:
        row = []
    if len(row) != width or not np.isfinite(row).all():
        raise ModelError(
            f"{line.strip()!r} is no row of {width} numbers",
            where=where,
            remedy="write decimals with a point and separate columns by commas",
        )
    return row
