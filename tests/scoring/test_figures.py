"""The registry of figures: one entry is a figure everywhere."""

import json

import numpy as np
import pytest

from trms_cli.commands import runs as runs_command
from trms_cli.commands import score as score_command
from trms_cli.core import wording
from trms_cli.core.findings import plain
from trms_cli.library.report.sweeps import _page_figures
from trms_cli.reporting.run_panels import score_note
from trms_cli.runs.columns import COLUMNS, figures_of
from trms_cli.scoring import figures, findings
from trms_cli.scoring.baseline import Baseline, compare
from trms_cli.scoring.comparison.findings import pair, ranking_tables
from trms_cli.scoring.comparison.ranking import group, rank
from trms_cli.scoring.comparison.runs import ComparisonRun
from trms_cli.scoring.figures import Figure, FigureTolerance


@pytest.fixture
def ninth(monkeypatch: pytest.MonkeyPatch) -> Figure:
    """A figure more than the program has."""
    more = Figure(
        "channels", "error_p95", "error, 95th percentile", "{}", FigureTolerance(absolute=1e-3),
        of=lambda m, channel: m.quantile(np.abs(channel.error), 0.95),
    )  # fmt: skip
    monkeypatch.setattr(figures, "FIGURES", [*figures.FIGURES, more])
    return more


def test_one_entry_is_a_figure_everywhere(ninth, make_log, capsys):
    log = str(make_log())
    score_command.main([log, "--json"])
    document = json.loads(capsys.readouterr().out)
    value = document["channels"]["alpha_h"]["error_p95"]
    assert 0 < value < document["channels"]["alpha_h"]["max_abs_error"]
    # the screen, and the page, which has the same tables
    score_command.main([log])
    printed = capsys.readouterr().out
    assert "error, 95th percentile [rad]" in printed and wording.number(value) in printed
    tables = findings.tables_of(document)
    assert any("error, 95th percentile [rad]" in map(plain, row) for row in tables[0].rows)
    # the tables that `trms run` ends with, a panel's note, and the page of a sweep
    (short, *_) = findings.short_tables(document)
    assert any("error, 95th percentile [rad]" in map(plain, row) for row in short.rows)
    assert "error 0." in score_note(document["channels"]["alpha_h"])
    assert {"error_p95_yaw", "error_p95_pitch"} <= {*_page_figures()}
    assert " error_p95" in runs_command.figure_columns()
    # `trms runs`, comparisons and baselines
    assert figures_of(document)["error_p95_alpha_h"] == value
    runs = [ComparisonRun(path=p, coordinates={"controller": p}, score=document) for p in "ab"]
    assert any(row.key == "channels.alpha_h.error_p95" for row in pair(*runs).rows)
    moved = json.loads(json.dumps(document))
    moved["channels"]["alpha_h"]["error_p95"] += 0.01
    (worse,) = [row for row in compare(moved, Baseline(document)) if row.regressed]
    assert worse.key == "channels.alpha_h.error_p95" and worse.unit == "rad"


def test_keys_and_columns_are_told_once(score):
    keys = [(figure.group, figure.key) for figure in figures.FIGURES]
    assert len(set(keys)) == len(keys)
    columns = figures_of(score)
    for name, column in COLUMNS.items():
        if column.about and column.is_number and name not in ("seed", "sample_time", "took"):
            assert name in columns, name


def test_a_strangers_score_has_the_figures_that_are_numbers():
    odd = {"channels": {"alpha_v": {"rmse": "low", "iae": 1.0}, "x": 3}, "inputs": [], "solver": 0}
    found = {entry.key: entry.value for entry in figures.entries(odd)}
    assert found["channels.alpha_v.rmse"] is None and found["channels.alpha_v.iae"] == 1.0
    assert found["violations"] is None
    assert findings.measures_of(odd)[0].value is None
    assert [table.columns[0] for table in findings.tables_of(odd)] == ["tracking"]


def test_a_ranking_has_the_figures_of_each_entrant():
    score = {
        "channels": {"alpha_v": {"rmse": 0.1234, "unit": "rad"}},
        "inputs": {"u_v": {"effort": 123.4, "total_variation": 56.7, "unit": "V"}},
        "solver": {"time_ms": {"median": 1.23, "p99": 4.56, "max": 7.89}, "deadline_misses": 2},
    }
    runs = [
        ComparisonRun(path=name, coordinates={"controller": name, "seed": str(seed)}, score=score)
        for name in "abc"
        for seed in range(6)
    ]
    ranking = rank(group(runs))
    rows = [row for table in ranking_tables(ranking, ranking.standings) for row in table.rows]
    cells = [plain(cell) for row in rows for cell in row]
    for shown in (0.1234, 123.4, 56.7, 1.23, 4.56, 7.89):
        assert cells.count(pytest.approx(shown)) == 3, shown


@pytest.mark.parametrize(
    ("path", "name"),
    [
        ("fit/model.yaml", "fit"),
        ("outputs/d/corrected_model.yaml", "d corrected"),
        ("rig.yaml", "rig"),
        ("model.yaml", "model"),
        ("a/b/tuned.yaml", "tuned"),
    ],
)
def test_a_fitted_model_is_called_by_its_file_or_fit(path, name):
    assert wording.option("from_file", {"path": path}) == name
    assert wording.option("newtonian", {"path": path}) == "newtonian"
