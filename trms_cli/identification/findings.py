"""What a fit has to tell: errors before and after, parameters with their doubts, the search."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from trms_cli.core import findings as report
from trms_cli.core import wording
from trms_cli.core.chart import Axis, Band, Chart, Curve, Line, Mark, Panel, Points

if TYPE_CHECKING:
    from trms_cli.identification.free_runs import Assessment, WindowRuns

#: Parts of the recordings in the document, as a person reads them.
PARTS = {"held_out": "held out", "fit": "fitted"}
#: Sets of parameters that imitate each other that are report.
_MOST_SETS = 4
#: Prior deviations from which a fitted value is worth a word.
_FAR = 4.0
#: Growth of a held-out error that is more than its scatter; relative change that is none.
_WORSE, _NO_CHANGE = 1.1, 0.01
#: s of a recording that the figure of the free runs shows at most.
_LONGEST = 120.0
#: Prior standard deviations to either side that the figure of the parameters shows.
_REACH = 4.0
_WIDTH = 5.5


def findings(
    document: Mapping[str, Any],
    assessment: Assessment | None = None,
    then: Sequence[report.NextCommand] = (),
) -> report.Findings:
    """What is worth telling of a fit: of ``trms.identification/1``.

    ``assessment``: its free runs are drawn. ``then``: what to type next.
    """
    sections = [_free_runs(document, assessment)]
    if document["parameters"]:
        sections.append(_parameters(document))
    sections += [_search(document), _recordings(document)]
    model = wording.model_name(str(document["model"]))
    return report.Findings(
        title=f"Fit of {model} by {wording.readable(str(document['method']))}",
        lead=list(_lead(document)),
        sections=sections,
        warnings=[f"{i['problem']} ({i['remedy']})" for i in document["admission"]],
        measures=list(_measures(document)),
        facts=_facts(document),
        next=then,
    )


def in_short(document: Mapping[str, Any]) -> str:
    """One line for a job of a sweep."""
    part = judged_part(document)
    errors = document["errors"][part]["after"] or {}
    figures = [f"{n} {wording.quantity(e['rmse'], e['unit'])}" for n, e in errors.items()]
    return (
        f"{wording.seconds(document['seconds']['fit'])}, cost {document['cost']:.6g}, on what was "
        f"{PARTS[part]}: RMSE {', '.join(figures)}"
    )


def judged_part(document: Mapping[str, Any]) -> str:
    """The part of the recordings that shows how good the model is."""
    return "held_out" if document["errors"]["held_out"]["after"] else "fit"


def _lead(document: Mapping[str, Any]) -> Iterator[str]:
    part = judged_part(document)
    words = []
    for error in _errors(document, part):
        was = "" if error.before is None else f" (before: {wording.number(error.before)})"
        rmse = wording.quantity(error.rmse, error.unit)
        words.append(f"{wording.signal(error.output)} to **{rmse}**{was}")
    data = "data that it has not seen" if part == "held_out" else "the data that it was fitted to"
    length = document["windows"]["length_s"]
    if words:
        yield (
            f"Alone over windows of up to {length:.3g} s, on {data}, the model foretells "
            f"{', '.join(words)} RMS."
        )
    if network := document["details"].get("network"):
        yield _of_network(network)
    yield f"How it ended: {document['sentence']}."


def _of_network(network: Mapping[str, Any]) -> str:
    """Whether a white-box model's network was kept, and what decided."""
    before, after = network["validation_loss"]
    if not network["kept"]:
        return (
            "No network is kept: none foretold what is held out enough better than the parameters "
            "alone (method.least_gain)."
        )
    if before is None or after is None:
        return "The network is kept; nothing was held out to tell whether it should be."
    share = wording.number(100 * (1 - (after / before) ** 0.5), 2)
    return f"The network is kept: it takes {share} % off the error on what is held out."


def _measures(document: Mapping[str, Any]) -> Iterator[report.Measure]:
    for error in _errors(document, judged_part(document)):
        was = "" if error.before is None else f"; before: {wording.number(error.before)}"
        head = f"RMSE {wording.signal(error.output)}"
        yield report.Measure(head, error.rmse, error.unit, error.change, PARTS[error.part] + was)


class _Error(NamedTuple):
    """Errors of an output over a part of the recordings, in the unit that they are shown in."""

    output: str
    part: str
    unit: str
    before: float | None  #: RMSE before the fit
    rmse: float | None  #: As fitted, as all that follows
    largest: float | None
    fit: float | None  #: %

    @property
    def change(self) -> report.Judgement:
        if self.before is None or self.rmse is None or not self.before > 0:
            return ""
        change = self.rmse / self.before - 1
        return "" if abs(change) <= _NO_CHANGE else "good" if change < 0 else "bad"


