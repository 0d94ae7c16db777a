"""Levenberg–Marquardt for networks.

M. T. Hagan & M. B. Menhaj (1994), IEEE Trans. Neural Networks 5(6): the step solves
``(JᵀJ + μ I) Δ = −Jᵀr``; μ falls by a factor after a step that reduces the loss, and grows by
another until one does.

Why not ``scipy.optimize.least_squares``: it holds and factorises the whole Jacobian, while JᵀJ
can be gathered piece by piece from any number of samples; and Bayesian regularisation needs JᵀJ.
Both end in the same minimum, which a test holds.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from msgspec import Meta

from trms_cli.core.arrays import FloatArray
from trms_cli.identification.blackbox.prediction_error import NormalEquations, TrainingObjective
from trms_cli.identification.blackbox.training.training import EpochReport, TrainingAlgorithm

_LEAST_DAMPING, _MOST_DAMPING = 1e-20, 1e10


@dataclass(frozen=True, kw_only=True)
class LevenbergMarquardt(TrainingAlgorithm):
    """Hagan & Menhaj's training."""

    damping: Annotated[float, Meta(gt=0)] = 1e-3  #: μ at the start, per residual
    growth: Annotated[float, Meta(gt=1)] = 10.0  #: Factor of μ after a step that fails
    decay: Annotated[float, Meta(gt=0, lt=1)] = 0.1  #: After one that succeeds

    def minimise(
        self, objective: TrainingObjective, start: FloatArray, report: EpochReport
    ) -> None:
        theta, n, damping = start, objective.n_residuals, self.damping
        equations = objective.normal_equations(theta)
        while damping <= _MOST_DAMPING:
            # Per residual, so that the damping means the same for any number of samples.
            trial = theta + damped_step(equations.curvature / n, equations.slope / n, damping)
            loss = objective.loss(trial)
            if loss < equations.loss:
                theta = trial
                damping = max(_LEAST_DAMPING, damping * self.decay)
                equations = objective.normal_equations(theta)
                report(theta, equations.loss, slope_norm(equations, n))
            else:
                damping *= self.growth


def damped_step(curvature: FloatArray, slope: FloatArray, damping: float) -> FloatArray:
    """The step ``−(curvature + damping I)⁻¹ slope``."""
    from scipy.linalg import LinAlgError, cho_factor, cho_solve

    damped = curvature.copy()
    damped.flat[:: len(damped) + 1] += damping
    try:
        return np.asarray(-cho_solve(cho_factor(damped, overwrite_a=True), slope))
    except LinAlgError:  # singular to rounding: as if the damping were too small
        return np.zeros_like(slope)


def slope_norm(equations: NormalEquations, n_residuals: int) -> float:
    """Norm of the gradient of the mean squared residual, ``2 Jᵀr / N``."""
    return 2.0 * float(np.linalg.norm(equations.slope)) / n_residuals
