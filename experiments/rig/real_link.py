"""The same in real time: the rig in a process of its own behind UDP, the program in another.

Both are forked from this one, so that a run takes no longer than its own time, and a program can
be killed as the system does it.
"""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Callable, Mapping
from typing import Any

from experiments.rig.faulty_rig import FaultyRig
from trms_cli.plants.link.nuisances import WireNuisances
from trms_cli.plants.link.server import RigServer, UdpListener


class ServedProcess:
    """A rig that is served in a process of its own, from now until :meth:`end`."""

    def __init__(self, rig: FaultyRig, nuisances: WireNuisances, seed: int, step: float) -> None:
        from_child, to_parent = os.pipe()
        from_parent, self._to_child = os.pipe()
        self._pid = os.fork()
        if self._pid == 0:
            os.close(from_child)
            os.close(self._to_child)
            _serve(rig, nuisances, seed, step, from_parent, to_parent)
        os.close(to_parent)
        os.close(from_parent)
        self._stream = os.fdopen(from_child, encoding="utf-8")
        self.port = int(self._stream.readline())

    def end(self) -> Mapping[str, Any]:
        """Stop it; what has to be looked at of the rig."""
        os.close(self._to_child)
        summary: Mapping[str, Any] = json.loads(self._stream.readline())
        self._stream.close()
        os.waitpid(self._pid, 0)
        return summary


def _serve(
    rig: FaultyRig, nuisances: WireNuisances, seed: int, step: float, watched: int, answer: int
) -> None:
    """What the child does; it does not come back."""
    code = 1
    try:
        os.set_blocking(watched, False)
        listener = UdpListener("127.0.0.1", 0)
        port = listener.address.rpartition("=")[2]
        os.write(answer, f"{port}\n".encode())
        RigServer(rig, listener, nuisances, seed).serve(60.0, step, lambda: _is_closed(watched))
        listener.close()
        _write_all(answer, json.dumps(rig.summary()).encode() + b"\n")
        code = 0
    finally:
        os._exit(code)


def _write_all(descriptor: int, data: bytes) -> None:
    while data:
        data = data[os.write(descriptor, data) :]


def _is_closed(descriptor: int) -> bool:
    try:
        return os.read(descriptor, 1) == b""
    except BlockingIOError:
        return False


def run_in_process(work: Callable[[], None], kill_at: float | None) -> bool:
    """Do it in a process of its own, which is killed after a time (s); whether it ended by itself.

    ``work``: returns or raises; either ends the process.
    """
    pid = os.fork()
    if pid == 0:
        code = 1
        try:
            work()
            code = 0
        finally:
            os._exit(code)
    if kill_at is not None:
        time.sleep(kill_at)
        os.kill(pid, signal.SIGKILL)
    _, status = os.waitpid(pid, 0)
    return os.WIFEXITED(status)
