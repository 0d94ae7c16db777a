"""Figures of networks: what they show, also of trainings that diverged."""

from pathlib import Path

import numpy as np
import pytest

from experiments.chapter3 import training_picture as picture


@pytest.fixture
def figures(monkeypatch):
    """The figures instead of their files."""
    saved_figures = []
    monkeypatch.setattr(picture, "save_png", lambda figure, path: saved_figures.append(figure))
    return saved_figures


def words(figure) -> str:
    figure.canvas.draw()
    texts = [text.get_text() for axes in figure.axes for text in axes.texts]
    return " ".join(texts)


def test_a_training_that_diverged_is_counted_and_not_drawn(figures):
    rows = [
        picture.Spread("lm", np.array([10.0, 12.0, np.inf]), np.array([0.5, 0.6, 0.7])),
        picture.Spread("gd", np.array([np.inf] * 3), np.array([0.1, 0.2, 0.3])),
    ]
    picture.draw_spread(rows, Path("x.png"), unit="mrad", what="error")
    figure = figures[0]
    assert "1 of 3 diverged" in words(figure)
    assert "3 of 3 diverged" in words(figure)
    drawn = [line.get_xdata() for line in figure.axes[0].lines]
    assert all(np.isfinite(values).all() for values in drawn)


def test_a_learning_curve_shows_root_mean_squares_from_epoch_zero(figures):
    losses, seconds = np.array([1.0, 0.25, 0.04]), np.array([0.0, 0.1, 0.3])
    picture.draw_learning([picture.LearningCurve("lm", losses, seconds)], Path("x.png"))
    epochs, time = (axes.lines[0] for axes in figures[0].axes)
    assert list(epochs.get_xdata()) == [0, 1, 2]
    assert epochs.get_ydata() == pytest.approx([1.0, 0.5, 0.2])
    assert time.get_xdata() == pytest.approx(seconds)


def test_the_map_of_structures_frames_the_selected_one(figures):
    errors = np.array([[[3.0, 4.0], [2.0, 2.0]], [[1.0, np.inf], [5.0, 6.0]]])
    picture.draw_structure([1, 2], [4, 8], errors, (1, 8), Path("x.png"))
    axes = figures[0].axes[0]
    frame = axes.patches[-1]
    assert (frame.get_x(), frame.get_y()) == (0.5, -0.5)
    assert "∞" in words(figures[0])


def test_a_page_has_a_row_a_network_with_its_run_and_its_tests(figures):
    time, lags = np.linspace(0, 10, 50), np.arange(1.0, 6.0)
    tests = [
        picture.Correlation("φ_ξξ", lags, 0.3 / lags, np.full(5, 0.1), True),
        picture.Correlation("φ_uξ", lags, 0.01 / lags, np.full(5, 0.1), False),
    ]
    rows = [
        picture.ResponseRow("lm", {"alpha_v": np.cos(time)}, {"alpha_v": 12.3}, {"alpha_v": tests}),
        picture.ResponseRow(
            "gd", {"alpha_v": np.exp(5 * time)}, {"alpha_v": np.inf}, {"alpha_v": tests}
        ),
    ]
    picture.draw_responses(time, {"alpha_v": np.sin(time)}, rows, Path("x.png"), title="t")
    axes = figures[0].axes
    assert len(axes) == 2 * 3
    assert "RMS 12.3 mrad" in words(figures[0])
    assert "RMS > 1 rad" in words(figures[0])
    assert axes[3].get_ylim()[1] < 2.0  # what diverges leaves the measured range visible
    assert axes[1].lines[0].get_color() == picture.ALARM
    assert axes[2].lines[0].get_color() != picture.ALARM


def test_a_free_run_that_diverges_leaves_the_measured_range_visible(figures):
    time = np.linspace(0, 10, 50)
    measured = {"alpha_v": np.sin(time)}
    runs = {"NNARX": {"alpha_v": np.exp(time)}}
    picture.draw_free_runs(
        time, measured, runs, {"u_v": time * 0}, {"alpha_v": "rad"}, Path("x.png")
    )
    low, high = figures[0].axes[0].get_ylim()
    assert -2 < low < high < 2


def test_a_failed_correlation_test_stands_out(figures):
    lags, band = np.arange(1, 6), np.full(5, 0.1)
    tests = [
        picture.Correlation(name, lags, np.full(5, size), band, failed)
        for name, size, failed in (("a", 0.05, False), ("b", 0.5, True), ("c", np.nan, False))
    ]
    picture.draw_correlations(tests, Path("x.png"))
    colours = [axes.lines[0].get_color() for axes in figures[0].axes[:3]]
    assert colours[0] == colours[2] != colours[1]
