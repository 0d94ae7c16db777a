"""One engine for every residual test: is a residual uncorrelated with what came before it?

Under a right model the residual a(t) is unpredictable: ``E[a(t) z(t − k)] = 0`` for every
instrument z of the past (a residual, an input, a square, a product) and every lag k ≥ 1. Then
``v(t) = a(t)·[z(t − k₁), …, z(t − k_m)]`` is a martingale difference whatever the autocorrelation
of z, and

    T = n v̄ᵀ V⁻¹ v̄,   V = (1/n) Σ v vᵀ        is χ² of m degrees of freedom.

No band assumes a white input, and none a constant variance of the residual: the noise of an
encoder depends on how the rig moves. Only the past is looked at, so the tests hold in closed loop,
where the input carries the residuals of before.

Sources: I. N. Lobato, "Testing that a dependent process is uncorrelated", J. Amer. Statist. Assoc.
96, 2001 (V in place of the variances of white noise); J. M. Wooldridge, "A unified approach to
robust, regression-based specification tests", Econometric Theory 6, 1990 (T as n R² of a
regression of ones on v).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

#: Directions of the instruments with less than this share of the mean variance are left out: lags
#: of a smooth input are nearly one another's copies, and what little differs says nothing.
_LEAST_SHARE = 1e-3
#: Samples per lag below which the χ² is not to be trusted.
_SAMPLES_PER_LAG = 10


@dataclass(frozen=True)
class MomentTest:
    """A test, with the correlations it looked at."""

    lags: npt.NDArray[np.int64]  #: (m,) int array; samples
    correlations: FloatArray  #: (m,) array; sample correlations at the lags, in [−1, 1]
    #: (m,) array; of the correlations, if the residual is unpredictable
    standard_errors: FloatArray
    statistic: float  #: T; NaN if there are too few samples, or nothing varies
    degrees: int  #: Degrees of freedom of its χ²
    p_value: float  #: of the test

    def band(self, level: float = 0.95) -> FloatArray:
        """Half width of a band that all lags together stay in with probability `level` (Šidák)."""
        from scipy.special import ndtri

        each = level ** (1.0 / max(1, len(self.lags)))
        return np.asarray(float(ndtri(0.5 + each / 2)) * self.standard_errors)


def moment_test(
    present: FloatArray, past: FloatArray | Sequence[FloatArray], lags: Sequence[int]
) -> MomentTest:
    """Test that `present` is uncorrelated with earlier values of `past`.

    Parameters
    ----------
    present : (n,) array
        Unpredictable if the model is right; its mean is taken off. NaN where missing.
    past : (n,) array, or several
        Instruments; their means are taken off. Several share one test.
    lags : sequence of int
        From 1 on: ``present(t)`` meets ``past(t − lag)``.
    """
    series = [past] if isinstance(past, np.ndarray) else list(past)
    steps = np.asarray(lags, dtype=np.int64)
    a = present - np.nanmean(present) if np.any(~np.isnan(present)) else present
    columns = [_shifted(z - _mean(z), int(k)) for z in series for k in steps]
    z = np.column_stack(columns)
    v = a[:, None] * z
    complete = ~np.isnan(v).any(axis=1)
    v, z, a = v[complete], z[complete], a[complete]
    n, m = v.shape
    all_lags = np.tile(steps, len(series))
    nothing = np.full(m, np.nan)
    if n < _SAMPLES_PER_LAG * max(m, 2):
        return MomentTest(all_lags, nothing, nothing, np.nan, 0, np.nan)
    mean = v.mean(axis=0)
    second = v.T @ v / n
    spread = np.sqrt(np.diag(second))
    norms = np.sqrt(np.mean(a**2) * np.mean(z**2, axis=0))
    varying = (spread > 0) & (norms > 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        correlations, errors = mean / norms, spread / norms / np.sqrt(n)
    if not varying.any():
        return MomentTest(all_lags, nothing, nothing, np.nan, 0, np.nan)
    scaled = mean[varying] / spread[varying]
    values, vectors = np.linalg.eigh(
        second[np.ix_(varying, varying)] / np.outer(spread[varying], spread[varying])
    )
    kept = values > _LEAST_SHARE
    along = vectors[:, kept].T @ scaled
    statistic = float(n * np.sum(along**2 / values[kept]))
    degrees = int(np.count_nonzero(kept))
    return MomentTest(
        all_lags, correlations, errors, statistic, degrees, chi2_tail(statistic, degrees)
    )


def mean_test(present: FloatArray) -> MomentTest:
    """Test that an unpredictable residual has mean zero (the same engine, instrument 1)."""
    values = present[~np.isnan(present)]
    lag = np.zeros(1, dtype=np.int64)
    power = float(np.mean(values**2)) if values.size else 0.0
    if values.size < 2 * _SAMPLES_PER_LAG or power == 0.0:
        return MomentTest(lag, np.full(1, np.nan), np.full(1, np.nan), np.nan, 0, np.nan)
    share = float(np.mean(values)) / np.sqrt(power)
    statistic = values.size * share**2
    error = np.array([1.0 / np.sqrt(values.size)])
    return MomentTest(lag, np.array([share]), error, statistic, 1, chi2_tail(statistic, 1))


def ljung_box(residual: FloatArray, lags: int) -> MomentTest:
    """The classical whiteness test, Q = n(n + 2) Σ r²(k)/(n − k), for a constant variance.

    Source: G. M. Ljung, G. E. P. Box, "On a measure of lack of fit in time series models",
    Biometrika 65(2), 1978. With missing samples each r(k) has its own count of pairs.
    """
    steps = np.arange(1, lags + 1)
    a = residual - _mean(residual)
    power = np.nanmean(a**2) if np.any(~np.isnan(a)) else 0.0
    pairs = [a * _shifted(a, int(k)) for k in steps]
    counts = np.array([np.count_nonzero(~np.isnan(p)) for p in pairs])
    n = int(np.count_nonzero(~np.isnan(a)))
    if not power > 0 or counts.min() < _SAMPLES_PER_LAG * max(2, lags):
        nothing = np.full(lags, np.nan)
        return MomentTest(steps, nothing, nothing, np.nan, 0, np.nan)
    r = np.array([np.nansum(p) for p in pairs]) / (power * n)
    # Pairs that are missing beyond those at the end lower r's variance in the same proportion.
    variances = counts / n**2
    statistic = float(np.sum((n + 2) / n * r**2 / variances))
    return MomentTest(steps, r, np.sqrt(variances), statistic, lags, chi2_tail(statistic, lags))


def chi2_tail(statistic: float, degrees: float) -> float:
    """Probability that a χ² exceeds the statistic; NaN without degrees of freedom."""
    from scipy.special import chdtrc

    return float(chdtrc(degrees, statistic)) if degrees > 0 and np.isfinite(statistic) else np.nan


def correlation(a: FloatArray, b: FloatArray, lags: Sequence[int]) -> FloatArray:
    """Sample correlations of ``a(t)`` with ``b(t − lag)``, lags of any sign; for figures."""
    a, b = a - _mean(a), b - _mean(b)
    scale = np.sqrt(np.nanmean(a**2) * np.nanmean(b**2))
    if not scale > 0:
        return np.full(len(lags), np.nan)
    present = max(1, int(np.count_nonzero(~np.isnan(a * b))))
    return np.array([np.nansum(a * _shifted(b, int(k))) / present / scale for k in lags])


def _mean(values: FloatArray) -> float:
    present = values[~np.isnan(values)]
    return float(present.mean()) if present.size else 0.0


def _shifted(values: FloatArray, lag: int) -> FloatArray:
    """``values(t − lag)``, NaN where that lies outside."""
    shifted = np.full(len(values), np.nan)
    if lag == 0:
        shifted[:] = values
    elif 0 < lag < len(values):
        shifted[lag:] = values[:-lag]
    elif -len(values) < lag < 0:
        shifted[:lag] = values[-lag:]
    return shifted
