"""What a diagnosis has to tell: verdict, causes, places, the race, the gap before and after."""

import shlex
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from trms_cli.core import chart as draw
from trms_cli.core import findings as report
from trms_cli.core import wording
from trms_cli.core.invocation import program
from trms_cli.gap.diagnosis import (
    NO_EFFECT,
    Cause,
    DiagnosisResult,
    FittedParameter,
    Gap,
    GapTest,
    RaceEntry,
    Rejected,
    Shrink,
    SizeEstimate,
    Traces,
    Worth,
)
from trms_cli.identification.findings import near

#: s; the horizon that stands for all: this, or the longest that there is below.
HORIZON = 2.0
#: Probability and share below which a cause and a place are not worth a line.
LEAST = 0.01
#: Probability from which causes without a row are told together.
_REST = 0.0005
#: Verdicts after which the missing force itself is described: a cause says more of it.
_UNNAMED = ("none_of_these", "undecided")
#: Probability from which an answer is called sure, and likely.
_SURE, _LIKELY = 0.9, 0.7
#: nats within which two competitors are level.
_LEVEL = 3.0
#: Prior standard deviations from which a parameter has moved far.
_FAR = 2.5
#: Rows of tables and bars of the race; the JSON has all.
_MOST_CAUSES, _MOST_PARAMETERS, _MOST_BARS, _MOST_MOVED = 8, 12, 14, 6
#: Probabilities below which digits mean nothing.
_SMALLEST = 1e-6
#: s of the part of a force that is enlarged.
_ENLARGED = 15.0
_WIDTH = 9.2
#: Stands for the causes that have no row of their own.
_OTHERS = ("others",)
#: Heads of the tables of the gap.
_LENGTH, _CLOSED = "free run [s]", ("closed", "95 % interval")
#: Units of sizes besides, and the factors to them.
_SIZES = {"s": ("ms", 1e3), "kg": ("g", 1e3)}
#: Models of the pictures: name, colour, line.
_RUNS: Mapping[str, tuple[str, draw.Colour, draw.Style]] = {
    "raw": ("as it was", "grey", "dashed"),
    "refit": ("refitted", "vermilion", "solid"),
    "corrected": ("corrected", "blue", "solid"),
}


def findings(
    diagnosis: DiagnosisResult, remarks: Sequence[str] = (), folder: Path | None = None
) -> report.Findings:
    """What is worth telling of a diagnosis.

    ``remarks``: what was found in the recordings and what was done to them. ``folder``: of the
    corrected model, for what to type next.
    """
    sections = (
        _causes(diagnosis),
        _moved(diagnosis),
        *_rejected(diagnosis),
        _where(diagnosis),
        _race(diagnosis),
        _force(diagnosis),
        _before_and_after(diagnosis),
        _tests(diagnosis),
        _not_told(diagnosis),
        _parameters(diagnosis),
        _recordings(diagnosis, remarks),
    )
    warnings = [text for text in diagnosis.warnings if text not in remarks]
    if diagnosis.worse:
        worse = wording.listing([wording.signal(name) for name in diagnosis.worse])
        warnings.insert(0, f"the correction made {worse} worse, by over 2 % at 2 s")
    return report.Findings(
        title=f"Diagnosis: {headline(diagnosis)}",
        lead=[text for text in _lead(diagnosis) if text],
        sections=[section for section in sections if section is not None],
        warnings=warnings,
        measures=list(_measures(diagnosis)),
        facts=_facts(diagnosis),
        next=_next(diagnosis, folder),
        next_first=True,
    )


def _lead(diagnosis: DiagnosisResult) -> list[str]:
    """The answer in its order: what, how sure, since when, and what it gains.

    Poor excitation comes before all: it limits whatever follows.
    """
    worth = diagnosis.worth
    return [
        *diagnosis.excitation,
        diagnosis.sentence,
        _confidence(diagnosis),
        _since(diagnosis),
        _of_the_refit(diagnosis),
        "" if worth is None else worth.words,
    ]


