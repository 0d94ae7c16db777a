"""The answer of a diagnosis: verdict, causes, parameters, places, and what to do next."""

import shlex
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from trms_cli.core import chart as draw
from trms_cli.core import findings as report
from trms_cli.core import wording
from trms_cli.core.invocation import program
from trms_cli.gap.diagnosis import (
    LEAST,
    WORSE,
    Cause,
    DiagnosisResult,
    Rejected,
    Worth,
    compared_with_a_state,
    confusable_with,
    is_corrected,
    likeliest,
    shown_horizon,
)
from trms_cli.gap.evidence_sections import evidence_sections
from trms_cli.gap.wording import (
    OTHERS,
    cause_name,
    laws_in_words,
    place_name,
    size_text,
    size_unit,
    sizes,
)

#: Probability from which causes without a row are told together.
_REST = 0.0005
#: Probability from which an answer is called sure, and likely.
_SURE, _LIKELY = 0.9, 0.7
#: Rows of tables; the JSON has all.
_MOST_CAUSES, _MOST_MOVED = 8, 6


def findings(
    diagnosis: DiagnosisResult, remarks: Sequence[str] = (), folder: Path | None = None
) -> report.Findings:
    """What is worth telling of a diagnosis.

    ``remarks``: what was found in the recordings and what was done to them. ``folder``: of the
    corrected model, for what to type next.
    """
    lead = (
        *diagnosis.excitation,  # first: poor excitation limits whatever follows
        diagnosis.sentence,
        _model_form(diagnosis),
        _confidence(diagnosis),
        _since(diagnosis),
        _of_the_refit(diagnosis),
        "" if diagnosis.worth is None else diagnosis.worth.words,
    )
    sections = (
        _causes(diagnosis),
        _moved_parameters(diagnosis),
        *_rejected_effects(diagnosis),
        _where(diagnosis),
        *evidence_sections(diagnosis, remarks),
    )
    warnings = [text for text in diagnosis.warnings if text not in remarks]
    if diagnosis.worth is not None and diagnosis.worth.warning:
        warnings.insert(0, diagnosis.worth.warning)
    if diagnosis.worse:
        at = float(shown_horizon(h for gaps in diagnosis.gap.values() for h in gaps))
        worse = wording.listing([wording.signal(name) for name in diagnosis.worse])
        much = f"by over {100 * (WORSE - 1):.0f} % at {at:g} s"
        warnings.insert(0, f"the correction made {worse} worse, {much}")
    return report.Findings(
        title=f"Diagnosis: {headline(diagnosis)}",
        lead=[text for text in lead if text],
        sections=[section for section in sections if section is not None],
        warnings=warnings,
        measures=list(_measures(diagnosis)),
        facts=_facts(diagnosis),
        next=list(_next(diagnosis, folder)),
        next_first=True,
    )


def headline(diagnosis: DiagnosisResult) -> str:
    """The verdict in a few words."""
    first = likeliest(diagnosis)
    if diagnosis.verdict == "effect" and first is not None:
        together = first.probability + sum(c.probability for c in confusable_with(first, diagnosis))
        verb = "is" if together >= _SURE else "is likely" if together >= _LIKELY else "may be"
        lacks = "what changed" if diagnosis.against else "what the model lacks"
        if first.onset is not None and first.onset.ends:
            lacks = "what ended"
        return f"{cause_name(first.effects)} {verb} {lacks}"
    undecided = "the cause or its size" if first and first.open_sizes else "the cause"
    return {
        "parameters_only": "other parameters, and no effect, explain the gap",
        "no_gap": "no gap",
        "no_change": "nothing changed since the known state",
        "none_of_these": "something that is not in the library",
    }.get(diagnosis.verdict, f"{undecided} stays undecided")


def _of_the_refit(diagnosis: DiagnosisResult) -> str:
    """How much other parameters alone close, where they are the answer."""
    horizon = shown_horizon(h for gaps in diagnosis.gap.values() for h in gaps)
    rows = {c: gaps[horizon] for c, gaps in diagnosis.gap.items() if horizon in gaps}
    rows = {c: row for c, row in rows.items() if row.floor > 0 and np.isfinite(row.raw)}
    if diagnosis.verdict != "parameters_only" or not rows:
        return ""
    channel = max(rows, key=lambda name: rows[name].raw / rows[name].floor)
    row = rows[channel]
    unit, scale = wording.small_unit(row.unit)
    raw, refit, floor = (scale * value for value in (row.raw, row.refit, row.floor))
    return (
        f"On data kept aside the error of {wording.signal(channel)} over {float(horizon):g} s "
        f"goes from {wording.number(raw)} to {wording.quantity(refit, unit)} "
        f"(noise alone: {wording.number(floor)})."
    )


def _since(diagnosis: DiagnosisResult) -> str:
    """Since when the likeliest cause acts, where it does not from the beginning."""
    first = likeliest(diagnosis)
    if first is None or first.onset is None:
        return ""
    onset = first.onset
    begins, before = ("ends", "from then on") if onset.ends else ("begins", "before,")
    return (
        f"It {begins} {onset.time_s:.1f} s into the recording "
        f"({onset.ci95[0]:.1f} to {onset.ci95[1]:.1f} s): {before} the model holds without it."
    )


