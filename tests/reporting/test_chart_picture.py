"""Charts as figures: every mark is drawn, legends tell looks apart, equal ones look equal."""

import io

import numpy as np
import pytest

from trms_cli.core.chart import (
    Axis,
    Band,
    Chart,
    Contour,
    Curve,
    Flow,
    Line,
    Note,
    Panel,
    Points,
    Region,
)
from trms_cli.reporting.chart_picture import picture_of
from trms_cli.reporting.style import house_style

GRID = np.linspace(-1.0, 1.0, 11)
X, Y = np.meshgrid(GRID, GRID)
MARKS = [
    Curve(GRID, GRID**2, "parabola", arrow=True),
    Points([0.0], [0.0], "rest", marker="stable", names=["here"]),
    Flow(GRID, GRID, Y, -X),
    Contour(GRID, GRID, X + Y, [0.0], "nullcline", "orange", numbers=True),
    Region(GRID, GRID, X**2 + Y**2 < 0.5, "set"),
    Band(GRID, GRID - 0.1, GRID + 0.1, "strip", "green"),
    Line(x=0.5, label="limit"),
    Line(y=0.25),
    Note(0.0, 0.5, "words"),
]


def drawn(*panels: Panel):
    with house_style():
        return picture_of(Chart("one", panels, "caption"))


def pixels(figure) -> bytes:
    content = io.BytesIO()
    with house_style():
        figure.savefig(content, format="rgba")
    return content.getvalue()


def panel(marks, **more) -> Panel:
    return Panel(Axis("x", "m"), Axis("y"), marks, **more)


def legends(figure) -> list[list[str]]:
    found = [*figure.legends, *(a.get_legend() for a in figure.axes if a.get_legend())]
    return [[text.get_text() for text in legend.get_texts()] for legend in found]


@pytest.mark.parametrize("mark", MARKS, ids=lambda mark: type(mark).__name__)
def test_every_mark_leaves_the_same_ink_each_time(mark):
    ink = pixels(drawn(panel([mark])))
    assert ink != pixels(drawn(panel([])))
    assert ink == pixels(drawn(panel([mark])))


def test_the_legend_has_every_label_once():
    figure = drawn(panel([*MARKS, *MARKS]))
    assert legends(figure) == [["parabola", "rest", "nullcline", "set", "strip", "limit"]]


def test_panels_share_a_legend_where_no_look_means_two_things():
    same = drawn(panel([Curve(GRID, GRID, "a")]), panel([Curve(GRID, GRID, "a")]))
    assert legends(same) == [["a"]]
    clash = drawn(panel([Curve(GRID, GRID, "a")]), panel([Curve(GRID, GRID, "b")]))
    assert legends(clash) == [["a"], ["b"]]


def test_axes_have_units_and_the_limits_that_were_asked_for():
    figure = drawn(Panel(Axis("ω", "rad/s", (-3, 3)), Axis("n", log=True), [Curve([1], [10])]))
    (axes,) = figure.axes
    assert axes.get_xlabel() == "ω [rad/s]" and axes.get_ylabel() == "n"
    assert axes.get_xlim() == (-3, 3) and axes.get_yscale() == "log"


def test_three_axes():
    marks = [Curve(GRID, GRID, z=GRID, label="path"), Points([0], [0], z=[0], names=["rest"])]
    figure = drawn(panel(marks, z=Axis("z", "rad")))
    assert figure.axes[0].get_zlabel() == "z [rad]"


def test_nothing_to_draw_is_no_error():
    empty = np.full_like(GRID, np.nan)
    marks = [
        Curve(empty, empty, "nothing", arrow=True),
        Curve([], [], arrow=True),
        Region(GRID, GRID, np.zeros((11, 11), bool), "empty"),
        Contour(GRID, GRID, np.full((11, 11), np.nan), [0.0], "none"),
    ]
    pixels(drawn(panel(marks)))
