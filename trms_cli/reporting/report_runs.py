"""What a page tells of a run, or of a few over one another: signals, solver times, scores.

::

    findings = findings_of_run(run)          # a RunReport
    findings = findings_of_comparison([one, other], ranking=ranking)  # with what `compare` says
    write_page(findings, folder / "report.html", pictures=False)

From a notebook, with a log's path: :func:`trms_cli.library.report.pages.report_of`.
"""

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace

from trms_cli.core import wording
from trms_cli.core.chart import Axis, Chart, Panel, Points, page_look
from trms_cli.core.findings import (
    Block,
    Column,
    Datum,
    Details,
    Findings,
    Measure,
    NextCommand,
    Section,
    Table,
    table,
)
from trms_cli.reporting import plot_kinds, run_panels
from trms_cli.reporting.chart_plot import MOST_POINTS
from trms_cli.reporting.signals import RunEvent, RunReport, RunSignals
from trms_cli.scoring.comparison.findings import ranking_tables
from trms_cli.scoring.comparison.ranking import Ranking, Standing
from trms_cli.scoring.figures import finite, part
from trms_cli.scoring.findings import answer, comparison_rows, measures_of, tables_of, warnings_of

_MOST_EVENTS = 500
_LONGEST_CONFIG = 200_000  # characters
#: Options that are named under the lead, with the words for them.
_PARTS = {
    "model": "model",
    "plant": "rig",
    "effect": "effects",
    "fault": "faults",
    "observer": "observer",
    "controller": "controller",
    "ref": "reference",
    "supervisor": "supervisor",
}

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


def findings_of_run(run: RunReport, *, title: str = "") -> Findings:
    """What a page tells of a run; its `title` is by default what ran against what, and its name."""
    channels, commands = run.channels(), run_panels.command_panel(run)
    first = [run_panels.channel_panel(run, name, detail=True) for name in channels]
    first += [commands] if commands is not None else []
    if first:
        marks = run_panels.event_marks(run)
        first[0] = replace(first[0], marks=[*first[0].marks, *marks])
    torques = [replace(panel, half=True) for panel in run_panels.torque_panels(run)]
    positions = any(run.unit("/measurement", name) == "m" for name in channels)
    sections = [
        plot_section(
            "Positions and commands" if positions else "Angles and commands", first, HOW_TO_TURN
        ),
        Section("Score", [f"{words}." for words in warnings_of(run.score)], tables_of(run.score)),
        plot_section("Speeds, rates and torques", [*run_panels.state_panels(run), *torques]),
        plot_section(
            "Innovations",
            run_panels.innovation_panels(run),
            "Measured minus foretold by the observer. Those of a consistent observer stay within "
            "the band for 95 % of the samples, without a pattern.",
            folded=True,
        ),
        plot_section("Phase plots", phases_of([run], channels), folded=True),
        plot_section(
            "Predictions",
            run_panels.fan_panels(run),
            "What the controller expected, each from the moment it was made. The slider chooses "
            "the bold one.",
        ),
        plot_section("Solver", run_panels.solver_panels(run)),
        _events(run),
    ]
    sections = [section for section in sections if section.blocks]
    if not any(isinstance(block, Chart) for section in sections for block in section.blocks):
        sections.insert(0, Section("Nothing to draw", ["The log holds no sample of any signal."]))
    origin: list[Block] = [NextCommand(run.command, "What was typed:")] if run.command else []
    origin += [Details("The whole configuration", _cut(run.config))] if run.config else []
    sections.append(Section(MADE, [THINNED], origin, folded=True))
    return Findings(
        title or title_of(run),
        _lead(run),
        sections,
        measures=measures_of(run.score),
        facts=_facts(run),
    )


def plot_section(
    heading: str, panels: Sequence[Panel], text: str = "", *, folded: bool = False
) -> Section:
    """A section with panels under one another; without a block where there are none."""
    name = heading.lower().replace(" ", "_")
    return Section(heading, [text], [Chart(name, panels, columns=1)] if panels else [], folded)


def phases_of(runs: Sequence[RunSignals], channels: Sequence[str]) -> list[Panel]:
    """Each of the first channels against its rate, and the first two against each other."""
    panels = plot_kinds.phase_panels(runs, channels[:4], page_look)
    path = None
    if len(channels) > 1:
        path = plot_kinds.path_panel(runs, channels[1], channels[0], page_look)
    return [*panels, path] if path is not None else panels


