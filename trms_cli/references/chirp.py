"""A sine whose frequency sweeps from one value to another."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from trms_cli.references.signal import Array, Duration, Frequency, has_started


@dataclass(frozen=True, kw_only=True)
class Chirp:
    """``offset + amplitude·sin(2π·(cycles(t) + phase))`` with a sweeping frequency.

    With ``τ = t − start``, T the duration, and ``k = final/frequency``::

        linear:       cycles = frequency·τ + (final − frequency)·τ²/(2T)
        logarithmic:  cycles = frequency·T/ln k · (k^(τ/T) − 1)

    (the formulas of ``scipy.signal.chirp``, which a test compares with; importing it would cost
    more than the whole start of a run). After the sweep the last value is held.
    """

    amplitude: float  #: Peak deviation from the offset, rad
    frequency: Frequency  #: Frequency at the start, Hz
    #: Frequency at the end of the sweep, Hz; may be lower than the first
    final_frequency: Frequency
    duration: Duration  #: Time of the sweep, s
    #: Whether the frequency grows by equal steps or by equal factors in equal times
    sweep: Literal["linear", "logarithmic"] = "linear"
    offset: float = 0.0  #: Mean value, and the value before ``start``, rad
    phase: float = 0.0  #: Lead as a fraction of a period
    start: float = 0.0  #: Time at which the sweep begins, s

    def sample(self, times: Array) -> Array:
        elapsed = np.asarray(times, dtype=float) - self.start
        swept = np.clip(elapsed, 0.0, self.duration)
        ratio = self.final_frequency / self.frequency
        if self.sweep == "linear" or ratio == 1.0:
            slope = (self.final_frequency - self.frequency) / self.duration
            cycles = self.frequency * swept + slope * swept**2 / 2
        else:
            exponent = np.log(ratio) * swept / self.duration
            cycles = self.frequency * self.duration / np.log(ratio) * np.expm1(exponent)
        wave = self.amplitude * np.sin(2 * np.pi * (cycles + self.phase))
        return self.offset + np.where(has_started(times, self.start), wave, 0.0)
