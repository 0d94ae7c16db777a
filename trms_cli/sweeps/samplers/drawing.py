"""From the unit cube to the values of a space, and from values to what is typed for a run.

The points of most samplers are known before the first result: samples crossed with choices.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from decimal import ROUND_CEILING, ROUND_FLOOR, Context
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from trms_cli.core.errors import ConfigurationError
from trms_cli.sweeps.robustness import Robustness
from trms_cli.sweeps.space import Choice, PriorOfKey, Range, RunResult, Space, SweepPoint

FloatArray = npt.NDArray[np.float64]

#: Significant digits of a drawn number: what is typed for a run is what was simulated.
DIGITS = 6


def quantiles(varied: Range | PriorOfKey, shares: FloatArray) -> FloatArray:
    """Values, (n,) in the unit of the key, at these shares, (n,) within [0, 1], of a distribution.

    A range is uniform, in its logarithm if it is logarithmic. A prior is normal with its tails
    moved to the bounds, as a parameter table is drawn by ``plant.prior_seed``. The values are
    rounded to :data:`DIGITS` digits but within the bounds.
    """
    from scipy import stats

    if isinstance(varied, PriorOfKey):
        # Shares of 0 and 1 are infinitely far out; the bounds bring them back.
        values = stats.norm.ppf(shares, varied.mean, varied.sd)
    elif varied.whole:
        low, high = varied.low - 0.5, varied.high + 0.5
        values = np.round(_uniform(varied, low, high, shares))
    else:
        values = _uniform(varied, varied.low, varied.high, shares)
    return np.array([rounded(varied, float(value)) for value in values])


def _uniform(varied: Range, low: float, high: float, shares: FloatArray) -> FloatArray:
    from scipy import stats

    if varied.logarithmic:
        return np.asarray(stats.loguniform.ppf(shares, low, high))
    return np.asarray(stats.uniform.ppf(shares, low, high - low))


def rounded(varied: Range | PriorOfKey, value: float) -> float:
    """A value with few digits, within the bounds: at a bound of more digits, just inside of it."""
    if isinstance(varied, Range) and varied.whole:
        return min(max(value, varied.low), varied.high)
    short = float(f"{value:.{DIGITS}g}")
    if short < varied.low:
        short = _short(varied.low, ROUND_CEILING)
    elif short > varied.high:
        short = _short(varied.high, ROUND_FLOOR)
    # Bounds may lie so close that no number of few digits is between them.
    return min(max(short, varied.low), varied.high)


def _short(bound: float, towards: str) -> float:
    return float(Context(DIGITS, towards).create_decimal(repr(bound)))


def as_data(varied: Range | PriorOfKey, value: float) -> float | int:
    """A value as it stands in a point: a whole number as such."""
    return int(value) if isinstance(varied, Range) and varied.whole else float(value)


@dataclass(frozen=True)
class Part:
    """A part of a point: some keys with their values."""

    overrides: tuple[str, ...] = ()  #: As they would be typed
    values: Mapping[str, Any] | None = None  #: The same as data

    def __add__(self, other: Part) -> Part:
        values = {**(self.values or {}), **(other.values or {})}
        return Part(self.overrides + other.overrides, values)


def drawn_part(continuous: Sequence[Range | PriorOfKey], row: Sequence[float]) -> Part:
    """The part of a point that gives each range and prior one value."""
    values = {
        varied.key: as_data(varied, value) for varied, value in zip(continuous, row, strict=True)
    }
    return Part(tuple(f"{key}={value!r}" for key, value in values.items()), values)


def chosen_part(choices: Sequence[Choice], number: int) -> Part:
    """The part of a point that makes each choice: combination `number`, the last varying fastest.

    Raises IndexError if there are not so many combinations.
    """
    picked: list[tuple[str, str]] = []
    for choice in reversed(choices):
        number, index = divmod(number, len(choice.values))
        picked.append((choice.key, choice.values[index]))
    if number:
        raise IndexError(number)
    picked.reverse()
    return Part(tuple(f"{key}={value}" for key, value in picked), dict(picked))


def combinations(choices: Sequence[Choice]) -> int:
    """How many combinations of choices there are; 1 without any."""
    return int(np.prod([len(choice.values) for choice in choices], dtype=np.int64))


def all_chosen(choices: Sequence[Choice]) -> Iterator[Part]:
    """Every combination, the last choice varying fastest."""
    return (chosen_part(choices, number) for number in range(combinations(choices)))


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


@dataclass(frozen=True, kw_only=True)
class DrawingSampler:
    """Samples drawn from the ranges and priors at the beginning, crossed with the choices."""

    NAME: ClassVar[str]  #: Its option
    #: Figures that are told of at the end, by the names of ``trms runs``
    figures: tuple[str, ...] = ()
    #: Largest allowed value of some figures: a run beyond one counts as a failure
    limits: Mapping[str, float] = field(default_factory=dict)

    def shares(self, columns: int) -> FloatArray:
        """The samples as points of the unit cube, (samples, columns)."""
        raise NotImplementedError

    def start(self, space: Space, known: Sequence[SweepPoint] = ()) -> Planned:
        """Begin, or go on; see :class:`trms_cli.sweeps.plugins.Sampler`.

        Raises ConfigurationError for a space in which there is nothing to draw.
        """
        if not space.continuous:
            keys = ", ".join(choice.key for choice in space.choices) or "what was typed"
            raise ConfigurationError(
                f"nothing is drawn: no range and no prior among {keys}",
                where="sampler",
                remedy=f"give {self.NAME} something: plant.parameters=prior or "
                "KEY=interval(LOW,HIGH); choices alone are tried one by one by sampler=grid",
            )
        told = Robustness(self.figures, self.limits).checked()
        return planned(space, self.shares(len(space.continuous)), known, told)
