"""Pages that stand alone: nothing fetched, everything escaped, whole or not at all."""

from html.parser import HTMLParser

import numpy as np
import pytest

from trms_cli.core.chart import Axis, Chart, Curve, Panel
from trms_cli.core.findings import Datum, Findings, Remarks, Section, Table
from trms_cli.reporting.page import embed_figure, page_html, write_page
from trms_cli.reporting.style import new_figure


class Tree(HTMLParser):
    """Checks that tags are closed in order, and collects what would be fetched."""

    VOID = ("meta", "img", "br", "link")

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.sources: list[str] = []
        self.ids: list[str] = []
        self.feed(text)
        assert not self.open

    def handle_starttag(self, tag, attributes):
        values = dict(attributes)
        self.sources += [values[name] for name in ("src", "href") if name in values]
        self.ids += [values["id"]] if "id" in values else []
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def drawing(points: int = 50):
    figure = new_figure(3, 2)
    figure.subplots().plot(np.arange(points), np.sin(np.arange(points)))
    return figure


@pytest.fixture(scope="module")
def findings() -> Findings:
    rows = [["pitch", 0.0123], ["yaw", Datum(None, "bad")]]
    sine = Panel(Axis("x"), Axis("y"), [Curve(np.arange(50), np.sin(np.arange(50)))])
    blocks = [Table(["channel", "RMS [rad]"], rows, "Cap"), Chart("sine", [sine], "A sine")]
    remarks = Remarks(["plain", Datum("wrong <here>", "bad")])
    sections = [
        Section("Errors", ["RMS & more."], blocks),
        Section("Errors", ["One.", "Two."], [remarks]),
        Section("End"),
        Section("", blocks=[Table([f"c{i}" for i in range(13)], [[0.5] * 13])]),
    ]
    lead = ["It is **good**.", "See `x & y`."]
    return Findings("A <title>", lead, sections, facts={"file": "a<b>.csv"})


@pytest.fixture(scope="module")
def page(findings) -> str:
    return page_html(findings, interactive=False)


def test_is_well_formed_and_fetches_nothing(page):
    tree = Tree(page)
    assert all(source.startswith(("data:", "#")) for source in tree.sources)
    assert "http" not in page.replace("http-equiv", "")
    assert len(set(tree.ids)) == len(tree.ids)
    assert all(source[1:] in tree.ids for source in tree.sources if source[0] == "#")
    # text is escaped and two marks are understood
    assert "A &lt;title&gt;" in page and "a&lt;b&gt;.csv" in page and "wrong &lt;here&gt;" in page
    assert "<strong>good</strong>" in page and "<code>x &amp; y</code>" in page
    # a column of numbers stands right, and a table of many columns is set smaller
    assert '<th scope="col" class="number">RMS [rad]</th>' in page
    assert '<td class="bad number">–</td>' in page
    assert page.count('<table class="wide">') == 1 < page.count("<table")


@pytest.mark.parametrize(
    ("points", "kind", "begin"),
    [(50, "image/svg+xml", b"<"), (20_000, "image/png", b"\x89PNG")],
)
def test_few_points_are_curves_many_are_pixels_and_both_are_reproducible(points, kind, begin):
    told, content = embed_figure(drawing(points))
    assert told == kind and content.startswith(begin)
    assert embed_figure(drawing(points)) == (told, content)


def test_is_written_whole_or_not_at_all(findings, page, tmp_path, monkeypatch, capsys):
    path = tmp_path / "page.html"
    assert write_page(findings, path, pictures=False, interactive=False) == path
    assert path.read_text(encoding="utf-8") == page

    def full(*arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.replace", full)
    assert write_page(Findings("other", []), path) is None
    assert "No space left on device" in capsys.readouterr().err
    assert path.read_text(encoding="utf-8") == page
    assert [entry.name for entry in tmp_path.iterdir()] == ["page.html"]
