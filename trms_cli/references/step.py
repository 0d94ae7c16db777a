"""One step from one value to another."""

from dataclasses import dataclass

import numpy as np

from trms_cli.references.signal import Array, has_started


@dataclass(frozen=True, kw_only=True)
class Step:
    """``offset`` before ``start``, ``offset + amplitude`` from then on."""

    amplitude: float  #: Height of the step, rad; negative steps down
    offset: float = 0.0  #: Value before the step, rad
    start: float = 0.0  #: Time of the step, s

    def sample(self, times: Array) -> Array:
        return self.offset + np.where(has_started(times, self.start), self.amplitude, 0.0)
