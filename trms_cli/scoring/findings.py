"""What a score has to tell, as data: the answer in a sentence, its few figures first, its tables.

``trms run`` ends with the tables in short, ``trms score`` and the page of a run have them whole.
The score may be of another version of the program, or a stranger's: what it lacks is left out.
"""

from collections.abc import Mapping, Sequence
from typing import Any

from trms_cli.core import wording
from trms_cli.core.findings import Cell, Column, Datum, Judgement, Measure, Table, table
from trms_cli.scoring import figures
from trms_cli.scoring.baseline import BaselineRow, has_regressed
from trms_cli.scoring.figures import Figure, finite, part

#: What is more than sensors do: an encoder's steps alone, under a model that is exactly right,
#: correlate neighbouring innovations by up to 0.6, and thousands of samples make that certain.
_MUCH_CORRELATION = 0.7
_MUCH_NIS = 2.0
_SOURCES = {"state": "true state", "measurement": "measurements"}


def answer(score: Mapping[str, Any], who: str) -> str:
    """``newton_mpc followed pitch to 0.134 rad and yaw to 0.19 rad (RMSE) over 80 s, …``."""
    errors = [
        f"{wording.signal(entry.of)} to {wording.quantity(entry.value, entry.unit)}"
        for entry in _present_entries(score, "channels", "rmse")
    ]
    duration = f"{finite(score.get('duration_s')) or 0:g} s"
    troubles = ", ".join(trouble_of(score)) or "nothing to report of a solver"
    if errors:
        return f"**{who}** followed {wording.listing(errors)} (RMSE) over {duration}, {troubles}."
    return f"**{who}**: {duration} without a reference to follow, {troubles}."


def trouble_of(score: Mapping[str, Any], *, marks: bool = True) -> list[str]:
    """Missed deadlines, fall-backs and times that were not normal, in words."""
    bold = "**" if marks else ""
    solver = part(score, "solver")
    misses, failures = finite(solver.get("deadline_misses")), finite(solver.get("failures"))
    words = []
    if misses is not None:
        missed = f"{wording.count(int(misses), 'deadline')} missed"
        words.append(f"{bold}{missed}{bold}" if misses else missed)
    if failures:
        words.append(f"{bold}{wording.count(int(failures), 'fall-back')}{bold}")
    unwell = figures.total(finite(v) for v in part(part(score, "degraded"), "share").values())
    if unwell:
        words.append(f"not normal for {wording.percent(unwell)} of the time")
    return words


def measures_of(score: Mapping[str, Any]) -> list[Measure]:
    """The few figures that come first: tracking, the slowest step, effort, deadlines."""
    measures = []
    for entry in figures.entries(score, "channels"):
        if entry.figure.key == "rmse":
            label = f"RMSE {wording.signal(entry.of)}"
            measures.append(Measure(label, entry.value, entry.unit))
    if settling := _present_entries(score, "channels", "settling_time_s"):
        slowest = max(settling, key=lambda entry: entry.value or 0)
        note = f"slowest step, of {wording.signal(slowest.of)}"
        measures.append(Measure("settling time", slowest.value, "s", note=note))
    if effort := _present_entries(score, "inputs", "effort"):
        total = figures.total(entry.value for entry in effort)
        note = "" if len(effort) == 1 else "both inputs added"
        measures.append(Measure("effort ∫u²dt", total, effort[0].unit, note=note))
    solver = part(score, "solver")
    for key, label in (("deadline_misses", "deadlines missed"), ("failures", "fall-backs")):
        value = finite(solver.get(key))
        if value is not None:
            measures.append(Measure(label, value, "", "bad" if value else "good"))
    return measures


def _present_entries(
    score: Mapping[str, Any], group: figures.Group, key: str
) -> list[figures.Entry]:
    entries = figures.entries(score, group)
    return [e for e in entries if e.figure.key == key and e.value is not None]


def tables_of(score: Mapping[str, Any]) -> list[Table]:
    """Tracking, inputs, estimate, solver and exceeded limits."""
    tables = (
        *_by_names(score),
        _estimate(score),
        _solver(score),
        _timing(score),
        _exceeded(score),
    )
    return [table for table in tables if table.rows]


def short_tables(score: Mapping[str, Any]) -> list[Table]:
    """Tracking and inputs, the figures that tell most alone."""
    return [table for table in _by_names(score, short=True) if table.rows]


