"""What a person sees of a run: a progress bar on a terminal, then the score and the files."""

from __future__ import annotations

from pathlib import Path
from time import perf_counter
from types import TracebackType
from typing import Any, Self, TextIO


class RunScreen:
    """Progress on a stream that is a terminal; silence elsewhere.

    Parameters
    ----------
    duration : float
        Simulated time of the whole run, s.
    stream : text stream
    """

    #: A run that ends before this needs no bar (s), and none of the time that drawing it takes.
    _PATIENCE = 0.5

    def __init__(self, duration: float, stream: TextIO) -> None:
        self._duration, self._stream = duration, stream
        self._bar: Any = None
        self._task: Any = None
        self._begin = perf_counter()
        self._visible = stream.isatty()

    def __enter__(self) -> Self:
        self._begin = perf_counter()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._bar is not None:
            self._bar.stop()
            self._bar = None

    def progress(self, time: float, error: float) -> None:
        """Simulated time (s) and the largest present tracking error (rad)."""
        spent = perf_counter() - self._begin
        if not self._visible or spent < self._PATIENCE:
            return
        if self._bar is None:
            self._bar, self._task = _bar(self._duration, self._stream)
            self._bar.start()
        speed = time / spent
        self._bar.update(self._task, completed=time, speed=f"{speed:.0f}×", error=f"{error:.3f}")

    def say_interrupted(self, log: Path, time: float) -> None:
        """Where the log of an interrupted run is."""
        self._stream.write(f"\ninterrupted at {time:.2f} s; the log up to there: {log}\n")

    def say_finished(
        self, score: dict[str, Any], log: Path, picture: Path | None, spent: float
    ) -> None:
        """The score, and where the files are."""
        from trms_cli.commands.score import print_score

        print_score(score)
        speed = score["duration_s"] / spent if spent > 0 else float("inf")
        print(f"\n{score['duration_s']:g} s simulated in {spent:.2f} s ({speed:.0f}× real time)")
        print(f"log      {log}")
        if picture is not None:
            print(f"picture  {picture}")


def _bar(duration: float, stream: TextIO) -> tuple[Any, Any]:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    bar = Progress(
        TextColumn("{task.completed:6.1f} / {task.total:g} s"),
        BarColumn(),
        TextColumn("{task.fields[speed]} real time"),
        TextColumn("error {task.fields[error]} rad"),
        TimeRemainingColumn(),
        console=Console(file=stream),
        transient=True,
    )
    return bar, bar.add_task("", total=duration, speed="", error="")
