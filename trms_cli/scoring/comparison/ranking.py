"""Ranks who ran in the same conditions, with intervals.

The measure is the tracking error of a run over the best entrant's in the same *condition* (same
reference, rig and seed: everything that does not name the entrant). It is a pure number, so that
a hard rig counts no more than an easy one; the mean is the geometric one, for which it makes no
difference which entrant the errors are held against. A run that failed counts as
:data:`FAILED_RATIO` times the best, or as the worst of its condition if that is more.

Intervals are of the percentile bootstrap: rigs (conditions but for their reference, whose runs
share a rig's quirks and are not independent) are drawn again with replacement, for all entrants
the same ones, which keeps the pairing. Efron & Tibshirani, An Introduction to the Bootstrap, 1993,
chapter 13.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from trms_cli.scoring.comparison.compared_run import ComparedRun, State
from trms_cli.scoring.comparison.grouping import ComparisonGroup

FloatArray = npt.NDArray[np.float64]

FAILED_RATIO = 10.0
RESAMPLES, SEED, LEVEL = 2000, 0, 0.95
#: Who was in fewer of the conditions than this share of the busiest entrant's is not ranked; the
#: others are ranked on the conditions that all of them were in.
SHARE_TO_BE_RANKED = 0.8
#: With fewer rigs, drawing them again tells nothing about others.
FEWEST_CLUSTERS = 5


@dataclass(frozen=True, kw_only=True)
class RatioInterval:
    """Of the bootstrap, at :data:`LEVEL`."""

    low: float  #: ends of the interval
    high: float  #: ends of the interval

    @property
    def excludes_one(self) -> bool:
        """Whether a ratio with this interval is told from equality."""
        return self.low > 1.0 or self.high < 1.0


@dataclass(frozen=True, kw_only=True)
class Standing:
    """How an entrant stands."""

    name: str
    #: From 1; None for one that is outside the ranking, or was in too few conditions
    rank: int | None
    outside: str  #: Why it is outside; "" if it is not
    runs: tuple[ComparedRun, ...]  #: Its runs that count, in the order of the conditions
    conditions: npt.NDArray[np.int64]  #: (n,) int array; which conditions they were in
    ratios: FloatArray  #: (n,) array; error over the best ranked entrant's in that condition
    ratio: float  #: Their geometric mean
    #: Of `ratio`; None with fewer rigs than :data:`FEWEST_CLUSTERS`
    interval: RatioInterval | None = None
    #: Error over the first's, geometric mean over the conditions that both ran in; NaN without
    against_first: float = math.nan
    against_interval: RatioInterval | None = None
    shared: int = 0  #: How many conditions it shares with the first

    @property
    def different(self) -> bool | None:
        """Whether it is told from the first; None where that cannot be said."""
        found = self.against_interval
        return None if found is None else found.excludes_one

    @property
    def failed(self) -> int:
        """Runs that failed."""
        return sum(run.state is State.FAILED for run in self.runs)


@dataclass(frozen=True, kw_only=True)
class Ranking:
    """The entrants of a contest in order."""

    metric: str  #: Which error, summed over the channels
    contest: ComparisonGroup  #: Entrants and conditions
    standings: tuple[Standing, ...]  #: Ranked ones first, in order; then the others by their ratio
    #: By condition, the entrant with the smallest error among those that may be ranked
    best: Mapping[int, str] = field(default_factory=dict)
    clusters: int = 0  #: Rigs that were drawn again
    #: Conditions that are not counted for those with a rank, since not all of them were in
    left_out: int = 0

    @property
    def first(self) -> Standing | None:
        """The entrant of rank 1; None if nobody is ranked."""
        return next((standing for standing in self.standings if standing.rank == 1), None)

    @property
    def ranked(self) -> tuple[Standing, ...]:
        """Those with a rank."""
        return tuple(standing for standing in self.standings if standing.rank is not None)


def rank(runs: ComparisonGroup, metric: str = "rmse", *, resamples: int = RESAMPLES) -> Ranking:
    """Rank the entrants of a contest.

    Parameters
    ----------
    runs : ComparisonGroup
    metric : str
        One of :func:`trms_cli.scoring.figures.metrics`.
    resamples : int
        Of the bootstrap.
    """
    errors = runs.errors(metric)  # (entrants, conditions), NaN where nobody ran, inf for failures
    inside = np.array([not outside for outside in runs.outside], dtype=bool)
    allowed = np.where(np.isfinite(errors) & inside[:, None], errors, np.inf)
    if not np.isfinite(allowed).any():  # only outsiders: they are held against one another
        allowed = np.where(np.isfinite(errors), errors, np.inf)
    floor = allowed.min(axis=0) if allowed.size else np.zeros(0)
    ratios = _ratios(errors, floor)
    ran = ~np.isnan(ratios)
    most = int(ran[inside].sum(axis=1).max()) if inside.any() else 0
    whole = inside & (ran.sum(axis=1) >= SHARE_TO_BE_RANKED * most) & (most > 0)
    common = ran[whole].all(axis=0)
    if not common.any():
        whole = inside & (ran.sum(axis=1) == most)
        whole &= (ran == ran[np.argmax(whole)]).all(axis=1)
        common = ran[whole].all(axis=0)
    left_out = int(np.count_nonzero(ran[whole].any(axis=0) & ~common))
    ratios = np.where(whole[:, None] & ~common, np.nan, ratios)
    ran = ~np.isnan(ratios)
    means = np.array([_geometric(row[there]) for row, there in zip(ratios, ran, strict=True)])
    order = sorted(range(len(means)), key=lambda i: (not whole[i], bool(runs.outside[i]), means[i]))
    first = order[0] if order and whole[order[0]] else None
    clusters = runs.clusters()
    draws = _draws(clusters, resamples)
    standings = []
    for place, i in enumerate(order):
        there = np.flatnonzero(ran[i])
        versus, shared = _against(ratios, i, first)
        standings.append(
            Standing(
                name=runs.entrants[i],
                rank=place + 1 if whole[i] else None,
                outside=runs.outside[i],
                runs=tuple(runs.run(i, int(c)) for c in there),
                conditions=there,
                ratios=ratios[i, there],
                ratio=float(means[i]),
                interval=_interval(np.log(ratios[i]), clusters, draws),
                against_first=_geometric(np.exp(versus[shared])),
                against_interval=None if i == first else _interval(versus, clusters, draws),
                shared=int(shared.sum()),
            )
        )
    best = {
        c: runs.entrants[int(np.argmin(allowed[:, c]))]
        for c in range(len(floor))
        if np.isfinite(floor[c])
    }
    return Ranking(
        metric=metric,
        contest=runs,
        standings=tuple(standings),
        best=best,
        clusters=int(clusters.max()) + 1 if clusters.size else 0,
        left_out=left_out,
    )


def _ratios(errors: FloatArray, floor: FloatArray) -> FloatArray:
    """Errors over the best; a failure as bad as the worst there is, and at least FAILED_RATIO."""
    with np.errstate(invalid="ignore", divide="ignore"):
        base = np.where(np.isfinite(floor) & (floor > 0), floor, np.nan)
        ratios = errors / base
    finite = np.where(np.isfinite(ratios), ratios, -np.inf)
    worst = np.maximum(finite.max(axis=0, initial=FAILED_RATIO), FAILED_RATIO)
    failed = np.isinf(errors)
    return np.where(failed, worst, ratios)


def _against(
    ratios: FloatArray, i: int, first: int | None
) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """Logarithm of the ratio to the first by condition, and where both ran."""
    if first is None:
        return np.full(ratios.shape[1], np.nan), np.zeros(ratios.shape[1], dtype=bool)
    with np.errstate(invalid="ignore", divide="ignore"):
        versus = np.log(ratios[i]) - np.log(ratios[first])
    return versus, ~np.isnan(versus)


def _draws(clusters: npt.NDArray[np.int64], resamples: int) -> FloatArray:
    """How often each cluster is drawn, (resamples, clusters); the same for all entrants."""
    count = int(clusters.max()) + 1 if clusters.size else 0
    if count == 0:
        return np.zeros((resamples, 0))
    generator = np.random.default_rng(SEED)
    return generator.multinomial(count, np.full(count, 1.0 / count), size=resamples).astype(float)


def _interval(
    logs: FloatArray, clusters: npt.NDArray[np.int64], draws: FloatArray
) -> RatioInterval | None:
    """Of the geometric mean of exp(logs), clusters drawn again; NaN is left out."""
    present = ~np.isnan(logs)
    count = draws.shape[1]
    sums = np.bincount(clusters[present], logs[present], minlength=count)
    sizes = np.bincount(clusters[present], minlength=count).astype(float)
    if np.count_nonzero(sizes) < FEWEST_CLUSTERS:
        return None
    weights = draws @ sizes
    usable = weights > 0
    means = (draws @ sums)[usable] / weights[usable]
    tail = (1.0 - LEVEL) / 2.0
    low, high = np.exp(np.quantile(means, [tail, 1.0 - tail]))
    return RatioInterval(low=float(low), high=float(high))


def _geometric(values: FloatArray) -> float:
    return float(np.exp(np.mean(np.log(values)))) if values.size else math.nan


def quantile(values: Sequence[float] | FloatArray, share: float) -> float:
    """A quantile of the finite values; NaN without any."""
    present = np.asarray([value for value in values if math.isfinite(value)], dtype=float)
    return float(np.quantile(present, share)) if present.size else math.nan