def _errors(document: Mapping[str, Any], part: str) -> Iterator[_Error]:
    errors = document["errors"][part]
    for name, after in (errors["after"] or {}).items():
        unit, scale = wording.small_unit(after["unit"])
        before = (errors["before"] or {}).get(name, {}).get("rmse")
        figures = (before, after["rmse"], after["max_abs_error"])
        was, rmse, largest = (None if value is None else scale * value for value in figures)
        yield _Error(name, part, unit, was, rmse, largest, after["fit_percent"])


def _facts(document: Mapping[str, Any]) -> dict[str, str]:
    facts = {"command": f"`{document['command']}`", "model": str(document["model"])}
    if document["effects"]:
        facts["effects"] = ", ".join(document["effects"])
    if document["driven"]:
        facts["driven by measured"] = ", ".join(document["driven"])
    facts["simulations"] = str(document["evaluations"])
    facts["time"] = wording.seconds(document["seconds"]["fit"])
    facts["versions"] = ", ".join(f"{k} {v}" for k, v in document["versions"].items())
    return facts


def _free_runs(document: Mapping[str, Any], assessment: Assessment | None) -> report.Section:
    columns = [
        report.Column(
            "output", lambda error: wording.with_unit(wording.signal(error.output), error.unit)
        ),
        report.Column("recording", lambda error: PARTS[error.part]),
        report.Column("RMSE before", "before"),
        report.Column("RMSE fitted", lambda error: report.Datum(error.rmse, error.change)),
        report.Column("largest error", "largest"),
        report.Column("fit [%]", "fit"),
    ]
    errors = [error for part in PARTS for error in _errors(document, part)]
    blocks: list[report.Block] = [report.table(errors, columns, "Free runs of the model.", heads=2)]
    chart = None if assessment is None else free_run_chart(assessment)
    blocks += [chart] if chart is not None else []
    return report.Section(
        "Free runs",
        [
            "The model alone over windows, each started from what was measured in the two seconds "
            "before it. What was held out played no part in the fit."
        ],
        blocks,
    )


def free_run_chart(assessment: Assessment) -> Chart | None:
    """Measured against simulated over the judged part of a recording, the errors beside."""
    part = "held_out" if assessment.after.get("held_out") else "fit"
    if not assessment.after.get(part):
        return None
    after = assessment.after[part][0]
    before = assessment.before[part][0] if assessment.before.get(part) else None
    begin = int(after.window[0])
    last = int(np.flatnonzero(~np.isnan(after.simulated).all(axis=1))[-1]) + 1
    end = min(last, begin + round(_LONGEST / after.dataset.sample_time))
    time = after.dataset.time[begin:end]
    starts = after.dataset.time[after.window[after.window < end]]
    x = Axis("time", "s", (float(time[0]), float(time[-1])))
    panels = []
    for i, signal in enumerate(after.dataset.outputs):
        measured = after.dataset.measurements[begin:end, i]
        runs = [("simulated, fitted", after, "blue", "solid")]
        if before is not None:
            runs.insert(0, ("simulated before the fit", before, "vermilion", "dashed"))
        curves = [(label, _broken(run, i, begin, end, starts), c, s) for label, run, c, s in runs]
        marks: list[Mark] = [Curve(time, measured, "measured", "pale", width=2.4)]
        errors: list[Mark] = []
        scores = []
        for label, values, colour, style in curves:
            marks.append(Curve(time, values, label, colour, style, 0.9))  # type: ignore[arg-type]
            errors.append(Curve(time, measured - values, "", colour, style, 0.8))  # type: ignore[arg-type]
            differences = (measured - values)[np.isfinite(measured - values)]
            scores.append(
                wording.number(float(np.sqrt(np.mean(differences**2)))) if differences.size else "–"
            )
        marks += [Line(x=float(start)) for start in starts]
        errors.append(Line(y=0.0, style="solid"))
        label = wording.signal(signal.name)
        limits = near(measured, [values for _, values, _, _ in curves])
        unit = wording.unit(signal.unit)
        panels.append(Panel(x, Axis(label, unit, limits), marks))
        title = f"RMSE {' → '.join(scores)} {unit}"
        panels.append(Panel(x, Axis("error", unit), errors, title))
    words = {"held_out": "held out from the fit", "fit": "fitted"}[part]
    return Chart(
        "free_runs",
        panels,
        f"{after.dataset.name}: free runs over what was {words}; at a dotted line a window starts "
        "anew.",
        width=_WIDTH,
        height=1.75,
        together=True,
    )


def _broken(run: WindowRuns, column: int, begin: int, end: int, starts: np.ndarray) -> np.ndarray:
    """The values with the last sample of each window missing, so that no line joins two."""
    values = run.simulated[begin:end, column]
    broken = np.where(np.isfinite(values), values, np.nan)
    time = run.dataset.time[begin:end]
    for start in starts[1:]:
        last = int(np.searchsorted(time, start - 1e-9)) - 1
        if last >= 0:
            broken[last] = np.nan
    return broken


