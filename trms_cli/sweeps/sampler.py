"""What a sampler is: it turns what a sweep varies into runs, all at once or by what came before.

A sampler is a plugin: frozen configuration, built from a YAML of the group ``sampler``. Its state
is a `Proposals`, which the driver asks for points and tells of results. Where several controllers
are compared under sampled rigs, each is to see the same draws: the samples are crossed with the
choices and not drawn anew.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

from trms_cli.sweeps.point import RunResult, SweepPoint
from trms_cli.sweeps.space import Space


class Proposals(Protocol):
    """The points of one sweep, as they come."""

    @property
    def total(self) -> int | None:
        """Points there will be in all; None where nobody knows."""
        ...

    def more(self, results: Sequence[RunResult], wanted: int) -> list[SweepPoint]:
        """The next points.

        Parameters
        ----------
        results : sequence of RunResult
            Those that came since the last call.
        wanted : int
            Points for which there are workers; more or fewer may be given.

        Returns
        -------
        list of SweepPoint
            Numbered on from the last. Empty while some are still at work: nothing until further
            results come. Empty when none is at work: the sweep is complete.
        """
        ...

    def summary(self, results: Mapping[int, RunResult]) -> dict[str, Any]:
        """What the sampler has to say at the end, JSON data for ``sweep.json`` (may be empty).

        Keys of an optimiser: ``objectives`` (names), ``pareto`` (numbers of points, or of trials
        with their means), ``best``.
        """
        ...


class Sampler(Protocol):
    """Configuration of how values are chosen."""

    def start(self, space: Space, known: Sequence[SweepPoint] = ()) -> Proposals:
        """Begin, or go on.

        Parameters
        ----------
        space : Space
        known : sequence of SweepPoint
            Those that were proposed before the sweep was interrupted, in their order. Their
            results are told by the first call of `Proposals.more`; equal configuration and results
            give equal points.

        Raises
        ------
        ConfigurationError
            If the space does not suit the sampler: a range under ``grid``, nothing to vary, …
        """
        ...
