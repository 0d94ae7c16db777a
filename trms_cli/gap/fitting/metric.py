"""A metric of residuals: whitened by noise and by what the equations may err by."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from trms_cli.gap.innovations.discrepancy import Discrepancy
from trms_cli.gap.innovations.kalman import Gains

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Metric:
    """The same linear operation for all who compete, so that their costs can be compared."""

    #: Linearised along the recording, through the states that the data say
    discrepancy: Discrepancy
    #: (n_d,) array; size of the force on each equation, as a share of what acts there
    shares: FloatArray
    #: Innovations beyond so many standard deviations count linearly (Huber)
    robust: float | None = 4.0
    filter_: Gains = field(init=False, repr=False)  #: Ready to run

    def __post_init__(self) -> None:
        object.__setattr__(self, "filter_", self.discrepancy.filter(self.shares))

    def whitened(self, columns: FloatArray) -> FloatArray:
        """Innovations of columns (m, c, n_y, k)."""
        return self.discrepancy.whitened(self.filter_, columns)

    def losses(self, z: FloatArray) -> FloatArray:
        """Half the robust squares of innovations (m, c, n_y), by window, shape (m,)."""
        loss = z**2
        if self.robust is not None:
            size = np.abs(z)
            far = size > self.robust
            loss = np.where(far, 2 * self.robust * size - self.robust**2, loss)
        total: FloatArray = 0.5 * loss.sum(axis=(1, 2))
        return total

    def roots(self, z: FloatArray) -> FloatArray:
        """Factors of innovations and slopes whose squares make the losses' parabola."""
        if self.robust is None:
            return np.ones_like(z)
        roots: FloatArray = np.sqrt(self.robust / np.maximum(np.abs(z), self.robust))
        return roots

    @property
    def normalisation(self) -> FloatArray:
        """What a window's log density loses by the spread of its innovations, nats, (m,)."""
        half: FloatArray = 0.5 * self.filter_.logdet
        return half
