"""Pages in a real browser: they draw, zoom together, sort, filter, print, run nothing foreign."""

import base64
import gzip
import re
from dataclasses import replace

import numpy as np
import pytest

from tests.reporting.conftest import events, example_run
from trms_cli.core.chart import Axis, Chart, Curve, Panel
from trms_cli.core.findings import Findings, Section, Table
from trms_cli.reporting.chart_plot import Plot, script_json
from trms_cli.reporting.page import page_html
from trms_cli.reporting.report_runs import findings_of_comparison, findings_of_run
from trms_cli.reporting.report_sweep import findings_of_sweep
from trms_cli.reporting.sweep_report import Objective, SweepReport, SweepRun
from trms_cli.scoring.metrics import Series

#: What a stranger may have written anywhere.
ATTACKS = (
    "<a href='https://example.org'>plotly knows links</a>",
    "<script>window.harmed = 1</script>",
    "</script><script>window.harmed = 1</script>",
    '"><img src=x onerror="window.harmed = 1">',
    "<svg onload=window.harmed=1><a href='javascript:window.harmed=1'>x</a>",
    "<!--<script>",
)
HOSTILE = " ".join(ATTACKS)
RANGES = """() => [...document.querySelectorAll('div.plot')]
  .filter(p => p.layout.xaxis.title.text === 'time [s]')
  .map(p => p.layout.xaxis.range.map(Number))"""


@pytest.fixture(scope="module")
def sweep() -> SweepReport:
    runs = [
        SweepRun(
            name=str(i),
            number=i,
            entrant=("pid", "lqr")[i % 2],
            values={"controller": ("pid", "lqr")[i % 2], "gain": 0.1 * (i % 5), "size": i % 3},
            figures={"rmse": 0.001 * ((37 * i) % 60 + 1), "effort": 60.0 - i},
        )
        for i in range(60)
    ]
    runs.append(SweepRun(name="60", entrant="pid", outcome="failed", problem="it fell"))
    return SweepReport(
        name="many",
        runs=runs,
        keys=["controller", "gain", "size"],
        figures={"rmse": "rad", "effort": "V² s"},
        objectives=(Objective("rmse"), Objective("effort")),
    )


def test_a_run_draws_and_its_axes_are_linked(opened, run):
    page = opened(page_html(findings_of_run(run)))
    curves = "p => p.querySelector('.cartesianlayer path') !== null"
    assert page(f"[...document.querySelectorAll('div.plot')].every({curves})")
    before = page(RANGES)
    assert len(before) >= 8 and all(r == [0, 20.0] for r in before)

    # a drag over a part of the first plot enlarges that part in all
    box = page.tab.locator("div.plot .nsewdrag").first.bounding_box()
    page.tab.mouse.move(box["x"] + 0.25 * box["width"], box["y"] + 0.5 * box["height"])
    page.tab.mouse.down()
    page.tab.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 0.5 * box["height"], steps=4)
    page.tab.mouse.up()
    page.tab.wait_for_function(f"({RANGES})().every(r => r[1] - r[0] < 6)")
    after = page(RANGES)
    assert all(r == after[0] for r in after)
    assert after[0] == pytest.approx([0.25 * 20.0, 0.5 * 20.0], abs=0.3)

    page.tab.get_by_role("button", name="the whole time").first.click()
    page.tab.wait_for_function(f"({RANGES})().every(r => r[0] === 0 && r[1] === 20.0)")

    # the slider chooses a prediction
    slider = page.tab.get_by_role("slider")
    slider.fill("7")
    assert "made at 7 s" in page.tab.locator("output").first.inner_text()
    chosen = page(
        "() => { const p = [...document.querySelectorAll('div.plot')].find(p => p.data.some("
        "t => t.name === 'chosen prediction')); const t = p._fullData.find("
        "t => t.name === 'chosen prediction'); return [t.x[0], t.x.length]; }"
    )
    assert chosen == [pytest.approx(7.0), 21]

    # nothing is offered to be sent to anybody, nothing was fetched, nothing complained
    sharing = '[data-title*="Share"], [data-title*=cloud i]'
    assert page("what => document.querySelectorAll(what).length", sharing) == 0
    assert page.fetched == page.messages == []


