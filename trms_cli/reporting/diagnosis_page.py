"""The report of a diagnosis: one page that a colleague understands without explanation."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from trms_cli.core.findings import Cell, Judged, Judgement
from trms_cli.gap.diagnosis import Cause, Diagnosis, GapTest, Shrink, horizon_key
from trms_cli.reporting import diagnosis_figures as figures
from trms_cli.reporting.diagnosis_diagram import diagram
from trms_cli.reporting.diagnosis_words import (
    FAR,
    cause_words,
    confidence_words,
    effect_words,
    force_words,
    gap_words,
    interval_words,
    is_corrected,
    percent,
    race_words,
    size_words,
    tests_words,
    where_words,
    winner,
)
from trms_cli.reporting.page import Page
from trms_cli.reporting.style import LABELS

VERDICTS = {
    "effect": "an effect that the model lacks",
    "parameters_only": "other parameters; no effect is needed",
    "no_gap": "no gap",
    "none_of_these": "something that is not in the library",
    "undecided": "undecided",
}
#: Verdicts after which the missing force itself is described: a cause says more of it.
_UNNAMED = ("none_of_these", "undecided")
#: Rows of tables; the JSON has all.
_MOST_CAUSES, _MOST_PARAMETERS = 8, 12
#: Probabilities below which digits mean nothing.
_SMALLEST = 1e-6


def diagnosis_page(diagnosis: Diagnosis, remarks: Sequence[str] = ()) -> Page:
    """Lay out a diagnosis.

    Parameters
    ----------
    remarks : sequence of str
        What was found in the recordings and what was done to them.
    """
    page = Page(diagnosis.sentence, confidence_words(diagnosis), _facts(diagnosis))
    _causes(page, diagnosis)
    _where(page, diagnosis)
    _race(page, diagnosis)
    _force(page, diagnosis)
    _before_and_after(page, diagnosis)
    if diagnosis.next_experiment is not None:
        page.section("The next experiment", diagnosis.next_experiment.why)
        page.command(diagnosis.next_experiment.command)
    _tests(page, diagnosis)
    _parameters(page, diagnosis)
    _not_told(page, diagnosis)
    _recordings(page, diagnosis, remarks)
    return page


def _facts(diagnosis: Diagnosis) -> dict[str, str]:
    files = [r.file for r in diagnosis.recordings]
    length = sum(r.duration_s for r in diagnosis.recordings)
    facts = {
        "verdict": f"**{VERDICTS[diagnosis.verdict]}**",
        "model": f"`{diagnosis.model}`",
        "recorded": f"{', '.join(files)}: {length:g} s",
        "effort": f"{diagnosis.effort}, seed {diagnosis.seed}",
    }
    if diagnosis.seconds:
        facts["time"] = f"{sum(diagnosis.seconds.values()):.0f} s"
    return facts


def _causes(page: Page, diagnosis: Diagnosis) -> None:
    if not diagnosis.causes:
        return
    page.section(
        "Which cause",
        "Probabilities of all answers; they sum to one. How the race turns into probabilities is "
        "set by rigs whose truth is known, built by other code than the models.",
    )
    kept = [c for c in diagnosis.causes if c.probability >= 0.005][:_MOST_CAUSES]
    sure = diagnosis.verdict != "undecided"
    rows: list[list[Cell]] = []
    for i, cause in enumerate(kept):
        mark: Judgement = "good" if i == 0 and sure else ""
        rows.append(
            [
                cause_words(cause.effects),
                Judged(percent(cause.probability), mark),
                _bar(cause.probability),
                size_words(cause.parameters),
                _confused_with(cause, diagnosis),
            ]
        )
    page.table(["cause", "probability", "", "size", "not told apart from"], rows)


def _bar(share: float) -> str:
    return "█" * round(16 * share)


def _confused_with(cause: Cause, diagnosis: Diagnosis) -> str:
    mine = set(cause.effects)
    others = [
        name
        for group in diagnosis.confusable
        if mine & set(group)
        for name in group
        if name not in mine
    ]
    return ", ".join(effect_words(name) for name in dict.fromkeys(others))


def _where(page: Page, diagnosis: Diagnosis) -> None:
    if not diagnosis.where:
        return
    page.section("Where the gap lies", where_words(diagnosis))
    page.figure(
        diagram(diagnosis.where, {c for r in diagnosis.recordings for c in r.channels}),
        "From the commands to the sensors: the share of the gap that lies at each place, with its "
        "95 % interval. Without a figure: next to nothing. Dashed: was not recorded.",
    )
    if diagnosis.region:
        page.table(
            ["place", "when", "share of its energy"],
            [
                [r.location.replace("_", " "), r.condition, percent(r.share)]
                for r in diagnosis.region
            ],
        )


def _race(page: Page, diagnosis: Diagnosis) -> None:
    if not diagnosis.race:
        return
    best = winner(diagnosis)
    page.section("The race of the suspects", race_words(diagnosis))
    page.figure(
        figures.race_figure(diagnosis.race, diagnosis.confusable, best.effects if best else ()),
        "How much better each suspect, fitted together with the model's parameters, foretells "
        "blocks that it was not fitted to. On the right: the share of the gap that it closes.",
    )


def _force(page: Page, diagnosis: Diagnosis) -> None:
    figure, described = None, diagnosis.verdict in _UNNAMED and bool(diagnosis.description)
    if diagnosis.traces is not None:
        order = [place.location for place in diagnosis.where if place.share >= 0.02]
        order += [name for name in diagnosis.traces.explained if name not in order]
        figure = figures.force_figure(diagnosis.traces, order)
    if figure is None and not described:
        return
    page.section("The missing force", force_words(diagnosis))
    if figure is not None:
        page.figure(figure, "Below: the shaded part, enlarged.")
    if described:
        page.points(list(diagnosis.description))


def _before_and_after(page: Page, diagnosis: Diagnosis) -> None:
    corrected = is_corrected(diagnosis)
    figure = figures.gap_figure(diagnosis.gap, corrected=corrected)
    if figure is None:
        return
    page.section("Before and after", gap_words(diagnosis))
    page.figure(
        figure,
        "RMS of the errors of free runs on the sealed part, over their length: the model as it "
        "was, refitted, corrected, and the floor that noise sets.",
    )
    runs = None if diagnosis.traces is None else figures.run_figure(diagnosis.traces)
    if runs is not None:
        page.figure(runs, "One free run over the sealed part: started once, then the model alone.")
    if corrected:
        page.table(
            ["output", "free run [s]", "as it was", "refitted", "corrected", "floor", "unit",
             "closed", "95 % interval"],
            list(_gap_rows(diagnosis)),
            "Closed: what the correction took from the gap above the floor that the refit left.",
            heads=2,
        )  # fmt: skip
    else:
        page.table(
            ["output", "free run [s]", "as it was", "refitted", "floor", "unit"],
            [[*row[:4], *row[5:7]] for row in _gap_rows(diagnosis) if row[6]],
            heads=2,
        )


def _gap_rows(diagnosis: Diagnosis) -> Iterator[list[Cell]]:
    for channel, rows in diagnosis.gap.items():
        for horizon, row in rows.items():
            shrink = _shrink(diagnosis, channel, horizon)
            unit, scale = figures.shown_unit(row.unit)
            worse = row.corrected > 1.02 * row.refit
            mark: Judgement = "bad" if worse else ""
            yield [
                LABELS.get(channel, channel),
                f"{float(horizon):g}",
                scale * row.raw,
                scale * row.refit,
                Judged(scale * row.corrected, mark),
                scale * row.floor,
                unit,
                *_closed(shrink),
            ]
    for horizon in diagnosis.shrink.get("all", {}):
        shrink = _shrink(diagnosis, "all", horizon)
        yield ["all", f"{float(horizon):g}", None, None, None, None, "", *_closed(shrink)]


def _shrink(diagnosis: Diagnosis, channel: str, horizon: str) -> Shrink | None:
    rows = diagnosis.shrink.get(channel, {})
    key = horizon_key(horizon)
    return next((s for h, s in rows.items() if horizon_key(h) == key), None)


def _closed(shrink: Shrink | None) -> list[Cell]:
    if shrink is None or shrink.fraction is None:
        return ["–", ""]
    mark: Judgement = "good" if shrink.fraction > 0.5 else "bad" if shrink.fraction < 0 else ""
    interval = ""
    if shrink.ci95 is not None:
        interval = interval_words(shrink.ci95)
    return [Judged(percent(shrink.fraction), mark), interval]


def _tests(page: Page, diagnosis: Diagnosis) -> None:
    """A row a test, a column an output: the probability that noise alone does that."""
    if not diagnosis.tests:
        return
    page.section("Is there a gap at all?", tests_words(diagnosis))
    channels = list(dict.fromkeys(test.channel for test in diagnosis.tests))
    found = {(test.name, test.channel): test for test in diagnosis.tests}
    rows: list[list[Cell]] = []
    for name in dict.fromkeys(test.name for test in diagnosis.tests):
        row: list[Cell] = [name]
        for channel in channels:
            test = found.get((name, channel))
            row.append("" if test is None else _probability(test))
        rows.append(row)
    page.table(
        ["test", *(LABELS.get(channel, channel) for channel in channels)],
        rows,
        "Probability that noise alone does that, corrected for the number of tests; red: a gap.",
    )


def _probability(test: GapTest) -> Judged:
    small = test.p_corrected < _SMALLEST
    return Judged("< 1e−6" if small else f"{test.p_corrected:.2g}".replace("-", "−"),
                  "bad" if test.rejected else "good")  # fmt: skip


def _more(count: int, what: str) -> str:
    return f"And {count} more {what}: see diagnosis.json." if count > 0 else ""


def _parameters(page: Page, diagnosis: Diagnosis) -> None:
    if not diagnosis.parameters:
        return
    page.section(
        "Parameters of the model",
        "With the cause in the model, where there is one. A parameter that had to move far from "
        "what was known of it is a suspect: it may stand in for something that the model lacks.",
    )

    def far(name: str) -> float:
        moved = diagnosis.parameters[name].moved
        return -abs(moved) if moved is not None else 0.0

    names = sorted(diagnosis.parameters, key=far)
    rows: list[list[Cell]] = []
    for name in names[:_MOST_PARAMETERS]:
        p = diagnosis.parameters[name]
        mark: Judgement = "doubtful" if p.moved is not None and abs(p.moved) > FAR else ""
        moved = None if p.moved is None else f"{p.moved:+.1f} sd".replace("-", "−")
        rows.append(
            [name, p.prior, Judged(p.fitted, sd=p.sd), p.sd, p.unit or "1", Judged(moved, mark)]
        )
    page.table(
        ["parameter", "before", "fitted", "±", "unit", "moved, in sd of what was known"],
        rows,
        _more(len(names) - _MOST_PARAMETERS, "parameters, which moved less"),
    )


def _not_told(page: Page, diagnosis: Diagnosis) -> None:
    if not diagnosis.not_testable and not diagnosis.detectable:
        return
    page.section(
        "What these recordings cannot tell",
        "An effect that was not excited is not tested, which is not to say that it is absent.",
    )
    if diagnosis.not_testable:
        page.table(
            ["not testable", "why"], [[item.effect, item.reason] for item in diagnosis.not_testable]
        )
    if diagnosis.detectable:
        items = sorted(diagnosis.detectable.items())
        half = -(-len(items) // 2)
        rows: list[list[Cell]] = []
        for i in range(half):
            row: list[Cell] = []
            for name, found in items[i::half]:
                row += [name, found.minimum_size, found.unit or "1"]
            rows.append(row + [""] * (6 - len(row)))
        page.table(
            ["effect", "smallest size", "unit", "effect", "smallest size", "unit"],
            rows,
            "Sizes below these leave no trace in these recordings: such an effect may be there.",
        )


def _recordings(page: Page, diagnosis: Diagnosis, remarks: Sequence[str]) -> None:
    page.section("Recordings")
    points: list[str | Judged] = [
        Judged(text, "doubtful") for text in diagnosis.warnings if text not in remarks
    ]
    points += remarks
    if points:
        page.points(points)
    page.table(
        ["file", "length [s]", "rate [Hz]", "channels", "SHA-256"],
        [
            [
                r.file,
                r.duration_s,
                round(1 / r.sample_time_s, 3),
                ", ".join(r.channels),
                r.sha256[:16],
            ]
            for r in diagnosis.recordings
        ],
    )
    if diagnosis.versions:
        page.text("Computed with " + ", ".join(f"{k} {v}" for k, v in diagnosis.versions.items()))
