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
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from functools import cached_property
from statistics import NormalDist

import numpy as np

from trms_cli.core.arrays import BoolArray, FloatArray, IntArray
from trms_cli.core.errors import ConfigurationError
from trms_cli.scoring.comparison.runs import (
    FIGURES,
    ComparisonRun,
    FlatConfiguration,
    State,
    differing_coordinates,
)
from trms_cli.scoring.figures import Group

#: Coordinates of who ran; the others are of what was run in.
OF_ENTRANTS = ("controller", "observer", "model", "supervisor", "qp_solver")
#: The key of a rig's own model.
_EQUATIONS = "plant.model"
#: Keys of true values of a rig; as many as this are named together.
RIG_PARAMETERS, FEWEST_GATHERED = "plant.parameters.", 6


@dataclass(frozen=True, kw_only=True)
class ComparisonGroup:
    """Entrants × conditions."""

    by: tuple[str, ...]  #: Coordinates that name an entrant
    given_by: tuple[str, ...]  #: Coordinates that name a condition, of those in which runs differ
    entrants: tuple[str, ...]  #: Names
    outside: tuple[str, ...]  #: Per entrant, why it is not ranked; "" if it is
    conditions: tuple[Mapping[str, str], ...]  #: Coordinates of each condition
    #: The runs of an entrant in a condition: one, or repetitions of one another
    cells: Mapping[tuple[int, int], tuple[ComparisonRun, ...]]

    def run(self, entrant: int, condition: int) -> ComparisonRun:
        """One run of a cell: a failed one if there is one."""
        runs = self.cells[entrant, condition]
        return next((run for run in runs if run.state is State.FAILED), runs[0])

    def errors(self, metric: str) -> FloatArray:
        """Tracking errors (entrants, conditions): NaN where nobody ran, inf for a failed run."""
        table = np.full((len(self.entrants), len(self.conditions)), np.nan)
        for place, runs in self.cells.items():
            if any(run.state is State.FAILED for run in runs):
                table[place] = math.inf
            elif len(runs) == 1:
                table[place] = runs[0].error(metric)
            else:
                table[place] = np.mean([run.error(metric) for run in runs])
        return table

    @cached_property
    def rigs_differ(self) -> bool:
        """Whether runs of one condition had rigs of other equations, each its own model's."""
        rigs: dict[int, set[tuple[tuple[str, str], ...]]] = {}
        shared: dict[int, tuple[tuple[str, str], ...]] = {}
        for (_, condition), runs in self.cells.items():
            for run in runs:
                if run.settings is None and not run.config and not run.typed:
                    continue  # of which nothing is known
                own = run.flat_settings()
                is_own = any(key.startswith(_EQUATIONS) for key in own.changes)
                if is_own or run.settings is None:
                    equations = own.below(_EQUATIONS)
                else:  # of all runs with this base, which lives as long as they do
                    equations = shared.get(id(own.base)) or FlatConfiguration(own.base).below(
                        _EQUATIONS
                    )
                    shared[id(own.base)] = equations
                if equations and equations != ((_EQUATIONS, "none"),) and not own.is_partial:
                    rigs.setdefault(condition, set()).add(equations)
        return any(len(models) > 1 for models in rigs.values())

    def condition_name(self, condition: int) -> str:
        """In what it differs from the others."""
        return self._condition_name(condition, self.given_by)

    def brief_condition_name(self, condition: int) -> str:
        """In what it differs, but where many parameters of the rig do, which condition it is."""
        keys = [key for key in self.given_by if not key.startswith(RIG_PARAMETERS)]
        if len(self.given_by) - len(keys) < FEWEST_GATHERED:
            return self.condition_name(condition)
        others = [self._condition_name(condition, keys)] if keys else []
        return ", ".join([*others, f"rig {self.clusters()[condition] + 1}"])

    def _condition_name(self, condition: int, keys: Sequence[str]) -> str:
        coordinates = self.conditions[condition]
        parts = []
        for key in keys:
            if coordinates[key] not in ("", "–", "none"):
                name = key.rpartition(".")[2]
                parts.append(
                    f"{name} {coordinates[key]}"
                    if "." in key or name == "seed"
                    else coordinates[key]
                )
        return ", ".join(parts) or "the same for all"

    def clusters(self) -> IntArray:
        """Which rig each condition is of: all but the reference."""
        rigs: dict[tuple[tuple[str, str], ...], int] = {}
        indices = []
        for condition in self.conditions:
            key = tuple(
                (name, condition[name]) for name in self.given_by if not _of_reference(name)
            )
            indices.append(rigs.setdefault(key, len(rigs)))
        return np.array(indices, dtype=np.int64)


