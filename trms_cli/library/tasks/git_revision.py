"""The revision of the checkout that the program runs from."""

import os
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Self

#: The answer, where it has been found out for many runs at once.
_revision: ContextVar[str | None] = ContextVar("revision", default=None)


@contextmanager
def known_revision(revision: str) -> Iterator[None]:
    """Inside, nobody asks git: this is its answer."""
    before = _revision.set(revision)
    try:
        yield
    finally:
        _revision.reset(before)


class GitRevision:
    """A question to git, asked now and answered later: the run starts meanwhile."""

    _PATIENCE = 5.0  # s

    def __init__(self, answering: subprocess.Popen[str] | None, answer: str = "") -> None:
        self._answering, self._answer = answering, answer

    @classmethod
    def ask(cls) -> Self:
        """Start to find out; no git or no checkout is no error."""
        revision = _revision.get()
        if revision is not None:
            return cls(None, revision)
        root = Path(__file__).resolve().parents[3]
        if not (root / ".git").exists():
            return cls(None)
        try:
            return cls(
                subprocess.Popen(
                    ["git", "-C", str(root), "describe", "--always", "--dirty", "--abbrev=12"],
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.PIPE,
                    stderr=subprocess.DEVNULL,
                    text=True,
                    env={**os.environ, "GIT_OPTIONAL_LOCKS": "0"},
                )
            )
        except OSError:
            return cls(None)

    def answer(self) -> str:
        """The revision, with ``-dirty`` behind it when files differ; empty if there is none."""
        if self._answering is not None:
            try:
                output, _ = self._answering.communicate(timeout=self._PATIENCE)
                self._answer = output.strip() if self._answering.returncode == 0 else ""
            except subprocess.TimeoutExpired:
                self._answering.kill()
                self._answering.wait()
            self._answering = None
        return self._answer
