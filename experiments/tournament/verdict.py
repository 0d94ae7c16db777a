"""What a tournament came to: rankings by block, class and reference, and whether aims are met."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from experiments.tournament.schedule import BLOCKS, FAULTS, MAIN, OBSERVERS, Criteria
from trms_cli.core.errors import RecordingError
from trms_cli.scoring.comparison.ranking import Ranking, Standing, figures_of, group, rank
from trms_cli.scoring.comparison.runs import ComparisonRun, RunCollection, State, gather

#: What names an entrant here, also where all have one observer.
BY = ("controller", "observer")
CLASS, RIG, REF = "class", "rig", "ref"


@dataclass(frozen=True, kw_only=True)
class Aim:
    """A criterion and what came out."""

    words: str  #: What was asked
    is_met: bool | None  #: None where the runs do not tell
    figures: str  #: What was found


@dataclass(frozen=True, kw_only=True)
class Behind:
    """A rig and reference on which the champion is not within the limit."""

    rig_class: str
    rig: str
    ref: str
    ratio: float  #: Its error over the best's
    best: str  #: Who tracks best there
    error: float  #: Of both, rad
    best_error: float  #: Of both, rad


@dataclass(frozen=True, kw_only=True)
class Results:
    """All that came out."""

    gathered: dict[str, RunCollection]  #: Runs by block
    main: Ranking
    faults: Ranking | None
    observers: Ranking | None
    classes: dict[str, Ranking]  #: Of the main block, in parts
    references: dict[str, Ranking]  #: Of the main block, in parts
    behind: tuple[Behind, ...]  #: Worst first
    aims: tuple[Aim, ...]

    @property
    def runs(self) -> int:
        """How many different runs there are."""
        return len({_key(run) for run in self.all_runs()})

    def all_runs(self) -> list[ComparisonRun]:
        """Of all blocks; one that is in several stands several times."""
        return [run for collection in self.gathered.values() for run in collection.runs]


def read_results(folder: Path, criteria: Criteria) -> Results:
    """Sum up what lies in a tournament's folder.

    Raises RecordingError if there are no runs of the main block.
    """
    gathered = {
        block: gather([folder / block]) for block in BLOCKS if any((folder / block).glob("*"))
    }
    if MAIN not in gathered:
        raise RecordingError(
            "there is no run of the main block", where=str(folder), remedy="run the tournament"
        )
    runs = gathered[MAIN].runs
    main = _ranked(runs)
    classes = {name: _ranked(_of(runs, CLASS, name)) for name in _values(runs, CLASS)}
    behind = _behind(main, criteria)
    return Results(
        gathered=gathered,
        main=main,
        faults=_ranked(gathered[FAULTS].runs) if FAULTS in gathered else None,
        observers=_ranked(gathered[OBSERVERS].runs) if OBSERVERS in gathered else None,
        classes=classes,
        references={name: _ranked(_of(runs, REF, name)) for name in _values(runs, REF)},
        behind=behind,
        aims=tuple(_aims(main, classes, behind, gathered, criteria)),
    )


def standing_of(ranking: Ranking, name: str) -> Standing | None:
    """An entrant's, by name; None if it did not run."""
    return next((each for each in ranking.standings if each.name == name), None)


def by_rig(ranking: Ranking, name: str) -> dict[str, float]:
    """An entrant's ratio to the best on each rig: geometric mean over the references."""
    standing = standing_of(ranking, name)
    if standing is None:
        return {}
    logs: dict[str, list[float]] = {}
    for condition, ratio in zip(standing.conditions, standing.ratios, strict=True):
        rig = ranking.contest.conditions[int(condition)].get(RIG, "")
        logs.setdefault(rig, []).append(math.log(ratio))
    return {rig: math.exp(float(np.mean(values))) for rig, values in logs.items()}


def _ranked(runs: Sequence[ComparisonRun]) -> Ranking:
    return rank(group(runs, BY))


def _behind(main: Ranking, criteria: Criteria) -> tuple[Behind, ...]:
    standing = standing_of(main, criteria.champion)
    if standing is None:
        return ()
    runs_behind = []
    for condition, ratio, run in zip(
        standing.conditions, standing.ratios, standing.runs, strict=True
    ):
        if ratio <= criteria.within:
            continue
        at = int(condition)
        best = standing_of(main, main.best[at])
        assert best is not None
        rival = best.runs[int(np.flatnonzero(best.conditions == at)[0])]
        runs_behind.append(
            Behind(
                rig_class=run.coordinates[CLASS],
                rig=run.coordinates[RIG],
                ref=run.coordinates[REF],
                ratio=float(ratio),
                best=best.name,
                error=run.error(main.metric),
                best_error=rival.error(main.metric),
            )
        )
    return tuple(sorted(runs_behind, key=lambda each: -each.ratio))


def _aims(
    main: Ranking,
    classes: dict[str, Ranking],
    behind: Sequence[Behind],
    gathered: dict[str, RunCollection],
    criteria: Criteria,
) -> list[Aim]:
    return [
        _first_on_nominal(classes, criteria),
        _close_on_disturbed(main, behind, criteria),
        _finite(gathered),
        _nothing_failed(gathered),
        _faster(main, criteria),
    ]


