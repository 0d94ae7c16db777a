"""What a person sees of a sweep: one line while it goes on, then the counts and what to do next."""

from __future__ import annotations

import math
import shlex
import sys
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Any, Self

from trms_cli.core import wording
from trms_cli.core.errors import TrmsError
from trms_cli.core.invocation import program
from trms_cli.core.printable import print_json
from trms_cli.reporting.progress import ProgressLine, termination
from trms_cli.sweeps.findings import rate, sweep_findings
from trms_cli.sweeps.outcome import outcome_of

if TYPE_CHECKING:
    from trms_cli.sweeps.driver import SweepOutcome, SweepProgress
    from trms_cli.sweeps.space import RunResult

_MOST_NOTES = 10
#: Lines that runs of a small sweep say of themselves.
_MOST_LINES = 30
_EVERY = 0.2  # s between two lines


def on_screen(drive: Callable[..., SweepOutcome], *, as_json: bool = False) -> SweepOutcome:
    """Drive a sweep to its end; show how it goes and what came of it, or that as JSON.

    `drive` takes `tell` and `begun` of :func:`trms_cli.library.tasks.sweep.make_sweep`.
    """
    screen = SweepScreen()
    with screen:
        outcome = drive(tell=screen.tell, begun=screen.say_begun)
    document = outcome_of(outcome.folder, outcome.points)
    draw_summary(outcome.folder, document["summary"])
    if as_json:
        print_json(document)
    else:
        say_outcome(document)
    return outcome


class SweepScreen:
    """Progress on standard error, if that is a terminal."""

    def __init__(self) -> None:
        self._line = ProgressLine()
        self._stack = ExitStack()
        self._last = -math.inf
        self._notes: set[str] = set()
        self._folder: Path | None = None

    def __enter__(self) -> Self:
        self._stack.enter_context(termination())
        self._stack.enter_context(self._line)
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        self._stack.close()
        if self._folder is None or error is None:
            return
        if isinstance(error, (KeyboardInterrupt, TrmsError)):
            words = "interrupted" if isinstance(error, KeyboardInterrupt) else "not completed"
            folder = shlex.quote(str(self._folder))
            sys.stderr.write(
                f"\n{words}; nothing that is done is lost\n"
                f"  how it stands  {program()} sweep status {folder}\n"
            )
            # What is asked of the sampler stands; going on would end with the same error.
            if not getattr(error, "where", "").startswith("sampler"):
                sys.stderr.write(f"  to go on       {program()} sweep resume {folder}\n")

    def say_begun(self, folder: Path) -> None:
        """The record stands; from here on the sweep can be resumed."""
        self._folder = folder

    def tell(self, progress: SweepProgress, result: RunResult | None) -> None:
        """How far it is; what runs would have told, each line once."""
        for note in result.notes if result is not None else ():
            if note not in self._notes and len(self._notes) < _MOST_NOTES:
                self._notes.add(note)
                sys.stderr.write(f"\r{note}\n")
        here = monotonic()
        if here - self._last >= _EVERY:
            self._last = here
            self._line.tell(line_of(progress))


def line_of(progress: SweepProgress) -> str:
    """``37 of 1000 done · 2 failed · 6.3 runs/s · 2 min 33 s left``."""
    counts = progress.counts
    of = "" if progress.total is None else f" of {progress.total}"
    parts = [f"{counts.get('done', 0)}{of} done"]
    parts += [f"{counts[state]} {state}" for state in ("failed", "lost") if counts.get(state)]
    if progress.retried:
        parts.append(f"{progress.retried} tried again")
    if progress.total is not None:
        parts.append(f"{max(0, progress.total - progress.ended_count)} left")
    if progress.rate > 0 and progress.ended_count > progress.before + 1:
        parts.append(rate(progress.rate))
        if progress.total is not None:
            parts.append(
                f"{wording.seconds((progress.total - progress.ended_count) / progress.rate)}"
            )
    parts.append(f"{progress.workers} worker{'s' if progress.workers != 1 else ''}")
    return " · ".join(parts)


def draw_summary(folder: Path, summary: Mapping[str, Any]) -> list[Path]:
    """Pictures of what a sampler said, into the folder of the sweep; none where there are none."""
    from trms_cli.reporting.sweep_charts import summary_charts

    paths = []
    for chart in summary_charts(summary):
        from trms_cli.reporting.chart_picture import picture_of
        from trms_cli.reporting.style import house_style, save_png

        paths.append(folder / f"{chart.name}.png")
        with house_style():
            save_png(picture_of(chart), paths[-1])
    return paths


def say_outcome(document: Mapping[str, Any]) -> None:
    """Print how a sweep stands (`trms.sweep-status/1`)."""
    from trms_cli.reporting.screen import show

    show(sweep_findings(document), "sweep", rows=_MOST_LINES)
