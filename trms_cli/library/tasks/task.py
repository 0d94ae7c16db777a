"""What a task gives back, and who hears what it does meanwhile."""

from __future__ import annotations

import io
import sys
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from trms_cli.core.errors import EXIT_INTERRUPTED, EXIT_OK

if TYPE_CHECKING:
    from trms_cli.composition.composer import Composition, Outcome
    from trms_cli.core.findings import Findings
    from trms_cli.reporting.progress import ProgressLine


#: Called with the simulated time (s) and the largest present tracking error (rad).
LoopProgress = Callable[[float, float], None]
#: Rows of a table on the screen: all parameters of a model.
_ROWS = 40


@dataclass(frozen=True)
class Done:
    """What a task has done."""

    folder: Path  #: What it wrote into
    findings: Findings  #: What it has to tell
    subject: str = ""  #: What of: ``newtonian with pitch_coulomb_friction``
    exit_code: int = EXIT_OK
    objective: float | None = None  #: Smaller is better; None where a sweeper does not search
    #: First word of what is shown; empty where it is shown once the task begins
    command: str = ""

    @property
    def text(self) -> str:
        """The findings as a terminal shows them."""
        from trms_cli.reporting.screen import show

        stream = io.StringIO()
        show(self.findings, self.command, self.subject, stream=stream, rows=_ROWS)
        return stream.getvalue()


class Interrupted(KeyboardInterrupt):
    """Ctrl-C, or a notebook's stop button: what was done until then is kept.

    Parameters
    ----------
    folder : Path
        Holds it; ``trms_cli.load(folder)`` reads it.
    how : str
        How to go on, to be typed.
    exit_code : int
        Of the process: of Ctrl-C, or of a signal to end.
    words : str
        What a command tells of it, where it cannot be gone on with.
    """

    def __init__(
        self, folder: Path, how: str = "", exit_code: int = EXIT_INTERRUPTED, words: str = ""
    ) -> None:
        super().__init__(f"what was done until then is in {folder}")
        self.folder, self.how, self.exit_code, self.words = folder, how, exit_code, words


class Listener:
    """Hears what a task is about to do; this one says nothing of it.

    ``command``: the first word of what is shown.
    """

    quiet = True  #: Whether a bar of progress is unwelcome

    def __init__(self, command: str) -> None:
        self.command = command

    def begin(self, words: str, facts: Mapping[str, str]) -> None:
        """What is done, and to what."""

    def done(self, result: Done) -> None:
        """What came of it."""

    def progress(self) -> ProgressLine:
        """The line on which a task without a bar tells what it does."""
        from trms_cli.reporting.progress import ProgressLine

        return ProgressLine(quiet=self.quiet)

    def simulation(self, duration: float) -> AbstractContextManager[LoopProgress | None]:
        """Gives what a loop of so many seconds is to call, if anything."""
        return nullcontext(None)

    def confirm(self, question: str) -> bool:
        """Whether a person agrees with what is about to happen; nobody is there to be asked."""
        return False


class Screen(Listener):
    """Shows it on standard output."""

    quiet = False
    _has_begun = False

    def begin(self, words: str, facts: Mapping[str, str]) -> None:
        """What is done, and to what."""
        from trms_cli.reporting.screen import say

        self._has_begun = True
        say(self.command, words)
        for name, text in facts.items():
            for line in text.split("\n"):
                say(name, line)
        sys.stdout.flush()

    def done(self, result: Done) -> None:
        """What came of it."""
        from trms_cli.reporting.screen import show

        command = "" if self._has_begun else result.command or self.command
        show(result.findings, command, result.subject, rows=_ROWS)

    def confirm(self, question: str) -> bool:
        """Whether the person at the terminal agrees."""
        if not (sys.stdin.isatty() and sys.stderr.isatty()):
            return False
        sys.stderr.write(f"{question}; go on? [y/N] ")
        sys.stderr.flush()
        return sys.stdin.readline().strip().lower() in ("y", "yes")

    def simulation(self, duration: float) -> AbstractContextManager[LoopProgress | None]:
        """Gives what moves a bar, on a terminal."""
        from trms_cli.reporting.progress import LoopBar

        return LoopBar(duration) if sys.stderr.isatty() else nullcontext(None)


def as_job(composition: Composition, task: Callable[..., Done], **how: Any) -> Outcome:
    """Let a task do a job of a sweep, which says a few lines of itself."""
    from trms_cli.composition.composer import Outcome
    from trms_cli.reporting.screen import show_job

    assert composition.job is not None
    result = task(composition, Listener(""), **how)
    show_job(result.findings, composition.job, composition.overrides or [result.findings.title])
    return Outcome(result.exit_code, result.objective, result.folder)
