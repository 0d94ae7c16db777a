"""What is being done, on one line of standard error, where that is a terminal."""

from __future__ import annotations

import sys
from time import perf_counter
from types import TracebackType
from typing import Self


class ProgressLine:
    """A line that is written over, and gone at the end of its ``with`` block."""

    _PATIENCE = 0.5  # s, before progress is worth a line

    def __init__(self) -> None:
        self._begin = perf_counter()
        self._width = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._width:
            sys.stderr.write("\r" + " " * self._width + "\r")

    def tell(self, doing: str) -> None:
        """What is being done."""
        if not sys.stderr.isatty() or perf_counter() - self._begin < self._PATIENCE:
            return
        sys.stderr.write("\r" + doing.ljust(self._width))
        sys.stderr.flush()
        self._width = max(self._width, len(doing))
