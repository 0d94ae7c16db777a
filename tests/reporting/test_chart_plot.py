"""Charts for a browser: the same data as in print."""

from __future__ import annotations

import base64

import numpy as np
import pytest

from trms_cli.core.chart import (
    Axis,
    Chart,
    Contour,
    Curve,
    Flow,
    Line,
    Note,
    Panel,
    Points,
    Region,
    Span,
    as_data,
)
from trms_cli.reporting.chart_picture import picture_of
from trms_cli.reporting.chart_plot import plots_of
from trms_cli.reporting.style import house_style

GRID = np.linspace(-2.0, 2.0, 41)
X, Y = np.meshgrid(GRID, GRID)


def unpacked(array):
    return np.frombuffer(base64.b64decode(array["bdata"]), dtype="<" + array["dtype"])


def drawn(*marks, x=None):
    (plot,) = plots_of(Chart("one", [Panel(x or Axis("x"), Axis("y"), marks)], "Seen so."))
    return plot


def test_curves_have_their_points_and_one_name_each_in_the_legend():
    curve = Curve([0.0, 1.0], [2.0, 3.0], "a", "vermilion", "dashed", held=True)
    plot = drawn(curve, Curve([0, 1], [0, 1], "a"), x=Axis("t", "s", linked="time"))
    first, second = plot.traces
    assert unpacked(first["y"]).tolist() == [2.0, 3.0]
    assert first["line"]["color"] == "@vermilion" and first["line"]["dash"] == "dash"
    assert first["line"]["shape"] == "hv"
    assert "showlegend" not in first and second["showlegend"] is False
    assert plot.group == "time" and plot.caption == "Seen so."
    assert plot.layout["xaxis"]["title"]["text"] == "t [s]"


def test_level_lines_lie_on_their_level():
    plot = drawn(Contour(GRID, GRID, X**2 + Y**2, [1.0]))
    x, y = (unpacked(plot.traces[0][key]) for key in "xy")
    inside = np.isfinite(x)
    np.testing.assert_allclose(np.hypot(x, y)[inside], 1.0, atol=2e-3)


def test_stream_lines_follow_the_field():
    plot = drawn(Flow(GRID, GRID, -Y, X))
    x, y = (unpacked(plot.traces[0][key]).astype(float) for key in "xy")
    radius = np.hypot(x, y)
    pieces = np.split(radius, np.flatnonzero(~np.isfinite(radius)))
    spread = [np.ptp(piece[1:]) for piece in pieces if len(piece) > 3]
    assert spread and max(spread) < 0.05  # circles


def test_regions_spans_lines_and_notes():
    region = Region(GRID, GRID, X**2 + Y**2 < 1, "set", "green")
    span, line = Span(0.5, 0.7, colour="pale"), Line(x=1.0, label="limit")
    plot = drawn(region, span, line, Note(10.0, 1.0, "<b>"), x=Axis("x", log=True))
    assert plot.traces[0]["type"] == "contour" and plot.traces[0]["z"][20][20] == 1
    shaded, across = plot.layout["shapes"]
    assert (shaded["x0"], shaded["x1"]) == (0.5, 0.7) and across["x0"] == 1.0
    assert plot.layout["annotations"][0]["x"] == pytest.approx(1.0)  # a power of ten
    assert plot.layout["annotations"][0]["text"] == "&lt;b&gt;"
    assert [trace["name"] for trace in plot.traces] == ["set", "limit"]


def test_three_axes_are_a_picture():
    curve = Curve([0.0, 1.0], [0.0, 1.0], z=[0.0, 1.0])
    chart = Chart("deep", [Panel(Axis("x"), Axis("y"), [curve], z=Axis("z"))])
    assert plots_of(chart) is None


def test_what_is_held_and_shaded_is_drawn_in_print_too():
    marks = [Curve([0.0, 1.0, 2.0], [0, 1, 0], held=True), Span(0.5, 1.0, "late"), Points([1], [1])]
    chart = Chart("held", [Panel(Axis("t", linked="time"), Axis("u"), marks)])
    with house_style():
        (axes,) = picture_of(chart).axes
    assert axes.lines[0].get_drawstyle() == "steps-post"
    data = as_data(chart)["panels"][0]
    assert data["marks"][0]["held"] is True and data["x"]["linked"] == "time"
    assert "linked" not in data["y"] and data["marks"][1]["kind"] == "span"
