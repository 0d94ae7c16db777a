"""Remarks besides a result: a page that could not be written, a package that differs.

They go to standard error; whoever calls from Python hears them as warnings.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_listener: ContextVar[Callable[[str], None] | None] = ContextVar("listener", default=None)


def note(text: str) -> None:
    """Remark something."""
    listener = _listener.get()
    if listener is None:
        sys.stderr.write(f"{text}\n")
    else:
        listener(text)


@contextmanager
def notes_to(listener: Callable[[str], None]) -> Iterator[None]:
    """Inside, remarks go to `listener`."""
    before = _listener.set(listener)
    try:
        yield
    finally:
        _listener.reset(before)
