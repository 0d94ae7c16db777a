"""Specifications of plots: no peak lost, no text taken for markup, nothing that is no JSON."""

from __future__ import annotations

import base64
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trms_cli.core.chart import Axis, Band, Curve, Fans, Panel, page_look
from trms_cli.reporting.chart_plot import (
    packed,
    packed_time,
    plot_text,
    plots,
    script_json,
    thinned,
)
from trms_cli.reporting.run_panels import framed


def unpacked(array):
    return np.frombuffer(base64.b64decode(array["bdata"]), dtype="<" + array["dtype"])


def drawn(mark):
    """The trace of a mark that is alone in its panel."""
    ((trace,),) = [plot.traces for plot in plots([Panel(Axis("t", "s"), Axis("y"), [mark])])]
    return trace


@given(
    st.lists(st.floats(-1e6, 1e6) | st.just(np.nan), min_size=1, max_size=400), st.integers(4, 60)
)
def test_thinning_keeps_extremes_order_and_gaps(values, most):
    values = np.array(values)
    time = np.arange(len(values), dtype=float)
    kept_time, kept = thinned(time, values, most)
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
    kept_time, kept = thinned(time, values, 1000)
    for begin in range(0, 10_000, 20):
        within = (kept_time >= time[begin]) & (kept_time <= time[begin + 19])
        assert kept[within].max() == values[begin : begin + 20].max()
        assert kept[within].min() == values[begin : begin + 20].min()


def test_few_samples_stay_as_they_are():
    time, values = thinned([0, 1, 2], [3, np.nan, 5], 10)
    np.testing.assert_array_equal(time, [0, 1, 2])
    np.testing.assert_array_equal(values, [3, np.nan, 5])


@given(st.lists(st.floats(allow_nan=True, allow_infinity=True, width=64), max_size=50))
def test_packing_keeps_seven_digits(values):
    back = unpacked(packed(values))
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


def test_what_is_no_text_does_not_stop_a_page():
    assert json.loads(script_json(["a\udcffb"])) == ["a?b"]


@pytest.mark.parametrize(
    "text",
    [
        "<b>bold</b>",
        '<a href="javascript:alert(1)">x</a>',
        "%{y} %{customdata}",
        "a\nb",
        "&lt;b&gt;",
    ],
)
def test_text_of_a_plot_is_no_markup_and_no_placeholder(text):
    shown = plot_text(text)
    assert "<" not in shown and ">" not in shown and "%{" not in shown and "\n" not in shown


def test_long_text_of_a_plot_is_cut():
    assert len(plot_text("x" * 10_000)) == 200


def test_a_band_ends_at_gaps_and_covers_all_between_its_edges():
    time = np.arange(2000.0)
    low, high = -np.ones(2000), np.sin(time / 50) + 2
    high[900:1000] = np.nan
    trace = drawn(Band(time, low, high, "b"))
    x, y = unpacked(trace["x"]), unpacked(trace["y"])
    assert len(x) == len(y)
    cuts = np.flatnonzero(np.isnan(x))
    assert len(cuts) == 2 and np.array_equal(cuts, np.flatnonzero(np.isnan(y)))
    first = slice(0, cuts[0])
    assert x[first].max() <= 899 and y[first].max() == pytest.approx(high[:900].max())
    assert x[cuts[0] + 1 : cuts[1]].min() >= 1000
    assert trace["fill"] == "toself"


def test_a_band_of_nothing_is_empty():
    trace = drawn(Band([0, 1], [np.nan, np.nan], [1, 1], "b"))
    assert not len(unpacked(trace["x"])) and not len(unpacked(trace["y"]))


def test_the_range_is_of_what_happened():
    assert framed([]) is None and framed([np.array([np.nan])]) is None
    assert framed([np.array([0.0, 1.0]), np.array([np.nan, -1.0])]) == pytest.approx((-1.16, 1.16))
    low, high = framed([np.array([3.0])])
    assert low < 3.0 < high


def test_two_dozen_curves_are_told_apart():
    assert len({tuple(page_look(number).values()) for number in range(24)}) == 24


def test_a_plot_as_the_script_gets_it():
    time = Axis("time", "s", linked="time")
    fans = Fans([0.0, 1.0], [0, 1, np.nan, 1, 2, np.nan], [1, 2, np.nan, 2, 3, np.nan])
    other = Panel(time, Axis("u", "V"), [Curve([0, 1], [3, 4], "<x>", held=True), fans])
    panel = Panel(time, Axis("alpha"), [Curve([0, 1], [1, 2], "<x>", held=True), fans],
                  variants={"other": other})  # fmt: skip
    (plot,) = plots([panel])
    told = json.loads(script_json(plot.document()))
    assert told["group"] == "time" and told["traces"][0]["name"] == "&lt;x&gt;"
    assert told["traces"][0]["line"]["shape"] == "hv"
    (variant,) = told["variants"]
    assert variant["titles"] == {"yaxis": "u [V]"}
    assert [list(changed) for changed in variant["traces"]] == [["y"], [], []]
    assert told["fans"] == {"times": [0.0, 1.0], "starts": [0, 3, 6], "pairs": [[1, 2]]}
