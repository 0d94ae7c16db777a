"""Commands that arrive late: a network or a computer that is busy."""

from collections import deque
from dataclasses import dataclass

from trms_cli.core.arrays import FloatArray
from trms_cli.core.ranges import NotNegative, Positive
from trms_cli.plants.faults.fault import FaultRun, FaultSetup


@dataclass(frozen=True, kw_only=True)
class DelayedCommands:
    """All commands reach the rig later."""

    start: NotNegative  #: s
    delay: Positive  #: s, rounded to whole samples
    duration: Positive | None = None  #: s; None lasts to the end

    def init(self, setup: FaultSetup) -> FaultRun:
        active = setup.window(self.start, self.duration)
        late = max(1, round(self.delay / setup.sample_time))
        return _Run(active, f"commands arrive {late * setup.sample_time:g} s late", late)


class _Run(FaultRun):
    def __init__(self, active: range, words: str, late: int) -> None:
        super().__init__(active, words)
        self._past_commands: deque[FloatArray] = deque(maxlen=late + 1)

    def commanded(self, sample: int, u: FloatArray) -> None:
        self._past_commands.append(u.copy())
        if sample in self.active:
            u[:] = self._past_commands[0]
