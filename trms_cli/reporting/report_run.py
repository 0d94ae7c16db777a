"""The page of one run: a sentence, facts, time plots with linked axes, solver, score.

::

    page = run_page(run)          # a ReportedRun
    page.write(folder / "report.html")

From a notebook, with a log's path: :func:`trms_cli.library.report.pages.report_page`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

from trms_cli.core import wording
from trms_cli.core.chart import Panel, page_look
from trms_cli.reporting import run_panels
from trms_cli.reporting.chart_plot import MOST_POINTS, plots
from trms_cli.reporting.page import Page
from trms_cli.reporting.page_rows import RowCell, RowColumn
from trms_cli.reporting.signals import ReportedRun, RunSignals
from trms_cli.scoring.findings import answer, measures_of, tables_of, warnings_of

_MOST_EVENTS = 500
_LONGEST_CONFIG = 200_000  # characters
#: Options that are named under the lead, with the words for them.
_PARTS = {
    "model": "model", "plant": "rig", "effect": "effects", "fault": "faults",
    "observer": "observer", "controller": "controller", "ref": "reference",
    "supervisor": "supervisor",
}  # fmt: skip

THINNED = (
    f"Curves of more than {MOST_POINTS} samples are thinned: of each stretch of the time the least "
    "and the largest sample are kept, so that no peak is lost. The log has all of them."
)

HOW_TO_TURN = (
    "Drag over a time to enlarge it, or use the buttons: all plots follow. A double click goes "
    "back; a click on a name hides its curve."
)


def run_page(run: ReportedRun, *, title: str = "") -> Page:
    """The page of a run, ready to be written.

    Parameters
    ----------
    run : ReportedRun
    title : str
        Default: what ran against what, and the run's name.
    """
    page = Page(title or title_of(run), _lead(run), _facts(run), measures_of(run.score))
    channels, commands = run.channels(), run_panels.command_panel(run)
    first = [run_panels.channel_panel(run, name, detail=True) for name in channels]
    first += [commands] if commands is not None else []
    if first:
        marks = run_panels.event_marks(run)
        first[0] = replace(first[0], marks=[*first[0].marks, *marks])
    torques = [replace(panel, half=True) for panel in run_panels.torque_panels(run)]
    inner = [*run_panels.state_panels(run), *torques]
    innovations = run_panels.innovation_panels(run)
    predictions = run_panels.fan_panels(run)
    solver = run_panels.solver_panels(run)
    timed = [*first, *inner, *innovations, *predictions, *solver]
    if not timed:
        page.section("Nothing to draw", "The log holds no sample of any signal.")
    if first:
        page.section("Angles and commands", HOW_TO_TURN)
        page.plots(plots(first))
    tables = tables_of(run.score)
    if tables:
        page.section("Score", [f"{words}." for words in warnings_of(run.score)])
        for table in tables:
            page.table(table.columns, table.rows, table.caption, heads=table.heads)
    if inner:
        page.section("Speeds, rates and torques")
        page.plots(plots(inner))
    if innovations:
        page.section(
            "Innovations",
            "Measured minus foretold by the observer. Those of a consistent observer stay within "
            "the band for 95 % of the samples, without a pattern.",
            folded=True,
        )
        page.plots(plots(innovations))
    phases = phases_of([run], channels)
    if phases:
        page.section("Phase plots", folded=True)
        page.plots(plots(phases))
    if predictions:
        page.section(
            "Predictions",
            "What the controller expected, each from the moment it was made. The slider chooses "
            "the bold one.",
        )
        page.plots(plots(predictions))
    if solver:
        page.section("Solver")
        page.plots(plots(solver))
    _events(page, run)
    page.section("How this page was made", THINNED, folded=True)
    if run.command:
        page.text("What was typed:")
        page.command(run.command)
    if run.config:
        page.details("The whole configuration", _cut(run.config))
    return page


def phases_of(runs: Sequence[RunSignals], channels: Sequence[str]) -> list[Panel]:
    """Each of the first channels against its rate, and the first two against each other."""
    panels = run_panels.phase_panels(runs, channels[:4], page_look)
    path = None
    if len(channels) > 1:
        path = run_panels.path_panel(runs, channels[1], channels[0], page_look)
    return [*panels, path] if path is not None else panels


def title_of(run: ReportedRun) -> str:
    """``newton_mpc on square: first``; without choices the name alone."""
    controller, reference = run.choices.get("controller", ""), run.choices.get("ref", "")
    what = controller
    if controller and reference and "/reference" in run.tables:
        what = f"{controller} on {reference}"
    return f"{what}: {run.name}" if what else run.name


def ended(run: ReportedRun) -> str:
    """How it ended, in a word or two."""
    return {"completed": "completed", "died": "did not end"}.get(run.outcome, f"was {run.outcome}")


def _lead(run: ReportedRun) -> list[str]:
    who = run.choices.get("controller") or "The run"
    score = {"duration_s": run.duration} | dict(run.score)
    injected = sum(event.kind == "fault_injected" for event in run.events)
    held = sum(event.kind == "fault" for event in run.events)
    more = [f"{wording.count(injected, 'fault')} injected"] if injected else []
    if held:
        more.append(f"**{wording.count(held, 'command')} that were no numbers**")
    sentence = answer(score, who)
    return [", ".join([sentence[:-1], *more]) + ".", *_problems(run)]


def _problems(run: ReportedRun) -> list[str]:
    told = list(run.problems)
    if run.outcome != "completed" and not told:
        told = [f"the run {ended(run)}"]
    if not told:
        return []
    return [f"**Incomplete**: {'; '.join(told)}. What follows goes as far as the log does."]


def _facts(run: ReportedRun) -> dict[str, str]:
    facts = {words: run.choices[group] for group, words in _PARTS.items() if run.choices.get(group)}
    facts |= {"outcome": ended(run), "duration": f"{run.duration:g} s"}
    facts |= dict(run.facts)
    if run.repeat:
        facts["the same again"] = f"`{run.repeat.replace('`', chr(39))}`"
    return facts


def _events(page: Page, run: ReportedRun) -> None:
    if not run.events:
        return
    counts = Counter(event.kind for event in run.events)
    page.section(
        "Events",
        "; ".join(f"{kind} {count}" for kind, count in counts.most_common(20)) + ".",
        folded=True,
    )
    columns = [
        RowColumn("time [s]", "time", number=True, decimals=2),
        RowColumn("what", "what"),
        RowColumn("where", "where"),
        RowColumn("in words", "words"),
        RowColumn("value", "value", number=True),
    ]
    rows: list[list[RowCell]] = [
        [e.time, e.kind, e.source, e.message, e.value] for e in run.events[:_MOST_EVENTS]
    ]
    left = len(run.events) - len(rows)
    more = f"The first {_MOST_EVENTS}; {left} more are in the log." if left else ""
    page.rows(columns, rows, more, example="what=fault")


def _cut(text: str) -> str:
    if len(text) <= _LONGEST_CONFIG:
        return text
    return text[:_LONGEST_CONFIG] + f"\n… ({len(text) - _LONGEST_CONFIG} more characters)"
