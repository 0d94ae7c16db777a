"""The panel of estimated torques: which they are, and that its lines can be read."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.figure import Figure

from trms_cli.reporting.torques import draw_torques, estimated_torques

TIME = np.arange(2000) * 0.02


def column(value: float) -> np.ndarray:
    return np.full(len(TIME), value)


def test_torques_by_where_they_act_without_those_that_nobody_estimates():
    estimate = {
        "alpha_v": column(0.1),
        "sd_alpha_v": column(0.1),
        "pitch_moment": column(0.0),
        "sd_pitch_moment": column(1e-3),
        "yaw_moment": column(0.0),
        "sd_yaw_moment": column(0.0),
        "tail_motor": column(0.0),
        "sd_tail_motor": column(1e-3),
        "main_motor": column(0.0),
    }
    assert estimated_torques(estimate) == {"axes": ["pitch_moment"], "rotors": ["tail_motor"]}


@pytest.mark.parametrize(("value", "sd"), [(0.005, 1e-4), (0.0, 1e-3), (-0.02, 2e-3)])
def test_the_panel_reaches_as_far_as_the_line_and_its_band(value, sd):
    panel = Figure().subplots()
    torque, deviation = column(value), column(sd)
    torque[:50] = 1.0  # an observer that finds its feet
    deviation[:50] = 1.0
    torque[1000] = 5.0  # one outlier
    draw_torques(panel, TIME, {"yaw_moment": torque, "sd_yaw_moment": deviation}, ["yaw_moment"])
    low, high = panel.get_ylim()
    assert low <= 1e3 * min(value - 2 * sd, 0) and high >= 1e3 * max(value + 2 * sd, 0)
    assert high - low < 1.2e3 * (abs(value) + 4 * sd)


def test_without_torques_the_panel_stays_empty():
    panel = Figure().subplots()
    draw_torques(panel, TIME, {}, [])
    assert panel.get_legend() is None
