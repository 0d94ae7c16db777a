"""What a fit has to tell: errors, doubts and charts, of its document and of its free runs."""

from types import SimpleNamespace

import numpy as np
import pytest

from trms_cli.core.chart import Curve, Points
from trms_cli.core.findings import plain
from trms_cli.identification.findings import (
    convergence_chart,
    doubts_of,
    findings,
    free_run_chart,
    parameter_chart,
)
from trms_cli.identification.free_runs import Assessment
from trms_cli.models.model import Signal
from trms_cli.reporting.chart_picture import picture_of
from trms_cli.reporting.page import page_html
from trms_cli.reporting.style import house_style


def parameter(value: float, at_bound: str | None = None, **changes) -> dict:
    known = {
        "value": value, "sd": 1e-4, "unit": "N*m*s", "start": 0.006, "prior_mean": 0.006,
        "prior_sd": 0.002, "lower": 0.0, "upper": None, "at_bound": at_bound,
    }  # fmt: skip
    return known | changes


PARAMETERS = {
    "k_ov": parameter(0.007),
    "k_far": parameter(0.5),
    "k_low": parameter(0.0, "lower", sd=None),
    "k_free": parameter(0.004, prior_sd=None),
}


@pytest.fixture
def document() -> dict:
    errors = {"rmse": 0.01, "max_abs_error": 0.03, "fit_percent": 98.0, "unit": "rad"}
    part = {"before": {"alpha_v": errors | {"rmse": 0.05}}, "after": {"alpha_v": errors}}
    return {
        "model": "newtonian", "method": "genetic", "command": "trms identify real=<b>.csv",
        "effects": ["yaw_coulomb_friction"], "driven": [], "versions": {"trms": "1"},
        "sentence": "converged", "outcome": "converged", "evaluations": 50,
        "seconds": {"fit": 1.0}, "windows": {"length_s": 10.0},
        "settings": {"_target_": "x", "individuals": 50},
        "errors": {"fit": part, "held_out": part}, "parameters": PARAMETERS, "admission": [],
        "identifiability": {
            "confounded": [{"names": ["m_cb", "l_cb"], "index": 1e4}],
            "prior_remaining": {"k_ov": 0.95}, "silent": [], "uninformed": ["k_ov"],
        },
        "details": {"starts_agree": False}, "history": [[50, 0.5, 9.0], [100, 1.0, 3.0]],
        "recordings": [
            {"source": "rig.csv", "part": "fit", "from_s": 0.0, "to_s": 9.98,
             "sample_time_s": 0.02, "sha256": "ab" * 32, "remarks": ["3 samples missing"]},
        ],
    }  # fmt: skip


def assessment() -> Assessment:
    """Free runs of 20 s in two windows; the fitted one overflows."""
    time = np.arange(0, 20, 0.02)
    after = np.sin(time) + 0.01
    after[700:] = np.nan

    def run(values: np.ndarray) -> SimpleNamespace:
        dataset = SimpleNamespace(
            name="rig",
            time=time,
            sample_time=0.02,
            measurements=np.sin(time)[:, None],
            outputs=(Signal("alpha_v", "rad", "pitch"),),
        )
        window = np.array([0, 500])
        return SimpleNamespace(dataset=dataset, window=window, simulated=values[:, None])

    result = SimpleNamespace(values={}, covariance=None)
    runs = {"before": {"fit": [run(1.3 * np.sin(time))]}, "after": {"fit": [run(after)]}}
    return Assessment(result, **runs)  # type: ignore[arg-type]


def test_curves_break_where_a_window_begins_anew():
    chart = free_run_chart(assessment())
    run, error = chart.panels
    fitted = next(m for m in run.marks if getattr(m, "label", "") == "simulated, fitted")
    assert np.isnan(fitted.y[499]) and np.isfinite(fitted.y[500])
    assert error.title.endswith("0.01 rad") and "→" in error.title


def test_every_parameter_has_a_row_and_a_mark():
    (panel,) = parameter_chart(PARAMETERS).panels
    assert panel.y.categories == ["k_ov", "k_far (+247 sd)", "k_low", "k_free"]
    marked = [y for mark in panel.marks if isinstance(mark, Points) and mark.label != "start"
              for y in mark.y]  # fmt: skip
    assert sorted(marked) == [0, 1, 2, 3]
    assert any(getattr(mark, "label", "") == "on a bound" for mark in panel.marks)


@pytest.mark.parametrize("history", [[], [[1, 0.1, 5.0]], [[1, 0.1, 5.0], [2, 0.2, 5.0]]])
def test_a_search_that_never_fell_is_drawn(history):
    chart = convergence_chart(history)
    assert isinstance(chart.panels[0].marks[0], Curve)
    with house_style():
        picture_of(chart)


def test_errors_doubts_and_recordings_are_told(document):
    told = findings(document)
    assert "pitch to **10 mrad** (before: 50)" in told.lead[0]
    assert [(m.label, m.value, m.unit, m.judgement) for m in told.measures] == [
        ("RMSE pitch", 10.0, "mrad", "good")
    ]
    doubts = list(doubts_of(document))
    for words in ("m_cb and l_cb imitate", "unknown: of k_ov", "at a bound: k_low", "far: k_far"):
        assert any(words in doubt for doubt in doubts), words
    (rows,) = (t.rows for t in told.tables if "at a bound" in t.columns)
    assert [plain(row[-1]) for row in rows] == ["", "", "lower", ""]
    page = page_html(told, interactive=False)
    for words in ("different optima", "3 samples missing", "yaw_coulomb_friction", "abababab"):
        assert words in page, words
    assert "<b>.csv" not in page