def in_short(score: Mapping[str, Any]) -> dict[str, str]:
    """Estimate and solver in a line each, where there is one."""
    estimate, solver = part(score, "estimate"), part(score, "solver")
    lines: dict[str, str] = {}
    followed = part(score, "channels") or part(estimate, "rmse")
    for figure in figures.of_group("states"):
        errors = [
            f"{wording.signal(e.of)} {wording.quantity(e.value, e.unit)}"
            for e in figures.entries(score, "states")
            if e.figure is figure and e.value and (e.of in followed or figure.key != "rmse")
        ]
        if errors and not lines:
            lines["estimate"] = f"{figure.label}: {', '.join(errors)}"
    if (nees := consistency(estimate).replace(", more is overconfident", "")) and lines:
        lines["estimate"] += f"; {nees}"
    elif nees:
        lines["estimate"] = nees
    times = [
        f"{wording.quantity(value, figure.unit)} {figure.label.rpartition(', ')[2]}"
        for figure in figures.of_group("solver")
        if figure.short and figure.unit and (value := figure.value(solver)) is not None
    ]
    if times:
        troubles = wording.listing(trouble_of(score, marks=False)) or "nothing missed"
        lines["solver"] = f"{', '.join(times)} a step; {troubles}"
    if words := timing_in_words(score):
        lines["timing"] = words
    return lines


def timing_in_words(score: Mapping[str, Any]) -> str:
    """How punctual a real rig's samples were; empty for a run that waited for no clock."""
    timing = part(score, "timing")
    late = finite(timing.get("late_share"))
    if late is None:
        return ""
    worst = wording.quantity(finite(part(timing, "lateness_ms").get("max")), "ms")
    after = [
        f"{wording.quantity(finite(part(timing, 'command_ms').get(key)), 'ms')} {key}"
        for key in ("median", "p99")
    ]
    words = f"{wording.percent(late, 1)} of the samples over 1 ms late, worst {worst}"
    words += f"; commands {', '.join(after)} after the reading"
    if skipped := finite(timing.get("skipped")):
        words += f"; {wording.count(int(skipped), 'sample')} left out"
    return words


def consistency(estimate: Mapping[str, Any]) -> str:
    """``NEES 6.03 (6 is consistent, more is overconfident)``; empty without covariances."""
    if finite(estimate.get("nees_mean")) is None:
        return ""
    expected = f"{estimate.get('nees_expected')} is consistent, more is overconfident"
    return f"NEES {wording.number(estimate['nees_mean'])} ({expected})"


def warnings_of(score: Mapping[str, Any]) -> list[str]:
    """How much of the run the loop was not normal, and why; nothing for a normal run."""
    degraded = part(score, "degraded")
    first = finite(degraded.get("first_s"))
    if first is None:
        return []
    shares = [
        f"{mode} for {wording.percent(share, 1)} of the time"
        for mode, share in part(degraded, "share").items()
        if share
    ]
    reasons = [
        f"{name} {wording.quantity(s, 's')}" for name, s in part(degraded, "reasons_s").items()
    ]
    return [f"mode: {', '.join(shares)}, first at {first:g} s ({', '.join(reasons)})"]


def scored_on(score: Mapping[str, Any]) -> str:
    """``scored on the true state``; empty without a channel."""
    sources = {own.get("scored_on") for own in part(score, "channels").values()} & {*_SOURCES}
    return f"scored on the {' and '.join(_SOURCES[s] for s in sorted(sources))}" if sources else ""


def comparison_table(rows: Sequence[BaselineRow], name: str, *, everything: bool = False) -> Table:
    """The figures that moved beyond their tolerance, or all; those that decide are judged."""

    def judgement(row: BaselineRow) -> Judgement:
        return "bad" if row.regressed else "good" if row.verdict == "better" else ""

    visible_rows = [row for row in rows if everything or row.verdict != "same"]
    columns = [
        Column(f"against {name}", lambda r: wording.with_unit(_key_in_words(r.key), r.unit)),
        Column("baseline", lambda r: Datum(r.baseline, sd=r.tolerance or None)),
        Column("now", lambda r: Datum(r.now, judgement(r), sd=r.tolerance or None)),
        Column("tolerance", lambda r: f"±{wording.number(r.tolerance)}"),
        Column("", lambda r: Datum(r.verdict if r.judged else f"({r.verdict})", judgement(r))),
    ]
    hint = "In brackets: shown only, does not decide."
    return table(visible_rows, columns, hint if any(not row.judged for row in visible_rows) else "")


