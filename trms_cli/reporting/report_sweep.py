"""The page of many runs: who won, how figures spread and on what they depend, what failed.

::

    page = sweep_page(ReportedSweep(name="sweep", runs=[SweepRun(name="0", …), …], …))
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence

import numpy as np

from trms_cli.core.findings import Cell
from trms_cli.reporting.chart_plot import plots
from trms_cli.reporting.page import Page
from trms_cli.reporting.page_rows import MOST_ROWS, Linked, RowCell, RowColumn
from trms_cli.reporting.report_comparison import RankedCandidate, add_ranking
from trms_cli.reporting.report_draws import (
    add_correlations,
    add_failure_shares,
    failures_sentence,
)
from trms_cli.reporting.report_sweep_plots import (
    chosen_words,
    key_panels,
    pareto_panels,
    spread_panels,
)
from trms_cli.reporting.reported_sweep import Objective, ReportedSweep, SweepRun

_MOST_REASONS, _LONGEST_REASON = 50, 300
_MOST_OF_A_FRONT = 100
_MOST_NAMES = _MOST_NAMED = 6
#: Figures that the reader can choose for the plots.
_MOST_CHOICES = 14


def sweep_page(
    sweep: ReportedSweep,
    *,
    ranking: Sequence[RankedCandidate] = (),
    rule: str = "",
    title: str = "",
) -> Page:
    """The page of many runs, ready to be written.

    Parameters
    ----------
    sweep : ReportedSweep
    ranking : sequence of RankedCandidate
        As ``trms compare`` has it; empty where nobody can be ranked.
    rule : str
        How the rank comes about.
    title : str
    """
    figures = _telling(sweep)
    page = Page(title or f"Sweep {sweep.name}", _lead(sweep, ranking), dict(sweep.facts))
    if len(sweep.objectives) >= 1:
        _objectives(page, sweep)
    if len(ranking) > 1:
        add_ranking(page, ranking, rule)
    if sweep.draws:
        add_failure_shares(page, sweep.draws)
        add_correlations(page, sweep.draws)
    spread = spread_panels(sweep, figures)
    if spread:
        page.section("How figures spread", "Of the runs that ended.")
        page.plots(plots(spread))
    keys = key_panels(sweep, figures)
    if keys:
        page.section(
            "What they depend on",
            f"Each dot is a run; pointing at it tells which.{chosen_words(sweep)}",
        )
        page.plots(plots(keys))
    _failures(page, sweep)
    _all_runs(page, sweep)
    return page


def _telling(sweep: ReportedSweep) -> list[str]:
    """Figures that differ between runs, objectives first."""
    wanted = [objective.figure for objective in sweep.objectives]
    found = []
    for name in dict.fromkeys([*wanted, *sweep.figures]):
        values = [r.figures[name] for r in sweep.runs if not r.failed and name in r.figures]
        if len(set(values)) > 1 or (values and name in wanted):
            found.append(name)
    return found[:_MOST_CHOICES]


def _lead(sweep: ReportedSweep, ranking: Sequence[RankedCandidate]) -> list[str]:
    outcomes = Counter(run.outcome for run in sweep.runs)
    completed = outcomes.pop("completed", 0)
    others = ", ".join(f"**{count} {outcome}**" for outcome, count in outcomes.most_common())
    wanted = max(sweep.asked or 0, len(sweep.runs))
    never = wanted - len(sweep.runs)
    if never:
        begun = f"**{never} not begun**: the sweep stopped before its end"
        others = f"{others}, {begun}" if others else begun
    sentences = [f"{completed} of {wanted} runs completed{'; ' + others if others else ''}."]
    first = next((entrant for entrant in ranking if entrant.rank == 1), None)
    second = next((entrant for entrant in ranking if entrant.rank == 2), None)
    if first is not None and second is not None:
        sentence = f"**{first.name}** tracks best"
        if second.against_first:
            sentence += f"; {second.name} misses by {_times(second.against_first)}"
            if second.different is False:
                sentence += ", which these runs cannot tell from equal"
        sentences.append(sentence + ".")
    failed = failures_sentence(sweep.draws) if sweep.draws else ""
    if failed:
        sentences.append(failed)
    best = _best(sweep)
    if best is not None:
        run, value, name = best
        sentences.append(
            f"The least {name} of a {_kind(sweep)} is {value:.3g}: {run.name}{_where(sweep, run)}."
        )
    return sentences


def _times(ratio: float) -> str:
    """How many times as much, with the digits that tell it from one."""
    if ratio == 1:
        return "as much"
    digits = next((d for d in range(3, 7) if f"{ratio:.{d}g}" != "1"), 0)
    return f"{ratio:.{digits}g} times as much" if digits else "as much, to six digits"


def _best(sweep: ReportedSweep) -> tuple[SweepRun, float, str] | None:
    name = next((o.figure for o in sweep.objectives if not o.largest), None) or next(
        (n for n in sweep.figures if n.startswith("rmse")), None
    )
    if name is None:
        return None
    # A run that ended early has had less time to err.
    known = [r for r in sweep.tried if r.outcome == "completed" and name in r.figures]
    if not known:
        return None
    run = min(known, key=lambda each: each.figures[name])
    return run, run.figures[name], sweep.title(name)


def _where(sweep: ReportedSweep, run: SweepRun) -> str:
    told = [key for key in sweep.keys if run.values.get(key) not in (None, "")]
    chosen = [key for key in told if key not in sweep.drawn_keys]
    parts = [f"{key} {_shown(run.values[key])}" for key in chosen[:_MOST_NAMED]]
    if len(chosen) > _MOST_NAMED:
        parts.append(f"and {len(chosen) - _MOST_NAMED} more")
    if len(told) > len(chosen):
        parts.append(f"{len(told) - len(chosen)} drawn values")
    return f" ({', '.join(parts)})" if parts else ""


def _objectives(page: Page, sweep: ReportedSweep) -> None:
    front = sweep.front()
    names = [objective.figure for objective in sweep.objectives]
    page.section(
        "Objectives",
        f"Sought: {', '.join(map(_sought, sweep.objectives))}.",
    )
    page.plots(plots(pareto_panels(sweep)))
    first = sweep.objectives[0]
    front.sort(key=lambda run: run.figures.get(first.figure, math.inf))
    keys = [key for key in sweep.keys if any(run.values.get(key) is not None for run in front)]
    rows: list[list[Cell]] = []
    for run in front[:_MOST_OF_A_FRONT]:
        figures = [run.figures.get(name) for name in names]
        rows.append([run.name, *figures, *(_cell(run.values.get(key)) for key in keys)])
    if rows:
        kind = _kind(sweep)
        what = f"Each {kind} that none beats in all objectives." if len(names) > 1 else "The best."
        page.table([kind, *map(sweep.title, names), *keys], rows, what)


def _kind(sweep: ReportedSweep) -> str:
    return "trial" if sweep.trials else "run"


def _sought(objective: Objective) -> str:
    return f"the {'largest' if objective.largest else 'least'} {objective.figure}"


def _failures(page: Page, sweep: ReportedSweep) -> None:
    failed = [run for run in sweep.runs if run.failed]
    if failed or sweep.left_out:
        page.section("What failed")
    reasons: dict[str, list[SweepRun]] = {}
    for run in failed:
        reason = (run.problem or run.outcome).strip().splitlines() or [run.outcome]
        reasons.setdefault(reason[0][:_LONGEST_REASON], []).append(run)
    rows: list[list[Cell]] = []
    for why, runs in sorted(reasons.items(), key=lambda item: -len(item[1]))[:_MOST_REASONS]:
        names = [run.name for run in runs[:_MOST_NAMES]]
        names += ["…"] if len(runs) > _MOST_NAMES else []
        rows.append([len(runs), why, ", ".join(names)])
    if rows:
        more = len(reasons) - len(rows)
        page.table(
            ["runs", "why", "which"],
            rows,
            f"{more} more reasons are in the table below." if more > 0 else "",
        )
    if sweep.left_out:
        page.table(
            ["file that cannot be read", "why"],
            [[file, why[:_LONGEST_REASON]] for file, why in sweep.left_out[:_MOST_REASONS]],
        )


def _all_runs(page: Page, sweep: ReportedSweep) -> None:
    page.section("All runs", _how_to_filter(sweep))
    figures, alike = _apart(sweep)
    keys = [key for key in sweep.keys if key not in sweep.drawn_keys]
    drawn = [key for key in sweep.keys if key in sweep.drawn_keys]
    has_entrants = len(sweep.entrants) > 1 and not _said_by_a_key(sweep)
    columns = [RowColumn("run", "run")]
    columns += [RowColumn("who", "who")] if has_entrants else []
    columns += [RowColumn(key, key.lower(), number=key in sweep.numeric_keys) for key in keys]
    columns += [RowColumn("outcome", "outcome")]
    columns += [RowColumn(sweep.title(name), name.lower(), number=True) for name in figures]
    # They are many, and would push what came of them off the screen.
    columns += [RowColumn(key, key.lower(), number=key in sweep.numeric_keys) for key in drawn]
    told = any(run.problem for run in sweep.runs)
    columns += [RowColumn("why it failed", "problem")] if told else []
    rows: list[list[RowCell]] = []
    for run in sweep.runs[:MOST_ROWS]:
        row: list[RowCell] = [Linked(run.name, run.page)]
        row += [run.entrant] if has_entrants else []
        row += [run.values.get(key) for key in keys]
        row += [run.outcome, *(run.figures.get(name) for name in figures)]
        row += [run.values.get(key) for key in drawn]
        row += [run.problem] if told else []
        rows.append(row)
    caption = "A click on a head sorts. On paper stand the first 200 rows."
    if alike:
        same = ", ".join(f"{sweep.title(name)} {value:.4g}" for name, value in alike.items())
        caption += f" The same for all that have it: {same}."
    if len(sweep.runs) > MOST_ROWS:
        caption += f" The first {MOST_ROWS} of {len(sweep.runs)} runs."
    page.rows(columns, rows, caption, example=_example(sweep))


def _apart(sweep: ReportedSweep) -> tuple[list[str], dict[str, float]]:
    """Figures that tell runs apart, and those that are the same for all, with their value."""
    apart, alike = [], {}
    for name in sweep.figures:
        values = {run.figures[name] for run in sweep.runs if name in run.figures}
        if len(values) == 1 and len(sweep.runs) > 1:
            alike[name] = values.pop()
        elif values:
            apart.append(name)
    return apart, alike


def _how_to_filter(sweep: ReportedSweep) -> str:
    return (
        f"Filter by words and by columns, `{_example(sweep)}` for instance; all that is typed has "
        "to hold."
    )


def _example(sweep: ReportedSweep) -> str:
    """A condition that about half of the runs fulfil."""
    for name in sweep.figures:
        values = [run.figures[name] for run in sweep.runs if name in run.figures]
        if values:
            return f"{name.lower()}<{float(np.median(values)):.2g}"
    return "outcome=failed"


def _said_by_a_key(sweep: ReportedSweep) -> bool:
    """Whether one key alone names who ran: a column of its own would say it twice."""
    return any(map(sweep.names_entrants, sweep.keys))


def _shown(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _cell(value: object) -> Cell:
    return value if isinstance(value, (str, float, int)) or value is None else str(value)
