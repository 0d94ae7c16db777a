"""One self-contained HTML page: text, tables and figures in one file, nothing fetched.

::

    page = Page("Validation", lead="newtonian foretells pitch to 12 mrad over 2 s.")
    page.section("Errors", "RMS over the windows of each horizon.")
    page.table(["channel", "RMS [rad]"], [["pitch", 0.012]], caption="Free run, 2 s.")
    page.figure(figure, "Measured and simulated.")
    page.write(folder / "validation.html")

It reads well on a telephone, in a dark room (the browser's own setting) and on paper. Text is
escaped; ``**bold**`` and ```code``` are understood in it, and nothing else. A page with
:meth:`Page.plots` or :meth:`Page.rows` carries the scripts that it needs
(:mod:`~trms_cli.reporting.page_scripts`); others carry none.
"""

from __future__ import annotations

import base64
import io
import os
import re
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from trms_cli.core import wording
from trms_cli.core.findings import Cell, Judged, Measure
from trms_cli.reporting.chart_plot import Plot, script_json
from trms_cli.reporting.page_rows import RowCell, RowColumn, rows_html
from trms_cli.reporting.page_scripts import page_script, plotly_script, policy, text_digest

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: A drawing with more points in its curves than this is embedded as pixels instead.
_MOST_POINTS = 4_000
_PIXELS_PER_INCH = 144

#: Letters up to which a cell stays on one line.
_SHORT = 24


@dataclass
class _Block:
    kind: str
    content: dict[str, Any]


@dataclass
class _Section:
    heading: str
    text: str
    anchor: str
    folded: bool = False
    blocks: list[_Block] = field(default_factory=list)

    @property
    def has_plots(self) -> bool:
        """Whether a reader has something to turn in it."""
        return any(block.kind == "plots" for block in self.blocks)