def comparison_sentence(rows: Sequence[BaselineRow], name: str) -> str:
    """Whether a score is worse than the baseline, with the counts."""
    same = sum(row.verdict == "same" for row in rows)
    better = sum(row.judged and row.verdict == "better" for row in rows)
    worse = wording.count(sum(row.regressed for row in rows), "figure")
    verdict = "Worse" if has_regressed(list(rows)) else "Not worse"
    return f"{verdict} than the baseline {name}: {worse} worse, {better} better, {same} the same"


def comparison_rows(scores: Sequence[Mapping[str, Any]]) -> list[list[Cell]]:
    """Rows of figures, a column a score, the best of each row marked."""
    every = [{e.key: e for e in figures.entries(s, "channels", "inputs", "solver")} for s in scores]
    rows: list[list[Cell]] = []
    for key in dict.fromkeys(key for entries in every for key in entries):
        entry = next(entries[key] for entries in every if key in entries)
        values = [entries[key].value if key in entries else None for entries in every]
        numbers = [value for value in values if value is not None]
        if not numbers:
            continue
        # Equal to the digits that are shown is no victory.
        least, largest = min(numbers), max(numbers)
        apart = len(numbers) > 1 and largest - least > 1e-3 * max(abs(largest), abs(least))
        best = least if apart and entry.figure.better == "less" else None
        title = wording.with_unit(entry.figure.label, entry.unit)
        rows.append(
            [
                f"{channel_in_words(entry.of)}: {title}" if entry.of else title,
                *(Datum(v, "best" if v is not None and v == best else "") for v in values),
            ]
        )
    return rows


def channel_in_words(name: str) -> str:
    """A channel in words, an input with its symbol too: ``pitch``, ``main rotor u_v``."""
    words = wording.signal(name)
    return f"{words} {name}" if name.startswith("u_") and words != name else words


def innovation_sentences(estimate: Mapping[str, Any]) -> list[str]:
    """How far the innovations are from those of a filter that knows everything."""
    channels = part(estimate, "innovations").values()
    correlations = [c["correlation"] for c in channels if c.get("correlation") is not None]
    squares = [c["normalised_square"] for c in channels if c.get("normalised_square") is not None]
    correlation = max(correlations, key=abs, default=0.0)
    sentences = []
    p = finite(estimate.get("innovation_whiteness_p"))
    if p is not None and p >= 0.05:
        sentences.append("innovations white")
    elif p is not None:
        sentences.append(f"innovations not white (lag-1 correlation {correlation:.2f} at most)")
    if squares:
        low, high = (f"{edge:.2f}" for edge in (min(squares), max(squares)))
        extent = low if low == high else f"{low} to {high}"
        sentences.append(f"NIS {extent} a channel (1 is consistent, more is overconfident)")
    if finite(estimate.get("nis_mean")) is not None:
        inside = wording.percent(finite(estimate.get("nis_share_inside")))
        sentences.append(
            f"NIS of all {wording.number(estimate['nis_mean'])} ({estimate.get('nis_expected')} is "
            f"consistent), {inside} inside its 95 % interval"
        )
    for key, words in (("missing", "missing"), ("rejected", "rejected as outliers")):
        counts = {name: c.get(key, 0) for name, c in part(estimate, "innovations").items()}
        channel_counts = ", ".join(f"{name} {count}" for name, count in counts.items() if count)
        if channel_counts:
            sentences.append(f"samples {words}: {channel_counts}")
    if abs(correlation) > _MUCH_CORRELATION or max(squares, default=0.0) > _MUCH_NIS:
        sentences.append("the model, or the noise that the observer was told, misses something")
    return sentences


def _by_names(score: Mapping[str, Any], *, short: bool = False) -> list[Table]:
    tracking = _by_name(score, "channels", "tracking", short=short)
    return [tracking, _by_name(score, "inputs", "inputs", short=short)]


