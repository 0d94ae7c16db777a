"""Whether an observer believes the right amount: NEES, NIS and whiteness of the innovations.

Sources: Y. Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation with applications to tracking and
navigation", section 5.4; G. M. Ljung, G. E. P. Box, "On a measure of lack of fit in time series
models", Biometrika 65(2), 1978.
"""

from __future__ import annotations

import math

import numpy as np

from trms_cli.scoring.metrics import Array

#: Lags of the Ljung–Box statistic. Even: the tail of χ² then has a closed form.
LAGS = 20
#: Fewer innovations than this say nothing about LAGS correlations.
MINIMUM_SAMPLES = 5 * LAGS


def nees(error: Array, standard_deviation: Array) -> Array:
    """Normalised estimation error squared of each sample, by the diagonal of the covariance.

    ``Σ_i (e_i / σ_i)²``. The log holds standard deviations and no covariances. The mean over
    samples of a consistent filter is the number of states all the same, because
    ``E e_i² = σ_i²`` whatever the correlations; only its spread differs from the full form's.

    Parameters
    ----------
    error, standard_deviation : (n, n_x)
        Each column in its state's unit; deviations above 0.

    Returns
    -------
    (n,) -, NaN where a state is missing.
    """
    return np.sum((error / standard_deviation) ** 2, axis=1)


def normalised_square(innovation: Array, standard_deviation: Array) -> float:
    """Mean of (ν/σ)² of one channel: 1 for a filter that believes the right amount.

    Samples without a deviation above 0 are left out; NaN if that leaves none.
    """
    present = ~np.isnan(innovation) & (standard_deviation > 0)
    share = innovation[present] / standard_deviation[present]
    return float(np.mean(share**2)) if share.size else math.nan


def neighbour_correlation(values: Array) -> float:
    """Correlation of each value with the next one; pairs that lack one are left out."""
    centred = values - np.nanmean(values) if np.any(~np.isnan(values)) else values
    product = centred[1:] * centred[:-1]
    power = centred**2
    if np.all(np.isnan(product)) or not np.nansum(power) > 0:
        return math.nan
    return float(np.nanmean(product) / np.nanmean(power))


def whiteness_p(innovation: Array) -> float:
    """p-value of the Ljung–Box test: small if the innovations are correlated in time.

    ``Q = n(n + 2) Σ_{k=1}^{20} ρ_k²/(n − k)``, compared with χ² of 20 degrees of freedom.
    Missing innovations are left out as if the others followed each other, as they do when a
    sensor is slower than the loop.
    """
    present = innovation[~np.isnan(innovation)]
    n = present.size
    if n < MINIMUM_SAMPLES:
        return math.nan
    centred = present - np.mean(present)
    power = float(centred @ centred)
    if power <= 1e-24 * n * float(np.max(np.abs(present)) ** 2):
        return math.nan  # constant: there is nothing to correlate
    correlation = np.array([float(centred[lag:] @ centred[:-lag]) for lag in range(1, LAGS + 1)])
    statistic = (
        n * (n + 2) * float(np.sum((correlation / power) ** 2 / (n - np.arange(1, LAGS + 1))))
    )
    return chi_square_tail(statistic, LAGS)


def chi_square_tail(statistic: float, degrees: int) -> float:
    """``P(χ² > statistic)`` for an even number of degrees of freedom.

    ``e^{−x} Σ_{i < degrees/2} x^i / i!`` with ``x = statistic/2`` (an Erlang tail): importing
    SciPy for it would take longer than scoring a run.
    """
    if degrees % 2:
        raise ValueError(f"the closed form needs even degrees of freedom, not {degrees}")
    x = statistic / 2
    if x <= 0:
        return 1.0
    exponents = [i * math.log(x) - math.lgamma(i + 1) - x for i in range(degrees // 2)]
    return min(1.0, math.fsum(map(math.exp, exponents)))


def chi_square_interval(degrees: int, share: float = 0.95) -> tuple[float, float]:
    """Bounds between which χ² lies with probability ``share``, as often below as above.

    By bisection of the tail: a quantile has no closed form, and SciPy is slow to import.
    """
    beyond = (1.0 - share) / 2.0
    return _chi_square_quantile(1.0 - beyond, degrees), _chi_square_quantile(beyond, degrees)


def _chi_square_quantile(tail: float, degrees: int) -> float:
    """The value that χ² exceeds with probability ``tail``."""
    low, high = 0.0, 1.0
    while _any_tail(high, degrees) > tail:
        low, high = high, 2.0 * high
    for _ in range(60):
        middle = (low + high) / 2.0
        if _any_tail(middle, degrees) > tail:
            low = middle
        else:
            high = middle
    return (low + high) / 2.0


def _any_tail(statistic: float, degrees: int) -> float:
    """``P(χ² > statistic)``: each two degrees more than one or two add a term to the tail."""
    if degrees % 2 == 0:
        return chi_square_tail(statistic, degrees)
    x = statistic / 2
    if x <= 0:
        return 1.0
    exponents = [
        (k / 2) * math.log(x) - math.lgamma(k / 2 + 1) - x for k in range(1, degrees - 1, 2)
    ]
    return math.erfc(math.sqrt(x)) + math.fsum(map(math.exp, exponents))


def joint_p(p_values: list[float]) -> float:
    """One p-value of several tests: the smallest, times their number (Bonferroni).

    It holds whatever the dependence between the channels. NaN without any test.
    """
    present = [p for p in p_values if not math.isnan(p)]
    return min(1.0, len(present) * min(present)) if present else math.nan