def test_a_sweep_sorts_filters_and_changes_its_figure(opened, sweep):
    page = opened(page_html(findings_of_sweep(sweep)))

    def column(number):
        return page(
            "n => [...document.querySelectorAll('.sortable tbody tr:not([hidden])')]"
            ".map(r => r.cells[n].textContent)",
            number,
        )

    heads = page("[...document.querySelectorAll('.sortable thead th')].map(h => h.dataset.key)")
    rmse, run = heads.index("rmse"), heads.index("run")
    head = page.tab.locator(".sortable thead button").nth(rmse)
    head.click()
    rising = column(rmse)
    assert rising[-1] == "–" and [float(v) for v in rising[:-1]] == sorted(map(float, rising[:-1]))
    head.click()
    falling = column(rmse)
    assert falling[-1] == "–" and falling[:-1] == rising[-2::-1]
    page.tab.locator(".sortable thead button").nth(run).click()
    assert column(run) == [str(i) for i in range(61)]

    box = page.tab.get_by_role("searchbox")
    box.fill("lqr rmse<0.01")
    expected = [str(i) for i in range(60) if i % 2 and 0.001 * ((37 * i) % 60 + 1) < 0.01]
    assert column(run) == expected
    assert f"{len(expected)} of 61 rows" in page.tab.locator("main").inner_text()
    box.fill("outcome=failed")
    assert column(run) == ["60"]
    box.fill("")
    assert len(column(run)) == 61

    title = "() => document.querySelectorAll('div.plot')[1].layout.xaxis.title.text"
    assert page(title) == "rmse [rad]"
    page.tab.locator("select").first.select_option(label="effort [V² s]")
    page.tab.wait_for_function(f"({title})() === 'effort [V² s]'")
    drawn = page("() => document.querySelectorAll('div.plot')[1]._fullData[0].median[0]")
    assert drawn == 31.0
    kinds = page("[...document.querySelectorAll('div.plot')].flatMap(p => p.data.map(t => t.type))")
    assert {"box", "scatter", "heatmap"} <= set(kinds)
    assert page.messages == []


@pytest.mark.parametrize("what", ["run", "comparison", "sweep"])
def test_a_telephone_needs_no_sideways_scroll(opened, sweep, what):
    long = example_run("a_rather_long_name_of_a_folder_without_any_space_in_it_" + 3 * "0123456789")
    pages = {
        "run": lambda: findings_of_run(long),
        "comparison": lambda: findings_of_comparison([long, example_run("other")]),
        "sweep": lambda: findings_of_sweep(sweep),
    }
    page = opened(page_html(pages[what]()), width=375, is_mobile=True, has_touch=True)
    assert page("document.documentElement.scrollWidth") == 375
    plots = "[...document.querySelectorAll('div.plot{}')].every({})"
    assert page(plots.format(" .svg-container", "p => p.offsetWidth <= 375"))
    # a finger over a plot scrolls the page
    assert page(plots.format("", "p => p.layout.dragmode === false"))
    assert page.messages == []


def test_prints_on_paper_in_light_colours_also_from_a_dark_room(opened, run):
    few = ("/reference", "/plant/state", "/command")
    little = replace(run, tables={topic: run.tables[topic] for topic in few})
    page = opened(page_html(findings_of_run(little)), color_scheme="dark")
    ink = "() => document.querySelector('div.plot').layout.font.color"
    assert page(ink) == "#e6e6e6"
    page(
        "addEventListener('beforeprint', () => { window.printed = [...document.querySelectorAll("
        "'div.plot')].map(p => [p.layout.font.color, p._fullLayout.width]); })"
    )
    content = page.tab.pdf(format="A4")
    assert content.startswith(b"%PDF") and len(content) > 20_000
    printed = page("window.printed")
    assert len(printed) >= 6 and all(told == ["#222222", 680] for told in printed)
    assert page(ink) == "#e6e6e6"
    assert page.messages == []


def test_without_scripts_sentences_and_tables_stand(opened, sweep):
    page = opened(page_html(findings_of_sweep(sweep)), drawn=False, java_script_enabled=False)
    text = page.tab.locator("main").inner_text()
    assert "switched off here" in text and "it fell" in text
    assert page.tab.locator(".sortable tbody tr").count() == 61


def test_a_browser_that_cannot_unpack_says_so(opened, run):
    html = page_html(findings_of_run(run))
    page = opened(html, drawn=False, before="delete window.DecompressionStream")
    page.tab.wait_for_selector("html[data-plots=missing]", state="attached")
    assert "no DecompressionStream" in page.tab.locator("p.no-plots").inner_text()
    assert page.tab.locator("tbody tr").count() > 5 and page.messages == []


def test_a_damaged_script_is_told_and_not_run(opened, run):
    text = page_html(findings_of_run(run))
    (packed,) = re.findall('id="plotly">(.*?)<', text)
    foreign = base64.b64encode(gzip.compress(b"window.Plotly = {}; window.harmed = 1")).decode()
    for other, reason in ((packed[:1000], "could not be unpacked"), (foreign, "does not let it")):
        page = opened(text.replace(packed, other), drawn=False)
        page.tab.wait_for_selector("html[data-plots=missing]", state="attached")
        assert reason in page.tab.locator("p.no-plots").inner_text()
        assert page("window.harmed") is None


