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


def print_runs(found: QueryResult, told: Sequence[str] | None, *, filtered: bool) -> None:
    """Print the table, and a line on how much of all it is.

    `told`: columns that were asked about, shown beside the usual ones. None: all that `found` has
    are shown, and no others.
    """
    if not found.runs:
        print(_why_nothing(found, filtered))
        return
    names = list(found.columns)
    if told is not None:
        names = _chosen(found, told)
        names += _settings(found, names)
    if sys.stdout.isatty():
        _print_table(found, names)
    else:
        _print_plain(found, names)
    if sys.stdout.isatty():
        print(_count(found, filtered))


def print_unreadable(found: QueryResult) -> None:
    """Print the logs that could not be read, a line each."""
    for log, problem in found.unreadable:
        print(f"{_clean(log)}: {_clean(problem)}")
    if not found.unreadable:
        print("all logs could be read")


def say_remarks(found: QueryResult, *, unreadable: bool) -> None:
    """Say what limits the answer, apart from it."""
    for remark in found.remarks:
        sys.stderr.write(f"note   {_clean(remark)}\n")
    if found.unreadable and unreadable:
        log, problem = found.unreadable[0]
        count = len(found.unreadable)
        logs = wording.count(count, "log")
        first = _cut(f"{_clean(_near(log))}: {_clean(problem)}", _MOST_TOLD)
        more = "" if count == 1 else " (all: trms runs --unreadable)"
        sys.stderr.write(f"note   {logs} could not be read: {first}{more}\n")


def _chosen(found: QueryResult, told: Sequence[str]) -> list[str]:
    """The columns worth showing: those asked for, and the usual ones that say something."""
    asked = {ALIASES.get(name, name) for name in told}
    chosen: dict[str, str] = {}  # by the column's own name: an alias is shown once
    for name in found.columns:
        own = ALIASES.get(name, name)
        if own in chosen or (own == OVERRIDES and own not in asked):
            continue
        values = {run[name] for run in found.runs}
        same = len(values - {None}) < 2 and own in _IF_DIFFERENT
        usual_end = own == "outcome" and values == {"completed"}
        empty = values <= {None, ""}
        if own in asked or not (same or usual_end or empty):
            chosen[own] = name
    return list(chosen.values())


#: What nobody typed: a sweep gives it to its runs.
_SET_BY_SWEEPS = ("picture", "sim.scene_every")


def _settings(found: QueryResult, names: Sequence[str]) -> list[str]:
    """Keys that were typed, and in which the runs differ: else the runs of a sweep look alike."""
    from trms_cli.runs.entry import typed_overrides

    given = [typed_overrides(json.loads(run.get(OVERRIDES) or "[]")) for run in found.runs]
    settings = []
    for key in dict.fromkeys(key for keys in given for key in keys):
        own = ALIASES.get(key, key)
        values = {str(keys.get(key)) for keys in given}
        if (
            key not in _SET_BY_SWEEPS
            and ("." in key or "@" in key)
            and own not in found.columns
            and len(values) > 1
        ):
            settings.append(key)
            found.columns[key] = IndexColumn(key, "any")
            for run, keys in zip(found.runs, given, strict=True):
                run[key] = keys.get(key)
    return [key for key in settings if key not in names][:_MOST_SETTINGS]


def _print_plain(found: QueryResult, names: Sequence[str]) -> None:
    """Aligned columns with two spaces between them: nothing is cut or left out."""
    rows = [list(names)]
    rows += [
        [_text(run[name], found.columns[name], whole=True) for name in names] for run in found.runs
    ]
    widths = [max(len(row[i]) for row in rows) for i in range(len(names))]
    numbers = [found.columns[name].kind not in ("text", "truth") for name in names]
    for row in rows:
        cells = (
            text.rjust(width) if number else text.ljust(width)
            for text, width, number in zip(row, widths, numbers, strict=True)
        )
        print("  ".join(cells).rstrip())


def _print_table(found: QueryResult, names: Sequence[str]) -> None:
    """As wide as the terminal: names are folded, and columns parted into tables of their own."""
    from trms_cli.reporting.screen import show_table, terminal

    rows: list[list[Cell]] = []
    for run in found.runs:
        ended = run.get("outcome", "completed") == "completed"
        cells = [_cell(run[name], found.columns[name]) for name in names]
        rows.append([Datum(cell, "" if ended else "doubtful") for cell in cells])
    heads = [wording.with_unit(_HEADINGS.get(n, n), found.columns[n].unit) for n in names]
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


def _count(found: QueryResult, filtered: bool) -> str:
    count = f"{found.matching} of {found.of} runs" if filtered else wording.count(found.of, "run")
    if len(found.runs) < found.matching:
        return f"{len(found.runs)} of {count} (all: --limit 0)"
    return count


def _why_nothing(found: QueryResult, filtered: bool) -> str:
    if found.of and filtered:
        return f"none of the {found.of} runs matches"
    where = " and ".join(_clean(folder) for folder in found.folders)
    if not where:
        return "no run is known: make one by `trms run`"
    return f"no run under {where}: another folder by --in FOLDER, every known run by --all"


SCHEMA = "trms.runs/1"


def document(found: QueryResult, filter: str) -> dict[str, Any]:
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


def write_csv(found: QueryResult, path: Path, *, force: bool) -> None:
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


def write_parquet(found: QueryResult, path: Path, *, force: bool) -> None:
    """Write a table with types, and units in the metadata of its fields.

    Raises RecordingError if there is such a file and not `force`, or it cannot be written.
    """
    from trms_cli.recordings.output_file import write_parquet
    from trms_cli.runs.frame import table_of

    write_parquet(table_of(found), path, force=force)


def _write_lines(found: QueryResult, file: TextIO) -> None:
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(found.columns)
    for run in found.runs:
        writer.writerow([_csv_cell(run[name]) for name in found.columns])


def _csv_cell(value: Any) -> Any:
    if value is None:
        return ""
    return ("yes" if value else "no") if isinstance(value, bool) else value
