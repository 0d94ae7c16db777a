"""A rig at the other end of a wire, both in virtual time: hours of a link in seconds.

The computer's side is the product's own (:mod:`trms_cli.plants.link.linked_rig`), the rig's side
that of ``trms rig serve``, the wire that of its nuisances; only the clock is another.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from trms_cli.models.newtonian import Newtonian
from trms_cli.plants.link.frames import BadFrame, Kind, State, decode, is_newer
from trms_cli.plants.link.linked_rig import LinkedRig, LinkedRun
from trms_cli.plants.link.nuisances import Wire, WireNuisances
from trms_cli.plants.link.served_rig import ServedRig
from trms_cli.plants.link.transport import Transport
from trms_cli.plants.plant import PlantSetup
from trms_cli.plants.simulated import SimulatedRig
from trms_cli.simulation.pace import VirtualClock

#: s; steps of the simulated rig. Coarse: it is the wire that is looked at.
STEP = 0.01
#: s, after which a silent rig has to be at rest whatever its computer does.
WATCHDOG = 0.1


@dataclass
class Link:
    """The wire and the rig behind it; what comes over it is kept."""

    nuisances: WireNuisances
    seed: int
    duration: float  #: s, for which the rig can move
    clock: VirtualClock = field(default_factory=VirtualClock)
    garbage: float = 0.0  #: Share of the answers that come with bytes that are no frame before them
    strange: float = 0.0  #: Share of the readings with a number that is infinite or none
    reset_at: float | None = None  #: s, when the rig's computer starts anew
    dead_at: float | None = None  #: s, when the program is killed: nothing of it gets through then
    #: Commands in force at the rig, (time, command), at every change
    applied: list[tuple[float, np.ndarray]] = field(default_factory=list)
    old_commands: int = 0  #: That were applied after newer ones
    closed: int = 0  #: How often the wire was let go of

    def __post_init__(self) -> None:
        streams = np.random.SeedSequence(self.seed).spawn(3)
        first, second, self._generator = (np.random.default_rng(stream) for stream in streams)
        self._there, self._back = Wire(self.nuisances, first), Wire(self.nuisances, second)
        rig = SimulatedRig(model=Newtonian())
        self._run = rig.init(PlantSetup(STEP, round(self.duration / STEP) + 2, self.seed))
        self.rig = self._served()

    def _served(self) -> ServedRig:
        safe = np.zeros(2)
        rig = ServedRig(self._run, STEP, WATCHDOG, safe, lambda time, words: None)
        self.applied.append((self.clock.now(), rig.command.copy()))
        return rig

    def send(self, data: bytes) -> None:
        """The computer lets a frame go."""
        if self.dead_at is None or self.clock.now() < self.dead_at:
            self._there.put(data, self.clock.now())

    def receive(self, timeout: float) -> bytes | None:
        """The next frame that the computer gets within ``timeout`` (s)."""
        end = self.clock.now() + max(timeout, 0.0)
        while True:
            self.move()
            frame = self._back.take(self.clock.now())
            if frame is not None:
                return self._spoilt(frame)
            if self.clock.now() >= end:
                return None
            arrival = min(self._there.next_arrival, self._back.next_arrival, end)
            self.clock.sleep_until(max(arrival, self.clock.now()))

    def close(self) -> None:
        """The computer lets go of the wire."""
        self.closed += 1

    def move(self) -> None:
        """Let the rig move up to now, and answer what has arrived."""
        now = self.clock.now()
        if self.reset_at is not None and now >= self.reset_at:
            self.reset_at = None
            steps = self.rig.time
            self.rig = self._served()
            self.rig.begin_at(steps)
        while (frame := self._there.take(now)) is not None:
            self._advance(now)
            before = self.rig.sequence, self.rig.commands
            reply = self.rig.answer(frame, now)
            if self.rig.commands > before[1] and not is_newer(self.rig.sequence, before[0]):
                self.old_commands += 1
            self._note(now)
            if reply is not None:
                self._back.put(reply, now)
        self._advance(now)

    def _advance(self, now: float) -> None:
        self.rig.advance_to(now)
        self._note(now)

    def _note(self, now: float) -> None:
        if not np.array_equal(self.rig.command, self.applied[-1][1]):
            self.applied.append((now, self.rig.command.copy()))

    def _spoilt(self, data: bytes) -> bytes:
        draw = self._generator.random
        if self.garbage and draw() < self.garbage:
            return self._generator.bytes(int(draw() * 80))
        if self.strange and draw() < self.strange:
            with contextlib.suppress(BadFrame):  # spoilt on the way already
                frame = decode(data)
                if frame.kind == Kind.READING:
                    numbers = list(frame.numbers)
                    values = (np.inf, -np.inf, np.nan, 1e30, 40.0)
                    numbers[int(draw() * 4)] = values[int(draw() * len(values))]
                    return replace(frame, numbers=tuple(numbers)).encode()
        return data

    @property
    def is_safe(self) -> bool:
        """Whether the safe command is in force and no other would be taken."""
        return not self.rig.status & State.ARMED and not self.rig.command.any()


@dataclass(frozen=True, kw_only=True)
class VirtualRig(LinkedRig):
    """``plant=udp`` with a virtual wire in place of the socket."""

    link: Any  #: A :class:`Link`

    def init(self, setup: PlantSetup) -> VirtualRun:
        """The rig before it is connected."""
        return VirtualRun(self, setup)


class VirtualRun(LinkedRun):
    """See :class:`trms_cli.plants.link.linked_rig.LinkedRun`."""

    rig: VirtualRig

    def _open(self) -> Transport:
        link: Transport = self.rig.link
        return link

    def _address(self) -> tuple[str, str]:
        return "the virtual rig", "plant.link"

    def _now(self) -> float:
        return float(self.rig.link.clock.now())

    def _pause(self, duration: float) -> None:
        clock = self.rig.link.clock
        clock.sleep_until(clock.now() + duration)
