"""A rig at the other end of a wire, both in virtual time: hours of a link in seconds.

The computer's side is the product's own (:mod:`trms_cli.plants.link.linked_rig`), the rig's side
that of ``trms rig serve``, the wire that of its nuisances; only the clock is another.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from experiments.rig.faulty_rig import FaultyRig
from trms_cli.plants.link.linked_rig import LinkedRig, LinkedRun
from trms_cli.plants.link.nuisances import LossyWire, WireNuisances
from trms_cli.plants.link.transport import Transport
from trms_cli.plants.plant import PlantSetup
from trms_cli.simulation.pace import VirtualClock


@dataclass
class VirtualLink:
    """The wire, as the computer's transport, and the rig behind it."""

    nuisances: WireNuisances
    rig: FaultyRig
    seed: int
    clock: VirtualClock = field(default_factory=VirtualClock)
    dead_at: float | None = None  #: s, when the program is killed: nothing of it gets through then
    closed: int = 0  #: How often the wire was let go of

    def __post_init__(self) -> None:
        streams = np.random.SeedSequence([self.seed, 0x57495245]).spawn(2)
        self._there, self._back = (
            LossyWire(self.nuisances, np.random.default_rng(stream)) for stream in streams
        )

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
            if frame is not None or self.clock.now() >= end:
                return frame
            self.clock.sleep_until(min(self._there.next_arrival, self._back.next_arrival, end))

    def close(self) -> None:
        """The computer lets go of the wire."""
        self.closed += 1

    def move(self) -> None:
        """Let the rig move up to now, and answer what has arrived."""
        now = self.clock.now()
        while (frame := self._there.take(now)) is not None:
            self.rig.advance_to(now)
            reply = self.rig.answer(frame, now)
            if reply is not None:
                self._back.put(reply, now)
        self.rig.advance_to(now)


@dataclass(frozen=True, kw_only=True)
class VirtualRig(LinkedRig):
    """``plant=udp`` with a virtual wire in place of the socket."""

    link: Any  #: A :class:`VirtualLink`

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
