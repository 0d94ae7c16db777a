"""Puts the figures of a run into the documentation: ``python -m benchmarks --publish``."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.document import Table, cell_text, verdict
from experiments.provenance import record_publication

PAGE = Path(__file__).resolve().parent.parent / "docs" / "benchmarks.md"
_BEGIN, _END = "<!-- figures: begin -->", "<!-- figures: end -->"


def publish(
    tables: Sequence[Table], machine: Mapping[str, Any], out: Path, page: Path = PAGE
) -> None:
    """Rewrite the page between its marks, and copy the figures that the run drew.

    Raises
    ------
    ValueError
        If the page has no marks.
    """
    text = page.read_text(encoding="utf-8")
    before, begin, rest = text.partition(_BEGIN)
    _, end, after = rest.partition(_END)
    if not (begin and end):
        raise ValueError(f"{page} has no {_BEGIN} … {_END}")
    versions = ", ".join(f"{name} {number}" for name, number in machine["versions"].items())
    parts = [
        f"Taken on {machine['processor']}, {machine['cores']} cores, load {machine['load_1min']} "
        f"at the start, {machine['platform']}, Python {machine['python']}, {machine['compiler']}; "
        f"{versions}.",
        *(markdown(table) for table in tables),
    ]
    page.write_text(
        before + begin + "\n\n" + "\n\n".join(parts) + "\n\n" + end + after, encoding="utf-8"
    )
    for figure in sorted(out.glob("benchmark_*.png")):
        folder = page.parent / "figures"
        folder.mkdir(exist_ok=True)
        shutil.copyfile(figure, folder / figure.name)
    record_publication(page, ["figures"])


def markdown(table: Table) -> str:
    """A table with its title and notes."""
    columns = table.shown_columns()
    has_limits = any("met" in row for row in table.rows)
    titles = [f"{c.title} [{c.unit}]" if c.unit else c.title for c in columns]
    lines = [f"**{table.title}**", ""]
    lines.append(_row([*titles, *(["limit"] if has_limits else [])]))
    lines.append(_row(["---"] * (len(columns) + has_limits)))
    for row in table.rows:
        cells = [cell_text(row.get(column.key), column.digits) for column in columns]
        lines.append(_row([*cells, *([verdict(row)] if has_limits else [])]))
    for note in table.notes:
        lines += ["", f"{note[0].upper()}{note[1:]}"]
    return "\n".join(lines)


def _row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"
