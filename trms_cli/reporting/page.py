"""Findings as one self-contained HTML page: text, tables and figures in one file, nothing fetched.

One page for every command: who has something to tell makes
:class:`~trms_cli.core.findings.Findings` of it, and this is how a browser shows them: the answer,
its figures first, what limits it, what proves it, what to type. It reads well on a telephone, in a
dark room (the browser's own setting) and on paper. Text is escaped; ``**bold**`` and ```code``` are
understood in it, and nothing else.

A page with plots, or with rows to filter, carries the scripts that it needs; others carry none. It
may hold text of strangers: names of files, messages of events, configurations. Should a mistake let
markup through all the same, the page's Content-Security-Policy refuses it: nothing is fetched from
anywhere, and only two scripts run, by their hashes: ours (``assets/page.js``) and plotly.js, as the
installed package ``plotly`` has it. That is 4.8 MB of text, and a page carries it compressed, as
data that no browser runs; our script unpacks it and adds it to the page.
"""

from __future__ import annotations

import base64
import gzip
import hashlib
import io
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from html import escape
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from trms_cli.core import wording
from trms_cli.core.chart import Chart, RigDiagram
from trms_cli.core.findings import (
    Block,
    Cell,
    Datum,
    Details,
    Findings,
    NextCommand,
    Remarks,
    Section,
    Table,
    plain,
)
from trms_cli.core.invocation import note
from trms_cli.core.process_cache import cached_result
from trms_cli.core.whole_file import replace_whole
from trms_cli.reporting.chart_plot import plots_of, script_json

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from trms_cli.reporting.run_list import RunList


@dataclass(frozen=True)
class PackedScript:
    """A script as a page carries it: gzip, in base64."""

    packed: str
    digest: bytes  #: SHA-256 of the text that comes out


@cache
def page_script() -> str:
    """Our script: draws plots, links their axes, sorts and filters tables."""
    return _asset("page.js")


def _asset(name: str) -> str:
    return Path(__file__).with_name("assets").joinpath(name).read_text(encoding="utf-8")


@cache
def page_style() -> str:
    """The style sheet of a page."""
    light, dark = _colours()
    dark = f"@media (prefers-color-scheme: dark) {{ :root {dark} }}"
    return "\n".join((f":root {light}", dark, _asset("parts.css"), _asset("page.css")))


def _colours() -> tuple[str, str]:
    """Declarations of the light colours, and of the dark ones, each in its braces."""
    light, dark = re.findall(r"^\.(?:light|dark) (\{[^}]*\})", _asset("colours.css"), re.MULTILINE)
    return light, dark


#: Where notebooks (JupyterLab, VS Code, Colab) and sites say that they are dark.
_DARK_NOTEBOOKS = (
    "body[data-jp-theme-light=false]",
    "body.vscode-dark",
    "html[theme=dark]",
    "body[data-theme=dark]",
)
_AUTOMATIC = "body[data-theme=auto]"


@cache
def _fragment_style() -> str:
    """The style sheet of a part of somebody else's page: nothing outside of it is touched."""
    light, dark = _colours()
    places = ", ".join(f"{place} .trms" for place in _DARK_NOTEBOOKS)
    return "\n".join(
        (
            f".trms {light}",
            f"{places} {dark}",
            f"@media (prefers-color-scheme: dark) {{ {_AUTOMATIC} .trms {dark} }}",
            f".trms {{ {_asset('fragment.css')} {_asset('parts.css')} }}",
        )
    )


@cache
def plotly_source() -> bytes:
    """plotly.js of the installed package; that package itself is not imported, which takes time.

    Raises ModuleNotFoundError where it is not installed, and OSError where its script is missing.
    """
    package = find_spec("plotly")
    if package is None or package.origin is None:
        raise ModuleNotFoundError("No module named 'plotly'", name="plotly")
    return Path(package.origin).with_name("package_data").joinpath("plotly.min.js").read_bytes()


@cache
def plotly_script() -> PackedScript:
    """plotly.js as a page carries it."""
    text = plotly_source()
    digest = hashlib.sha256(text).digest()
    packed = cached_result(__file__, [digest], str, lambda: _packed(text))
    return PackedScript(packed, digest)