def headline(diagnosis: DiagnosisResult) -> str:
    """The verdict in a few words."""
    first = likeliest(diagnosis)
    if diagnosis.verdict == "effect" and first is not None:
        together = first.probability + sum(c.probability for c in _alike(first, diagnosis))
        verb = "is" if together >= _SURE else "is likely" if together >= _LIKELY else "may be"
        lacks = "what changed" if diagnosis.against else "what the model lacks"
        return f"{cause_name(first.effects)} {verb} {lacks}"
    return {
        "parameters_only": "other parameters, and no effect, explain the gap",
        "no_gap": "no gap",
        "no_change": "nothing changed since the known state",
        "none_of_these": "something that is not in the library",
    }.get(diagnosis.verdict, "the cause stays undecided")


def likeliest(diagnosis: DiagnosisResult) -> Cause | None:
    """The cause with the largest probability."""
    return max(diagnosis.causes, key=lambda cause: cause.probability, default=None)


def cause_name(effects: Sequence[str]) -> str:
    """A cause, or a competitor of the race, as a colleague calls it."""
    plain = {
        (): "parameters only",
        ("flexible",): "a force without a name",
        ("no_gap",): "no gap",
        ("no_change",): "nothing changed",
        ("none_of_these",): "none of these",
        _OTHERS: "others, together",
    }
    return plain.get(tuple(effects)) or " with ".join(wording.readable(name) for name in effects)


def sizes(parameters: Mapping[str, SizeEstimate]) -> str:
    """Sizes of a cause with their deviations; one without any was held where it is."""
    return ", ".join(
        f"{name.split('.', 1)[-1].replace('_', ' ')} {_size(size)}"
        for name, size in parameters.items()
    )


def _size(size: SizeEstimate) -> str:
    """One size: ``4.12 ± 0.18 mN m``."""
    unit, scale = _unit_of_size(size.unit, size.value)
    spread = f" ± {wording.number(scale * size.sd, 2)}" if size.sd > 0 else ""
    return f"{wording.number(scale * size.value)}{spread} {wording.unit(unit)}".rstrip()


def _unit_of_size(unit: str, value: float) -> tuple[str, float]:
    """A unit in which a size has few digits, and the factor to it."""
    if abs(value) >= 1:
        return unit, 1.0
    return _SIZES.get(unit) or wording.small_unit(unit)


def place_name(location: str) -> str:
    """``yaw_moment`` as yaw moment."""
    return location.replace("_", " ")


def shown_horizon(rows: Mapping[str, object]) -> str | None:
    """The horizon that stands for all."""
    known = sorted(rows, key=float)
    below = [horizon for horizon in known if float(horizon) <= HORIZON]
    return (below or known[:1])[-1] if known else None


def _of_the_refit(diagnosis: DiagnosisResult) -> str:
    """How much other parameters alone close, where they are the answer."""
    horizon = shown_horizon({h: None for gaps in diagnosis.gap.values() for h in gaps})
    shown = horizon or ""
    rows = {c: gaps[shown] for c, gaps in diagnosis.gap.items() if shown in gaps}
    rows = {c: row for c, row in rows.items() if row.floor > 0 and np.isfinite(row.raw)}
    if diagnosis.verdict != "parameters_only" or not rows:
        return ""
    channel = max(rows, key=lambda name: rows[name].raw / rows[name].floor)
    row = rows[channel]
    unit, scale = wording.small_unit(row.unit)
    raw, refit, floor = (scale * value for value in (row.raw, row.refit, row.floor))
    return (
        f"On data kept aside the error of {wording.signal(channel)} over {float(horizon or 0):g} s "
        f"goes from {wording.number(raw)} to {wording.quantity(refit, unit)} "
        f"(noise alone: {wording.number(floor)})."
    )


def _since(diagnosis: DiagnosisResult) -> str:
    """Since when the likeliest cause acts, where it does not from the beginning."""
    first = likeliest(diagnosis)
    if first is None or first.onset is None:
        return ""
    onset = first.onset
    return (
        f"It begins {onset.time_s:.1f} s into the recording "
        f"({onset.ci95[0]:.1f} to {onset.ci95[1]:.1f} s): before, the model holds without it."
    )


