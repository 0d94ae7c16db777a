"""The JSON twin of a comparison: ``trms.compare/1``, or ``trms.compare_pair/1`` of two runs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from trms_cli.scoring.comparison import ranking as ranked
from trms_cli.scoring.comparison.compared_run import ComparedRun, State
from trms_cli.scoring.comparison.figures import figures_of, worst_condition
from trms_cli.scoring.comparison.gathering import RunCollection
from trms_cli.scoring.comparison.pair import Pair
from trms_cli.scoring.comparison.ranking import Ranking, RatioInterval, Standing
from trms_cli.scoring.figures import metrics

SCHEMA, PAIR_SCHEMA = "trms.compare/1", "trms.compare_pair/1"


def rule(ranking: Ranking) -> str:
    """How the rank comes about, in two sentences."""
    name = ranking.metric.upper() if ranking.metric != "max_abs_error" else "largest error"
    given = ", ".join(ranking.contest.given_by) or "condition"
    return (
        f"Ranked by tracking: the {name} of all channels added, over the best entrant's on the "
        f"same {given}; geometric mean over the runs. A failed run counts as the worst of its "
        f"condition, and at least as {ranked.FAILED_RATIO:g} times the best."
    )


def document(
    ranking: Ranking, gathered: RunCollection, shown: Sequence[Standing]
) -> dict[str, Any]:
    """``trms.compare/1``, the entrants in the order in which they are shown."""
    runs = gathered.runs
    return _finite(
        {
            "schema": SCHEMA,
            "rule": rule(ranking),
            "metric": ranking.metric,
            "by": list(ranking.contest.by),
            "conditions_by": list(ranking.contest.given_by),
            "runs": len(runs),
            "conditions_left_out": ranking.left_out,
            "conditions": [dict(told) for told in ranking.contest.conditions],
            "interval": {
                "of": "percentile bootstrap over rigs, paired",
                "level": ranked.LEVEL,
                "resamples": ranked.RESAMPLES,
                "seed": ranked.SEED,
                "rigs": ranking.clusters,
                "fewest_rigs": ranked.FEWEST_CLUSTERS,
            },
            "entrants": [_entrant(standing, ranking) for standing in shown],
            "failed": [_told(run) for run in runs if run.state is State.FAILED],
            "incomplete": [_told(run) for run in runs if run.state is State.INCOMPLETE],
            "left_out": [{"path": path, "problem": why} for path, why in gathered.left_out],
        }
    )


def pair_document(pair: Pair) -> dict[str, Any]:
    """``trms.compare_pair/1``."""
    return _finite(
        {
            "schema": PAIR_SCHEMA,
            "runs": [
                {**_told(run), "state": run.state.value, "score": run.score}
                for run in (pair.one, pair.other)
            ],
            "differences": [
                {"key": key, "values": [left, right]} for key, left, right in pair.settings
            ],
            "figures": [asdict(row) for row in pair.rows],
        }
    )


def _entrant(standing: Standing, ranking: Ranking) -> dict[str, Any]:
    told = asdict(figures_of(standing, ranking.metric))
    others = {metric: _mean(standing, metric) for metric in metrics() if metric != ranking.metric}
    errors = {name: told.pop(f"error_{name}") for name in ("mean", "p95", "worst")}
    return {
        "name": standing.name,
        "rank": standing.rank,
        "outside": standing.outside or None,
        "tracking": {
            "ratio": standing.ratio,
            "interval": _pair(standing.interval),
            "against_first": standing.against_first,
            "against_first_interval": _pair(standing.against_interval),
            "different_from_first": standing.different,
            "shared_with_first": standing.shared,
            "ratio_p95": told.pop("ratio_p95"),
            "ratio_worst": told.pop("ratio_worst"),
            "worst_condition": worst_condition(standing, ranking.contest.condition_name),
            "error": errors,
            "other_metrics_mean": others,
        },
        **told,
        "by_condition": [
            {
                "condition": int(condition),
                "error": run.error(ranking.metric),
                "ratio": float(ratio),
                "state": run.state.value,
                "path": run.path,
            }
            for condition, ratio, run in zip(
                standing.conditions, standing.ratios, standing.runs, strict=True
            )
        ],
    }


def _mean(standing: Standing, metric: str) -> float:
    values = [run.error(metric) for run in standing.runs if run.state is State.DONE]
    present = [value for value in values if math.isfinite(value)]
    return math.fsum(present) / len(present) if present else math.nan


def _told(run: ComparedRun) -> dict[str, Any]:
    return {"path": run.path, "coordinates": dict(run.coordinates), "message": run.message}


def _pair(interval: RatioInterval | None) -> list[float] | None:
    return None if interval is None else [interval.low, interval.high]


def _finite(value: Any) -> Any:
    """The same with null for what is not a finite number."""
    if isinstance(value, Mapping):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
