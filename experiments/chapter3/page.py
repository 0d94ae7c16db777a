"""Writes the study's tables into its page, between marks that a reader does not see."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

from experiments.provenance import record_publication
from trms_cli.core.errors import RecordingError


def fill_tables(text: str, tables: Mapping[str, str], where: str) -> str:
    """The page with each table between its marks ``<!-- table NAME -->`` and ``<!-- end -->``.

    Raises RecordingError if a table has no place in the page.
    """
    for name, table in tables.items():
        marks = re.compile(rf"(<!-- table {re.escape(name)} -->\n).*?(<!-- end -->)", re.DOTALL)
        if not marks.search(text):
            raise RecordingError(
                f"no place for the table {name!r}",
                where=where,
                remedy=f"put <!-- table {name} --> and <!-- end --> where it belongs",
            )
        text = marks.sub(lambda match, t=table: f"{match[1]}{t}\n{match[2]}", text)  # type: ignore[misc]
    return text


def write_page(path: Path, tables: Mapping[str, str]) -> None:
    """Renew the tables of a page."""
    path.write_text(
        fill_tables(path.read_text(encoding="utf-8"), tables, str(path)), encoding="utf-8"
    )
    record_publication(path, tables)
