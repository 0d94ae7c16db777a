"""A channel that is off by a constant from one sample to the next: an encoder that slipped."""

from dataclasses import dataclass

import numpy as np

from trms_cli.core.ranges import NotNegative, Positive
from trms_cli.plants.faults.fault import FaultRun, FaultSetup, ShiftedReading


@dataclass(frozen=True, kw_only=True)
class ShiftedSensor:
    """The reading is off by a constant."""

    channel: str
    start: NotNegative  #: s
    shift: float  #: rad or rad/s
    duration: Positive | None = None  #: s; None lasts to the end

    def init(self, setup: FaultSetup) -> FaultRun:
        active = setup.window(self.start, self.duration)
        words = f"{self.channel} is off by {self.shift:g}"
        off = np.full(setup.samples, self.shift)
        return ShiftedReading(active, words, setup.output(self.channel), off)