class Page:
    """A page under construction: sections in the order in which they are added.

    Parameters
    ----------
    title : str
    lead : str or sequence of str
        What a colleague would say of it, in a sentence or a few; stands on top. Several are
        paragraphs.
    facts : mapping of str to str
        Circumstances (model, recording, date), a name and a value each; folded at the end.
    measures : sequence of Measure
        The few figures that come first.
    """

    def __init__(
        self,
        title: str,
        lead: str | Sequence[str] = "",
        facts: Mapping[str, str] | None = None,
        measures: Sequence[Measure] = (),
    ) -> None:
        self.title = title
        self.lead = [lead] if isinstance(lead, str) else list(lead)
        self.facts = dict(facts or {})
        self.measures = measures
        self._sections: list[_Section] = []

    def section(
        self, heading: str, text: str | Sequence[str] = "", *, folded: bool = False
    ) -> None:
        """Begin a section; tables and figures that follow stand in it.

        Parameters
        ----------
        text : str or sequence of str
            Paragraphs.
        folded : bool
            Whether the heading alone is shown until a reader opens it.
        """
        anchor = re.sub(r"[^a-z0-9]+", "-", heading.lower()).strip("-")
        taken = [section.anchor for section in self._sections]
        if anchor in taken:
            anchor = f"{anchor}-{len(taken) + 1}"
        self._sections.append(_Section(heading, "", anchor, folded))
        self.text(text)

    def text(self, text: str | Sequence[str]) -> None:
        """Paragraphs in the present section."""
        for paragraph in [text] if isinstance(text, str) else text:
            if paragraph:
                self._add("text", {"text": paragraph})

    def points(self, items: Sequence[str | Judged]) -> None:
        """A list of sentences, each with a judgement where it is ``Judged``."""
        judged = [item if isinstance(item, Judged) else Judged(item) for item in items]
        self._add("points", {"items": [(str(item.value), item.judgement) for item in judged]})

    def command(self, text: str) -> None:
        """A line to be typed, in a box of its own."""
        self._add("command", {"text": text})

    def table(
        self,
        columns: Sequence[str],
        rows: Sequence[Sequence[Cell]],
        caption: str = "",
        *,
        heads: int = 1,
    ) -> None:
        """A table; figures are shown with three digits, None as a dash.

        Parameters
        ----------
        columns : sequence of str
            Heads with units: ``RMS [rad]``.
        rows : sequence of sequences
            Text, numbers, None, or :class:`~trms_cli.core.findings.Judged`.
        heads : int
            Columns on the left that name the row.
        """
        shown = []
        for row in rows:
            cells = [cell if isinstance(cell, Judged) else Judged(cell) for cell in row]
            shown.append(
                [
                    {
                        "text": wording.cell(cell.value, cell.sd),
                        "mark": cell.judgement,
                        "number": isinstance(cell.value, (int, float)) or cell.value is None,
                        "short": len(wording.cell(cell.value, cell.sd)) <= _SHORT,
                        "bar": None if cell.bar is None else round(100 * cell.bar, 1),
                    }
                    for cell in cells
                ]
            )
        numeric = [
            all(row[i]["number"] for row in shown) if shown else False for i in range(len(columns))
        ]
        self._add(
            "table",
            {
                "columns": list(zip(columns, numeric, strict=True)),
                "rows": shown,
                "caption": caption,
                "heads": heads,
            },
        )

    def figure(self, figure: Figure, caption: str = "", *, alternative: str = "") -> None:
        """A drawing, as curves where they are few, else as pixels.

        Parameters
        ----------
        alternative : str
            What it shows, for who cannot see it; default the caption.
        """
        kind, content = embedded(figure)
        width = float(figure.get_size_inches()[0])
        self._add(
            "figure",
            {
                "source": f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}",
                "caption": caption,
                "alternative": alternative or caption,
                "width": round(width * 96),
            },
        )

    def plots(self, plots: Sequence[Plot]) -> None:
        """Interactive plots, below one another; halves side by side where there is room."""
        from markupsafe import Markup

        if plots:
            told = [
                {
                    "title": plot.title,
                    "caption": plot.caption,
                    "half": plot.half,
                    "data": Markup(script_json(plot.document())),
                }
                for plot in plots
            ]
            self._add("plots", {"plots": told})

    def rows(
        self,
        columns: Sequence[RowColumn],
        rows: Sequence[Sequence[RowCell]],
        caption: str = "",
        *,
        example: str = "",
    ) -> None:
        """A table of many rows, which the reader sorts and filters.

        Parameters
        ----------
        example : str
            A filter by a column, shown where one is typed: ``rmse<0.1``.
        """
        from markupsafe import Markup

        content = {"columns": list(columns), "caption": caption, "example": example}
        self._add("rows", content | {"body": Markup(rows_html(columns, rows))})

    def details(self, summary: str, text: str) -> None:
        """Text as it stands (a configuration), folded away until it is asked for."""
        self._add("details", {"summary": summary, "text": text})

    def html(self) -> str:
        """The page as text."""
        from markupsafe import Markup

        kinds = {block.kind for section in self._sections for block in section.blocks}
        script = page_script() if kinds & {"plots", "rows"} else ""
        plotly = plotly_script() if "plots" in kinds else None
        digests = [text_digest(script)] if script else []
        text: str = _template().render(
            policy=policy([*digests, plotly.digest] if plotly else digests),
            script=Markup(script),
            plotly=plotly.packed if plotly else "",
            title=self.title,
            lead=[paragraph for paragraph in self.lead if paragraph],
            facts=self.facts,
            measures=[
                {
                    "label": measure.label,
                    "value": wording.cell(measure.value),
                    "unit": wording.unit(measure.unit),
                    "mark": measure.judgement,
                    "note": measure.note,
                }
                for measure in self.measures
            ],
            sections=self._sections,
        )
        # A file's name may hold what is no text; the page does.
        return text.encode("utf-8", "replace").decode("utf-8")

    def write(self, path: Path) -> None:
        """Write the page, whole or not at all.

        Raises OSError if the disk does not take it.
        """
        text = self.html()
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        try:
            with os.fdopen(handle, "w", encoding="utf-8") as file:
                file.write(text)
            umask = os.umask(0)
            os.umask(umask)
            os.chmod(name, 0o666 & ~umask)
            os.replace(name, path)
        except BaseException:
            Path(name).unlink(missing_ok=True)
            raise

    def _add(self, kind: str, content: dict[str, Any]) -> None:
        if not self._sections:
            self._sections.append(_Section("", "", "top"))
        self._sections[-1].blocks.append(_Block(kind, content))


def embedded(figure: Figure) -> tuple[str, bytes]:
    """Media type and bytes of a drawing; equal figures give equal bytes."""
    import numpy as np

    from trms_cli.reporting.style import house_style

    drawn = io.BytesIO()
    lines = [line for axes in figure.axes for line in axes.lines]
    points = sum(np.shape(line.get_path().vertices)[0] for line in lines)
    if points <= _MOST_POINTS:
        with house_style():
            figure.savefig(drawn, format="svg", metadata={"Date": None, "Creator": None})
        return "image/svg+xml", drawn.getvalue()
    from PIL import Image

    figure.savefig(drawn, format="png", dpi=_PIXELS_PER_INCH, metadata={"Software": None})
    content = io.BytesIO()
    Image.open(drawn).convert("RGB").quantize(128).save(content, format="png")
    return "image/png", content.getvalue()


def _inline(text: str) -> Any:
    """Escaped text with ``**bold**`` and ```code```."""
    from markupsafe import Markup, escape

    safe = str(escape(text))
    safe = re.sub(r"\*\*(.+?)\*\*", r"<strong>\1</strong>", safe)
    return Markup(re.sub(r"`(.+?)`", r"<code>\1</code>", safe))


@cache
def _template() -> Any:
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).with_name("templates")),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["inline"] = _inline
    return environment.get_template("page.html")
