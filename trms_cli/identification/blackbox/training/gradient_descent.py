"""Gradient descent: plain, with momentum, with an adaptive rate, with both.

Momentum is that of Rumelhart, Hinton & Williams (1986, Nature 323), the adaptive rate that of
Vogl, Mangis, Rigler, Zink & Alkon (1988, Biological Cybernetics 59)::

    Δ_k = μ Δ_{k−1} − η ∇E        a step that raises E by more than the tolerance is taken back,
                                   μ counts as zero until a step succeeds, and η falls; after a
                                   step that lowers E, η grows
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from msgspec import Meta

from trms_cli.core.arrays import FloatArray
from trms_cli.identification.blackbox.prediction_error import TrainingObjective
from trms_cli.identification.blackbox.training.training import EpochReport, TrainingAlgorithm

#: A rate that fell this low moves no weight any more.
_LEAST_RATE = 1e-12


@dataclass(frozen=True, kw_only=True)
class GradientDescent(TrainingAlgorithm):
    """Steps down the gradient."""

    learning_rate: Annotated[float, Meta(gt=0)] = 0.05  #: η at the start
    momentum: Annotated[float, Meta(ge=0, lt=1)] = 0.0  #: μ; 0 for none
    adaptive: bool = False  #: Whether η adapts and bad steps are taken back
    growth: Annotated[float, Meta(ge=1)] = 1.05  #: Factor of η after a good step
    decay: Annotated[float, Meta(gt=0, lt=1)] = 0.7  #: After a bad one
    tolerance: Annotated[float, Meta(ge=1)] = 1.04  #: Factor by which a step may raise the loss

    def minimise(
        self, objective: TrainingObjective, start: FloatArray, report: EpochReport
    ) -> None:
        theta, rate = start, self.learning_rate
        change, momentum = np.zeros_like(theta), self.momentum
        loss, slope = objective.gradient(theta)
        while rate > _LEAST_RATE and np.isfinite(loss):
            trial_change = momentum * change - rate * slope
            trial = theta + trial_change
            trial_loss, trial_slope = objective.gradient(trial)
            if self.adaptive and not trial_loss <= self.tolerance * loss:
                rate *= self.decay
                momentum = 0.0
            else:
                if self.adaptive and trial_loss < loss:
                    rate *= self.growth
                    momentum = self.momentum
                theta, change, loss, slope = trial, trial_change, trial_loss, trial_slope
            report(theta, loss, float(np.linalg.norm(slope)))
