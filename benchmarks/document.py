"""What a benchmark says: tables for a person, one JSON document ``trms.bench/1`` for programs."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

SCHEMA = "trms.bench/1"

Value = str | float | int | bool | None


@dataclass(frozen=True)
class Column:
    """A column of a table."""

    key: str  #: In the JSON document
    title: str  #: In the printed table; the unit stands behind it
    unit: str = ""
    digits: int = 3  #: Significant digits printed; the document has them all


@dataclass
class Table:
    """Rows under columns; a cell that a row lacks stays empty.

    A row may say by ``limit`` and ``value`` (keys of its cells) that it has a limit: see
    :meth:`add`.
    """

    key: str
    title: str
    columns: Sequence[Column]
    notes: list[str] = field(default_factory=list)
    rows: list[dict[str, Value]] = field(default_factory=list)

    def add(self, **cells: Value) -> None:
        """Append a row; cells by column key, and ``met`` for whether the row's limit is held."""
        column_keys = {column.key for column in self.columns} | {"met"}
        unknown = set(cells) - column_keys
        if unknown:
            raise KeyError(f"table {self.key!r} has no column {sorted(unknown)}")
        self.rows.append(cells)

    def add_limited(self, value_key: str, value: float, limit: float, **cells: Value) -> None:
        """Append a row whose value must not exceed a limit: limit, ratio and verdict follow."""
        self.add(
            **{value_key: value},
            limit=limit,
            ratio=value / limit,
            met=bool(value <= limit),
            **cells,
        )

    def shown_columns(self) -> list[Column]:
        """Columns in which any row has something."""
        return [c for c in self.columns if any(row.get(c.key) is not None for row in self.rows)]

    @property
    def misses(self) -> list[dict[str, Value]]:
        """Rows that do not hold their limit."""
        return [row for row in self.rows if row.get("met") is False]


#: Columns of every table with limits.
LIMIT = (Column("limit", "limit"), Column("ratio", "of the limit", "", 2))


def print_table(table: Table) -> None:
    """Print for a person."""
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table as RichTable

    columns = table.shown_columns()
    printed = RichTable(
        title=table.title, title_justify="left", title_style="bold", box=SIMPLE_HEAD, padding=(0, 1)
    )
    for index, column in enumerate(columns):
        title = f"{column.title}\n{column.unit}" if column.unit else column.title
        words = any(isinstance(row.get(column.key), str) for row in table.rows)
        printed.add_column(title, justify="left" if words else "right", no_wrap=index < 2)
    has_limits = any("met" in row for row in table.rows)
    if has_limits:
        printed.add_column("")
    for row in table.rows:
        cells = [cell_text(row.get(column.key), column.digits) for column in columns]
        if has_limits:
            cells.append(f"[green]{verdict(row)}" if row.get("met") else f"[red]{verdict(row)}")
        printed.add_row(*cells)
    console = Console()
    if not console.is_terminal:
        console = Console(width=120)
    console.print()
    console.print(printed)
    for note in table.notes:
        console.print(f"  {note}", style="dim", highlight=False)


def document(machine: Mapping[str, Any], command: str, tables: Sequence[Table]) -> dict[str, Any]:
    """The tables as one document; figures that do not exist are null."""
    return {
        "schema": SCHEMA,
        "command": command,
        "machine": dict(machine),
        "tables": {
            table.key: {
                "title": table.title,
                "units": {column.key: column.unit for column in table.columns},
                "rows": [{key: _plain(value) for key, value in row.items()} for row in table.rows],
                "notes": list(table.notes),
            }
            for table in tables
        },
    }


def write_document(content: Mapping[str, Any], path: Path) -> None:
    """Write as JSON."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(
        json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False) + "\n", encoding="utf-8"
    )


def _plain(value: Value) -> Value:
    if isinstance(value, bool) or value is None or isinstance(value, str):
        return value
    number = float(value)
    if not math.isfinite(number):
        return None
    return int(number) if isinstance(value, int) else number


def verdict(row: Mapping[str, Value]) -> str:
    """Whether a row holds its limit; empty for a row without one."""
    if row.get("met") is None:
        return ""
    return "met" if row["met"] else "missed"


def cell_text(value: Value, digits: int) -> str:
    """A cell for a person."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, str | int):
        return str(value)
    if isinstance(value, float) and not math.isfinite(value):
        return "never" if value == math.inf else "–"
    if value == 0:
        return "0"
    if abs(value) < 1e-4:
        return f"{value:.1e}"
    places = max(0, digits - 1 - math.floor(math.log10(abs(value))))
    return f"{value:.{places}f}"
