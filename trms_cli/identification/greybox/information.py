"""What the data say of the parameters at a fitted point, and how far that can be trusted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from trms_cli.identification.greybox.correlation import autocovariance, score_covariances
from trms_cli.identification.greybox.elimination import reduced
from trms_cli.identification.greybox.objective import Objective

FloatArray = npt.NDArray[np.float64]

#: Share of a window up to which residuals are taken to hang together, and the same in s.
_LONGEST_SHARE, _LONGEST_LAG = 0.3, 3.0
#: Directions of a channel's information below this share of its largest say nothing.
_HEARD = 1e-12


@dataclass(frozen=True)
class Information:
    """Curvature and spread of the cost's slope, in scaled parameters."""

    #: (n_y, n_f, n_f) array; of each output's residuals, each as if white and of unit variance:
    #: Fisher's information with the starts eliminated
    curvature: FloatArray
    #: (n_y, n_f, n_f) array; covariance of each output's slope, with the residuals'
    #: autocorrelation, and with the copies of a residual that overlapping windows hold; see
    #: :func:`information`
    score: FloatArray
    trust: FloatArray  #: (n_y,) array; weight that each output has in the cost
    prior: FloatArray  #: (n_f,) array; precision of the priors, scaled
    scales: FloatArray  #: (n_f,) array
    size: FloatArray  #: (n_y,) array; root mean square of the whitened residuals
    share: float = 1.0  #: Of the weight of a sample that each of the windows over it has

    @property
    def of_data(self) -> FloatArray:
        """Curvature of the data's part of the cost, (n_f, n_f), scaled."""
        total: FloatArray = np.einsum("c,cfg->fg", self.trust, self.curvature)
        return total

    def covariance(self, held: npt.NDArray[np.bool_] | None = None) -> FloatArray:
        """Covariance of the estimate about the truth, (n_f, n_f), in the parameters' units.

        ``H⁻¹ (Σ trust² M + P) H⁻¹`` with ``H = Σ trust F + P``: the sandwich of misspecified
        likelihoods (White 1982, Econometrica 50), where the prior is taken at its word: the
        truth is a draw from it. Where the residuals are as assumed it is ``H⁻¹``.

        Parameters
        ----------
        held : (n_f,) array of bool or None
            Parameters on a bound; they get no variance and pass none on.
        """
        free = np.ones(len(self.scales), dtype=bool) if held is None else ~held
        inner = np.ix_(free, free)
        h = (self.of_data + np.diag(self.prior))[inner]
        spread = (np.einsum("c,cfg->fg", self.trust**2, self.score) + np.diag(self.prior))[inner]
        inverse = np.linalg.pinv(h, rcond=1e-13, hermitian=True)
        covariance = np.zeros((len(self.scales), len(self.scales)))
        covariance[inner] = inverse @ spread @ inverse
        whole: FloatArray = covariance * np.outer(self.scales, self.scales)
        return (whole + whole.T) / 2

    def samples_per_sample(self) -> FloatArray:
        """φ of each output: how much wider its scores are than white residuals' (n_y,).

        The mean ratio over the directions in parameter space, each weighted by how much the
        output narrows it. It is of residuals in time; copies of them in overlapping windows are
        not counted here, for the cost's weights have that share already.
        """
        h = self.of_data + np.diag(self.prior)
        inverse = np.linalg.pinv(h, rcond=1e-13, hermitian=True)
        ratios = np.ones(len(self.trust))
        for c in range(len(ratios)):
            white = np.trace(inverse @ self.curvature[c])
            if white > 0:
                ratios[c] = self.share * np.trace(inverse @ self.score[c]) / white
        return ratios


def information(objective: Objective, theta: FloatArray, starts: FloatArray) -> Information:
    """Information at a point, by one simulation with slopes.

    Windows that lie end to end have residuals of their own, and the covariances of their slopes
    add up. Where they overlap, ``k = 1/share`` windows hold copies of one residual. Sort the
    windows into k families, each end to end: the slope is ``S = Σ S_i``, one term a family, and

        cov S ≤ k Σ_i cov S_i = k M

    (Cauchy and Schwarz), M being the sum over all windows as if they were independent. The two
    sides are equal where the families' slopes are the same, which they nearly are: they come
    from the same samples. The score is therefore ``M / share``. With the cost's weights ``share/φ``
    the overlap then leaves ``(share/φ)² M/share``, which is what one family gives.

    Parameters
    ----------
    objective : Objective
    theta : (n_f,) array
    starts : (m, n_x) array
    """
    _, quadratic, residuals = objective.parabola(theta, starts)
    assert residuals.j is not None
    windows, weights = objective.windows, objective.weights
    n = windows.n_x
    slopes = objective.scaled(residuals.j)
    to_starts = reduced(quadratic, 0.0).to_starts
    projected = slopes[..., n:] + np.einsum("mtyn,mnf->mtyf", slopes[..., :n], to_starts)
    z = weights.whitened(residuals.r)
    score = z
    if weights.robust is not None:
        score = np.clip(z, -weights.robust, weights.robust)
        # Beyond the threshold the cost is a straight line and tells nothing of the curvature.
        inside = (np.abs(z) <= weights.robust) & windows.measured
    else:
        inside = windows.measured
    projected = projected / weights.sd[:, None, :, None] * windows.measured[..., None]
    lags = min(_LONGEST_LAG / windows.sample_time, _LONGEST_SHARE * z.shape[1])
    gamma = autocovariance(score, windows.measured, max(1, int(lags)))
    count = np.maximum(windows.measured.sum(axis=(0, 1)), 1)
    white = np.einsum("mtyf,mtyg->yfg", projected * inside[..., None], projected)
    found = score_covariances(projected, gamma)
    floored = np.array([_at_least(*pair) for pair in zip(white, found, strict=True)])
    return Information(
        curvature=white,
        score=floored / windows.share,
        trust=weights.trust,
        prior=objective.precisions * objective.scales**2,
        scales=objective.scales,
        size=np.sqrt((z**2).sum(axis=(0, 1)) / count),
        share=windows.share,
    )


def _at_least(white: FloatArray, found: FloatArray) -> FloatArray:
    """A score's covariance, no smaller in any direction than that of white residuals.

    Fitted starts and parameters take the slow part out of the residuals, so that their estimated
    autocorrelation errs to the small side; an interval must not profit from that.
    """
    values, vectors = np.linalg.eigh(white)
    heard = values > _HEARD * max(float(values.max(initial=0.0)), 1e-300)
    root = vectors[:, heard] * np.sqrt(values[heard])
    inverse = vectors[:, heard] / np.sqrt(values[heard])
    ratio, directions = np.linalg.eigh(inverse.T @ found @ inverse)
    scaled = root @ directions
    floored: FloatArray = (scaled * np.maximum(ratio, 1.0)) @ scaled.T
    return floored