def title_of(run: RunReport) -> str:
    """``newton_mpc on square, model fit, plant simulated (newtonian): first``.

    Without choices the name alone.
    """
    controller, reference = run.choices.get("controller", ""), run.choices.get("ref", "")
    what = controller
    if controller and reference and "/reference" in run.tables:
        what = f"{controller} on {reference}"
    parts = [what] if what else []
    parts += [f"model {run.choices['model']}"] if run.choices.get("model") else []
    parts += [f"plant {plant}"] if (plant := wording.plant_name(run.choices)) else []
    return f"{', '.join(parts)}: {run.name}" if parts else run.name


def run_ending(run: RunReport) -> str:
    """How it ended, in a word or two."""
    return {"completed": "completed", "died": "did not end"}.get(run.outcome, f"was {run.outcome}")


def _lead(run: RunReport) -> list[str]:
    who = run.choices.get("controller") or "The run"
    score = {"duration_s": run.duration} | dict(run.score)
    injected = sum(event.kind == "fault_injected" for event in run.events)
    invalid_commands = sum(event.kind == "fault" for event in run.events)
    more = [f"{wording.count(injected, 'fault')} injected"] if injected else []
    if invalid_commands:
        more.append(f"**{wording.count(invalid_commands, 'command')} that were no numbers**")
    sentence = answer(score, who)
    return [", ".join([sentence[:-1], *more]) + ".", *_problems(run)]


def _problems(run: RunReport) -> list[str]:
    reasons = list(run.problems)
    if run.outcome != "completed" and not reasons:
        reasons = [f"the run {run_ending(run)}"]
    if not reasons:
        return []
    return [f"**Incomplete**: {'; '.join(reasons)}. What follows goes as far as the log does."]


def _facts(run: RunReport) -> dict[str, str]:
    facts = {words: run.choices[group] for group, words in _PARTS.items() if run.choices.get(group)}
    facts |= {"rig": plant} if (plant := wording.plant_name(run.choices)) else {}
    facts |= {"outcome": run_ending(run), "duration": f"{run.duration:g} s"}
    facts |= dict(run.facts)
    if run.repeat:
        facts["the same again"] = f"`{run.repeat.replace('`', chr(39))}`"
    return facts


def _events(run: RunReport) -> Section:
    counts = Counter(event.kind for event in run.events).most_common(20)
    columns = [
        Column("time [s]", _time),
        Column("what", "kind"),
        Column("where", "source"),
        Column("in words", "message"),
        Column("value", "value"),
    ]
    remainder = len(run.events) - _MOST_EVENTS
    more = f"The first {_MOST_EVENTS}; {remainder} more are in the log." if remainder > 0 else ""
    keys = ("time", "what", "where", "words", "value")
    rows = table(run.events[:_MOST_EVENTS], columns, more, keys=keys, example="what=fault")
    words = "; ".join(f"{kind} {count}" for kind, count in counts)
    return Section("Events", [f"{words}."], [rows] if run.events else [], folded=True)


def _time(event: RunEvent) -> Datum:
    return Datum(event.time, sd=0.1)  # to a hundredth of a second


def _cut(text: str) -> str:
    if len(text) <= _LONGEST_CONFIG:
        return text
    return text[:_LONGEST_CONFIG] + f"\n… ({len(text) - _LONGEST_CONFIG} more characters)"


def findings_of_comparison(
    runs: Sequence[RunReport],
    *,
    ranking: Ranking | None = None,
    differences: Sequence[tuple[str, Sequence[str]]] = (),
    left_out: Sequence[tuple[str, str]] = (),
    title: str = "",
) -> Findings:
    """What a page tells of two runs or more, with names that differ.

    `differences`: settings in which the runs differ, with the value of each run. `left_out`: files
    that could not be read, with the reason. `title`: by default the names of the runs.
    """
    names = [run.name for run in runs]
    boxes = plot_kinds.time_boxes(runs)
    solver = _where_there(plot_kinds.solver, runs)
    settings_table = Table(["", *names], [[key, *values] for key, values in differences])
    best = "A star: the best, where it differs by more than 0.1 %."
    scores = Table(["", *names], comparison_rows([run.score for run in runs]), best)
    missing = Table(["file", "why"], [list(each) for each in left_out])
    sections = [
        Section("How they differ", blocks=[settings_table] if settings_table.rows else []),
        plot_section("Tracking", _tracking(runs), HOW_TO_TURN),
        plot_section("Commands", _where_there(plot_kinds.inputs, runs)),
        Section("Score", blocks=[scores] if scores.rows else []),
        plot_section("Solver", [boxes, *solver] if boxes is not None else solver),
        plot_section("Phase plots", phases_of(runs, runs[0].channels()), folded=True),
        ranking_section(ranking),
        Section("Not read", blocks=[missing] if missing.rows else []),
    ]
    return Findings(
        title or f"Comparison of {_listed(names)}",
        _lead_of_all(runs),
        [*(each for each in sections if each.blocks), Section(MADE, [THINNED], folded=True)],
        measures=_measures_of_all(runs),
        facts=_facts_of_all(runs),
    )


