"""Figures and page of a fit."""

from __future__ import annotations

import numpy as np
import pytest

from trms_cli.reporting.identification_page import identification_page
from trms_cli.reporting.identification_picture import (
    FreeRunTrace,
    convergence_figure,
    draw,
    free_run_figure,
    parameter_figure,
)


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
def trace() -> FreeRunTrace:
    time = np.arange(0, 20, 0.02)
    after = np.sin(time) + 0.01
    after[700:] = np.nan  # the simulation overflowed
    return FreeRunTrace(
        "alpha_v", "rad", time, np.sin(time), 1.3 * np.sin(time), after, np.array([0.0, 10.0])
    )


@pytest.fixture
def document() -> dict:
    errors = {"rmse": 0.01, "max_abs_error": 0.03, "fit_percent": 98.0, "unit": "rad"}
    part = {"before": {"alpha_v": errors | {"rmse": 0.05}}, "after": {"alpha_v": errors}}
    return {
        "model": "newtonian", "method": "genetic", "command": "trms identify real=<b>.csv",
        "effects": ["yaw_coulomb_friction"], "driven": [], "versions": {"trms": "1"},
        "sentence": "converged", "evaluations": 50, "seconds": {"fit": 1.0},
        "windows": {"length_s": 10.0}, "settings": {"_target_": "x", "individuals": 50},
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


def test_curves_break_where_a_window_begins_anew(trace):
    figure = free_run_figure([trace], "rig")
    left = figure.axes[0]
    fitted = next(line for line in left.lines if line.get_label() == "simulated, fitted")
    y = np.asarray(fitted.get_ydata(), dtype=float)
    assert np.isnan(y[499]) and np.isfinite(y[500])
    words = figure.axes[1].get_title(loc="right")
    assert words.endswith("0.01 rad") and "→" in words


def test_every_parameter_has_a_row_and_a_mark(tmp_path):
    figure = parameter_figure(PARAMETERS, "parameters")
    panel = figure.axes[0]
    assert [t.get_text() for t in panel.get_yticklabels()] == list(PARAMETERS)
    labels = [text.get_text() for text in panel.get_legend().get_texts()]
    assert "on a bound" in labels
    assert any("+247 sd" in text.get_text() for text in panel.texts)
    draw(figure, tmp_path / "parameters.png")
    assert (tmp_path / "parameters.png").stat().st_size > 5000


@pytest.mark.parametrize("history", [[], [[1, 0.1, 5.0]], [[1, 0.1, 5.0], [2, 0.2, 5.0]]])
def test_a_search_that_never_fell_is_drawn(history, tmp_path):
    draw(convergence_figure(history, "search"), tmp_path / "search.png")


def test_the_page_tells_errors_doubts_and_recordings(document, trace):
    figures = {"free_runs": (free_run_figure([trace], "rig"), "Free runs.")}
    html = identification_page(document, figures).html()
    for words in (
        "pitch to <strong>0.01 rad</strong> (before: 0.05)", "m_cb, l_cb imitate each other",
        "k_ov: next to nothing", "lower bound", "different optima", "3 samples missing",
        "yaw_coulomb_friction", "abababab",
    ):  # fmt: skip
        assert words in html, words
    assert "<b>.csv" not in html and "http:" not in html.replace("http://www.w3.org", "")
    assert "https:" not in html
