"""Which measurements a filter believes: a gate on each channel's innovation.

A sample whose innovation is beyond ``gate`` of its expected standard deviations is treated as
missing. That alone could blind a filter for ever: where the model is wrong, or the rig was moved
by hand, every sample looks like an outlier. A channel that was rejected without a break for
``longest_rejection`` seconds is therefore believed again, from a covariance widened by the
prior's, and stays believed until its innovations have kept within the gate for as long.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]


@dataclass
class Gate:
    """The gate of a filter that runs."""

    width: float  #: Standard deviations; infinite for a gate that is open for good
    #: Samples of unbroken rejection after which a channel is believed, and of unbroken agreement
    #: after which it is watched again
    patience: int
    #: (n_y,) array; ``width²`` per channel, infinite where the gate is open: an input of the
    #: filter's step
    squared: FloatArray
    #: (n_y,) int array; samples that a watched channel has been rejected, or a believed one has
    #: agreed, in a row
    run: npt.NDArray[np.int64]
    open: BoolArray  #: (n_y,) bool array; channels believed again
    #: (n_y,) array; 1 for what the last sample's gate held back; zeros for a gate that is always
    #: open
    rejected: FloatArray
    counting: bool = False  #: Whether any channel has a run or is believed again

    @classmethod
    def start(
        cls,
        gate: float | None,
        longest_rejection: float,
        sample_time: float,
        squared: FloatArray,
        rejected: FloatArray,
    ) -> Gate:
        """A gate over the arrays of a filter's step, which it fills and reads."""
        n_y = squared.size
        width = np.inf if gate is None else gate
        squared[:] = width**2
        patience = max(1, round(longest_rejection / sample_time))
        return cls(
            width, patience, squared, np.zeros(n_y, int), np.zeros(n_y, dtype=bool), rejected
        )

    @property
    def active(self) -> bool:
        """Whether there is a gate at all."""
        return self.width < np.inf

    def quiet(self) -> bool:
        """Whether the last sample changes nothing in the gate: all was believed, as before."""
        return not (self.counting or any(self.rejected.tolist()))

    def follow(self, present: BoolArray, innovation: FloatArray, sd: FloatArray) -> bool:
        """Take note of a sample; true if a channel is to be believed from the next one on.

        Parameters
        ----------
        present : (n_y,) bool array
            Channels that were measured; the others change nothing.
        innovation, sd : (n_y,) arrays
        """
        within = np.abs(innovation) <= self.width * sd
        counting = np.where(self.open, within, self.rejected > 0)
        self.run[present & counting] += 1
        self.run[present & ~counting] = 0
        turned = self.run >= self.patience
        widened = bool((turned & ~self.open).any())
        self.run[turned] = 0
        self.open ^= turned
        self.squared[:] = np.where(self.open, np.inf, self.width**2)
        self.counting = bool(self.run.any() or self.open.any())
        return widened
