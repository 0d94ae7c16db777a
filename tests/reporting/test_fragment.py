"""What an object shows of itself in a notebook: the look of a page, inside of its own place."""

import re

import numpy as np
import pytest

from tests import page_audit
from tests.reporting.conftest import example_run
from trms_cli.core.findings import Datum, Details, Findings, Measure, Section, Table
from trms_cli.reporting.page import fragment_html
from trms_cli.reporting.report_runs import findings_of_run
from trms_cli.reporting.style import small_png

COLOURS = """() => { const e = document.querySelector('.trms'); const s = getComputedStyle(e);
  return [s.color, s.backgroundColor]; }"""


def png() -> bytes:
    import io

    from PIL import Image

    content = io.BytesIO()
    Image.fromarray(np.zeros((40, 60, 3), np.uint8)).save(content, "PNG")
    return small_png(content.getvalue())


@pytest.fixture(scope="module")
def shown() -> str:
    tables = [
        Table(["axis", "RMSE [rad]"], [["pitch", Datum(0.1, "good")], ["yaw", Datum(None, "bad")]]),
        Table([f"column {i}" for i in range(14)], [[1.0 / (i + 1) for i in range(14)]]),
        Details("more", "a: 1"),
    ]
    return fragment_html(
        Findings(
            "pid on square",
            ["**pid** followed pitch."],
            [
                Section("Score", ["How well."], tables),
                Section("Folded", blocks=tables, folded=True),
            ],
            measures=[
                Measure("RMSE", 0.1, "rad", "good", "worst"),
                Measure("missed", 3, "", "bad"),
            ],
            warnings=["short"],
            facts={"log": "`run.mcap`"},
        ),
        [png()],
    )


@pytest.mark.parametrize(
    ("place", "is_dark"),
    [
        ("<body style='background:#fff'>", False),
        ("<body data-jp-theme-light=true style='background:#fff'>", False),
        ("<body data-jp-theme-light=false style='background:#111'>", True),
        ("<body class=vscode-dark style='background:#111'>", True),
        ("<body data-theme=dark style='background:#111'>", True),
        ("<body data-theme=auto style='background:#111'>", True),
    ],
)
def test_it_is_dark_where_the_notebook_is(opened, shown, place, is_dark):
    html = f"<!doctype html><meta charset=utf-8>{place}<main>{shown}</main>"
    page = opened(html, drawn=False, color_scheme="dark" if is_dark else "light")
    ink, ground = page(COLOURS)
    assert (ink, ground) == (
        ("rgb(230, 230, 230)", "rgb(23, 25, 28)") if is_dark
        else ("rgb(34, 34, 34)", "rgb(255, 255, 255)")
    )  # fmt: skip
    page("document.querySelectorAll('details').forEach(e => { e.open = true; })")
    assert page_audit.audit(page.tab) == []
    assert page.messages == [] and page.fetched == []


def test_it_touches_nothing_outside(opened, shown):
    outside = "<table id=other><tr><td>x</td></tr></table><p id=words>y</p>"
    look = """() => ['other', 'words'].map(id => { const s = getComputedStyle(
      document.getElementById(id)); return [s.fontSize, s.margin, s.borderCollapse]; })"""
    alone = opened(f"<!doctype html><body>{outside}", drawn=False)(look)
    assert opened(f"<!doctype html><body>{outside}{shown}", drawn=False)(look) == alone


def test_its_parts_look_as_those_of_a_page(opened, shown):
    page = opened(f"<!doctype html><body>{shown}", drawn=False)
    tile = "e => { const s = getComputedStyle(e); return [s.backgroundColor, s.borderRadius]; }"
    assert page.tab.locator("dl.measures div").first.evaluate(tile) == ["rgb(245, 246, 248)", "6px"]
    good = page.tab.locator("dl.measures .good dd").first.evaluate("e => getComputedStyle(e).color")
    assert good == "rgb(0, 115, 79)"


def test_charts_are_left_to_pictures_and_nothing_runs():
    text = fragment_html(findings_of_run(example_run("<script>x</script>")))
    assert "<script" not in text and not re.search(r"plot-data|<img", text)
    assert "RMSE" in text or "channels" in text
    assert len(text) < 100_000
