"""Who watches a diagnosis: a line with the stage, the state to go on from, and the log."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Mapping
from pathlib import Path
from time import perf_counter
from types import FrameType, TracebackType
from typing import Any, Self

from trms_cli.commands.identify_progress import FitProgress
from trms_cli.core.errors import (
    EXIT_INTERRUPTED,
    EXIT_TERMINATED,
    ConfigurationError,
    Terminated,
)

#: In the folder of a diagnosis: the stages that are finished, and what was done when.
STATE_NAME, LOG_NAME = "diagnose-state.json", "log.txt"


class DiagnoseProgress(FitProgress):
    """Progress of a diagnosis; see :class:`trms_cli.identification.method.Progress`.

    A message is the name of a stage, and after a colon what is done in it. Within the ``with``
    block the first Ctrl-C or SIGTERM asks to stop at the next step, the second one interrupts
    where it stands; finished stages stay on the disk either way.

    Parameters
    ----------
    file : Path
        Where the state is kept.
    log : Path
        Gets a line a stage.
    fingerprint : str
        Of the problem, so that a state is only gone on with for the same one.
    resume : bool
        Whether to go on from the state.
    quiet : bool
        No line, as in a sweep.
    """

    def __init__(
        self,
        file: Path,
        log: Path,
        fingerprint: str,
        *,
        resume: bool = False,
        quiet: bool = False,
    ) -> None:
        super().__init__(file, resume=resume, quiet=quiet)
        self._log, self._fingerprint, self._stage = log, fingerprint, ""

    def __enter__(self) -> Self:
        super().__enter__()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        super().__exit__(kind, error, trace)
        if error is not None:
            self.note(f"ended by {type(error).__name__}" + (f": {error}" if str(error) else ""))

    def update(self, fraction: float, cost: float, message: str) -> bool:
        """Show; False once somebody asked to stop."""
        spent = perf_counter() - self._begin
        stage, _, step = message.partition(":")
        if stage != self._stage:
            self._stage = stage
            self.note(stage)
        if self._visible and spent >= self._PATIENCE:
            if self._bar is None:
                self._bar, self._task = _bar()
                self._bar.start()
            self._bar.update(self._task, completed=fraction, stage=stage, step=step.strip())
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
                "what is diagnosed has changed since: a recording, the model or the suspects",
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
                log.write(f"{perf_counter() - self._begin:8.1f} s  {text}\n")
        except OSError:
            pass

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        terminated = number == signal.SIGTERM
        if self.exit_code is not None:
            raise Terminated if terminated else KeyboardInterrupt
        self.exit_code = EXIT_TERMINATED if terminated else EXIT_INTERRUPTED
        words = "stopping; finished stages are kept (once more: at once)"
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
        TextColumn("[bold]{task.fields[stage]}[/bold]"),
        TextColumn("{task.fields[step]}", style="dim"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(compact=True),
        console=Console(file=sys.stderr, force_jupyter=False),
        transient=True,
    )
    return bar, bar.add_task("", total=1.0, stage="", step="")