def _confidence(diagnosis: DiagnosisResult) -> str:
    """How sure the verdict is, and what comes next to it."""
    first = likeliest(diagnosis)
    if first is None:
        return ""
    alike = _alike(first, diagnosis)
    together = first.probability + sum(cause.probability for cause in alike)
    how = "Sure" if together >= _SURE else "Likely" if together >= _LIKELY else "Open"
    text = f"**{how}**: {cause_name(first.effects)}, {wording.percent(first.probability)}"
    if alike:
        names = wording.listing([cause_name(cause.effects) for cause in alike], "or")
        text += f"; {wording.percent(together)} together with {names}"
    rest = [c for c in diagnosis.causes if c is not first and all(c is not a for a in alike)]
    second = max(rest, key=lambda cause: cause.probability, default=None)
    if second is not None and second.probability >= LEAST:
        text += f"; next is {cause_name(second.effects)} with {wording.percent(second.probability)}"
    return f"{text}."


def _alike(cause: Cause, diagnosis: DiagnosisResult) -> list[Cause]:
    """Causes with a probability that these recordings do not tell from one."""
    groups = [set(group) for group in diagnosis.confusable if set(group) & set(cause.effects)]
    names = set(cause.effects).union(*groups)
    return [
        other
        for other in diagnosis.causes
        if other is not cause
        and other.probability >= LEAST
        and set(other.effects) <= names
        and not set(other.effects) <= set(cause.effects)
    ]


def _measures(diagnosis: DiagnosisResult) -> Iterator[report.Measure]:
    first = likeliest(diagnosis)
    if first is not None:
        yield report.Measure(
            "probability", wording.percent(first.probability), note=cause_name(first.effects)
        )
    if diagnosis.where and diagnosis.where[0].share >= 0.05:
        place = diagnosis.where[0]
        note = wording.gap_share(place.share, place.ci95, "of the gap in one-step errors")
        yield report.Measure("lies in", place_name(place.location), note=note)
    if first is not None and first.onset is not None:
        onset = first.onset
        note = f"s ({onset.ci95[0]:.1f} to {onset.ci95[1]:.1f}) into the recording"
        yield report.Measure("since", f"{onset.time_s:.1f}", note=note)
    rows = diagnosis.shrink.get("all", {})
    horizon = shown_horizon(rows)
    shrink = rows.get(horizon or "")
    if is_corrected(diagnosis) and shrink is not None and shrink.fraction is not None:
        share = wording.gap_share(shrink.fraction)
        ends = share if shrink.ci95 is None else wording.gap_interval(shrink.ci95)
        judgement: report.Judgement = "good" if shrink.fraction > 0.5 else ""
        note = f"({ends}) " if ends != share else ""
        note += f"of the errors over {float(horizon or 0):g} s on data kept aside"
        yield report.Measure("gap closed", share, judgement=judgement, note=note)
    if diagnosis.worth is not None:
        axis, gain = _largest_gain(diagnosis.worth)
        if axis:
            value = f"{wording.percent(abs(gain))} {'less' if gain > 0 else 'more'}"
            note = f"tracking error of {wording.signal(axis)}, simulated"
            mark: report.Judgement = "good" if gain > 0.1 else ""
            yield report.Measure("in the loop", value, judgement=mark, note=note)


def _largest_gain(worth: Worth) -> tuple[str, float]:
    """The angle whose tracking error changes most, in rad, and the share that it loses."""
    apart = {
        axis: old - worth.after[axis]
        for axis, old in worth.before.items()
        if old > 0 and np.isfinite(old) and np.isfinite(worth.after.get(axis, np.nan))
    }
    axis = max(apart, key=lambda name: abs(apart[name]), default="")
    return axis, apart[axis] / worth.before[axis] if axis else 0.0


def is_corrected(diagnosis: DiagnosisResult) -> bool:
    """Whether the corrected model is another one than the refitted."""
    rows = [row for rows in diagnosis.gap.values() for row in rows.values()]
    return any(row.corrected != row.refit for row in rows)


def _facts(diagnosis: DiagnosisResult) -> dict[str, str]:
    files = ", ".join(recording.file for recording in diagnosis.recordings)
    length = sum(recording.duration_s for recording in diagnosis.recordings)
    facts = {
        "verdict": diagnosis.verdict,
        "model": f"`{diagnosis.model}`",
        "recorded": f"{files}: {length:g} s",
        "effort": f"{diagnosis.effort}, seed {diagnosis.seed}",
    }
    if diagnosis.seconds:
        facts["time"] = wording.seconds(sum(diagnosis.seconds.values()))
    if diagnosis.versions:
        facts["versions"] = ", ".join(f"{name} {v}" for name, v in diagnosis.versions.items())
    return facts


