"""Statistical characteristics of signals: what a recording excites, and whether it stays alike.

Moments, amplitude distribution, correlation time, band, and a check for stationarity: the reverse
arrangements test on the means and the mean squares of equal parts (J. S. Bendat, A. G. Piersol,
"Random data", 4th ed. 2010, section 10.3). Under stationarity the number of pairs of parts i < j
with x_i > x_j has mean N(N − 1)/4 and variance N(2N + 5)(N − 1)/72.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from trms_cli.identification.dataset import Dataset, FloatArray
from trms_cli.identification.validation.spectra import default_length, segments_of, spectrum

#: Parts of the stationarity check.
_PARTS = 20
_HISTOGRAM_BINS = 30


@dataclass(frozen=True)
class Characteristics:
    """Figures of one signal; NaN for what does not exist."""

    name: str
    unit: str
    samples: int
    missing: int
    mean: float  #: In the unit
    sd: float  #: In the unit
    least: float  #: In the unit
    largest: float  #: In the unit
    skewness: float  #: Third and fourth standardised moments
    kurtosis: float  #: 0 and 3 for a normal distribution
    correlation_time: float  #: s until the autocorrelation falls below 1/e
    peak_frequency: float  #: Hz: of the largest density
    band_edge: float  #: below which 95 % of the power lies
    trend_of_mean: float  #: p-values of the stationarity check
    trend_of_power: float  #: small: they drift
    counts: FloatArray  #: (b,) array; amplitude distribution
    edges: FloatArray  #: (b + 1,) array; of its bins, in the unit
    #: (l,) array; at lags of 0, 1, … samples, up to ten correlation times
    autocorrelation: FloatArray


def characteristics(
    name: str, unit: str, values: FloatArray, sample_time: float
) -> Characteristics:
    """Characterise one signal.

    Parameters
    ----------
    values : (n,) array
        NaN where missing.
    sample_time : float
        s.
    """
    present = values[~np.isnan(values)]
    missing = len(values) - len(present)
    if not present.size:
        none, empty = (np.nan,) * 11, np.zeros(0)
        return Characteristics(name, unit, 0, missing, *none, empty, empty, empty)
    mean, sd = float(present.mean()), float(present.std())
    skewness, kurtosis = (
        (float(np.mean(((present - mean) / sd) ** k)) if sd > 0 else np.nan) for k in (3, 4)
    )
    r = autocorrelation(values)
    below = np.flatnonzero(r < np.exp(-1.0))
    time = float(below[0] * sample_time) if below.size and sd > 0 else np.nan
    density = spectrum(
        segments_of(values, sample_time, default_length(len(values), sample_time, 60.0))
    )
    peak = edge = np.nan
    if sd > 0 and not np.isnan(density.density).any() and density.density.sum() > 0:
        peak = float(density.frequencies[int(np.argmax(density.density))])
        share = np.cumsum(density.density) / density.density.sum()
        edge = float(density.frequencies[int(np.searchsorted(share, 0.95))])
    counts, edges = np.histogram(present, bins=_HISTOGRAM_BINS)
    shown = len(r) if np.isnan(time) else min(len(r), max(20, round(10 * time / sample_time)))
    return Characteristics(
        name,
        unit,
        len(present),
        missing,
        mean,
        sd,
        float(present.min()),
        float(present.max()),
        skewness,
        kurtosis,
        time,
        peak,
        edge,
        reverse_arrangements(parts_of(values, np.nanmean)),
        reverse_arrangements(parts_of(values - mean, lambda part: np.nanmean(part**2))),
        counts.astype(float),
        edges,
        r[:shown],
    )


def characteristics_of(dataset: Dataset) -> list[Characteristics]:
    """Statistics of the outputs, then of the inputs; of those that have any sample."""
    columns = [
        *zip(dataset.outputs, dataset.measurements.T, strict=True),
        *zip(dataset.inputs, dataset.commands.T, strict=True),
    ]
    found = [characteristics(s.name, s.unit, y, dataset.sample_time) for s, y in columns]
    return [signal for signal in found if signal.samples]


def autocorrelation(values: FloatArray) -> FloatArray:
    """Autocorrelation at lags 0, 1, … up to half the length; missing samples count for nothing."""
    from scipy.signal import correlate

    centred = values - np.nanmean(values)
    known = ~np.isnan(centred)
    centred = np.where(known, centred, 0.0)
    n = len(values)
    pairs = correlate(known.astype(float), known.astype(float), method="fft")[n - 1 :]
    sums = correlate(centred, centred, method="fft")[n - 1 :]
    half = max(1, n // 2)
    pairs = np.maximum(np.round(pairs[:half]), 1.0)
    r = sums[:half] / pairs
    return np.asarray(r / r[0]) if r[0] > 0 else np.full(half, np.nan)


def parts_of(values: FloatArray, figure: Callable[[FloatArray], Any]) -> FloatArray:
    """A figure of each of equal parts; of parts in which something was measured."""
    parts = np.array_split(values, min(_PARTS, max(1, len(values) // 10)))
    return np.array([figure(part) for part in parts if np.any(~np.isnan(part))])


def reverse_arrangements(figures: FloatArray) -> float:
    """Two-sided p-value of a trend in a sequence; NaN for fewer than ten figures."""
    from scipy.special import ndtr

    n = len(figures)
    if n < 10 or not np.ptp(figures) > 0:
        return np.nan
    above = np.sign(figures[:, None] - figures[None, :])
    later = np.triu(np.ones((n, n), dtype=bool), 1)
    # A tie counts half, as it would on average.
    count = float(np.sum((above[later] + 1.0) / 2.0))
    mean, variance = n * (n - 1) / 4.0, n * (2 * n + 5) * (n - 1) / 72.0
    return float(2.0 * ndtr(-abs(count - mean) / np.sqrt(variance)))
