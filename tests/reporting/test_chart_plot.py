"""Charts for a browser: no peak lost, no text taken for markup, the same data as in print."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.reporting.conftest import unpacked
from trms_cli.core.chart import (
    Axis,
    Band,
    Chart,
    Contour,
    Curve,
    Fans,
    Flow,
    Line,
    Note,
    Panel,
    Points,
    Region,
    Span,
    as_data,
    page_look,
)
from trms_cli.reporting.chart_picture import picture_of
from trms_cli.reporting.chart_plot import (
    pack_array,
    packed_time,
    plot_text,
    plots_of,
    script_json,
    thin_samples,
)
from trms_cli.reporting.run_panels import axis_range
from trms_cli.reporting.style import house_style

GRID = np.linspace(-2.0, 2.0, 41)
X, Y = np.meshgrid(GRID, GRID)


def drawn(*marks, x=None):
    (plot,) = plots_of(Chart("one", [Panel(x or Axis("x"), Axis("y"), marks)], "Seen so."))
    return plot


def test_curves_have_their_points_and_one_name_each_in_the_legend():
    curve = Curve([0.0, 1.0], [2.0, 3.0], "a", "vermilion", "dashed", is_step=True)
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
    marks = [
        Curve([0.0, 1.0, 2.0], [0, 1, 0], is_step=True),
        Span(0.5, 1.0, "late"),
        Points([1], [1]),
    ]
    chart = Chart("held", [Panel(Axis("t", linked="time"), Axis("u"), marks)])
    with house_style():
        (axes,) = picture_of(chart).axes
    assert axes.lines[0].get_drawstyle() == "steps-post"
    data = as_data(chart)["panels"][0]
    assert data["marks"][0]["held"] is True and data["x"]["linked"] == "time"
    assert "linked" not in data["y"] and data["marks"][1]["kind"] == "span"


@given(
    st.lists(st.floats(-1e6, 1e6) | st.just(np.nan), min_size=1, max_size=400), st.integers(4, 60)
)
def test_thinning_keeps_extremes_order_and_gaps(values, most):
    values = np.array(values)
    time = np.arange(len(values), dtype=float)
    kept_time, kept = thin_samples(time, values, most)
    assert np.all(np.diff(kept_time) > 0)
    np.testing.assert_array_equal(values[kept_time.astype(int)], kept)
    if np.isfinite(values).any():
        assert np.nanmax(kept) == np.nanmax(values) and np.nanmin(kept) == np.nanmin(values)
    assert np.isnan(kept).any() == np.isnan(values).any()
    # two extremes of a piece, and its gap if it has one
    assert len(kept) <= 1.5 * most + 3


def test_thinning_keeps_the_extremes_of_every_stretch():
    values = np.random.default_rng(1).normal(size=10_000)
    time = np.arange(10_000) * 0.01
    kept_time, kept = thin_samples(time, values, 1000)
    for begin in range(0, 10_000, 20):
        within = (kept_time >= time[begin]) & (kept_time <= time[begin + 19])
        assert kept[within].max() == values[begin : begin + 20].max()
        assert kept[within].min() == values[begin : begin + 20].min()
    # few stay as they are
    few_time, few = thin_samples([0, 1, 2], [3, np.nan, 5], 10)
    np.testing.assert_array_equal([few_time, few], [[0, 1, 2], [3, np.nan, 5]])


@given(st.lists(st.floats(allow_nan=True, allow_infinity=True, width=64), max_size=50))
def test_packing_keeps_seven_digits(values):
    back = unpacked(pack_array(values))
    for told, value in zip(back, values, strict=True):
        if np.isfinite(value) and 1e-30 < abs(value) < 1e30:
            assert told == pytest.approx(value, rel=1e-7)


def test_long_times_are_not_blurred():
    hours = np.arange(36_000.0, 36_001.0, 0.01)
    assert np.abs(unpacked(packed_time(hours)) - hours).max() < 1e-9
    seconds = np.arange(0.0, 80.0, 0.01)
    assert packed_time(seconds)["dtype"] == "f4"
    assert np.abs(unpacked(packed_time(seconds)) - seconds).max() < 1e-4


@given(st.text())
def test_json_in_a_page_neither_ends_its_element_nor_changes_what_it_says(text):
    told = script_json({"name": text, "list": [text, float("nan"), float("inf"), np.float64(1.5)]})
    assert not set(told) & set("<>&\u2028\u2029")
    assert json.loads(told) == {"name": text, "list": [text, None, None, 1.5]}
    assert json.loads(script_json(["a\udcffb"])) == ["a?b"]  # what is no text stops no page


@pytest.mark.parametrize(
    "text",
    ["<b>bold</b>", '<a href="javascript:alert(1)">', "%{y} %{customdata}", "a\nb", "&lt;b&gt;"],
)
def test_text_of_a_plot_is_no_markup_and_no_placeholder_and_is_cut(text):
    shown = plot_text(text)
    assert "<" not in shown and ">" not in shown and "%{" not in shown and "\n" not in shown
    assert len(plot_text("x" * 10_000)) == 200


def test_a_band_ends_at_gaps_and_covers_all_between_its_edges():
    time = np.arange(2000.0)
    low, high = -np.ones(2000), np.sin(time / 50) + 2
    high[900:1000] = np.nan
    (trace,) = drawn(Band(time, low, high, "b")).traces
    x, y = unpacked(trace["x"]), unpacked(trace["y"])
    assert len(x) == len(y)
    cuts = np.flatnonzero(np.isnan(x))
    assert len(cuts) == 2 and np.array_equal(cuts, np.flatnonzero(np.isnan(y)))
    first = slice(0, cuts[0])
    assert x[first].max() <= 899 and y[first].max() == pytest.approx(high[:900].max())
    assert x[cuts[0] + 1 : cuts[1]].min() >= 1000
    assert trace["fill"] == "toself"
    (nothing,) = drawn(Band([0, 1], [np.nan, np.nan], [1, 1], "b")).traces
    assert not len(unpacked(nothing["x"])) and not len(unpacked(nothing["y"]))


def test_the_range_is_of_what_happened():
    assert axis_range([]) is None and axis_range([np.array([np.nan])]) is None
    two = [np.array([0.0, 1.0]), np.array([np.nan, -1.0])]
    assert axis_range(two) == pytest.approx((-1.16, 1.16))
    low, high = axis_range([np.array([3.0])])
    assert low < 3.0 < high


def test_two_dozen_curves_are_told_apart():
    assert len({tuple(page_look(number).values()) for number in range(24)}) == 24


def test_a_plot_as_the_script_gets_it():
    time = Axis("time", "s", linked="time")
    fans = Fans([0.0, 1.0], [0, 1, np.nan, 1, 2, np.nan], [1, 2, np.nan, 2, 3, np.nan])
    other = Panel(time, Axis("u", "V"), [Curve([0, 1], [3, 4], "<x>", is_step=True), fans])
    panel = Panel(time, Axis("alpha"), [Curve([0, 1], [1, 2], "<x>", is_step=True), fans],
                  variants={"other": other})  # fmt: skip
    (plot,) = plots_of(Chart("one", [panel], columns=1))
    told = json.loads(script_json(plot.document()))
    assert told["group"] == "time" and told["traces"][0]["name"] == "&lt;x&gt;"
    assert told["traces"][0]["line"]["shape"] == "hv"
    (variant,) = told["variants"]
    assert variant["titles"] == {"yaxis": "u [V]"}
    assert [list(changed) for changed in variant["traces"]] == [["y"], [], []]
    assert told["fans"] == {"times": [0.0, 1.0], "starts": [0, 3, 6], "pairs": [[1, 2]]}
