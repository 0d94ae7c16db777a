"""Findings as a page: the answer, its figures first, what limits it, what proves it, what to type.

One page for every command: who has something to tell makes
:class:`~trms_cli.core.findings.Findings` of it, and this is how a browser shows them.
"""

from __future__ import annotations

import sys
from pathlib import Path

from trms_cli.core.chart import Chart
from trms_cli.core.findings import Block, Command, Details, Findings, Judged, Table
from trms_cli.reporting.chart_picture import picture_of
from trms_cli.reporting.chart_plot import plots_of
from trms_cli.reporting.page import Page
from trms_cli.reporting.style import house_style, save_png


def write_page(findings: Findings, path: Path, subject: str = "") -> Path | None:
    """Write the page, and each chart as a PNG beside it; None, and a word on standard error, if
    that fails: the numbers are safe, this much may."""
    try:
        page_of(findings, subject, path.parent).write(path)
    except OSError as error:
        sys.stderr.write(f"no page: {error.strerror or error}\n")
        return None
    return path


def page_of(findings: Findings, subject: str = "", pictures: Path | None = None) -> Page:
    """The page, ready to be written.

    Parameters
    ----------
    findings : Findings
    subject : str
        What was studied, behind the title.
    pictures : Path or None
        Folder that each chart is written into as a PNG too.
    """
    title = f"{findings.title}: {subject}" if subject else findings.title
    page = Page(title, findings.lead, findings.facts, findings.measures)
    if findings.warnings:
        page.section("What limits this")
        page.points([Judged(warning, "doubtful") for warning in findings.warnings])
    with house_style():
        for section in findings.sections:
            page.section(section.heading, list(section.text), folded=section.folded)
            for block in section.blocks:
                _add(page, block, pictures)
    if findings.next:
        page.section("Next")
        for command in findings.next:
            _add(page, command, pictures)
    return page


def _add(page: Page, block: Block, pictures: Path | None) -> None:
    match block:
        case Table():
            page.table(block.columns, block.rows, block.caption, heads=block.heads)
        case Chart():
            figure = picture_of(block)
            if pictures is not None:
                save_png(figure, pictures / f"{block.name}.png", colours=256)
            plots = plots_of(block)
            if plots is None:
                page.figure(figure, block.caption)
            else:
                page.plots(plots)
        case Command():
            page.text(block.why)
            page.command(block.text)
        case Details():
            page.details(block.summary, block.text)
