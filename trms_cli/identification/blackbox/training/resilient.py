"""Resilient propagation (RPROP).

M. Riedmiller & H. Braun (1993), IEEE Int. Conf. Neural Networks: each weight has a step of its
own that grows while the sign of its slope stays and shrinks when it changes; the size of the
slope plays no part. After a change of sign the last step of that weight is taken back and its
slope counts as zero once.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from msgspec import Meta

from trms_cli.core.arrays import FloatArray
from trms_cli.identification.blackbox.prediction_error import TrainingObjective
from trms_cli.identification.blackbox.training.training import EpochReport, TrainingAlgorithm


@dataclass(frozen=True, kw_only=True)
class Resilient(TrainingAlgorithm):
    """RPROP."""

    first_step: Annotated[float, Meta(gt=0)] = 0.01  #: Of each weight at the start
    least_step: Annotated[float, Meta(gt=0)] = 1e-7  #: Its lower bound
    most_step: Annotated[float, Meta(gt=0)] = 5.0  #: Its upper bound
    growth: Annotated[float, Meta(gt=1)] = 1.2  #: η⁺ and η⁻
    decay: Annotated[float, Meta(gt=0, lt=1)] = 0.5  #: η⁺ and η⁻

    def minimise(
        self, objective: TrainingObjective, start: FloatArray, report: EpochReport
    ) -> None:
        theta, step = start, np.full_like(start, self.first_step)
        before, change = np.zeros_like(theta), np.zeros_like(theta)
        _, slope = objective.gradient(theta)
        while True:
            agreement = before * slope
            grown = np.minimum(step * self.growth, self.most_step)
            shrunk = np.maximum(step * self.decay, self.least_step)
            step = np.where(agreement > 0, grown, np.where(agreement < 0, shrunk, step))
            change = np.where(agreement < 0, -change, -np.sign(slope) * step)
            before = np.where(agreement < 0, 0.0, slope)
            theta = theta + change
            loss, slope = objective.gradient(theta)
            if not np.isfinite(loss):
                return
            report(theta, loss, float(np.linalg.norm(slope)))
