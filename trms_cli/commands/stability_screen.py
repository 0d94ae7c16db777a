"""What a person sees of a study of stability: the answer, tables and files."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from trms_cli.core.findings import Findings, Judged, Table
from trms_cli.reporting.page import shown_cell

if TYPE_CHECKING:
    from trms_cli.composition.composer import Composition

_COLOURS = {"good": "green", "bad": "red", "doubtful": "yellow", "": ""}
#: Rows of a table on the screen; the page and the document have them all.
_MOST_ROWS = 16
#: Of the answer to a job of a sweep.
_SENTENCES_OF_A_JOB = 4
_WIDTH = 110


def say_finished(
    composition: Composition,
    document: Mapping[str, Any],
    findings: Findings,
    path: Path,
    page: Path | None,
    spent: float,
) -> None:
    """The answer, its tables, and the files; a few lines for a job of a sweep."""
    if composition.job is not None:
        what = " ".join(composition.overrides)
        first, *more = document["lead"][:_SENTENCES_OF_A_JOB]
        print(f"{composition.job:>4}  {what}  {first}")
        for sentence in more:
            print(f"      {sentence}")
        return
    from rich.console import Console

    # Into a file or a pipe: as wide as the tables like it.
    # in a notebook too by way of standard output, where whoever calls from Python hears it
    width = None if sys.stdout.isatty() else _WIDTH
    console = Console(width=width, force_jupyter=False)

    def say(text: str, style: str = "") -> None:
        console.print(text, style=style, highlight=False, markup=False, soft_wrap=False)

    say(f"stability  {document['title'].lower()} · {subject_words(document)}")
    console.print()
    for sentence in document["lead"]:
        say(sentence, "bold")
    console.print()
    for table in findings.tables:
        if table.on_screen and table.rows:
            _print_table(console, table)
    for warning in document["warnings"]:
        say(f"! {warning}", "yellow")
    if document["warnings"]:
        console.print()
    print(f"time       {spent:.1f} s")
    print(f"figures    {path}")
    if page is not None:
        print(f"page       {page}")


def subject_words(document: Mapping[str, Any]) -> str:
    """``newtonian with pitch_coulomb_friction, under pid with full_state``."""
    words = str(document["model"])
    if document["effects"]:
        words += f" with {', '.join(document['effects'])}"
    if document["loop"]:
        words += f", under {document['loop']['controller']} with {document['loop']['observer']}"
    return words


def _print_table(console: Any, table: Table) -> None:
    from rich.box import SIMPLE_HEAD
    from rich.markup import escape
    from rich.table import Table as Grid

    grid = Grid(
        box=SIMPLE_HEAD,
        pad_edge=False,
        padding=(0, 1),
        caption=escape(table.caption) or None,
        caption_style="dim",
        caption_justify="left",
    )
    numeric = [
        all(isinstance(_value(row[i]), int | float | None) for row in table.rows)
        for i in range(len(table.columns))
    ]
    for i, column in enumerate(table.columns):
        style = "bold cyan" if i < table.heads else "bold"
        grid.add_column(
            escape(column), header_style=style, justify="right" if numeric[i] else "left"
        )
    for row in table.rows[:_MOST_ROWS]:
        grid.add_row(*(_cell(cell) for cell in row))
    console.print(grid, highlight=False)
    more = len(table.rows) - _MOST_ROWS
    if more > 0:
        console.print(f"… {more} more rows in the document and on the page", style="dim")
    console.print()


def _value(cell: Any) -> Any:
    return cell.value if isinstance(cell, Judged) else cell


def _cell(cell: Any) -> str:
    from rich.markup import escape

    text = escape(shown_cell(_value(cell)))
    colour = _COLOURS[cell.judgement] if isinstance(cell, Judged) else ""
    return f"[{colour}]{text}[/{colour}]" if colour else text
