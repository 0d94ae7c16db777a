"""A channel that is off by a constant from one sample to the next: an encoder that slipped."""

from __future__ import annotations

from dataclasses import dataclass

from trms_cli.core.arrays import FloatArray
from trms_cli.core.ranges import NotNegative, Positive
from trms_cli.plants.faults.fault import FaultRun, FaultSetup


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
        return _Run(active, words, setup.output(self.channel), self.shift)


class _Run(FaultRun):
    def __init__(self, active: range, words: str, column: int, shift: float) -> None:
        super().__init__(active, words)
        self._column, self._shift = column, shift

    def sensed(self, sample: int, y: FloatArray) -> None:
        if sample in self.active:
            y[self._column] += self._shift