def near(
    measured: np.ndarray, others: Sequence[np.ndarray], reach: float = 0.5
) -> tuple[float, float]:
    """The measured range, and room for a simulation that strays as far again and no farther."""
    here = measured[np.isfinite(measured)]
    low, high = (float(here.min()), float(here.max())) if here.size else (-1.0, 1.0)
    room = reach * (high - low) or 1.0
    floor, roof = low - room, high + room
    for values in others:
        finite_values = values[np.isfinite(values)]
        if finite_values.size:
            low = max(min(low, float(finite_values.min())), floor)
            high = min(max(high, float(finite_values.max())), roof)
    margin = 0.05 * (high - low) or 0.1
    return low - margin, high + margin


def _parameters(document: Mapping[str, Any]) -> report.Section:
    columns = [
        report.Column("parameter", lambda item: wording.with_unit(item[0], item[1]["unit"])),
        report.Column("fitted", lambda item: report.Datum(item[1]["value"], sd=item[1]["sd"])),
        report.Column("±", lambda item: item[1]["sd"]),
        report.Column("before", lambda item: item[1]["prior_mean"]),
        report.Column("± before", lambda item: item[1]["prior_sd"]),
    ]
    if any(p["at_bound"] for p in document["parameters"].values()):
        columns.append(
            report.Column(
                "at a bound", lambda item: report.Datum(item[1]["at_bound"] or "", "doubtful")
            )
        )
    doubts = [report.Datum(text, "doubtful") for text in doubts_of(document)]
    return report.Section(
        "Parameters",
        [
            "± is one standard deviation: of the estimate, with the residuals' own size and "
            "correlation, and of what was known before."
        ],
        [
            report.table(document["parameters"].items(), columns),
            *([report.Remarks(doubts)] if doubts else []),
            parameter_chart(document["parameters"]),
        ],
    )


def doubts_of(document: Mapping[str, Any]) -> Iterator[str]:
    """What cannot be told apart, what the data are silent on, and what is at a bound."""
    parameters = document["parameters"]
    identifiability = document.get("identifiability") or {}
    sets = identifiability.get("confounded", [])
    for group in sets[:_MOST_SETS]:
        yield (
            f"confounded: {wording.listing(group['names'])} imitate each other (collinearity "
            f"{wording.number(float(group['index']))}); these data tell only a combination of them"
        )
    if len(sets) > _MOST_SETS:
        more = wording.count(len(sets) - _MOST_SETS, "more such set")
        yield f"{more}: see identification.json"
    vague = identifiability.get("uninformed", [])
    if vague:
        listed = wording.listing(vague)
        yield f"unknown: of {listed} the data say next to nothing; the prior decided"
    absent = [  # sizes of effects that are zero
        name
        for name, p in parameters.items()
        if "." in name and p["at_bound"] == "lower" and p["lower"] == 0
    ]
    if absent:
        yield f"absent: {wording.listing(absent)} of size zero; these data show none of it"
    deviations = {name: _prior_deviations(p) for name, p in parameters.items()}
    far = {name: deviation for name, deviation in deviations.items() if deviation > _FAR}
    if far:
        listed = wording.listing([f"{name} ({deviation:.0f})" for name, deviation in far.items()])
        yield (
            f"far: {listed} prior deviations from what was known; it may stand for something that "
            "the model lacks, or the recording is not what it seems"
        )
    bound = [name for name, p in parameters.items() if p["at_bound"] and name not in absent]
    if bound:
        listed = wording.listing(bound)
        yield f"at a bound: {listed}; widen bounds.NAME, or ask what the model lacks"
    if document["details"].get("starts_agree") is False:
        yield "the starts did not agree: there is more than one optimum; the best is kept"
    spread = any(p["sd"] is not None for p in parameters.values())
    if document["outcome"] != "converged" and spread:
        yield "the search had not settled: the ± do not tell how far it still had to go"
    worse = [
        wording.signal(error.output)
        for error in _errors(document, "held_out")
        if error.before and error.rmse is not None and error.rmse > _WORSE * error.before
    ]
    if worse:
        listed = wording.listing(worse)
        yield f"worse than before on what was held out: {listed}; ask what the model lacks"


def _prior_deviations(parameter: Mapping[str, Any]) -> float:
    """By how many prior deviations a parameter moved, 0 where it has no prior."""
    if parameter["prior_sd"] is None or parameter["value"] is None:
        return 0.0
    return abs(float(parameter["value"] - parameter["prior_mean"])) / float(parameter["prior_sd"])