def _packed(text: bytes) -> str:
    return base64.b64encode(gzip.compress(text, compresslevel=9, mtime=0)).decode("ascii")


def text_digest(script: str) -> bytes:
    """SHA-256 of a script that stands in a page as it is."""
    return hashlib.sha256(script.encode()).digest()


def policy(digests: Sequence[bytes] = ()) -> str:
    """The Content-Security-Policy of a page that runs the scripts with these hashes alone.

    Styles are inline: plotly.js sets the places of its parts so. Images come from the page itself,
    where a reader saves a plot as a file.
    """
    hashes = (f"'sha256-{base64.b64encode(digest).decode('ascii')}'" for digest in digests)
    return (
        f"default-src 'none'; script-src {' '.join(hashes) or chr(39) + 'none' + chr(39)}; "
        "style-src 'unsafe-inline'; img-src data: blob:; base-uri 'none'; form-action 'none'"
    )


@dataclass(frozen=True)
class Hosting:
    """What a page of a server has beside one that is a file."""

    #: ``page_script``, ``plotly``: Addresses of the two scripts, on the same server
    page_script: str
    plotly: str
    links: Sequence[tuple[str, str]] = ()  #: On top of the page: words and address
    refresh: float = 0.0  #: s after which the page fetches itself anew, again and again; 0: never


#: The Content-Security-Policy of pages of a server, as its answers have it: scripts are its own.
HOSTED_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'unsafe-inline'; img-src data: blob:; "
    "connect-src 'self'; base-uri 'none'; form-action 'self'; frame-ancestors 'none'"
)


#: A drawing with more points in its curves than this is embedded as pixels instead.
_MOST_POINTS = 4_000
_PIXELS_PER_INCH = 144
#: Letters up to which a cell stays on one line; of a table with a filter those that it has at most.
_SHORT, _LONGEST_CELL = 24, 300
#: Rows of a table with a filter: more are slow to lay out.
MOST_ROWS = 10_000


def write_page(
    findings: Findings,
    path: Path,
    subject: str = "",
    *,
    pictures: bool = True,
    interactive: bool = True,
) -> Path | None:
    """Write the page, whole or not at all; None, and a note, if that fails: the numbers are safe.

    `subject`: what was studied, behind the title. `pictures`: whether each chart is written beside
    it as a PNG too. `interactive`: whether a reader can zoom in; else charts are drawings, and the
    page carries no script.
    """
    folder = path.parent if pictures else None
    try:
        text = page_html(findings, subject, folder, interactive=interactive)
        replace_whole(path, text.encode())
    except OSError as error:
        note(f"no page: {error.strerror or error}")
        return None
    return path


def page_html(
    findings: Findings,
    subject: str = "",
    pictures: Path | None = None,
    *,
    interactive: bool = True,
    hosting: Hosting | None = None,
    run_list: RunList | None = None,
) -> str:
    """The page as text; `pictures`: the folder that each chart is written into as a PNG too.

    `hosting`: what it has as a page of a server. `run_list`: runs to choose from.
    """
    from markupsafe import Markup

    sections = list(findings.sections)
    if findings.warnings:
        limits = Remarks([Datum(warning, "doubtful") for warning in findings.warnings])
        sections.insert(0, Section("What limits this", blocks=[limits]))
    if findings.next:
        last = 0 if findings.next_first else len(sections)
        sections.insert(last, Section("Next", blocks=findings.next))
    section_data = [_section(section, pictures, interactive) for section in sections]
    for number, section in enumerate(section_data):
        anchors = [other["anchor"] for other in section_data[:number]]
        section["anchor"] += f"-{number + 1}" if section["anchor"] in anchors else ""
    kinds = {block["kind"] for section in section_data for block in section["blocks"]}
    needs_script, needs_plotly = bool(kinds & {"plots", "rows"}), "plots" in kinds
    script = page_script() if needs_script and hosting is None else ""
    plotly = plotly_script() if needs_plotly and hosting is None else None
    digests = [text_digest(script)] if script else []
    text: str = _template().render(
        policy="" if hosting else policy([*digests, plotly.digest] if plotly else digests),
        style=Markup(page_style()),
        hosting=hosting,
        run_list=run_list,
        needs_script=needs_script,
        needs_plotly=needs_plotly,
        script=Markup(script),
        plotly=plotly.packed if plotly else "",
        title=f"{findings.title}: {subject}" if subject else findings.title,
        lead=[paragraph for paragraph in findings.lead if paragraph],
        facts=findings.facts,
        measures=_measures(findings),
        sections=section_data,
    )
    # A file's name may hold what is no text; the page does.
    return text.encode("utf-8", "replace").decode("utf-8")


