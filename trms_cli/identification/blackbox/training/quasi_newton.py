"""Quasi-Newton training: BFGS (scipy's) and the one-step secant method.

One-step secant (R. Battiti 1992, Neural Computation 4(2)) is BFGS that forgets: the inverse
Hessian before each update is the identity, so that a direction costs a few products of vectors::

    d = −g + A s + B y,   s = θ_k − θ_{k−1},  y = g_k − g_{k−1},
    B = sᵀg / sᵀy,        A = −(1 + yᵀy/sᵀy) sᵀg/sᵀy + yᵀg/sᵀy
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from msgspec import Meta

from trms_cli.core.arrays import FloatArray
from trms_cli.identification.blackbox.prediction_error import TrainingObjective
from trms_cli.identification.blackbox.training.conjugate_gradient import (
    LineSearch,
    minimise_by_scipy,
)
from trms_cli.identification.blackbox.training.training import EpochReport, TrainingAlgorithm


@dataclass(frozen=True, kw_only=True)
class Bfgs(TrainingAlgorithm):
    """``scipy.optimize.minimize(method="BFGS")``."""

    def minimise(
        self, objective: TrainingObjective, start: FloatArray, report: EpochReport
    ) -> None:
        minimise_by_scipy("BFGS", {}, objective, start, report)


@dataclass(frozen=True, kw_only=True)
class OneStepSecant(TrainingAlgorithm):
    """Battiti's memoryless BFGS with a strong Wolfe line search."""

    curvature: Annotated[float, Meta(gt=0, lt=1)] = 0.4  #: Share of the slope that a search leaves

    def minimise(
        self, objective: TrainingObjective, start: FloatArray, report: EpochReport
    ) -> None:
        search = LineSearch(objective, self.curvature)
        theta, (loss, slope) = start, search.evaluate(start)
        direction, before, fresh = -slope, None, True
        while True:
            length = search.step(theta, direction, loss, slope, before)
            if length is None:
                if fresh:
                    return
                direction, fresh = -slope, True
                continue
            s = length * direction
            theta = theta + s
            before, (loss, after) = loss, search.evaluate(theta)
            direction = _secant(after, s, after - slope)
            slope, fresh = after, False
            report(theta, loss, float(np.linalg.norm(slope)))


def _secant(slope: FloatArray, s: FloatArray, y: FloatArray) -> FloatArray:
    """Battiti's direction; steepest descent where it does not descend."""
    sy = float(s @ y)
    if sy <= 0:
        return -slope
    b = float(s @ slope) / sy
    a = -(1.0 + float(y @ y) / sy) * b + float(y @ slope) / sy
    direction = -slope + a * s + b * y
    return direction if direction @ slope < 0 else -slope
