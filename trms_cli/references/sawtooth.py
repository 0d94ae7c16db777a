"""Sawteeth and triangles."""

from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np

from trms_cli.references.signal import Array, Frequency, cycles_since_start, has_started


@dataclass(frozen=True, kw_only=True)
class Sawtooth:
    """Rises in a straight line from ``offset − amplitude`` to ``offset + amplitude``, and back.

    Like a sine it begins at the offset, rising, so that it starts without a jump.
    """

    amplitude: float  #: Peak deviation from the offset, rad; negative begins by falling
    frequency: Frequency  #: Hz
    #: Fraction of the period spent rising: 1 is a sawtooth that drops at once, 0.5 a triangle
    width: Annotated[float, msgspec.Meta(gt=0, le=1)] = 1.0
    offset: float = 0.0  #: Mean value, and the value before ``start``, rad
    phase: float = 0.0  #: Lead as a fraction of a period
    start: float = 0.0  #: Time at which the wave begins, s

    def sample(self, times: Array) -> Array:
        lead = self.phase + self.width / 2
        cycles = cycles_since_start(times, self.start, self.frequency, lead)
        position = cycles - np.floor(cycles)
        rising = 2 * position / self.width - 1
        # with width 1 there is no falling part; the divisor only has to be harmless
        falling = 1 - 2 * (position - self.width) / max(1 - self.width, 1e-300)
        wave = self.amplitude * np.where(position < self.width, rising, falling)
        return self.offset + np.where(has_started(times, self.start), wave, 0.0)
