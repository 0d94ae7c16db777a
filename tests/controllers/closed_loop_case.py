"""A closed loop of a few lines for tests of linear controllers: the rig is the model itself."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from trms_cli.controllers.controller import Controller, ControlSample, ControlSetup
from trms_cli.core.compilation import BufferedFunction
from trms_cli.models.discretisation import discretise
from trms_cli.models.estimate import Estimate
from trms_cli.models.model import Model

SAMPLE_TIME = 0.02
#: Half a period of the default squares, s.
LEVEL_TIME = 20.0
LEVEL = {"alpha_v": 0.3, "alpha_h": 0.5}


@dataclass
class Trajectory:
    """x: (n, n_x), u: (n, n_u), r: (n, n_r), one row a sample."""

    model: Model
    x: np.ndarray
    u: np.ndarray
    r: np.ndarray

    def error(self, angle: str) -> np.ndarray:
        return (
            self.x[:, self.model.state_index(angle)] - self.r[:, self.model.controlled.index(angle)]
        )

    def levels(self, angle: str) -> list[np.ndarray]:
        """Errors towards the new level on each level after the first, overshoot positive."""
        n = round(LEVEL_TIME / SAMPLE_TIME)
        side = np.sign(self.r[:, self.model.controlled.index(angle)])
        signed = self.error(angle) * side
        return [signed[k : k + n] for k in range(n, len(signed) - n + 1, n)]


def squares(model: Model) -> Callable[[float], np.ndarray]:
    """The default references."""
    level = np.array([LEVEL[name] for name in model.controlled])

    def reference(time: float) -> np.ndarray:
        return level if (time / (2 * LEVEL_TIME)) % 1 < 0.5 else -level

    return reference


def run(
    controller: Controller,
    model: Model,
    reference: Callable[[float], np.ndarray],
    duration: float,
    torque: Callable[[float], np.ndarray] | None = None,
    start: np.ndarray | None = None,
    rig: Model | None = None,
) -> Trajectory:
    """Close the loop around the true state."""
    rig = rig or model
    discrete = discretise(rig, SAMPLE_TIME)
    step, p = BufferedFunction(discrete.step), rig.parameters.values
    u = np.zeros(model.n_u)
    x = discrete.initial(model.rest() if start is None else start, u)
    state = controller.init(ControlSetup(model, SAMPLE_TIME, u))
    n_x, n_w = model.n_x, model.n_w
    samples = round(duration / SAMPLE_TIME)
    rows: tuple[list[np.ndarray], ...] = ([], [], [])
    upper = model.input_bounds()[1]
    for k in range(samples):
        time = k * SAMPLE_TIME
        estimate = Estimate(x[:n_x].copy(), np.zeros(n_x), np.zeros(n_w), np.zeros(n_w))
        sample = ControlSample(time, reference(time)[None, :], estimate, u)
        u = controller.step(state, sample, want_prediction=False).u
        assert np.all(np.abs(u) <= upper)
        for row, value in zip(rows, (x[:n_x], u, reference(time)), strict=True):
            row.append(value.copy())
        w = np.zeros(n_w) if torque is None else torque(time)
        x = step.evaluate(x, u, p, w)[0].copy()
    return Trajectory(model, *(np.array(row) for row in rows))