def parameter_chart(parameters: Mapping[str, Mapping[str, Any]]) -> Chart:
    """Fitted values in prior standard deviations from the prior's centre."""
    count = len(parameters)
    ends = [-0.7, -0.7], [count - 0.3, count - 0.3]
    starts: tuple[list[float], list[float]] = ([], [])
    inside: tuple[list[float], list[float]] = ([], [])
    bound: tuple[list[float], list[float]] = ([], [])
    whiskers: tuple[list[float], list[float]] = ([], [])
    names = []
    for place, (name, p) in enumerate(parameters.items()):
        scale = p["prior_sd"] or 0.3 * abs(p["prior_mean"] or p["start"]) or 1.0
        at = (p["value"] - p["prior_mean"]) / scale
        position = float(np.clip(at, -_REACH + 0.1, _REACH - 0.1))
        names.append(name if position == at else f"{name} ({at:+.0f} sd)".replace("-", "−"))
        _place(starts, (p["start"] - p["prior_mean"]) / scale, place)
        _place(bound if p["at_bound"] else inside, position, place)
        if p["sd"] is not None:
            whiskers[0].extend([position - p["sd"] / scale, position + p["sd"] / scale, np.nan])
            whiskers[1].extend([place, place, np.nan])
    marks: list[Mark] = [
        Band([-2.0, 2.0], *ends, "two and one prior deviations", "grey", 0.12),
        Band([-1.0, 1.0], *ends, "", "grey", 0.16),
        Curve(*whiskers, "", "blue", width=1.6),
        Points(*starts, "start", "cross", "grey", size=5.0),
        Points(*inside, "fitted ± one standard deviation", "dot", "blue", size=4.0),
    ]
    if bound[0]:
        marks.append(Points(*bound, "on a bound", "triangle", "alarm", size=5.0))
    label = "from the prior's centre, in prior standard deviations (30 % without a prior)"
    panel = Panel(Axis(label, limits=(-_REACH, _REACH)), Axis("", categories=names), marks)
    return Chart(
        "parameters",
        [panel],
        "Fitted values; the bands are one and two prior standard deviations.",
        columns=1,
        width=2 * _WIDTH,
        height=1.2 + 0.24 * count,
    )


def _place(points: tuple[list[float], list[float]], x: float, y: float) -> None:
    points[0].append(x)
    points[1].append(y)


def _search(document: Mapping[str, Any]) -> report.Section:
    settings = ", ".join(f"{k} {v}" for k, v in document["settings"].items() if k[0] != "_")
    text = [f"{document['method']}: {settings}."]
    agree = document["details"].get("starts_agree")
    if agree is not None:
        text.append(
            "All starts ended in the same optimum."
            if agree
            else "The starts ended in different optima; the best is kept."
        )
    many = len(document["history"]) > 1
    blocks = [convergence_chart(document["history"])] if many else []
    return report.Section("The search", text, blocks, folded=True)


def convergence_chart(history: Sequence[Sequence[float | None]]) -> Chart:
    """The search's cost above its least, over simulations and over time.

    ``history``: of evaluations, seconds and cost.
    """
    points = np.array([list(row) for row in history], dtype=float).reshape(-1, 3)
    least = float(np.nanmin(points[:, 2])) if len(points) else 0.0
    above = np.where(points[:, 2] > least, points[:, 2] - least, np.nan)
    is_finite = np.isfinite(above)
    costs = [cost for _, _, cost in history if cost is not None]
    lowest = f"above the least of all ({wording.number(least, 6)})"
    caption = f"The least cost so far, {lowest}."
    if any(b > a for a, b in pairwise(costs)):
        caption = (
            f"The cost along the search, {lowest}. Where it rises, another start was begun or the "
            "residuals were weighed anew."
        )
    y = Axis("cost above its least", log=bool(np.any(is_finite)))
    panels = [
        Panel(Axis(label, unit), y, [Curve(points[:, i], above, is_step=True)])
        for i, (label, unit) in enumerate((("simulations", ""), ("time", "s")))
    ]
    return Chart("convergence", panels, caption, width=_WIDTH, height=2.6)


def _recordings(document: Mapping[str, Any]) -> report.Section:
    columns = [
        report.Column("recording", "source"),
        report.Column("part", lambda r: PARTS[r["part"]]),
        report.Column("from [s]", "from_s"),
        report.Column("to [s]", "to_s"),
        report.Column("rate [Hz]", lambda r: 1 / r["sample_time_s"]),
        report.Column("SHA-256", lambda r: r["sha256"][:16]),
    ]
    remarks = list(dict.fromkeys(remark for r in document["recordings"] for remark in r["remarks"]))
    blocks: list[report.Block] = [report.table(document["recordings"], columns, on_screen=False)]
    blocks += [report.Remarks(remarks, on_screen=False)] if remarks else []
    return report.Section("Recordings", (), blocks, folded=True)
