"""Small tables for notebooks; everything in them is escaped."""

import base64
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from trms_cli.core import wording
from trms_cli.core.findings import Findings, plain

_LEFT = "text-align:left"


def table(head: Sequence[str], rows: Iterable[Sequence[Any]], caption: str = "") -> str:
    """A table; the first column stands left, numbers are rounded to three digits."""
    top = _row("th", head)
    body = "".join(f"<tr>{_row('td', row)}</tr>" for row in rows)
    title = f'<caption style="{_LEFT}">{escape(caption)}</caption>' if caption else ""
    return f"<table>{title}<thead><tr>{top}</tr></thead><tbody>{body}</tbody></table>"


def paragraph(text: str, *, bold: bool = False) -> str:
    """A line of text."""
    inner = escape(text)
    return f"<p>{f'<b>{inner}</b>' if bold else inner}</p>"


def picture(png: bytes, *, width: int = 720) -> str:
    """A picture that is part of the page."""
    data = base64.b64encode(png).decode("ascii")
    return f'<img src="data:image/png;base64,{data}" style="max-width:{width}px;width:100%">'


def files(paths: Mapping[str, Path | None]) -> str:
    """Where things are."""
    entries = [(name, str(path)) for name, path in paths.items() if path is not None]
    lines = "<br>".join(f"{escape(n)}: <code>{escape(p)}</code>" for n, p in entries)
    return f"<p>{lines}</p>"


def _row(tag: str, cells: Sequence[Any]) -> str:
    styles = [_LEFT, *[""] * len(cells)]
    pairs = zip(styles, cells, strict=False)
    return "".join(f'<{tag} style="{style}">{_cell(cell)}</{tag}>' for style, cell in pairs)


def _cell(value: Any) -> str:
    if value is None or (isinstance(value, float) and value != value):
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.3g}"
    return escape(str(value))


def findings(result: Findings, headline: str, paths: Mapping[str, Path | None]) -> str:
    """What a study has to tell, with the tables of a terminal and what was written."""
    parts = [paragraph(headline, bold=True)]
    lead = [sentence.replace("**", "") for sentence in result.lead]
    parts += [paragraph(sentence) for sentence in lead if sentence != headline]
    parts += [paragraph(f"Note: {warning}") for warning in result.warnings]
    for one in result.tables:
        if one.on_screen and one.rows:
            rows = [[wording.cell(plain(cell)) for cell in row] for row in one.rows]
            parts.append(table(one.columns, rows, one.caption))
    return "".join([*parts, files(paths)])
