"""From the unit cube to the values of a space, and from values to what is typed for a run.

The points of most samplers are known before the first result: samples crossed with choices.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from decimal import ROUND_CEILING, ROUND_FLOOR, Context
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from trms_cli.core.errors import ConfigurationError
from trms_cli.sweeps.figures import (
    MERIT,
    canonical_all,
    canonical_limits,
    figure_of,
    tracking_errors,
    unit_of,
)
from trms_cli.sweeps.space import Choice, PriorOfKey, Range, RunResult, Space, SweepPoint

#: Of the intervals of shares and of what is called a correlation.
CONFIDENCE = 0.95
_QUANTILES = {"q05": 0.05, "q25": 0.25, "median": 0.5, "q75": 0.75, "q95": 0.95}
_PERCENTILES = np.linspace(0, 1, 101)
#: Fewer runs say nothing of a correlation.
_FEWEST = 8
#: A choice that repeats a run and distinguishes nothing.
_REPEATS = "seed"


@dataclass(frozen=True)
class Robustness:
    """What many runs with drawn parameters say: failures, quantiles, and which parameter matters.

    By group: one combination of the choices (``controller=pid``), over all draws, each the mean
    over the values of ``seed``. All groups have seen the same draws.
    """

    #: Names of figures, as scores have them; those that the runs do not have are left out
    figures: tuple[str, ...] = ()
    #: Largest allowed value of some figures: a run beyond one is a failure
    limits: Mapping[str, float] = field(default_factory=dict)

    def summary(
        self, space: Space, points: Sequence[SweepPoint], results: Mapping[int, RunResult]
    ) -> dict[str, Any]:
        """Statistics of each group, JSON data.

        ``points``: those that have results; interrupted ones are left out.
        """
        ended = [p for p in points if results[p.number].state != "interrupted"]
        there = {name for p in ended for name in results[p.number].figures}
        names = [n for n in self.figures if any(_has(results[p.number], n) for p in ended)]
        if tracking_errors(self.figures) and not tracking_errors(names):
            names = [*tracking_errors(there), *names]  # those of a rig with other channels
        if not names and any(_has(results[p.number], MERIT) for p in ended):
            names = [MERIT]
        keys = [c.key for c in space.choices if c.key != _REPEATS and len(c.values) > 1]
        groups: dict[tuple[str, ...], list[SweepPoint]] = {}
        for point in ended:
            groups.setdefault(tuple(str(point.values[key]) for key in keys), []).append(point)
        statistics = [
            {"choices": dict(zip(keys, values, strict=True))}
            | self._of_group(space, members, results, names)
            for values, members in groups.items()
        ]
        if len(statistics) > 1:
            for name in names:
                shares = _best_shares(space, list(groups.values()), results, name)
                for group, share in zip(statistics, shares, strict=True):
                    if name in group["figures"]:
                        group["figures"][name]["best_share"] = share
        return {
            "kind": "robustness",
            "confidence": CONFIDENCE,
            "varied": [varied.key for varied in space.continuous],
            "figures": {name: {"unit": unit_of(name, there)} for name in names},
            "limits": dict(self.limits),
            "groups": statistics,
        }

    def _of_group(
        self,
        space: Space,
        points: Sequence[SweepPoint],
        results: Mapping[int, RunResult],
        names: Sequence[str],
    ) -> dict[str, Any]:
        lost_runs = sum(results[p.number].state == "lost" for p in points)
        draws: dict[tuple[Any, ...], list[RunResult]] = {}
        for point in points:
            if results[point.number].state != "lost":
                draw = tuple(point.values[varied.key] for varied in space.continuous)
                draws.setdefault(draw, []).append(results[point.number])
        # Runs of one draw are not independent: what is counted are draws.
        failed = {draw for draw, own in draws.items() if any(r.state != "done" for r in own)}
        beyond = {
            name: {
                draw
                for draw, own in draws.items()
                if draw not in failed and any(_beyond(figure_of(r, name), bound) for r in own)
            }
            for name, bound in self.limits.items()
        }
        count = len(failed.union(*beyond.values()))
        failures: dict[str, Any] = {
            "draws": len(draws),
            "count": count,
            "failed_runs": len(failed),
            "beyond": {name: len(members) for name, members in beyond.items()},
        }
        figures = {name: _of_draws(draws, name) for name in names}
        return {
            "runs": sum(map(len, draws.values())),
            "lost": lost_runs,
            "failures": failures | _share(count, len(draws)),
            "figures": {
                name: _distribution(np.array(list(sample.values())))
                for name, sample in figures.items()
                if sample
            },
            "sensitivity": _sensitivity(space, figures),
        }


def _of_draws(
    draws: Mapping[tuple[Any, ...], Sequence[RunResult]], name: str
) -> dict[tuple[Any, ...], float]:
    """A figure of each draw, the mean over its runs; without those of which none has it."""
    figures = {}
    for draw, own in draws.items():
        values = [value for r in own if (value := figure_of(r, name)) is not None]
        if values:
            figures[draw] = float(np.mean(values))
    return figures


def _has(result: RunResult, name: str) -> bool:
    return figure_of(result, name) is not None


def _beyond(figure: float | None, bound: float) -> bool:
    """What has no figure to be judged by (a step that never settled) does not hold the limit."""
    return figure is None or figure > bound


def _share(count: int, runs: int) -> dict[str, float | None]:
    """A share with its Clopper-Pearson interval, which holds at least its confidence."""
    from scipy.stats import binomtest

    if not runs:
        return {"share": None, "low": None, "high": None}
    interval = binomtest(count, runs).proportion_ci(CONFIDENCE, method="exact")
    return {"share": count / runs, "low": float(interval.low), "high": float(interval.high)}


def _distribution(values: np.ndarray[Any, np.dtype[np.float64]]) -> dict[str, Any]:
    return {
        "draws": int(values.size),
        "mean": float(values.mean()),
        "sd": float(values.std(ddof=1)) if values.size > 1 else None,
        "min": float(values.min()),
        **{name: float(np.quantile(values, share)) for name, share in _QUANTILES.items()},
        "max": float(values.max()),
        "percentiles": [float(q) for q in np.quantile(values, _PERCENTILES)],
    }


def _sensitivity(
    space: Space, figures: Mapping[str, Mapping[tuple[Any, ...], float]]
) -> list[dict[str, Any]]:
    """Spearman's rank correlation of each drawn value with each figure, strongest first.

    ``p`` is adjusted for their number (Benjamini and Hochberg): of those called correlated by
    p < 0.05 at most one in twenty is expected not to be.
    """
    from scipy.stats import false_discovery_control, spearmanr

    correlations: list[dict[str, Any]] = []
    for name, sample in figures.items():
        if len(sample) < _FEWEST or np.ptp(list(sample.values())) == 0:
            continue
        draws = np.array(list(sample), dtype=float)
        for column, varied in enumerate(space.continuous):
            if np.ptp(draws[:, column]) > 0:
                rho, p = spearmanr(draws[:, column], list(sample.values()))
                correlations.append(
                    {"key": varied.key, "figure": name, "rho": float(rho), "p": float(p)}
                )
    if correlations:
        adjusted = false_discovery_control([each["p"] for each in correlations])
        for each, p in zip(correlations, adjusted, strict=True):
            each["p"] = float(p)
    return sorted(correlations, key=lambda each: -abs(each["rho"]))


def _best_shares(
    space: Space,
    groups: Sequence[Sequence[SweepPoint]],
    results: Mapping[int, RunResult],
    name: str,
) -> list[float | None]:
    """Share of the samples on which each group has the smallest figure; failures lose."""
    keys = [varied.key for varied in space.continuous] + [_REPEATS]
    tables = [
        {tuple(p.values.get(key) for key in keys): figure_of(results[p.number], name) for p in each}
        for each in groups
    ]
    shared = set(tables[0]).intersection(*tables[1:])
    wins = [0] * len(groups)
    contested = 0
    for sample in shared:
        row = [table[sample] for table in tables]
        present = [value for value in row if value is not None]
        if present:
            contested += 1
            wins[row.index(min(present))] += 1
    return [win / contested if contested else None for win in wins]


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
    return np.array([round_within(varied, float(value)) for value in values])


def _uniform(varied: Range, low: float, high: float, shares: FloatArray) -> FloatArray:
    from scipy import stats

    if varied.logarithmic:
        return np.asarray(stats.loguniform.ppf(shares, low, high))
    return np.asarray(stats.uniform.ppf(shares, low, high - low))


def round_within(varied: Range | PriorOfKey, value: float) -> float:
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


def sample_part(continuous: Sequence[Range | PriorOfKey], row: Sequence[float]) -> Part:
    """The part of a point that gives each range and prior one value."""
    values = {
        varied.key: as_data(varied, value) for varied, value in zip(continuous, row, strict=True)
    }
    return Part(tuple(f"{key}={value!r}" for key, value in values.items()), values)


def choice_part(choices: Sequence[Choice], number: int) -> Part:
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


def choice_parts(choices: Sequence[Choice]) -> Iterator[Part]:
    """Every combination, the last choice varying fastest."""
    return (choice_part(choices, number) for number in range(combinations(choices)))


@dataclass
class PlannedPoints:
    """The points of a sweep whose samples are all drawn at its beginning.

    Every combination of choices sees every sample, and those of one sample follow each other: a
    sweep that was stopped has compared like with like.
    """

    space: Space
    #: (n, d) array; values of the ranges and priors; n = 1 and d = 0 for a grid
    samples: FloatArray
    proposed_count: int = 0  #: Points that have been proposed
    robustness: Robustness | None = None  #: What is told of the samples at the end

    @property
    def total(self) -> int:
        """Points in all."""
        return len(self.samples) * self._combinations

    @cached_property
    def _combinations(self) -> int:
        return combinations(self.space.choices)

    def point(self, number: int) -> SweepPoint:
        """The point of a number."""
        sample, choice = divmod(number, self._combinations)
        chosen = choice_part(self.space.choices, choice)
        drawn = sample_part(self.space.continuous, self.samples[sample].tolist())
        return SweepPoint(
            number,
            (*self.space.fixed, *chosen.overrides, *drawn.overrides),
            {**(chosen.values or {}), **(drawn.values or {})},
        )

    def more(self, results: Sequence[RunResult], count: int) -> list[SweepPoint]:
        """The next points; results change nothing."""
        upto = min(self.proposed_count + max(count, 0), self.total)
        points = [self.point(number) for number in range(self.proposed_count, upto)]
        self.proposed_count = upto
        return points

    def summary(self, results: Mapping[int, RunResult]) -> dict[str, Any]:
        """Statistics over the samples; nothing of a grid."""
        if self.robustness is None:
            return {}
        points = [self.point(number) for number in sorted(results) if number < self.total]
        return self.robustness.summary(self.space, points, results)


def another_point(earlier_point: SweepPoint, keys: str) -> ConfigurationError:
    """The sweep was begun with another configuration."""
    return ConfigurationError(
        f"point {earlier_point.number} was another when the sweep began: "
        f"{' '.join(earlier_point.overrides)}",
        where="sampler",
        remedy=f"resume with {keys} that it began with, or begin a new sweep",
    )


def plan_points(
    space: Space,
    shares: FloatArray,
    earlier_points: Sequence[SweepPoint],
    robustness: Robustness | None = None,
) -> PlannedPoints:
    """Points of samples at given shares of the distributions, those that are known left out.

    ``shares``: (n, d) array; points of the unit cube, a column for each range and prior. Raises
    ConfigurationError if the points that are known are others: the sweep was begun with another
    configuration.
    """
    samples = shares.copy()
    for column, varied in enumerate(space.continuous):
        samples[:, column] = quantiles(varied, shares[:, column])
    proposals = PlannedPoints(space, samples, robustness=robustness)
    for point in earlier_points:
        if point.number >= proposals.total or proposals.point(point.number) != point:
            raise another_point(point, "the samples and the seed")
    proposals.proposed_count = len(earlier_points)
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

    def start(self, space: Space, earlier_points: Sequence[SweepPoint] = ()) -> PlannedPoints:
        """Begin, or go on; see :class:`trms_cli.sweeps.plugins.Sampler`.

        Raises ConfigurationError for a space in which there is nothing to draw, and for a figure
        that runs do not have.
        """
        if not space.continuous:
            keys = ", ".join(choice.key for choice in space.choices) or "what was typed"
            raise ConfigurationError(
                f"nothing is drawn: no range and no prior among {keys}",
                where="sampler",
                remedy=f"give {self.NAME} something: plant.parameters=prior or "
                "KEY=interval(LOW,HIGH); choices alone are tried one by one by sampler=grid",
            )
        robustness = Robustness(
            canonical_all(self.figures, "sampler.figures"),
            canonical_limits(self.limits, "sampler.limits"),
        )
        return plan_points(space, self.shares(len(space.continuous)), earlier_points, robustness)
