"""What a diagnosis rests on: the race, the missing force, the gap before and after, the tests."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from trms_cli.core import chart as draw
from trms_cli.core import findings as report
from trms_cli.core import wording
from trms_cli.gap.diagnosis import (
    LEAST,
    NO_EFFECT,
    DiagnosisResult,
    FittedParameter,
    GapTest,
    RaceEntry,
    Shrink,
    Traces,
    compared_with_a_state,
    confusable_with,
    is_corrected,
    likeliest,
    shown_horizon,
)
from trms_cli.gap.wording import cause_name, place_name
from trms_cli.identification.findings import near

#: Verdicts after which the missing force itself is described: a cause says more of it.
_UNNAMED = ("none_of_these", "undecided")
#: nats within which two competitors are level.
_LEVEL = 3.0
#: Prior standard deviations from which a parameter has moved far.
_FAR = 2.5
#: Rows of a table and bars of the race; the JSON has all.
_MOST_PARAMETERS, _MOST_BARS = 12, 14
#: Probabilities below which digits mean nothing.
_SMALLEST = 1e-6
#: s of the part of a force that is enlarged.
_ENLARGED = 15.0
_WIDTH = 9.2
#: Heads of the tables of the gap.
_LENGTH, _CLOSED = "free run [s]", ("closed", "95 % interval")
#: Models of the pictures: name, colour, line.
_RUNS: Mapping[str, tuple[str, draw.Colour, draw.Style]] = {
    "raw": ("as it was", "grey", "dashed"),
    "refit": ("refitted", "vermilion", "solid"),
    "corrected": ("corrected", "blue", "solid"),
}


def evidence_sections(
    diagnosis: DiagnosisResult, remarks: Sequence[str]
) -> list[report.Section | None]:
    """What the answer rests on, a section each; None for what this diagnosis has nothing of.

    ``remarks``: what was found in the recordings and what was done to them.
    """
    return [
        _race(diagnosis),
        _force(diagnosis),
        _before_and_after(diagnosis),
        _tests(diagnosis),
        _testability(diagnosis),
        _parameters(diagnosis),
        _recordings(diagnosis, remarks),
    ]


def _is_effect(effects: Sequence[str]) -> bool:
    """Whether a competitor of the race consists of effects."""
    return bool(effects) and not set(effects) & {"flexible", *NO_EFFECT}


def _winner(diagnosis: DiagnosisResult) -> RaceEntry | None:
    """The competitor that is the likeliest answer; the best score where it is no effect."""
    entries = [entry for entry in diagnosis.race if _is_effect(entry.effects)]
    first = likeliest(diagnosis)
    for entry in entries:
        if first is not None and entry.effects == first.effects:
            return entry
    return max(entries, key=lambda entry: entry.score, default=None)


def _race(diagnosis: DiagnosisResult) -> report.Section | None:
    if not diagnosis.race:
        return None
    words, chart = _race_words(diagnosis), race_chart(diagnosis)
    return report.Section("The race of the candidates", [words], [chart])


def _race_words(diagnosis: DiagnosisResult) -> str:
    """Who won, by how much, and whether a force without a name did better."""
    best, compared = _winner(diagnosis), compared_with_a_state(diagnosis)
    if best is None:
        return "No candidate ran."
    name = cause_name(best.effects)
    text = f"{name[0].upper()}{name[1:]} "
    if compared:
        way = "more" if best.score >= 0 else "less"
        text += f"is {abs(best.score):.0f} nats {way} probable, by what is recorded, than that "
        text += "nothing changed."
    else:
        text += f"foretells held-out blocks {_apart(best)} than the refitted model."
    others = [e for e in diagnosis.race if _is_effect(e.effects) and e is not best]
    second = max(others, key=lambda entry: entry.score, default=None)
    if second is not None:
        name, lead = cause_name(second.effects), best.score - second.score
        if abs(lead) < _LEVEL:
            text += f" Level with it is {name}."
        elif lead > 0:
            text += f" Next is {name}, {lead:.0f} nats below."
        else:
            why = "was less to be expected" if compared else "has more to adjust"
            text += f" Above it is {name} by {-lead:.0f} nats, which {why}."
    flexible = next((e for e in diagnosis.race if tuple(e.effects) == ("flexible",)), None)
    if flexible is not None:
        if flexible.score > best.score + 2 * (_se(flexible) + _se(best)):
            text += " **A force without a name does clearly better**: something else is missing."
        elif flexible.score <= best.score:
            text += " A force without a name, free to be anything, does no better."
    return text


def _apart(entry: RaceEntry) -> str:
    """A score above the refitted model's: ``12 ± 3 nats better``."""
    way = "better" if entry.score >= 0 else "worse"
    spread = "" if entry.se is None else f" ± {entry.se:.0f}"
    return f"{abs(entry.score):.0f}{spread} nats {way}"


