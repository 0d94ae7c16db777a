"""A sine wave."""

from dataclasses import dataclass

import numpy as np

from trms_cli.references.signal import Array, Frequency, has_started


@dataclass(frozen=True, kw_only=True)
class Sine:
    """``offset + amplitude·sin(2π(frequency·(t − start) + phase))``."""

    amplitude: float  #: Peak deviation from the offset, rad
    frequency: Frequency  #: Hz
    offset: float = 0.0  #: Mean value, and the value before ``start``, rad
    phase: float = 0.0  #: Lead as a fraction of a period; 0.25 makes a cosine
    start: float = 0.0  #: Time at which the wave begins, s

    def sample(self, times: Array) -> Array:
        cycles = (np.asarray(times, dtype=float) - self.start) * self.frequency + self.phase
        wave = self.amplitude * np.sin(2 * np.pi * cycles)
        return self.offset + np.where(has_started(times, self.start), wave, 0.0)
