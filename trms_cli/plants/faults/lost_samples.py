"""A channel that is not read: a wire that is off, or samples dropped on the way."""

from dataclasses import dataclass

import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.core.ranges import NotNegative, Positive
from trms_cli.plants.faults.fault import FaultRun, FaultSetup, Share


@dataclass(frozen=True, kw_only=True)
class LostSamples:
    """No reading of a channel."""

    channel: str
    start: NotNegative  #: s
    duration: Positive | None = None  #: s; None lasts to the end
    probability: Share = 1.0  #: Share of the samples that are lost meanwhile

    def init(self, setup: FaultSetup) -> FaultRun:
        column = setup.output(self.channel)
        is_lost = np.random.default_rng(setup.seed).random(setup.samples) < self.probability
        share = "" if self.probability == 1.0 else f"{100 * self.probability:g} % of "
        return _Run(
            setup.window(self.start, self.duration),
            f"{share}{self.channel} is not read",
            column,
            is_lost,
        )


class _Run(FaultRun):
    def __init__(self, active: range, words: str, column: int, is_lost: np.ndarray) -> None:
        super().__init__(active, words)
        self._column, self._is_lost = column, is_lost

    def sensed(self, sample: int, y: FloatArray) -> None:
        if sample in self.active and self._is_lost[sample]:
            y[self._column] = np.nan
