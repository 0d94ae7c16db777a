"""A multilevel random signal: levels and the times for which they hold are drawn.

Where a rig is nonlinear in its amplitude, two levels (PRBS) cannot show it: see O. Nelles,
"Nonlinear System Identification", section 17.7 (amplitude-modulated PRBS).
"""

from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np

from trms_cli.core.errors import ConfigurationError
from trms_cli.references.signal import EDGE, Array, Duration, has_started

#: Levels are drawn in blocks, each from its own seed, so that the first ones are the same
#: however long the signal is asked for.
_BLOCK = 512


@dataclass(frozen=True, kw_only=True)
class Multilevel:
    """``offset + a_k`` from one drawn time to the next, ``a_k`` drawn within ±amplitude."""

    amplitude: float  #: Largest deviation from the offset, rad (of a command, in its own unit)
    #: Number of equally distant levels from −amplitude to +amplitude; None for any value
    levels: Annotated[int, msgspec.Meta(ge=2)] | None = None
    #: ``shortest``, ``longest``: between these the holding times are drawn uniformly, s
    shortest: Duration
    longest: Duration
    seed: Annotated[int, msgspec.Meta(ge=0)] = 0  #: Of both draws: another seed, another signal
    offset: float = 0.0  #: Middle of the levels, and the value before ``start``, rad
    start: float = 0.0  #: Time at which the signal begins, s

    def __post_init__(self) -> None:
        if self.shortest > self.longest:
            raise ConfigurationError(
                f"the longest holding time, {self.longest:g} s, is below the shortest of "
                f"{self.shortest:g} s",
                where="longest",
                remedy="give shortest ≤ longest",
            )

    def _draw_levels(self, until: float) -> tuple[Array, Array]:
        """Levels, and the times at which they end, until after a time since the start."""
        levels, ends, end, block = [], [], 0.0, 0
        while end <= until + EDGE:
            generator = np.random.default_rng([self.seed, block])
            shares = generator.random((2, _BLOCK))
            hold = self.shortest + (self.longest - self.shortest) * shares[0]
            if self.levels is None:
                level = 2 * shares[1] - 1
            else:
                step = np.minimum(np.floor(self.levels * shares[1]), self.levels - 1)
                level = 2 * step / (self.levels - 1) - 1
            ends.append(end + np.cumsum(hold))
            levels.append(level)
            end, block = float(ends[-1][-1]), block + 1
        return np.concatenate(levels), np.concatenate(ends)

    def sample(self, times: Array) -> Array:
        elapsed = np.asarray(times, dtype=float) - self.start
        levels, ends = self._draw_levels(float(np.max(elapsed, initial=0.0)))
        wave = self.amplitude * levels[np.searchsorted(ends, elapsed + EDGE, side="right")]
        return self.offset + np.where(has_started(times, self.start), wave, 0.0)
