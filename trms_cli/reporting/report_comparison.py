"""What a page tells of a few runs over one another: signals, scores, solver times, who won.

::

    findings = findings_of_comparison([one, other])                # ReportedRun each
    findings = findings_of_comparison(runs, ranking=ranking)       # with what `trms compare` says
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from trms_cli.core.chart import Axis, Panel, Points, page_look
from trms_cli.core.findings import Findings, Section, Table
from trms_cli.reporting import run_panels
from trms_cli.reporting.report_run import HOW_TO_TURN, MADE, THINNED, ended, phases_of, plotted
from trms_cli.reporting.signals import ReportedRun
from trms_cli.scoring.comparison.findings import ranking_tables
from trms_cli.scoring.comparison.ranking import Ranking, Standing
from trms_cli.scoring.figures import finite, part
from trms_cli.scoring.findings import compared_rows


def findings_of_comparison(
    runs: Sequence[ReportedRun],
    *,
    ranking: Ranking | None = None,
    differences: Sequence[tuple[str, Sequence[str]]] = (),
    left_out: Sequence[tuple[str, str]] = (),
    title: str = "",
) -> Findings:
    """What a page tells of two runs or more, with names that differ.

    Parameters
    ----------
    differences : sequence of (str, sequence of str)
        Settings in which the runs differ, with the value of each run.
    left_out : sequence of (str, str)
        Files that could not be read, with the reason.
    title : str
        Default: the names of the runs.
    """
    names = [run.name for run in runs]
    boxes = run_panels.time_boxes(runs)
    solver = _where_there(run_panels.solver, runs)
    given = Table(["", *names], [[key, *values] for key, values in differences])
    best = "A star: the best, where it differs by more than 0.1 %."
    scores = Table(["", *names], compared_rows([run.score for run in runs]), best)
    missing = Table(["file", "why"], [list(each) for each in left_out])
    sections = [
        Section("How they differ", blocks=[given] if given.rows else []),
        plotted("Tracking", _tracking(runs), HOW_TO_TURN),
        plotted("Commands", _where_there(run_panels.inputs, runs)),
        Section("Score", blocks=[scores] if scores.rows else []),
        plotted("Solver", [boxes, *solver] if boxes is not None else solver),
        plotted("Phase plots", phases_of(runs, runs[0].channels()), folded=True),
        ranked(ranking),
        Section("Not read", blocks=[missing] if missing.rows else []),
    ]
    return Findings(
        title or f"Comparison of {_listed(names)}",
        _lead(runs),
        [*(each for each in sections if each.blocks), Section(MADE, [THINNED], folded=True)],
        facts=_facts(runs),
    )


def ranked(ranking: Ranking | None) -> Section:
    """A ranking: its ratios with their intervals, and its tables; without a block for none."""
    if ranking is None:
        return Section("Ranking")
    section = plotted("Ranking", _ratios(ranking.standings))
    return Section("Ranking", blocks=[*section.blocks, *ranking_tables(ranking, ranking.standings)])


def _ratios(standings: Sequence[Standing]) -> list[Panel]:
    """Ratios as dots with their intervals; none with fewer than two."""
    told = [each for each in standings if math.isfinite(each.ratio)]
    if len(told) < 2:
        return []
    ends = [(each.ratio, each.interval) for each in told]
    below = [0.0 if i is None else max(ratio - i.low, 0.0) for ratio, i in ends]
    above = [0.0 if i is None else max(i.high - ratio, 0.0) for ratio, i in ends]
    names = [each.name for each in told]
    dots = Points([each.ratio for each in told], range(len(told)), "", "dot", "blue", told=names,
                  reach=(below, above))  # fmt: skip
    return [
        Panel(
            Axis("error over the best's in the same conditions"), Axis("", categories=names),
            [dots], "error over the best's", row_height=(70 + 26 * min(len(told), 60)) / 256,
        )
    ]  # fmt: skip


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


def _listed(names: Sequence[str]) -> str:
    if len(names) > 4:
        return f"{', '.join(names[:3])} and {len(names) - 3} more"
    return ", ".join(names[:-1]) + f" and {names[-1]}" if len(names) > 1 else "".join(names)
