"""What a comparison has to tell, as data: who won and by how much, what that took, what failed."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import chain
from typing import Any

from trms_cli.core import wording
from trms_cli.core.findings import Cell, Column, Datum, Findings, Section, Table, json_data, table
from trms_cli.scoring.comparison import ranking as ranked
from trms_cli.scoring.comparison.runs import (
    ComparisonRun,
    RunCollection,
    State,
    differences,
    with_rigs,
)
from trms_cli.scoring.figures import Group, entries, metrics, part

_GROUPS: tuple[Group, ...] = ("channels", "inputs", "solver", "run")


@dataclass(frozen=True, kw_only=True)
class PairRow:
    """A figure of both runs; all are better when small."""

    key: str  #: ``channels.alpha_v.rmse``
    label: str  #: In words, with the channel
    unit: str
    one: float | None  #: in the row's unit
    other: float | None  #: in the row's unit

    @property
    def change(self) -> float | None:
        """(other − one)/one; None where it says nothing."""
        if self.one is None or self.other is None or abs(self.one) < 1e-12:
            return None
        return (self.other - self.one) / abs(self.one)


@dataclass(frozen=True, kw_only=True)
class Pair:
    """Two runs."""

    one: ComparisonRun
    other: ComparisonRun
    settings: tuple[tuple[str, str, str], ...]  #: Keys of the configurations that differ, and both
    rows: tuple[PairRow, ...]


def pair(one: ComparisonRun, other: ComparisonRun) -> Pair:
    """Put two runs side by side."""
    one, other = with_rigs((one, other))
    options = [
        (key, one.coordinates.get(key, "–"), other.coordinates.get(key, "–"))
        for key in dict.fromkeys([*one.coordinates, *other.coordinates])
        if one.coordinates.get(key) != other.coordinates.get(key)
    ]
    # keys below an option that differs follow from the option
    below = tuple(f"{key}." for key, _, _ in options if "." not in key)
    named = {key for key, _, _ in options}
    settings = [
        row
        for row in differences(one.config, other.config)
        if row[0] not in named and not row[0].startswith(below)
    ]
    return Pair(one=one, other=other, settings=(*options, *settings), rows=tuple(_rows(one, other)))


def _rows(one: ComparisonRun, other: ComparisonRun) -> Iterator[PairRow]:
    """The figures of both that are better when small, where one of them has one."""
    left, right = ({e.key: e for e in entries(run.score or {}, *_GROUPS)} for run in (one, other))
    for key in dict.fromkeys([*left, *right]):
        entry = left.get(key) or right[key]
        values = [side[key].value if key in side else None for side in (left, right)]
        of_all = entry.figure.group in ("solver", "run")
        if of_all:
            values = [None if value is None else float(value) for value in values]
        if entry.figure.better == "less" and (of_all or any(v is not None for v in values)):
            unit = entry.unit or (right[key].unit if key in right else "")
            yield PairRow(key=key, label=entry.label, unit=unit, one=values[0], other=values[1])


SCHEMA, PAIR_SCHEMA = "trms.compare/1", "trms.compare_pair/1"


def rule(ranking: ranked.Ranking) -> str:
    """How the rank comes about, in two sentences."""
    name = ranking.metric.upper() if ranking.metric != "max_abs_error" else "largest error"
    conditions = ", ".join(_gathered(ranking.contest.given_by)) or "condition"
    return (
        f"Ranked by tracking: the {name} of all channels added, over the best entrant's on the "
        f"same {conditions}; geometric mean over the runs. A failed run counts as the worst of its "
        f"condition, and at least as {ranked.FAILED_RATIO:g} times the best."
    )


def _gathered(keys: Sequence[str]) -> list[str]:
    """Coordinates as prose names them: many parameters of the rig, as draws have, are one."""
    rig_keys = [key for key in keys if key.startswith(ranked.RIG_PARAMETERS)]
    if len(rig_keys) < ranked.FEWEST_GATHERED:
        return list(keys)
    return [
        *(key for key in keys if key not in rig_keys),
        f"the rig's parameters ({len(rig_keys)} of {ranked.RIG_PARAMETERS.rstrip('.')})",
    ]


def document(
    ranking: ranked.Ranking, gathered: RunCollection, standings: Sequence[ranked.Standing]
) -> dict[str, Any]:
    """``trms.compare/1``, the entrants in the order in which they are shown."""
    runs = gathered.runs
    return json_data(
        {
            "schema": SCHEMA,
            "rule": rule(ranking),
            "metric": ranking.metric,
            "by": list(ranking.contest.by),
            "conditions_by": list(ranking.contest.given_by),
            "runs": len(runs),
            "conditions_left_out": ranking.left_out,
            "rigs_differ_by_model": ranking.contest.rigs_differ,
            "conditions": [dict(condition) for condition in ranking.contest.conditions],
            "interval": {
                "of": "percentile bootstrap over rigs, paired",
                "level": ranked.LEVEL,
                "resamples": ranked.RESAMPLES,
                "seed": ranked.SEED,
                "rigs": ranking.clusters,
                "fewest_rigs": ranked.FEWEST_CLUSTERS,
            },
            "entrants": [_entrant(standing, ranking) for standing in standings],
            "failed": [_run_data(run) for run in runs if run.state is State.FAILED],
            "incomplete": [_run_data(run) for run in runs if run.state is State.INCOMPLETE],
            "left_out": [{"path": path, "problem": why} for path, why in gathered.left_out],
        }
    )


def pair_document(pair: Pair) -> dict[str, Any]:
    """``trms.compare_pair/1``."""
    return json_data(
        {
            "schema": PAIR_SCHEMA,
            "runs": [
                {**_run_data(run), "state": run.state.value, "score": run.score}
                for run in (pair.one, pair.other)
            ],
            "differences": [
                {"key": key, "values": [left, right]} for key, left, right in pair.settings
            ],
            "figures": [asdict(row) for row in pair.rows],
        }
    )


def _entrant(standing: ranked.Standing, ranking: ranked.Ranking) -> dict[str, Any]:
    figures = asdict(ranked.figures_of(standing, ranking.metric))
    others = {
        m: ranked.mean(standing.column("channels", m)) for m in metrics() if m != ranking.metric
    }
    errors = {name: figures.pop(f"error_{name}") for name in ("mean", "p95", "worst")}
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
            "ratio_p95": figures.pop("ratio_p95"),
            "ratio_worst": figures.pop("ratio_worst"),
            "worst_condition": ranked.worst_condition(standing, ranking.contest.condition_name),
            "error": errors,
            "other_metrics_mean": others,
        },
        **figures,
        "by_condition": [
            {
                "condition": condition,
                "error": run.error(ranking.metric),
                "ratio": ratio,
                "state": run.state.value,
                "path": run.path,
            }
            for condition, ratio, run in zip(
                standing.conditions.tolist(), standing.ratios.tolist(), standing.runs, strict=True
            )
        ],
    }


def _run_data(run: ComparisonRun) -> dict[str, Any]:
    return {"path": run.path, "coordinates": dict(run.coordinates), "message": run.message}


def _pair(interval: ranked.RatioInterval | None) -> list[float] | None:
    return None if interval is None else [interval.low, interval.high]


#: As many failed runs or settings are listed; JSON has all.
_MOST_LISTED = 12
#: Of an entrant that differs significantly from the first, and of one that does not.
_MARKS = {None: "", True: "≠", False: "="}
#: What moved by less is not coloured.
_LEAST_CHANGE = 0.01


def ranking_findings(
    ranking: ranked.Ranking, gathered: RunCollection, standings: Sequence[ranked.Standing]
) -> Findings:
    """Who won, what that took, and what went wrong; the entrants in the order given."""
    contest = ranking.contest
    runs = wording.count(len(gathered.runs), "run")
    counted = [
        (wording.count(len(contest.entrants), "entrant"), contest.by),
        (wording.count(len(contest.conditions), "condition"), contest.given_by),
    ]
    parts = [f"{many} by {', '.join(_gathered(by))}" if by else many for many, by in counted]
    title = f"{runs}: {', '.join(parts)}"
    tables = ranking_tables(ranking, standings)
    lead, troubles = [*_answer(ranking)], [*trouble(gathered)]
    if not any("failed runs" in ranking_table.columns for ranking_table in tables):
        lead.append("No run failed: no fall-back, no missed deadline, never degraded.")
    return Findings(
        title,
        lead,
        [Section("Ranking", blocks=[*tables, *(each for _, each in troubles)])],
        document(ranking, gathered, standings),
        [words for words, _ in troubles],
    )


def ranking_tables(ranking: ranked.Ranking, standings: Sequence[ranked.Standing]) -> list[Table]:
    """Tracking and robustness, effort and time, and failures where there was one."""
    rows = [(standing, ranked.figures_of(standing, ranking.metric)) for standing in standings]
    channel, command = _unit_of(ranking, "channels", "rad"), _unit_of(ranking, "inputs", "V")
    unit = metrics()[ranking.metric].replace("{}", channel) if channel else ""
    effort = f"{command}² s" if command else ""
    error = {"max_abs_error": "largest error"}.get(ranking.metric, ranking.metric.upper())
    heads = [Column("rank", lambda each: each[0].rank), Column("who", lambda each: each[0].name)]
    tracking = [
        Column("runs", lambda each: each[1].runs),
        Column(wording.with_unit(error, unit), lambda each: each[1].error_mean),
        Column("over best", _best),
        Column("95 %", lambda each: _between(each[0].interval)),
        Column("over first", lambda each: _after_first(each[0], _ratio(each[0].against_first))),
        Column("95 %", lambda each: _after_first(each[0], _between(each[0].against_interval))),
        Column("differs", lambda each: _after_first(each[0], _MARKS[each[0].different])),
        Column("p95", lambda each: _ratio(each[1].ratio_p95)),
        Column("worst", lambda each: _ratio(each[1].ratio_worst)),
    ]
    cost = [
        Column(wording.with_unit("effort ∫u²dt", effort), lambda each: each[1].effort),
        Column(wording.with_unit("total variation Σ|Δu|", command), lambda each: each[1].variation),
        Column("step [ms]", lambda each: each[1].step_ms),
        Column("p99 [ms]", lambda each: each[1].step_p99_ms),
        Column("longest [ms]", lambda each: each[1].step_max_ms),
    ]
    failures = [
        Column("failed runs", lambda each: _alarm(each[1].failed)),
        Column("commands not finite", lambda each: _alarm(each[1].non_finite)),
        Column("fall-backs [samples]", lambda each: each[1].fallbacks),
        Column("deadlines missed", lambda each: each[1].missed),
        Column("degraded [s]", lambda each: each[1].degraded_s),
        Column("in runs", lambda each: each[1].degraded_runs),
    ]
    unwell = [each for each in rows if _failed(each[1])]
    caption = " ".join(notes(ranking, standings))
    tables = [
        table(rows, [*heads, *tracking], caption, heads=2),
        table(rows, [*heads, *cost], heads=2),
    ]
    return tables + ([table(unwell, [*heads, *failures], heads=2)] if unwell else [])


def _unit_of(ranking: ranked.Ranking, group: str, usual: str) -> str:
    """The unit of channels or inputs of ranked runs; the twin rotor's where no score tells one.

    Empty where they have several: a sum over them has none.
    """
    runs = list(chain.from_iterable(ranking.contest.cells.values()))
    owners = chain.from_iterable(part(run.score, group).values() for run in runs)
    units = {str(own["unit"]) for own in owners if own.get("unit")}
    units = units | {run.units[group] for run in runs if group in run.units} or {usual}
    return units.pop() if len(units) == 1 else ""


def notes(ranking: ranked.Ranking, standings: Sequence[ranked.Standing]) -> Iterator[str]:
    """How the tables are to be read."""
    yield rule(ranking)
    if ranking.contest.rigs_differ:
        yield (
            "The rigs differ: each took its own model's equations "
            "(model@plant.model=newtonian gives all the same)."
        )
    if ranking.clusters >= ranked.FEWEST_CLUSTERS:
        yield (
            f"Intervals: {100 * ranked.LEVEL:.0f} % of a paired bootstrap over {ranking.clusters} "
            "rigs. ≠ differs significantly from the first, = does not."
        )
    else:
        yield (
            f"No intervals: {wording.count(ranking.clusters, 'rig')}, and they take "
            f"{ranked.FEWEST_CLUSTERS} (sweep plant.prior_seed or seed)."
        )
    if ranking.first is not None and len(standings) > 1:
        for standing in ranking.ranked[:2]:
            where = ranked.worst_condition(standing, ranking.contest.brief_condition_name)
            ratio = float(standing.ratios.max())
            if ratio > 1.0 + 1e-9:
                yield f"Worst of {standing.name}: {where} ({ratio:.3f} times the best)."
    if any(
        key.partition(".")[0].partition("@")[0] not in ranked.OF_ENTRANTS
        for key in ranking.contest.by
    ):
        yield "Rows ran in different conditions: their errors tell as much of those as of who ran."
    outside = dict.fromkeys(
        f"{standing.name}: {standing.outside}" for standing in standings if standing.outside
    )
    if outside:
        yield f"Outside of the ranking: {'; '.join(outside)}."
    partial = [s.name for s in standings if s.rank is None and not s.outside]
    if partial:
        yield f"Not ranked, since in too few of the conditions: {', '.join(partial)}."
    if ranking.left_out:
        yield f"Left out: {ranking.left_out} conditions in which not all of the ranked ran."


def trouble(gathered: RunCollection) -> Iterator[tuple[str, Table]]:
    """How many runs failed or did not end, or files were passed over; and which, and why."""
    for word, rows in (
        ("failed", _runs_that_are(State.FAILED, gathered)),
        ("incomplete, not counted", _runs_that_are(State.INCOMPLETE, gathered)),
        ("passed over", list(gathered.left_out)),
    ):
        if rows:
            yield f"{len(rows)} {word}", _at_most([word.partition(",")[0], "why"], rows)


def _runs_that_are(state: State, gathered: RunCollection) -> list[tuple[str, str]]:
    return [
        (run.path, next(iter(run.message.splitlines()), ""))
        for run in gathered.runs
        if run.state is state
    ]


def pair_findings(pair: Pair) -> Findings:
    """Two runs side by side: what they were given differently, and every figure of both."""
    warnings = [
        f"{letter} {run.state.value}: {run.message}"
        for letter, run in (("A", pair.one), ("B", pair.other))
        if run.state is not State.DONE
    ]
    settings_table = _at_most(["given differently", "A", "B"], pair.settings)
    compared = table(
        pair.rows,
        [
            Column("figure", lambda row: wording.with_unit(row.label, row.unit)),
            Column("A", "one"),
            Column("B", "other"),
            Column("B − A", _difference),
            Column("change", _change),
        ],
    )
    same = [] if pair.settings else ["Nothing was given differently."]
    return Findings(
        "two runs",
        [f"A  {pair.one.path}", f"B  {pair.other.path}", *same],
        [
            Section("Given differently", blocks=[settings_table]),
            Section("Figures", blocks=[compared]),
        ],
        pair_document(pair),
        warnings,
    )


def _answer(ranking: ranked.Ranking) -> Iterator[str]:
    first = ranking.first
    if first is None or len(ranking.ranked) < 2:
        return
    second = ranking.ranked[1]
    behind = 100 * (second.against_first - 1)
    words = " (no significant difference)" if second.different is False else ""
    yield f"**{first.name}** tracks best, {second.name} {behind:.1f} % behind{words}."


def _at_most(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> Table:
    more = len(rows) - _MOST_LISTED
    caption = f"and {more} more (--json has all)" if more > 0 else ""
    return Table(columns, [list(row) for row in rows[:_MOST_LISTED]], caption)


def _best(each: tuple[ranked.Standing, ranked.Figures]) -> Cell:
    ratio = _ratio(each[0].ratio)
    return Datum(ratio, "best") if each[0].rank == 1 else ratio


def _after_first(standing: ranked.Standing, cell: Cell) -> Cell:
    return "" if standing.rank == 1 else cell


def _alarm(amount: int | None) -> Cell:
    return Datum(amount, "bad" if amount else "")


def _failed(figures: ranked.Figures) -> bool:
    return any(
        (figures.failed, figures.non_finite, figures.fallbacks, figures.missed, figures.degraded_s)
    )


def _between(interval: ranked.RatioInterval | None) -> str:
    return wording.MISSING if interval is None else f"{interval.low:.3f}–{interval.high:.3f}"


def _ratio(value: float) -> str:
    """With three decimals, which tell near ones apart."""
    if math.isnan(value):
        return wording.MISSING
    return f"{value:.3f}" if value < 9.9995 else f"{value:.3g}"


def _difference(row: PairRow) -> float | None:
    return None if row.one is None or row.other is None else row.other - row.one


def _change(row: PairRow) -> Cell:
    """Coloured where it moved by a hundredth and more; times belong to the machine."""
    if row.change is None:
        return ""
    text = f"{100 * row.change:+.1f} %".replace("-", "−")
    if abs(row.change) < _LEAST_CHANGE or "time_ms" in row.key:
        return text
    return Datum(text, "good" if row.change < 0 else "doubtful")
