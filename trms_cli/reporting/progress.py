"""What is being done: a line or a bar on standard error, and the way to stop and to go on."""

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from time import perf_counter
from types import FrameType, MappingProxyType
from typing import Any, Self

from trms_cli.core.errors import EXIT_INTERRUPTED, EXIT_TERMINATED, ConfigurationError, Termination
from trms_cli.core.invocation import note

#: In the fit's folder: what its method has kept to go on from.
STATE_NAME = "fit-state.json"
#: In the folder of a diagnosis: the stages that are finished, and what was done when.
STAGES_NAME, LOG_NAME = "diagnose-state.json", "log.txt"


@contextmanager
def termination() -> Iterator[None]:
    """SIGTERM ends what runs inside as Ctrl-C does, where it runs in the main thread."""
    if threading.current_thread() is not threading.main_thread():
        yield  # signals are the main thread's
        return

    def terminate(*_: Any) -> None:
        raise Termination

    before = signal.signal(signal.SIGTERM, terminate)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


class ProgressLine:
    """A line that is written over, and gone at the end of its ``with`` block."""

    _PATIENCE = 0.5  # s, before progress is worth a line

    def __init__(self, *, quiet: bool = False) -> None:
        self._visible = sys.stderr.isatty() and not quiet
        self._begin = perf_counter()
        self._width = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._width:
            sys.stderr.write("\r" + " " * self._width + "\r")

    def tell(self, doing: str) -> None:
        """What is being done."""
        if not self._visible or perf_counter() - self._begin < self._PATIENCE:
            return
        sys.stderr.write("\r" + doing.ljust(self._width))
        sys.stderr.flush()
        self._width = max(self._width, len(doing))


class _Bar:
    """A bar on standard error with some words behind it, once it is worth one.

    `columns`: the words' names, and their styles. `head`: what stands before the bar.
    """

    _PATIENCE = 0.5  # s; what ends before needs no bar

    def __init__(
        self,
        columns: Mapping[str, str],
        head: str = "{task.percentage:>3.0f} %",
        total: float = 1.0,
        *,
        elapsed: bool = True,
    ) -> None:
        self._columns, self._head, self._total, self._elapsed = columns, head, total, elapsed
        self.begin = perf_counter()
        self._bar: Any = None
        self._task: Any = None

    def show(self, completed: float, **fields: str) -> None:
        if perf_counter() - self.begin < self._PATIENCE:
            return
        if self._bar is None:
            self._bar = self._make()
            blank: dict[str, Any] = dict.fromkeys(self._columns, "")
            self._task = self._bar.add_task("", total=self._total, **blank)
            self._bar.start()
        self._bar.update(self._task, completed=completed, **fields)

    def say(self, words: str) -> bool:
        """Words over the bar; False where there is none."""
        if self._bar is not None:
            self._bar.console.print(words)
        return self._bar is not None

    def stop(self) -> None:
        if self._bar is not None:
            self._bar.stop()
            self._bar = None

    def _make(self) -> Any:
        from rich import progress
        from rich.console import Console

        words = [
            progress.TextColumn(f"{{task.fields[{name}]}}", style=style)
            for name, style in self._columns.items()
        ]
        return progress.Progress(
            progress.TextColumn(self._head),
            progress.BarColumn(bar_width=20),
            *words,
            *((progress.TimeElapsedColumn(), progress.TextColumn("left")) if self._elapsed else ()),
            progress.TimeRemainingColumn(compact=True),
            console=Console(file=sys.stderr, force_jupyter=False),
            transient=True,
        )


