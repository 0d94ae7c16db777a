"""Tables that a study writes into its page."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from experiments.provenance import record_publication
from trms_cli.core.errors import ConfigurationError


def write_tables(page: Path, tables: Mapping[str, str]) -> None:
    """Put each table between ``<!-- NAME: begin -->`` and ``<!-- NAME: end -->``.

    The revision is put down in ``docs/provenance.json``, for the page's new pictures as well.

    Raises ConfigurationError if the page has lost a mark.
    """
    text = page.read_text(encoding="utf-8")
    for name, table in tables.items():
        begin, end = f"<!-- {name}: begin -->", f"<!-- {name}: end -->"
        before, opening, rest = text.partition(begin)
        _, closing, after = rest.partition(end)
        if not (opening and closing):
            raise ConfigurationError(
                f"the page has lost its marks {begin} … {end}", where=str(page), remedy="add them"
            )
        text = f"{before}{begin}\n{table}\n{end}{after}"
    page.write_text(text, encoding="utf-8")
    record_publication(page, tables)


def write_alone(folder: Path, tables: Mapping[str, str]) -> None:
    """All tables under their names into ``tables.md`` of a folder."""
    words = "\n\n".join(f"## {name}\n\n{table}" for name, table in tables.items())
    (folder / "tables.md").write_text(words + "\n", encoding="utf-8")


def markdown(rows: Sequence[Sequence[str]]) -> str:
    """A table, its head in the first row."""
    lines = ["| " + " | ".join(rows[0]) + " |", "|" + "---|" * len(rows[0])]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in rows[1:]])


def print_tables(tables: Mapping[str, Sequence[Sequence[str]]], width: int) -> None:
    """For a person; ``width``: characters of a line where no terminal has its own."""
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table

    console = Console()
    if not console.is_terminal:
        console = Console(width=width)
    for name, rows in tables.items():
        table = Table(title=name, title_justify="left", box=SIMPLE_HEAD)
        for i, head in enumerate(rows[0]):
            table.add_column(head, justify="left" if i < 2 else "right")
        for row in rows[1:]:
            table.add_row(*row)
        console.print(table)


def number(value: float, digits: int = 3) -> str:
    """Significant digits; a dash for what does not exist."""
    if math.isnan(value):
        return "–"
    if value == int(value) and abs(value) < 1e6:
        return str(int(value))
    if abs(value) < 1e-3:
        return f"{value:.1e}"
    if abs(value) >= 10**digits:
        return f"{value:.0f}"
    return f"{value:.{digits}g}"
