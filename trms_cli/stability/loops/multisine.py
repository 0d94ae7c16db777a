"""The test signal of a frequency response: a multisine of few lines, held over control periods.

All harmonics of the lowest line at first, then lines a constant factor apart, up to half the
controller's rate. What lies between the lines is left empty on purpose: power found there is not
the answer of a linear loop. Phases after M. R. Schroeder, "Synthesis of low-peak-factor signals
and binary sequences with low autocorrelation", IEEE Trans. Information Theory 16(1), 1970.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]


@dataclass(frozen=True)
class Probe:
    """One period of a multisine of rms 1."""

    step: float  #: Control period over which each value is held, s
    #: (n,) array of int; harmonics of the period that are in it, the lowest first
    lines: npt.NDArray[np.int64]
    values: FloatArray  #: (N,) array; one period

    @property
    def length(self) -> int:
        """Control periods after which it repeats."""
        return self.values.size

    @property
    def period(self) -> float:
        """Time after which it repeats, s."""
        return self.length * self.step

    @property
    def omega(self) -> FloatArray:
        """Frequencies of the lines, rad/s, (n,)."""
        return np.asarray(2 * math.pi * self.lines / self.period, dtype=np.float64)

    def spectrum(self, samples: FloatArray) -> ComplexArray:
        """Of one period (N, m), at the lines, (n, m)."""
        return np.asarray(np.fft.rfft(samples, axis=0)[self.lines])

    def beside(self, samples: FloatArray) -> float:
        """Power of a period (N, m) off the lines, as a share of that on them."""
        power = (np.abs(np.fft.rfft(samples, axis=0)) ** 2).sum(axis=1)
        on = float(power[self.lines].sum())
        power[0] = 0.0
        return (float(power.sum()) - on) / on if on > 0 else 0.0


def harmonics_of(step: float, lowest: float) -> int:
    """Harmonics of the lowest line (rad/s) up to half the rate of a control period (s)."""
    return round(math.pi / (lowest * step))


def multisine(step: float, lowest: float, ratio: float, seed: int = 0) -> Probe:
    """A multisine of a controller's band.

    Parameters
    ----------
    step : float
        Control period, s.
    lowest : float
        Lowest line, rad/s; the period is the whole even number of control periods that comes
        closest to it.
    ratio : float
        Of a line to the one below it, where the harmonics are denser than that.
    seed : int
        0: Schroeder's phases; else random ones, of another signal of the same spectrum.
    """
    half = max(2, harmonics_of(step, lowest))
    lines = [1]
    while lines[-1] < half:
        lines.append(max(lines[-1] + 1, round(lines[-1] * ratio)))
    # half the rate is a line too: the loop is real there, and may cross −1
    chosen = np.unique(np.minimum(lines, half))
    n = chosen.size
    if seed:
        phases = np.random.default_rng(seed).uniform(0, 2 * math.pi, n)
    else:
        order = np.arange(n)
        phases = -math.pi * order * (order + 1) / n
    spectrum = np.zeros(half + 1, dtype=complex)
    spectrum[chosen] = np.exp(1j * phases)
    spectrum[half] = 1.0
    values = np.fft.irfft(spectrum, 2 * half)
    return Probe(step, chosen, values / np.sqrt(np.mean(values**2)))