def _confidence(diagnosis: DiagnosisResult) -> str:
    """How sure the verdict is, and what comes next to it."""
    first = likeliest(diagnosis)
    if first is None:
        return ""
    alike = confusable_with(first, diagnosis)
    together = first.probability + sum(cause.probability for cause in alike)
    how = "Sure" if together >= _SURE else "Likely" if together >= _LIKELY else "Open"
    text = f"**{how}**: {cause_name(first.effects)}, {wording.percent(first.probability)}"
    if alike:
        names = wording.listing([cause_name(cause.effects) for cause in alike], "or")
        text += f"; {wording.percent(together)} together with {names}"
    rest = [c for c in diagnosis.causes if c is not first and all(c is not a for a in alike)]
    second = max(rest, key=lambda cause: cause.probability, default=None)
    if second is not None and second.probability >= LEAST:
        text += f"; next is {cause_name(second.effects)} ({wording.percent(second.probability)})"
    return f"{text}."


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
        yield report.Measure("until" if onset.ends else "since", f"{onset.time_s:.1f}", note=note)
    rows = diagnosis.shrink.get("all", {})
    horizon = shown_horizon(rows)
    shrink = rows.get(horizon)
    if is_corrected(diagnosis) and shrink is not None and shrink.fraction is not None:
        share = wording.gap_share(shrink.fraction)
        ends = share if shrink.ci95 is None else wording.gap_interval(shrink.ci95)
        judgement: report.Judgement = "good" if shrink.fraction > 0.5 else ""
        note = f"of the errors over {float(horizon):g} s on data kept aside"
        note += f" ({ends} on another recording)" if ends != share else ""
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


def _next(diagnosis: DiagnosisResult, folder: Path | None) -> Iterator[report.NextCommand]:
    model = "" if folder is None else shlex.quote(str(folder / "corrected_model.yaml"))
    experiment = diagnosis.next_experiment
    if diagnosis.control:
        for line in diagnosis.control:
            yield report.NextCommand(line.command, line.why)
    elif diagnosis.worth is not None:  # of a file without such lines
        yield report.NextCommand(
            diagnosis.worth.command, "the loop that is told, on a simulated clone of the model"
        )
    if experiment is not None:
        yield report.NextCommand(experiment.command, experiment.why)
    if model:
        yield report.NextCommand(
            f"{program()} validate model={model} real=FILE",
            "the corrected model on a recording that it has not seen",
        )