def fragment_html(findings: Findings, pictures: Sequence[bytes] = ()) -> str:
    """Findings as a part of another page: what an object in a notebook shows of itself.

    The same figures, answer and tables as on a page, with `pictures` (PNG) in the place of charts.
    It fetches nothing and runs no script, and its style sheet holds inside of it alone.
    """
    from markupsafe import Markup

    sections = list(findings.sections)
    if findings.warnings:
        limits = Remarks([Datum(warning, "doubtful") for warning in findings.warnings])
        sections.append(Section("What limits this", blocks=[limits], folded=True))
    without_charts = [
        replace(s, blocks=[b for b in s.blocks if not isinstance(b, Chart | RigDiagram)])
        for s in sections
    ]
    data = (base64.b64encode(picture).decode("ascii") for picture in pictures)
    text: str = _template("fragment.html").render(
        style=Markup(_fragment_style()),
        title=findings.title,
        measures=_measures(findings),
        lead=[paragraph for paragraph in findings.lead if paragraph],
        pictures=[f"data:image/png;base64,{one}" for one in data],
        sections=[_section(each, None, False) for each in without_charts if each.blocks],
        facts=findings.facts,
    )
    return text.encode("utf-8", "replace").decode("utf-8")


def _measures(findings: Findings) -> list[dict[str, str]]:
    return [
        {
            "label": measure.label,
            "value": wording.cell(measure.value),
            "unit": wording.unit(measure.unit),
            "mark": measure.judgement,
            "note": measure.note,
        }
        for measure in findings.measures
    ]


def _section(section: Section, pictures: Path | None, interactive: bool) -> dict[str, Any]:
    return {
        "heading": section.heading,
        "anchor": re.sub(r"[^a-z0-9]+", "-", section.heading.lower()).strip("-") or "top",
        "folded": section.folded,
        "text": [paragraph for paragraph in section.text if paragraph],
        "blocks": [_block(block, pictures, interactive) for block in section.blocks],
    }


def _block(block: Block, pictures: Path | None, interactive: bool) -> dict[str, Any]:
    """What the template shows of a block, by its kind."""
    match block:
        case Table():
            return _table(block)
        case Remarks():
            data = [item if isinstance(item, Datum) else Datum(item) for item in block.items]
            return {"kind": "points", "points": [(str(i.value), i.judgement) for i in data]}
        case NextCommand():
            return {"kind": "command", "why": block.why, "text": block.text}
        case Details():
            return {"kind": "details", "summary": block.summary, "text": block.text}
        case Chart() | RigDiagram():
            return _chart(block, pictures, interactive)


def _chart(chart: Chart | RigDiagram, pictures: Path | None, interactive: bool) -> dict[str, Any]:
    """Plots that a reader can turn; a drawing where that cannot be, or is not wanted."""
    from markupsafe import Markup

    plots = plots_of(chart) if isinstance(chart, Chart) and interactive else None
    plot_data = [(plot, Markup(script_json(plot.document()))) for plot in plots or ()]
    if plots is not None and pictures is None:
        return {"kind": "plots", "plots": plot_data}
    # matplotlib takes a third of a second to import, which interactive pages do without
    from trms_cli.reporting.chart_picture import picture_of
    from trms_cli.reporting.rig_diagram import diagram
    from trms_cli.reporting.style import house_style, save_png

    with house_style():
        figure = diagram(chart) if isinstance(chart, RigDiagram) else picture_of(chart)
        if pictures is not None:
            save_png(figure, pictures / f"{chart.name}.png", colours=256)
        if plots is not None:
            return {"kind": "plots", "plots": plot_data}
        kind, content = embed_figure(figure)
    source = f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"
    return {"kind": "figure", "source": source, "caption": chart.caption}


