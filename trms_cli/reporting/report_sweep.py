"""What a page tells of many runs: who won, how figures spread and on what they depend, failures.

::

    findings_of_sweep(ReportedSweep(name="sweep", runs=[SweepRun(name="0", …), …], …))
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence

import numpy as np

from trms_cli.core.findings import Cell, Column, Findings, Judged, Section, table
from trms_cli.reporting.page import MOST_ROWS
from trms_cli.reporting.report_comparison import ranked
from trms_cli.reporting.report_run import plotted
from trms_cli.reporting.report_sweep_plots import (
    chosen_words,
    key_panels,
    pareto_panels,
    spread_panels,
)
from trms_cli.reporting.reported_sweep import (
    Draws,
    FailureShare,
    Objective,
    ReportedSweep,
    SweepRun,
)
from trms_cli.scoring.comparison.ranking import Ranking

_MOST_REASONS, _LONGEST_REASON = 50, 300
_MOST_OF_A_FRONT = 100
_MOST_NAMES = _MOST_NAMED = 6
#: Figures that the reader can choose for the plots.
_MOST_CHOICES = 14
_MOST_CORRELATIONS = 30
#: Of p values that are adjusted for their number.
_LEVEL = 0.05


def findings_of_sweep(
    sweep: ReportedSweep, *, ranking: Ranking | None = None, title: str = ""
) -> Findings:
    """What a page tells of many runs; `ranking`: as ``trms compare`` has it."""
    figures = _telling(sweep)
    several = ranking is not None and len(ranking.standings) > 1
    varied = f"Each dot is a run; pointing at it tells which.{chosen_words(sweep)}"
    sections = [
        _objectives(sweep),
        ranked(ranking if several else None),
        *(_draws(sweep.draws) if sweep.draws else ()),
        plotted("How figures spread", spread_panels(sweep, figures), "Of the runs that ended."),
        plotted("What they depend on", key_panels(sweep, figures), varied),
        _failures(sweep),
        _all_runs(sweep),
    ]
    return Findings(
        title or f"Sweep {sweep.name}",
        _lead(sweep, ranking),
        [section for section in sections if section.blocks],
        facts=sweep.facts,
    )


def _telling(sweep: ReportedSweep) -> list[str]:
    """Figures that differ between runs, objectives first."""
    wanted = [objective.figure for objective in sweep.objectives]
    found = []
    for name in dict.fromkeys([*wanted, *sweep.figures]):
        values = [r.figures[name] for r in sweep.runs if not r.failed and name in r.figures]
        if len(set(values)) > 1 or (values and name in wanted):
            found.append(name)
    return found[:_MOST_CHOICES]


def _lead(sweep: ReportedSweep, ranking: Ranking | None) -> list[str]:
    outcomes = Counter(run.outcome for run in sweep.runs)
    completed = outcomes.pop("completed", 0)
    others = ", ".join(f"**{count} {outcome}**" for outcome, count in outcomes.most_common())
    wanted = max(sweep.asked or 0, len(sweep.runs))
    never = wanted - len(sweep.runs)
    if never:
        begun = f"**{never} not begun**: the sweep stopped before its end"
        others = f"{others}, {begun}" if others else begun
    sentences = [f"{completed} of {wanted} runs completed{'; ' + others if others else ''}."]
    if ranking is not None and len(ranking.ranked) > 1:
        first, second = ranking.ranked[:2]
        sentence = f"**{first.name}** tracks best"
        if second.against_first > 0:
            sentence += f"; {second.name} misses by {_times(second.against_first)}"
            if second.different is False:
                sentence += ", which these runs cannot tell from equal"
        sentences.append(sentence + ".")
    if sweep.draws:
        sentences += _failures_sentence(sweep.draws)
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


def _objectives(sweep: ReportedSweep) -> Section:
    if not sweep.objectives:
        return Section("Objectives")
    front = sweep.front()
    names = [objective.figure for objective in sweep.objectives]
    words = f"Sought: {', '.join(map(_sought, sweep.objectives))}."
    section = plotted("Objectives", pareto_panels(sweep), words)
    front.sort(key=lambda run: run.figures.get(names[0], math.inf))
    keys = [key for key in sweep.keys if any(run.values.get(key) is not None for run in front)]
    kind = _kind(sweep)
    columns = [Column(kind, "name"), *(Column(sweep.title(n), _figure(n)) for n in names)]
    columns += [Column(key, _value(key)) for key in keys]
    what = f"Each {kind} that none beats in all objectives." if len(names) > 1 else "The best."
    best = table(front[:_MOST_OF_A_FRONT], columns, what)
    return Section("Objectives", section.text, [*section.blocks, *([best] if front else [])])


def _kind(sweep: ReportedSweep) -> str:
    return "trial" if sweep.trials else "run"


def _sought(objective: Objective) -> str:
    return f"the {'largest' if objective.largest else 'least'} {objective.figure}"


def _draws(draws: Draws) -> list[Section]:
    """How often drawn runs fail, and what their figures hang on: the strongest correlations."""
    columns = [
        Column("who", "who"),
        Column("draws", "draws"),
        Column("failures", "count"),
        Column("share", lambda each: _percent(each.share)),
        Column("95 % interval", _interval),
    ]
    counted = (
        f"Counted is a draw whose run ended in an error{_beyond(draws)}. The interval of 95 % is "
        "that of Clopper and Pearson for independent draws."
    )
    failures = [table(draws.failures, columns)] if draws.failures else []
    told = [each for each in draws.correlations if each.p is not None and each.p < _LEVEL]
    shown = (told or draws.correlations[:5])[:_MOST_CORRELATIONS]
    words = (
        "Spearman's rank correlation of each drawn value with each figure, the strongest first: "
        f"{len(told)} of {len(draws.correlations)} are more than chance explains (p < {_LEVEL:g}, "
        "adjusted for their number by Benjamini and Hochberg)"
    )
    if not told:
        words += "; the strongest are here, and may be chance"
    elif len(told) > len(shown):
        words += f"; the first {len(shown)} are here"
    columns = [
        Column("figure", "figure"),
        Column("who", "who"),
        Column("drawn value", "key"),
        Column("correlation", lambda each: f"{each.rho:+.2f}"),
        Column("adjusted p", "p"),
    ]
    correlations = [table(shown, columns, heads=3)] if shown else []
    return [
        Section("Failures among the draws", [counted], failures),
        Section("Sensitivities", [f"{words}."], correlations),
    ]


def _failures_sentence(draws: Draws) -> list[str]:
    """How often draws failed, for the head of the page; none where none did, or nobody counted."""
    failed = [each for each in draws.failures if each.count]
    if not failed:
        return []
    told = ", ".join(
        f"{each.who} **{each.count} of {each.draws}** ({_percent(each.share)}, 95 % interval "
        f"{_interval(each)})"
        for each in failed[:6]
    )
    more = f", and {len(failed) - 6} more" if len(failed) > 6 else ""
    return [f"Draws that failed{_beyond(draws)}: {told}{more}."]


def _beyond(draws: Draws) -> str:
    limits = ", ".join(f"{name} ≤ {bound:g}" for name, bound in draws.limits.items())
    return f", or that did not hold a limit ({limits})" if limits else ""


def _percent(share: float | None) -> str:
    return "–" if share is None else f"{100 * share:.1f} %"


def _interval(told: FailureShare) -> str:
    if told.low is None or told.high is None:
        return "–"
    return f"{100 * told.low:.1f}\u2060–\u2060{100 * told.high:.1f} %"


def _failures(sweep: ReportedSweep) -> Section:
    reasons: dict[str, list[SweepRun]] = {}
    for run in sweep.runs:
        if run.failed:
            reason = (run.problem or run.outcome).strip().splitlines() or [run.outcome]
            reasons.setdefault(reason[0][:_LONGEST_REASON], []).append(run)
    often = sorted(reasons.items(), key=lambda item: -len(item[1]))[:_MOST_REASONS]
    columns = [
        Column("runs", lambda each: len(each[1])),
        Column("why", lambda each: each[0]),
        Column("which", lambda each: _names(each[1])),
    ]
    more = len(reasons) - len(often)
    caption = f"{more} more reasons are in the table below." if more > 0 else ""
    failed = [table(often, columns, caption)] if often else []
    columns = [
        Column("file that cannot be read", lambda each: each[0]),
        Column("why", lambda each: each[1][:_LONGEST_REASON]),
    ]
    unread = [table(sweep.left_out[:_MOST_REASONS], columns)] if sweep.left_out else []
    return Section("What failed", blocks=[*failed, *unread])


def _names(runs: Sequence[SweepRun]) -> str:
    return ", ".join([run.name for run in runs[:_MOST_NAMES]] + ["…"] * (len(runs) > _MOST_NAMES))


def _all_runs(sweep: ReportedSweep) -> Section:
    figures, alike = _apart(sweep)
    keys = [key for key in sweep.keys if key not in sweep.drawn_keys]
    drawn = [key for key in sweep.keys if key in sweep.drawn_keys]
    columns = [("run", Column("run", lambda run: Judged(run.name, link=run.page)))]
    # A key that alone names who ran would say it twice.
    if len(sweep.entrants) > 1 and not any(map(sweep.names_entrants, sweep.keys)):
        columns.append(("who", Column("who", "entrant")))
    columns += [(key, Column(key, _value(key))) for key in keys]
    columns.append(("outcome", Column("outcome", "outcome")))
    columns += [(name, Column(sweep.title(name), _figure(name))) for name in figures]
    # They are many, and would push what came of them off the screen.
    columns += [(key, Column(key, _value(key))) for key in drawn]
    if any(run.problem for run in sweep.runs):
        columns.append(("problem", Column("why it failed", "problem")))
    caption = "A click on a head sorts. On paper stand the first 200 rows."
    if alike:
        same = ", ".join(f"{sweep.title(name)} {value:.4g}" for name, value in alike.items())
        caption += f" The same for all that have it: {same}."
    if len(sweep.runs) > MOST_ROWS:
        caption += f" The first {MOST_ROWS} of {len(sweep.runs)} runs."
    example = _example(sweep)
    text = f"Filter by words and by columns, `{example}` for instance; all that is typed has to "
    rows = table(
        sweep.runs[:MOST_ROWS], [column for _, column in columns], caption,
        keys=[key.lower() for key, _ in columns], example=example,
    )  # fmt: skip
    return Section("All runs", [f"{text}hold."], [rows])


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


def _example(sweep: ReportedSweep) -> str:
    """A condition that about half of the runs fulfil."""
    for name in sweep.figures:
        values = [run.figures[name] for run in sweep.runs if name in run.figures]
        if values:
            return f"{name.lower()}<{float(np.median(values)):.2g}"
    return "outcome=failed"


def _shown(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _value(key: str) -> Callable[[SweepRun], Cell]:
    return lambda run: run.values.get(key)


def _figure(name: str) -> Callable[[SweepRun], Cell]:
    return lambda run: run.figures.get(name)