def _next(diagnosis: DiagnosisResult, folder: Path | None) -> list[report.NextCommand]:
    commands = []
    model = "" if folder is None else shlex.quote(str(folder / "corrected_model.yaml"))
    if diagnosis.worth is not None:
        commands.append(
            report.NextCommand(
                diagnosis.worth.command, "drive with the corrected model: the loop that is told"
            )
        )
    elif model and diagnosis.verdict not in ("no_gap", "no_change"):
        commands.append(
            report.NextCommand(
                f"{program()} run model={model} controller=newton_mpc",
                "control with the corrected model; `model=` takes it anywhere",
            )
        )
    if diagnosis.next_experiment is not None:
        commands.append(
            report.NextCommand(diagnosis.next_experiment.command, diagnosis.next_experiment.why)
        )
    if model:
        commands.append(
            report.NextCommand(
                f"{program()} validate model={model} real=FILE",
                "the corrected model on a recording that it has not seen",
            )
        )
    return commands


def _causes(diagnosis: DiagnosisResult) -> report.Section | None:
    kept = [cause for cause in diagnosis.causes if cause.probability >= LEAST][:_MOST_CAUSES]
    if not kept:
        return None
    sure = diagnosis.verdict != "undecided" and kept[0].probability >= _LIKELY

    def probability(cause: Cause) -> report.Datum:
        judgement: report.Judgement = "good" if cause is kept[0] and sure else ""
        return report.Datum(wording.percent(cause.probability), judgement, bar=cause.probability)

    rest = sum(cause.probability for cause in diagnosis.causes if cause not in kept)
    rows = [*kept, Cause(effects=_OTHERS, probability=rest)] if rest >= _REST else kept
    columns = [
        report.Column("cause", lambda cause: cause_name(cause.effects)),
        report.Column("probability", probability),
        report.Column("size", lambda cause: sizes(cause.parameters)),
    ]
    if any(_alike(cause, diagnosis) for cause in kept):
        columns.append(
            report.Column(
                "confusable with",
                lambda cause: ", ".join(cause_name(c.effects) for c in _alike(cause, diagnosis)),
            )
        )
    return report.Section(
        "Which cause" if len(kept) == 1 else "Which of the causes",
        [
            "Probabilities of all answers; they sum to one. How the race turns into probabilities "
            "is set by rigs whose truth is known, built by other code than the models."
        ],
        [report.table(rows, columns), *_parts(diagnosis)],
    )


def _parts(diagnosis: DiagnosisResult) -> list[report.Block]:
    """Probability of each effect to be part of the answer, where some answers have several."""
    if not any(len(c.effects) > 1 and c.probability >= LEAST for c in diagnosis.causes):
        return []
    listed = [item for item in diagnosis.inclusion.items() if item[1] >= LEAST]
    columns = [
        report.Column("effect", lambda item: wording.readable(item[0])),
        report.Column(
            "part of the answer",
            lambda item: report.Datum(wording.percent(min(item[1], 1.0)), bar=min(item[1], 1.0)),
        ),
    ]
    caption = (
        "Of all answers that hold the effect, alone or with others: these need not sum to one."
    )
    return [report.table(listed, columns, caption)]


def _moved(diagnosis: DiagnosisResult) -> report.Section | None:
    """Which parameters moved, where other parameters may be the answer."""
    if not diagnosis.moved:
        return None
    columns = [
        report.Column("what", "words"),
        report.Column(
            "that it moved",
            lambda moved: report.Datum(wording.percent(moved.probability), bar=moved.probability),
        ),
        report.Column("parameter", "parameter"),
    ]
    text = (
        "A refit moves every parameter a little. Here each either keeps to what was known of it or "
        "has moved: the probability that it has, and by how much."
    )
    shown = diagnosis.verdict in ("parameters_only", "undecided")
    return report.Section(
        "Which of the parameters",
        [text],
        [report.table(diagnosis.moved[:_MOST_MOVED], columns, on_screen=shown)],
    )