def group(runs: Sequence[ComparisonRun], by: Sequence[str] = ()) -> ComparisonGroup:
    """Sort runs that count, which incomplete ones do not, by who ran and in what.

    ``by``: coordinates that name an entrant; by default those of controller, observer and model in
    which the runs differ, and where they do not, all in which they do. Raises ConfigurationError if
    it names a coordinate that there is not.
    """
    counted = [run for run in runs if run.state.ranked]
    differ = differing_coordinates(counted)
    for key in by:
        _require_coordinate(key, counted, "--by")
    coordinate_names = {key for run in counted for key in run.coordinates}
    entrant_keys = tuple(by) or tuple(
        key for key in usual_entrants(differ) if key in coordinate_names
    )
    condition_keys = tuple(key for key in differ if key not in entrant_keys)
    entrants: dict[str, int] = {}
    outside: list[str] = []
    conditions: dict[tuple[str, ...], int] = {}
    cells: dict[tuple[int, int], list[ComparisonRun]] = {}
    for run in counted:
        name = controller_name(run.coordinates, entrant_keys, condition_keys)
        if name not in entrants:
            entrants[name] = len(entrants)
            outside.append(run.outside)
        condition = tuple(run.coordinates.get(key, "") for key in condition_keys)
        place = entrants[name], conditions.setdefault(condition, len(conditions))
        cells.setdefault(place, []).append(run)
    return ComparisonGroup(
        by=entrant_keys,
        given_by=condition_keys,
        entrants=tuple(entrants),
        outside=tuple(outside),
        conditions=tuple(
            dict(zip(condition_keys, condition, strict=True)) for condition in conditions
        ),
        cells={place: tuple(members) for place, members in cells.items()},
    )


def _require_coordinate(key: str, runs: Sequence[ComparisonRun], where: str) -> None:
    coordinate_names = dict.fromkeys(key for run in runs for key in run.coordinates)
    if key not in coordinate_names:
        there = f"there are: {', '.join(coordinate_names)}"
        raise ConfigurationError(f"the runs have no {key!r}", where=where, remedy=there)


def usual_entrants(differ: Sequence[str]) -> tuple[str, ...]:
    """Coordinates that name who ran, of those in which runs differ."""
    own = [key for key in differ if _stem(key) in OF_ENTRANTS]
    # a setting is named with the option that has it
    return tuple(dict.fromkeys(part for key in own for part in (_stem(key), key))) or tuple(differ)


def controller_name(
    coordinates: Mapping[str, str], by: Sequence[str], condition_keys: Sequence[str] = ()
) -> str:
    """``newton_mpc + ukf``, and the settings in which it differs: ``max_iterations=1``."""
    parts = []
    for key in by:
        value = coordinates.get(key, "")
        if "." not in key:
            parts.append(value if key in OF_ENTRANTS or not condition_keys else f"{key} {value}")
        elif value not in ("", "–"):
            parts.append(f"{key.partition('.')[2]}={value}")
    return " + ".join(parts) or "all runs"


