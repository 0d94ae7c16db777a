"""Tables of figures, a row a run, as Arrow tables and Parquet files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from trms_cli.recordings.output_file import whole_file

if TYPE_CHECKING:
    import pyarrow


def arrow_table(
    rows: Sequence[Mapping[str, Any]], kinds: Mapping[str, type | None], units: Mapping[str, str]
) -> pyarrow.Table:
    """Rows as columns, each of one type, with its unit in its metadata.

    Parameters
    ----------
    rows : sequence of mappings
        None for what a row does not have.
    kinds : mapping of str to type or None
        The columns in their order: ``float``, ``int``, ``bool``, ``str``, or None for a column
        of values that may be of several types (numbers if all are numbers, else text).
    units : mapping of str to str
        By column; "" or absent for what has none.
    """
    import pyarrow as pa

    types = {float: pa.float64(), int: pa.int64(), bool: pa.bool_(), str: pa.string()}
    fields, arrays = [], []
    for name, kind in kinds.items():
        values = [row.get(name) for row in rows]
        if kind is None:
            kind, values = _one_type(values)
        fields.append(pa.field(name, types[kind], metadata={"unit": units.get(name, "")}))
        arrays.append(pa.array(values, types[kind]))
    return pa.table(arrays, schema=pa.schema(fields))


def write_parquet(table: pyarrow.Table, path: Path, *, force: bool = False) -> None:
    """Write a table; the file appears when it is whole.

    Raises RecordingError if there is such a file already and not ``force``, or the disk does not
    take it.
    """
    import pyarrow.parquet as pq

    with whole_file(path, force=force) as temporary:
        pq.write_table(table, temporary)


def _one_type(values: Sequence[Any]) -> tuple[type, list[Any]]:
    present = [value for value in values if value is not None]
    if all(isinstance(value, (int, float)) for value in present):
        return float, [None if value is None else float(value) for value in values]
    return str, [None if value is None else str(value) for value in values]
