"""What the data say of the parameters at a fitted point, and how far that can be trusted.

Residuals of a good fit are not white: an encoder's rounding stays the same while the beam is slow,
and what a model misses lasts for seconds. With slopes ``B̃`` of the whitened residuals in the
parameters (the windows' starts eliminated) the score ``Σ B̃ᵀ r`` then has the covariance

    M = Σ_c Σ_{s,t} B̃_c(s)ᵀ γ_c(t − s) B̃_c(t)

with γ_c the autocovariance of channel c, estimated from the residuals, tapered by Parzen's window
so that M stays positive (Newey & West 1987, Econometrica 55, with the autocovariance pooled over
all windows instead of that of the products: 15 parameters cannot be told from a dozen windows).

Identifiability: Brun, Reichert & Künsch (2001, Water Resources Research 37) call a set of
parameters collinear when the change that one of them makes can nearly be made up for by the others:
with the normalised columns of the set's sensitivities, ``γ = 1/√λ_min`` of their Gram matrix. From
γ of about 10 to 15 on a set cannot be identified together: 1/γ of the effect of one is all that the
others cannot imitate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from trms_cli.core.arrays import BoolArray, FloatArray
from trms_cli.identification.greybox.objective import MapObjective, reduced


def autocovariance(z: FloatArray, measured: BoolArray, lags: int) -> FloatArray:
    """Tapered autocovariance of each channel's whitened residuals, shape (n_y, lags + 1).

    ``z``: (m, c, n_y) array; 0 where nothing was measured. ``lags``: the longest, in samples.
    """
    size = 2 ** int(np.ceil(np.log2(z.shape[1] + lags + 1)))
    spectrum = np.fft.rfft(z, size, axis=1)
    raw = np.fft.irfft(np.abs(spectrum) ** 2, size, axis=1)[:, : lags + 1].sum(axis=0)
    # Divided by the number of samples, not of pairs: only so is it positive at all frequencies.
    count = np.maximum(measured.sum(axis=(0, 1)), 1)
    return np.asarray((raw / count).T * parzen(lags))


def parzen(lags: int) -> FloatArray:
    """Parzen's lag window, 1 at lag 0 and 0 beyond the last, shape (lags + 1,)."""
    x = np.arange(lags + 1) / (lags + 1)
    return np.where(x <= 0.5, 1 - 6 * x**2 + 6 * x**3, 2 * (1 - x) ** 3)


def score_covariances(slopes: FloatArray, gamma: FloatArray) -> FloatArray:
    """Covariance of each channel's part of the score, shape (n_y, n_f, n_f).

    ``slopes``: (m, c, n_y, n_f) array; of the whitened residuals; 0 where nothing was measured.
    ``gamma``: (n_y, lags + 1) array.
    """
    lags = gamma.shape[1] - 1
    length = slopes.shape[1]
    size = 2 ** int(np.ceil(np.log2(length + lags)))
    kernel = np.zeros((gamma.shape[0], size))
    kernel[:, : lags + 1] = gamma
    kernel[:, size - lags :] = gamma[:, :0:-1]
    density = np.fft.rfft(kernel, axis=1).real  # (n_y, frequencies)
    found = []
    for c in range(slopes.shape[2]):
        spectrum = np.fft.rfft(slopes[:, :, c], size, axis=1)
        smooth = np.fft.irfft(spectrum * density[c][None, :, None], size, axis=1)[:, :length]
        found.append(np.einsum("mtf,mtg->fg", slopes[:, :, c], smooth))
    matrices = np.array(found)
    return np.asarray((matrices + matrices.swapaxes(1, 2)) / 2)


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
        return np.asarray(np.einsum("c,cfg->fg", self.trust, self.curvature))

    def covariance(self, held: BoolArray | None = None) -> FloatArray:
        """Covariance of the estimate about the truth, (n_f, n_f), in the parameters' units.

        ``H⁻¹ (Σ trust² M + P) H⁻¹`` with ``H = Σ trust F + P``: the sandwich of misspecified
        likelihoods (White 1982, Econometrica 50), where the prior is taken at its word: the
        truth is a draw from it. Where the residuals are as assumed it is ``H⁻¹``.

        ``held``: (n_f,) array of bool or None; parameters on a bound; they get no variance and pass
        none on.
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


def information(objective: MapObjective, theta: FloatArray, starts: FloatArray) -> Information:
    """Information at a point, by one simulation with slopes.

    Windows that lie end to end have residuals of their own, and the covariances of their slopes
    add up. Where they overlap, ``k = 1/share`` windows hold copies of one residual. Sort the
    windows into k families, each end to end: the slope is ``S = Σ S_i``, one term a family, and

        cov S ≤ k Σ_i cov S_i = k M

    (Cauchy and Schwarz), M being the sum over all windows as if they were independent. The two
    sides are equal where the families' slopes are the same, which they nearly are: they come
    from the same samples. The score is therefore ``M / share``. With the cost's weights ``share/φ``
    the overlap then leaves ``(share/φ)² M/share``, which is what one family gives.

    ``theta``: (n_f,) array. ``starts``: (m, n_x) array.
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
    return np.asarray((scaled * np.maximum(ratio, 1.0)) @ scaled.T)


