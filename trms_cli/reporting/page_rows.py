"""Tables of many rows, which a reader sorts and filters in the page."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from urllib.parse import quote

#: Rows that a page lists at most: more are slow to lay out.
MOST_ROWS = 10_000
_LONGEST_CELL = 300


@dataclass(frozen=True)
class RowColumn:
    """A column."""

    title: str  #: Head, with its unit
    key: str  #: Its name in a filter: ``rmse_yaw<0.05``
    number: bool = False  #: Whether it holds numbers, which stand right
    decimals: int | None = None  #: Digits behind the point; None: three digits in all


@dataclass(frozen=True)
class Linked:
    """A cell that leads to a file beside the page."""

    text: str
    target: str = ""  #: Path of the file from the page's folder; "": no link


RowCell = str | float | int | bool | None | Linked


def rows_html(columns: Sequence[RowColumn], rows: Sequence[Sequence[RowCell]]) -> str:
    """Rows of a table's body, everything in them escaped; numbers keep six digits for sorting."""
    return "\n".join(f"<tr>{''.join(map(_cell, columns, row))}</tr>" for row in rows[:MOST_ROWS])


def relative_link(target: str, folder: str) -> str:
    """A file's address from a folder, as a link: never one of another kind than of a file."""
    path = os.path.relpath(target, folder)
    return "./" + quote(path.encode("utf-8", "surrogateescape"))


def _cell(column: RowColumn, value: RowCell) -> str:
    if isinstance(value, Linked):
        text = escape(_cut(value.text))
        if value.target:
            text = f'<a href="{escape(value.target)}">{text}</a>'
        return f"<td>{text}</td>"
    if isinstance(value, bool):
        return f"<td>{'yes' if value else 'no'}</td>"
    missing = value is None or (isinstance(value, float) and math.isnan(value))
    if isinstance(value, (int, float)) and not missing:
        from trms_cli.core import wording

        sort = f' data-v="{value:.6g}"' if math.isfinite(value) else ""
        shown = wording.cell(value) if column.decimals is None else f"{value:.{column.decimals}f}"
        return f'<td class="number"{sort}>{escape(shown)}</td>'
    if missing:
        return f"<td{' class=' + chr(34) + 'number' + chr(34) if column.number else ''}>–</td>"
    return f"<td>{escape(_cut(str(value)))}</td>"


def _cut(text: str) -> str:
    return text if len(text) <= _LONGEST_CELL else text[: _LONGEST_CELL - 1] + "…"
