"""Bayesian regularisation.

D. J. C. MacKay (1992), Neural Computation 4(3), with the Gauss–Newton approximation of F. D.
Foresee & M. T. Hagan (1997), IEEE Int. Conf. Neural Networks. With E_D = Σ r² and E_W = Σ θ²
the training reduces F = β E_D + α E_W, and after each step

    H = 2 β JᵀJ + 2 α I     γ = P − 2 α tr H⁻¹     α = γ / (2 E_W)     β = (N − γ) / (2 E_D)

γ is the effective number of parameters: how many the data determine. At the start γ = P and α and β
follow from it.
"""

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from msgspec import Meta

from trms_cli.core.arrays import FloatArray
from trms_cli.identification.blackbox.prediction_error import TrainingObjective
from trms_cli.identification.blackbox.training.levenberg_marquardt import damped_step, slope_norm
from trms_cli.identification.blackbox.training.training import EpochReport, TrainingAlgorithm

_LEAST_DAMPING, _MOST_DAMPING = 1e-20, 1e10
_LEAST = 1e-300


@dataclass(frozen=True, kw_only=True)
class BayesianRegularisation(TrainingAlgorithm):
    """MacKay's evidence framework within Levenberg–Marquardt steps."""

    damping: Annotated[float, Meta(gt=0)] = 5e-3  #: μ at the start, relative to β N
    growth: Annotated[float, Meta(gt=1)] = 10.0  #: Factor of μ after a step that fails
    decay: Annotated[float, Meta(gt=0, lt=1)] = 0.1  #: After one that succeeds

    regularised: ClassVar[bool] = True

    def minimise(
        self, objective: TrainingObjective, start: FloatArray, report: EpochReport
    ) -> None:
        theta, n, damping = start, objective.n_residuals, self.damping
        equations = objective.normal_equations(theta)
        gamma = float(theta.size)
        alpha, beta = hyperparameters(gamma, n, equations.loss * n, float(theta @ theta))
        while damping <= _MOST_DAMPING:
            # F / (β N): then only the ratio α/β is there, and the damping is per residual.
            ratio = alpha / (beta * n)
            cost = equations.loss + ratio * float(theta @ theta)
            curvature = equations.curvature / n
            curvature.flat[:: theta.size + 1] += ratio
            step = damped_step(curvature, equations.slope / n + ratio * theta, damping)
            trial = theta + step
            trial_cost = objective.loss(trial) + ratio * float(trial @ trial)
            if not trial_cost < cost:
                damping *= self.growth
                continue
            theta, damping = trial, max(_LEAST_DAMPING, damping * self.decay)
            equations = objective.normal_equations(theta)
            gamma = effective_parameters(equations.curvature, alpha, beta)
            alpha, beta = hyperparameters(gamma, n, equations.loss * n, float(theta @ theta))
            report(theta, equations.loss, slope_norm(equations, n), gamma)


def effective_parameters(curvature: FloatArray, alpha: float, beta: float) -> float:
    """γ = P − 2 α tr (2 β JᵀJ + 2 α I)⁻¹, by the eigenvalues of JᵀJ (P, P)."""
    eigenvalues = np.maximum(np.linalg.eigvalsh(curvature), 0.0)
    return float(np.sum(beta * eigenvalues / np.maximum(beta * eigenvalues + alpha, _LEAST)))


def hyperparameters(
    gamma: float, n_residuals: int, squares: float, weights: float
) -> tuple[float, float]:
    """α and β of the largest evidence for γ effective parameters, E_D and E_W."""
    alpha = gamma / max(2.0 * weights, _LEAST)
    beta = max(n_residuals - gamma, 1.0) / max(2.0 * squares, _LEAST)
    return alpha, beta