def matching_runs(
    runs: Sequence[ComparisonRun], where: Mapping[str, Sequence[str]]
) -> list[ComparisonRun]:
    """The runs whose coordinates match patterns, as a shell matches file names.

    Raises ConfigurationError if a coordinate is unknown, or nothing is left.
    """
    matches = list(runs)
    for key, patterns in where.items():
        values = dict.fromkeys(run.coordinates.get(key, "") for run in matches)
        _require_coordinate(key, matches, "--where")
        matches = [
            run
            for run in matches
            if any(fnmatchcase(run.coordinates.get(key, ""), pattern) for pattern in patterns)
        ]
        if not matches:
            raise ConfigurationError(
                f"no run has {key} {', '.join(patterns)}",
                where="--where",
                remedy=f"there are: {', '.join(values)}",
            )
    return matches


def _stem(key: str) -> str:
    return key.partition(".")[0].partition("@")[0]


def _of_reference(key: str) -> bool:
    return "ref" in (_stem(key), key.partition("@")[2].partition(".")[0])


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


@dataclass(frozen=True, kw_only=True)
class Standing:
    """How an entrant stands."""

    name: str
    rank: int | None  #: From 1; None outside the ranking, or in too few conditions
    outside: str  #: Why it is outside; "" if it is not
    runs: tuple[ComparisonRun, ...]  #: Its runs that count, in the order of the conditions
    conditions: IntArray  #: (n,) int array; which conditions they were in
    ratios: FloatArray  #: (n,) array; error over the best ranked entrant's in that condition
    ratio: float  #: Their geometric mean
    interval: RatioInterval | None = None  #: None with fewer rigs than :data:`FEWEST_CLUSTERS`
    #: Error over the first's, geometric mean over the conditions that both ran in; NaN without
    against_first: float = math.nan
    against_interval: RatioInterval | None = None
    shared: int = 0  #: How many conditions it shares with the first
    #: By metric, once they were asked for
    figures: dict[str, Figures] = field(default_factory=dict, compare=False, repr=False)

    @cached_property
    def _ended(self) -> FloatArray:
        """Of the runs that did not fail all of FIGURES, a column each; NaN for what is not."""
        rows = [run.row() for run in self.runs if run.state is not State.FAILED]
        return np.array(rows, dtype=float).reshape(len(rows), len(FIGURES))

    def column(self, group: Group, key: str) -> FloatArray:
        """A figure of each run that did not fail; NaN for those without."""
        return self._ended[:, FIGURES[group, key]]

    @property
    def different(self) -> bool | None:
        """Whether it is told from the first; None where that cannot be said."""
        interval = self.against_interval
        return None if interval is None else interval.low > 1.0 or interval.high < 1.0


@dataclass(frozen=True, kw_only=True)
class Ranking:
    """The entrants of a contest in order."""

    metric: str  #: Which error, summed over the channels
    contest: ComparisonGroup  #: Entrants and conditions
    standings: tuple[Standing, ...]  #: Ranked ones first, in order; then the others by their ratio
    #: By condition, the entrant with the smallest error among those that may be ranked
    best: Mapping[int, str] = field(default_factory=dict)
    clusters: int = 0  #: Rigs that were drawn again
    left_out: int = 0  #: Conditions not counted, since not all of the ranked were in

    @property
    def first(self) -> Standing | None:
        """The entrant of rank 1; None if nobody is ranked."""
        return next((standing for standing in self.standings if standing.rank == 1), None)

    @property
    def ranked(self) -> tuple[Standing, ...]:
        """Those with a rank."""
        return tuple(standing for standing in self.standings if standing.rank is not None)


