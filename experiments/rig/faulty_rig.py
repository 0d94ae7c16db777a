"""The rig's side of a wire, with faults of its own, and what was in force on it."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from trms_cli.models.newtonian import Newtonian
from trms_cli.plants.link.frames import BadFrame, Kind, RigStatus, decode, is_newer
from trms_cli.plants.link.served_rig import ServedRig
from trms_cli.plants.plant import PlantSetup
from trms_cli.plants.simulated import SimulatedRig

#: s; steps of the simulated rig. Coarse: it is the wire that is looked at.
STEP = 0.01
#: s, after which a silent rig has to be at rest whatever its computer does.
WATCHDOG = 0.1


@dataclass(frozen=True, kw_only=True)
class RigFaults:
    """What goes wrong on the rig's side."""

    garbage: float = 0.0  #: Share of the answers in whose place come bytes that are no frame
    strange: float = 0.0  #: Share of the readings with a number that is infinite, none, or far off
    reset_at: float | None = None  #: s, when the rig's computer starts anew


@dataclass
class FaultyRig:
    """A served rig, with the interface of :class:`trms_cli.plants.link.served_rig.ServedRig`."""

    faults: RigFaults
    seed: int
    duration: float  #: s, for which the rig can move
    #: Commands in force, (time, command), at every change; s, V
    applied: list[tuple[float, list[float]]] = field(default_factory=list)
    old_commands: int = 0  #: That were applied after newer ones

    def __post_init__(self) -> None:
        self._generator = np.random.default_rng([self.seed, 0x524947])
        rig = SimulatedRig(model=Newtonian())
        self._run = rig.init(PlantSetup(STEP, round(self.duration / STEP) + 2, self.seed))
        self._reset_at = self.faults.reset_at
        self._rig = self._started(0.0)

    def _started(self, now: float) -> ServedRig:
        rig = ServedRig(self._run, STEP, WATCHDOG, np.zeros(2), lambda time, words: None)
        self.applied.append((now, rig.command.tolist()))
        return rig

    @property
    def time(self) -> float:
        """Up to which the rig has moved, s."""
        return self._rig.time

    def advance_to(self, now: float) -> None:
        """Let the rig move up to a time (s)."""
        if self._reset_at is not None and now >= self._reset_at:
            self._reset_at, time = None, self._rig.time
            self._rig = self._started(now)
            self._rig.begin_at(time)
        self._rig.advance_to(now)
        self._note(now)

    def answer(self, data: bytes, now: float) -> bytes | None:
        """What is answered to a frame at a time (s), perhaps spoilt."""
        before = self._rig.sequence, self._rig.commands
        reply = self._rig.answer(data, now)
        if self._rig.commands > before[1] and not is_newer(self._rig.sequence, before[0]):
            self.old_commands += 1
        self._note(now)
        return None if reply is None else self._spoilt(reply)

    def _note(self, now: float) -> None:
        command = self._rig.command.tolist()
        if command != self.applied[-1][1]:
            self.applied.append((now, command))

    def _spoilt(self, data: bytes) -> bytes:
        draw = self._generator.random
        if self.faults.garbage and draw() < self.faults.garbage:
            return self._generator.bytes(int(draw() * 80))
        if self.faults.strange and draw() < self.faults.strange:
            with contextlib.suppress(BadFrame):
                frame = decode(data)
                if frame.kind == Kind.READING:
                    numbers = list(frame.numbers)
                    values = (np.inf, -np.inf, np.nan, 1e30, 40.0)
                    numbers[int(draw() * 4)] = values[int(draw() * len(values))]
                    return replace(frame, numbers=tuple(numbers)).encode()
        return data

    def summary(self) -> Mapping[str, Any]:
        """What has to be looked at once all is over."""
        return {
            "applied": self.applied,
            "old_commands": self.old_commands,
            "safe": not self._rig.status & RigStatus.ARMED and not self._rig.command.any(),
            "command": self._rig.command.tolist(),
        }
