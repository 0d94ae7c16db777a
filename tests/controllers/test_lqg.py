"""The LQG scenario: it composes, runs, follows, and rejects a constant torque."""

from __future__ import annotations

import numpy as np
import pytest

from trms_cli.controllers.lqr import Lqr
from trms_cli.observers.kalman import Kalman

from ..simulation.looping import composed, looped


def errors(*overrides: str) -> dict[str, np.ndarray]:
    """Of each controlled angle against the true state, rad."""
    experiment = composed("experiment=lqg", *overrides)
    assert isinstance(experiment.controller, Lqr)
    assert isinstance(experiment.observer, Kalman)
    history = looped(experiment).history
    truth, reference = (history.columns(t) for t in ("/plant/state", "/reference"))
    return {name: truth[name] - reference[name] for name in reference}


@pytest.mark.parametrize("model", ["newtonian", "newtonian_vertical", "newtonian_horizontal"])
def test_squares_are_followed(model: str) -> None:
    for error in errors(f"model={model}", "sim.duration=40").values():
        assert np.sqrt((error**2).mean()) < 0.25
        for end in (1000, 2000):  # before each change of the reference
            assert np.abs(error[end - 50 : end]).max() < 0.01


def test_a_push_leaves_no_offset() -> None:
    error = errors(
        "ref=constant",
        "ref.alpha_v.offset=0.1",
        "ref.alpha_h.offset=0.4",
        "disturbance@plant.disturbances=[yaw_push]",
        "plant.disturbances.yaw_push.torque.start=15",
        "sim.duration=40",
    )["alpha_h"]
    assert np.abs(error[750:1000]).max() > 0.02  # it was felt
    assert np.abs(error[-100:]).max() < 0.01