def _se(entry: RaceEntry) -> float:
    return entry.se or 0.0


def _result(entry: RaceEntry) -> str:
    """What the race says of an effect that is hardly testable."""
    return _apart(entry) + ("" if _beats_no_effect(entry) else ": not told apart")


def race_chart(diagnosis: DiagnosisResult) -> draw.Chart:
    """Bars of the held-out score of each competitor above the refitted model's."""
    entries = sorted((e for e in diagnosis.race if np.isfinite(e.score)), key=lambda e: -e.score)
    bar_entries = entries[:_MOST_BARS]
    bar_entries += [e for e in entries[_MOST_BARS:] if not _is_effect(e.effects)]
    best, first = _winner(diagnosis), likeliest(diagnosis)
    alike = {cause.effects for cause in (confusable_with(first, diagnosis) if first else ())}
    hardly = _hardly_testable(diagnosis)
    top = max([e.score + (_se(e) if _is_effect(e.effects) else 0.0) for e in bar_entries] + [1.0])
    low = min(0.0, max(min((e.score for e in bar_entries), default=0.0), -0.25 * top))

    def colour(entry: RaceEntry) -> draw.Colour:
        if not _is_effect(entry.effects):
            return "pale"
        if best is not None and entry.effects == best.effects:
            return "blue"
        return "sky" if entry.effects in alike else "grey"

    def whisker(entry: RaceEntry) -> float:
        has_one = entry.se is not None and _is_effect(entry.effects) and entry.score >= low
        return _se(entry) if has_one else np.nan

    def note(entry: RaceEntry) -> str:
        if entry.effects in alike:
            return "not significantly different from the best"
        is_none = entry in hardly.values() and not _beats_no_effect(entry)
        return "not significantly different from no effect" if is_none else ""

    bars = draw.Bars(
        [cause_name(e.effects) if e.effects != ("no_gap",) else "as it was" for e in bar_entries],
        [max(e.score, low) for e in bar_entries],
        [colour(e) for e in bar_entries],
        [whisker(e) for e in bar_entries],
        [note(e) for e in bar_entries],
    )
    label = "held-out log density above the refitted model"
    caption = (
        "How much better each candidate, fitted together with the model's parameters, foretells "
        "blocks that it was not fitted to, one step ahead; whiskers: one standard error."
    )
    if compared_with_a_state(diagnosis):
        label = "log evidence above that nothing changed"
        caption = (
            "How much more probable the missing forces are with each difference than with none, "
            "averaged over its sizes and onsets."
        )
    axis = draw.Axis(label, "nats", (1.05 * low, 1.04 * top))
    return draw.Chart(
        "race",
        [draw.Panel(axis, draw.Axis(""), [bars])],
        caption,
        columns=1,
        width=_WIDTH,
        height=0.8 + 0.27 * len(bar_entries),
    )


def _force(diagnosis: DiagnosisResult) -> report.Section | None:
    blocks: list[report.Block] = []
    if diagnosis.traces is not None:
        order = [place.location for place in diagnosis.where if place.share >= 0.02]
        order += [name for name in diagnosis.traces.explained if name not in order]
        chart = force_chart(diagnosis.traces, order)
        blocks += [chart] if chart is not None else []
    if diagnosis.verdict in _UNNAMED and diagnosis.description:
        blocks.append(report.Remarks(diagnosis.description))
    if not blocks:
        return None
    text = (
        "What had to act on the model, beyond its equations, for it to follow the recordings: "
        "estimated without any candidate in mind."
    )
    if diagnosis.traces is not None and diagnosis.traces.explained:
        text += " In blue, what the likeliest cause says this force is."
    return report.Section("The missing force", [text], blocks)