def _table(table: Table) -> dict[str, Any]:
    """Figures with three digits, None as a dash, all escaped."""
    from markupsafe import Markup

    sortable, count = bool(table.keys), len(table.columns)
    rows = table.rows[:MOST_ROWS] if sortable else table.rows
    numeric = [bool(rows) and all(_is_number(row[i]) for row in rows) for i in range(count)]
    heads = [i < table.heads and not sortable for i in range(count)]
    body = "\n".join(
        f"<tr>{''.join(_cell(*each, sortable) for each in zip(row, numeric, heads, strict=True))}"
        "</tr>"
        for row in rows
    )
    return {
        "kind": "rows" if sortable else "table",
        "columns": list(zip(table.columns, numeric, table.keys or table.columns, strict=True)),
        "body": Markup(body),
        "caption": table.caption,
        "example": table.example,
    }


#: What is known of a plain value.
_NOTHING_ELSE = Datum(None)


def _cell(cell: Cell, is_numeric: bool, is_head: bool, is_sortable: bool) -> str:
    if is_sortable and not is_head and isinstance(cell, float) and math.isfinite(cell):
        # hundreds of thousands of these stand in a table of runs
        return f'<td class="number" data-v="{cell:.6g}">{wording.number(cell)}</td>'
    datum = cell if isinstance(cell, Datum) else _NOTHING_ELSE
    value = plain(cell)
    text = wording.cell(value, datum.sd)
    if isinstance(value, bool):
        text = "yes" if value else "no"
    if is_sortable and len(text) > _LONGEST_CELL:
        text = text[: _LONGEST_CELL - 1] + "…"
    content = escape(text)
    if datum.link:
        content = f'<a href="{escape(datum.link)}">{content}</a>'
    if is_head:
        return f'<th scope="row">{content}</th>'
    is_number = is_numeric or (_is_number(value) and value is not None)
    short = "" if is_sortable or len(text) > _SHORT else "short"
    names = (datum.judgement, "number" if is_number else short, "bar" * (datum.bar is not None))
    looks = " ".join(filter(None, names))
    attributes = f' class="{looks}"' if looks else ""
    if datum.bar is not None:
        attributes += f' style="--part: {round(100 * datum.bar, 1)}%"'
    if is_sortable and isinstance(value, int | float) and math.isfinite(value):
        attributes += f' data-v="{value:.6g}"'  # for sorting and filtering
    return f"<td{attributes}>{content}</td>"


def _list_cell(cell: Cell) -> Any:
    """A cell of a list of runs."""
    from markupsafe import Markup

    return Markup(_cell(cell, plain(cell) is None, False, False))


def _is_number(cell: Cell) -> bool:
    value = plain(cell)
    return value is None or (isinstance(value, int | float) and not isinstance(value, bool))


def embed_figure(figure: Figure) -> tuple[str, bytes]:
    """Media type and bytes of a drawing; equal figures give equal bytes."""
    import numpy as np

    from trms_cli.reporting.style import house_style

    buffer = io.BytesIO()
    lines = [line for axes in figure.axes for line in axes.lines]
    points = sum(np.shape(line.get_path().vertices)[0] for line in lines)
    if points <= _MOST_POINTS:
        with house_style():
            figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
        return "image/svg+xml", buffer.getvalue()
    from PIL import Image

    figure.savefig(buffer, format="png", dpi=_PIXELS_PER_INCH, metadata={"Software": None})
    content = io.BytesIO()
    Image.open(buffer).convert("RGB").quantize(128).save(content, format="png")
    return "image/png", content.getvalue()


def _inline(text: str) -> Any:
    """Escaped text with ``**bold**`` and ```code```."""
    from markupsafe import Markup, escape

    safe = str(escape(text))
    safe = re.sub(r"\*\*(.+?)\*\*", r"<strong>\1</strong>", safe)
    return Markup(re.sub(r"`(.+?)`", r"<code>\1</code>", safe))


def _breakable(text: str) -> Any:
    """Escaped text that may break within a key: ``effect.yaw_…`` is longer than many a plot."""
    from markupsafe import Markup, escape

    return Markup(re.sub(r"(?<=\w)([._])(?=[a-z])", r"\1<wbr>", str(escape(text))))


@cache
def _template(name: str = "page.html") -> Any:
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).with_name("templates")),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["inline"] = _inline
    environment.filters["breakable"] = _breakable
    environment.filters["cell"] = _list_cell
    return environment.get_template(name)
