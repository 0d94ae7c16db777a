"""What an entrant's runs come to: tracking, effort, robustness, time of a step, failures."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from trms_cli.scoring.comparison.compared_run import ComparedRun, State
from trms_cli.scoring.comparison.ranking import Standing, quantile


@dataclass(frozen=True, kw_only=True)
class Figures:
    """Figures of one entrant over its runs; NaN for what no run tells."""

    runs: int  #: Those that count
    #: ``error_mean``, ``error_p95``, ``error_worst``: Tracking error in the metric's unit, of the
    #: runs that did not fail
    error_mean: float
    error_p95: float
    error_worst: float
    ratio_p95: float  #: Error over the best in the same condition
    ratio_worst: float  #: a failed run counts as `FAILED_RATIO` or more
    #: ``effort``, ``variation``: Mean of ∫u²dt (V² s) and of Σ|Δu| (V), both inputs added
    effort: float
    variation: float
    #: ``step_ms``, ``step_p99_ms``: Time of a control step: median of the runs' medians, median of
    #: their 99th percentiles, ms
    step_ms: float
    step_p99_ms: float
    step_max_ms: float  #: The longest of all, ms
    failed: int  #: Runs that ended in an error
    non_finite: int | None  #: Commands that were not finite; None where nobody counted
    fallbacks: int  #: Control samples on which the solver failed or a fall-back acted
    #: ``degraded_s``, ``degraded_runs``: Time in which the loop was not normal, s in all runs, and
    #: in how many
    degraded_s: float
    degraded_runs: int
    missed: int  #: Deadlines
    violations: int  #: Samples beyond a limit


def figures_of(standing: Standing, metric: str = "rmse") -> Figures:
    """Sum up the runs of an entrant."""
    runs = standing.runs
    ended = [run for run in runs if run.state is not State.FAILED]
    errors = [run.error(metric) for run in ended]
    counted = [run.non_finite for run in runs if run.non_finite is not None]
    degraded = [run.of_run("degraded") for run in ended]
    return Figures(
        runs=len(runs),
        error_mean=_mean(errors),
        error_p95=quantile(errors, 0.95),
        error_worst=_largest(errors),
        ratio_p95=quantile(standing.ratios, 0.95),
        ratio_worst=_largest(standing.ratios),
        effort=_mean(run.input_sum("effort") for run in ended),
        variation=_mean(run.input_sum("total_variation") for run in ended),
        step_ms=_median(ended, lambda run: run.step_time("median")),
        step_p99_ms=_median(ended, lambda run: run.step_time("p99")),
        step_max_ms=_largest([run.step_time("max") for run in ended]),
        failed=len(runs) - len(ended),
        non_finite=sum(counted) if counted else None,
        fallbacks=_count(run.solver("failures") for run in ended),
        degraded_s=math.fsum(value for value in degraded if math.isfinite(value)),
        degraded_runs=sum(value > 0 for value in degraded),
        missed=_count(run.solver("deadline_misses") for run in ended),
        violations=_count(run.of_run("violations") for run in ended),
    )


def worst_condition(standing: Standing, names: Callable[[int], str]) -> str:
    """Where its ratio is largest; "" without any."""
    if not standing.ratios.size:
        return ""
    return names(int(standing.conditions[int(np.argmax(standing.ratios))]))


def _mean(values: Iterable[float]) -> float:
    present = [value for value in values if math.isfinite(value)]
    return math.fsum(present) / len(present) if present else math.nan


def _median(runs: Sequence[ComparedRun], figure: Callable[[ComparedRun], float]) -> float:
    return quantile([figure(run) for run in runs], 0.5)


def _largest(values: Iterable[float]) -> float:
    return max((float(value) for value in values if math.isfinite(value)), default=math.nan)


def _count(values: Iterable[float]) -> int:
    return int(math.fsum(value for value in values if math.isfinite(value)))