def force_chart(traces: Traces, locations: Sequence[str]) -> draw.Chart | None:
    """The smoothed missing force at some places with its band, and what the cause says it is.

    None where nothing was smoothed. Of the first place a part is enlarged below.
    """
    places = [name for name in locations if name in traces.force][:3]
    if not places:
        return None
    time = np.asarray(traces.force_time, dtype=float)
    begin, end = _busiest_part(traces, places[0])
    whole = (float(time[0]), float(time[-1]))
    panels = []
    for number, name in enumerate((places[0], *places)):
        is_enlarged = number == 1
        unit, scale = wording.small_unit(traces.force_unit.get(name, ""))
        force = scale * np.asarray(traces.force[name], dtype=float)
        marks: list[draw.Mark] = []
        if f"{name}.sd" in traces.force:
            sd = scale * np.asarray(traces.force[f"{name}.sd"], dtype=float)
            marks.append(draw.Band(time, force - 2 * sd, force + 2 * sd, "± 2 sd", "grey"))
        marks.append(draw.Curve(time, force, "missing", "ink", width=0.8))
        if name in traces.explained:
            explained_force = scale * np.asarray(traces.explained[name], dtype=float)
            marks.append(
                draw.Curve(time, explained_force, "what the cause says", "blue", width=1.3)
            )
        marks.append(draw.Line(y=0.0))
        if number == 0:
            marks += [draw.Line(x=begin, colour="ink"), draw.Line(x=end, colour="ink")]
        title = f"{place_name(name)}{', enlarged' if is_enlarged else ''}"
        axis = draw.Axis("time", "s", (begin, end) if is_enlarged else whole)
        panels.append(draw.Panel(axis, draw.Axis("", wording.unit(unit)), marks, title))
    return draw.Chart(
        "force", panels, "Second: the part between the dotted lines, enlarged.", 1, _WIDTH, 1.9
    )


def _busiest_part(traces: Traces, name: str) -> tuple[float, float]:
    """The stretch in which the force (or what is said of it) has most energy."""
    time = np.asarray(traces.force_time, dtype=float)
    duration = min(_ENLARGED, float(time[-1] - time[0]))
    values = np.nan_to_num(np.asarray(traces.explained.get(name, traces.force[name]), dtype=float))
    if not np.any(values):
        values = np.nan_to_num(np.asarray(traces.force[name], dtype=float))
    width = max(1, int(np.searchsorted(time - time[0], duration)))
    if width >= len(time):
        return float(time[0]), float(time[-1])
    energy = np.convolve(values**2, np.ones(width), "valid")
    first = int(np.argmax(energy))
    return float(time[first]), float(time[min(first + width, len(time) - 1)])


def _before_and_after(diagnosis: DiagnosisResult) -> report.Section | None:
    corrected = is_corrected(diagnosis)
    chart = gap_chart(diagnosis)
    if chart is None:
        return None
    at_horizon, whole = _gap_tables(diagnosis, corrected)
    runs = None if diagnosis.traces is None else run_chart(diagnosis.traces)
    blocks = [block for block in (at_horizon, chart, runs, whole) if block is not None]
    text = "On a part of the recordings that was sealed: nothing was fitted to it."
    if compared_with_a_state(diagnosis):
        text += " Which difference it is was chosen on the whole."
    if not corrected:
        text += " No cause was added, so the refitted model is all there is to show."
    return report.Section("Before and after", [text], blocks)


