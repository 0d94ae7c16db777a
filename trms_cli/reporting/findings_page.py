"""Findings as a page: the answer, its figures first, what limits it, what proves it, what to type.

One page for every command: who has something to tell makes
:class:`~trms_cli.core.findings.Findings` of it, and this is how a browser shows them.
"""

from __future__ import annotations

from pathlib import Path

from trms_cli.core.chart import Chart, RigDiagram
from trms_cli.core.findings import Block, Details, Findings, Judged, NextCommand, Remarks, Table
from trms_cli.core.notes import note
from trms_cli.reporting.chart_picture import picture_of
from trms_cli.reporting.chart_plot import plots_of
from trms_cli.reporting.page import Page
from trms_cli.reporting.rig_diagram import diagram
from trms_cli.reporting.style import house_style, save_png


def write_page(
    findings: Findings,
    path: Path,
    subject: str = "",
    *,
    pictures: bool = True,
    interactive: bool = True,
) -> Path | None:
    """Write the page; None, and a note, if that fails: the numbers are safe, this much may.

    Parameters
    ----------
    pictures : bool
        Whether each chart is written beside it as a PNG too.
    interactive : bool
        Whether a reader can zoom in; else charts are drawings, and the page carries no script.
    """
    folder = path.parent if pictures else None
    try:
        page_of(findings, subject, folder, interactive=interactive).write(path)
    except OSError as error:
        note(f"no page: {error.strerror or error}")
        return None
    return path


def page_of(
    findings: Findings,
    subject: str = "",
    pictures: Path | None = None,
    *,
    interactive: bool = True,
) -> Page:
    """The page, ready to be written.

    Parameters
    ----------
    findings : Findings
    subject : str
        What was studied, behind the title.
    pictures : Path or None
        Folder that each chart is written into as a PNG too.
    interactive : bool
        Whether a reader can zoom in; else charts are drawings.
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
                _add(page, block, pictures, interactive)
    if findings.next:
        page.section("Next")
        for command in findings.next:
            _add(page, command, pictures, interactive)
    return page


def _add(page: Page, block: Block, pictures: Path | None, interactive: bool) -> None:
    match block:
        case Table():
            page.table(block.columns, block.rows, block.caption, heads=block.heads)
        case Remarks():
            page.points(block.items)
        case Chart() | RigDiagram():
            chart = block if isinstance(block, Chart) else None
            plots = plots_of(chart) if chart is not None and interactive else None
            if plots is None or pictures is not None:
                figure = diagram(block) if isinstance(block, RigDiagram) else picture_of(block)
            if pictures is not None:
                save_png(figure, pictures / f"{block.name}.png", colours=256)
            if plots is None:
                page.figure(figure, block.caption)
            else:
                page.plots(plots)
        case NextCommand():
            page.text(block.why)
            page.command(block.text)
        case Details():
            page.details(block.summary, block.text)
