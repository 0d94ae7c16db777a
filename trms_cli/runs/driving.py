"""Whether a process drives a sweep at present: it holds a lock in the sweep's folder."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path

#: Held by the process that drives the sweep; the system frees it when that process dies.
LOCK_NAME = ".lock"


def has_driver(folder: Path) -> bool:
    """Whether a process drives the sweep in a folder at present."""
    try:
        descriptor = os.open(folder / LOCK_NAME, os.O_RDWR | os.O_CLOEXEC)
    except OSError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    finally:
        os.close(descriptor)
    return False
