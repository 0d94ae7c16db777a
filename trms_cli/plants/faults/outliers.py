"""Single readings far off: spikes on a tacho's line, a bit that flips in a counter."""

from dataclasses import dataclass

import numpy as np

from trms_cli.core.ranges import NotNegative, Positive
from trms_cli.plants.faults.fault import FaultRun, FaultSetup, Share, ShiftedReading


@dataclass(frozen=True, kw_only=True)
class Outliers:
    """Some readings of a channel are off by a fixed size, to either side."""

    channel: str
    start: NotNegative  #: s
    size: Positive  #: By how much, rad or rad/s
    duration: Positive | None = None  #: s; None lasts to the end
    probability: Share = 0.02  #: Share of the samples that are off

    def init(self, setup: FaultSetup) -> FaultRun:
        generator = np.random.default_rng(setup.seed)
        hit = generator.random(setup.samples) < self.probability
        off = np.where(hit, self.size * generator.choice([-1.0, 1.0], setup.samples), 0.0)
        return ShiftedReading(
            setup.window(self.start, self.duration),
            f"{100 * self.probability:g} % of {self.channel} are off by {self.size:g}",
            setup.output(self.channel),
            off,
        )
