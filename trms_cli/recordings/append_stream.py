"""A file that grows in steps, each of which is wholly there or not at all."""

from __future__ import annotations

import os
from pathlib import Path


class AppendStream:
    """Collects bytes and hands them to the operating system on :meth:`flush`.

    A step that fails half-way (full disk) is cut off again, so that the file always ends
    where the last good step ended. What a flush has passed to the system outlives SIGKILL
    of this process; it is not forced to the platters, a power cut may still lose it.

    Parameters
    ----------
    path : Path
        Must not exist: the file is created exclusively.
    """

    def __init__(self, path: Path) -> None:
        self._descriptor = os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666)
        self._pending = bytearray()
        self._size = 0

    def write(self, data: bytes) -> int:
        """Collect ``data``; nothing reaches the file yet."""
        self._pending += data
        return len(data)

    def tell(self) -> int:
        """Return the position in the file [bytes] at which the next data will stand."""
        return self._size + len(self._pending)

    def flush(self) -> None:
        """Write what is collected; on failure restore the file's end and raise OSError."""
        data = memoryview(bytes(self._pending))
        self._pending.clear()
        written = 0
        try:
            while written < len(data):
                written += os.write(self._descriptor, data[written:])
        except OSError:
            os.ftruncate(self._descriptor, self._size)
            raise
        self._size += written

    def close(self) -> None:
        """Close the file; what was not flushed is dropped."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1