def _by_name(score: Mapping[str, Any], group: figures.Group, title: str, *, short: bool) -> Table:
    """A row a figure, a column a channel or an input."""
    members = {name: own for name, own in part(score, group).items() if isinstance(own, Mapping)}
    units = {str(own.get("unit", "")) for own in members.values()}
    unit = units.pop() if len(units) == 1 else ""
    steps = max((finite(own.get("steps")) or 0 for own in members.values()), default=0)
    rows: list[list[Cell]] = []
    for figure in figures.of_group(group):
        values = [figure.value(own) for own in members.values()]
        absent = all(value is None for value in values)
        once = steps < 2 and figure.of_steps == "median"
        if (short and not figure.short) or once or (absent and (short or not figure.of_steps)):
            continue
        rows.append([_title(figure, unit, steps), *values])
    unsettled = [finite(own.get("unsettled_steps")) or 0 for own in members.values()]
    late = wording.count(int(sum(unsettled)), "step") if sum(unsettled) else ""
    caption = (
        f"{late} had not settled when the next one came or the run ended." if late and short else ""
    )
    return Table([title, *map(channel_in_words, members)], rows if members else [], caption)


def _title(figure: Figure, unit: str, steps: float) -> str:
    """``overshoot, worst of 4 steps [%]``."""
    label = figure.label
    if figure.of_steps == "worst":
        label = label.partition(",")[0]
        label += f", worst of {steps:g} steps" if steps > 1 else ""
    return wording.with_unit(label, figure.unit_of(unit))


def _estimate(score: Mapping[str, Any]) -> Table:
    """Errors of the estimate, a row a state."""
    estimate = part(score, "estimate")
    # an observer that is handed the true state has no error worth a column
    columns = [f for f in figures.of_group("states") if any(part(estimate, f.key).values())]
    units = part(estimate, "units")
    rows: list[list[Cell]] = []
    for name in dict.fromkeys(name for figure in columns for name in part(estimate, figure.key)):
        values = [finite(part(estimate, figure.key).get(name)) for figure in columns]
        if any(value is not None for value in values):
            rows.append([wording.with_unit(_state(name), str(units.get(name, ""))), *values])
    caption = "; ".join(filter(None, [consistency(estimate), *innovation_sentences(estimate)]))
    return Table(
        ["estimate", *(figure.label for figure in columns)],
        rows,
        f"{caption[0].upper()}{caption[1:]}." if caption else "",
    )


def _state(name: str) -> str:
    words = wording.signal(name)
    return f"{words} {name}" if name.startswith("omega") else words.replace("_moment", " moment")


def _solver(score: Mapping[str, Any]) -> Table:
    """A row a figure: the time of a control step, and what went wrong."""
    solver = part(score, "solver")
    rows: list[list[Cell]] = [
        [
            wording.with_unit(figure.label, figure.unit),
            Datum(value, "bad" if figure.whole and figure.better and value else ""),
        ]
        for figure in figures.of_group("solver")
        if (value := figure.value(solver)) is not None
    ]
    timed = finite(part(solver, "time_ms").get("median")) is not None
    return Table(["solver", "value"], rows if timed else [])


def _timing(score: Mapping[str, Any]) -> Table:
    """A row a figure: how punctual the samples of a real rig were."""
    timing = part(score, "timing")
    rows: list[list[Cell]] = [
        [wording.with_unit(figure.label, figure.unit), Datum(value)]
        for figure in figures.of_group("timing")
        if (value := figure.value(timing)) is not None
    ]
    return Table(["time of the samples", "value"], rows)


def _exceeded(score: Mapping[str, Any]) -> Table:
    columns = figures.of_group("constraint_violations")
    rows: list[list[Cell]] = [
        [
            wording.with_unit(channel_in_words(name), str(part({name: own}, name).get("unit", ""))),
            *(Datum(f.value(own), "bad" if f.whole else "") for f in columns),
        ]
        for name, own in part(score, "constraint_violations").items()
        if isinstance(own, Mapping) and finite(own.get("samples"))
    ]
    return Table(["limits that were exceeded", *(f.label for f in columns)], rows)


def _key_in_words(key: str) -> str:
    """``channels.alpha_v.rmse`` as ``alpha_v rmse``."""
    group, _, rest = key.partition(".")
    words = rest if group in ("channels", "inputs") else key
    name = words.replace(".", " ").replace("constraint_violations", "limits")
    return name.removesuffix("_percent").removesuffix("_s").replace("prediction_rmse", "prediction")
