"""A straight line from one value to another."""

from dataclasses import dataclass

import numpy as np

from trms_cli.references.signal import Array, Duration


@dataclass(frozen=True, kw_only=True)
class Ramp:
    """From ``offset`` to ``offset + amplitude`` within ``duration``, then at rest."""

    amplitude: float  #: Height, rad; the slope is ``amplitude / duration``
    duration: Duration  #: Time of the rise, s
    offset: float = 0.0  #: Value before the ramp, rad
    start: float = 0.0  #: Time at which the ramp begins, s

    def sample(self, times: Array) -> Array:
        elapsed = (np.asarray(times, dtype=float) - self.start) / self.duration
        return self.offset + self.amplitude * np.clip(elapsed, 0.0, 1.0)