def _first_on_nominal(classes: dict[str, Ranking], criteria: Criteria) -> Aim:
    words = f"{criteria.champion} tracks best on the nominal rigs"
    ranking = classes.get(criteria.nominal_class)
    first = None if ranking is None else ranking.first
    standing = None if ranking is None else standing_of(ranking, criteria.champion)
    if ranking is None or first is None or standing is None:
        return Aim(words=words, is_met=None, figures="no such runs")
    won = sum(name == criteria.champion for name in ranking.best.values())
    figures = f"rank {standing.rank}, best in {won} of {len(ranking.best)} runs"
    others = [each for each in ranking.ranked if each.name != criteria.champion]
    if others and first.name == criteria.champion:
        lead = 100 * (others[0].against_first - 1)
        figures += f"; {others[0].name} second, {lead:.1f} % behind"
    elif first.name != criteria.champion:
        figures += f"; {first.name} first, {100 * (standing.against_first - 1):.1f} % ahead"
    return Aim(words=words, is_met=first.name == criteria.champion, figures=figures)


def _close_on_disturbed(main: Ranking, behind: Sequence[Behind], criteria: Criteria) -> Aim:
    words = (
        f"{criteria.champion} is within {100 * (criteria.within - 1):.0f} % of the best on every "
        "disturbed rig, with every reference"
    )
    standing = standing_of(main, criteria.champion)
    if standing is None:
        return Aim(words=words, is_met=None, figures="no such runs")
    at = [
        float(ratio)
        for ratio, run in zip(standing.ratios, standing.runs, strict=True)
        if run.coordinates[CLASS] in criteria.disturbed_classes
    ]
    if not at:
        return Aim(words=words, is_met=None, figures="no such runs")
    missed = [each for each in behind if each.rig_class in criteria.disturbed_classes]
    rigs = {run.coordinates[RIG] for run in standing.runs if _disturbed(run, criteria)}
    means = {rig: ratio for rig, ratio in by_rig(main, criteria.champion).items() if rig in rigs}
    over = sum(ratio > criteria.within for ratio in means.values())
    figures = (
        f"{len(at) - len(missed)} of {len(at)} runs within, worst {max(at):.3f} times the best; "
        f"over all references of a rig {len(means) - over} of {len(means)} rigs within, worst "
        f"{max(means.values()):.3f}"
    )
    return Aim(words=words, is_met=not missed, figures=figures)


def _finite(gathered: dict[str, RunCollection]) -> Aim:
    runs = _all(gathered)
    counted = [run.non_finite for run in runs if run.non_finite is not None]
    bad = sum(1 for value in counted if value)
    figures = f"{sum(counted)} in {len(counted)} runs"
    if bad:
        figures += f" ({bad} runs with some)"
    return Aim(words="no command that is not finite, in any run", is_met=not bad, figures=figures)


def _nothing_failed(gathered: dict[str, RunCollection]) -> Aim:
    runs = _all(gathered)
    failed = [run for run in runs if run.state is State.FAILED]
    stopped = sum(run.state is State.INCOMPLETE for run in runs)
    figures = f"{len(failed)} of {len(runs)} runs failed"
    if failed:
        names = dict.fromkeys(run.coordinates.get("controller", "") for run in failed)
        figures += f": {', '.join(names)}"
    if stopped:
        figures += f"; {stopped} did not end (`--resume` runs them)"
    is_met = None if stopped and not failed else not failed
    return Aim(words="no run ends in an error", is_met=is_met, figures=figures)


def _faster(main: Ranking, criteria: Criteria) -> Aim:
    words = (
        f"{criteria.champion} is {criteria.faster_by:g} times as fast a step as "
        f"{criteria.slower_peer}"
    )
    one, other = (standing_of(main, n) for n in (criteria.champion, criteria.slower_peer))
    if one is None or other is None:
        return Aim(words=words, is_met=None, figures="no such runs")
    own, theirs = figures_of(one).step_ms, figures_of(other).step_ms
    if not (math.isfinite(own) and math.isfinite(theirs)) or own <= 0:
        return Aim(words=words, is_met=None, figures="no times")
    figures = f"{theirs / own:.1f} times: median {own:.2g} against {theirs:.2g} ms"
    return Aim(words=words, is_met=theirs / own >= criteria.faster_by, figures=figures)


def _disturbed(run: ComparisonRun, criteria: Criteria) -> bool:
    return run.coordinates[CLASS] in criteria.disturbed_classes


def _all(gathered: dict[str, RunCollection]) -> list[ComparisonRun]:
    """Every run once."""
    runs_by_key = {_key(run): run for each in gathered.values() for run in each.runs}
    return list(runs_by_key.values())


def _key(run: ComparisonRun) -> tuple[str, ...]:
    return tuple(run.coordinates.get(key, "") for key in (*BY, REF, RIG))


def _of(runs: Sequence[ComparisonRun], key: str, value: str) -> list[ComparisonRun]:
    return [run for run in runs if run.coordinates.get(key) == value]


def _values(runs: Sequence[ComparisonRun], key: str) -> list[str]:
    return list(dict.fromkeys(run.coordinates.get(key, "") for run in runs))
