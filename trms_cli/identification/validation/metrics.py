"""Figures of a model's errors and of signals, what chance leaves open, and where errors lie.

    fit = 100 (1 − ‖e‖/‖y − ȳ‖)        VAF = 100 (1 − var e / var y)

Fit counts a constant error, VAF does not; both are 100 for no error and may be negative.

Errors of several models are of the same windows of the same recordings, so they are paired. Windows
overlap and neighbours resemble each other, so whole blocks of time are drawn anew, with all that
lies in them (H. R. Künsch, "The jackknife and the bootstrap for general stationary observations",
Ann. Statist. 17, 1989, without overlap of the blocks).

By region: each sample of the free-run windows belongs to a bin of every operating variable (the
measured outputs and the commands). Bins hold equally many samples, so that a share of the squared
error is to be compared with one over the number of bins.

Signals are told by their characteristics and spectra: what is excited, and whether it stays alike.
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

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from trms_cli.core.arrays import FloatArray, IntArray
from trms_cli.identification.dataset import Dataset


def rms(errors: FloatArray) -> float:
    """Root mean square of what is present; NaN if nothing is, infinite if the model overflowed."""
    present = errors[~np.isnan(errors)]
    if not present.size:
        return np.nan
    with np.errstate(over="ignore"):
        return float(np.sqrt(np.mean(present**2)))


def largest(errors: FloatArray) -> float:
    """Largest absolute error."""
    present = np.abs(errors[~np.isnan(errors)])
    return float(present.max()) if present.size else np.nan


def fit_percent(errors: FloatArray, measured: FloatArray) -> float:
    """Fit in %; NaN for a signal that does not move."""
    return _percent(errors, measured, lambda e, y: np.linalg.norm(e) / np.linalg.norm(y - y.mean()))


def vaf_percent(errors: FloatArray, measured: FloatArray) -> float:
    """Variance accounted for in %; NaN for a signal that does not move."""
    return _percent(errors, measured, lambda e, y: np.var(e) / np.var(y))


def _percent(
    errors: FloatArray, measured: FloatArray, share: Callable[[FloatArray, FloatArray], Any]
) -> float:
    """What a share of the measured signal leaves of 100 %, over what is present."""
    present = ~np.isnan(errors) & ~np.isnan(measured)
    e, y = errors[present], measured[present]
    if not e.size or not np.ptp(y) > 0:
        return np.nan
    with np.errstate(over="ignore", invalid="ignore"):
        return 100.0 * (1.0 - float(share(e, y)))


_DRAWS = 2000


@dataclass(frozen=True)
class WindowErrors:
    """Errors of the windows of one horizon in one recording."""

    channels: tuple[str, ...]
    first: IntArray  #: (m,) array of int; first sample of each window
    errors: FloatArray  #: (m, k, n_y) array; measured minus simulated; NaN where not measured
    measured: FloatArray  #: (m, k, n_y) array
    #: (m, k, n_y) array; error of the prediction that nothing changes from the last sample before
    #: the window
    unchanged: FloatArray


@dataclass(frozen=True)
class BlockSums:
    """Squared errors of one model, channel and horizon, summed over blocks of time."""

    squares: FloatArray  #: (b,) array; squared errors, summed in each block
    counts: FloatArray  #: (b,) array; how many samples they are

    @property
    def rms(self) -> float:
        """Over all blocks."""
        total = self.counts.sum()
        return float(np.sqrt(self.squares.sum() / total)) if total else np.nan


@dataclass(frozen=True)
class BootstrapInterval:
    """An estimate with its 95 % interval."""

    value: float  #: the estimate
    lower: float  #: 2.5 % of the draws lie below
    upper: float  #: 2.5 % of the draws lie above

    @property
    def ends(self) -> list[float]:
        """Of the interval."""
        return [self.lower, self.upper]


def block_sums(
    recordings: Sequence[WindowErrors], channel: str, block: int, errors: str = "errors"
) -> BlockSums:
    """Sum the squared errors of a channel over blocks.

    ``recordings``: of one horizon; a block never reaches over the end of a recording. ``block``:
    samples; windows that begin in it belong to it.
    """
    squares: list[float] = []
    counts: list[float] = []
    for windows in recordings:
        if channel not in windows.channels or not len(windows.first):
            continue
        column = getattr(windows, errors)[:, :, windows.channels.index(channel)]
        with np.errstate(over="ignore"):
            each = np.nansum(column**2, axis=1)
        present = np.count_nonzero(~np.isnan(column), axis=1)
        of = (windows.first - windows.first[0]) // block
        squares += np.bincount(of, each).tolist()
        counts += np.bincount(of, present).tolist()
    return BlockSums(np.array(squares), np.array(counts))


def rms_interval(sums: BlockSums, seed: int) -> BootstrapInterval:
    """The RMS with its interval; without one for fewer than four blocks."""
    return _interval(sums.rms, [sums], lambda rms: rms[0], seed)


def ratio_interval(one: BlockSums, other: BlockSums, seed: int) -> BootstrapInterval:
    """RMS of the one over RMS of the other, paired by blocks."""
    value = one.rms / other.rms if other.rms > 0 else np.nan
    return _interval(value, [one, other], lambda rms: rms[0] / rms[1], seed)


def mean_log_ratio(
    one: Mapping[tuple[str, float], BlockSums],
    other: Mapping[tuple[str, float], BlockSums],
    seed: int,
) -> BootstrapInterval:
    """Geometric mean over channels and horizons of the ratios of RMS, paired by blocks.

    Horizons have different numbers of windows; a draw takes the same share of each.
    """
    keys = [key for key in one if key in other and one[key].rms > 0 and other[key].rms > 0]
    if not keys:
        return BootstrapInterval(np.nan, np.nan, np.nan)
    value = float(np.exp(np.mean([np.log(one[k].rms / other[k].rms) for k in keys])))
    blocks = {key: min(len(one[key].squares), len(other[key].squares)) for key in keys}
    most = max(blocks.values())
    if most < 4:
        return BootstrapInterval(value, np.nan, np.nan)
    draws = _draws(most, seed)
    logs = np.zeros(len(draws))
    for key in keys:
        # blocks that only shorter horizons reach are taken from the same places, wrapped
        indices = draws % blocks[key]
        a, b = (_rms_of_draws(x[key], indices) for x in (one, other))
        with np.errstate(divide="ignore", invalid="ignore"):
            logs += np.log(a / b) / len(keys)
    lower, upper = np.exp(np.nanquantile(logs, [0.025, 0.975]))
    return BootstrapInterval(value, float(lower), float(upper))


def _interval(
    value: float,
    sums: Sequence[BlockSums],
    figure: Callable[[list[FloatArray]], FloatArray],
    seed: int,
) -> BootstrapInterval:
    blocks = len(sums[0].squares)
    if blocks < 4 or not np.isfinite(value):
        return BootstrapInterval(value, np.nan, np.nan)
    draws = _draws(blocks, seed)
    with np.errstate(divide="ignore", invalid="ignore"):
        samples = figure([_rms_of_draws(each, draws) for each in sums])
    samples = samples[np.isfinite(samples)]
    if not samples.size:
        return BootstrapInterval(value, np.nan, np.nan)
    lower, upper = np.quantile(samples, [0.025, 0.975])
    return BootstrapInterval(value, float(lower), float(upper))


def _draws(blocks: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, blocks, (_DRAWS, blocks))


def _rms_of_draws(sums: BlockSums, draws: np.ndarray) -> FloatArray:
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        return np.asarray(np.sqrt(sums.squares[draws].sum(axis=1) / sums.counts[draws].sum(axis=1)))


#: Bins of an operating variable.
BINS = 8


@dataclass(frozen=True)
class RegionTable:
    """The error of one channel over one operating variable."""

    channel: str
    variable: str
    edges: FloatArray  #: (b + 1,) array; of the bins, in the variable's unit
    rms: FloatArray  #: (b,) array; of the error in each bin, in the channel's unit
    time_share: FloatArray  #: (b,) array; of the samples
    error_share: FloatArray  #: (b,) array; of the squared error


def region_tables(
    errors: Mapping[str, FloatArray], variables: Mapping[str, FloatArray], bins: int = BINS
) -> list[RegionTable]:
    """Tables of all channels over all variables.

    ``errors``: dict of str to (N,) arrays; by channel; NaN where there is none. ``variables``: dict
    of str to (N,) arrays; operating variables at the same samples; NaN where missing.
    """
    tables = []
    for variable, values in variables.items():
        present = values[~np.isnan(values)]
        if present.size < 10 * bins:
            continue
        edges = np.unique(np.quantile(present, np.linspace(0, 1, bins + 1)))
        if len(edges) < 3:
            continue  # it hardly moves
        for channel, error in errors.items():
            table = _table(channel, variable, error, values, edges)
            if table is not None:
                tables.append(table)
    return tables


def _table(
    channel: str, variable: str, error: FloatArray, values: FloatArray, edges: FloatArray
) -> RegionTable | None:
    is_valid = np.isfinite(error) & ~np.isnan(values)
    square = error[is_valid] ** 2
    if not square.size or not np.isfinite(square.sum()) or not square.sum() > 0:
        return None
    n = len(edges) - 1
    bin_of = np.clip(np.searchsorted(edges, values[is_valid], side="right") - 1, 0, n - 1)
    counts = np.bincount(bin_of, minlength=n).astype(float)
    sums = np.bincount(bin_of, square, minlength=n)
    if np.any(counts == 0):
        return None
    return RegionTable(
        channel, variable, edges, np.sqrt(sums / counts), counts / counts.sum(), sums / sums.sum()
    )


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
    lower: float  #: Factor of the density to the lower end of its 95 % interval
    upper: float  #: To the upper end
    segments: int


@dataclass(frozen=True)
class Coherence:
    """Squared coherence of two signals."""

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
        return Coherence(np.full(len(one.frequencies), np.nan), np.nan)
    cross = np.abs(np.mean(a * np.conj(b), axis=0)) ** 2
    powers = np.mean(np.abs(a) ** 2, axis=0) * np.mean(np.abs(b) ** 2, axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        squared = np.where(powers > 0, cross / powers, np.nan)
    return Coherence(squared, float(1.0 - 0.05 ** (1.0 / (k - 1.0))))


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
    autocorrelation: FloatArray  #: (l,) array; at lags 0, 1, … samples, up to ten correlation times


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
    lag_count = len(r) if np.isnan(time) else min(len(r), max(20, round(10 * time / sample_time)))
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
        r[:lag_count],
    )


def characteristics_of(dataset: Dataset) -> list[Characteristics]:
    """Statistics of the outputs, then of the inputs; of those that have any sample."""
    columns = [
        *zip(dataset.outputs, dataset.measurements.T, strict=True),
        *zip(dataset.inputs, dataset.commands.T, strict=True),
    ]
    results = [characteristics(s.name, s.unit, y, dataset.sample_time) for s, y in columns]
    return [signal for signal in results if signal.samples]


def autocorrelation(values: FloatArray) -> FloatArray:
    """Autocorrelation at lags 0, 1, … up to half the length; missing samples count for nothing."""
    from scipy.signal import correlate

    centred = values - np.nanmean(values)
    is_present = ~np.isnan(centred)
    centred = np.where(is_present, centred, 0.0)
    n = len(values)
    pairs = correlate(is_present.astype(float), is_present.astype(float), method="fft")[n - 1 :]
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
