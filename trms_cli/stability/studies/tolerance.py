"""How much delay, gain error and friction a loop tolerates in simulation."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any

import numpy as np
from msgspec import Meta

from trms_cli.core.chart import Axis, Chart, Colour, Curve, Line, Mark, Marker, Panel, Points
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.findings import Cell, Column, Datum, Findings, Measure, Section, Table, table
from trms_cli.core.plugins import nearest
from trms_cli.core.ranges import Positive
from trms_cli.stability.loops.frequency_response import (
    Analyser,
    MarginResult,
    NoResponse,
    measure_response,
    point_of,
)
from trms_cli.stability.loops.tolerance import (
    Bounds,
    FailureBracket,
    Impairment,
    ImpairmentKind,
    ImpairmentLimits,
    Kind,
    ToleranceTrial,
    TrialRun,
    explanation,
    impairments_of,
    limits_of,
)
from trms_cli.stability.studies.margins import (
    condition_of,
    gliding_words,
    no_response_findings,
    warning_of_statuses,
)
from trms_cli.stability.study import Tell
from trms_cli.stability.subject import Subject

_Factor = Annotated[float, Meta(gt=1)]


@dataclass(frozen=True, kw_only=True)
class Tolerance:
    """What the loop stands from a start beside its operating point."""

    #: Operating point: angles (rad) or commands (V). Empty: level, and yaw at 0.3 rad, where the
    #: tail rotor turns.
    at: Mapping[str, float] = field(default_factory=dict)
    #: By how much the start differs, by state; rad for angles. Those of axes that the model does
    #: not have are left out.
    offset: Mapping[str, float] = field(default_factory=lambda: {"alpha_v": -0.2, "alpha_h": -0.2})
    duration: Positive = 30.0  #: s, of a run; judged are its last two thirds
    rest: Positive = 0.02  #: rad that a loop may rest beside the point
    swing: Positive = 0.002  #: rad by which it may swing on
    chatter: Positive = 0.02  #: Share of half its range by which a command may swing on
    lost: Positive = 1.0  #: rad from the point at which a run is ended
    delays: Sequence[Positive] = (0.05, 0.1, 0.2, 0.4)  #: s, the scan
    #: Factors above 1, the scan upwards; their inverses downwards
    gains: Sequence[_Factor] = (2.0, 4.0, 8.0, 16.0)
    #: N m, the scan; of a model of a user's in the proportion of the forces on its axes
    frictions: Sequence[Positive] = (0.001, 0.003, 0.01, 0.03)
    #: Factor between a size that is stood and one that is not, at which the search ends
    precision: Annotated[float, Meta(gt=1)] = 1.1

    def run(self, subject: Subject, tell: Tell) -> Findings:
        """Measure the linear margins, then make everything worse until the loop fails.

        Raises TrmsError without a controller, where the rig cannot rest, and for a loop that does
        not come back with nothing wrong.
        """
        loop = subject.require_loop("study=tolerance")
        model, point = subject.model, point_of(subject, self.at)
        start, bounds = self._start(subject), Bounds(self.rest, self.swing, self.chatter)
        trial = ToleranceTrial(subject, loop, point, start, self.duration, bounds, self.lost)
        scans = {"delay": self.delays, "gain": self.gains, "friction": self.frictions}
        impairments = [one for one in impairments_of(model) if scans[one.kind]]
        if not impairments:
            raise ConfigurationError(
                "no sizes to try are given",
                where="delays",
                remedy="give some of study.delays, study.gains, study.frictions",
            )
        response = measure_response(Analyser(), subject, loop, point, tell)
        if isinstance(response, NoResponse):
            return no_response_findings(response, subject, loop, point)
        tell("nothing wrong")
        nothing = trial.at(impairments[0], impairments[0].none)
        self._require_back(nothing, condition_of(subject, loop, point))
        margins = MarginResult(response)
        limits = []
        for impairment in impairments:
            tell(impairment.words)
            sizes = [size * impairment.force_ratio for size in sorted(scans[impairment.kind])]
            limits.append(limits_of(trial, impairment, sizes, self.precision, nothing, margins))
        tell("what differs from the linear margins")
        return _findings(limits, trial, margins)

    def _start(self, subject: Subject) -> dict[str, float]:
        model = subject.model
        known_names = {"alpha_v", "alpha_h", *model.state_names}
        for name in self.offset:
            if name not in known_names:
                raise ConfigurationError(
                    f"{name!r} is no state of model {subject.name!r}",
                    where=f"offset.{name}",
                    remedy=nearest(name, model.state_names),
                )
            if name in model.controlled and abs(self.offset[name]) >= self.lost:
                raise ConfigurationError(
                    f"a start {abs(self.offset[name]):g} rad away counts as lost already",
                    where=f"offset.{name}",
                    remedy=f"start closer than study.lost ({self.lost:g} rad), or raise that",
                )
        return {name: value for name, value in self.offset.items() if name in model.state_names}

    def _require_back(self, nothing: TrialRun, where: str) -> None:
        if not nothing.verdict.back:
            does: str = nothing.verdict.kind
            does = "is still creeping" if does == "still creeping" else f"{does} already"
            raise ConfigurationError(
                f"with nothing wrong, the loop {does} ({where})",
                where="offset",
                remedy="start closer to the point (study.offset.alpha_v=-0.05), run longer "
                "(study.duration), allow more (study.rest, study.swing), or let the observer "
                "estimate what the model lacks (observer=ukf)",
            )


def _findings(
    limits: Sequence[ImpairmentLimits], trial: ToleranceTrial, margins: MarginResult
) -> Findings:
    """The answer for a loop that holds its point."""
    where = condition_of(trial.subject, trial.loop, trial.point)
    why = [explanation(result, trial) for result in limits]
    start = ", ".join(f"{name} {value:+g}" for name, value in trial.offset.items()) or "the point"
    bounds = trial.bounds
    charts = [_overview(limits, trial, where)]
    if any(result.back.above for result in limits):
        charts.append(_responses(limits, trial, where))
    unit = _error_unit(trial)
    verdicts = (
        f"A loop comes back if, in the last third of {trial.duration:g} s, it rests within "
        f"{bounds.rest:g} {unit} of the point and swings by at most {bounds.swing:g} {unit} (its "
        f"commands by {100 * bounds.chatter:g} % of half their range), or the swing shrinks to "
        "80 % of the third before and the error to half. It is still creeping if the error shrinks "
        "too slowly for that, and rests beside the point if it does not shrink, or a command stays "
        "at its limit. It stays calm if nothing swings on, wherever it rests. Each limit lies "
        "between a size that is stood and one that is not."
    )
    linear = [
        "The linear loop becomes unstable at the margins that were measured around the point; a "
        "swing that goes on in the simulation is compared with that. The gain error of the "
        "simulation is of the whole command, so that the controller has to give another one to "
        "hold the point; that of the linear loop is of changes only.",
        *gliding_words(margins.response.held_states),
    ]
    return Findings(
        "What a loop tolerates",
        [f"{where}: started beside the point ({start}).", *map(_sentence, limits)],
        [
            Section("Tolerated", [verdicts], [_table(limits)]),
            Section("Against the linear margins", linear, [_comparison(limits, why)]),
            Section("Figures", [], charts),
        ],
        _results(limits, why, trial, margins),
        _warnings(limits),
        [_measure(one) for one in limits],
    )


def _amount(impairment: Impairment, size: float) -> str:
    return ("×" if impairment.kind == "gain" else "") + impairment.amount(size)


def _measure(result: ImpairmentLimits) -> Measure:
    """The worst that was stood."""
    impairment, stood = result.impairment, result.back.below.size
    most = "the most tried" if result.back.above is None else ""
    if stood == impairment.none:
        return Measure(impairment.words, "none", "", "bad", "of the sizes tried")
    return Measure(impairment.words, _amount(impairment, stood), "", "", most)


def _sentence(result: ImpairmentLimits) -> str:
    impairment, above = result.impairment, result.back.above
    name = f"{impairment.words[0].upper()}{impairment.words[1:]}"
    to = "down to" if impairment.display_size(2.0) < impairment.display_size(1.0) else "up to"
    if above is None:
        return f"{name}: stood {to} {_amount(impairment, result.back.below.size)}, the most tried."
    stood, words = result.back.below.size, "none of the sizes tried is stood"
    if stood != impairment.none:
        words = f"stood {to} {_amount(impairment, stood)}"
    verdict = above.verdict.kind
    does = "is still creeping" if verdict == "still creeping" else verdict
    sentence = f"{name}: {words}; at {_amount(impairment, above.size)} the loop {does}"
    if above.verdict.calm:
        beside, swings = verdict == "rests beside", result.calm.above
        sentence += (
            " the point" if beside else (f" towards the point after {above.run.time[-1]:.0f} s")
        )
        sentence += (
            ", but does not swing at any size tried"
            if swings is None
            else (f", and swings from {_amount(impairment, swings.size)} on")
        )
    if result.back.again:
        again = ", ".join(_amount(impairment, size) for size in result.back.again)
        sentence += f"; stood again: {again}"
    return f"{sentence}."


def _table(limits: Sequence[ImpairmentLimits]) -> Table:
    def sized(at: Callable[[ImpairmentLimits], TrialRun | None]) -> Callable[[Any], Cell]:
        """The size of a run, as it is told."""
        return lambda limit: _display_size(limit.impairment, getattr(at(limit), "size", None))

    def again(limit: ImpairmentLimits) -> str | None:
        return (
            ", ".join(f"{limit.impairment.display_size(s):.3g}" for s in limit.back.again) or None
        )

    def failure(limit: ImpairmentLimits) -> Datum:
        above = limit.back.above
        return Datum(above.verdict.kind) if above else Datum("–", "good")

    return table(
        limits,
        [
            Column("what is made worse", lambda limit: limit.impairment.words),
            Column("comes back at", sized(lambda limit: limit.back.below)),
            Column("no longer at", sized(lambda limit: limit.back.above)),
            Column("then it", failure),
            Column("calm at", sized(lambda limit: limit.calm.below)),
            Column("swings at", sized(lambda limit: limit.calm.above)),
            Column("back again at", again),
        ],
        f"Delays in s, gains as factors, friction in {_force_unit(limits)}. The sizes beside each "
        "limit; nothing "
        "stands where no size tried is too much.",
    )


def _force_unit(limits: Sequence[ImpairmentLimits]) -> str:
    """Units of all frictions: ``N m``, or ``N and N m``."""
    units = dict.fromkeys(r.impairment.unit for r in limits if r.impairment.kind == "friction")
    return " and ".join(units) or "N m"


def _display_size(impairment: Impairment, size: float | None) -> float | None:
    return None if size is None else impairment.display_size(size)


def _comparison(limits: Sequence[ImpairmentLimits], why: Sequence[str]) -> Table:
    return table(
        [(limit, words) for limit, words in zip(limits, why, strict=True) if limit.foretold],
        [
            Column("what is made worse", lambda row: row[0].impairment.words),
            Column("linear limit", lambda row: _display_size(row[0].impairment, row[0].predicted)),
            Column(
                "swings in simulation",
                lambda row: _display_size(row[0].impairment, row[0].calm.limit),
            ),
            Column("compared", lambda row: row[1]),
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
            limit.impairment.key: {
                "unit": limit.impairment.unit,
                "back": _bracket_data(limit.impairment, limit.back),
                "calm": _bracket_data(limit.impairment, limit.calm),
                "linear": _display_size(limit.impairment, limit.predicted),
                "compared": words,
            }
            for limit, words in zip(limits, why, strict=True)
        },
        "bounds": {
            "rest": trial.bounds.rest,
            "swing": trial.bounds.swing,
            "lost": trial.distance_limit,
        },
        "nonlinearity": margins.response.nonlinearity,
    }


def _bracket_data(impairment: Impairment, result: FailureBracket) -> dict[str, Any]:
    above = result.above
    return {
        "below": impairment.display_size(result.below.size),
        "above": _display_size(impairment, above.size if above else None),
        "limit": _display_size(impairment, result.limit),
        "verdict": above.verdict.kind if above else None,
        "again": [impairment.display_size(size) for size in result.again],
        "tried": [
            {"size": impairment.display_size(t.size), "verdict": t.verdict.kind}
            for t in result.runs
            if t.size != impairment.none
        ],
    }


def _warnings(limits: Sequence[ImpairmentLimits]) -> list[str]:
    statuses: Counter[str] = Counter()
    for limit in limits:
        statuses.update(limit.back.below.run.statuses)
    words = warning_of_statuses(statuses, "what is stood is in part the fall-back's doing")
    sentences = [words] if words else []
    failures = [limit.back.above for limit in limits if limit.impairment.up]
    if any(above is not None and above.verdict.kind == "rests beside" for above in failures):
        sentences.append(
            "a gain too large leaves the loop beside its point before it swings: nothing in it "
            "integrates the error; an observer that estimates torques does (observer=ukf)"
        )
    return sentences


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
        for trial_run, colour in ((above, "vermilion"), (first.below, "blue")):
            word = "just too much" if trial_run is above else "still stood"
            marks.append(
                Curve(trial_run.run.time, trial.errors(trial_run.run.x)[:, axis], word, colour)  # type: ignore[arg-type]
            )
        title = f"{result.impairment.words}: {result.impairment.amount(above.size)}"
        panels.append(
            Panel(Axis("time", "s"), Axis(f"error of {name}", _error_unit(trial)), marks, title)
        )
    caption = (
        f"Error of the angle that fails, at sizes just below and just above each limit: "
        f"{condition}."
    )
    return Chart("tolerance_responses", panels, caption, columns=3, width=3.9, height=2.6)


def _overview(limits: Sequence[ImpairmentLimits], trial: ToleranceTrial, condition: str) -> Chart:
    """What is left of the swing and of the error at the end, over each size that was tried."""
    panels = []
    for kind, axis in _AXES.items():
        marks: list[Mark] = [Line(y=trial.bounds.rest + trial.bounds.swing)]
        results = [result for result in limits if result.impairment.kind == kind]
        for i, result in enumerate(results):
            marks += _row(result, trial, _COLOURS[i % len(_COLOURS)])
        if results:
            y_axis = Axis("error + swing", _error_unit(trial), log=True)
            own = replace(axis, unit=_force_unit(limits)) if kind == "friction" else axis
            panels.append(Panel(own, y_axis, marks, kind.capitalize()))
    caption = (
        f"Mean error plus swing in the last third of each run over what was made worse (stars, on "
        f"the dotted line of both bounds: where the linear loop becomes unstable): {condition}."
    )
    return Chart("tolerance_overview", panels, caption, columns=len(panels), width=4.2, height=4.2)


def _error_unit(trial: ToleranceTrial) -> str:
    """Units of what is controlled: ``rad``."""
    model = trial.subject.model
    units = (model.states[model.state_index(name)].unit for name in model.controlled)
    return " and ".join(dict.fromkeys(units))


def _row(result: ImpairmentLimits, trial: ToleranceTrial, colour: Colour) -> list[Mark]:
    impairment = result.impairment
    every = {t.size: t for t in (*result.back.runs, *result.calm.runs) if t.size != impairment.none}
    runs = [every[size] for size in sorted(every)]
    sizes = np.array([impairment.display_size(t.size) for t in runs])
    residuals = np.array([_residual(t, trial) for t in runs])
    marks: list[Mark] = [Curve(sizes, residuals, impairment.words, colour, width=1.0)]
    looks: tuple[tuple[Marker, str, tuple[Kind, ...]], ...] = (
        ("stable", "comes back", ("settles",)),
        ("triangle", "on its way back", ("dies out",)),
        ("square", "still creeping, or rests beside", ("still creeping", "rests beside")),
        ("cross", "swings on, or is lost", ("chatters", "swings", "is lost")),
    )
    for marker, label, kinds in looks:
        selection = np.array([t.verdict.kind in kinds for t in runs], dtype=bool)
        if selection.any():
            marks.append(
                Points(sizes[selection], residuals[selection], label, marker, colour, size=5)
            )
    if result.predicted is not None and len(sizes):
        at = impairment.display_size(result.predicted)
        bound = trial.bounds.rest + trial.bounds.swing
        if min(sizes) / 2 < at < 2 * max(sizes):
            marks.append(Points([at], [bound], "linear limit", "star", colour))
    return marks


def _residual(trial_run: TrialRun, trial: ToleranceTrial) -> float:
    """Mean error plus swing of the last third, rad, of the worse angle; of a lost run the bound."""
    if trial_run.run.stop_reason:
        return trial.distance_limit
    verdict = trial_run.verdict
    return max(_LEAST, float((np.abs(verdict.rest) + verdict.swing).max()))