def ranking_section(ranking: Ranking | None) -> Section:
    """A ranking: its ratios with their intervals, and its tables; without a block for none."""
    if ranking is None:
        return Section("Ranking")
    section = plot_section("Ranking", _ratios(ranking.standings))
    return Section("Ranking", blocks=[*section.blocks, *ranking_tables(ranking, ranking.standings)])


def _ratios(standings: Sequence[Standing]) -> list[Panel]:
    """Ratios as dots with their intervals; none with fewer than two."""
    entrants = [each for each in standings if math.isfinite(each.ratio)]
    if len(entrants) < 2:
        return []
    ends = [(each.ratio, each.interval) for each in entrants]
    below = [0.0 if i is None else max(ratio - i.low, 0.0) for ratio, i in ends]
    above = [0.0 if i is None else max(i.high - ratio, 0.0) for ratio, i in ends]
    names = [each.name for each in entrants]
    dots = Points(
        [each.ratio for each in entrants],
        range(len(entrants)),
        "",
        "dot",
        "blue",
        tooltips=names,
        reach=(below, above),
    )
    return [
        Panel(
            Axis("times the best's error"),
            Axis("", categories=names),
            [dots],
            "error over the best's",
            caption="In the same conditions, with 95 % intervals where there are several.",
            row_height=(70 + 26 * min(len(entrants), 60)) / 256,
        )
    ]


def _tracking(runs: Sequence[RunReport]) -> list[Panel]:
    """Per channel: where all runs were, and by how much they missed."""
    where = _where_there(plot_kinds.tracking, runs)
    errors = _where_there(plot_kinds.errors, runs)
    ordered = []
    for panel in where:
        ordered += [panel, *(each for each in errors if each.title.endswith(panel.title))]
    return ordered


def _where_there(draw: Callable[..., list[Panel]], runs: Sequence[RunReport]) -> list[Panel]:
    """Panels of runs, in the colours of a page; none where no run has what they show."""
    try:
        return draw(runs, page_look)
    except plot_kinds.Absent:
        return []


def _rmse_sums(runs: Sequence[RunReport]) -> dict[str, float]:
    """RMSE of all channels added, of the runs that have it, by their names."""
    sums = {}
    for run in runs:
        channels = part(run.score, "channels").values()
        values = [finite(part({"": own}, "").get("rmse")) for own in channels]
        if values and all(value is not None for value in values):
            sums[run.name] = sum(value for value in values if value is not None)
    return sums


def _measures_of_all(runs: Sequence[RunReport]) -> list[Measure]:
    """How well each run tracks, the best marked."""
    sums = _rmse_sums(runs)
    units = {
        str(part({"": own}, "").get("unit", ""))
        for run in runs
        for own in part(run.score, "channels").values()
    }
    unit = units.pop() if len(units) == 1 else ""
    least = min(sums.values(), default=0.0)
    return [
        Measure(name, value, unit, "good" if value == least else "", "RMSE of all channels added")
        for name, value in sums.items()
    ]


def _lead_of_all(runs: Sequence[RunReport]) -> list[str]:
    sums = _rmse_sums(runs)
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


def _facts_of_all(runs: Sequence[RunReport]) -> dict[str, str]:
    facts = {}
    for number, run in enumerate(runs):
        parts = [run.choices.get(key, "") for key in ("controller", "observer", "ref", "model")]
        seed = run.facts.get("seed")
        parts += [f"seed {seed}" if seed else "", f"{run.duration:g} s", run_ending(run)]
        facts[run.name or str(number)] = ", ".join(part for part in parts if part)
    return facts


def _listed(names: Sequence[str]) -> str:
    return wording.listing(names, most=4 if len(names) == 4 else 3)
