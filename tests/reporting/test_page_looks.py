"""Pages of all kinds, in light and in the dark, at three widths: nothing cut, covered or faint."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from tests import page_audit
from tests.gap.diagnosis_case import diagnosis
from tests.reporting.conftest import example_run
from tests.reporting.test_report_browser import sweep as sweep  # the fixture
from trms_cli.core.chart import Axis, Chart, Curve, Line, Panel, Points
from trms_cli.core.findings import Findings, Measure, NextCommand, Section, Table
from trms_cli.gap.findings import findings as findings_of_diagnosis
from trms_cli.reporting.page import page_html
from trms_cli.reporting.report_runs import findings_of_comparison, findings_of_run
from trms_cli.reporting.report_sweep import findings_of_sweep

pytestmark = pytest.mark.slow


def study() -> Findings:
    """A study as of equilibria: curves with named points, two panels beside each other."""
    u = np.linspace(-2.5, 2.5, 60)
    marks = [
        Curve(u, u**3 / 10, "stable"),
        Curve(u, u**3 / 8, "unstable", "vermilion", "dashed"),
        Line(y=1.0, label="stop"),
        Points(
            [-2.5, 0.0, 2.5], [-1.56, 0.0, 1.56], "fold", "star", names=["-2.5", "rest", "2.227"]
        ),
    ]
    panels = [
        Panel(Axis("u_v", "V"), Axis("α_v", "rad"), marks, half=True),
        Panel(Axis("u_v", "V"), Axis("ω_v", "rad/s"), marks, half=True),
    ]
    rows = [[float(x), float(x**3 / 10), "stable", None] for x in u]
    table = Table(["u_v [V]", "α_v [rad]", "stability", "rightmost [1/s]"], rows)
    return Findings(
        "Equilibria: newtonian",
        ["Rest: u_v = 0 V.", "Hover: u_v = 1.413 V."],
        [Section("Over u_v", ["The box."], [Chart("over_u_v", panels, "All."), table])],
        warnings=["over u_v equilibria lie on a switch"],
        measures=[Measure("rest", -0.62, "rad"), Measure("fold", 2.227, "V", "bad", "of u_v")],
        next=[NextCommand("trms stability study=local model=newtonian", "slopes there")],
    )


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_nothing_overlaps_is_cut_or_faint(opened, run, sweep, scheme: str) -> None:
    long = example_run("a_rather_long_name_of_a_folder_without_any_space_in_it_0123456789")
    kinds: dict[str, Callable[[], str]] = {
        "run": lambda: page_html(findings_of_run(run)),
        "comparison": lambda: page_html(findings_of_comparison([long, example_run("other")])),
        "sweep": lambda: page_html(findings_of_sweep(sweep)),
        "study": lambda: page_html(study()),
        "diagnosis": lambda: page_html(
            findings_of_diagnosis(replace(diagnosis(), traces=None)), interactive=False
        ),
    }
    if scheme == "dark":  # of each part that they have, one
        del kinds["comparison"], kinds["study"]
    wrong = {}
    for kind, make in kinds.items():
        html = make()
        page = opened(html, drawn='class="plot-data"' in html, color_scheme=scheme)
        page("document.querySelectorAll('details').forEach(e => { e.open = true; })")
        found = page_audit.audit(page.tab) + page.messages
        if found or page.fetched:
            wrong[kind] = [*found, *page.fetched]
    assert wrong == {}


def test_the_order_is_the_same_on_all_pages(opened, run, sweep) -> None:
    """Figures, the answer, the first plot; what was asked for and how it was made stand last."""
    order = """() => ['dl.measures', '.lead', 'div.plot', '.plots', '#circumstances'].map(
      what => document.querySelector(what)?.getBoundingClientRect().top ?? null)"""
    for made in (findings_of_run(run), findings_of_comparison([run, example_run("other")]),
                 findings_of_sweep(sweep), study()):  # fmt: skip
        page = opened(page_html(made))
        measures, lead, plot, _, last = page(order)
        assert measures < lead < plot and (last is None or last > plot)
        first = page("document.querySelector('div.plot').closest('details')")
        assert first is None, "the plot that proves it is not folded"