def _gap_tables(diagnosis: DiagnosisResult, corrected: bool) -> tuple[report.Table, report.Table]:
    """The gap by channel at the horizon that stands for all, and at every horizon."""
    horizon = shown_horizon(h for gaps in diagnosis.gap.values() for h in gaps)
    caption = f"RMS of the errors of free runs of {float(horizon or 0):g} s on the sealed part."
    of_all, heads = "", ["output", _LENGTH, "as it was", "refitted", "floor"]
    if corrected:
        heads = [*heads[:-1], "corrected", "floor", *_CLOSED]
        above = "above the floor"
        caption += f" Closed: of what the refit left {above} (interval: on another recording)."
        of_all = f"Closed: what the correction took from the gap {above} that the refit left."
    rows = [row for row in _gap_rows(diagnosis) if corrected or row["floor"] != ""]
    columns = [report.Column(head, head) for head in heads]
    rows_at_horizon = [row for row in rows if horizon and row[_LENGTH] == f"{float(horizon):g}"]
    return (
        report.table(rows_at_horizon, [columns[0], *columns[2:]], caption),
        report.table(rows, columns, of_all, heads=2, on_screen=False),
    )


def _gap_rows(diagnosis: DiagnosisResult) -> Iterator[dict[str, report.Cell]]:
    """Cells by head: a row a channel and horizon, then what all channels say together."""
    for channel, gaps in diagnosis.gap.items():
        for horizon, gap in gaps.items():
            unit, scale = wording.small_unit(gap.unit)
            mark: report.Judgement = "bad" if gap.is_worse else ""
            yield {
                "output": wording.with_unit(wording.signal(channel), unit),
                _LENGTH: f"{float(horizon):g}",
                "as it was": scale * gap.raw,
                "refitted": scale * gap.refit,
                "corrected": report.Datum(scale * gap.corrected, mark),
                "floor": scale * gap.floor,
                **_closed_cells(diagnosis.shrink.get(channel, {}).get(horizon)),
            }
    for horizon, shrink in diagnosis.shrink.get("all", {}).items():
        row = dict.fromkeys(("as it was", "refitted", "corrected", "floor"), "")
        row |= {"output": "all channels", _LENGTH: f"{float(horizon):g}"}
        yield {**row, **_closed_cells(shrink)}


def _closed_cells(shrink: Shrink | None) -> dict[str, report.Cell]:
    if shrink is None or shrink.fraction is None:
        return {_CLOSED[0]: wording.MISSING, _CLOSED[1]: ""}
    bad: report.Judgement = "bad" if shrink.fraction < 0 else ""
    mark: report.Judgement = "good" if shrink.fraction > 0.5 else bad
    ends = "" if shrink.ci95 is None else wording.gap_interval(shrink.ci95)
    return {_CLOSED[0]: report.Datum(wording.gap_share(shrink.fraction), mark), _CLOSED[1]: ends}


def gap_chart(diagnosis: DiagnosisResult) -> draw.Chart | None:
    """The gap over the length of a free run, a panel a channel; None without any."""
    channels = [name for name, rows in diagnosis.gap.items() if rows]
    if not channels:
        return None
    corrected = is_corrected(diagnosis)
    panels = []
    for channel in channels:
        horizons = sorted(diagnosis.gap[channel], key=float)
        rows = [diagnosis.gap[channel][horizon] for horizon in horizons]
        lengths = [float(horizon) for horizon in horizons]
        unit, scale = wording.small_unit(rows[0].unit)
        marks: list[draw.Mark] = []
        for name, (label, colour, style) in _RUNS.items():
            if name == "corrected" and not corrected:
                continue
            values = [scale * getattr(row, name) for row in rows]
            marks.append(draw.Curve(lengths, values, label, colour, style))
            marks.append(draw.Points(lengths, values, "", "dot", colour, size=3.5))
        floors = [scale * row.floor for row in rows]
        marks.append(draw.Curve(lengths, floors, "floor", "ink", "dotted"))
        title = wording.with_unit(wording.signal(channel), unit)
        axis = draw.Axis("free run", "s", log=True, ticks=lengths)
        panels.append(draw.Panel(axis, draw.Axis("", log=True), marks, title))
    return draw.Chart(
        "gap",
        panels,
        "RMS of the errors of free runs on the sealed part, over their length: the model as it "
        "was, refitted, corrected, and the floor that noise sets.",
        columns=len(panels),
        width=_WIDTH / max(len(panels), 2),
        height=2.6,
    )


