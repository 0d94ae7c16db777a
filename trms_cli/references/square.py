"""A square wave: the reference of the benchmarks."""

from dataclasses import dataclass

import numpy as np

from trms_cli.references.signal import Array, Frequency, cycles_since_start, has_started


@dataclass(frozen=True, kw_only=True)
class Square:
    """``offset ± amplitude``, high in the first half of each period."""

    #: Half of the distance between the two levels, rad; negative begins with the low half
    amplitude: float
    frequency: Frequency  #: Hz
    offset: float = 0.0  #: Mean value, and the value before ``start``, rad
    phase: float = 0.0  #: Lead as a fraction of a period
    start: float = 0.0  #: Time at which the wave begins, s

    def sample(self, times: Array) -> Array:
        cycles = cycles_since_start(times, self.start, self.frequency, self.phase)
        wave = np.where(cycles - np.floor(cycles) < 0.5, self.amplitude, -self.amplitude)
        return self.offset + np.where(has_started(times, self.start), wave, 0.0)
