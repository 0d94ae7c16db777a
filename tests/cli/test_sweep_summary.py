"""What is printed and drawn at the end of a sweep that drew or searched."""

import shlex
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.sweeps.samplers.test_optimise import SPACE, TWO, bowls, searched
from tests.sweeps.test_robustness import told
from trms_cli.reporting.sweep_charts import summary_charts
from trms_cli.reporting.sweep_screen import draw_summary as draw
from trms_cli.sweeps.findings import summary_findings
from trms_cli.sweeps.samplers.optimise import Optimise


def summary_of(**config) -> dict:
    proposals, _, results = searched(Optimise(**config), SPACE, bowls)
    return proposals.summary(results)


def pixels(file: Path) -> int:
    """How many pixels are not paper."""
    return int((np.asarray(Image.open(file).convert("L")) < 250).sum())


class TestSearch:
    def test_a_front_with_the_configuration_as_it_was(self, tmp_path):
        summary = summary_of(trials=30, objectives=TWO, confirm=2)
        assert draw(tmp_path, summary) == [tmp_path / "pareto.png"]
        findings = summary_findings(summary)
        assert findings.lead[0].startswith("30 trials by tpe, mean of 2 conditions each")
        [table] = findings.tables
        assert table.rows[-1][0] == "before" and "fresh" in table.caption
        shown = {row[0] for row in table.rows}
        assert {str(number) for number in summary["pareto"][:1] + summary["pareto"][-1:]} <= shown
        assert table.columns.count("again") == len(summary["objectives"])
        assert pixels(tmp_path / "pareto.png") > 5000

    def test_one_objective_is_drawn_over_the_trials_and_the_best_is_run(self, tmp_path):
        summary = summary_of(trials=20, objectives=("rmse_yaw",))
        assert draw(tmp_path, summary) == [tmp_path / "search.png"]
        assert pixels(tmp_path / "search.png") > 3000
        summary["fixed"] = ["controller=lqr", "picture=false"]
        [command] = summary_findings(summary).next
        [best] = [t for t in summary["trials"] if t["trial"] == summary["best"]]
        assert shlex.split(command.text)[-4:] == ["controller=lqr", *best["overrides"]]

    def test_three_objectives_in_pairs(self, tmp_path):
        summary = summary_of(trials=15, objectives=TWO, limits={"effort": 5})
        for trial in summary["trials"]:
            trial["figures"]["iae"] = trial["trial"] + 1.0
        summary["objectives"].append({"name": "iae", "unit": "rad s", "direction": "minimise"})
        draw(tmp_path, summary)
        assert Image.open(tmp_path / "pareto.png").width > 1200

    @pytest.mark.parametrize("objectives", [TWO, ("rmse_yaw",)])
    def test_trials_that_are_not_shown_are_counted(self, objectives):
        summary = summary_of(trials=20, objectives=objectives)
        seldom = [t for t in summary["trials"][1:] if t["trial"] not in summary["pareto"]]
        for trial in seldom[:3]:
            trial["figures"]["rmse_alpha_h"] = 1e6
        seldom[3]["figures"] = {}
        [chart] = summary_charts(summary)
        [panel] = chart.panels
        names = [each["name"] for each in summary["objectives"]]
        ends = [axis.limits or (-np.inf, np.inf) for axis in (panel.x, panel.y)]
        outside = 0
        for trial in summary["trials"]:
            if trial["figures"]:
                at = [trial["figures"][name] for name in names]
                at = at if len(at) == 2 else [trial["trial"], *at]
                outside += not all(
                    low <= v <= high for v, (low, high) in zip(at, ends, strict=True)
                )
        assert outside >= 3
        first, second = panel.title.splitlines()
        assert first.startswith("20 trials by tpe")
        assert second == f"not shown: {outside} outside the frame, 1 failed"

    def test_nothing_worked(self, tmp_path):
        summary = summary_of(trials=15, objectives=TWO, limits={"effort": -1})
        assert draw(tmp_path, summary) == []
        assert summary_findings(summary).lead[-1] == "no trial ran to its end within the limits"


class TestRobustness:
    def test_tables_and_pictures(self, tmp_path):
        summary, _, _ = told(samples=60, limits={"rmse_yaw": 1.1})
        drawn = draw(tmp_path, summary)
        assert [file.name for file in drawn] == ["robustness.png", "sensitivity.png"]
        assert all(pixels(file) > 3000 for file in drawn)
        spread, failed, sensitivity = summary_findings(summary).tables
        assert failed.caption == "limits: rmse_alpha_h ≤ 1.1"
        assert any("k +1.00" in str(row[-1]) for row in sensitivity.rows)
        for table in (spread, failed):
            assert any("controller=lqr" in row for row in table.rows)

    def test_too_few_draws_for_a_correlation(self, tmp_path):
        summary, _, _ = told(samples=3)
        assert [file.name for file in draw(tmp_path, summary)] == ["robustness.png"]
        assert any("no figure is correlated" in line for line in summary_findings(summary).warnings)


@pytest.mark.parametrize("summary", [{}, {"kind": "of a sampler of one's own"}])
def test_other_samplers_are_left_alone(tmp_path, summary):
    assert draw(tmp_path, summary) == []
    findings = summary_findings(summary)
    assert not findings.lead and not findings.sections and not findings.next
