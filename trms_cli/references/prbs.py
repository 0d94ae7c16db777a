"""A pseudo-random binary sequence of maximal length.

Source: L. Ljung, "System Identification", 2nd ed., section 13.3. The sequence is that of
``scipy.signal.max_len_seq``, which a test compares with: importing it takes 0.6 s, more than the
rest of a run's start.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

import msgspec
import numpy as np

from trms_cli.references.signal import EDGE, Array, Duration, has_started

#: Exponents between 0 and n of a primitive polynomial over GF(2) of each degree n.
_EXPONENTS = {
    2: (1,), 3: (2,), 4: (3,), 5: (3,), 6: (5,), 7: (6,), 8: (7, 6, 1), 9: (5,), 10: (7,),
    11: (9,), 12: (11, 10, 4), 13: (12, 11, 8), 14: (13, 12, 2), 15: (14,), 16: (15, 13, 4),
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Prbs:
    """``offset ± amplitude`` after the bits of a shift register, one bit per ``hold``.

    The sequence repeats after ``2**bits − 1`` bits; its spectrum is flat up to about
    ``0.44 / hold`` Hz.
    """

    amplitude: float  #: Half of the distance between the two levels, rad
    hold: Duration  #: Time of one bit, s
    bits: Annotated[int, msgspec.Meta(ge=2, le=16)] = 8  #: Length of the shift register
    offset: float = 0.0  #: Middle of the two levels, and the value before ``start``, rad
    #: Lead as a fraction of the whole sequence; 0.5 on the second axis makes the two axes
    #: uncorrelated
    phase: float = 0.0
    start: float = 0.0  #: Time at which the sequence begins, s

    @cached_property
    def _levels(self) -> Array:
        """One period of the sequence as ±1, ``(2**bits − 1,)``."""
        bits = [1] * self.bits
        for k in range(2**self.bits - 1 - self.bits):
            bit = bits[k]
            for exponent in _EXPONENTS[self.bits]:
                bit ^= bits[k + exponent]
            bits.append(bit)
        return 2.0 * np.array(bits) - 1.0

    def sample(self, times: Array) -> Array:
        length = self._levels.size
        elapsed = (np.asarray(times, dtype=float) - self.start) / self.hold
        # a whole number of bits, so that the edges stay where they are without a phase
        lead = round(self.phase * length)
        index = (np.floor(elapsed + EDGE).astype(np.int64) + lead) % length
        wave = self.amplitude * self._levels[index]
        return self.offset + np.where(has_started(times, self.start), wave, 0.0)
