"""What is printed and drawn at the end of a sweep that drew or searched."""

from __future__ import annotations

import shlex
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.sweeps.samplers.test_optimise import SPACE, TWO, bowls, searched
from tests.sweeps.test_robustness import told
from trms_cli.commands.sweep_summary import draw, say
from trms_cli.sweeps.samplers.optimise import Optimise


def document(folder: Path, summary: dict) -> dict:
    return {"summary": summary, "folder": str(folder), "primary": "run", "overrides": []}


def summary_of(**config) -> dict:
    proposals, _, results = searched(Optimise(**config), SPACE, bowls)
    return proposals.summary(results)


def pixels(file: Path) -> int:
    """How many pixels are not paper."""
    return int((np.asarray(Image.open(file).convert("L")) < 250).sum())


class TestSearch:
    def test_a_front_with_the_configuration_as_it_was(self, tmp_path, capsys):
        summary = summary_of(trials=30, objectives=TWO, confirm=2)
        assert draw(tmp_path, summary) == [tmp_path / "pareto.png"]
        say(document(tmp_path, summary))
        printed = capsys.readouterr().out
        assert "30 trials by tpe, mean of 2 conditions each" in printed
        assert "before" in printed and "fresh" in printed and "pareto.png" in printed
        for number in summary["pareto"][:1] + summary["pareto"][-1:]:
            assert any(line.split()[:1] == [str(number)] for line in printed.splitlines())
        assert all(len(line) <= 100 for line in printed.splitlines() if "trms run" not in line)
        assert pixels(tmp_path / "pareto.png") > 5000

    def test_the_command_runs_the_chosen_one_alone(self, tmp_path, capsys):
        summary = summary_of(trials=20, objectives=("rmse_yaw",))
        summary["fixed"] = ["controller=lqr", "picture=false"]
        say(document(tmp_path, summary))
        line = next(x for x in capsys.readouterr().out.splitlines() if " run controller=" in x)
        [best] = [t for t in summary["trials"] if t["trial"] == summary["best"]]
        assert shlex.split(line)[-4:] == ["controller=lqr", *best["overrides"]]

    def test_one_objective_is_drawn_over_the_trials(self, tmp_path, capsys):
        summary = summary_of(trials=20, objectives=("rmse_yaw",))
        assert draw(tmp_path, summary) == [tmp_path / "search.png"]
        assert pixels(tmp_path / "search.png") > 3000

    def test_three_objectives_in_pairs(self, tmp_path):
        summary = summary_of(trials=15, objectives=TWO, limits={"effort": 5})
        for trial in summary["trials"]:
            trial["figures"]["iae"] = trial["trial"] + 1.0
        summary["objectives"].append({"name": "iae", "unit": "rad s", "direction": "minimise"})
        draw(tmp_path, summary)
        assert Image.open(tmp_path / "pareto.png").width > 1200

    @pytest.mark.parametrize("objectives", [TWO, ("rmse_yaw",)])
    def test_trials_that_are_not_shown_are_counted(self, tmp_path, monkeypatch, objectives):
        from trms_cli.reporting import search_picture

        figures = []
        monkeypatch.setattr(search_picture, "save_png", lambda figure, path: figures.append(figure))
        summary = summary_of(trials=20, objectives=objectives)
        seldom = [t for t in summary["trials"][1:] if t["trial"] not in summary["pareto"]]
        for trial in seldom[:3]:
            trial["figures"]["rmse_alpha_h"] = 1e6
        seldom[3]["figures"] = {}
        draw(tmp_path, summary)
        [figure] = figures
        [panel] = figure.axes
        names = [each["name"] for each in summary["objectives"]]
        outside = 0
        for trial in summary["trials"]:
            if trial["figures"]:
                at = [trial["figures"][name] for name in names]
                x, y = at if len(at) == 2 else (trial["trial"], at[0])
                limits = (*panel.get_xlim(), *panel.get_ylim())
                outside += not (limits[0] <= x <= limits[1] and limits[2] <= y <= limits[3])
        assert outside >= 3
        first, second = figure.get_suptitle().splitlines()
        assert first.startswith("20 trials by tpe")
        assert second == f"not shown: {outside} outside the frame, 1 failed"

    def test_nothing_worked(self, tmp_path, capsys):
        summary = summary_of(trials=15, objectives=TWO, limits={"effort": -1})
        assert draw(tmp_path, summary) == []
        say(document(tmp_path, summary))
        assert "no trial ran to its end within the limits" in capsys.readouterr().out


class TestRobustness:
    def test_tables_and_pictures(self, tmp_path, capsys):
        summary, _, _ = told(samples=60, limits={"rmse_yaw": 1.1})
        drawn = draw(tmp_path, summary)
        assert [file.name for file in drawn] == ["robustness.png", "sensitivity.png"]
        assert all(pixels(file) > 3000 for file in drawn)
        say(document(tmp_path, summary))
        printed = capsys.readouterr().out
        assert "rmse_alpha_h ≤ 1.1" in printed and "k +1.00" in printed
        assert printed.count("controller=lqr") == 3
        assert all(len(line) <= 100 for line in printed.splitlines() if "picture" not in line)

    def test_too_few_draws_for_a_correlation(self, tmp_path, capsys):
        summary, _, _ = told(samples=3)
        assert [file.name for file in draw(tmp_path, summary)] == ["robustness.png"]
        say(document(tmp_path, summary))
        assert "no figure is correlated" in capsys.readouterr().out


@pytest.mark.parametrize("summary", [{}, {"kind": "of a sampler of one's own"}])
def test_other_samplers_are_left_alone(tmp_path, capsys, summary):
    assert draw(tmp_path, summary) == []
    say(document(tmp_path, summary))
    assert capsys.readouterr().out == ""
