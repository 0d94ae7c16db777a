"""Who watches a fit: a bar, the state to go on from, and the way to stop it."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Mapping
from pathlib import Path
from time import perf_counter
from types import FrameType, TracebackType
from typing import Any, Self

from trms_cli.core.errors import (
    EXIT_INTERRUPTED,
    EXIT_TERMINATED,
    ConfigurationError,
    Terminated,
)

#: In the fit's folder: what its method has kept to go on from.
STATE_NAME = "fit-state.json"


class FitProgress:
    """Progress of a fit; see :class:`trms_cli.identification.method.Progress`.

    Within its ``with`` block the first Ctrl-C or SIGTERM asks the method to stop at the best so
    far, the second one interrupts it where it stands.

    Parameters
    ----------
    file : Path
        Where the state is kept.
    resume : bool
        Whether to go on from it.
    quiet : bool
        No bar, as in a sweep.
    """

    #: A fit that ends before this needs no bar (s).
    _PATIENCE = 0.5
    #: s between two writes of the state.
    _PAUSE = 0.5
    _SIGNALS = (signal.SIGINT, signal.SIGTERM)

    def __init__(self, file: Path, *, resume: bool = False, quiet: bool = False) -> None:
        self._file, self._resume = file, resume
        self._visible = sys.stderr.isatty() and not quiet
        self._begin = perf_counter()
        self._state: Mapping[str, Any] | None = None
        self._written = 0.0
        self._bar: Any = None
        self._task: Any = None
        self._before: dict[int, Any] = {}
        self.exit_code: int | None = None  #: once somebody asked to stop

    def __enter__(self) -> Self:
        self._begin = perf_counter()
        if threading.current_thread() is threading.main_thread():
            for number in self._SIGNALS:
                self._before[number] = signal.signal(number, self._on_signal)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        if self._bar is not None:
            self._bar.stop()
            self._bar = None
        self._write()

    def update(self, fraction: float, cost: float, message: str) -> bool:
        """Show; False once somebody asked to stop."""
        spent = perf_counter() - self._begin
        if self._visible and spent >= self._PATIENCE:
            if self._bar is None:
                self._bar, self._task = _bar()
                self._bar.start()
            self._bar.update(self._task, completed=fraction, cost=f"cost {cost:.6g}", what=message)
        return self.exit_code is None

    def save(self, state: Mapping[str, Any]) -> None:
        """Keep a state; it is on the disk a moment later."""
        self._state = state
        if perf_counter() - self._written > self._PAUSE:
            self._write()

    def saved(self) -> Mapping[str, Any] | None:
        """The state of the fit that is to go on."""
        if not self._resume:
            return None
        import msgspec

        try:
            state: dict[str, Any] = msgspec.json.decode(self._file.read_bytes(), type=dict)
        except FileNotFoundError:
            return None
        except (OSError, msgspec.MsgspecError) as error:
            raise ConfigurationError(
                f"cannot be read: {error}", where=str(self._file), remedy="fit anew"
            ) from error
        return state

    def _write(self) -> None:
        """Whole or not at all; a disk that is full costs the resumption, not the fit."""
        if self._state is None:
            return
        import msgspec

        # One name, so that what an interruption leaves of it is written over by the next.
        draft = self._file.with_name(f".{self._file.name}")
        try:
            draft.write_bytes(msgspec.json.encode(self._state))
            os.replace(draft, self._file)
        except OSError as error:
            draft.unlink(missing_ok=True)
            sys.stderr.write(f"note   the state of the fit cannot be kept: {error}\n")
        self._state, self._written = None, perf_counter()

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        terminated = number == signal.SIGTERM
        if self.exit_code is not None:
            raise Terminated if terminated else KeyboardInterrupt
        self.exit_code = EXIT_TERMINATED if terminated else EXIT_INTERRUPTED
        words = "stopping at the best so far (once more: at once)"
        if self._bar is not None:
            self._bar.console.print(words)
        else:
            # Not sys.stderr: a signal may come while it is being written to.
            os.write(2, f"\n{words}\n".encode())


def _bar() -> tuple[Any, Any]:
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    bar = Progress(
        TextColumn("{task.percentage:>3.0f} %"),
        BarColumn(bar_width=20),
        TextColumn("{task.fields[cost]}"),
        TextColumn("{task.fields[what]}"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(compact=True),
        console=Console(file=sys.stderr, force_jupyter=False),
        transient=True,
    )
    return bar, bar.add_task("", total=1.0, cost="", what="")
