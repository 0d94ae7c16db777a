"""Runs gathered, ranked and put in order: what ``trms compare`` and reports rank by."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from trms_cli.core.errors import RecordingError
from trms_cli.scoring.figures import metrics

if TYPE_CHECKING:
    from trms_cli.scoring.comparison.ranking import Figures, Ranking, Standing
    from trms_cli.scoring.comparison.runs import RunCollection

METRICS = tuple(metrics())
SORTS = ("rank", "tracking", "worst", "effort", "variation", "time", "failures", "name")


def runs_from(paths: Sequence[Path], where: Mapping[str, Sequence[str]]) -> RunCollection:
    """The runs in files and folders, those alone that have certain values of their keys.

    Raises RecordingError if there is nothing to compare.
    """
    from trms_cli.reporting.progress import ReadingProgress
    from trms_cli.runs.many import gather_runs
    from trms_cli.scoring.comparison.ranking import matching_runs
    from trms_cli.scoring.comparison.runs import RunCollection

    with ReadingProgress() as tell:
        gathered = gather_runs(paths, tell)
    if where:
        gathered = RunCollection(tuple(matching_runs(gathered.runs, where)), gathered.left_out)
    if len(gathered.runs) == 1 and gathered.runs[0].state.ranked:
        raise RecordingError(
            "there is one run only, and nothing to compare it with",
            where=", ".join(map(str, paths)),
            remedy=f"add another; its own figures: trms score {gathered.runs[0].path}",
        )
    return gathered


def ranking_of(
    gathered: RunCollection, by: Sequence[str], metric: str, paths: Sequence[Path]
) -> Ranking:
    """Everybody held against the best on the same reference, rig and seed.

    Raises RecordingError if nobody has a tracking error.
    """
    from trms_cli.scoring.comparison.ranking import group, rank

    ranking = rank(group(gathered.runs, by), metric)
    if not ranking.best:
        raise RecordingError(
            _why_nothing(gathered),
            where=", ".join(map(str, paths)),
            remedy="look at them one by one: trms score LOG",
        )
    return ranking


def sort_standings(ranking: Ranking, sort: str) -> list[Standing]:
    """The standings in the order of a column; those without a rank stay last."""
    from trms_cli.scoring.comparison.ranking import figures_of

    columns: dict[str, Callable[[Figures], Any]] = {
        "worst": lambda figures: figures.ratio_worst,
        "effort": lambda figures: figures.effort,
        "variation": lambda figures: figures.variation,
        "time": lambda figures: figures.step_ms,
        "failures": lambda figures: (
            figures.failed,
            figures.non_finite or 0,
            figures.fallbacks,
            figures.missed,
        ),
    }
    standings = list(ranking.standings)
    if sort == "name":
        standings.sort(key=lambda standing: standing.name)
    elif sort == "tracking":
        standings.sort(key=lambda standing: _last_if_nan(standing.ratio))
    elif sort in columns:
        sort_values = {id(s): columns[sort](figures_of(s, ranking.metric)) for s in standings}
        standings.sort(key=lambda standing: _last_if_nan(sort_values[id(standing)]))
    return standings


def _why_nothing(gathered: RunCollection) -> str:
    runs = gathered.runs
    if len(runs) == 1 and not runs[0].state.ranked:
        return f"the only run here did not end ({runs[0].message})"
    ended = sum(run.state.ranked for run in runs)
    if not ended:
        return f"none of the {len(runs)} runs ended"
    return f"none of the {len(runs)} runs has a tracking error: they follow no reference, or failed"


def _last_if_nan(value: Any) -> Any:
    return float("inf") if isinstance(value, float) and value != value else value
