"""The estimate one sample on: what a controller plans from whose command acts a sample later."""

from __future__ import annotations

import math
from dataclasses import replace

from trms_cli.core.arrays import FloatArray
from trms_cli.core.compilation import BufferedFunction
from trms_cli.models.discretisation import discretise
from trms_cli.models.estimate import Estimate
from trms_cli.models.model import Model

_LONGEST_STEP = 0.01  # s, of the integration


class OneStepAhead:
    """Carries estimates on by one sample, with what the model remembers of commands.

    ``first_command``: (n_u,), V; in force before time zero.
    """

    def __init__(self, model: Model, sample_time: float, first_command: FloatArray) -> None:
        substeps = 1 if model.sample_time is not None else math.ceil(sample_time / _LONGEST_STEP)
        discrete = discretise(model, sample_time, substeps)
        self._step = BufferedFunction(discrete.step)
        self._parameters = model.parameters.values
        self._n_x = model.n_x
        self._full = discrete.initial(model.rest(), first_command)

    def __call__(self, estimate: Estimate, command: FloatArray) -> Estimate:
        """The estimate that holds once a command (n_u,) has been in force for one sample."""
        self._full[: self._n_x] = estimate.x
        following = self._step.evaluate(
            self._full, command, self._parameters, estimate.disturbance
        )[0].ravel()
        self._full[self._n_x :] = following[self._n_x :]
        return replace(estimate, x=following[: self._n_x].copy())
