"""The tables of ``trms compare``, at most 100 columns wide."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.padding import Padding
from rich.table import Table

from trms_cli.scoring.comparison.compared_run import ComparedRun, State
from trms_cli.scoring.comparison.document import rule
from trms_cli.scoring.comparison.figures import Figures, figures_of, worst_condition
from trms_cli.scoring.comparison.gathering import Gathered
from trms_cli.scoring.comparison.grouping import OF_ENTRANTS
from trms_cli.scoring.comparison.pair import Pair, Row
from trms_cli.scoring.comparison.ranking import (
    FEWEST_CLUSTERS,
    LEVEL,
    Interval,
    Ranking,
    Standing,
)
from trms_cli.scoring.figures import metrics

_WIDTH = 100
#: As many names of conditions, failed runs or settings are listed; JSON has all.
_MOST_LISTED = 12


def console() -> Console:
    """As wide as the terminal but no wider than 100, which is also the width of a file."""
    usual = Console()
    return usual if usual.is_terminal and usual.width <= _WIDTH else Console(width=_WIDTH)


def print_ranking(ranking: Ranking, gathered: Gathered, shown: Sequence[Standing]) -> None:
    """Who won, what that took, and what went wrong."""
    out = console()
    for line in _heading(ranking, gathered):
        out.print(line, highlight=False)
    out.print()
    figures = {standing.name: figures_of(standing, ranking.metric) for standing in shown}
    out.print(tracking_table(ranking, shown, figures))
    out.print(cost_table(shown, figures))
    failures = failure_table(shown, figures)
    if failures is not None:
        out.print(failures)
    else:
        out.print("  No run failed: no fall-back, no missed deadline, never degraded.\n")
    for line in notes(ranking, shown):
        out.print(Padding(escape(line), (0, 0, 0, 2)), style="dim")
    for line in trouble(gathered):
        out.print(line, highlight=False)


def tracking_table(
    ranking: Ranking, shown: Sequence[Standing], figures: Mapping[str, Figures]
) -> Table:
    """Tracking and robustness: errors over the best of the same condition."""
    unit = metrics()[ranking.metric].replace("{}", "rad")
    title = f"{_short(ranking.metric)}\n[{unit}]"
    table = _table("tracking", "runs", title, "over\nbest", "\n95 %", "over\nfirst", "\n95 %", "")
    for title in ("\np95", "\nworst"):
        table.add_column(title, justify="right", no_wrap=True)
    for standing in shown:
        told = figures[standing.name]
        first = standing.rank == 1
        table.add_row(
            _place(standing),
            standing.name,
            str(told.runs),
            number(told.error_mean),
            _ratio(standing.ratio),
            _between(standing.interval),
            "" if first else _ratio(standing.against_first),
            "" if first else _between(standing.against_interval),
            _mark(standing),
            _ratio(told.ratio_p95),
            _ratio(told.ratio_worst),
            style=_style(standing),
        )
    return table


def cost_table(shown: Sequence[Standing], figures: Mapping[str, Figures]) -> Table:
    """Effort and time of a step."""
    table = _table(
        "effort and time", "∫u²dt\n[V² s]", "Σ|Δu|\n[V]", "step\n[ms]", "p99\n[ms]", "longest\n[ms]"
    )
    for standing in shown:
        told = figures[standing.name]
        table.add_row(
            _place(standing),
            standing.name,
            number(told.effort),
            number(told.variation),
            *(number(value, 2) for value in (told.step_ms, told.step_p99_ms, told.step_max_ms)),
            style=_style(standing),
        )
    return table


def failure_table(shown: Sequence[Standing], figures: Mapping[str, Figures]) -> Table | None:
    """What went wrong, of those for whom something did; None if nothing did."""
    table = _table(
        "failures",
        "failed\nruns",
        "not finite\ncommands",
        "fall-backs\n[samples]",
        "deadlines\nmissed",
        "degraded\n[s]",
        "in runs",
    )
    for standing in shown:
        told = figures[standing.name]
        if not any((told.failed, told.non_finite, told.fallbacks, told.missed, told.degraded_s)):
            continue
        table.add_row(
            _place(standing),
            standing.name,
            _alarm(told.failed),
            "–" if told.non_finite is None else _alarm(told.non_finite),
            str(told.fallbacks),
            str(told.missed),
            number(told.degraded_s),
            str(told.degraded_runs),
            style=_style(standing),
        )
    return table if table.row_count else None


def notes(ranking: Ranking, shown: Sequence[Standing]) -> Iterator[str]:
    """How the table is to be read."""
    yield rule(ranking)
    if ranking.clusters >= FEWEST_CLUSTERS:
        yield (
            f"Intervals: {100 * LEVEL:.0f} % of a paired bootstrap over {ranking.clusters} rigs. "
            "≠ told from the first, = not told from it."
        )
    else:
        yield (
            f"No intervals: {ranking.clusters} rig{'s' if ranking.clusters != 1 else ''}, and they "
            f"take {FEWEST_CLUSTERS} (sweep plant.prior_seed or seed)."
        )
    first = ranking.first
    if first is not None and len(shown) > 1:
        for standing in ranking.ranked[:2]:
            where = worst_condition(standing, ranking.contest.condition_name)
            ratio = float(standing.ratios.max())
            if ratio > 1.0 + 1e-9:
                yield f"Worst of {standing.name}: {where} ({ratio:.3f} times the best)."
    if any(_is_condition(key) for key in ranking.contest.by):
        yield "Rows ran in different conditions: their errors tell as much of those as of who ran."
    outside = dict.fromkeys(
        f"{standing.name}: {standing.outside}" for standing in shown if standing.outside
    )
    if outside:
        yield f"Outside of the ranking: {'; '.join(outside)}."
    partial = [s.name for s in shown if s.rank is None and not s.outside]
    if partial:
        yield f"Not ranked, since in too few of the conditions: {', '.join(partial)}."
    if ranking.left_out:
        yield f"Left out: {ranking.left_out} conditions in which not all of the ranked ran."


def _is_condition(key: str) -> bool:
    return key.partition(".")[0].partition("@")[0] not in OF_ENTRANTS


def trouble(gathered: Gathered) -> Iterator[str]:
    """Runs that failed or did not end, and files that were passed over."""
    for state, word in ((State.FAILED, "failed"), (State.INCOMPLETE, "incomplete, not counted")):
        runs = [run for run in gathered.runs if run.state is state]
        yield from _listed(f"{len(runs)} {word}", [_sentence(run) for run in runs])
    yield from _listed(
        f"{len(gathered.left_out)} passed over",
        [f"{path}: {why}" for path, why in gathered.left_out],
    )


def print_pair(pair: Pair) -> None:
    """Two runs side by side."""
    out = console()
    for letter, run in (("A", pair.one), ("B", pair.other)):
        words = "" if run.state is State.DONE else f"  ({run.state.value}: {run.message})"
        out.print(f"{letter}  {run.path}{words}", highlight=False, soft_wrap=True)
    out.print()
    table = _table("given differently", "A", "B", numbered=False)
    for key, left, right in pair.settings[:_MOST_LISTED]:
        table.add_row(key, left, right)
    if pair.settings:
        out.print(table)
    else:
        out.print("  nothing was given differently\n", style="dim")
    if len(pair.settings) > _MOST_LISTED:
        out.print(f"  and {len(pair.settings) - _MOST_LISTED} more (--json has all)", style="dim")
    figures = _table("figure", "", "A", "B", "B − A", "", numbered=False)
    for row in pair.rows:
        figures.add_row(*_cells(row), style=_change_style(row))
    out.print(figures)


def _heading(ranking: Ranking, gathered: Gathered) -> Iterator[str]:
    contest = ranking.contest
    yield (
        f"[bold]{len(gathered.runs)} runs[/bold]: {len(contest.entrants)} entrants by "
        f"{', '.join(contest.by) or 'nothing'}, {len(contest.conditions)} conditions by "
        f"{', '.join(contest.given_by) or 'nothing'}"
    )
    first = ranking.first
    if first is not None and len(ranking.ranked) > 1:
        second = ranking.ranked[1]
        behind = 100 * (second.against_first - 1)
        words = {None: "", True: "", False: " (not told apart)"}[second.different]
        yield f"[bold]{first.name}[/bold] tracks best, {second.name} {behind:.1f} % behind{words}"


def _listed(title: str, sentences: Sequence[str]) -> Iterator[str]:
    if sentences:
        yield f"\n[bold]{title}[/bold]"
        yield from (f"  {sentence}" for sentence in sentences[:_MOST_LISTED])
        if len(sentences) > _MOST_LISTED:
            yield f"  and {len(sentences) - _MOST_LISTED} more (--json has all)"


def _sentence(run: ComparedRun) -> str:
    message = run.message.splitlines()[0] if run.message else ""
    return escape(f"{run.path}: {message}")


def _place(standing: Standing) -> str:
    return "" if standing.rank is None else str(standing.rank)


def _style(standing: Standing) -> str:
    if standing.rank == 1:
        return "bold"
    return "dim" if standing.rank is None else ""


def _mark(standing: Standing) -> str:
    if standing.rank == 1 or standing.different is None:
        return ""
    return "≠" if standing.different else "="


def _alarm(count: int) -> str:
    return f"[bold red]{count}[/]" if count else "0"


def _between(interval: Interval | None) -> str:
    return "–" if interval is None else f"{interval.low:.3f}–{interval.high:.3f}"


def _ratio(value: float) -> str:
    return "–" if math.isnan(value) else f"{value:.3f}" if value < 9.9995 else f"{value:.3g}"


def _cells(row: Row) -> tuple[str, ...]:
    values = ["–" if v is None else number(v) for v in (row.one, row.other)]
    both = row.one is not None and row.other is not None
    delta = number(row.other - row.one) if both else "–"  # type: ignore[operator]
    change = "" if row.change is None else f"{100 * row.change:+.1f} %"
    return (row.label, row.unit, *values, delta, change)


def _change_style(row: Row) -> str:
    """Colour for what moved by a hundredth and more; times belong to the machine."""
    if row.change is None or abs(row.change) < 0.01 or "time_ms" in row.key:
        return ""
    return "green" if row.change < 0 else "yellow"


def number(value: float, digits: int = 3) -> str:
    """Significant digits; a dash for what does not exist."""
    if math.isnan(value):
        return "–"
    if value == int(value) and abs(value) < 1e6:
        return str(int(value))
    if abs(value) < 1e-3:
        return f"{value:.1e}"
    if abs(value) >= 10**digits:
        return f"{value:.0f}"
    return f"{value:.{digits}g}"


def _short(metric: str) -> str:
    return {"max_abs_error": "largest"}.get(metric, metric.upper())


def _table(title: str, *columns: str, numbered: bool = True) -> Table:
    """A table whose first columns are a rank and a name, the others numbers."""
    table = Table(box=SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    if numbered:
        table.add_column("", justify="right", no_wrap=True)
    table.add_column(title, header_style="bold cyan", no_wrap=True, min_width=14)
    for column in columns:
        table.add_column(escape(column), justify="right", no_wrap=True)
    return table
