"""Statistical characteristics and spectra of signals: what is excited, and whether it stays alike.

Moments, amplitude distribution, correlation time, band, and a check for stationarity: the reverse
arrangements test on the means and the mean squares of equal parts (J. S. Bendat, A. G. Piersol,
"Random data", 4th ed. 2010, section 10.3). Under stationarity the number of pairs of parts i < j
with x_i > x_j has mean N(N − 1)/4 and variance N(2N + 5)(N − 1)/72.

Power spectra and coherence are Welch's, with bands, in spite of missing samples: segments of a Hann
window, half overlapping, each without its mean; a segment with a missing sample is left out. K
segments are worth K/(1 + 2c²(K − 1)/K) independent ones, c² = 1/36 for this window and overlap,
which gives a power spectrum twice as many degrees of freedom.

Sources: P. D. Welch, "The use of fast Fourier transform for the estimation of power spectra", IEEE
Trans. Audio Electroacoust. 15, 1967; J. S. Bendat, A. G. Piersol, "Random data", 4th ed. 2010,
sections 8.5 and 9.2 (bands, and the coherence that independent signals show by chance).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from trms_cli.core.arrays import FloatArray
from trms_cli.identification.dataset import Dataset

_OVERLAP_CORRELATION = 1.0 / 36.0


@dataclass(frozen=True)
class Segments:
    """Windowed Fourier transforms of one signal."""

    frequencies: FloatArray  #: (f,) array; hz
    #: (k, f) complex array; scaled so that their mean square is the one-sided density; NaN for a
    #: segment with a missing sample
    transforms: npt.NDArray[np.complex128]


@dataclass(frozen=True)
class Spectrum:
    """A one-sided power spectral density."""

    frequencies: FloatArray  #: (f,) array; hz
    density: FloatArray  #: (f,) array; unit² per Hz
    #: ``lower``, ``upper``: Factors of the density to the ends of its 95 % interval
    lower: float
    upper: float
    segments: int


@dataclass(frozen=True)
class Coherence:
    """Squared coherence of two signals."""

    frequencies: FloatArray  #: (f,) array; hz
    squared: FloatArray  #: (f,) array; from 0 to 1
    by_chance: float  #: What independent signals stay below at a frequency with probability 0.95


def segments_of(values: FloatArray, sample_time: float, length: int) -> Segments:
    """Cut a signal into segments and transform them.

    ``values``: (n,) array; NaN where missing. ``length``: samples of a segment.
    """
    from scipy.signal.windows import hann

    length = min(length, len(values))
    window = hann(length, sym=False)
    scale = np.sqrt(2.0 * sample_time / np.sum(window**2))
    begins = range(0, len(values) - length + 1, max(1, length // 2))
    cut = np.array([values[i : i + length] for i in begins])
    cut = (cut - cut.mean(axis=1, keepdims=True)) * window * scale
    transforms = np.fft.rfft(cut, axis=1)
    frequencies = np.asarray(np.fft.rfftfreq(length, sample_time), dtype=float)
    # Without their mean the segments say nothing at 0 Hz.
    return Segments(frequencies[1:], transforms[:, 1:])


def default_length(samples: int, sample_time: float, longest: float = 12.0) -> int:
    """Samples of a segment: at most `longest` s, and a fourth of all."""
    return max(16, min(samples // 4, round(longest / sample_time)))


def spectrum(segments: Segments) -> Spectrum:
    """The density of a signal."""
    from scipy.special import chdtri

    complete = segments.transforms[~np.isnan(segments.transforms).any(axis=1)]
    if not len(complete):
        nothing = np.full(len(segments.frequencies), np.nan)
        return Spectrum(segments.frequencies, nothing, np.nan, np.nan, 0)
    freedom = 2.0 * _independent(len(complete))
    return Spectrum(
        segments.frequencies,
        np.mean(np.abs(complete) ** 2, axis=0),
        float(freedom / chdtri(freedom, 0.025)),
        float(freedom / chdtri(freedom, 0.975)),
        len(complete),
    )


def coherence(one: Segments, two: Segments) -> Coherence:
    """The squared coherence of two signals with the same segments."""
    both = ~(np.isnan(one.transforms).any(axis=1) | np.isnan(two.transforms).any(axis=1))
    a, b = one.transforms[both], two.transforms[both]
    k = _independent(int(np.count_nonzero(both)))
    if k <= 1.5:
        return Coherence(one.frequencies, np.full(len(one.frequencies), np.nan), np.nan)
    cross = np.abs(np.mean(a * np.conj(b), axis=0)) ** 2
    powers = np.mean(np.abs(a) ** 2, axis=0) * np.mean(np.abs(b) ** 2, axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        squared = np.where(powers > 0, cross / powers, np.nan)
    return Coherence(one.frequencies, squared, float(1.0 - 0.05 ** (1.0 / (k - 1.0))))


def _independent(count: int) -> float:
    """Independent segments that `count` half-overlapping ones are worth."""
    return count / (1.0 + 2.0 * _OVERLAP_CORRELATION * (count - 1) / count) if count else 0.0


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

    ``values``: (n,) array; NaN where missing. ``sample_time``: s.
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
