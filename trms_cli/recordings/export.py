"""Run logs as CSV, Parquet and MAT, for programs that read no MCAP."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import orjson

from trms_cli.core.errors import ConfigurationError, RecordingError
from trms_cli.core.whole_file import whole_file
from trms_cli.recordings.csv_recording import write_csv
from trms_cli.recordings.log_reader import LoggedRun, TopicTable
from trms_cli.recordings.mcap_recording import recording_of

_EVENTS = "/event"
SUFFIXES = {"csv": ".csv", "parquet": ".parquet", "mat": ".mat"}


def export_log(log: LoggedRun, path: Path | str, format: str, *, force: bool = False) -> None:
    """Write a log, complete or not, in another format; the file appears when it is whole.

    ``path``: refused when it exists, unless ``force``. ``format``: "csv": the recording (inputs,
    outputs, references) on the sample grid, as ``trms import`` reads it; "parquet": one wide table
    of all topics, a row per sample time; "mat": a struct per topic.
    """
    path = Path(path)
    if format == "csv":
        write_csv(recording_of(log), path, force=force)
        return
    if format not in SUFFIXES:
        raise ConfigurationError(
            f"the format {format!r} is not known",
            where="--format",
            remedy=f"formats are {', '.join(SUFFIXES)}",
        )
    if not any(len(table) for name, table in log.tables.items() if name != _EVENTS):
        raise RecordingError(
            "the log holds no sample", where=str(log.path), remedy="repeat the run"
        )
    with whole_file(path, force=force) as temporary:
        if format == "parquet":
            _write_parquet(log, temporary)
        else:
            _write_mat(log, temporary)


def _write_parquet(log: LoggedRun, path: Path) -> None:
    """Write one row per sample time; cells of topics silent at that time are null.

    Columns are named ``topic.field``; each field's metadata holds its unit, the table's
    the run's metadata, score and config. Events make no rows: those that happened from a
    sample until the next one are lists in that sample's row, with their own times.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    tables = {name: t for name, t in log.tables.items() if len(t) and name != _EVENTS}
    grid = np.unique(np.concatenate([table.time_ns for table in tables.values()]))
    arrays = [pa.array(grid / 1e9, pa.float64())]
    fields = [pa.field("time", pa.float64(), metadata={"unit": "s"})]

    def add(topic: str, key: str, array: Any, unit: str) -> None:
        label = f"{topic.strip('/').replace('/', '.')}.{key}"
        fields.append(pa.field(label, array.type, metadata={"unit": unit}))
        arrays.append(array)

    for name, table in tables.items():
        # of each time of the grid the last message at that time, or -1
        last = np.searchsorted(table.time_ns, grid, side="right") - 1
        is_there = (last >= 0) & (table.time_ns[np.maximum(last, 0)] == grid)
        row_of_grid = np.where(is_there, last, -1)
        for key, column in table.columns.items():
            add(name, key, _arrow_column(column, row_of_grid), table.units[key])
    events = log.tables.get(_EVENTS)
    if events is not None and len(events):
        rows = np.maximum(np.searchsorted(grid, events.time_ns, side="right") - 1, 0)
        add(_EVENTS, "time", _arrow_lists(events.time, rows, len(grid)), "s")
        for key, column in events.columns.items():
            add(_EVENTS, key, _arrow_lists(column, rows, len(grid)), events.units[key])
    metadata = {
        "trms.run": orjson.dumps(log.run),
        "trms.score": orjson.dumps(log.score),
        "config.yaml": log.config,
    }
    pq.write_table(pa.table(arrays, schema=pa.schema(fields, metadata=metadata)), path)


def _arrow_lists(column: np.ndarray, rows: np.ndarray, count: int) -> Any:
    """Return ``count`` lists of what belongs to each row; null for a row without any."""
    import pyarrow as pa

    cells: list[list[Any] | None] = [None] * count
    number = column.dtype == float
    for row, value in zip(rows.tolist(), column.tolist(), strict=True):
        cell = cells[row] = cells[row] or []
        cell.append(None if number and np.isnan(value) else value)
    return pa.array(cells, pa.list_(pa.float64() if number else pa.string()))


def _arrow_column(column: np.ndarray, row_of_grid: np.ndarray) -> Any:
    import pyarrow as pa

    absent = row_of_grid < 0
    if column.dtype == float:
        values = column[np.maximum(row_of_grid, 0)]
        return pa.array(values, pa.float64(), mask=absent | np.isnan(values))
    cells = [None if row < 0 else column[row] for row in row_of_grid.tolist()]
    holds_arrays = isinstance(column[0], np.ndarray)
    return pa.array(cells, pa.list_(pa.float64()) if holds_arrays else pa.string())


def _write_mat(log: LoggedRun, path: Path) -> None:
    """Write a MATLAB 5 file: ``measurement.time``, ``measurement.alpha_v``, … as columns.

    Units stand in ``measurement.units.alpha_v``, what the run was in ``run``, its config
    as text in ``config``.
    """
    from scipy.io import savemat

    content: dict[str, Any] = {
        _matlab_name(name): _matlab_struct(table)
        for name, table in log.tables.items()
        if len(table)
    }
    content["run"] = {_matlab_name(key): value for key, value in log.run.items()}
    content["config"] = log.config
    content["complete"] = log.complete
    # Opened here, because savemat would add an ending of its own.
    with path.open("wb") as file:
        savemat(file, content, oned_as="column", long_field_names=True, do_compression=True)


def _matlab_struct(table: TopicTable) -> dict[str, Any]:
    struct: dict[str, Any] = {"time": table.time}
    units = {"time": "s"}
    for key, column in table.columns.items():
        name = _matlab_name(key)
        if name == "time":  # the horizon of /prediction has a time of its own
            name = "time_from_now"
        struct[name] = _matlab_value(column)
        units[name] = table.units[key] or "-"
    return {**struct, "units": units}


def _matlab_value(column: np.ndarray) -> np.ndarray:
    """Return numbers as (n,), arrays of one length as (n, k), all else as a cell array."""
    if column.dtype == float or not isinstance(column[0], np.ndarray):
        return column
    if len({len(values) for values in column}) == 1:
        return np.stack(list(column))
    return column


def _matlab_name(name: str) -> str:
    """Return a valid MATLAB identifier, at most 63 characters: /plant/state → plant_state."""
    text = re.sub(r"\W", "_", name.strip("/"), flags=re.ASCII)[:63]
    return text if text[:1].isalpha() else f"x{text}"[:63]
