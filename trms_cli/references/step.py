"""One step from one value to another."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trms_cli.references.signal import Array, has_started


@dataclass(frozen=True, kw_only=True)
class Step:
    """``offset`` before ``start``, ``offset + amplitude`` from then on.

    Parameters
    ----------
    amplitude : float
        Height of the step, rad; negative steps down.
    offset : float
        Value before the step, rad.
    start : float
        Time of the step, s.
    """

    amplitude: float
    offset: float = 0.0
    start: float = 0.0

    def sample(self, times: Array) -> Array:
        """Value at each time, ``times: (n,) s -> (n,) rad``."""
        return self.offset + np.where(has_started(times, self.start), self.amplitude, 0.0)
