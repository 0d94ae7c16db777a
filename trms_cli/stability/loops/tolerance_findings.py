"""What a loop tolerates, in sentences, tables, figures and data."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

from trms_cli.core.findings import Findings, Judged, Section, Table, Value
from trms_cli.stability.loops import tolerance_charts
from trms_cli.stability.loops.impairments import Impairment
from trms_cli.stability.loops.margin_findings import (
    condition_of,
    gliding_words,
    warning_of_statuses,
)
from trms_cli.stability.loops.margins import Margins
from trms_cli.stability.loops.tolerance import Limits, Trial, explanation
from trms_cli.stability.loops.tolerance_search import Found

TITLE = "What a loop tolerates"


def findings_of(limits: Sequence[Limits], trial: Trial, margins: Margins) -> Findings:
    """The answer."""
    where = condition_of(trial.subject, trial.loop, trial.point)
    why = [explanation(found, trial) for found in limits]
    start = ", ".join(f"{name} {value:+g}" for name, value in trial.offset.items()) or "the point"
    bounds = trial.bounds
    charts = [tolerance_charts.overview(limits, trial, where)]
    if any(found.back.above for found in limits):
        charts.append(tolerance_charts.responses(limits, trial, where))
    return Findings(
        TITLE,
        [f"{where}: started beside the point ({start}).", *(_sentence(found) for found in limits)],
        [
            Section(
                "Tolerated",
                [
                    f"A loop comes back if, in the last third of {trial.duration:g} s, it rests "
                    f"within {bounds.rest:g} rad of the point and swings by at most "
                    f"{bounds.swing:g} rad (its commands by {100 * bounds.chatter:g} % of half "
                    "their range), or the swing shrinks to 80 % of the third before and the error "
                    "to half. It is still creeping if the error shrinks too slowly for that, and "
                    "rests beside the point if it does not shrink, or a command stays at its "
                    "limit. It stays calm if nothing swings on, wherever it rests. Each limit lies "
                    "between a size that is stood and one that is not.",
                ],
                [_table(limits)],
            ),
            Section(
                "Against the linear margins",
                [
                    "The linear loop becomes unstable at the margins that were measured around the "
                    "point; a swing that goes on in the simulation is compared with that. The "
                    "gain error of the simulation is of the whole command, so that the "
                    "controller has to give another one to hold the point; that of the linear "
                    "loop is of changes only.",
                    *gliding_words(margins.measured.held),
                ],
                [_comparison(limits, why)],
            ),
            Section("Figures", [], charts),
        ],
        _results(limits, why, trial, margins),
        _warnings(limits),
    )


def _told(impairment: Impairment, size: float) -> str:
    unit = f" {impairment.unit}" if impairment.unit else ""
    sign = "×" if impairment.kind == "gain" else ""
    return f"{sign}{impairment.shown(size):.3g}{unit}"


def _sentence(found: Limits) -> str:
    impairment, above = found.impairment, found.back.above
    name = f"{impairment.words[0].upper()}{impairment.words[1:]}"
    to = "down to" if impairment.shown(2.0) < impairment.shown(1.0) else "up to"
    if above is None:
        return f"{name}: stood {to} {_told(impairment, found.back.below.size)}, the most tried."
    stood = found.back.below.size
    words = (
        f"stood {to} {_told(impairment, stood)}"
        if stood != impairment.none
        else "none of the sizes tried is stood"
    )
    verdict = above.verdict.kind
    does = "is still creeping" if verdict == "still creeping" else verdict
    said = f"{name}: {words}; at {_told(impairment, above.size)} the loop {does}"
    if above.verdict.calm:
        calm = found.calm
        said += (
            " the point"
            if verdict == "rests beside"
            else f" towards the point after {above.run.time[-1]:.0f} s"
        )
        said += (
            f", and swings from {_told(impairment, calm.above.size)} on"
            if calm.above is not None
            else ", but does not swing at any size tried"
        )
    if found.back.again:
        again = ", ".join(_told(impairment, size) for size in found.back.again)
        said += f"; stood again: {again}"
    return f"{said}."


def _table(limits: Sequence[Limits]) -> Table:
    rows: list[list[Value | Judged]] = []
    for found in limits:
        impairment = found.impairment
        back, calm = found.back, found.calm
        verdict = back.above.verdict.kind if back.above else "–"
        rows.append(
            [
                impairment.words,
                _size(impairment, back.below.size),
                _size(impairment, back.above.size) if back.above else None,
                Judged(verdict, "good" if back.above is None else ""),
                _size(impairment, calm.below.size),
                _size(impairment, calm.above.size) if calm.above else None,
                ", ".join(f"{impairment.shown(s):.3g}" for s in back.again) or None,
            ]
        )
    return Table(
        [
            "what is made worse",
            "comes back at",
            "no longer at",
            "then it",
            "calm at",
            "swings at",
            "back again at",
        ],
        rows,
        "Delays in s, gains as factors, friction in N m. The sizes beside each limit; nothing "
        "stands where no size tried is too much.",
    )


def _size(impairment: Impairment, size: float) -> float:
    return impairment.shown(size)


def _comparison(limits: Sequence[Limits], why: Sequence[str]) -> Table:
    rows: list[list[Value | Judged]] = []
    for found, words in zip(limits, why, strict=True):
        if not found.foretold:
            continue
        impairment, limit = found.impairment, found.calm.limit
        rows.append(
            [
                impairment.words,
                None if found.predicted is None else _size(impairment, found.predicted),
                None if limit is None else _size(impairment, limit),
                words,
            ]
        )
    return Table(
        ["what is made worse", "linear limit", "swings in simulation", "compared"],
        rows,
        "Linear: one gain alone, or one delay of all commands. Nothing stands where no such size "
        "is found.",
    )


def _results(
    limits: Sequence[Limits], why: Sequence[str], trial: Trial, margins: Margins
) -> dict[str, Any]:
    """Sizes as they are told: delays in s, factors of gains, N m."""
    return {
        "holds": True,
        "tolerances": {
            found.impairment.key: {
                "unit": found.impairment.unit,
                "back": _found_data(found.impairment, found.back),
                "calm": _found_data(found.impairment, found.calm),
                "linear": None
                if found.predicted is None
                else found.impairment.shown(found.predicted),
                "compared": words,
            }
            for found, words in zip(limits, why, strict=True)
        },
        "bounds": {"rest": trial.bounds.rest, "swing": trial.bounds.swing, "lost": trial.lost},
        "nonlinearity": margins.measured.nonlinearity,
    }


def _found_data(impairment: Impairment, found: Found) -> dict[str, Any]:
    limit = found.limit
    return {
        "below": impairment.shown(found.below.size),
        "above": None if found.above is None else impairment.shown(found.above.size),
        "limit": None if limit is None else impairment.shown(limit),
        "verdict": None if found.above is None else found.above.verdict.kind,
        "again": [impairment.shown(size) for size in found.again],
        "tried": [
            {"size": impairment.shown(t.size), "verdict": t.verdict.kind}
            for t in found.tried
            if t.size != impairment.none
        ],
    }


def _warnings(limits: Sequence[Limits]) -> list[str]:
    said = []
    statuses: Counter[str] = Counter()
    for found in limits:
        statuses.update(found.back.below.run.statuses)
    words = warning_of_statuses(statuses, "what is stood is in part the fall-back's doing")
    if words:
        said.append(words)
    beside = [
        found
        for found in limits
        if getattr(found.impairment, "up", False)
        and found.back.above is not None
        and found.back.above.verdict.kind == "rests beside"
    ]
    if beside:
        said.append(
            "a gain too large leaves the loop beside its point before it swings: nothing in it "
            "integrates the error; an observer that estimates torques does (observer=ukf)"
        )
    return said