class FitProgress:
    """Progress of a fit; see :class:`trms_cli.identification.problem.Progress`.

    Within its ``with`` block the first Ctrl-C or SIGTERM asks the method to stop at the best so
    far, the second one interrupts it where it stands.

    ``file``: where the state is kept, to go on from with ``resume``. ``quiet``: no bar, as in a
    sweep.
    """

    #: s between two writes of the state.
    _PAUSE = 0.5
    _SIGNALS = (signal.SIGINT, signal.SIGTERM)
    _STOPPING = "stopping at the best so far (once more: at once)"
    #: Columns of the bar, and their style.
    _COLUMNS: Mapping[str, str] = MappingProxyType({"cost": "", "what": ""})

    def __init__(self, file: Path, *, resume: bool = False, quiet: bool = False) -> None:
        self._file, self._resume = file, resume
        self._visible = sys.stderr.isatty() and not quiet
        self._bar = _Bar(self._COLUMNS)
        self._state: Mapping[str, Any] | None = None
        self._write_time = 0.0
        self._before: dict[int, Any] = {}
        self.exit_code: int | None = None  #: once somebody asked to stop

    def __enter__(self) -> Self:
        self._bar.begin = perf_counter()
        if threading.current_thread() is threading.main_thread():
            for number in self._SIGNALS:
                self._before[number] = signal.signal(number, self._on_signal)
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._bar.stop()
        self._write()

    def update(self, fraction: float, cost: float, message: str) -> bool:
        """Show; False once somebody asked to stop."""
        self._show(fraction, cost=f"cost {cost:.6g}", what=message)
        return self.exit_code is None

    def _show(self, fraction: float, **fields: str) -> None:
        if self._visible:
            self._bar.show(fraction, **fields)

    def save(self, state: Mapping[str, Any]) -> None:
        """Keep a state; it is on the disk a moment later."""
        self._state = state
        if perf_counter() - self._write_time > self._PAUSE:
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
            note(f"note   the state of the fit cannot be kept: {error}")
        self._state, self._write_time = None, perf_counter()

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        terminated = number == signal.SIGTERM
        if self.exit_code is not None:
            raise Termination if terminated else KeyboardInterrupt
        self.exit_code = EXIT_TERMINATED if terminated else EXIT_INTERRUPTED
        if not self._bar.say(self._STOPPING):
            # Not sys.stderr: a signal may come while it is being written to.
            os.write(2, f"\n{self._STOPPING}\n".encode())


class DiagnoseProgress(FitProgress):
    """Progress of a diagnosis; see :class:`trms_cli.identification.problem.Progress`.

    A message is the name of a stage, and after a colon what is done in it. Within the ``with``
    block the first Ctrl-C or SIGTERM asks to stop at the next step, the second one interrupts where
    it stands; finished stages stay on the disk either way.

    ``log``: gets a line a stage. ``fingerprint``: of the problem, so that a state is only gone on
    with for the same one.
    """

    _STOPPING = "stopping; finished fits are kept (once more: at once)"
    _COLUMNS = MappingProxyType({"stage": "bold", "step": "dim"})

    def __init__(
        self, file: Path, log: Path, fingerprint: str, *, resume: bool = False, quiet: bool = False
    ) -> None:
        super().__init__(file, resume=resume, quiet=quiet)
        self._log, self._fingerprint, self._stage = log, fingerprint, ""

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        super().__exit__(kind, error, trace)
        if error is not None:
            self.note(f"ended by {type(error).__name__}" + (f": {error}" if str(error) else ""))

    def update(self, fraction: float, cost: float, message: str) -> bool:
        """Show; False once somebody asked to stop."""
        stage, _, step = message.partition(":")
        if stage != self._stage:
            self._stage = stage
            self.note(stage)
        self._show(fraction, stage=stage, step=step.strip())
        return self.exit_code is None

    def save(self, state: Mapping[str, Any]) -> None:
        """Keep the finished stages; they are on the disk a moment later."""
        super().save({"problem": self._fingerprint, "stages": state})

    def saved(self) -> Mapping[str, Any] | None:
        """The finished stages of the diagnosis that is to go on."""
        content = super().saved()
        if content is None:
            return None
        if content.get("problem") != self._fingerprint:
            raise ConfigurationError(
                "what is diagnosed has changed since: a recording, the model or the candidates",
                where=str(self._file),
                remedy="diagnose anew into another folder",
            )
        stages: Mapping[str, Any] = content["stages"]
        return stages

    def finish(self, text: str) -> None:
        """A last line in the log; a finished diagnosis has nothing to go on with."""
        self.note(text)
        self._file.unlink(missing_ok=True)

    def note(self, text: str) -> None:
        """A line in the log; a disk that is full costs the line, not the diagnosis."""
        try:
            with self._log.open("a", encoding="utf-8") as log:
                log.write(f"{perf_counter() - self._bar.begin:8.1f} s  {text}\n")
        except OSError:
            pass


class ReadingProgress(ProgressLine):
    """Tells how many logs are left to be read, on a terminal and when it takes a while."""

    def __call__(self, count: int, of: int) -> None:
        """Say that `count` logs of `of` have been read."""
        self.tell(f"reading logs: {count} of {of}")


class LoopBar:
    """A bar on standard error for a loop of so many seconds, which one that ends at once lacks."""

    def __init__(self, duration: float) -> None:
        head = "{task.completed:.0f} / {task.total:g} s"
        self._bar = _Bar({"speed": "", "error": ""}, head, duration, elapsed=False)

    def __enter__(self) -> Callable[[float, float], None]:
        self._bar.begin = perf_counter()
        return self._tell

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def _tell(self, time: float, error: float) -> None:
        """Simulated time (s) and the largest present tracking error (rad)."""
        speed = f"{time / max(perf_counter() - self._bar.begin, 1e-9):.0f}× real time"
        self._bar.show(time, speed=speed, error=f"error {error:.3f} rad")
