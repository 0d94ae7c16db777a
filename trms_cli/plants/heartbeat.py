"""An emergency stop over the network: datagrams that must not stop."""

from __future__ import annotations

import socket
import time
from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from trms_cli.core.errors import ConfigurationError
from trms_cli.core.ranges import Positive


@dataclass(frozen=True, kw_only=True)
class Heartbeat:
    """Where datagrams of any content are waited for, and how long."""

    port: Annotated[int, Meta(ge=0, le=65535)] | None = None  #: None: nobody sends any
    host: str = "127.0.0.1"  #: Address to listen on; 0.0.0.0 for all of this machine
    timeout: Positive = 0.5  #: s without one, after which the rig is landed

    def init(self) -> HeartbeatMonitor | None:
        """Listens from now on; None where nobody sends.

        Raises ConfigurationError for a port that somebody else has.
        """
        return None if self.port is None else HeartbeatMonitor(self)


class HeartbeatMonitor:
    """A heartbeat during one run."""

    def __init__(self, heartbeat: Heartbeat) -> None:
        self._timeout = heartbeat.timeout
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind((heartbeat.host, heartbeat.port))
        except OSError as error:
            self._socket.close()
            raise ConfigurationError(
                f"{heartbeat.host}:{heartbeat.port} cannot be listened on: "
                f"{error.strerror or error}",
                where="plant.envelope.heartbeat",
                remedy="another port, an address of this machine",
            ) from None
        self._socket.setblocking(False)
        self.port = int(self._socket.getsockname()[1])
        self._last = -1e9

    def wait(self) -> None:
        """Wait for the first one.

        Raises ConfigurationError where none comes in time.
        """
        end = time.perf_counter() + 2 * self._timeout
        while time.perf_counter() < end:
            if not self.silence():
                return
            time.sleep(0.01)
        raise ConfigurationError(
            f"no heartbeat on port {self.port} within {2 * self._timeout:g} s",
            where="plant.envelope.heartbeat.port",
            remedy="start what sends it; plant.envelope.heartbeat.port=null does without",
        )

    def silence(self) -> float:
        """For how long none has come, s, if that is too long; else 0."""
        now = time.perf_counter()
        while True:
            try:
                self._socket.recv(64)
            except OSError:  # nothing left to read
                break
            self._last = now
        silence = now - self._last
        return silence if silence > self._timeout else 0.0

    def close(self) -> None:
        """Let go of the port."""
        self._socket.close()
