"""What a validation has to tell: which model, its errors, where they lie, what the tests see."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from trms_cli.core import wording
from trms_cli.core.findings import (
    Block,
    Cell,
    Column,
    Findings,
    Judged,
    Judgement,
    Measure,
    Remarks,
    Section,
    Table,
    table,
)
from trms_cli.core.invocation import command_line
from trms_cli.identification.admission import Issue
from trms_cli.identification.validation import charts
from trms_cli.identification.validation.characteristics import characteristics_of
from trms_cli.identification.validation.validate import ModelValidation
from trms_cli.identification.validation.verdict import (
    SMALL,
    Remark,
    lead_of,
    p_words,
    remarks_on,
    remarks_on_comparison,
    word,
)

_START_WORDS = {
    "estimated": "estimated by the filter from all samples before the window",
    "moving_horizon": "the end of the model's own best run over the seconds before the window",
    "fitted": "fitted to the window itself, which flatters the model",
}
Document = Mapping[str, Any]


def findings(document: Document, validations: Sequence[ModelValidation] = ()) -> Findings:
    """What is worth telling of a validation.

    Parameters
    ----------
    document : dict
        ``trms.validation/1``.
    validations : sequence of ModelValidation
        What charts are drawn of; none without.
    """
    models = models_of(document)
    sections = [_comparison(document)] if len(models) > 1 else []
    for name, of in models.items():
        heading = "What is good and what is not" if len(models) == 1 else f"{name} in sentences"
        items = Remarks(_judged(remarks_on(of)), on_screen=len(models) == 1)
        sections.append(Section(heading, (), [items], folded=len(models) > 1))
    sections += [_errors(models, validations), _errors_in_full(models)]
    sections += _regions(validations)
    sections.append(_tests(models, validations))
    sections += _spectra(validations)
    sections += _signals(validations)
    sections.append(_method(document, models))
    return Findings(
        title=f"Validation of {wording.listing(list(models))}",
        lead=lead_of(document),
        sections=sections,
        warnings=[str(Issue(**warning)) for warning in document["warnings"]],
        measures=_measures(document, models),
        facts=_facts(document),
    )


def models_of(document: Document) -> dict[str, Document]:
    """The figures of each model, by its name."""
    return dict(document["models"]) if "models" in document else {document["model"]: document}


def in_short(document: Document) -> str:
    """One line for a job of a sweep."""
    rows = document["by_horizon"]
    last = list(next(iter(rows.values())))[-1]
    parts = [
        f"{channel} {wording.quantity(row[last]['rms'], document['units'][channel])}"
        for channel, row in rows.items()
    ]
    return f"RMS over {float(last):g} s {', '.join(parts)}"


def _judged(remarks: Sequence[Remark]) -> list[Judged]:
    return [Judged(remark.text, remark.judgement) for remark in remarks]


def _measures(document: Document, models: Mapping[str, Document]) -> list[Measure]:
    if len(models) > 1:
        return []
    (of,) = models.values()
    measures = []
    for channel, horizons in of["by_horizon"].items():
        last = list(horizons)[-1]
        row = horizons[last]
        unit, scale = wording.small_unit(of["units"][channel])
        value = None if row["rms"] is None else scale * row["rms"]
        better = row["rms"] is not None and row["rms"] < (row["unchanged_rms"] or 0)
        judgement: Judgement = "" if better else "bad"
        note = f"free for {float(last):g} s"
        measures.append(Measure(f"RMS {word(channel)}", value, unit, judgement, note))
    failed, count = of["residual_tests"]["failed"], of["residual_tests"]["count"]
    mark: Judgement = "bad" if failed else "good"
    measures.append(Measure("tests that fail", f"{failed} of {count}", "", mark, "one step ahead"))
    return measures


def _facts(document: Document) -> dict[str, str]:
    facts = {}
    for recording in document["recordings"]:
        key = "recording" if len(document["recordings"]) == 1 else f"recording {recording['name']}"
        facts[key] = (
            f"{recording['file']}: {recording['duration_s']:g} s at "
            f"{1 / recording['sample_time_s']:g} Hz, SHA-256 {recording['sha256'][:12]}…"
        )
    facts["windows"] = ", ".join(
        f"{count} of {float(horizon):g} s" for horizon, count in document["windows"].items()
    )
    facts["their start"] = _START_WORDS[document["window_start"]]
    for i, note in enumerate(document["notes"]):
        facts[f"note {i + 1}" if len(document["notes"]) > 1 else "note"] = note
    facts["command"] = f"`{command_line()}`"
    facts["versions"] = ", ".join(f"{name} {v}" for name, v in document["versions"].items())
    return facts


def _comparison(document: Document) -> Section:
    ranks = {row["model"]: rank for rank, row in enumerate(document["ranking"], 1)}
    columns = [
        Column("rank", lambda row: ranks[row["model"]]),
        Column("model", "model"),
        Column("error over no change", "relative_error"),
        Column("95 % interval", lambda row: _between(row["ci95"])),
    ]
    blocks: list[Block] = [
        table(document["ranking"], columns, heads=2),
        Remarks(_judged(remarks_on_comparison(document))),
    ]
    rows: list[list[Cell]] = []
    for pair in document["comparison"]:
        for channel, horizons in pair["by_channel"].items():
            cells = [_ratio(figures) for figures in horizons.values()]
            rows.append([" / ".join(pair["models"]), word(channel), *cells])
    horizons = list(next(iter(document["comparison"][0]["by_channel"].values()), {}))
    if rows:
        blocks.append(
            Table(
                ["models", "channel", *(f"{float(h):g} s" for h in horizons)],
                rows,
                "RMS of the first over RMS of the second, with 95 % intervals; coloured where "
                f"they differ by more than chance and more than {100 * SMALL:g} %.",
                heads=2,
                on_screen=False,
            )
        )
    return Section(
        "Which model",
        [
            "The same windows for all models. The error is the geometric mean, over channels and "
            "horizons, of the RMS over that of predicting no change; intervals from a bootstrap "
            "over blocks of time, paired between models."
        ],
        blocks,
    )


def _ratio(figures: Document) -> Judged:
    low, high = figures["ci95"]
    mark: Judgement = ""
    if low is not None and abs(figures["ratio"] - 1.0) >= SMALL:
        mark = "good" if high < 1 else "bad" if low > 1 else ""
    text = wording.number(figures["ratio"])
    if low is not None:
        text += f" ({wording.interval(low, high)})"
    return Judged(text, mark)


def _errors(models: Mapping[str, Document], validations: Sequence[ModelValidation]) -> Section:
    blocks: list[Block] = [_in_short(name, of) for name, of in models.items()]
    if validations:
        blocks += [charts.growth_chart(validations), charts.free_run_chart(validations)]
    return Section(
        "Errors",
        [
            "The model runs alone from the start of each window. RMS over all samples of the "
            "windows of a horizon."
        ],
        blocks,
    )


def _errors_in_full(models: Mapping[str, Document]) -> Section:
    text = (
        "RMS over the windows of a horizon, with the 95 % interval; **at its end** that much time "
        "after the last measurement. Fit is 1 − ‖e‖/‖y − ȳ‖, VAF 1 − var e/var y."
    )
    tables = [_error_table(name, of) for name, of in models.items()]
    return Section("Errors in full", [text], tables, folded=True)


def _in_short(name: str, of: Document) -> Table:
    """A row a channel and one of predicting no change; columns of horizons."""
    horizons = list(next(iter(of["by_horizon"].values())))
    rows: list[list[Cell]] = []
    for channel, by_horizon in of["by_horizon"].items():
        unit, scale = wording.small_unit(of["units"][channel])
        steps = [of["one_step"][channel], *(by_horizon[h] for h in horizons)]
        tests = [t for t in of["residual_tests"]["tests"] if t["channel"] == channel]
        failed = sum(test["failed"] for test in tests)

        def figures(key: str, steps: list[Any] = steps, scale: float = scale) -> list[Cell]:
            return [None if s[key] is None else scale * s[key] for s in steps]

        fit = by_horizon[horizons[-1]]["fit_percent"]
        tested = Judged(f"{failed}/{len(tests)}", "bad" if failed else "")
        label = wording.titled(word(channel), unit)
        rows.append([label, *figures("rms"), None if fit is None else round(fit), tested])
        rows.append(["  no change", *figures("unchanged_rms"), None, ""])
    heads = [name, "1 step", *(f"{float(h):g} s" for h in horizons), "fit [%]", "tests"]
    caption = f"RMS; fit over {float(horizons[-1]):g} s; residual tests that fail."
    return Table(heads, rows, caption)


def _error_table(name: str, of: Document) -> Table:
    rows: list[list[Cell]] = []
    for channel, horizons in of["by_horizon"].items():
        unit = of["units"][channel]
        step, whole = of["one_step"][channel], of["free_run"][channel]
        label = wording.titled(word(channel), unit)
        rows.append(
            [label, "one step", step["rms"], "", step["rms"], step["max"],
             step["unchanged_rms"], step["fit_percent"], step["vaf_percent"]]
        )  # fmt: skip
        for horizon, row in horizons.items():
            better = row["rms"] is not None and row["rms"] < (row["unchanged_rms"] or 0)
            rows.append(
                ["", f"{float(horizon):g} s", Judged(row["rms"], "" if better else "bad"),
                 _between(row["ci95"]), row["at_end"], row["max"], row["unchanged_rms"],
                 row["fit_percent"], row["vaf_percent"]]
            )  # fmt: skip
        rows.append(
            ["", "to the end", whole["rms"], "", None, whole["max"], None,
             whole["fit_percent"], whole["vaf_percent"]]
        )  # fmt: skip
    heads = ["channel", "free for", "RMS", "95 % interval", "at its end", "largest", "no change"]
    caption = f"{name}. Red: no better than predicting no change."
    return Table([*heads, "fit [%]", "VAF [%]"], rows, caption, heads=2, on_screen=False)


def _regions(validations: Sequence[ModelValidation]) -> list[Section]:
    chart = charts.region_chart(validations) if validations else None
    if chart is None:
        return []
    text = (
        "The error over the operating range: a row a channel, a column a signal that tells where "
        "the rig was. The bins of a column hold equally many samples."
    )
    return [Section("Where the error lies", [text], [chart], folded=True)]


def _tests(models: Mapping[str, Document], validations: Sequence[ModelValidation]) -> Section:
    tests = next(iter(models.values()))["residual_tests"]
    source = (
        "from simulations of the model with the sensors' noise and quanta"
        if tests["calibration"] == "simulated"
        else "from the limit of long recordings, valid for any input and in closed loop"
    )
    blocks: list[Block] = [_test_table(name, of) for name, of in models.items()]
    drawn = {v.name: charts.correlation_chart(v) for v in validations}
    blocks += [chart for chart in drawn.values() if chart is not None]
    short = [name for name, chart in drawn.items() if chart is None]
    return Section(
        "Residual tests",
        [
            "What the past foretells of the one-step error, a right model has foretold. The "
            f"p-values are {source}, and hold for all tests together (Holm): a right model fails "
            f"any of them with a probability of {100 * tests['level']:g} %.",
            *(f"{name}: the recording is too short for tests of correlation." for name in short),
        ],
        blocks,
        folded=True,
    )


def _test_table(name: str, of: Document) -> Table:
    channels = list(of["by_horizon"])
    by_place = {(t["channel"], t["name"]): t for t in of["residual_tests"]["tests"]}
    rows: list[list[Cell]] = []
    for test in dict.fromkeys(key[1] for key in by_place):
        own = [by_place.get((channel, test)) for channel in channels]
        known = [one for one in own if one is not None and one["p_holm"] is not None]
        meaning, formula = (known[-1]["meaning"], known[-1]["formula"]) if known else ("", "")
        rows.append([formula, *map(_p_value, own), meaning])
    heads = ["test", *(word(channel) for channel in channels), "if it fails"]
    count = of["residual_tests"]["count"]
    caption = f"{name}: p over all {wording.count(count, 'test')}. {_predictor(of)}"
    return Table(heads, rows, caption, on_screen=False)


def _p_value(test: Document | None) -> Cell:
    if test is None or test["p_holm"] is None:
        return wording.MISSING
    text = p_words(test["p_holm"]).removeprefix("p ").removeprefix("= ")
    return Judged(("✗ " if test["failed"] else "") + text, "bad" if test["failed"] else "good")


def _predictor(of: Document) -> str:
    orders = of["residual_tests"]["whitening_order"]
    taken = ", ".join(f"{word(c)} {order}" for c, order in orders.items() if order)
    text = f"Predictor: {of['predictor']}."
    if taken:
        text += (
            f" An autoregression (order: {taken}) was taken out before all tests but the first "
            "two of correlation in time."
        )
    return text


def _spectra(validations: Sequence[ModelValidation]) -> list[Section]:
    chart = charts.spectra_chart(validations) if validations else None
    if chart is None:
        return []
    text = (
        "Power spectral densities of the measured channel, of the free run to the end of the "
        "recording and of its error; the coherence tells how much of the error follows an input "
        "linearly."
    )
    return [Section("Spectra", [text], [chart], folded=True)]


def _signals(validations: Sequence[ModelValidation]) -> list[Section]:
    if not validations:
        return []
    columns = [
        Column("signal", lambda c: wording.titled(c.name, c.unit)),
        *(Column(n, n) for n in ("mean", "sd", "least", "largest", "skewness", "kurtosis")),
        Column("correlation time [s]", "correlation_time"),
        Column("peak [Hz]", "peak_frequency"),
        Column("95 % of power below [Hz]", "band_edge"),
        Column("p: mean drifts", "trend_of_mean"),
        Column("p: power drifts", "trend_of_power"),
        Column("missing", "missing"),
    ]
    first = characteristics_of(validations[0].datasets[0])
    blocks: list[Block] = []
    for dataset in validations[0].datasets:
        caption = f"{dataset.name}. Kurtosis is 3 for a normal distribution."
        blocks.append(table(characteristics_of(dataset), columns, caption, on_screen=False))
    if first:
        blocks.append(charts.signal_chart(first, validations[0].sample_time))
    text = (
        "What the recording excites. A small p of drift means that mean or power changed over the "
        "recording: averages over it then hide something."
    )
    return [Section("Signals", [text], blocks, folded=True)]


def _method(document: Document, models: Mapping[str, Document]) -> Section:
    predictor = next(iter(models.values()))["predictor"]
    items = [
        f"Start of a window: {_START_WORDS[document['window_start']]}. Predicting no change "
        "starts from the last sample before the window.",
        f"One-step errors: {predictor}.",
        "Where a test or an interval does not exist, there is a dash. All figures are in "
        "validation.json beside this page.",
    ]
    left = document["left_out_horizons_s"]
    if left:
        listed = ", ".join(f"{horizon:g} s" for horizon in left)
        items.append(f"Horizons that do not fit the recording: {listed}.")
    return Section("How it was made", (), [Remarks(items, on_screen=False)], folded=True)


def _between(ends: Sequence[float | None]) -> str:
    low, high = ends
    return wording.MISSING if low is None or high is None else wording.interval(low, high)