def run_chart(traces: Traces) -> draw.Chart | None:
    """A free run over the sealed part: measured, and the models; None without one."""
    if not traces.runs or len(traces.run_time) < 2:
        return None
    time = np.asarray(traces.run_time, dtype=float)
    panels = []
    for channel, series in traces.runs.items():
        measured = np.asarray(series["measured"], dtype=float)
        marks: list[draw.Mark] = [draw.Curve(time, measured, "measured", "pale", width=2.6)]
        marks += [
            draw.Curve(time, series[name], label, colour, style, width=1.1)
            for name, (label, colour, style) in _RUNS.items()
            if name in series
        ]
        unit = traces.run_unit.get(channel, "")
        axis = draw.Axis("time", "s", (float(time[0]), float(time[-1])))
        limits = near(measured, [np.asarray(series[n]) for n in _RUNS if n in series], 0.6)
        panels.append(draw.Panel(axis, draw.Axis(wording.signal(channel), unit, limits), marks))
    caption = "One free run over the sealed part: started once, then the model alone."
    return draw.Chart("free_run", panels, caption, 1, _WIDTH, 1.6, together=True)


def _tests(diagnosis: DiagnosisResult) -> report.Section | None:
    """A row a test, a column an output: the probability that noise alone does that."""
    if not diagnosis.tests:
        return None
    channels = list(dict.fromkeys(test.channel for test in diagnosis.tests))
    by_place = {(test.name, test.channel): _probability(test) for test in diagnosis.tests}
    rows = [
        [name, *(by_place.get((name, channel), "") for channel in channels)]
        for name in dict.fromkeys(test.name for test in diagnosis.tests)
    ]
    rejections = [test for test in diagnosis.tests if test.rejected]
    caption = (
        "Probability that noise and errors of usual size make that, corrected for the number of "
        "tests; red: larger."
    )
    power = max((t.margin for t in diagnosis.tests if t.margin > 1), default=None)
    correlation = max((t.margin for t in diagnosis.tests if 0 < t.margin < 1), default=None)
    if power is not None and correlation is not None:
        caption += (
            f" The margin: errors {wording.percent(power - 1)} stronger than usual, and "
            f"correlations of {correlation:g}, still count as usual."
        )
    heads = ["test", *(wording.signal(channel) for channel in channels)]
    return report.Section(
        "Is there a gap at all?",
        [_tests_words(diagnosis, rejections)],
        [report.Table(heads, rows, caption, on_screen=False)],
        folded=True,
    )


def _tests_words(diagnosis: DiagnosisResult, rejections: Sequence[GapTest]) -> str:
    """What the tests say, and how that goes with the verdict."""
    of = "the refitted model's one-step errors"
    nothing = diagnosis.verdict in ("no_gap", "no_change", "parameters_only")
    if not rejections:
        text = f"None of the tests finds {of} larger than usual."
        if not nothing:
            text += " What the race tells lies within the margin of each test: a weak gap."
        return text
    where = dict.fromkeys(wording.signal(test.channel) for test in rejections)
    text = (
        f"{len(rejections)} of {wording.count(len(diagnosis.tests), 'test')} find {of} larger than "
        f"usual, in {wording.listing(list(where))}."
    )
    if nothing:
        text += (
            " The verdict names no effect all the same: none foretells held-out blocks better. "
            "Something may be left that no candidate explains."
        )
    return text


def _probability(test: GapTest) -> report.Datum:
    text = "< 1e−6" if test.p_corrected < _SMALLEST else wording.number(test.p_corrected, 2)
    return report.Datum(text, "bad" if test.rejected else "good")


