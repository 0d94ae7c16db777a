"""What carries frames: datagrams, or a serial line."""

from __future__ import annotations

import contextlib
import os
import select
import socket
import time
from collections import deque
from typing import Any, Protocol

from trms_cli.core.errors import ConfigurationError
from trms_cli.plants.link.frames import FrameStream

_LONGEST_DATAGRAM = 2048


class Transport(Protocol):
    """Carries encoded frames to the other side and back. What is lost on the way is lost."""

    def send(self, data: bytes) -> None:
        """Let a frame go; never waits."""

    def receive(self, timeout: float) -> bytes | None:
        """The next frame, or None where none came within ``timeout`` (s)."""

    def close(self) -> None:
        """Let go of the port."""


class UdpTransport:
    """Datagrams to one peer.

    Raises ConfigurationError for an address that does not exist.
    """

    def __init__(self, host: str, port: int, where: str = "plant") -> None:
        try:
            family, kind, protocol, _, address = socket.getaddrinfo(
                host, port, type=socket.SOCK_DGRAM
            )[0]
        except OSError as error:
            raise ConfigurationError(
                f"{host!r}: {error.strerror or error}",
                where=f"{where}.host",
                remedy="a name or address of the rig's computer: 192.168.0.10, 127.0.0.1",
            ) from None
        self._socket = socket.socket(family, kind, protocol)
        self._socket.connect(address)
        self._socket.setblocking(False)

    def send(self, data: bytes) -> None:
        """Let a frame go; a peer that is not there is known by its silence."""
        with contextlib.suppress(OSError):
            self._socket.send(data)

    def receive(self, timeout: float) -> bytes | None:
        """The next datagram, or None where none came within ``timeout`` (s)."""
        if not select.select([self._socket], [], [], max(timeout, 0.0))[0]:
            return None
        try:
            return self._socket.recv(_LONGEST_DATAGRAM)
        except OSError:  # nobody listens there (refused), which may change
            return None

    def close(self) -> None:
        """Let go of the port."""
        self._socket.close()


class StreamTransport:
    """Frames over a file descriptor that carries bytes: a serial line, a pseudo-terminal.

    ``descriptor``: open and not blocking. ``owner``: closed in its place, where it has one.
    """

    def __init__(self, descriptor: int, owner: Any = None) -> None:
        self._descriptor, self._owner = descriptor, owner
        self._stream = FrameStream()
        self._frames: deque[bytes] = deque()

    def send(self, data: bytes) -> None:
        """Let a frame go; what the line cannot take now is lost."""
        with contextlib.suppress(OSError):
            os.write(self._descriptor, data)

    def receive(self, timeout: float) -> bytes | None:
        """The next whole frame, or None where none came within ``timeout`` (s)."""
        end = time.perf_counter() + timeout
        while not self._frames:
            left = max(end - time.perf_counter(), 0.0)
            if not select.select([self._descriptor], [], [], left)[0]:
                return None
            try:
                data = os.read(self._descriptor, 4096)
            except OSError:  # a cable that was pulled
                time.sleep(min(left, 1e-3))
                data = b""
            self._frames.extend(self._stream.feed(data))
            if not self._frames and time.perf_counter() >= end:
                return None
        return self._frames.popleft()

    def close(self) -> None:
        """Let go of the line."""
        if self._owner is not None:
            self._owner.close()
        else:
            os.close(self._descriptor)


def open_serial(port: str, baudrate: int, where: str = "plant") -> StreamTransport:
    """A serial line by its name: ``/dev/ttyACM0``, ``COM3``.

    Raises ConfigurationError for a port that is not there or that somebody else has.
    """
    if os.name != "posix":
        raise ConfigurationError(
            "serial lines are waited for as POSIX has it, and this system is none",
            where=f"{where}.port",
            remedy="plant=udp, or plant=callable with pyserial in your own functions",
        )

    import serial
    from serial.tools import list_ports

    try:
        line = serial.Serial(port, baudrate, timeout=0, write_timeout=0, exclusive=True)
    except (OSError, ValueError) as error:  # SerialException is an OSError
        names = ", ".join(p.device for p in list_ports.comports()) or "none"
        raise ConfigurationError(
            f"{port!r} cannot be opened: {error}",
            where=f"{where}.port",
            remedy=f"ports of this machine: {names}; is another program using it?",
        ) from None
    return StreamTransport(line.fileno(), line)
