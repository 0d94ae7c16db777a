"""The table of ``trms runs``: as wide as the terminal, or aligned and whole for a pipe."""

import csv
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TextIO

from trms_cli.core import wording
from trms_cli.core.findings import Cell, Datum, Table, Value
from trms_cli.runs.columns import IndexColumn
from trms_cli.runs.query import QueryResult
from trms_cli.runs.table import HEADINGS, differing_keys, visible_columns

_NOTHING = "–"
_MOST_TOLD = 200  # characters of a line on trouble


def print_runs(
    result: QueryResult, mentioned_columns: Sequence[str] | None, *, filtered: bool
) -> None:
    """Print the table, and a line on how much of all it is.

    `mentioned_columns`: those that were asked about, shown beside the usual ones. None: all that
    `result` has are shown, and no others.
    """
    if not result.runs:
        print(_why_nothing(result, filtered))
        return
    names = list(result.columns)
    if mentioned_columns is not None:
        names = visible_columns(result, mentioned_columns)
        names += differing_keys(result, names)
    if sys.stdout.isatty():
        _print_table(result, names)
    else:
        _print_plain(result, names)
    if sys.stdout.isatty():
        print(_count(result, filtered))


def print_unreadable(result: QueryResult) -> None:
    """Print the logs that could not be read, a line each."""
    for log, problem in result.unreadable:
        print(f"{_clean(log)}: {_clean(problem)}")
    if not result.unreadable:
        print("all logs could be read")


def say_remarks(result: QueryResult, *, unreadable: bool) -> None:
    """Say what limits the answer, apart from it."""
    for remark in result.remarks:
        sys.stderr.write(f"note   {_clean(remark)}\n")
    if result.unreadable and unreadable:
        log, problem = result.unreadable[0]
        count = len(result.unreadable)
        logs = wording.count(count, "log")
        first = _cut(f"{_clean(_near(log))}: {_clean(problem)}", _MOST_TOLD)
        more = "" if count == 1 else " (all: trms runs --unreadable)"
        sys.stderr.write(f"note   {logs} could not be read: {first}{more}\n")


def _print_plain(result: QueryResult, names: Sequence[str]) -> None:
    """Aligned columns with two spaces between them: nothing is cut or left out."""
    rows = [list(names)]
    rows += [
        [_text(run[name], result.columns[name], whole=True) for name in names]
        for run in result.runs
    ]
    widths = [max(len(row[i]) for row in rows) for i in range(len(names))]
    numbers = [result.columns[name].kind not in ("text", "truth") for name in names]
    for row in rows:
        cells = (
            text.rjust(width) if number else text.ljust(width)
            for text, width, number in zip(row, widths, numbers, strict=True)
        )
        print("  ".join(cells).rstrip())


def _print_table(result: QueryResult, names: Sequence[str]) -> None:
    """As wide as the terminal: names are folded, and columns parted into tables of their own."""
    from trms_cli.reporting.screen import show_table, terminal

    rows: list[list[Cell]] = []
    for run in result.runs:
        ended = run.get("outcome", "completed") == "completed"
        cells = [_cell(run[name], result.columns[name]) for name in names]
        rows.append([Datum(cell, "" if ended else "doubtful") for cell in cells])
    heads = [wording.with_unit(HEADINGS.get(n, n), result.columns[n].unit) for n in names]
    show_table(terminal(), Table(heads, rows), len(rows))


def _cell(value: Any, column: IndexColumn) -> Value:
    """Numbers as they are, which stand right; what is not there as text where others are text."""
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return value if number or (value is None and column.is_number) else _text(value, column)


def _text(value: Any, column: IndexColumn, *, whole: bool = False) -> str:
    """A cell; a path is short where the working folder is above it."""
    if value is None or value == "":
        return _NOTHING
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        if value != 0 and not 1e-3 <= abs(value) < 1e5:
            return f"{value:.2e}"
        return f"{value:.4g}"
    text = _near(str(value)) if column.name in ("path", "log") else str(value)
    return _clean(text) if whole else _cut(_clean(text), 200 if column.name == "path" else 60)


def _near(path: str) -> str:
    """A path from the working folder on, if that is above it."""
    here = os.path.realpath(os.curdir).rstrip(os.sep) + os.sep
    return path[len(here) :] if path.startswith(here) and len(path) > len(here) else path


def _clean(text: str) -> str:
    """Without what would steer a terminal: a log's words may be a stranger's."""
    return "".join(c if c.isprintable() else "�" for c in text)


def _cut(text: str, most: int) -> str:
    return text if len(text) <= most else f"{text[: most - 1]}…"


def _count(result: QueryResult, filtered: bool) -> str:
    count = (
        f"{result.matching} of {result.of} runs" if filtered else wording.count(result.of, "run")
    )
    if len(result.runs) < result.matching:
        return f"{len(result.runs)} of {count} (all: --limit 0)"
    return count


def _why_nothing(result: QueryResult, filtered: bool) -> str:
    if result.of and filtered:
        return f"none of the {result.of} runs matches"
    where = " and ".join(_clean(folder) for folder in result.folders)
    if not where:
        return "no run is known: make one by `trms run`"
    return f"no run under {where}: another folder by --in FOLDER, every known run by --all"


SCHEMA = "trms.runs/1"


def document(result: QueryResult, filter: str) -> dict[str, Any]:
    """``trms.runs/1``: the runs, the units of their columns, and what limits the answer."""
    return {
        "schema": SCHEMA,
        "filter": filter,
        "folders": list(result.folders),
        "matching": result.matching,
        "of": result.of,
        "units": {name: column.unit for name, column in result.columns.items() if column.unit},
        "runs": result.runs,
        "unreadable": [{"log": log, "problem": problem} for log, problem in result.unreadable],
        "remarks": list(result.remarks),
    }


def write_csv(result: QueryResult, path: Path, *, force: bool) -> None:
    """Write a header of names and a line a run; ``-`` prints it. Empty cells for what is not there.

    Raises RecordingError if there is such a file and not `force`, or it cannot be written.
    """
    if path == Path("-"):
        _write_lines(result, sys.stdout)
        return
    from trms_cli.core.whole_file import whole_file

    with (
        whole_file(path, force=force) as temporary,
        temporary.open("w", newline="", encoding="utf-8", errors="backslashreplace") as file,
    ):
        _write_lines(result, file)


def _write_lines(result: QueryResult, file: TextIO) -> None:
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(result.columns)
    for run in result.runs:
        writer.writerow([_csv_cell(run[name]) for name in result.columns])


def _csv_cell(value: Any) -> Any:
    if value is None:
        return ""
    return ("yes" if value else "no") if isinstance(value, bool) else value
