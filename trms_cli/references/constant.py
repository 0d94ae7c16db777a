"""A value that does not change."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trms_cli.references.signal import Array


@dataclass(frozen=True, kw_only=True)
class Constant:
    """``r(t) = offset``.

    Parameters
    ----------
    offset : float
        The value, rad.
    """

    offset: float = 0.0

    def sample(self, times: Array) -> Array:
        """Value at each time, ``times: (n,) s -> (n,) rad``."""
        return np.full(np.shape(times), self.offset)
