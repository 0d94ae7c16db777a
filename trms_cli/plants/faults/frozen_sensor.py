"""A channel that shows its last value: a counter or a converter that hangs."""

from dataclasses import dataclass

from trms_cli.core.arrays import FloatArray
from trms_cli.core.ranges import NotNegative, Positive
from trms_cli.plants.faults.fault import FaultRun, FaultSetup


@dataclass(frozen=True, kw_only=True)
class FrozenSensor:
    """The reading stays what it was when the fault began."""

    channel: str
    start: NotNegative  #: s
    duration: Positive | None = None  #: s; None lasts to the end

    def init(self, setup: FaultSetup) -> FaultRun:
        active = setup.window(self.start, self.duration)
        return _Run(active, f"{self.channel} is frozen", setup.output(self.channel))


class _Run(FaultRun):
    def __init__(self, active: range, words: str, column: int) -> None:
        super().__init__(active, words)
        self._column, self._last_reading = column, 0.0

    def sensed(self, sample: int, y: FloatArray) -> None:
        if sample in self.active and sample > self.active.start:
            y[self._column] = self._last_reading
        else:
            self._last_reading = y[self._column]
