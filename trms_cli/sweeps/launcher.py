"""What a launcher is: it has points computed somewhere, and tells what came of them.

A launcher is a plugin: frozen configuration, built from a YAML of the group ``launcher``. It keeps
no record: the driver writes down what is to be done, the workers write the ``status.json`` of each
run, and whoever reads both knows what is left, whatever died.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Protocol

from trms_cli.sweeps.point import RunResult, SweepPoint


@dataclass(frozen=True)
class Attempt:
    """A point as it is handed to a worker."""

    point: SweepPoint
    #: 1 for the first time that it is tried. Whoever is handed the same attempt after another
    #: worker has begun it, does not run it.
    number: int = 1


#: A picklable function that makes one run and never raises for a run that fails; None where
#: another worker has begun this attempt.
Work = Callable[[Attempt], RunResult | None]


@dataclass(frozen=True)
class Ended:
    """An attempt whose worker has come back, or has died."""

    attempt: Attempt
    #: None: the worker died with it, or its result was lost; whether the run was made stands in its
    #: folder
    result: RunResult | None
    reason: str = ""  #: Why there is no result, as the engine tells it


class Workers(Protocol):
    """Workers that are up."""

    @property
    def workers(self) -> int:
        """How many runs are made at once."""
        ...

    def submit(self, attempts: Sequence[Attempt]) -> None:
        """Have runs made; returns at once."""
        ...

    def ended(self, timeout_s: float) -> list[Ended]:
        """Those that have ended since the last call; waits up to `timeout_s` for the first.

        When a worker dies its attempts are among them, and the crew goes on with new workers (or
        raises TrmsError when there are none to be had).
        """
        ...


class Launcher(Protocol):
    """Configuration of where runs are made."""

    def crew(self, work: Work) -> AbstractContextManager[Workers]:
        """Start workers; leaving the context ends them, and what is not done stays undone.

        Raises ConfigurationError if the engine is not installed or cannot be reached.
        """
        ...
