"""Pages that stand alone: nothing fetched, everything escaped, whole or not at all."""

from __future__ import annotations

import math
from html.parser import HTMLParser

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trms_cli.core import wording
from trms_cli.core.chart import Axis, Chart, Curve, Panel
from trms_cli.core.findings import Findings, Judged, Remarks, Section, Table
from trms_cli.reporting.page import embedded, page_html, write_page
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
    rows = [["pitch", 0.0123], ["yaw", Judged(None, "bad")]]
    sine = Panel(Axis("x"), Axis("y"), [Curve(np.arange(50), np.sin(np.arange(50)))])
    blocks = [Table(["channel", "RMS [rad]"], rows, "Cap"), Chart("sine", [sine], "A sine")]
    remarks = Remarks(["plain", Judged("wrong <here>", "bad")])
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


def test_text_is_escaped_and_two_marks_are_understood(page):
    assert "A &lt;title&gt;" in page and "a&lt;b&gt;.csv" in page and "wrong &lt;here&gt;" in page
    assert "<strong>good</strong>" in page and "<code>x &amp; y</code>" in page


def test_a_column_of_numbers_stands_right(page):
    assert '<th scope="col" class="number">RMS [rad]</th>' in page
    assert '<td class="bad number">–</td>' in page


@pytest.mark.parametrize(
    "value, shown",
    [(None, "–"), (math.nan, "–"), (math.inf, "∞"), (0.0, "0"), (0.012345, "0.0123"),
     (-3.14159, "−3.14"), (123456.0, "1.23e05"), (4321.0, "4321"), (1.2e-5, "1.20e−05"),
     (7, "7"), ("text", "text")],
)  # fmt: skip
def test_cells(value, shown):
    assert wording.cell(value) == shown


def test_few_points_are_curves_many_are_pixels_and_both_are_reproducible():
    assert embedded(drawing())[0] == "image/svg+xml"
    kind, content = embedded(drawing(20_000))
    assert kind == "image/png" and content[:4] == b"\x89PNG"
    assert embedded(drawing()) == embedded(drawing())
    assert embedded(drawing(20_000))[1] == content


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


@pytest.mark.parametrize(
    ("value", "sd", "shown"),
    [
        (1.69623e-5, 5.9e-8, "1.6962e−05"), (0.02, 2.7e-4, "0.02000"), (1.5, 4.0, "1.5"),
        (-0.353, 1e-9, "−0.353000"), (0.0, 0.1, "0"), (0.5, None, "0.5"), (0.5, 0.0, "0.5"),
        (4321.25, 0.3, "4321.25"), (None, 0.1, "–"),
    ],
)  # fmt: skip
def test_a_value_is_shown_to_the_digits_of_its_deviation(value, sd, shown):
    assert wording.cell(value, sd) == shown


@given(st.floats(1e-8, 1e8), st.floats(1e-4, 1.0))
def test_what_is_shown_is_within_the_deviation(value, share):
    text = wording.cell(value, share * value).replace("−", "-")
    assert abs(float(text) - value) <= 0.06 * share * value + 1e-2 * share * value


def test_a_table_of_many_columns_is_set_smaller(page):
    assert page.count('<table class="wide">') == 1 < page.count("<table")
