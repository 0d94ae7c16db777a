"""Panels of estimated torques: which they are, and that their lines can be read."""

from typing import Any

import numpy as np
import pytest

from trms_cli.reporting.run_panels import torque_panels
from trms_cli.reporting.signals import RunSignals
from trms_cli.scoring.metrics import Series

TIME = np.arange(2000) * 0.02


def estimating(**columns: Any) -> RunSignals:
    units = dict.fromkeys(columns, "N*m")
    return RunSignals(tables={"/estimate": Series(TIME, columns, units)})


def test_torques_by_where_they_act_without_those_that_nobody_estimates():
    deviations = {"alpha_v": 0.1, "pitch_moment": 1e-3, "yaw_moment": 0.0, "tail_motor": 1e-3}
    columns = dict.fromkeys([*deviations, "main_motor"], np.full_like(TIME, 0.0))
    columns |= {f"sd_{name}": np.full_like(TIME, value) for name, value in deviations.items()}
    run = estimating(**columns)
    assert run.torques() == {"axes": ["pitch_moment"], "rotors": ["tail_motor"]}
    assert [panel.y.unit for panel in torque_panels(run)] == ["mN m", "mN m"]
    assert torque_panels(RunSignals(tables={})) == []


@pytest.mark.parametrize(("value", "sd"), [(0.005, 1e-4), (0.0, 1e-3), (-0.02, 2e-3)])
def test_a_panel_reaches_as_far_as_the_line_and_its_band(value, sd):
    torque, deviation = np.full_like(TIME, value), np.full_like(TIME, sd)
    torque[:50] = 1.0  # an observer that finds its feet
    deviation[:50] = 1.0
    torque[1000] = 5.0  # one outlier
    (panel,) = torque_panels(estimating(yaw_moment=torque, sd_yaw_moment=deviation))
    low, high = panel.y.limits
    assert low <= 1e3 * min(value - 2 * sd, 0) and high >= 1e3 * max(value + 2 * sd, 0)
    assert high - low < 1.2e3 * (abs(value) + 4 * sd)