def rank(runs: ComparisonGroup, metric: str = "rmse", *, resamples: int = RESAMPLES) -> Ranking:
    """Rank the entrants by a metric of :func:`trms_cli.scoring.figures.metrics`."""
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
    against = [_against(ratios, i, first) for i in order]
    intervals = _intervals(
        [*(np.log(ratios[i]) for i in order), *(versus for versus, _ in against)],
        clusters,
        resamples,
    )
    standings = []
    for place, i in enumerate(order):
        there = np.flatnonzero(ran[i])
        versus, shared = against[place]
        standings.append(
            Standing(
                name=runs.entrants[i],
                rank=place + 1 if whole[i] else None,
                outside=runs.outside[i],
                runs=tuple(runs.run(i, c) for c in there.tolist()),
                conditions=there,
                ratios=ratios[i, there],
                ratio=float(means[i]),
                interval=intervals[place],
                against_first=_geometric(np.exp(versus[shared])),
                against_interval=None if i == first else intervals[len(order) + place],
                shared=int(shared.sum()),
            )
        )
    conditions = np.flatnonzero(np.isfinite(floor))
    bests = allowed[:, conditions].argmin(axis=0) if conditions.size else conditions
    best = {c: runs.entrants[i] for c, i in zip(conditions.tolist(), bests.tolist(), strict=True)}
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


def _against(ratios: FloatArray, i: int, first: int | None) -> tuple[FloatArray, BoolArray]:
    """Logarithm of the ratio to the first by condition, and where both ran."""
    if first is None:
        return np.full(ratios.shape[1], np.nan), np.zeros(ratios.shape[1], dtype=bool)
    with np.errstate(invalid="ignore", divide="ignore"):
        versus = np.log(ratios[i]) - np.log(ratios[first])
    return versus, ~np.isnan(versus)


#: Clusters from which a mean over them is as good as normal: the interval's ends are then known
#: better than from resamples, whose quantiles have a scatter of a twentieth of its width.
_MANY_CLUSTERS = 2000


def _intervals(
    rows: Sequence[FloatArray], clusters: IntArray, resamples: int
) -> list[RatioInterval | None]:
    """Of the geometric mean of exp(row), clusters drawn again, the same for all rows.

    NaN is left out. None for a row with fewer clusters than :data:`FEWEST_CLUSTERS`.
    """
    count = int(clusters.max()) + 1 if clusters.size else 0
    sums, sizes = np.zeros((2, len(rows), count))
    for place, logs in enumerate(rows):
        present = ~np.isnan(logs)
        sums[place] = np.bincount(clusters[present], logs[present], minlength=count)
        sizes[place] = np.bincount(clusters[present], minlength=count)
    places = np.flatnonzero(np.count_nonzero(sizes, axis=1) >= FEWEST_CLUSTERS)
    known: dict[int, RatioInterval] = {}
    if count > _MANY_CLUSTERS:
        known = {int(row): _normal_interval(sums[row], sizes[row]) for row in places}
    elif places.size:
        generator = np.random.default_rng(SEED)
        # (resamples, clusters): how often each cluster is drawn
        shares = np.full(count, 1.0 / count)
        draws = generator.multinomial(count, shares, size=resamples).astype(float)
        known = {int(row): _interval(draws @ sums[row], draws @ sizes[row]) for row in places}
    return [known.get(place) for place in range(len(rows))]


def _normal_interval(sums: FloatArray, sizes: FloatArray) -> RatioInterval:
    """The same of very many clusters: a ratio of totals, linearised (Cochran 1977, ch. 6)."""
    mean = sums.sum() / sizes.sum()
    error = float(np.sqrt(np.sum((sums - mean * sizes) ** 2))) / sizes.sum()
    reach = NormalDist().inv_cdf((1.0 + LEVEL) / 2.0) * error
    return RatioInterval(low=float(np.exp(mean - reach)), high=float(np.exp(mean + reach)))


def _interval(totals: FloatArray, weights: FloatArray) -> RatioInterval:
    usable = weights > 0
    means = totals[usable] / weights[usable]
    tail = (1.0 - LEVEL) / 2.0
    low, high = np.exp(np.quantile(means, [tail, 1.0 - tail]))
    return RatioInterval(low=float(low), high=float(high))


