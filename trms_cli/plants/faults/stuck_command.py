"""An input that no longer follows its command: an amplifier that holds its last value."""

from dataclasses import dataclass

from trms_cli.core.arrays import FloatArray
from trms_cli.core.ranges import NotNegative, Positive
from trms_cli.plants.faults.fault import FaultRun, FaultSetup


@dataclass(frozen=True, kw_only=True)
class StuckCommand:
    """The input stays what it was when the fault began, or at a given value."""

    input: str
    start: NotNegative  #: s
    duration: Positive | None = None  #: s; None lasts to the end
    value: float | None = None  #: V; None holds the last command

    def init(self, setup: FaultSetup) -> FaultRun:
        active = setup.window(self.start, self.duration)
        words = f"{self.input} is stuck" + ("" if self.value is None else f" at {self.value:g} V")
        return _Run(active, words, setup.input(self.input), self.value)


class _Run(FaultRun):
    def __init__(self, active: range, words: str, column: int, value: float | None) -> None:
        super().__init__(active, words)
        self._column, self._value, self._last_command = column, value, 0.0

    def commanded(self, sample: int, u: FloatArray) -> None:
        if sample not in self.active:
            self._last_command = u[self._column]
        else:
            u[self._column] = self._last_command if self._value is None else self._value
