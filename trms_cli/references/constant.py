"""A value that does not change."""

from dataclasses import dataclass

import numpy as np

from trms_cli.references.signal import Array


@dataclass(frozen=True, kw_only=True)
class Constant:
    """``r(t) = offset``."""

    offset: float = 0.0  #: The value, rad

    def sample(self, times: Array) -> Array:
        return np.full(np.shape(times), self.offset)
