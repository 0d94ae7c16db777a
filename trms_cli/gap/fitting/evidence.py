"""What a fitted model is worth: log predictive density of each block given all others.

At the optimum the cost is a parabola in parameters and starts. With a block's starts eliminated
(:mod:`trms_cli.identification.greybox.elimination`) a triangle ``[R_j c_j]`` is left of it, and

    H = Σ R_jᵀR_j + P        H₋ⱼ = H − R_jᵀR_j        θ₋ⱼ = θ̂ + H₋ⱼ⁻¹ R_jᵀ c_j

is the posterior without the block, from which the block is predicted with the parameters' spread:

    log p(y_j | y₋ⱼ) = −½ rᵀ(I + R_j H₋ⱼ⁻¹ R_jᵀ)⁻¹ r − ½ log det(I + R_j H₋ⱼ⁻¹ R_jᵀ) + …

This is leave-one-out cross-validation of a Gaussian linear model, exact for the parabola (Vehtari
et al. 2017, Stat. Comput. 27, use the same quantity), at the price of one factorisation a block.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from trms_cli.gap.fitting.objective import InnovationObjective

FloatArray = npt.NDArray[np.float64]

#: Slopes beyond this, per scaled unit, are those of a simulation that runs away.
_STEEP = 1e9


@dataclass(frozen=True)
class Evidence:
    """A fit's predictive densities and its parameters' spread."""

    predictive: FloatArray  #: (m,) array; log density of each block given the others, nats
    likelihood: FloatArray  #: (m,) array; the same at the optimum itself
    covariance: FloatArray  #: (n_f, n_f) array; of the free parameters, in their units


def evidence(
    objective: InnovationObjective,
    theta: FloatArray,
    starts: FloatArray,
    bounds: tuple[FloatArray, FloatArray],
) -> Evidence:
    """Evidence at a fit's optimum.

    Parameters
    ----------
    objective : InnovationObjective
    theta : (n_f,) array
    starts : (m, n_x) array
    bounds : (lower, upper)
        A parameter that lies on one is taken as known.
    """
    _, quadratic, residuals = objective.parabola(theta, starts)
    n, m = quadratic.n, len(starts)
    if not residuals.finite:
        nothing = np.full(m, -np.inf)
        return Evidence(nothing, nothing, np.full((len(theta), len(theta)), np.nan))
    own = np.zeros((m, n, quadratic.triangles.shape[-1]))
    own[:, :, :n] = np.eye(n)
    own[:, :, -1] = quadratic.start_gap
    rows = np.concatenate([quadratic.triangles, own], axis=1)
    whole = np.asarray(np.linalg.qr(rows, mode="r"))
    of_starts = np.log(np.abs(np.einsum("mii->mi", whole[:, :n, :n]))).sum(axis=1)
    r, c = whole[:, n:, n:-1], whole[:, n:, -1]
    if not (np.isfinite(r).all() and np.abs(r).max() < _STEEP):
        nothing = np.full(m, -np.inf)
        return Evidence(nothing, nothing, np.full((len(theta), len(theta)), np.nan))
    near = 1e-6 * objective.scales
    free = (theta > bounds[0] + near) & (theta < bounds[1] - near)
    r = r[..., free]
    prior = np.diag(quadratic.prior_root[free] ** 2)
    each = np.swapaxes(r, 1, 2) @ r
    total = each.sum(axis=0) + prior
    base = -of_starts - objective.metric.normalisation
    likelihood = base - objective.by_window(theta, starts)
    predictive = np.empty(m)
    for j in range(m):
        left = total - each[j]
        shift = np.linalg.solve(left, r[j].T @ c[j]) if free.any() else np.zeros(0)
        away = c[j] + r[j] @ shift
        spread = np.eye(len(away)) + r[j] @ np.linalg.solve(left, r[j].T)
        _, logdet = np.linalg.slogdet(spread)
        worse = 0.5 * (away @ np.linalg.solve(spread, away) - c[j] @ c[j])
        predictive[j] = likelihood[j] - worse - 0.5 * logdet
    covariance = np.zeros((len(theta), len(theta)))
    inverse = np.linalg.pinv(total, rcond=1e-13, hermitian=True)
    covariance[np.ix_(free, free)] = inverse
    covariance *= np.outer(objective.scales, objective.scales)
    return Evidence(predictive, likelihood, covariance)
