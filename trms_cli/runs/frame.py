"""Runs in a notebook: a list of dicts, an Arrow table or a pandas frame, in one line."""

import os
import pathlib
from collections.abc import Sequence
from typing import Any

from trms_cli.core.errors import TrmsError
from trms_cli.runs.query import Query, QueryResult, find

Path = str | os.PathLike[str]


def find_runs(
    filter: str = "",
    folders: Path | Sequence[Path] = (),
    *,
    everywhere: bool = False,
    sort: str = "time",
    descending: bool = False,
    columns: Sequence[str] = (),
    limit: int | None = None,
) -> list[dict[str, Any]]:
    """Runs as dicts of values by column; None for what a run does not have.

    Parameters
    ----------
    filter : str
        As for ``trms runs``: ``"controller == 'newton_mpc' and rmse_yaw < 0.05"``.
    folders : path, or sequence of paths
        Where to look, however deep; by default the working folder.
    everywhere : bool
        Every run that this machine knows of, instead.
    sort : str
        A column; runs that have no value of it come last.
    descending : bool
        Largest, or latest, first.
    columns : sequence of str
        By default all.
    limit : int or None
        Runs at most.

    Raises
    ------
    FilterError
        If the filter cannot be used; it says why and where.
    ConfigurationError
        If there is no such folder or column.
    """
    result = _query(
        filter,
        folders,
        everywhere=everywhere,
        sort=sort,
        descending=descending,
        columns=columns,
        limit=limit,
    )
    return list(result.runs)


def runs_table(filter: str = "", folders: Path | Sequence[Path] = (), **how: Any) -> Any:
    """Runs as a ``pyarrow.Table``, units in the metadata of its fields; as :func:`find_runs`."""
    return table_of(_query(filter, folders, **how))


def runs_frame(filter: str = "", folders: Path | Sequence[Path] = (), **how: Any) -> Any:
    """Runs as a ``pandas.DataFrame``, a row each; arguments as of :func:`find_runs`.

    ``frame.attrs["units"]`` has the units by column, and the ``time`` column is of the type
    ``datetime64`` in UTC.

    Raises TrmsError if pandas is not installed: it is no dependency of this package.
    """
    from importlib import import_module
    from importlib.util import find_spec

    if find_spec("pandas") is None:
        raise TrmsError(
            "a frame needs pandas, which is not installed",
            where="runs_frame",
            remedy="pip install pandas; without it: find_runs(…) gives a list of dicts, "
            "runs_table(…) an Arrow table",
        )
    pandas = import_module("pandas")
    result = _query(filter, folders, **how)
    frame = table_of(result).to_pandas()
    if "time" in frame:
        frame["time"] = pandas.to_datetime(frame["time"], utc=True)
    frame.attrs["units"] = {name: column.unit for name, column in result.columns.items()}
    return frame


def table_of(result: QueryResult) -> Any:
    """An answer of the index as a ``pyarrow.Table``, each column of one type.

    A column's unit stands in its metadata. One of any values is numbers if all are, else text.
    """
    import pyarrow as pa

    types = {"number": pa.float64(), "whole": pa.int64(), "truth": pa.bool_(), "text": pa.string()}
    fields, arrays = [], []
    for name, column in result.columns.items():
        kind, values = str(column.kind), [run.get(name) for run in result.runs]
        if kind == "any":
            kind, values = _one_kind(values)
        fields.append(pa.field(name, types[kind], metadata={"unit": column.unit}))
        arrays.append(pa.array(values, types[kind]))
    return pa.table(arrays, schema=pa.schema(fields))


def write_parquet(result: QueryResult, path: pathlib.Path, *, force: bool) -> None:
    """Write a table with types, and units in the metadata of its fields.

    Raises RecordingError if there is such a file and not `force`, or it cannot be written.
    """
    import pyarrow.parquet as pq

    from trms_cli.core.whole_file import whole_file

    with whole_file(path, force=force) as temporary:
        pq.write_table(table_of(result), temporary)


def _one_kind(values: Sequence[Any]) -> tuple[str, list[Any]]:
    present = [value for value in values if value is not None]
    if all(isinstance(value, (int, float)) for value in present):
        return "number", [None if value is None else float(value) for value in values]
    return "text", [None if value is None else str(value) for value in values]


def _query(
    filter: str, folders: Path | Sequence[Path], *, columns: Sequence[str] = (), **how: Any
) -> QueryResult:
    several = (folders,) if isinstance(folders, (str, os.PathLike)) else tuple(folders)
    column_names = (columns,) if isinstance(columns, str) else tuple(columns)
    return find(
        Query(filter=filter, folders=several, columns=column_names, **({"descending": False} | how))
    )