#: Brun's threshold.
COLLINEAR = 15.0
#: Share of the prior's deviation above which the data have said next to nothing.
_UNINFORMED = 0.9
#: Sets of up to so many parameters are looked at.
_LARGEST_SET = 4


@dataclass(frozen=True)
class CollinearSet:
    """Parameters whose effects on these data imitate each other."""

    names: tuple[str, ...]  #: A smallest set: without any one of them the others can be told apart
    index: float  #: Collinearity γ


@dataclass(frozen=True)
class Identifiability:
    """What the data alone say of each parameter."""

    #: Standard deviation after the data over that before; only where there is a prior
    prior_remaining: dict[str, float]
    #: γ of each parameter against all others: how many times its own effect is larger than what of
    #: it the others cannot imitate
    collinearity: dict[str, float]
    confounded: tuple[CollinearSet, ...]  #: The worst first
    silent: tuple[str, ...]  #: Parameters that these data do not depend on at all
    #: Parameters of which the data say next to nothing, so that the prior decided: those of whose
    #: prior's deviation more than nine tenths remain, and the silent ones
    uninformed: tuple[str, ...]


def identifiability(
    information: Information, names: Sequence[str], covariance: FloatArray
) -> Identifiability:
    """Judge the parameters of a fit.

    ``covariance``: (n_f, n_f) array; of the estimate, in the parameters' units.
    """
    fisher = information.of_data
    size = np.sqrt(np.diag(fisher))
    loud = size > 1e-9 * max(float(size.max(initial=0.0)), 1e-300)
    heard = np.flatnonzero(loud).tolist()
    gram = fisher[np.ix_(heard, heard)] / np.outer(size[heard], size[heard])
    sd = np.sqrt(np.diag(covariance))
    remaining = {
        name: float(sd[i] / information.scales[i])
        for i, name in enumerate(names)
        if information.prior[i] > 0
    }
    against_all = _against_all(gram)
    silent = tuple(names[i] for i in np.flatnonzero(~loud).tolist())
    return Identifiability(
        remaining,
        {names[i]: float(against_all[k]) for k, i in enumerate(heard)},
        tuple(_confounded(gram, [names[i] for i in heard])),
        silent,
        tuple(n for n in names if remaining.get(n, 0.0) > _UNINFORMED or n in silent),
    )


def correlations(covariance: FloatArray) -> FloatArray:
    """Correlation matrix; NaN beside a parameter without variance, its own included."""
    sd = np.sqrt(np.diag(covariance))
    with np.errstate(invalid="ignore", divide="ignore"):
        found: FloatArray = covariance / np.outer(sd, sd)
    return found


def _against_all(gram: FloatArray) -> FloatArray:
    """γ of each column against all the others: the root of its variance inflation."""
    inverse = np.linalg.pinv(gram, rcond=1e-14, hermitian=True)
    return np.asarray(np.sqrt(np.maximum(np.diag(inverse), 1.0)))


def _confounded(gram: FloatArray, names: Sequence[str]) -> list[CollinearSet]:
    found: list[tuple[tuple[int, ...], float]] = []
    for size in range(2, min(_LARGEST_SET, len(names)) + 1):
        sets = np.array(list(combinations(range(len(names)), size)))
        for known, _ in found:  # a larger set around a known one says nothing new
            inside = np.isin(sets, known).sum(axis=1) == len(known)
            sets = sets[~inside]
        if not len(sets):
            break
        least = np.linalg.eigvalsh(gram[sets[:, :, None], sets[:, None, :]])[:, 0]
        index = 1 / np.sqrt(np.maximum(least, 1e-16))
        bad = np.flatnonzero(index > COLLINEAR)
        found += [(tuple(sets[k].tolist()), float(index[k])) for k in bad]
    found.sort(key=lambda item: -item[1])
    return [CollinearSet(tuple(names[i] for i in rows), index) for rows, index in found]
