"""How the program was called, for the commands that it tells to type next."""

import shlex
import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

_NAME = "trms"
#: What stands for the command line where a command was called from Python.
_called: ContextVar[str | None] = ContextVar("called", default=None)


def program() -> str:
    """What to type for this program: its name where the shell finds it, else the way it was called.

    A program that was started as ``.venv/bin/trms`` is on nobody's path, and another ``trms`` may
    be.
    """
    called = Path(sys.argv[0])
    if called.name == "__main__.py" and called.parent.name == "trms_cli":
        return f"{shlex.quote(_relative(sys.executable))} -m trms_cli"
    path = shutil.which(_NAME)
    if called.name != _NAME or (path and Path(path).absolute() == called.absolute()):
        return _NAME
    return shlex.quote(sys.argv[0])


def _relative(executable: str) -> str:
    """A path under the working folder without it, else as it is."""
    path, here = Path(executable), Path.cwd()
    return str(path.relative_to(here)) if path.is_relative_to(here) else executable


def command_line() -> str:
    """What was typed, for the records of what is written; from Python, what would be typed."""
    called = _called.get()
    return shlex.join([_NAME, *sys.argv[1:]]) if called is None else called


@contextmanager
def called_as(words: str) -> Iterator[None]:
    """Inside, a command is called from Python, and `words` are what :func:`command_line` says."""
    before = _called.set(words)
    try:
        yield
    finally:
        _called.reset(before)


def whole_trace() -> str:
    """Where the trace of an exception is that a message tells of."""
    typed = _called.get() is None
    return "the whole trace: add --debug" if typed else "the whole trace: the error's __cause__"


_listener: ContextVar[Callable[[str], None] | None] = ContextVar("listener", default=None)


def note(text: str) -> None:
    """Remark something."""
    listener = _listener.get()
    if listener is None:
        sys.stderr.write(f"{text}\n")
    else:
        listener(text)


def remark_wait(text: str) -> None:
    """Tell a person at a terminal that something takes a while; nobody else."""
    if _listener.get() is None and sys.stderr.isatty():
        sys.stderr.write(f"{text}\n")


@contextmanager
def notes_to(listener: Callable[[str], None]) -> Iterator[None]:
    """Inside, remarks go to `listener`."""
    before = _listener.set(listener)
    try:
        yield
    finally:
        _listener.reset(before)
