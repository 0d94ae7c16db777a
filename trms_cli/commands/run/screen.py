"""What a person sees of a run: a progress bar on a terminal, then the score and the files."""

from __future__ import annotations

import re
import shlex
import sys
from collections.abc import Iterator, Mapping
from functools import cached_property
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any, Self

from trms_cli.core import wording
from trms_cli.core.findings import Findings, NextCommand, Section
from trms_cli.core.headline import headline
from trms_cli.core.invocation import program
from trms_cli.scoring.findings import in_short, short_tables, warnings_of

if TYPE_CHECKING:
    from trms_cli.composition.composer import Composition
    from trms_cli.simulation.closed_loop import Experiment


class RunScreen:
    """Progress on standard error if that is a terminal; the score on standard output.

    Parameters
    ----------
    composition : Composition
    experiment : Experiment
    log : Path
    """

    #: A run that ends before this needs no bar (s), and none of the time that drawing it takes.
    _PATIENCE = 0.5

    def __init__(self, composition: Composition, experiment: Experiment, log: Path) -> None:
        self._composition, self._experiment, self._log = composition, experiment, log
        self._stream = sys.stderr
        self._bar: Any = None
        self._task: Any = None
        self._visible = self._stream.isatty()
        self._begin = perf_counter()
        self._spent = 0.0

    def __enter__(self) -> Self:
        self._begin = perf_counter()
        return self

    def __exit__(self, *_: object) -> None:
        self._spent = perf_counter() - self._begin
        if self._bar is not None:
            self._bar.stop()
            self._bar = None

    def progress(self, time: float, error: float) -> None:
        """Simulated time (s) and the largest present tracking error (rad)."""
        spent = perf_counter() - self._begin
        if not self._visible or spent < self._PATIENCE:
            return
        if self._bar is None:
            self._bar, self._task = _bar(self._experiment.duration, self._stream)
            self._bar.start()
        speed = f"{time / spent:.0f}× real time"
        self._bar.update(self._task, completed=time, speed=speed, error=f"error {error:.3f} rad")

    def say_interrupted(self, time: float) -> None:
        """Where the log of an interrupted run is."""
        self._stream.write(
            f"\ninterrupted at {time:.2f} s; the log up to there is complete and readable\n"
            f"  log  {self._log}\n"
            f"  try  {program()} score {shlex.quote(str(self._log))}\n"
        )

    def say_finished(self, score: dict[str, Any], picture: Path | None, whole: float) -> None:
        """The score in short, the files, and what to do next; one line for a job of a sweep."""
        if self._composition.job is not None:
            print(self._job_line(score))
            return
        from trms_cli.reporting.screen import show

        show(self.findings(score, picture, whole), "run")

    def findings(self, score: dict[str, Any], picture: Path | None, whole: float) -> Findings:
        """What the run has to tell; `whole` is the time of the command so far, s."""
        duration = score["duration_s"]
        speed = duration / self._spent if self._spent > 0 else float("inf")
        time = (
            f"{duration:g} s at {1 / self._experiment.sample_time:g} Hz simulated in "
            f"{self._spent:.2f} s ({speed:.0f}× real time), {whole:.2f} s in all"
        )
        log, trms = shlex.quote(str(self._log)), program()
        files = {"log": self._log} | ({"picture": picture} if picture is not None else {})
        typed = (f"score {log}", f"export {log}", f"run --from {log} {self._another()}")
        return Findings(
            self.title,
            [],
            [Section("Score", blocks=short_tables(score))],
            score,
            [*self._unheard(), *_beyond_limits(score), *warnings_of(score)],
            facts=in_short(score) | {"time": time},
            files=files,
            next=[NextCommand(f"{trms} {words}") for words in typed],
        )

    @cached_property
    def title(self) -> str:
        """Who runs on what."""
        e = self._experiment
        rig = str(getattr(getattr(e.plant, "model", None), "name", ""))
        return headline(self._composition.shown_choices, follows=self._follows, rig=rig)

    @property
    def _follows(self) -> bool:
        return bool(getattr(self._experiment.controller, "follows_reference", True))

    def _unheard(self) -> Iterator[str]:
        """What was asked for and has no part in the run."""
        if self._follows:
            return
        heads = (text.lstrip("+~").partition("=")[0] for text in self._composition.overrides)
        asked = [head for head in heads if re.match(r"ref\b|\w+@ref\b", head)]
        if asked:
            name = self._composition.choices.get("controller")
            yield (f"{name} follows no reference; of no effect: {', '.join(asked)}")

    def _another(self) -> str:
        """An override that would be interesting next."""
        effects = self._composition.choices.get("effect")
        if self._composition.choices.get("plant") == "simulated" and not effects:
            return "effect=yaw_coulomb_friction"
        if not self._follows:
            return "controller=pid"
        return "ref=sine" if self._composition.choices.get("ref") != "sine" else "ref=square"

    def _job_line(self, score: Mapping[str, Any]) -> str:
        figures = [
            f"{name} {wording.number(channel['rmse'])} {channel['unit']}"
            for name, channel in score["channels"].items()
        ]
        what = " ".join(self._composition.overrides) or self.title
        return f"{self._composition.job:>4}  {what}  RMSE {', '.join(figures) or '–'}"


def _beyond_limits(score: Mapping[str, Any]) -> Iterator[str]:
    for name, told in score["constraint_violations"].items():
        if told["samples"]:
            samples = wording.count(told["samples"], "sample")
            worst = wording.quantity(told["worst"], told["unit"])
            yield f"{name} beyond its limit on {samples}, by {worst}"


def _bar(duration: float, stream: Any) -> tuple[Any, Any]:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    bar = Progress(
        TextColumn("{task.completed:.0f} / {task.total:g} s"),
        BarColumn(bar_width=20),
        TextColumn("{task.fields[speed]}"),
        TextColumn("{task.fields[error]}"),
        TimeRemainingColumn(compact=True),
        console=Console(file=stream, force_jupyter=False),
        transient=True,
    )
    return bar, bar.add_task("", total=duration, speed="", error="")
