"""Power spectra and coherence by Welch's method, with bands, in spite of missing samples.

Segments of a Hann window, half overlapping, each without its mean; a segment with a missing sample
is left out. K segments are worth K/(1 + 2c²(K − 1)/K) independent ones, c² = 1/36 for this window
and overlap, which gives a power spectrum twice as many degrees of freedom.

Sources: P. D. Welch, "The use of fast Fourier transform for the estimation of power spectra", IEEE
Trans. Audio Electroacoust. 15, 1967; J. S. Bendat, A. G. Piersol, "Random data", 4th ed. 2010,
sections 8.5 and 9.2 (bands, and the coherence that independent signals show by chance).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from trms_cli.identification.dataset import FloatArray

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
    #: ``lower``, ``upper``: (f,) arrays; 95 % interval (Fisher's transform)
    lower: FloatArray
    upper: FloatArray
    segments: int


def segments_of(values: FloatArray, sample_time: float, length: int) -> Segments:
    """Cut a signal into segments and transform them.

    Parameters
    ----------
    values : (n,) array
        NaN where missing.
    length : int
        Samples of a segment.
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
        nothing = np.full(len(one.frequencies), np.nan)
        return Coherence(
            one.frequencies, nothing, np.nan, nothing, nothing, int(np.count_nonzero(both))
        )
    cross = np.abs(np.mean(a * np.conj(b), axis=0)) ** 2
    powers = np.mean(np.abs(a) ** 2, axis=0) * np.mean(np.abs(b) ** 2, axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        squared = np.where(powers > 0, cross / powers, np.nan)
    root = np.arctanh(np.minimum(np.sqrt(squared), 1 - 1e-12))
    reach = 1.96 / np.sqrt(2.0 * k)
    return Coherence(
        one.frequencies,
        squared,
        float(1.0 - 0.05 ** (1.0 / (k - 1.0))),
        np.tanh(np.maximum(root - reach, 0.0)) ** 2,
        np.tanh(root + reach) ** 2,
        int(np.count_nonzero(both)),
    )


def _independent(count: int) -> float:
    """Independent segments that `count` half-overlapping ones are worth."""
    return count / (1.0 + 2.0 * _OVERLAP_CORRELATION * (count - 1) / count) if count else 0.0
