"""The page of a few runs over one another: signals with linked axes, scores, solver times.

::

    page = comparison_page([one, other])                # ReportedRun each
    page = comparison_page(runs, ranking=rows)          # with what `trms compare` says
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from trms_cli.core.findings import Cell, Judged
from trms_cli.reporting.interactive import (
    INK,
    Plot,
    curve_style,
    framed,
    level,
    line,
    plot_text,
    significant,
    time_plot,
)
from trms_cli.reporting.page import Page
from trms_cli.reporting.report_phase import phase_plots
from trms_cli.reporting.report_run import HOW_TO_TURN, THINNED, ended
from trms_cli.reporting.report_signals import axis_title, label_of, whole_time
from trms_cli.reporting.report_solver import solver_overlay
from trms_cli.reporting.reported import FloatArray, ReportedRun, numbers
from trms_cli.scoring.figures import finite, part
from trms_cli.scoring.findings import compared_rows

_MOST_POINTS = 1_500
_NEAR = 2.5


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
    commands = _commands(runs)
    solver = solver_overlay(runs)
    timed = [*followed, *commands, *solver]
    whole_time(timed, min(run.begin for run in runs), max(run.end for run in runs))
    if differences:
        page.section("How they differ")
        page.table(["", *names], [[key, *values] for key, values in differences])
    if followed:
        page.section(
            "Tracking",
            HOW_TO_TURN,
        )
        page.plots(followed)
    if commands:
        page.section("Commands")
        page.plots(commands)
    rows = compared_rows([run.score for run in runs])
    if rows:
        page.section("Score")
        page.table(["", *names], rows, "A star: the best, where it differs by more than 0.1 %.")
    if solver:
        page.section("Solver")
        page.plots(solver)
    phases = phase_plots(runs)
    if phases:
        page.section("Phase plots", folded=True)
        page.plots(phases)
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
    plot = ratio_plot(ranking)
    if plot is not None:
        page.plots([plot])
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


def ratio_plot(ranking: Sequence[RankedCandidate]) -> Plot | None:
    """Ratios as dots with their intervals; None with fewer than two."""
    told = [e for e in ranking if e.ratio is not None and np.isfinite(e.ratio)]
    if len(told) < 2:
        return None
    plot = Plot("error over the best's", height=70 + 26 * min(len(told), 60))
    ratios = [significant(float(e.ratio or 0)) for e in told]
    below = [
        0.0 if e.low is None else significant(max(r - e.low, 0.0))
        for e, r in zip(told, ratios, strict=True)
    ]
    above = [
        0.0 if e.high is None else significant(max(e.high - r, 0.0))
        for e, r in zip(told, ratios, strict=True)
    ]
    plot.traces.append(
        {
            "type": "scatter", "mode": "markers", "x": ratios,
            "y": [plot_text(e.name) for e in told],
            "marker": {"color": "@blue", "size": 9},
            "error_x": {"type": "data", "symmetric": False, "array": above, "arrayminus": below,
                        "color": "@blue"},
            "hovertemplate": "%{y}: %{x:.4g}<extra></extra>", "name": "ratio",
        }
    )  # fmt: skip
    plot.layout = {
        "xaxis": {"title": {"text": "error over the best's in the same conditions"}},
        "yaxis": {"autorange": "reversed", "type": "category"},
        "showlegend": False,
    }
    return plot


def _tracking(runs: Sequence[ReportedRun]) -> list[Plot]:
    """Per channel: where all runs were, and by how much they missed."""
    plots = []
    for channel in dict.fromkeys(c for run in runs for c in run.channels()):
        unit = next((u for run in runs if (u := run.unit("/measurement", channel))), "rad")
        words = label_of(channel)
        where = time_plot(words, axis_title(words, unit), height=300)
        error = time_plot(
            f"tracking error of {words}", axis_title("reference − actual", unit), height=220
        )
        seen: list[FloatArray] = []
        missed: list[FloatArray] = []
        for number, run in enumerate(runs):
            colour, dash = curve_style(number)
            found, difference = run.actual(channel), run.error(channel)
            if found is not None:
                time, values, _ = found
                where.traces.append(_curve(time, values, run.name, colour, dash))
                seen.append(values)
            if difference is not None:
                error.traces.append(_curve(*difference, run.name, colour, dash))
                missed.append(difference[1])
        seen += _references(where, runs, channel)
        for plot, drawn in ((where, seen), (error, missed)):
            found_range = framed(drawn)
            if plot.traces and found_range is not None:
                plot.layout["yaxis"]["range"] = found_range
                plots.append(plot)
    return plots


def _references(plot: Plot, runs: Sequence[ReportedRun], channel: str) -> list[FloatArray]:
    """One dashed line for a reference that all share, else one each in the run's colour."""
    told = [
        (number, run.time("/reference"), numbers(run.topic("/reference")[channel]))
        for number, run in enumerate(runs)
        if channel in run.topic("/reference")
    ]
    if not told:
        return []
    _, time, values = told[0]
    shared = all(
        np.array_equal(values[: len(v)], v[: len(values)])
        and np.array_equal(time[: len(t)], t[: len(time)])
        for _, t, v in told
    )
    if shared:
        _, time, values = max(told, key=lambda each: len(each[1]))
        plot.traces.append(
            line(
                time,
                values,
                "reference",
                INK,
                dash="dash",
                steps=True,
                width=1.1,
                most=_MOST_POINTS,
            )
        )
        return [values]
    for number, time, values in told:
        colour, _ = curve_style(number)
        name = f"reference of {runs[number].name}"
        plot.traces.append(
            line(time, values, name, colour, dash="dash", steps=True, width=0.9, most=_MOST_POINTS)
        )
    return [values for _, _, values in told]


def _commands(runs: Sequence[ReportedRun]) -> list[Plot]:
    plots = []
    for name in dict.fromkeys(n for run in runs for n in run.inputs()):
        unit = next((run.unit("/command", name) for run in runs if name in run.inputs()), "")
        label = name if label_of(name) == name else f"{label_of(name)} {name}"
        plot = time_plot(label, axis_title(label, unit), height=220)
        seen = []
        for number, run in enumerate(runs):
            if name in run.topic("/command"):
                colour, dash = curve_style(number)
                values = numbers(run.topic("/command")[name])
                trace = _curve(run.time("/command"), values, run.name, colour, dash)
                trace["line"]["shape"] = "hv"
                plot.traces.append(trace)
                seen.append(values)
        found = framed(seen)
        if found is None:
            continue
        reach = max(map(abs, found))
        bounds = {b for run in runs for b in run.limits.get(name, ()) if abs(b) < _NEAR * reach}
        plot.shapes([level(float(bound)) for bound in sorted(bounds)])
        plot.layout["yaxis"]["range"] = found
        plots.append(plot)
    return plots


def _curve(
    time: FloatArray, values: FloatArray, name: str, colour: str, dash: str
) -> dict[str, Any]:
    return line(time, values, name, colour, dash=dash, width=1.5, most=_MOST_POINTS)


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