def _rejected(diagnosis: DiagnosisResult) -> list[report.Section]:
    """Why not the others: the nearest, and folded away those that were not even fitted."""

    def score(item: Rejected) -> report.Cell:
        return report.Datum(None if item.score is None else round(item.score))

    def bound(item: Rejected) -> str:
        if item.upper_bound is None:
            return wording.MISSING
        unit, scale = _unit_of_size(item.unit, item.upper_bound)
        return wording.quantity(scale * item.upper_bound, unit, 2)

    columns = [
        report.Column("suspect", lambda item: wording.readable(item.effect)),
        report.Column("why not", "reason"),
        report.Column("nats", score),
        report.Column("size if alone", lambda item: "" if item.size is None else _size(item.size)),
        report.Column("at most", bound),
    ]
    caption = (
        "Nats: held-out log density above the refitted model, of those that were fitted. At most: "
        "its first size lies below that with 95 %, beside the answer (of what is not told apart "
        "from it: alone)."
    )
    near = [item for item in diagnosis.rejected if item.score is not None][:_MOST_CAUSES]
    rest = [item for item in diagnosis.rejected if item not in near]
    sections = []
    if near:
        text = "The nearest of the other suspects, each fitted together with the parameters."
        rows = report.table(near, columns, caption, on_screen=False)
        sections.append(report.Section("Why not the others", [text], [rows]))
    if rest:
        text = "Every suspect that was not worth a fit, the nearest first, by the trace it leaves."
        kept = [column for column in columns if column.head in ("suspect", "why not", "at most")]
        rows = report.table(rest, kept, "" if near else caption, on_screen=False)
        sections.append(report.Section("Why not the rest", [text], [rows], folded=True))
    return sections


def _where(diagnosis: DiagnosisResult) -> report.Section | None:
    places = [place for place in diagnosis.where if place.share >= LEAST]
    if not places:
        return None
    regions = {
        place.location: [r for r in diagnosis.region if r.location == place.location]
        for place in places
    }

    def when(location: str) -> str:
        return "; ".join(
            f"{wording.gap_share(r.share)} where {r.condition}" for r in regions[location]
        )

    columns = [
        report.Column("place", lambda place: place_name(place.location)),
        report.Column("share of the gap", lambda place: wording.gap_share(place.share)),
        report.Column("95 % interval", lambda place: wording.gap_interval(place.ci95)),
    ]
    if any(regions.values()):
        columns.append(report.Column("of its energy", lambda place: when(place.location)))
    rows = report.table(places, columns)
    return report.Section(
        "Where the gap lies",
        [_where_words(diagnosis)],
        [
            draw.RigDiagram(
                "places",
                {p.location: (p.share, *p.ci95) for p in diagnosis.where},
                [c for recording in diagnosis.recordings for c in recording.channels],
                "From the commands to the sensors: the share of the gap that lies at each place, "
                "with its 95 % interval. Without a figure: next to nothing. Dashed: was not "
                "recorded.",
            ),
            rows,
        ],
    )


def _where_words(diagnosis: DiagnosisResult) -> str:
    first = max(diagnosis.where, key=lambda place: place.share)
    if first.share < 0.05:
        return "No place stands out: a free force at any of them closes next to nothing."
    text = (
        f"**{wording.gap_share(first.share)}** of the gap lies in the "
        f"{place_name(first.location)} (95 % interval: {wording.gap_interval(first.ci95)}). Shares "
        "are of what forces at all places together explain of the refitted model's one-step "
        "errors, not of the errors of free runs."
    )
    rivals = [
        place_name(place.location)
        for place in diagnosis.where
        if place is not first and place.ci95[1] >= first.ci95[0]
    ]
    if rivals:
        verb = "reaches" if len(rivals) == 1 else "reach"
        interval = "interval" if len(rivals) == 1 else "intervals"
        text += (
            f" The {interval} of {wording.listing(rivals)} {verb} as far: the place is not certain."
        )
    return text


def is_effect(effects: Sequence[str]) -> bool:
    """Whether a competitor of the race consists of effects."""
    return bool(effects) and not set(effects) & {"flexible", *NO_EFFECT}


def winner(diagnosis: DiagnosisResult) -> RaceEntry | None:
    """The competitor that is the likeliest answer; the best score where it is no effect."""
    named = [entry for entry in diagnosis.race if is_effect(entry.effects)]
    first = likeliest(diagnosis)
    for entry in named:
        if first is not None and entry.effects == first.effects:
            return entry
    return max(named, key=lambda entry: entry.score, default=None)