def _geometric(values: FloatArray) -> float:
    return float(np.exp(np.mean(np.log(values)))) if values.size else math.nan


def quantile(values: Sequence[float] | FloatArray, share: float) -> float:
    """A quantile of the finite values; NaN without any."""
    present = _finite(values)
    return float(np.quantile(present, share)) if present.size else math.nan


@dataclass(frozen=True, kw_only=True)
class Figures:
    """Figures of one entrant over its runs; NaN for what no run tells."""

    runs: int  #: Those that count
    error_mean: float  #: Of tracking, in the metric's unit, of the runs that did not fail
    error_p95: float  #: likewise
    error_worst: float  #: likewise
    ratio_p95: float  #: Error over the best in the same condition
    ratio_worst: float  #: a failed run counts as `FAILED_RATIO` or more
    effort: float  #: Mean of ∫u²dt, both inputs added, V² s
    variation: float  #: Mean of Σ|Δu|, both inputs added, V
    step_ms: float  #: Time of a control step: median of the runs' medians, ms
    step_p99_ms: float  #: Median of their 99th percentiles, ms
    step_max_ms: float  #: The longest of all, ms
    failed: int  #: Runs that ended in an error
    non_finite: int | None  #: Commands that were not finite; None where nobody counted
    fallbacks: int  #: Control samples on which the solver failed or a fall-back acted
    degraded_s: float  #: Time in which the loop was not normal, s in all runs
    degraded_runs: int  #: and in how many
    missed: int  #: Deadlines
    violations: int  #: Samples beyond a limit


def figures_of(standing: Standing, metric: str = "rmse") -> Figures:
    """Sum up the runs of an entrant."""
    if metric not in standing.figures:
        standing.figures[metric] = _summed(standing, metric)
    return standing.figures[metric]


def _summed(standing: Standing, metric: str) -> Figures:
    runs, column = standing.runs, standing.column
    errors, degraded = column("channels", metric), column("run", "degraded")
    counted = [run.non_finite for run in runs if run.non_finite is not None]
    return Figures(
        runs=len(runs),
        error_mean=mean(errors),
        error_p95=quantile(errors, 0.95),
        error_worst=_largest(errors),
        ratio_p95=quantile(standing.ratios, 0.95),
        ratio_worst=_largest(standing.ratios),
        effort=mean(column("inputs", "effort")),
        variation=mean(column("inputs", "total_variation")),
        step_ms=quantile(column("solver", "time_ms.median"), 0.5),
        step_p99_ms=quantile(column("solver", "time_ms.p99"), 0.5),
        step_max_ms=_largest(column("solver", "time_ms.max")),
        failed=len(runs) - len(errors),
        non_finite=sum(counted) if counted else None,
        fallbacks=int(_sum(column("solver", "failures"))),
        degraded_s=_sum(degraded),
        degraded_runs=int(np.count_nonzero(degraded > 0)),
        missed=int(_sum(column("solver", "deadline_misses"))),
        violations=int(_sum(column("run", "violations"))),
    )


def worst_condition(standing: Standing, names: Callable[[int], str]) -> str:
    """Where its ratio is largest; "" without any."""
    if not standing.ratios.size:
        return ""
    return names(int(standing.conditions[int(np.argmax(standing.ratios))]))


def _finite(values: Sequence[float] | FloatArray) -> FloatArray:
    numbers = np.asarray(values, dtype=float)
    return numbers[np.isfinite(numbers)]


def _sum(values: FloatArray) -> float:
    return math.fsum(_finite(values).tolist())


def mean(values: FloatArray) -> float:
    """Of the finite values; NaN without any."""
    count = np.count_nonzero(np.isfinite(values))
    return _sum(values) / int(count) if count else math.nan


def _largest(values: FloatArray) -> float:
    present = _finite(values)
    return float(present.max()) if present.size else math.nan
