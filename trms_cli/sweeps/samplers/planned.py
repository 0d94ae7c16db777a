"""Points that are known before the first result: samples crossed with choices."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from trms_cli.core.errors import ConfigurationError
from trms_cli.sweeps.point import RunResult, SweepPoint
from trms_cli.sweeps.robustness import Robustness
from trms_cli.sweeps.samplers.drawing import (
    FloatArray,
    Part,
    chosen_part,
    combinations,
    drawn_part,
    quantiles,
)
from trms_cli.sweeps.space import Space


@dataclass
class Planned:
    """The points of a sweep whose samples are all drawn at its beginning.

    Every combination of choices sees every sample, and those of one sample follow each other: a
    sweep that was stopped has compared like with like.
    """

    space: Space
    #: (n, d) array; values of the ranges and priors; n = 1 and d = 0 for a grid
    samples: FloatArray
    given: int = 0  #: Points that have been proposed
    robustness: Robustness | None = None  #: What is told of the samples at the end

    @property
    def total(self) -> int:
        """Points in all."""
        return len(self.samples) * combinations(self.space.choices)

    def point(self, number: int) -> SweepPoint:
        """The point of a number."""
        sample, choice = divmod(number, combinations(self.space.choices))
        part = (
            Part(self.space.fixed)
            + chosen_part(self.space.choices, choice)
            + drawn_part(self.space.continuous, self.samples[sample].tolist())
        )
        return SweepPoint(number, part.overrides, part.values or {})

    def more(self, results: Sequence[RunResult], wanted: int) -> list[SweepPoint]:
        """The next points; results change nothing."""
        upto = min(self.given + max(wanted, 0), self.total)
        points = [self.point(number) for number in range(self.given, upto)]
        self.given = upto
        return points

    def summary(self, results: Mapping[int, RunResult]) -> dict[str, Any]:
        """Statistics over the samples; nothing of a grid."""
        if self.robustness is None:
            return {}
        points = [self.point(number) for number in sorted(results) if number < self.total]
        return self.robustness.told(self.space, points, results)


def planned(
    space: Space,
    shares: FloatArray,
    known: Sequence[SweepPoint],
    robustness: Robustness | None = None,
) -> Planned:
    """Points of samples at given shares of the distributions, those that are known left out.

    ``shares``: (n, d) array; points of the unit cube, a column for each range and prior. Raises
    ConfigurationError if the points that are known are others: the sweep was begun with another
    configuration.
    """
    samples = shares.copy()
    for column, varied in enumerate(space.continuous):
        samples[:, column] = quantiles(varied, shares[:, column])
    proposals = Planned(space, samples, robustness=robustness)
    for point in known:
        if point.number >= proposals.total or proposals.point(point.number) != point:
            raise ConfigurationError(
                f"point {point.number} was another when the sweep began: "
                f"{' '.join(point.overrides)}",
                where="sampler",
                remedy="resume with the samples and the seed that it began with, "
                "or begin a new sweep",
            )
    proposals.given = len(known)
    return proposals
