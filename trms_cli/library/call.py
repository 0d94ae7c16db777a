"""A call from Python: composed, done without a word, and the process left as it was."""

from __future__ import annotations

import shlex
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from trms_cli.composition.arguments import Arguments
from trms_cli.core.errors import EXIT_INTERRUPTED, EXIT_TERMINATED
from trms_cli.core.invocation import notes_to
from trms_cli.library.tasks.task import Done, Interrupted, Listener, Screen

if TYPE_CHECKING:
    from trms_cli.composition.composer import Composition

#: One call at a time: a composition and the standard streams are the process's own.
_TURN = threading.RLock()


class TrmsNote(UserWarning):
    """What a command remarks: a package that differs, a picture that could not be drawn."""


@contextmanager
def turn(words: str, objects: Sequence[Any] = ()) -> Iterator[None]:
    """Inside, this call alone composes and finds its objects; afterwards the process is as it was.

    `words`: what the records of what is written say of the call.
    """
    from trms_cli.composition.given_object import place_objects
    from trms_cli.core.invocation import called_as

    with _TURN:
        path = list(sys.path)
        try:
            with called_as(words), place_objects(objects):
                yield
        finally:
            sys.path[:] = path


@contextmanager
def remarks(verbose: bool) -> Iterator[None]:
    """Remarks made inside are shown as a command shows them, or are warnings of whoever called."""
    if verbose:
        yield
        return
    notes: list[str] = []
    with notes_to(notes.append):
        yield
    for text in notes:
        warnings.warn(text.strip(), TrmsNote, stacklevel=6)


def call_command(
    command: str,
    arguments: Arguments,
    task: Callable[[Composition, Listener], Done],
    *,
    verbose: bool,
) -> Done:
    """Compose what a command is asked for, let a task do it, and show it if `verbose`.

    Raises Interrupted if it was stopped, and has left something.
    """
    from trms_cli.composition.composer import compose
    from trms_cli.composition.given_object import with_objects

    def whole(listener: Listener) -> Done:
        return task(with_objects(compose(arguments.argv, command), arguments.objects), listener)

    return call_task(
        command, words_of(command, arguments), whole, arguments.objects, verbose=verbose
    )


def call_task(
    command: str,
    words: str,
    task: Callable[[Listener], Done],
    objects: Mapping[str, Any],
    *,
    verbose: bool,
) -> Done:
    """Let a task do its work as a call in `words`; see :func:`call_command`."""
    listener = Screen(command) if verbose else Listener(command)
    with turn(words, list(objects.values())), remarks(verbose):
        result = task(listener)
    listener.done(result)
    if result.exit_code in (EXIT_INTERRUPTED, EXIT_TERMINATED):
        raise Interrupted(result.folder)
    return result


def words_of(command: str, arguments: Arguments) -> str:
    """A call in words: as it would be typed, or in Python where it has objects."""
    from trms_cli.composition.given_object import words_of as said

    if not arguments.objects:
        return shlex.join(["trms", command, *arguments.argv])
    words = [*map(repr, arguments.words), *(f"{p}={said(o)}" for p, o in arguments.objects.items())]
    return f"Python: {command}({', '.join(words)})"
