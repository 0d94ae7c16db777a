"""A sum of harmonics with a low crest factor, for exciting a band evenly.

Source: M. R. Schroeder, "Synthesis of low-peak-factor signals and binary sequences with low
autocorrelation", IEEE Trans. Information Theory 16(1), 1970, eq. 9 (flat spectrum).
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from trms_cli.core.errors import ConfigurationError
from trms_cli.references.signal import EDGE, Array, Frequency, has_started

#: Points per period of the highest harmonic in the search for the peak: 32 miss it by at most
#: 0.5 %.
_POINTS_PER_PERIOD = 32


@dataclass(frozen=True, kw_only=True)
class Multisine:
    """All harmonics of ``frequency`` within ``[lowest, highest]``, each equally strong.

    With K harmonics ``f_1 … f_K`` and Schroeder's phases ``φ_k = −π k(k − 1)/K``::

        r(t) = offset + amplitude / peak · Σ_k cos(2π f_k (t − start + phase/frequency) + φ_k)
    """

    amplitude: float  #: Largest deviation from the offset within a period, rad
    #: Distance between two harmonics, Hz; the signal repeats after ``1/frequency``
    frequency: Frequency
    #: ``lowest``, ``highest``: band, Hz
    lowest: Frequency
    highest: Frequency
    offset: float = 0.0  #: Mean value, and the value before ``start``, rad
    #: Lead as a fraction of the whole period; two axes with different phases are less alike
    phase: float = 0.0
    start: float = 0.0  #: Time at which the signal begins, s

    def __post_init__(self) -> None:
        if self.lowest > self.highest:
            raise ConfigurationError(
                f"the band ends at {self.highest:g} Hz, below its begin of {self.lowest:g} Hz",
                where="highest",
                remedy="give lowest ≤ highest",
            )
        if self.harmonics.size == 0:
            raise ConfigurationError(
                f"no multiple of {self.frequency:g} Hz lies within "
                f"[{self.lowest:g}, {self.highest:g}] Hz",
                where="frequency",
                remedy="choose a frequency that is at most the width of the band",
            )

    @cached_property
    def harmonics(self) -> NDArray[np.int64]:
        """Multiples of ``frequency`` in the band, (K,)."""
        first = int(np.ceil(self.lowest / self.frequency - EDGE))
        last = int(np.floor(self.highest / self.frequency + EDGE))
        return np.arange(max(first, 1), last + 1)

    @cached_property
    def _scale(self) -> float:
        """rad per unit of the bare sum: what makes its peak the amplitude."""
        points = _POINTS_PER_PERIOD * int(self.harmonics[-1])
        return self.amplitude / float(np.max(np.abs(self._sum(np.arange(points) / points))))

    def _sum(self, cycles: Array) -> Array:
        """The bare sum at ``cycles: (n,)`` periods."""
        k = np.arange(1, self.harmonics.size + 1)
        total = np.zeros(np.shape(cycles))
        # one harmonic at a time: a run of minutes times a hundred harmonics would fill memory
        for harmonic, phase in zip(
            self.harmonics, -np.pi * k * (k - 1) / self.harmonics.size, strict=True
        ):
            total += np.cos(2 * np.pi * harmonic * cycles + phase)
        return total

    def sample(self, times: Array) -> Array:
        cycles = (np.asarray(times, dtype=float) - self.start) * self.frequency + self.phase
        wave = self._scale * self._sum(cycles)
        return self.offset + np.where(has_started(times, self.start), wave, 0.0)