def _causes(diagnosis: DiagnosisResult) -> report.Section | None:
    probable = [cause for cause in diagnosis.causes if cause.probability >= LEAST]
    probable_causes = probable[:_MOST_CAUSES]
    if not probable_causes:
        return None
    first = likeliest(diagnosis)
    sure = diagnosis.verdict != "undecided" and first is not None and first.probability >= _LIKELY

    def probability(cause: Cause) -> report.Datum:
        judgement: report.Judgement = "good" if cause is first and sure else ""
        return report.Datum(wording.percent(cause.probability), judgement, bar=cause.probability)

    rest = sum(cause.probability for cause in diagnosis.causes if cause not in probable_causes)
    rows = [*probable_causes, *[Cause(effects=OTHERS, probability=rest)] * (rest >= _REST)]
    columns = [
        report.Column("cause", lambda cause: cause_name(cause.effects)),
        report.Column("probability", probability),
        report.Column("size", lambda cause: sizes(cause.parameters)),
    ]

    def alike(cause: Cause) -> str:
        return ", ".join(cause_name(c.effects) for c in confusable_with(cause, diagnosis))

    if any(map(alike, probable_causes)):
        columns.append(report.Column("confusable with", alike))
    return report.Section(
        "Which cause" if len(probable_causes) == 1 else "Which of the causes",
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
    probable_effects = [item for item in diagnosis.inclusion.items() if item[1] >= LEAST]
    columns = [
        report.Column("effect", lambda item: wording.readable(item[0])),
        report.Column("part of the answer", lambda item: _with_bar(min(item[1], 1.0))),
    ]
    caption = (
        "Of all answers that hold the effect, alone or with others: these need not sum to one."
    )
    return [report.table(probable_effects, columns, caption)]


def _with_bar(probability: float) -> report.Datum:
    return report.Datum(wording.percent(probability), bar=probability)


#: Departures of laws that are listed.
_MOST_LAWS = 3


def _model_form(diagnosis: DiagnosisResult) -> str:
    """What the model's own laws err by, where they were refitted with it."""
    words = laws_in_words(diagnosis.model_form)
    if not words:
        return ""
    return (
        "The model's own laws are of another form than the rig's, and effects are weighed beside "
        f"laws that were fitted, too: {wording.listing(words[:_MOST_LAWS])}."
    )


def _moved_parameters(diagnosis: DiagnosisResult) -> report.Section | None:
    """Which parameters moved, where other parameters may be the answer."""
    if not diagnosis.moved:
        return None
    columns = [
        report.Column("parameter", "parameter"),
        report.Column("that it moved", lambda item: _with_bar(item.probability)),
        report.Column("what", "words"),
    ]
    text = (
        "A refit moves every parameter a little. Here each either keeps to what was known of it or "
        "has moved: the probability that it has, and by how much."
    )
    if diagnosis.verdict != "parameters_only":
        probabilities = {cause.effects: cause.probability for cause in diagnosis.causes}
        share = wording.percent(probabilities.get(("parameters_only",), 0.0))
        text = (
            f"What would have moved if other parameters were the answer, which has {share}. {text}"
        )
    on_screen = diagnosis.verdict in ("parameters_only", "undecided")
    return report.Section(
        "Which of the parameters",
        [text],
        [report.table(diagnosis.moved[:_MOST_MOVED], columns, on_screen=on_screen)],
    )


def _rejected_effects(diagnosis: DiagnosisResult) -> list[report.Section]:
    """Why not the others: the nearest, and folded away those that were not even fitted."""

    def score(item: Rejected) -> report.Cell:
        return report.Datum(None if item.score is None else round(item.score))

    def bound(item: Rejected) -> str:
        if item.upper_bound is None:
            return wording.MISSING
        unit, scale = size_unit(item.unit, item.upper_bound)
        return wording.quantity(scale * item.upper_bound, unit, 2)

    columns = [
        report.Column("suspect", lambda item: wording.readable(item.effect)),
        report.Column("why not", "reason"),
        report.Column("nats", score),
        report.Column(
            "size if alone", lambda item: "" if item.size is None else size_text(item.size)
        ),
    ]
    if any(item.upper_bound is not None for item in diagnosis.rejected):
        columns.append(report.Column("at most", bound))
    against_state = compared_with_a_state(diagnosis)
    caption = (
        "Nats: log evidence above that nothing changed."
        if against_state
        else "Nats: held-out log density above the refitted model, of those that were fitted. At "
        "most: its first size lies below that with 95 %, beside the answer (of what is not told "
        "apart from it: alone)."
    )
    near = [item for item in diagnosis.rejected if item.score is not None][:_MOST_CAUSES]
    rest = [item for item in diagnosis.rejected if item not in near]
    sections = []
    if near:
        text = "The nearest of the other suspects, " + (
            "each alone." if against_state else "each fitted together with the parameters."
        )
        rows = report.table(near, columns, caption, on_screen=False)
        sections.append(report.Section("Why not the others", [text], [rows]))
    if rest:
        text = "Every suspect that was not worth a fit, the nearest first, by the trace it leaves."
        rest_columns = [
            column for column in columns if column.head in ("suspect", "why not", "at most")
        ]
        rows = report.table(rest, rest_columns, "" if near else caption, on_screen=False)
        sections.append(report.Section("Why not the rest", [text], [rows], folded=True))
    return sections


def _where(diagnosis: DiagnosisResult) -> report.Section | None:
    places = [place for place in diagnosis.where if place.share >= LEAST]
    if not places:
        return None
    regions = {
        place.location: "; ".join(
            f"{wording.gap_share(region.share)} where {region.condition}"
            for region in diagnosis.region
            if region.location == place.location
        )
        for place in places
    }
    columns = [
        report.Column("place", lambda place: place_name(place.location)),
        report.Column("share of the gap", lambda place: wording.gap_share(place.share)),
        report.Column("95 % interval", lambda place: wording.gap_interval(place.ci95)),
    ]
    if any(regions.values()):
        columns.append(report.Column("of its energy", lambda place: regions[place.location]))
    rig = draw.RigDiagram(
        "places",
        {p.location: (p.share, *p.ci95) for p in diagnosis.where},
        [c for recording in diagnosis.recordings for c in recording.channels],
        "From the commands to the sensors: the share of the gap that lies at each place, with its "
        "95 % interval. Without a figure: next to nothing. Dashed: was not recorded.",
        () if diagnosis.traces is None else diagnosis.traces.rows,
    )
    blocks: list[report.Block] = [rig, report.table(places, columns)]
    return report.Section("Where the gap lies", [_where_words(diagnosis)], blocks)


def _where_words(diagnosis: DiagnosisResult) -> str:
    first = max(diagnosis.where, key=lambda place: place.share)
    if first.share < 0.05:
        return "No place stands out: a free force at any of them closes next to nothing."
    text = (
        f"**{wording.gap_share(first.share)}** of the gap lies in the "
        f"{place_name(first.location)} (95 % interval: {wording.gap_interval(first.ci95)}). "
        "Causes count by their probabilities, each where it acts; what has no name by what forces "
        "at each place explain of the refitted model's one-step errors, not of free runs."
    )
    rivals = [
        place_name(place.location)
        for place in diagnosis.where
        if place is not first and place.ci95[1] >= first.ci95[0]
    ]
    if rivals:
        interval, verb = ("interval", "reaches") if len(rivals) == 1 else ("intervals", "reach")
        text += (
            f" The {interval} of {wording.listing(rivals)} {verb} as far: the place is not certain."
        )
    return text
