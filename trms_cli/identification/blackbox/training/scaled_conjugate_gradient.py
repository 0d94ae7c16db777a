"""Scaled conjugate gradients.

M. F. Møller (1993), Neural Networks 6(4): the step along a conjugate direction comes from the
curvature along it, by a difference of gradients, made positive by a scale λ as in
Levenberg–Marquardt; no line search. Variables as in the paper (s is Møller's product of the
Hessian with p, δ its product with p, μ the slope along −p, Δ the comparison of the predicted with
the found reduction).
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from msgspec import Meta

from trms_cli.core.arrays import FloatArray
from trms_cli.identification.blackbox.prediction_error import TrainingObjective
from trms_cli.identification.blackbox.training.training import EpochReport, TrainingAlgorithm

_MOST_SCALE = 1e15


@dataclass(frozen=True, kw_only=True)
class ScaledConjugateGradient(TrainingAlgorithm):
    """Møller's algorithm."""

    difference: Annotated[float, Meta(gt=0, le=1e-2)] = 5e-5  #: σ, a step for the curvature
    first_scale: Annotated[float, Meta(gt=0, le=1e-2)] = 5e-7  #: λ at the start

    def minimise(
        self, objective: TrainingObjective, start: FloatArray, report: EpochReport
    ) -> None:
        theta = start
        loss, slope = objective.gradient(theta)
        r = -slope
        p = r
        scale, scale_bar, success, k = self.first_scale, 0.0, True, 0
        delta, square = 0.0, float(p @ p)
        while scale < _MOST_SCALE and square > 0:
            k += 1
            if success:
                sigma = self.difference / np.sqrt(square)
                s = (objective.gradient(theta + sigma * p)[1] + r) / sigma
                delta = float(p @ s)
            delta += (scale - scale_bar) * square
            if delta <= 0:  # make the curvature positive
                scale_bar = 2.0 * (scale - delta / square)
                delta = -delta + scale * square
                scale = scale_bar
            mu = float(p @ r)
            alpha = mu / delta
            trial = theta + alpha * p
            trial_loss, trial_slope = objective.gradient(trial)
            comparison = 2.0 * delta * (loss - trial_loss) / mu**2
            if comparison >= 0:
                theta, loss, r_before, r = trial, trial_loss, r, -trial_slope
                scale_bar, success = 0.0, True
                p = r if k % theta.size == 0 else r + (r @ r - r @ r_before) / mu * p
                if comparison >= 0.75:
                    scale = max(scale / 4.0, 1e-15)
            else:
                scale_bar, success = scale, False
            if not comparison >= 0.25:
                growth = delta * (1.0 - comparison) / square
                scale += growth if np.isfinite(growth) else 3.0 * scale
            if p @ r <= 0:  # no descent: start anew
                p, success = r, True
            square = float(p @ p)
            report(theta, loss, float(np.linalg.norm(r)))
