"""Tables that a study writes into its page."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

from trms_cli.core.errors import ConfigurationError


def write_tables(page: Path, tables: Mapping[str, str]) -> None:
    """Put each table between ``<!-- NAME: begin -->`` and ``<!-- NAME: end -->``.

    Raises ConfigurationError if the page has lost a mark.
    """
    text = page.read_text(encoding="utf-8")
    for name, table in tables.items():
        begin, end = f"<!-- {name}: begin -->", f"<!-- {name}: end -->"
        before, found, rest = text.partition(begin)
        _, closed, after = rest.partition(end)
        if not (found and closed):
            raise ConfigurationError(
                f"the page has lost its marks {begin} … {end}", where=str(page), remedy="add them"
            )
        text = f"{before}{begin}\n{table}\n{end}{after}"
    page.write_text(text, encoding="utf-8")


def write_alone(folder: Path, tables: Mapping[str, str]) -> None:
    """All tables under their names into ``tables.md`` of a folder."""
    words = "\n\n".join(f"## {name}\n\n{table}" for name, table in tables.items())
    (folder / "tables.md").write_text(words + "\n", encoding="utf-8")


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
