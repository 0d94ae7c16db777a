"""What objects show of themselves in a notebook: findings, as pages have them."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from trms_cli.core.findings import Cell, Findings, Section, Table


def table(title: str, head: Sequence[str], rows: Iterable[Sequence[Any]]) -> Findings:
    """A table and its title; what is no number, text or truth value is told as text."""
    cells = [[_cell(value) for value in row] for row in rows]
    return Findings(title, [], [Section("", blocks=[Table(head, cells)])])


def _cell(value: Any) -> Cell:
    if value is None or isinstance(value, str | int | float):
        return None if isinstance(value, float) and value != value else value
    return str(value)


def view(
    findings: Findings,
    pictures: Sequence[bytes] = (),
    paths: Mapping[str, Path | None] | None = None,
) -> str:
    """Findings as HTML, with pictures (PNG) and where files are."""
    from trms_cli.reporting.page import fragment_html

    files = {name: f"`{path}`" for name, path in (paths or {}).items() if path is not None}
    return fragment_html(replace(findings, facts=files), pictures)


def on_screen(findings: Findings) -> Findings:
    """Findings with the tables of a terminal: those that tell most."""
    sections = [
        replace(
            section,
            blocks=[
                block
                for block in section.blocks
                if not isinstance(block, Table) or (block.on_screen and block.rows)
            ],
        )
        for section in findings.sections
    ]
    return replace(findings, sections=[section for section in sections if section.blocks])
