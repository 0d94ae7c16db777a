"""The table of ``trms runs``: as wide as the terminal, or aligned and whole for a pipe."""

import csv
import json
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TextIO

from trms_cli.core import wording
from trms_cli.core.findings import Cell, Datum, Table, Value
from trms_cli.runs.columns import ALIASES, IndexColumn
from trms_cli.runs.query import QueryResult

#: Read with the usual columns, for the settings in which runs differ; not shown itself.
OVERRIDES = "overrides"
_MOST_SETTINGS = 6
#: Columns of the table, in their order.
USUAL = (
    "path",
    "time",
    "controller",
    "observer",
    "ref",
    "model",
    "plant",
    "effects",
    "faults",
    "seed",
    "duration",
    "outcome",
    "rmse_alpha_v",
    "rmse_alpha_h",
    "rmse_*",
    "total_variation",
    "solve_p99",
    "failures",
    "deadline_misses",
)
#: Worth a column only where runs differ in them.
_IF_DIFFERENT = frozenset(USUAL) - {
    "path",
    "time",
    "controller",
    "rmse_alpha_v",
    "rmse_alpha_h",
    "total_variation",
    "solve_p99",
}
_HEADINGS = {
    "path": "run",
    "rmse_alpha_v": "rmse pitch",
    "rmse_alpha_h": "rmse yaw",
    "total_variation": "Σ|Δu|",
    "solve_p99": "step p99",
    "deadline_misses": "misses",
}
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
        names = _visible_columns(result, mentioned_columns)
        names += _settings(result, names)
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


def _visible_columns(result: QueryResult, mentioned_columns: Sequence[str]) -> list[str]:
    """The columns worth showing: those asked for, and the usual ones that say something."""
    requested_names = {ALIASES.get(name, name) for name in mentioned_columns}
    names_by_column: dict[str, str] = {}  # by the column's own name: an alias is shown once
    for name in result.columns:
        own = ALIASES.get(name, name)
        if own in names_by_column or (own == OVERRIDES and own not in requested_names):
            continue
        values = {run[name] for run in result.runs}
        same = len(values - {None}) < 2 and own in _IF_DIFFERENT
        usual_end = own == "outcome" and values == {"completed"}
        empty = values <= {None, ""}
        if own in requested_names or not (same or usual_end or empty):
            names_by_column[own] = name
    return list(names_by_column.values())


#: What nobody typed: a sweep gives it to its runs.
_SET_BY_SWEEPS = ("picture", "sim.scene_every", "sim.estimate_every")


def _settings(result: QueryResult, names: Sequence[str]) -> list[str]:
    """Keys that were typed, and in which the runs differ: else the runs of a sweep look alike."""
    from trms_cli.runs.entry import typed_overrides

    overrides = [typed_overrides(json.loads(run.get(OVERRIDES) or "[]")) for run in result.runs]
    settings = []
    for key in dict.fromkeys(key for keys in overrides for key in keys):
        own = ALIASES.get(key, key)
        values = {str(keys.get(key)) for keys in overrides}
        if (
            key not in _SET_BY_SWEEPS
            and ("." in key or "@" in key)
            and own not in result.columns
            and len(values) > 1
        ):
            settings.append(key)
            result.columns[key] = IndexColumn(key, "any")
            for run, keys in zip(result.runs, overrides, strict=True):
                run[key] = keys.get(key)
    return [key for key in settings if key not in names][:_MOST_SETTINGS]


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
    heads = [wording.with_unit(_HEADINGS.get(n, n), result.columns[n].unit) for n in names]
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
