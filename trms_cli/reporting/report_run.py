"""What a page tells of one run: a sentence, time plots with linked axes, solver, score.

::

    findings = findings_of_run(run)          # a ReportedRun
    write_page(findings, folder / "report.html", pictures=False)

From a notebook, with a log's path: :func:`trms_cli.library.report.pages.report_of`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

from trms_cli.core import wording
from trms_cli.core.chart import Chart, Panel, page_look
from trms_cli.core.findings import (
    Block,
    Column,
    Details,
    Findings,
    Judged,
    NextCommand,
    Section,
    table,
)
from trms_cli.reporting import run_panels
from trms_cli.reporting.chart_plot import MOST_POINTS
from trms_cli.reporting.signals import ReportedRun, RunEvent, RunSignals
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

#: The heading of what stands at the end.
MADE = "How this page was made"
HOW_TO_TURN = (
    "Drag over a time to enlarge it, or use the buttons: all plots follow. A double click goes "
    "back; a click on a name hides its curve."
)


def findings_of_run(run: ReportedRun, *, title: str = "") -> Findings:
    """What a page tells of a run; its `title` is by default what ran against what, and its name."""
    channels, commands = run.channels(), run_panels.command_panel(run)
    first = [run_panels.channel_panel(run, name, detail=True) for name in channels]
    first += [commands] if commands is not None else []
    if first:
        marks = run_panels.event_marks(run)
        first[0] = replace(first[0], marks=[*first[0].marks, *marks])
    torques = [replace(panel, half=True) for panel in run_panels.torque_panels(run)]
    sections = [
        plotted("Angles and commands", first, HOW_TO_TURN),
        Section("Score", [f"{words}." for words in warnings_of(run.score)], tables_of(run.score)),
        plotted("Speeds, rates and torques", [*run_panels.state_panels(run), *torques]),
        plotted(
            "Innovations",
            run_panels.innovation_panels(run),
            "Measured minus foretold by the observer. Those of a consistent observer stay within "
            "the band for 95 % of the samples, without a pattern.",
            folded=True,
        ),
        plotted("Phase plots", phases_of([run], channels), folded=True),
        plotted(
            "Predictions",
            run_panels.fan_panels(run),
            "What the controller expected, each from the moment it was made. The slider chooses "
            "the bold one.",
        ),
        plotted("Solver", run_panels.solver_panels(run)),
        _events(run),
    ]
    sections = [section for section in sections if section.blocks]
    if not any(isinstance(block, Chart) for section in sections for block in section.blocks):
        sections.insert(0, Section("Nothing to draw", ["The log holds no sample of any signal."]))
    made: list[Block] = [NextCommand(run.command, "What was typed:")] if run.command else []
    made += [Details("The whole configuration", _cut(run.config))] if run.config else []
    sections.append(Section(MADE, [THINNED], made, folded=True))
    return Findings(
        title or title_of(run), _lead(run), sections, measures=measures_of(run.score),
        facts=_facts(run),
    )  # fmt: skip


def plotted(
    heading: str, panels: Sequence[Panel], text: str = "", *, folded: bool = False
) -> Section:
    """A section with panels under one another; without a block where there are none."""
    name = heading.lower().replace(" ", "_")
    return Section(heading, [text], [Chart(name, panels, columns=1)] if panels else [], folded)


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


def _events(run: ReportedRun) -> Section:
    counts = Counter(event.kind for event in run.events).most_common(20)
    columns = [
        Column("time [s]", _time),
        Column("what", "kind"),
        Column("where", "source"),
        Column("in words", "message"),
        Column("value", "value"),
    ]
    left = len(run.events) - _MOST_EVENTS
    more = f"The first {_MOST_EVENTS}; {left} more are in the log." if left > 0 else ""
    keys = ("time", "what", "where", "words", "value")
    rows = table(run.events[:_MOST_EVENTS], columns, more, keys=keys, example="what=fault")
    words = "; ".join(f"{kind} {count}" for kind, count in counts)
    return Section("Events", [f"{words}."], [rows] if run.events else [], folded=True)


def _time(event: RunEvent) -> Judged:
    return Judged(event.time, sd=0.1)  # to a hundredth of a second


def _cut(text: str) -> str:
    if len(text) <= _LONGEST_CONFIG:
        return text
    return text[:_LONGEST_CONFIG] + f"\n… ({len(text) - _LONGEST_CONFIG} more characters)"