def _parameters(diagnosis: DiagnosisResult) -> report.Section | None:
    if not diagnosis.parameters:
        return None
    items = sorted(diagnosis.parameters.items(), key=lambda item: -abs(item[1].moved or 0.0))

    def move_cell(item: tuple[str, FittedParameter]) -> report.Datum:
        by = item[1].moved
        if by is None:
            return report.Datum(None)
        mark: report.Judgement = "doubtful" if abs(by) > _FAR else ""
        return report.Datum(f"{by:+.1f} sd".replace("-", "−"), mark)

    columns = [
        report.Column("parameter", lambda item: wording.with_unit(item[0], item[1].unit)),
        report.Column("before", lambda item: item[1].prior),
        report.Column("fitted", lambda item: report.Datum(item[1].fitted, sd=item[1].sd)),
        report.Column("±", lambda item: item[1].sd),
        report.Column("moved, in sd of what was known", move_cell),
    ]
    more = len(items) - _MOST_PARAMETERS
    caption = f"And {more} more, which moved less: see diagnosis.json." if more > 0 else ""
    return report.Section(
        "Parameters of the model",
        [
            "With the cause in the model, where there is one. A parameter that had to move far "
            "from what was known of it may stand in for something that the model lacks."
        ],
        [report.table(items[:_MOST_PARAMETERS], columns, caption, on_screen=False)],
        folded=True,
    )


def _hardly_testable(diagnosis: DiagnosisResult) -> dict[str, RaceEntry]:
    """Effects that raced although their trace about the refitted model is below the noise.

    There the discrepancy is as large as the refit left it; in the race it may be smaller.
    """
    unseen = {item.effect for item in diagnosis.not_testable}
    return {
        entry.effects[0]: entry
        for entry in diagnosis.race
        if len(entry.effects) == 1 and entry.effects[0] in unseen
    }


def _beats_no_effect(entry: RaceEntry) -> bool:
    """Whether a competitor does better than no effect by more than chance."""
    return entry.score > max(_LEVEL, 2 * _se(entry))


def _testability(diagnosis: DiagnosisResult) -> report.Section | None:
    cause_effects = {
        name for cause in diagnosis.causes if cause.probability >= LEAST for name in cause.effects
    }
    # what the race was decided by was tested, whatever was foreseen of it
    unnamed = [item for item in diagnosis.not_testable if item.effect not in cause_effects]
    race_entries = _hardly_testable(diagnosis)
    hardly = [item for item in unnamed if item.effect in race_entries]
    untested = [item for item in unnamed if item.effect not in race_entries]
    if not unnamed and not diagnosis.detectable:
        return None
    text = ["An effect that was not excited is not tested, which is not to say that it is absent."]
    blocks: list[report.Block] = []
    if hardly:
        text.append(
            "Some raced all the same, for the little that they do points at what the refitted "
            "model leaves over."
        )
        columns = [
            report.Column("raced, but hardly testable", lambda item: wording.readable(item.effect)),
            report.Column("against no effect", lambda item: _result(race_entries[item.effect])),
            report.Column("why", "reason"),
        ]
        blocks.append(report.table(hardly, columns, on_screen=False))
    if untested:
        columns = [
            report.Column("not testable", lambda item: wording.readable(item.effect)),
            report.Column("why", "reason"),
        ]
        blocks.append(report.table(untested, columns, on_screen=False))
    if diagnosis.detectable:
        columns = [
            report.Column("effect", lambda item: wording.readable(item[0])),
            report.Column("smallest size", lambda item: item[1].minimum_size),
            report.Column("unit", lambda item: wording.unit(item[1].unit)),
        ]
        caption = (
            "Sizes below these leave no trace in these recordings: such an effect may be there."
        )
        blocks.append(
            report.table(sorted(diagnosis.detectable.items()), columns, caption, on_screen=False)
        )
    return report.Section("What these recordings cannot tell", text, blocks, folded=True)


def _recordings(diagnosis: DiagnosisResult, remarks: Sequence[str]) -> report.Section:
    columns = [
        report.Column("file", "file"),
        report.Column("length [s]", "duration_s"),
        report.Column("rate [Hz]", lambda r: round(1 / r.sample_time_s, 3)),
        report.Column("channels", lambda r: ", ".join(r.channels)),
        report.Column("SHA-256", lambda r: r.sha256[:16]),
    ]
    blocks: list[report.Block] = [report.Remarks(remarks, on_screen=False)] if remarks else []
    blocks.append(report.table(diagnosis.recordings, columns, on_screen=False))
    if diagnosis.against:
        caption = "Of a known state, with which the others are compared."
        blocks.append(report.table(diagnosis.against, columns, caption, on_screen=False))
    return report.Section("Recordings", (), blocks, folded=True)
