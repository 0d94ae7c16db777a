"""A command called from Python: composed, done without a word, and the process left as it was."""

from __future__ import annotations

import io
import shlex
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from trms_cli.composition.arguments import Arguments
from trms_cli.core.errors import EXIT_INTERRUPTED, EXIT_TERMINATED
from trms_cli.core.notes import notes_to
from trms_cli.library.tasks.task import Done, Interrupted, Listener, Screen

if TYPE_CHECKING:
    from trms_cli.composition.composer import Composition, Outcome

#: One call at a time: a composition and the standard streams are the process's own.
_TURN = threading.RLock()


class TrmsNote(UserWarning):
    """What a command remarks: a package that differs, a picture that could not be drawn."""


class CapturedOutput:
    """What a command printed."""

    def __init__(self) -> None:
        self.out: list[str] = []
        self.err: list[str] = []

    @property
    def text(self) -> str:
        """What stands on standard output."""
        return "".join(self.out)

    def warn(self) -> None:
        """Notes on standard error, as warnings of whoever called."""
        for line in "".join(self.err).splitlines():
            note = line.strip()
            if note:
                warnings.warn(note, TrmsNote, stacklevel=4)


class _Ear(io.TextIOBase):
    """A standard stream that hears what one thread writes; all else goes where it always went."""

    def __init__(self, beneath: TextIO, heard: list[str], show: bool) -> None:
        self._beneath, self._heard, self._show = beneath, heard, show
        self._thread = threading.get_ident()

    def write(self, text: str) -> int:
        own = threading.get_ident() == self._thread
        if own:
            self._heard.append(text)
        if self._show or not own:
            self._beneath.write(text)
        return len(text)

    def flush(self) -> None:
        self._beneath.flush()

    def isatty(self) -> bool:
        return self._show and self._beneath.isatty()

    def writable(self) -> bool:
        return True

    @property
    def encoding(self) -> str:  # type: ignore[override]
        return getattr(self._beneath, "encoding", None) or "utf-8"


@contextmanager
def called(
    words: str, objects: Sequence[Any] = (), *, verbose: bool = False
) -> Iterator[CapturedOutput]:
    """Inside, a command may do as on the command line; afterwards the process is as it was.

    Parameters
    ----------
    words : str
        What the records of what is written say of the call.
    objects : sequence
        Those that the call was given.
    verbose : bool
        Whether what is printed is shown.
    """
    heard = CapturedOutput()
    with turn(words, objects):
        streams = (sys.stdout, sys.stderr)
        sys.stdout = _Ear(streams[0], heard.out, verbose)
        sys.stderr = _Ear(streams[1], heard.err, verbose)
        try:
            yield heard
        finally:
            sys.stdout, sys.stderr = streams


@contextmanager
def turn(words: str, objects: Sequence[Any] = ()) -> Iterator[None]:
    """Inside, this call alone composes and finds its objects; afterwards the process is as it was.

    Parameters
    ----------
    words : str
        What the records of what is written say of the call.
    objects : sequence
        Those that the call was given.
    """
    from trms_cli.composition.given_object import given
    from trms_cli.core.invocation import called_as

    with _TURN:
        path = list(sys.path)
        try:
            with called_as(words), given(objects):
                yield
        finally:
            sys.path[:] = path


def done(
    command: str,
    asked: Arguments,
    task: Callable[[Composition, Listener], Done],
    *,
    verbose: bool,
) -> Done:
    """Compose what is asked for and let a task do it.

    Parameters
    ----------
    command : str
        Its name, which is also that of its configuration.
    verbose : bool
        Whether progress and result are shown as the command shows them.

    Raises
    ------
    Interrupted
        If it was stopped, and has left something.
    """
    from trms_cli.composition.composer import compose
    from trms_cli.composition.given_object import with_objects

    def whole(listener: Listener) -> Done:
        return task(with_objects(compose(asked.argv, command), asked.objects), listener)

    return done_by(command, words_of(command, asked), whole, asked.objects, verbose=verbose)


def done_by(
    command: str,
    words: str,
    task: Callable[[Listener], Done],
    objects: Mapping[str, Any],
    *,
    verbose: bool,
) -> Done:
    """Let a task do its work as a call in `words`; see :func:`done`."""
    listener = Screen(command) if verbose else Listener(command)
    remarks: list[str] = []
    # shown as a command shows them, or warnings of whoever called
    heard = nullcontext() if verbose else notes_to(remarks.append)
    with turn(words, list(objects.values())), heard:
        result = task(listener)
    listener.done(result)
    for remark in remarks:
        warnings.warn(remark.strip(), TrmsNote, stacklevel=5)
    if result.exit_code in (EXIT_INTERRUPTED, EXIT_TERMINATED):
        raise Interrupted(result.folder)
    return result


def perform(
    command: str,
    asked: Arguments,
    task: Callable[[Composition], Outcome],
    *,
    verbose: bool,
) -> tuple[Path, str]:
    """Compose what is asked for and do it.

    Parameters
    ----------
    command : str
        Its name, which is also that of its configuration.

    Returns
    -------
    folder : Path
    text : str
        What the command prints.

    Raises
    ------
    Interrupted
        If it was stopped, and has left something.
    """
    from trms_cli.composition.composer import compose
    from trms_cli.composition.given_object import with_objects

    objects = list(asked.objects.values())
    with called(words_of(command, asked), objects, verbose=verbose) as heard:
        outcome = task(with_objects(compose(asked.argv, command), asked.objects))
    return finished(outcome, heard, verbose=verbose)


def finished(outcome: Outcome, heard: CapturedOutput, *, verbose: bool) -> tuple[Path, str]:
    """The folder of an outcome, and what was printed."""
    assert outcome.folder is not None
    if outcome.exit_code in (EXIT_INTERRUPTED, EXIT_TERMINATED):
        raise Interrupted(outcome.folder)
    if not verbose:
        heard.warn()
    return outcome.folder, heard.text


def words_of(command: str, asked: Arguments) -> str:
    """A call in words: as it would be typed, or in Python where it has objects."""
    from trms_cli.composition.given_object import words_of as said

    if not asked.objects:
        return shlex.join(["trms", command, *asked.argv])
    words = [*map(repr, asked.words), *(f"{p}={said(o)}" for p, o in asked.objects.items())]
    return f"Python: {command}({', '.join(words)})"
