"""A chart as data: what the JSON twin holds."""

import json

import numpy as np

from trms_cli.core.chart import Axis, Chart, Curve, Panel, Points, Region, as_data


def chart() -> Chart:
    grid = np.linspace(0.0, 1.0, 3)
    marks = [
        Curve(grid, np.array([1.0, np.nan, np.inf]), "pitch"),
        Points([1 / 3], [2], "rest", marker="stable"),
        Region(grid, grid, np.eye(3, dtype=bool), "inside"),
    ]
    return Chart("one", [Panel(Axis("u_v", "V"), Axis("α_v", "rad"), marks)], "A caption.")


def test_the_data_are_json_of_six_digits_with_a_kind_for_each_mark():
    data = json.loads(json.dumps(as_data(chart()), allow_nan=False))
    curve, points, region = data["panels"][0]["marks"]
    assert [curve["kind"], points["kind"], region["kind"]] == ["curve", "points", "region"]
    assert data["panels"][0]["x"] == {"label": "u_v", "unit": "V", "limits": None, "log": False}
    assert curve["y"] == [1.0, None, None]
    assert points["x"] == [0.333333] and points["y"] == [2]
    assert region["inside"][0] == [True, False, False]
