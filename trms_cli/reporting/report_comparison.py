"""The page of a few runs over one another: signals with linked axes, scores, solver times.

::

    page = comparison_page([one, other])                # ReportedRun each
    page = comparison_page(runs, ranking=rows)          # with what `trms compare` says
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from trms_cli.core.chart import Axis, Panel, Points, page_look
from trms_cli.core.findings import Cell, Judged
from trms_cli.reporting import run_panels
from trms_cli.reporting.chart_plot import plots
from trms_cli.reporting.page import Page
from trms_cli.reporting.report_run import HOW_TO_TURN, THINNED, ended, phases_of
from trms_cli.reporting.signals import ReportedRun
from trms_cli.scoring.figures import finite, part
from trms_cli.scoring.findings import compared_rows


@dataclass(frozen=True, kw_only=True)
class RankedCandidate:
    """A line of a ranking."""

    name: str  #: Who ran
    rank: int | None  #: From 1; None for one that is not ranked
    ratio: float | None  #: Its error over the best's in the same conditions, geometric mean
    low: float | None = None  #: Interval of the ratio
    high: float | None = None  #: None where there are too few rigs to tell
    against_first: float | None = None  #: Its error over the first's
    #: Whether it is told from the first; None where that cannot be said
    different: bool | None = None
    figures: Mapping[str, float | int | None]  #: Further columns, by their heads with units


def comparison_page(
    runs: Sequence[ReportedRun],
    *,
    ranking: Sequence[RankedCandidate] = (),
    rule: str = "",
    differences: Sequence[tuple[str, Sequence[str]]] = (),
    left_out: Sequence[tuple[str, str]] = (),
    title: str = "",
) -> Page:
    """The page of a comparison, ready to be written.

    Parameters
    ----------
    runs : sequence of ReportedRun
        Two or more, with names that differ.
    ranking : sequence of RankedCandidate
    rule : str
        How the rank comes about.
    differences : sequence of (str, sequence of str)
        Settings in which the runs differ, with the value of each run.
    left_out : sequence of (str, str)
        Files that could not be read, with the reason.
    title : str
        Default: the names of the runs.
    """
    names = [run.name for run in runs]
    page = Page(title or f"Comparison of {_listed(names)}", _lead(runs), _facts(runs))
    followed = _tracking(runs)
    commands = _where_there(run_panels.inputs, runs)
    solver = _where_there(run_panels.solver, runs)
    boxes = run_panels.time_boxes(runs)
    if differences:
        page.section("How they differ")
        page.table(["", *names], [[key, *values] for key, values in differences])
    if followed:
        page.section("Tracking", HOW_TO_TURN)
        page.plots(plots(followed))
    if commands:
        page.section("Commands")
        page.plots(plots(commands))
    rows = compared_rows([run.score for run in runs])
    if rows:
        page.section("Score")
        page.table(["", *names], rows, "A star: the best, where it differs by more than 0.1 %.")
    if solver:
        page.section("Solver")
        page.plots(plots([*([boxes] if boxes is not None else []), *solver]))
    phases = phases_of(runs, runs[0].channels())
    if phases:
        page.section("Phase plots", folded=True)
        page.plots(plots(phases))
    add_ranking(page, ranking, rule)
    if left_out:
        page.section("Not read")
        page.table(["file", "why"], [list(each) for each in left_out])
    page.section("How this page was made", THINNED, folded=True)
    return page


def add_ranking(page: Page, ranking: Sequence[RankedCandidate], rule: str) -> None:
    """The section of a ranking: a plot of ratios with their intervals, and the table."""
    if not ranking:
        return
    page.section("Ranking", rule)
    panel = ratio_panel(ranking)
    if panel is not None:
        page.plots(plots([panel]))
    heads = list(dict.fromkeys(head for entrant in ranking for head in entrant.figures))
    rows: list[list[Cell]] = [
        [
            entrant.rank,
            entrant.name,
            Judged(entrant.ratio, "best" if entrant.rank == 1 else ""),
            _interval(entrant),
            entrant.against_first,
            {True: "yes", False: "no", None: "–"}[entrant.different],
            *(entrant.figures.get(head) for head in heads),
        ]
        for entrant in ranking
    ]
    columns = [
        "rank",
        "who",
        "error over the best's",
        "95 % interval",
        "over the first's",
        "told apart",
    ]
    page.table([*columns, *heads], rows, heads=2)


def ratio_panel(ranking: Sequence[RankedCandidate]) -> Panel | None:
    """Ratios as dots with their intervals; None with fewer than two."""
    told = [e for e in ranking if e.ratio is not None and math.isfinite(e.ratio)]
    if len(told) < 2:
        return None
    ratios = [float(e.ratio or 0.0) for e in told]
    pairs = list(zip(told, ratios, strict=True))
    below = [0.0 if e.low is None else max(ratio - e.low, 0.0) for e, ratio in pairs]
    above = [0.0 if e.high is None else max(e.high - ratio, 0.0) for e, ratio in pairs]
    names = [e.name for e in told]
    dots = Points(ratios, range(len(told)), "", "dot", "blue", told=names, reach=(below, above))
    return Panel(
        Axis("error over the best's in the same conditions"), Axis("", categories=names), [dots],
        "error over the best's", row_height=(70 + 26 * min(len(told), 60)) / 256,
    )  # fmt: skip


def _tracking(runs: Sequence[ReportedRun]) -> list[Panel]:
    """Per channel: where all runs were, and by how much they missed."""
    where = _where_there(run_panels.tracking, runs)
    errors = _where_there(run_panels.errors, runs)
    ordered = []
    for panel in where:
        ordered += [panel, *(each for each in errors if each.title.endswith(panel.title))]
    return ordered


def _where_there(draw: Callable[..., list[Panel]], runs: Sequence[ReportedRun]) -> list[Panel]:
    """Panels of runs, in the colours of a page; none where no run has what they show."""
    try:
        return draw(runs, page_look)
    except run_panels.Absent:
        return []


def _lead(runs: Sequence[ReportedRun]) -> list[str]:
    sums = {}
    for run in runs:
        channels = part(run.score, "channels").values()
        values = [finite(part({"": own}, "").get("rmse")) for own in channels]
        if values and all(value is not None for value in values):
            sums[run.name] = sum(value for value in values if value is not None)
    sentences = []
    if len(sums) > 1:
        order = sorted(sums, key=lambda name: sums[name])
        best, worst = order[0], order[-1]
        sentences.append(
            f"**{best}** tracks best: RMSE of all channels added {sums[best]:.3g}; {worst} has "
            f"{sums[worst]:.3g}, {sums[worst] / sums[best]:.3g} times as much."
            if sums[best] > 0
            else f"**{best}** tracks without an error."
        )
    else:
        sentences.append(f"{len(runs)} runs over one another.")
    references = {run.choices["ref"] for run in runs if "ref" in run.choices}
    if len(references) > 1:
        sentences.append("They followed **different references**: their errors compare little.")
    unwell = [run.name for run in runs if run.outcome != "completed" or run.problems]
    if unwell:
        sentences.append(f"**Incomplete**: {_listed(unwell)}; scored as far as they go.")
    return sentences


def _facts(runs: Sequence[ReportedRun]) -> dict[str, str]:
    facts = {}
    for number, run in enumerate(runs):
        parts = [run.choices.get(key, "") for key in ("controller", "observer", "ref", "model")]
        seed = run.facts.get("seed")
        parts += [f"seed {seed}" if seed else "", f"{run.duration:g} s", ended(run)]
        facts[run.name or str(number)] = ", ".join(part for part in parts if part)
    return facts


def _interval(entrant: RankedCandidate) -> str:
    if entrant.low is None or entrant.high is None:
        return "–"
    return f"{entrant.low:.3f}\u2060–\u2060{entrant.high:.3f}"  # in one line


def _listed(names: Sequence[str]) -> str:
    if len(names) > 4:
        return f"{', '.join(names[:3])} and {len(names) - 3} more"
    return ", ".join(names[:-1]) + f" and {names[-1]}" if len(names) > 1 else "".join(names)
