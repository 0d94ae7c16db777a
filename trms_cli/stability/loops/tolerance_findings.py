"""What a loop tolerates, in sentences, tables, figures and data."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from trms_cli.core.chart import Axis, Chart, Colour, Curve, Line, Mark, Marker, Panel, Points
from trms_cli.core.findings import Cell, Column, Findings, Judged, Section, Table, table
from trms_cli.stability.loops.impairments import Impairment, ImpairmentKind
from trms_cli.stability.loops.margin_findings import (
    condition_of,
    gliding_words,
    warning_of_statuses,
)
from trms_cli.stability.loops.margins import MarginResult
from trms_cli.stability.loops.tolerance import (
    FailureBracket,
    ImpairmentLimits,
    Kind,
    ToleranceTrial,
    TrialRun,
    explanation,
)

TITLE = "What a loop tolerates"


def tolerance_findings(
    limits: Sequence[ImpairmentLimits], trial: ToleranceTrial, margins: MarginResult
) -> Findings:
    """The answer."""
    where = condition_of(trial.subject, trial.loop, trial.point)
    why = [explanation(result, trial) for result in limits]
    start = ", ".join(f"{name} {value:+g}" for name, value in trial.offset.items()) or "the point"
    bounds = trial.bounds
    charts = [_overview(limits, trial, where)]
    if any(result.back.above for result in limits):
        charts.append(_responses(limits, trial, where))
    return Findings(
        TITLE,
        [
            f"{where}: started beside the point ({start}).",
            *(_sentence(result) for result in limits),
        ],
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
                    "between a size that is stood and one that is not."
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
                    *gliding_words(margins.response.held),
                ],
                [_comparison(limits, why)],
            ),
            Section("Figures", [], charts),
        ],
        _results(limits, why, trial, margins),
        _warnings(limits),
    )


def _amount(impairment: Impairment, size: float) -> str:
    unit = f" {impairment.unit}" if impairment.unit else ""
    sign = "×" if impairment.kind == "gain" else ""
    return f"{sign}{impairment.shown(size):.3g}{unit}"


def _sentence(result: ImpairmentLimits) -> str:
    impairment, above = result.impairment, result.back.above
    name = f"{impairment.words[0].upper()}{impairment.words[1:]}"
    to = "down to" if impairment.shown(2.0) < impairment.shown(1.0) else "up to"
    if above is None:
        return f"{name}: stood {to} {_amount(impairment, result.back.below.size)}, the most tried."
    stood = result.back.below.size
    words = (
        f"stood {to} {_amount(impairment, stood)}"
        if stood != impairment.none
        else "none of the sizes tried is stood"
    )
    verdict = above.verdict.kind
    does = "is still creeping" if verdict == "still creeping" else verdict
    sentence = f"{name}: {words}; at {_amount(impairment, above.size)} the loop {does}"
    if above.verdict.calm:
        calm = result.calm
        sentence += (
            " the point"
            if verdict == "rests beside"
            else f" towards the point after {above.run.time[-1]:.0f} s"
        )
        sentence += (
            f", and swings from {_amount(impairment, calm.above.size)} on"
            if calm.above is not None
            else ", but does not swing at any size tried"
        )
    if result.back.again:
        again = ", ".join(_amount(impairment, size) for size in result.back.again)
        sentence += f"; stood again: {again}"
    return f"{sentence}."


def _table(limits: Sequence[ImpairmentLimits]) -> Table:
    def sized(at: Callable[[ImpairmentLimits], TrialRun | None]) -> Callable[[Any], Cell]:
        """The size of a run, as it is told."""

        def cell(limit: ImpairmentLimits) -> Cell:
            run = at(limit)
            return None if run is None else limit.impairment.shown(run.size)

        return cell

    def again(limit: ImpairmentLimits) -> str | None:
        return ", ".join(f"{limit.impairment.shown(s):.3g}" for s in limit.back.again) or None

    return table(
        limits,
        [
            Column("what is made worse", lambda limit: limit.impairment.words),
            Column("comes back at", sized(lambda limit: limit.back.below)),
            Column("no longer at", sized(lambda limit: limit.back.above)),
            Column(
                "then it",
                lambda limit: Judged(
                    limit.back.above.verdict.kind if limit.back.above else "–",
                    "" if limit.back.above else "good",
                ),
            ),
            Column("calm at", sized(lambda limit: limit.calm.below)),
            Column("swings at", sized(lambda limit: limit.calm.above)),
            Column("back again at", again),
        ],
        "Delays in s, gains as factors, friction in N m. The sizes beside each limit; nothing "
        "stands where no size tried is too much.",
    )


def _comparison(limits: Sequence[ImpairmentLimits], why: Sequence[str]) -> Table:
    def size(limit: ImpairmentLimits, value: float | None) -> float | None:
        return None if value is None else limit.impairment.shown(value)

    return Table(
        ["what is made worse", "linear limit", "swings in simulation", "compared"],
        [
            [
                limit.impairment.words,
                size(limit, limit.predicted),
                size(limit, limit.calm.limit),
                words,
            ]
            for limit, words in zip(limits, why, strict=True)
            if limit.foretold
        ],
        "Linear: one gain alone, or one delay of all commands. Nothing stands where no such size "
        "is found.",
    )


def _results(
    limits: Sequence[ImpairmentLimits],
    why: Sequence[str],
    trial: ToleranceTrial,
    margins: MarginResult,
) -> dict[str, Any]:
    """Sizes as they are told: delays in s, factors of gains, N m."""
    return {
        "holds": True,
        "tolerances": {
            result.impairment.key: {
                "unit": result.impairment.unit,
                "back": _bracket_data(result.impairment, result.back),
                "calm": _bracket_data(result.impairment, result.calm),
                "linear": None
                if result.predicted is None
                else result.impairment.shown(result.predicted),
                "compared": words,
            }
            for result, words in zip(limits, why, strict=True)
        },
        "bounds": {"rest": trial.bounds.rest, "swing": trial.bounds.swing, "lost": trial.lost},
        "nonlinearity": margins.response.nonlinearity,
    }


def _bracket_data(impairment: Impairment, result: FailureBracket) -> dict[str, Any]:
    limit = result.limit
    return {
        "below": impairment.shown(result.below.size),
        "above": None if result.above is None else impairment.shown(result.above.size),
        "limit": None if limit is None else impairment.shown(limit),
        "verdict": None if result.above is None else result.above.verdict.kind,
        "again": [impairment.shown(size) for size in result.again],
        "tried": [
            {"size": impairment.shown(t.size), "verdict": t.verdict.kind}
            for t in result.tried
            if t.size != impairment.none
        ],
    }


def _warnings(limits: Sequence[ImpairmentLimits]) -> list[str]:
    sentence = []
    statuses: Counter[str] = Counter()
    for result in limits:
        statuses.update(result.back.below.run.statuses)
    words = warning_of_statuses(statuses, "what is stood is in part the fall-back's doing")
    if words:
        sentence.append(words)
    beside = [
        result
        for result in limits
        if getattr(result.impairment, "up", False)
        and result.back.above is not None
        and result.back.above.verdict.kind == "rests beside"
    ]
    if beside:
        sentence.append(
            "a gain too large leaves the loop beside its point before it swings: nothing in it "
            "integrates the error; an observer that estimates torques does (observer=ukf)"
        )
    return sentence


_COLOURS: tuple[Colour, ...] = ("blue", "vermilion", "green", "purple", "orange", "sky")
_AXES: dict[ImpairmentKind, Axis] = {
    "delay": Axis("delay", "s"),
    "gain": Axis("factor of the gain", log=True),
    "friction": Axis("Coulomb friction", "N m", log=True),
}
#: rad below which a swing is not shown.
_LEAST = 1e-5


def _responses(limits: Sequence[ImpairmentLimits], trial: ToleranceTrial, condition: str) -> Chart:
    """The angle that fails, just below and just above each first limit."""
    panels = []
    for result in limits:
        first = result.back
        above = first.above
        if above is None:
            continue
        axis = above.verdict.axis
        name = trial.subject.model.controlled[axis]
        marks: list[Mark] = [Line(y=0.0)]
        for tried, colour in ((above, "vermilion"), (first.below, "blue")):
            word = "just too much" if tried is above else "still stood"
            marks.append(
                Curve(tried.run.time, trial.errors(tried.run.x)[:, axis], word, colour)  # type: ignore[arg-type]
            )
        size = result.impairment.shown(above.size)
        unit = f" {result.impairment.unit}" if result.impairment.unit else ""
        title = f"{result.impairment.words}: {size:.3g}{unit}"
        panels.append(Panel(Axis("time", "s"), Axis(f"error of {name}", "rad"), marks, title))
    return Chart(
        "tolerance_responses",
        panels,
        f"Error of the angle that fails, at sizes just below and just above each limit: "
        f"{condition}.",
        columns=3,
        width=3.9,
        height=2.6,
    )


def _overview(limits: Sequence[ImpairmentLimits], trial: ToleranceTrial, condition: str) -> Chart:
    """What is left of the swing and of the error at the end, over each size that was tried."""
    panels = []
    for kind, axis in _AXES.items():
        marks: list[Mark] = [Line(y=trial.bounds.rest + trial.bounds.swing)]
        chosen = [result for result in limits if result.impairment.kind == kind]
        for i, result in enumerate(chosen):
            marks += _row(result, trial, _COLOURS[i % len(_COLOURS)])
        if chosen:
            panels.append(
                Panel(
                    axis,
                    Axis("error + swing", "rad", log=True),
                    marks,
                    {"delay": "Delay", "gain": "Gain", "friction": "Friction"}[kind],
                )
            )
    return Chart(
        "tolerance_overview",
        panels,
        f"Mean error plus swing in the last third of each run over what was made worse (stars, on "
        f"the dotted line of both bounds: where the linear loop becomes unstable): {condition}.",
        columns=len(panels),
        width=4.2,
        height=4.2,
    )


def _row(result: ImpairmentLimits, trial: ToleranceTrial, colour: Colour) -> list[Mark]:
    impairment = result.impairment
    every = {
        t.size: t for t in (*result.back.tried, *result.calm.tried) if t.size != impairment.none
    }
    tried = [every[size] for size in sorted(every)]
    sizes = np.array([impairment.shown(t.size) for t in tried])
    left = np.array([_left(t, trial) for t in tried])
    marks: list[Mark] = [Curve(sizes, left, impairment.words, colour, width=1.0)]
    looks: tuple[tuple[Marker, str, tuple[Kind, ...]], ...] = (
        ("stable", "comes back", ("settles",)),
        ("triangle", "on its way back", ("dies out",)),
        ("square", "still creeping, or rests beside", ("still creeping", "rests beside")),
        ("cross", "swings on, or is lost", ("chatters", "swings", "is lost")),
    )
    for marker, label, kinds in looks:
        chosen = np.array([t.verdict.kind in kinds for t in tried], dtype=bool)
        if chosen.any():
            marks.append(Points(sizes[chosen], left[chosen], label, marker, colour, size=5))
    if result.predicted is not None and len(sizes):
        at, bound = impairment.shown(result.predicted), trial.bounds.rest + trial.bounds.swing
        if min(sizes) / 2 < at < 2 * max(sizes):
            marks.append(Points([at], [bound], "linear limit", "star", colour))
    return marks


def _left(tried: TrialRun, trial: ToleranceTrial) -> float:
    """Mean error plus swing of the last third, rad, of the worse angle: what is judged.

    That at which a run is ended for one that was.
    """
    if tried.run.ended:
        return trial.lost
    verdict = tried.verdict
    return max(_LEAST, float((np.abs(verdict.rest) + verdict.swing).max()))
