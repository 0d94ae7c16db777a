"""The plugins of a sweep: a sampler turns what varies into runs, a launcher has them computed.

Both are frozen configuration, built from a YAML of the group ``sampler`` or ``launcher``. A
sampler's state is a `Proposals`, which the driver asks for points and tells of results. Where
several controllers are compared under sampled rigs, each is to see the same draws: the samples are
crossed with the choices and not drawn anew. A launcher keeps no record: the driver writes down what
is to be done, the workers write the ``status.json`` of each run, and whoever reads both knows what
is left, whatever died.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, Protocol

from trms_cli.sweeps.space import RunResult, Space, SweepPoint


class Proposals(Protocol):
    """The points of one sweep, as they come."""

    @property
    def total(self) -> int | None:
        """Points there will be in all; None where nobody knows."""

    def more(self, results: Sequence[RunResult], count: int) -> list[SweepPoint]:
        """The next points, numbered on from the last.

        `results`: those that came since the last call. `count`: points for which there are
        workers; more or fewer may be given. None while some are still at work: nothing until
        further results come. None when none is at work: the sweep is complete.
        """

    def summary(self, results: Mapping[int, RunResult]) -> dict[str, Any]:
        """What the sampler has to say at the end, JSON data for ``sweep.json`` (may be empty).

        Keys of an optimiser: ``objectives`` (names), ``pareto`` (numbers of points, or of trials
        with their means), ``best``.
        """


class Sampler(Protocol):
    """Configuration of how values are chosen."""

    def start(self, space: Space, earlier_points: Sequence[SweepPoint] = ()) -> Proposals:
        """Begin, or go on.

        `earlier_points`: those that were proposed before the sweep was interrupted, in their
        order. Their results are told by the first call of `Proposals.more`; equal configuration and
        results give equal points. Raises ConfigurationError if the space does not suit the sampler:
        a range under ``grid``, nothing to vary, …
        """


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
class EndedAttempt:
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

    def submit(self, attempts: Sequence[Attempt]) -> None:
        """Have runs made; returns at once."""

    def collect(self, timeout_s: float) -> list[EndedAttempt]:
        """Those that have ended since the last call; waits up to `timeout_s` for the first.

        When a worker dies its attempts are among them, and the crew goes on with new workers (or
        raises TrmsError when there are none to be had).
        """


class Launcher(Protocol):
    """Configuration of where runs are made."""

    def crew(self, work: Work) -> AbstractContextManager[Workers]:
        """Start workers; leaving the context ends them, and what is not done stays undone.

        Raises ConfigurationError if the engine is not installed or cannot be reached.
        """
