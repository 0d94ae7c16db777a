"""The answers of ``trms runs`` as JSON, CSV and Parquet."""

from __future__ import annotations

import csv
import json
import sys
from pathlib import Path
from typing import Any, TextIO

from trms_cli.runs.finding import Found

SCHEMA = "trms.runs/1"


def print_json(found: Found, filter: str) -> None:
    """Print ``trms.runs/1``."""
    json.dump(document(found, filter), sys.stdout, indent=2, ensure_ascii=False, allow_nan=False)
    sys.stdout.write("\n")


def document(found: Found, filter: str) -> dict[str, Any]:
    """``trms.runs/1``: the runs, the units of their columns, and what limits the answer."""
    return {
        "schema": SCHEMA,
        "filter": filter,
        "folders": list(found.folders),
        "matching": found.matching,
        "of": found.of,
        "units": {name: column.unit for name, column in found.columns.items() if column.unit},
        "runs": found.runs,
        "unreadable": [{"log": log, "problem": problem} for log, problem in found.unreadable],
        "remarks": list(found.remarks),
    }


def write_csv(found: Found, path: Path, *, force: bool) -> None:
    """Write a header of names and a line a run; ``-`` prints it. Empty cells for what is not there.

    Raises RecordingError if there is such a file and not `force`, or it cannot be written.
    """
    if path == Path("-"):
        _write_lines(found, sys.stdout)
        return
    from trms_cli.recordings.output_file import whole_file

    with (
        whole_file(path, force=force) as temporary,
        temporary.open("w", newline="", encoding="utf-8", errors="backslashreplace") as file,
    ):
        _write_lines(found, file)


def write_parquet(found: Found, path: Path, *, force: bool) -> None:
    """Write a table with types, and units in the metadata of its fields.

    Raises RecordingError if there is such a file and not `force`, or it cannot be written.
    """
    from trms_cli.recordings.figure_table import write_parquet
    from trms_cli.runs.frame import table_of

    write_parquet(table_of(found), path, force=force)


def _write_lines(found: Found, file: TextIO) -> None:
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(found.columns)
    for run in found.runs:
        writer.writerow([_cell(run[name]) for name in found.columns])


def _cell(value: Any) -> Any:
    if value is None:
        return ""
    return ("yes" if value else "no") if isinstance(value, bool) else value
