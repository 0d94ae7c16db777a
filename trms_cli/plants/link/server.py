"""Serves a rig in real time: datagrams or a pseudo-terminal, with what a wire does to frames."""

from __future__ import annotations

import contextlib
import os
import select
import socket
from collections.abc import Callable
from typing import Protocol

import numpy as np

from trms_cli.core.errors import ConfigurationError
from trms_cli.plants.link.nuisances import LossyWire, WireNuisances
from trms_cli.plants.link.transport import StreamTransport
from trms_cli.simulation.pace import WallClock


class RigPort(Protocol):
    """The rig's end of a wire."""

    address: str  #: What the computer calls the rig by, as overrides of ``trms run``

    def receive(self, timeout: float) -> bytes | None:
        """The next frame, or None where none came within ``timeout`` (s)."""

    def send(self, data: bytes) -> None:
        """Answer whoever spoke last."""

    def close(self) -> None:
        """Let go of the wire."""


class UdpListener:
    """Datagrams on a port.

    Raises ConfigurationError for a port that somebody else has.
    """

    def __init__(self, host: str, port: int) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind((host, port))
        except OSError as error:
            self._socket.close()
            raise ConfigurationError(
                f"{host}:{port} cannot be listened on: {error.strerror or error}",
                where="port",
                remedy="another port=…; 0 takes a free one",
            ) from None
        self._socket.setblocking(False)
        self._peer: tuple[str, int] | None = None
        host, port = self._socket.getsockname()[:2]
        self.address = f"plant=udp plant.host={host} plant.port={port}"

    def receive(self, timeout: float) -> bytes | None:
        """The next datagram, or None where none came within ``timeout`` (s)."""
        if not select.select([self._socket], [], [], max(timeout, 0.0))[0]:
            return None
        try:
            data, self._peer = self._socket.recvfrom(2048)
        except OSError:
            return None
        return data

    def send(self, data: bytes) -> None:
        """Answer whoever spoke last."""
        if self._peer is not None:
            with contextlib.suppress(OSError):
                self._socket.sendto(data, self._peer)

    def close(self) -> None:
        """Let go of the port."""
        self._socket.close()


class PseudoTerminal:
    """A serial line that is none: its other end has a name like one.

    Raises ConfigurationError on a system that has no pseudo-terminals.
    """

    def __init__(self) -> None:
        try:
            import pty
            import tty
        except ImportError:
            raise ConfigurationError(
                "this system has no pseudo-terminals", where="serial", remedy="serial=false"
            ) from None
        master, self._other = pty.openpty()
        tty.setraw(self._other)
        os.set_blocking(master, False)
        self._line = StreamTransport(master)
        self.address = f"plant=serial plant.port={os.ttyname(self._other)}"

    def receive(self, timeout: float) -> bytes | None:
        """The next frame, or None where none came within ``timeout`` (s)."""
        return self._line.receive(timeout)

    def send(self, data: bytes) -> None:
        """Answer."""
        self._line.send(data)

    def close(self) -> None:
        """Let go of both ends."""
        self._line.close()
        os.close(self._other)


class AnsweringRig(Protocol):
    """What is served; a :class:`trms_cli.plants.link.served_rig.ServedRig`."""

    @property
    def time(self) -> float:
        """Up to which the rig has moved, s."""

    def advance_to(self, now: float) -> None:
        """Let the rig move up to a time (s)."""

    def answer(self, data: bytes, now: float) -> bytes | None:
        """What is answered to a frame at a time (s)."""


#: s that a rig may be behind the clock. One that takes longer to simulate than to live stands still
#: for the rest: to catch up it would answer ever later, and in the end nobody.
_BEHIND = 0.05


class RigServer:
    """A rig, its listener, and the wire between them."""

    def __init__(
        self, rig: AnsweringRig, listener: RigPort, nuisances: WireNuisances, seed: int
    ) -> None:
        self._rig, self._listener = rig, listener
        streams = np.random.SeedSequence([seed, 0x57495245]).spawn(2)
        self._there, self._back = (LossyWire(nuisances, np.random.default_rng(s)) for s in streams)
        self.stood_still = 0.0  #: s for which the rig did not move, since the machine is too slow

    def serve(self, duration: float, step_time: float, is_over: Callable[[], bool]) -> None:
        """Move and answer for a time (s), by the machine's clock."""
        clock, rig = WallClock(), self._rig
        begin = start = clock.now()
        while not is_over():
            now = clock.now() - start
            if clock.now() - begin >= duration:
                return
            due = min(rig.time + step_time, self._there.next_arrival, self._back.next_arrival)
            data = self._listener.receive(max(due - now, 0.0))
            now = clock.now() - start
            too_late = now - rig.time - step_time - _BEHIND
            if too_late > 0.0:
                start, now = start + too_late, now - too_late
                self.stood_still += too_late
            if data is not None:
                self._there.put(data, now)
            # one step, and whoever asked meanwhile is answered before the next
            rig.advance_to(min(now, rig.time + step_time))
            while (frame := self._there.take(now)) is not None:
                reply = rig.answer(frame, now)
                if reply is not None:
                    self._back.put(reply, now)
            while (frame := self._back.take(now)) is not None:
                self._listener.send(frame)
