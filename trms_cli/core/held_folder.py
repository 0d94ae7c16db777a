"""A folder held by one process while it writes into it, so that no second one does.

The lock is the system's own, on the folder itself: it leaves no file behind, and whoever is killed
loses it. Where a file system has no such locks, the first to make a folder has it all the same, and
two that are given one empty folder at the same moment are not kept apart.
"""

from __future__ import annotations

import contextlib
import os
import threading
from pathlib import Path

#: A process that makes thousands of folders keeps descriptors of no more.
_MANY = 64
#: Folders that this process holds: descriptor, and the thread that took it.
_held: dict[tuple[int, int], tuple[int, int, Path]] = {}
_guard = threading.Lock()


def hold(folder: Path) -> bool:
    """Hold a folder until the process ends or lets go of it; whether nobody else does.

    Raises OSError if it cannot be opened.
    """
    try:
        import fcntl
    except ImportError:  # not a system of this kind
        return True
    with _guard:
        _forget_written()
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        about = os.fstat(descriptor)
        key = (about.st_dev, about.st_ino)
        known = _held.get(key)
        if known is not None:
            os.close(descriptor)
            return known[1] == threading.get_ident()
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(descriptor)
            return False
        except OSError:  # no locks here
            os.close(descriptor)
            return True
        _held[key] = descriptor, threading.get_ident(), folder
        return True


def let_go(folder: Path) -> None:
    """Let go of a folder; nothing happens where it is not held."""
    with _guard, contextlib.suppress(OSError):
        about = os.stat(folder)
        known = _held.pop((about.st_dev, about.st_ino), None)
        if known is not None:
            os.close(known[0])


def _forget_written() -> None:
    """Let go of folders that are gone or hold files, where there are many.

    One that holds a file is nobody else's any more, since only empty ones are taken.
    """
    if len(_held) < _MANY:
        return
    for key, (descriptor, _, folder) in list(_held.items()):
        try:
            needed = not any(folder.iterdir())
        except OSError:
            needed = False
        if not needed:
            os.close(descriptor)
            del _held[key]
