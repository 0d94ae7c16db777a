"""The page of a study of stability, and its figures as files."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from trms_cli.commands.stability_screen import subject_words
from trms_cli.core.chart import Chart
from trms_cli.core.findings import Findings, Judged, Table
from trms_cli.reporting.chart_picture import picture_of
from trms_cli.reporting.page import Marked, Page
from trms_cli.reporting.style import house_style, save_png


def write_page(
    document: Mapping[str, Any], findings: Findings, folder: Path, name: str
) -> Path | None:
    """Write the page and a PNG a figure; None, and a word on standard error, if that fails."""
    path = folder / name
    try:
        page = page_of(document, findings, folder)
        page.write(path)
    except OSError as error:  # the numbers are safe: this much may fail
        sys.stderr.write(f"no page: {error.strerror or error}\n")
        return None
    return path


def page_of(document: Mapping[str, Any], findings: Findings, folder: Path) -> Page:
    """The page, ready to be written; its figures are written into the folder."""
    page = Page(
        f"{document['title']}: {subject_words(document)}", document["lead"], _facts(document)
    )
    if document["warnings"]:
        page.section("What limits this")
        page.points([Marked(warning, "doubtful") for warning in document["warnings"]])
    with house_style():
        for section in findings.sections:
            page.section(section.heading, list(section.text))
            for block in section.blocks:
                if isinstance(block, Table):
                    page.table(
                        block.columns,
                        [_row(row) for row in block.rows],
                        block.caption,
                        heads=block.heads,
                    )
                elif isinstance(block, Chart):
                    _figure(page, block, folder)
    return page


def _figure(page: Page, chart: Chart, folder: Path) -> None:
    figure = picture_of(chart)
    save_png(figure, folder / f"{chart.name}.png", colours=256)
    page.figure(figure, chart.caption)


def _row(row: Any) -> list[Any]:
    return [
        Marked(cell.value, cell.judgement) if isinstance(cell, Judged) else cell for cell in row
    ]


def _facts(document: Mapping[str, Any]) -> dict[str, str]:
    facts = {"model": document["model"]}
    if document["effects"]:
        facts["effects"] = ", ".join(document["effects"])
    if document["loop"]:
        facts["loop"] = f"{document['loop']['controller']} with {document['loop']['observer']}"
    facts["command"] = f"`{document['command']}`"
    facts["versions"] = ", ".join(f"{name} {v}" for name, v in document["versions"].items())
    return facts