@pytest.mark.parametrize("kind", ["contour", "heatmap", "histogram2d", "bar", "violin", "table"])
def test_plots_of_two_dimensions_need_no_more_than_the_policy_allows(opened, kind):
    trace: dict[str, object] = {"type": kind, "x": [1, 2, 2], "y": [1, 1, 2]}
    if kind in ("contour", "heatmap"):
        trace["z"] = [[1, 2, 3], [2, 3, 5], [3, 4, 9]]
    if kind == "table":
        trace = {"type": kind, "header": {"values": ["a"]}, "cells": {"values": [[1, 2]]}}
    empty = Chart("one", [Panel(Axis("x"), Axis("y"), [Curve([], [])])])
    html = page_html(Findings("One", [], [Section("", blocks=[empty])]))
    data = script_json(Plot("it", traces=[trace]).document())
    shown = opened(re.sub('(plot-data">).*?(</script>)', lambda m: m[1] + data + m[2], html))
    assert shown.tab.locator("div.plot svg").count() > 0
    assert shown.fetched == shown.messages == []


@pytest.mark.slow
def test_hostile_text_runs_nothing(opened, run, sweep):
    command = run.tables["/command"]
    tables = {topic: run.tables[topic] for topic in ("/prediction",)} | {
        topic: Series(
            table.time,
            {**table.columns, HOSTILE: np.resize(command.columns["u_v"], len(table.time))},
            {**table.units, HOSTILE: HOSTILE},
        )
        for topic, table in run.tables.items()
        if topic not in ("/prediction", "/event")
    }
    happened = events((1.0, HOSTILE, HOSTILE, HOSTILE, np.nan), (2.0, "fault", *2 * [HOSTILE], 1.0))
    hostile = replace(
        run,
        name=HOSTILE,
        tables=tables | {"/event": Series(happened.pop("time"), happened), HOSTILE: command},
        problems=[HOSTILE],
        outcome=HOSTILE,
        choices={"controller": HOSTILE, "ref": HOSTILE, HOSTILE: HOSTILE},
        facts={HOSTILE: HOSTILE},
        command=HOSTILE,
        repeat=HOSTILE,
        config=HOSTILE,
        score={
            **run.score,
            "channels": {HOSTILE: {"rmse": 1.0, "unit": HOSTILE}},
            "inputs": {HOSTILE: {"effort": 1.0, "unit": HOSTILE}},
        },
    )
    swept = SweepRun(
        name=HOSTILE,
        entrant=HOSTILE,
        outcome="completed",
        problem=HOSTILE,
        page="./" + "x",
        values={"controller": HOSTILE, HOSTILE: 1.0},
        figures={"rmse": 1.0, HOSTILE: 2.0},
    )
    failed = replace(swept, entrant="b", outcome="failed")
    many = replace(
        sweep,
        name=HOSTILE,
        runs=[swept, failed, replace(swept, values={HOSTILE: 2.0})],
        keys=["controller", HOSTILE],
        figures={"rmse": HOSTILE, HOSTILE: HOSTILE},
        objectives=(Objective("rmse"), Objective(HOSTILE)),
        left_out=[(HOSTILE, HOSTILE)],
        facts={HOSTILE: HOSTILE},
    )
    more = {"differences": [(HOSTILE, [HOSTILE, HOSTILE])], "left_out": [(HOSTILE, HOSTILE)]}
    for made in (
        findings_of_run(hostile),
        findings_of_comparison([hostile, run], **more),
        findings_of_sweep(many, title=HOSTILE),
    ):
        page = opened(page_html(made))
        for plot in page.tab.locator("div.plot .nsewdrag").all()[:3]:  # what is pointed at is told
            plot.hover(force=True)
        assert page("window.harmed") is None
        # no element that strangers wrote came to be, in the page or in its plots
        strange = "main img, a[href^=javascript], [onload], [onerror], div.plot a:not(.modebar-btn)"
        assert page(f"document.querySelectorAll('{strange}').length") == 0
        # ours, plotly.js packed and unpacked
        assert page("document.querySelectorAll('script').length") == 3 + page(
            "document.querySelectorAll('script.plot-data').length"
        )
        assert page("document.body.innerText.includes('<script>window.harmed = 1</script>')")
        assert page.messages == []


def test_the_policy_stops_what_escaping_would_have_let_through(opened, run):
    """The second wall, should the first have a hole: markup in a page runs and fetches nothing."""
    bare = replace(run, tables={"/plant/state": run.tables["/plant/state"]})
    html = page_html(findings_of_run(bare)).replace(
        "</main>",
        "<script>window.harmed = 1</script>"
        "<img src='http://127.0.0.1:9/x' onerror='window.harmed = 1'>"
        "</main>",
    )
    page = opened(html)
    assert page("window.harmed") is None
    assert any("Content Security Policy" in message for message in page.messages)


def test_pages_of_other_commands_complain_of_nothing(opened):
    table = Section("", blocks=[Table(["a"], [[1.0]])])
    plain = Findings("Plain", ["A page without plots."], [table])
    assert opened(page_html(plain), drawn=False).messages == []
