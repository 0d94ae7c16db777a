"""Pages that stand alone: nothing fetched, everything escaped, whole or not at all."""

from __future__ import annotations

import math
from html.parser import HTMLParser

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trms_cli.core import wording
from trms_cli.core.findings import Judged
from trms_cli.reporting.page import Page, embedded
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


@pytest.fixture
def page() -> Page:
    page = Page("A <title>", ["It is **good**.", "See `x & y`."], {"file": "a<b>.csv"})
    page.section("Errors", "RMS & more.")
    page.table(["channel", "RMS [rad]"], [["pitch", 0.0123], ["yaw", Judged(None, "bad")]], "Cap")
    page.figure(drawing(), "A sine")
    page.section("Errors", ["One.", "Two."])
    page.points(["plain", Judged("wrong <here>", "bad")])
    page.section("End")
    return page


def test_is_well_formed_and_fetches_nothing(page):
    tree = Tree(page.html())
    assert all(source.startswith(("data:", "#")) for source in tree.sources)
    assert "http" not in page.html().replace("http-equiv", "")
    assert len(set(tree.ids)) == len(tree.ids)
    assert all(source[1:] in tree.ids for source in tree.sources if source[0] == "#")


def test_text_is_escaped_and_two_marks_are_understood(page):
    text = page.html()
    assert "A &lt;title&gt;" in text and "a&lt;b&gt;.csv" in text and "wrong &lt;here&gt;" in text
    assert "<strong>good</strong>" in text and "<code>x &amp; y</code>" in text


def test_a_column_of_numbers_stands_right(page):
    text = page.html()
    assert '<th scope="col" class="number">RMS [rad]</th>' in text
    assert '<td class="bad number">–</td>' in text


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


def test_is_written_whole_or_not_at_all(page, tmp_path, monkeypatch):
    path = tmp_path / "page.html"
    page.write(path)
    assert path.read_text(encoding="utf-8") == page.html()

    def full(*arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.replace", full)
    with pytest.raises(OSError):
        Page("other").write(path)
    assert path.read_text(encoding="utf-8") == page.html()
    assert [entry.name for entry in tmp_path.iterdir()] == ["page.html"]


def test_content_before_the_first_section_has_a_place():
    page = Page("bare")
    page.text("hello")
    Tree(page.html())
    assert "hello" in page.html()


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


def test_a_table_of_many_columns_is_set_smaller():
    page = Page("Wide")
    page.table([f"c{i}" for i in range(13)], [[0.5] * 13])
    page.table(["a", "b"], [[1.0, 2.0]])
    assert page.html().count('<table class="wide">') == 1
