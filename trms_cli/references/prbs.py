"""A pseudo-random binary sequence of maximal length.

Source: L. Ljung, "System Identification", 2nd ed., section 13.3; the shift register is SciPy's.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

import msgspec
import numpy as np

from trms_cli.references.signal import EDGE, Array, Duration, has_started


@dataclass(frozen=True, kw_only=True)
class Prbs:
    """``offset ± amplitude`` after the bits of a shift register, one bit per ``hold``.

    The sequence repeats after ``2**bits − 1`` bits; its spectrum is flat up to about
    ``0.44 / hold`` Hz.

    Parameters
    ----------
    amplitude : float
        Half of the distance between the two levels, rad.
    hold : float
        Time of one bit, s.
    bits : int
        Length of the shift register.
    offset : float
        Middle of the two levels, and the value before ``start``, rad.
    phase : float
        Lead as a fraction of the whole sequence; 0.5 on the second axis makes the two axes
        uncorrelated.
    start : float
        Time at which the sequence begins, s.
    """

    amplitude: float
    hold: Duration
    bits: Annotated[int, msgspec.Meta(ge=2, le=20)] = 8
    offset: float = 0.0
    phase: float = 0.0
    start: float = 0.0

    @cached_property
    def _levels(self) -> Array:
        """One period of the sequence as ±1, ``(2**bits − 1,)``."""
        from scipy.signal import max_len_seq

        return 2.0 * max_len_seq(self.bits)[0] - 1.0

    def sample(self, times: Array) -> Array:
        """Value at each time, ``times: (n,) s -> (n,) rad``."""
        length = self._levels.size
        elapsed = (np.asarray(times, dtype=float) - self.start) / self.hold
        # a whole number of bits, so that the edges stay where they are without a phase
        lead = round(self.phase * length)
        index = (np.floor(elapsed + EDGE).astype(np.int64) + lead) % length
        wave = self.amplitude * self._levels[index]
        return self.offset + np.where(has_started(times, self.start), wave, 0.0)