def _race(diagnosis: DiagnosisResult) -> report.Section | None:
    if not diagnosis.race:
        return None
    chart = race_chart(diagnosis)
    return report.Section("The race of the candidates", [_race_words(diagnosis)], [chart])


def _race_words(diagnosis: DiagnosisResult) -> str:
    """Who won, by how much, and whether a force without a name did better."""
    best = winner(diagnosis)
    if best is None:
        return "No candidate ran."
    name = cause_name(best.effects)
    text = (
        f"{name[0].upper()}{name[1:]} foretells held-out blocks {_apart(best)} than the refitted "
        "model."
    )
    others = [e for e in diagnosis.race if is_effect(e.effects) and e is not best]
    second = max(others, key=lambda entry: entry.score, default=None)
    if second is not None:
        name, apart = cause_name(second.effects), best.score - second.score
        if abs(apart) < _LEVEL:
            text += f" Level with it is {name}."
        elif apart > 0:
            text += f" Next is {name}, {apart:.0f} nats below."
        else:
            text += f" Above it is {name} by {-apart:.0f} nats, which has more to adjust."
    flexible = next((e for e in diagnosis.race if tuple(e.effects) == ("flexible",)), None)
    if flexible is not None:
        if flexible.score > best.score + 2 * (flexible.se + best.se):
            text += " **A force without a name does clearly better**: something else is missing."
        elif flexible.score <= best.score:
            text += " A force without a name, free to be anything, does no better."
    return text


def _apart(entry: RaceEntry) -> str:
    """A score above the refitted model's: ``12 ± 3 nats better``."""
    way = "better" if entry.score >= 0 else "worse"
    return f"{abs(entry.score):.0f} ± {entry.se:.0f} nats {way}"


def _result(entry: RaceEntry) -> str:
    """What the race says of an effect that is hardly testable."""
    return _apart(entry) + ("" if _beats_no_effect(entry) else ": not told apart")


