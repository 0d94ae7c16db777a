"""The LQG scenario: it composes, runs, follows, and rejects a constant torque."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from trms_cli.composition.composer import compose
from trms_cli.controllers.lqr import Lqr
from trms_cli.library.tasks.experiment import experiment_of, topics_of
from trms_cli.observers.kalman import Kalman
from trms_cli.simulation.closed_loop import Loop
from trms_cli.simulation.history import History


def looped(*overrides: str) -> Loop:
    """The scenario, run in memory."""
    experiment = experiment_of(compose(["experiment=lqg", *overrides]).config)
    assert isinstance(experiment.controller, Lqr)
    assert isinstance(experiment.observer, Kalman)

    def make_history(plant: Any) -> History:
        topics = topics_of(experiment, plant)
        return History({t.name: {f.name: f.unit for f in t.fields} for t in topics}, None)

    loop = Loop.start(experiment, make_history)
    loop.run()
    return loop


def errors(loop: Loop) -> dict[str, np.ndarray]:
    """Of each controlled angle against the true state, rad."""
    truth, reference = (loop.history.columns(t) for t in ("/plant/state", "/reference"))
    return {name: truth[name] - reference[name] for name in reference}


@pytest.mark.parametrize("model", ["newtonian", "newtonian_vertical", "newtonian_horizontal"])
def test_squares_are_followed(model: str) -> None:
    for error in errors(looped(f"model={model}", "sim.duration=40")).values():
        assert np.sqrt((error**2).mean()) < 0.25
        for end in (1000, 2000):  # before each change of the reference
            assert np.abs(error[end - 50 : end]).max() < 0.01


def test_a_push_leaves_no_offset() -> None:
    loop = looped(
        "ref=constant",
        "ref.alpha_v.offset=0.1",
        "ref.alpha_h.offset=0.4",
        "disturbance@plant.disturbances=[yaw_push]",
        "plant.disturbances.yaw_push.torque.start=15",
        "sim.duration=40",
    )
    error = errors(loop)["alpha_h"]
    assert np.abs(error[750:1000]).max() > 0.02  # it was felt
    assert np.abs(error[-100:]).max() < 0.01
