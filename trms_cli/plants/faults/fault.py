"""What a fault is: for a time, it stands between the rig and what is read of it or sent to it.

An effect (:mod:`trms_cli.effects`) belongs to the rig's physics and lasts; a fault begins, ends,
and is in the wiring. Faults act in the order in which they are given.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Protocol

from msgspec import Meta

from trms_cli.core.arrays import FloatArray
from trms_cli.core.plugins import require_known

Share = Annotated[float, Meta(gt=0, le=1)]


@dataclass(frozen=True)
class FaultSetup:
    """What a fault is told before a run."""

    sample_time: float  #: s
    samples: int  #: Of the run
    outputs: tuple[str, ...]  #: Measured channels, the order of y
    inputs: tuple[str, ...]  #: The order of u
    seed: tuple[int, ...]  #: Of what is random in it

    def window(self, start: float, duration: float | None) -> range:
        """Samples from ``start`` for ``duration`` seconds, to the end for None."""
        first = math.ceil(start / self.sample_time - 1e-9)
        last = self.samples if duration is None else first + round(duration / self.sample_time)
        return range(min(first, self.samples), min(last, self.samples))

    def output(self, channel: str, where: str = "channel") -> int:
        """Position of a measured channel.

        Raises ConfigurationError if it is not measured.
        """
        return _position(channel, self.outputs, "the rig measures no", where)

    def input(self, name: str, where: str = "input") -> int:
        """Position of an input.

        Raises ConfigurationError if there is none of that name.
        """
        return _position(name, self.inputs, "the rig has no input", where)


class FaultRun:
    """A fault during one run; what it leaves alone passes through.

    ``active``: samples during which it acts. ``words``: what it does, for the log.
    """

    def __init__(self, active: range, words: str) -> None:
        self.active = active
        self.words = words

    def sensed(self, sample: int, y: FloatArray) -> None:
        """Alter what is read at a sample, in place. Called at every sample."""

    def commanded(self, sample: int, u: FloatArray) -> None:
        """Alter what reaches the rig from a sample on, in place. Called at every sample."""


class ShiftedReading(FaultRun):
    """A channel is off while the fault acts: at each sample of the run by so much."""

    def __init__(self, active: range, words: str, column: int, off: FloatArray) -> None:
        super().__init__(active, words)
        self._column, self._off = column, off

    def sensed(self, sample: int, y: FloatArray) -> None:
        if sample in self.active:
            y[self._column] += self._off[sample]


class Fault(Protocol):
    """An immutable configuration of a fault."""

    def init(self, setup: FaultSetup) -> FaultRun:
        """The fault at the beginning of a run."""


def _position(name: str, valid_names: Sequence[str], words: str, where: str) -> int:
    require_known(name, valid_names, f"{words} {name!r}", where)
    return list(valid_names).index(name)