def race_chart(diagnosis: DiagnosisResult) -> draw.Chart:
    """Bars of the held-out score of each competitor above the refitted model's."""
    entries = sorted((e for e in diagnosis.race if np.isfinite(e.score)), key=lambda e: -e.score)
    kept = entries[:_MOST_BARS]
    kept += [e for e in entries[_MOST_BARS:] if not is_effect(e.effects)]
    best = winner(diagnosis)
    first = likeliest(diagnosis)
    alike = {cause.effects for cause in _alike(first, diagnosis)} if first is not None else set()
    hardly = _hardly_testable(diagnosis)
    top = max([e.score + (e.se if is_effect(e.effects) else 0.0) for e in kept] + [1.0])
    low = min(0.0, max(min((e.score for e in kept), default=0.0), -0.25 * top))

    def colour(entry: RaceEntry) -> draw.Colour:
        if not is_effect(entry.effects):
            return "pale"
        if best is not None and entry.effects == best.effects:
            return "blue"
        return "sky" if entry.effects in alike else "grey"

    bars = draw.Bars(
        [cause_name(e.effects) if e.effects != ("no_gap",) else "as it was" for e in kept],
        [max(e.score, low) for e in kept],
        [colour(e) for e in kept],
        [e.se if is_effect(e.effects) and e.score >= low else np.nan for e in kept],
        [
            "not significantly different from the best"
            if e.effects in alike
            else "not significantly different from no effect"
            if e in hardly.values() and not _beats_no_effect(e)
            else ""
            for e in kept
        ],
    )
    axis = draw.Axis(
        "held-out log density above the refitted model", "nats", (1.05 * low, 1.04 * top)
    )
    return draw.Chart(
        "race",
        [draw.Panel(axis, draw.Axis(""), [bars])],
        "How much better each candidate, fitted together with the model's parameters, foretells "
        "blocks that it was not fitted to, one step ahead; whiskers: one standard error.",
        columns=1,
        width=_WIDTH,
        height=0.8 + 0.27 * len(kept),
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
    shown = [name for name in locations if name in traces.force][:3]
    if not shown:
        return None
    time = np.asarray(traces.force_time, dtype=float)
    begin, end = _busiest_part(traces, shown[0])
    whole = (float(time[0]), float(time[-1]))
    panels = []
    for number, name in enumerate((shown[0], *shown)):
        enlarged = number == 1
        unit, scale = wording.small_unit(traces.force_unit.get(name, ""))
        force = scale * np.asarray(traces.force[name], dtype=float)
        marks: list[draw.Mark] = []
        if f"{name}.sd" in traces.force:
            sd = scale * np.asarray(traces.force[f"{name}.sd"], dtype=float)
            marks.append(draw.Band(time, force - 2 * sd, force + 2 * sd, "± 2 sd", "grey"))
        marks.append(draw.Curve(time, force, "missing", "ink", width=0.8))
        if name in traces.explained:
            says = scale * np.asarray(traces.explained[name], dtype=float)
            marks.append(draw.Curve(time, says, "what the cause says", "blue", width=1.3))
        marks.append(draw.Line(y=0.0))
        if number == 0:
            marks += [draw.Line(x=begin, colour="ink"), draw.Line(x=end, colour="ink")]
        label = f"{place_name(name)}{', enlarged' if enlarged else ''}"
        panels.append(
            draw.Panel(
                draw.Axis("time", "s", (begin, end) if enlarged else whole),
                draw.Axis("", wording.unit(unit)),
                marks,
                label,
            )
        )
    return draw.Chart(
        "force", panels, "Second: the part between the dotted lines, enlarged.", 1, _WIDTH, 1.9
    )


def _busiest_part(traces: Traces, name: str) -> tuple[float, float]:
    """The stretch in which the force (or what is said of it) has most energy."""
    time = np.asarray(traces.force_time, dtype=float)
    wanted = min(_ENLARGED, float(time[-1] - time[0]))
    values = np.nan_to_num(np.asarray(traces.explained.get(name, traces.force[name]), dtype=float))
    if not np.any(values):
        values = np.nan_to_num(np.asarray(traces.force[name], dtype=float))
    width = max(1, int(np.searchsorted(time - time[0], wanted)))
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
    section = "On a part of the recordings that was sealed: nothing was fitted or chosen on it."
    if not corrected:
        section += " No cause was added, so the refitted model is all there is to show."
    return report.Section("Before and after", [section], blocks)


def _gap_tables(diagnosis: DiagnosisResult, corrected: bool) -> tuple[report.Table, report.Table]:
    """The gap by channel at the horizon that stands for all, and at every horizon."""
    shown = shown_horizon({h: None for gaps in diagnosis.gap.values() for h in gaps})
    caption = f"RMS of the errors of free runs of {float(shown or 0):g} s on the sealed part."
    of_all, heads = "", ["output", _LENGTH, "as it was", "refitted", "floor"]
    if corrected:
        heads = ["output", _LENGTH, "as it was", "refitted", "corrected", "floor", *_CLOSED]
        caption += " Closed: of what the refit left above the floor."
        of_all = "Closed: what the correction took from the gap above the floor that "
        of_all += "the refit left."
    rows = [row for row in _gap_rows(diagnosis) if corrected or row["floor"] != ""]
    columns = [report.Column(head, head) for head in heads]
    at_shown = [row for row in rows if shown and row[_LENGTH] == f"{float(shown):g}"]
    return (
        report.table(at_shown, [columns[0], *columns[2:]], caption),
        report.table(rows, columns, of_all, heads=2, on_screen=False),
    )


def _gap_rows(diagnosis: DiagnosisResult) -> Iterator[dict[str, report.Cell]]:
    """Cells by head: a row a channel and horizon, then what all channels say together."""
    for channel, gaps in diagnosis.gap.items():
        for horizon, gap in gaps.items():
            unit, scale = wording.small_unit(gap.unit)
            mark: report.Judgement = "bad" if gap.corrected > 1.02 * gap.refit else ""
            yield {
                "output": wording.with_unit(wording.signal(channel), unit),
                _LENGTH: f"{float(horizon):g}",
                "as it was": scale * gap.raw,
                "refitted": scale * gap.refit,
                "corrected": report.Datum(scale * gap.corrected, mark),
                "floor": scale * gap.floor,
                **_closed(diagnosis.shrink.get(channel, {}).get(horizon)),
            }
    for horizon, shrink in diagnosis.shrink.get("all", {}).items():
        blank = dict.fromkeys(("as it was", "refitted", "corrected", "floor"), "")
        yield {"output": "all channels", _LENGTH: f"{float(horizon):g}", **blank, **_closed(shrink)}


def _closed(shrink: Shrink | None) -> dict[str, report.Cell]:
    if shrink is None or shrink.fraction is None:
        return {_CLOSED[0]: wording.MISSING, _CLOSED[1]: ""}
    mark: report.Judgement = (
        "good" if shrink.fraction > 0.5 else "bad" if shrink.fraction < 0 else ""
    )
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
        rows: list[tuple[float, Gap]] = sorted(
            ((float(h), row) for h, row in diagnosis.gap[channel].items()), key=lambda r: r[0]
        )
        horizons = [h for h, _ in rows]
        unit, scale = wording.small_unit(rows[0][1].unit)
        marks: list[draw.Mark] = []
        for name, (label, colour, style) in _RUNS.items():
            if name == "corrected" and not corrected:
                continue
            values = [scale * getattr(row, name) for _, row in rows]
            marks.append(draw.Curve(horizons, values, label, colour, style))
            marks.append(draw.Points(horizons, values, "", "dot", colour, size=3.5))
        marks.append(
            draw.Curve(horizons, [scale * row.floor for _, row in rows], "floor", "ink", "dotted")
        )
        title = wording.with_unit(wording.signal(channel), unit)
        panels.append(
            draw.Panel(
                draw.Axis("free run", "s", log=True, ticks=horizons),
                draw.Axis("", log=True),
                marks,
                title,
            )
        )
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
        unit = "rad" if channel.startswith("alpha") else "rad/s"
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
    seen = [test for test in diagnosis.tests if test.rejected]
    caption = (
        "Probability that noise and errors of usual size make that, corrected for the number of "
        f"tests; red: larger. {_margins(diagnosis)}"
    ).rstrip()
    heads = ["test", *(wording.signal(channel) for channel in channels)]
    return report.Section(
        "Is there a gap at all?",
        [_tests_words(diagnosis, seen)],
        [report.Table(heads, rows, caption, on_screen=False)],
        folded=True,
    )


def _margins(diagnosis: DiagnosisResult) -> str:
    """What still counts as usual."""
    power = max((t.margin for t in diagnosis.tests if t.margin > 1), default=None)
    correlation = max((t.margin for t in diagnosis.tests if 0 < t.margin < 1), default=None)
    if power is None or correlation is None:
        return ""
    return (
        f"The margin: errors {wording.percent(power - 1)} stronger than usual, and correlations "
        f"of {correlation:g}, still count as usual."
    )


def _tests_words(diagnosis: DiagnosisResult, seen: Sequence[GapTest]) -> str:
    """What the tests say, and how that goes with the verdict."""
    of = "the refitted model's one-step errors"
    nothing = diagnosis.verdict in ("no_gap", "no_change", "parameters_only")
    if not seen:
        text = f"None of the tests finds {of} larger than usual."
        if not nothing:
            text += " What the race tells lies within the margin of each test: a weak gap."
        return text
    where = dict.fromkeys(wording.signal(test.channel) for test in seen)
    text = (
        f"{len(seen)} of {wording.count(len(diagnosis.tests), 'test')} find {of} larger than "
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

    def moved(item: tuple[str, FittedParameter]) -> report.Datum:
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
        report.Column("moved, in sd of what was known", moved),
    ]
    more = len(items) - _MOST_PARAMETERS
    caption = ""
    if more > 0:
        caption = f"And {more} more, which moved less: see diagnosis.json."
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
    return entry.score > max(_LEVEL, 2 * entry.se)


def _not_told(diagnosis: DiagnosisResult) -> report.Section | None:
    named = {
        name for cause in diagnosis.causes if cause.probability >= LEAST for name in cause.effects
    }
    # what the race was decided by was tested, whatever was foreseen of it
    unnamed = [item for item in diagnosis.not_testable if item.effect not in named]
    raced = _hardly_testable(diagnosis)
    hardly = [item for item in unnamed if item.effect in raced]
    untested = [item for item in unnamed if item.effect not in raced]
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
            report.Column("against no effect", lambda item: _result(raced[item.effect])),
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
