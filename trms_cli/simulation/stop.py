"""Ctrl-C and SIGTERM as something that the loop reads once a sample, and no library can swallow.

A solver in C++ may catch an exception that a signal raised in one of its callbacks, and go on. A
flag stays. The first signal asks the loop to land the rig, the second one to stop at once: that one
is raised where the program stands, and should it be swallowed there, the flag is still read at the
next sample.
"""

from __future__ import annotations

import os
import signal
import threading
from types import FrameType
from typing import Any, Self

from trms_cli.core.errors import Termination


class StopRequest:
    """Whether somebody wants the loop to stop; within its ``with`` block signals ask for it.

    Signals that the process ignores, and those of threads other than the main one, are left alone.
    ``words``: told on standard error when the first signal comes; empty for nothing.
    """

    _SIGNALS = (signal.SIGINT, signal.SIGTERM)

    def __init__(self, words: str = "") -> None:
        self.requests = 0  #: How often it was asked for
        self.terminated = False  #: Whether by SIGTERM
        self._words = words
        self._before: dict[int, Any] = {}

    def request(self) -> None:
        """Ask for a landing; once more: for an end at once."""
        self.requests += 1

    @property
    def at_once(self) -> bool:
        """Whether not even a ramp is to be waited for."""
        return self.requests > 1

    def error(self) -> KeyboardInterrupt:
        """What tells the caller that it was a signal that ended the loop."""
        return Termination() if self.terminated else KeyboardInterrupt()

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            for number in self._SIGNALS:
                before = signal.getsignal(number)
                if before is not signal.SIG_IGN:
                    self._before[number] = before
                    signal.signal(number, self._on_signal)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler if handler is not None else signal.SIG_DFL)
        self._before.clear()

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self.request()
        self.terminated |= number == signal.SIGTERM
        if self.at_once:
            raise self.error()
        if self._words:  # not sys.stderr: a signal may come while it is being written to
            os.write(2, f"\n{self._words}\n".encode())
