"""What the controllers' tests share: a closed loop without sensors, logs or configuration."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from trms_cli.controllers.controller import Command, ControlSample, ControlSetup
from trms_cli.core.compilation import BufferedFunction
from trms_cli.models.discretisation import discretise
from trms_cli.models.estimate import Estimate
from trms_cli.models.model import Model

sys.path.insert(0, str(Path(__file__).parent))  # linear_model.py


def estimate(x: np.ndarray, disturbance: np.ndarray) -> Estimate:
    """A certain estimate."""
    return Estimate(x, np.zeros_like(x), disturbance, np.zeros_like(disturbance))


@dataclass
class Ran:
    """A closed loop's trajectories, one row a control period."""

    x: list[np.ndarray] = field(default_factory=list)
    u: list[np.ndarray] = field(default_factory=list)
    commands: list[Command] = field(default_factory=list)

    @property
    def states(self) -> np.ndarray:
        return np.array(self.x)

    @property
    def inputs(self) -> np.ndarray:
        return np.array(self.u)


def close_loop(
    controller: Any,
    model: Model,
    reference: Callable[[np.ndarray], np.ndarray],
    seconds: float,
    *,
    plant: Model | None = None,
    x0: np.ndarray | None = None,
    disturbance: np.ndarray | None = None,
) -> Ran:
    """Full state, known disturbance; ``reference`` maps times (n,) to (n, n_r)."""
    period = controller.sample_time
    setup = ControlSetup(model, period, np.zeros(model.n_u))
    preview = controller.preview(setup)
    state = controller.init(setup)
    rig = plant or model
    w = np.zeros(rig.n_w) if disturbance is None else disturbance
    step = BufferedFunction(discretise(rig, period, 10).step)
    x = rig.rest() if x0 is None else x0.copy()
    u = np.zeros(model.n_u)
    lower, upper = model.input_bounds()
    ran = Ran()
    for k in range(round(seconds / period)):
        times = (k + np.arange(preview + 1)) * period
        sample = ControlSample(k * period, reference(times), estimate(x.copy(), w), u)
        command = controller.step(state, sample, want_prediction=k == 0)
        u = np.clip(command.u, lower, upper)
        ran.x.append(x.copy())
        ran.u.append(u.copy())
        ran.commands.append(command)
        x = step.evaluate(x, u, rig.parameters.values, w)[0].copy()
    return ran


@pytest.fixture(name="close_loop")
def _close_loop() -> Callable[..., Ran]:
    return close_loop
