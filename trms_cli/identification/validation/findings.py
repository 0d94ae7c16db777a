"""What a validation has to tell: which model, its errors, where they lie, what the tests see.

The sentences, each with a judgement, are made from the document's figures alone, so that what is
said and what is written agree.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from trms_cli.core import findings as report
from trms_cli.core import wording
from trms_cli.core.invocation import command_line
from trms_cli.identification.admission.issues import Issue
from trms_cli.identification.validation import charts
from trms_cli.identification.validation.metrics import characteristics_of
from trms_cli.identification.validation.residual_tests import p_words
from trms_cli.identification.validation.validate import ModelValidation

_START_WORDS = {
    "estimated": "estimated by the filter from all samples before the window",
    "moving_horizon": "the end of the model's own best run over the seconds before the window",
    "fitted": "fitted to the window itself, which flatters the model",
}
Document = Mapping[str, Any]
_WORDS = {
    **wording.SIGNALS,
    "omega_v": "main rotor speed",
    "omega_h": "tail rotor speed",
    "u_v": "main command",
    "u_h": "tail command",
}
#: An error up to this many times the declared noise is the noise's.
_AT_THE_NOISE = 1.5
#: Error over that of predicting no change: below the first it is good, below the second of use.
_GOOD, _USEFUL = 0.3, 0.9
#: A quarter of the time with this much of the squared error is worth a sentence.
_CONCENTRATED = 0.5
#: Models whose errors differ by less than this share are alike for all purposes.
_SMALL = 0.02
#: Most sentences on failed tests.
_MOST_TESTS = 6
#: Kinds of tests that a right model fails too where its outputs are quantised.
_WHITENESS = ("auto", "ljung_box", "other")


def findings(document: Document, validations: Sequence[ModelValidation] = ()) -> report.Findings:
    """What is worth telling of a validation: of ``trms.validation/1``.

    ``validations``: what charts are drawn of; none without.
    """
    models = dict(document["models"]) if "models" in document else {document["model"]: document}
    sections = [_comparison(document)] if len(models) > 1 else []
    for name, of in models.items():
        heading = "What is good and what is not" if len(models) == 1 else f"{name} in sentences"
        items = report.Remarks(remarks_on(of), on_screen=len(models) == 1)
        sections.append(report.Section(heading, (), [items], folded=len(models) > 1))
    sections += [_errors(models, validations), _errors_in_full(models)]
    sections += _regions(validations)
    sections.append(_tests(models, validations))
    sections += _spectra(validations)
    sections += _signals(validations)
    sections.append(_method(document, models))
    return report.Findings(
        title=f"Validation of {wording.listing(list(models))}",
        lead=lead_of(document),
        sections=sections,
        warnings=[str(Issue(**warning)) for warning in document["warnings"]],
        measures=_measures(document, models),
        facts=_facts(document),
    )


def in_short(document: Document) -> str:
    """One line for a job of a sweep."""
    rows, last = document["by_horizon"], _last(document)
    parts = [
        f"{channel} {wording.quantity(row[last]['rms'], document['units'][channel])}"
        for channel, row in rows.items()
    ]
    return f"RMS over {float(last):g} s {', '.join(parts)}"


def _measures(document: Document, models: Mapping[str, Document]) -> list[report.Measure]:
    if len(models) > 1:
        return []
    (of,) = models.values()
    measures = []
    last = _last(of)
    for channel, horizons in of["by_horizon"].items():
        row = horizons[last]
        unit, scale = wording.small_unit(of["units"][channel])
        value = None if row["rms"] is None else scale * row["rms"]
        better = row["rms"] is not None and row["rms"] < (row["unchanged_rms"] or 0)
        judgement: report.Judgement = "" if better else "bad"
        note = f"free for {float(last):g} s"
        measures.append(report.Measure(f"RMS {word(channel)}", value, unit, judgement, note))
    failed, count = of["residual_tests"]["failed"], of["residual_tests"]["count"]
    mark: report.Judgement = "bad" if failed else "good"
    measures.append(
        report.Measure("tests that fail", f"{failed} of {count}", "", mark, "one step ahead")
    )
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


def _comparison(document: Document) -> report.Section:
    ranks = {row["model"]: rank for rank, row in enumerate(document["ranking"], 1)}
    columns = [
        report.Column("rank", lambda row: ranks[row["model"]]),
        report.Column("model", "model"),
        report.Column("error over no change", "relative_error"),
        report.Column("95 % interval", lambda row: _between(row["ci95"])),
    ]
    blocks: list[report.Block] = [
        report.table(document["ranking"], columns, heads=2),
        report.Remarks(remarks_on_comparison(document)),
    ]
    rows: list[list[report.Cell]] = []
    for pair in document["comparison"]:
        for channel, horizons in pair["by_channel"].items():
            cells = [_ratio(figures) for figures in horizons.values()]
            rows.append([" / ".join(pair["models"]), word(channel), *cells])
    horizons = list(next(iter(document["comparison"][0]["by_channel"].values()), {}))
    if rows:
        blocks.append(
            report.Table(
                ["models", "channel", *(f"{float(h):g} s" for h in horizons)],
                rows,
                "RMS of the first over RMS of the second, with 95 % intervals; coloured where "
                f"they differ by more than chance and more than {100 * _SMALL:g} %.",
                heads=2,
                on_screen=False,
            )
        )
    return report.Section(
        "Which model",
        [
            "The same windows for all models. The error is the geometric mean, over channels and "
            "horizons, of the RMS over that of predicting no change; intervals from a bootstrap "
            "over blocks of time, paired between models."
        ],
        blocks,
    )


def _ratio(figures: Document) -> report.Datum:
    low, high = figures["ci95"]
    mark: report.Judgement = ""
    if low is not None and abs(figures["ratio"] - 1.0) >= _SMALL:
        mark = "good" if high < 1 else "bad" if low > 1 else ""
    text = wording.number(figures["ratio"])
    if low is not None:
        text += f" ({wording.interval(low, high)})"
    return report.Datum(text, mark)


def _errors(
    models: Mapping[str, Document], validations: Sequence[ModelValidation]
) -> report.Section:
    blocks: list[report.Block] = [_in_short(name, of) for name, of in models.items()]
    if validations:
        blocks += [charts.growth_chart(validations), charts.free_run_chart(validations)]
    return report.Section(
        "Errors",
        [
            "The model runs alone from the start of each window. RMS over all samples of the "
            "windows of a horizon."
        ],
        blocks,
    )


def _errors_in_full(models: Mapping[str, Document]) -> report.Section:
    text = (
        "RMS over the windows of a horizon, with the 95 % interval; **at its end** that much time "
        "after the last measurement. Fit is 1 − ‖e‖/‖y − ȳ‖, VAF 1 − var e/var y."
    )
    tables = [_error_table(name, of) for name, of in models.items()]
    return report.Section("Errors in full", [text], tables, folded=True)


def _in_short(name: str, of: Document) -> report.Table:
    """A row a channel and one of predicting no change; columns of horizons."""
    horizons = list(next(iter(of["by_horizon"].values())))
    rows: list[list[report.Cell]] = []
    for channel, by_horizon in of["by_horizon"].items():
        unit, scale = wording.small_unit(of["units"][channel])
        steps = [of["one_step"][channel], *(by_horizon[h] for h in horizons)]
        tests = [t for t in of["residual_tests"]["tests"] if t["channel"] == channel]
        failed = sum(test["failed"] for test in tests)

        def figures(key: str, steps: list[Any] = steps, scale: float = scale) -> list[report.Cell]:
            return [None if s[key] is None else scale * s[key] for s in steps]

        fit = by_horizon[horizons[-1]]["fit_percent"]
        tested = report.Datum(f"{failed}/{len(tests)}", "bad" if failed else "")
        label = wording.with_unit(word(channel), unit)
        rows.append([label, *figures("rms"), None if fit is None else round(fit), tested])
        rows.append(["  no change", *figures("unchanged_rms"), None, ""])
    heads = [name, "1 step", *(f"{float(h):g} s" for h in horizons), "fit [%]", "tests"]
    caption = f"RMS; fit over {float(horizons[-1]):g} s; residual tests that fail."
    return report.Table(heads, rows, caption)


def _error_table(name: str, of: Document) -> report.Table:
    columns = [
        *(report.Column(head, head) for head in ("channel", "free for")),
        report.Column("RMS", "rms"),
        report.Column("95 % interval", "interval"),
        report.Column("at its end", "at_end"),
        report.Column("largest", "max"),
        report.Column("no change", "unchanged_rms"),
        report.Column("fit [%]", "fit_percent"),
        report.Column("VAF [%]", "vaf_percent"),
    ]
    caption = f"{name}. Red: no better than predicting no change."
    return report.table(_error_rows(of), columns, caption, heads=2, on_screen=False)


def _error_rows(of: Document) -> Iterator[dict[str, Any]]:
    """Figures of a channel one step ahead, at each horizon, and to the end of the recording."""
    for channel, horizons in of["by_horizon"].items():
        step = {"free for": "one step", "interval": "", **of["one_step"][channel]}
        label = wording.with_unit(word(channel), of["units"][channel])
        yield {"channel": label, "at_end": step["rms"], **step}
        for horizon, row in horizons.items():
            better = row["rms"] is not None and row["rms"] < (row["unchanged_rms"] or 0)
            rms = report.Datum(row["rms"], "" if better else "bad")
            place = {"channel": "", "free for": f"{float(horizon):g} s"}
            yield {**row, **place, "rms": rms, "interval": _between(row["ci95"])}
        yield {"channel": "", "free for": "to the end", "interval": "", **of["free_run"][channel]}


def _regions(validations: Sequence[ModelValidation]) -> list[report.Section]:
    chart = charts.region_chart(validations) if validations else None
    if chart is None:
        return []
    text = (
        "The error over the operating range: a row a channel, a column a signal that tells where "
        "the rig was. The bins of a column hold equally many samples."
    )
    return [report.Section("Where the error lies", [text], [chart], folded=True)]


def _tests(
    models: Mapping[str, Document], validations: Sequence[ModelValidation]
) -> report.Section:
    tests = next(iter(models.values()))["residual_tests"]
    source = (
        "from simulations of the model with the sensors' noise and quanta"
        if tests["calibration"] == "simulated"
        else "from the limit of long recordings, valid for any input and in closed loop"
    )
    blocks: list[report.Block] = [_test_table(name, of) for name, of in models.items()]
    charts_by_model = {v.name: charts.correlation_chart(v) for v in validations}
    blocks += [chart for chart in charts_by_model.values() if chart is not None]
    short = [name for name, chart in charts_by_model.items() if chart is None]
    return report.Section(
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


def _test_table(name: str, of: Document) -> report.Table:
    channels = list(of["by_horizon"])
    by_place = {(t["channel"], t["name"]): t for t in of["residual_tests"]["tests"]}
    rows: list[list[report.Cell]] = []
    for test in dict.fromkeys(key[1] for key in by_place):
        own = [by_place.get((channel, test)) for channel in channels]
        results = [one for one in own if one is not None and one["p_holm"] is not None]
        meaning, formula = (results[-1]["meaning"], results[-1]["formula"]) if results else ("", "")
        rows.append([formula, *map(_p_value, own), meaning])
    heads = ["test", *(word(channel) for channel in channels), "if it fails"]
    count = of["residual_tests"]["count"]
    caption = f"{name}: p over all {wording.count(count, 'test')}. {_predictor(of)}"
    return report.Table(heads, rows, caption, on_screen=False)


def _p_value(test: Document | None) -> report.Cell:
    if test is None or test["p_holm"] is None:
        return wording.MISSING
    text = p_words(test["p_holm"]).removeprefix("p ").removeprefix("= ")
    return report.Datum(
        ("✗ " if test["failed"] else "") + text, "bad" if test["failed"] else "good"
    )


def _predictor(of: Document) -> str:
    orders = of["residual_tests"]["whitening_order"]
    order_words = ", ".join(f"{word(c)} {order}" for c, order in orders.items() if order)
    text = f"Predictor: {of['predictor']}."
    if order_words:
        text += (
            f" An autoregression (order: {order_words}) was taken out before all tests but the "
            "first two of correlation in time."
        )
    return text


def _spectra(validations: Sequence[ModelValidation]) -> list[report.Section]:
    chart = charts.spectra_chart(validations) if validations else None
    if chart is None:
        return []
    text = (
        "Power spectral densities of the measured channel, of the free run to the end of the "
        "recording and of its error; the coherence tells how much of the error follows an input "
        "linearly."
    )
    return [report.Section("Spectra", [text], [chart], folded=True)]


def _signals(validations: Sequence[ModelValidation]) -> list[report.Section]:
    if not validations:
        return []
    columns = [
        report.Column("signal", lambda c: wording.with_unit(c.name, c.unit)),
        *(report.Column(n, n) for n in ("mean", "sd", "least", "largest", "skewness", "kurtosis")),
        report.Column("correlation time [s]", "correlation_time"),
        report.Column("peak [Hz]", "peak_frequency"),
        report.Column("95 % of power below [Hz]", "band_edge"),
        report.Column("p: mean drifts", "trend_of_mean"),
        report.Column("p: power drifts", "trend_of_power"),
        report.Column("missing", "missing"),
    ]
    first = characteristics_of(validations[0].datasets[0])
    blocks: list[report.Block] = []
    for dataset in validations[0].datasets:
        caption = f"{dataset.name}. Kurtosis is 3 for a normal distribution."
        blocks.append(report.table(characteristics_of(dataset), columns, caption, on_screen=False))
    if first:
        blocks.append(charts.signal_chart(first, validations[0].sample_time))
    text = (
        "What the recording excites. A small p of drift means that mean or power changed over the "
        "recording: averages over it then hide something."
    )
    return [report.Section("Signals", [text], blocks, folded=True)]


def _method(document: Document, models: Mapping[str, Document]) -> report.Section:
    predictor = next(iter(models.values()))["predictor"]
    items = [
        f"Start of a window: {_START_WORDS[document['window_start']]}. Predicting no change "
        "starts from the last sample before the window.",
        f"One-step errors: {predictor}.",
        "Where a test or an interval does not exist, there is a dash. All figures are in "
        "validation.json beside this page.",
    ]
    omissions = document["left_out_horizons_s"]
    if omissions:
        listed = ", ".join(f"{horizon:g} s" for horizon in omissions)
        items.append(f"Horizons that do not fit the recording, or an unstable model: {listed}.")
    return report.Section(
        "How it was made", (), [report.Remarks(items, on_screen=False)], folded=True
    )


def _between(ends: Sequence[float | None]) -> str:
    low, high = ends
    return wording.MISSING if low is None or high is None else wording.interval(low, high)


def word(name: str) -> str:
    """A signal in words."""
    return _WORDS.get(name, name)


def quantity_words(value: float | None, unit: str) -> str:
    """A figure with its unit, small angles in mrad."""
    if value is None:
        return "–"
    if unit.startswith("rad") and unit != "rad/s" and abs(value) < 0.1:
        return f"{_digits(1e3 * value)} m{unit}"
    return _digits(value) if unit == "1" else f"{_digits(value)} {unit}"


def _digits(value: float) -> str:
    if value == 0 or 1e-3 <= abs(value) < 1e4:
        return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"
    return f"{value:.1e}"


def lead_of(document: Document) -> list[str]:
    """The sentences on top."""
    return _lead_of_several(document) if "models" in document else _lead_of_one(document)


def _lead_of_one(document: Document) -> list[str]:
    horizon = _last(document)
    groups: dict[str, list[str]] = {"noise": [], "good": [], "useful": [], "bad": []}
    for channel, rows in document["by_horizon"].items():
        groups[_grade(document, channel, rows[horizon])].append(
            f"{word(channel)} to {quantity_words(rows[horizon]['rms'], document['units'][channel])}"
        )
    parts = [
        f"{beginning} {wording.listing(groups[key])}"
        for key, beginning in (
            ("noise", "foretells down to the sensor's noise:"),
            ("good", "foretells well:"),
            ("useful", "foretells roughly:"),
            ("bad", "is no better than predicting no change in:"),
        )
        if groups[key]
    ]
    first = f"Left alone for {float(horizon):g} s, {document['model']} {'; '.join(parts)} (RMS)."
    tests = document["residual_tests"]
    if tests["failed"]:
        channels = list(dict.fromkeys(word(test["channel"]) for test in _failed(document)))
        second = (
            f"One step ahead, {tests['failed']} of {tests['count']} residual tests find something "
            f"that the model leaves unexplained, first in {wording.listing(channels[:3])}."
        )
    else:
        second = (
            f"One step ahead, none of {tests['count']} residual tests finds anything that the "
            "model leaves unexplained."
        )
    return [first, second]


def _lead_of_several(document: Document) -> list[str]:
    ranking = document["ranking"]
    best = ranking[0]
    if best["relative_error"] is None:
        return ["None of the models can be ranked: no error is finite, or nothing moves."]
    best_two = [best["model"], ranking[1]["model"]]
    against = next((pair for pair in document["comparison"] if pair["models"] == best_two), None)
    sentences = []
    lasting = document["models"][best["model"]]
    horizon = _last(lasting)
    errors = [
        f"{word(c)} {quantity_words(rows[horizon]['rms'], lasting['units'][c])}"
        for c, rows in lasting["by_horizon"].items()
    ]
    if against is not None and against["ratio"] is not None:
        ratio = f"{against['ratio']:.3g}"
        if against["ci95"][0] is not None:
            ratio += f" (95 % interval {against['ci95'][0]:.3g} to {against['ci95'][1]:.3g})"
        if against["differ"] and abs(against["ratio"] - 1.0) < _SMALL:
            sentences.append(
                f"{best['model']} and {ranking[1]['model']} foretell alike: the errors of the "
                f"first are {ratio} times those of the second, on average over channels and "
                "horizons."
            )
        elif against["differ"]:
            sentences.append(
                f"{best['model']} foretells best: its errors are {ratio} times those of "
                f"{ranking[1]['model']}, on average over channels and horizons."
            )
        else:
            sentences.append(
                f"{best['model']} has the smallest errors, but these recordings do not tell it "
                f"from {ranking[1]['model']}: its errors are {ratio} times the other's."
            )
    sentences.append(
        f"Left alone for {float(horizon):g} s it errs by {wording.listing(errors)} (RMS)."
    )
    return sentences


def remarks_on(document: Document) -> list[report.Datum]:
    """One model's figures in sentences: errors, tests, regions."""
    return [
        *_on_errors(document),
        *_on_belief(document),
        *_on_tests(document),
        *_on_regions(document),
    ]


def _on_errors(document: Document) -> Iterator[report.Datum]:
    for channel, rows in document["by_horizon"].items():
        unit = document["units"][channel]
        horizons = list(rows)[-2:]
        errors = wording.listing(
            [f"{quantity_words(rows[h]['rms'], unit)} over {float(h):g} s" for h in horizons]
        )
        naive = wording.listing([quantity_words(rows[h]["unchanged_rms"], unit) for h in horizons])
        grades = [_grade(document, channel, rows[h]) for h in horizons]
        judgement: report.Judgement = "doubtful"
        if "bad" in grades:
            judgement = "bad"
        elif "useful" not in grades:
            judgement = "good"
        text = f"**{word(channel)}**: {errors}; predicting no change errs by {naive}"
        fit = rows[horizons[-1]]["fit_percent"]
        if fit is not None:
            text += f"; fit {fit:.0f} %".replace("-", "−")
        if set(grades) == {"noise"}:
            noise = quantity_words(document["noise_sd"][channel], unit)
            text += f". That is the sensor's noise ({noise})"
        yield report.Datum(text + ".", judgement)


def _on_belief(document: Document) -> Iterator[report.Datum]:
    off = {
        channel: figures["normalised_square"]
        for channel, figures in document["one_step"].items()
        if figures["normalised_square"] is not None and not 0.4 < figures["normalised_square"] < 2.0
    }
    if off:
        parts = wording.listing([f"{word(c)} {value:.2g}" for c, value in off.items()])
        yield report.Datum(
            f"The one-step errors are not as wide as the declared noise and the filter expect "
            f"(mean square over expected: {parts}; 1 is right): `data.noise_sd` may be wrong.",
            "doubtful",
        )


def _on_tests(document: Document) -> Iterator[report.Datum]:
    tests = document["residual_tests"]
    level = f"{100 * tests['level']:g} %"
    if not tests["count"] or all(test["p"] is None for test in tests["tests"]):
        yield report.Datum("No residual test could be made: too few samples.", "doubtful")
        return
    if not tests["failed"]:
        yield report.Datum(
            f"None of {tests['count']} residual tests fails (a false alarm in any: {level}).",
            "good",
        )
        return
    failed = _failed(document)
    coloured = [test for test in failed if test["name"] in _WHITENESS]
    if coloured:
        channels = wording.listing(list(dict.fromkeys(word(test["channel"]) for test in coloured)))
        largest = max(abs(test["largest_correlation"] or 0.0) for test in coloured)
        text = (
            f"The one-step errors of {channels} are correlated in time (up to {largest:.2f}): a "
            "missing lag or state, or the noise model."
        )
        if tests["calibration"] == "asymptotic":
            text += (
                " A quantised angle does that to a right model too: `tests.calibration=simulated` "
                "tells the two apart."
            )
        yield report.Datum(text, "doubtful" if len(coloured) == len(failed) else "bad")
    groups: dict[tuple[str, str], list[Document]] = {}
    for test in failed:
        if test["name"] not in _WHITENESS:
            groups.setdefault((test["channel"], test["meaning"]), []).append(test)
    for (channel, meaning), failures in list(groups.items())[:_MOST_TESTS]:
        inputs = [" × ".join(word(name) for name in test["inputs"]) for test in failures]
        of = f" ({wording.listing(inputs)})" if any(inputs) else ""
        size = ""
        if failures[0]["name"] != "mean":
            largest = max(abs(test["largest_correlation"] or 0.0) for test in failures)
            size = f" correlation up to {largest:.2f},"
        p = p_words(failures[0]["p_holm"])
        yield report.Datum(f"**{word(channel)}**: {meaning}{of};{size} {p}.", "bad")
    rest = sum(len(failures) for failures in list(groups.values())[_MOST_TESTS:])
    if rest:
        yield report.Datum(f"{rest} more tests fail: see the table.", "bad")


def _on_regions(document: Document) -> Iterator[report.Datum]:
    """Per channel, the quarter of the time with most of the error, if it is much."""
    horizon = document["regions"]["horizon_s"]
    for channel, rows in document["by_horizon"].items():
        row = rows.get(repr(float(horizon)))
        if row is None or _grade(document, channel, row) == "noise":
            continue
        quarters = [
            (share, low, high, time, table["variable"])
            for table in document["regions"]["tables"]
            if table["channel"] == channel
            for low, high, time, share in [worst_quarter(table)]
        ]
        if not quarters:
            continue
        share, low, high, time, variable = max(quarters)
        if share >= max(_CONCENTRATED, 1.5 * time):
            unit = document["units"].get(variable, "")
            yield report.Datum(
                f"{100 * share:.0f} % of the squared error of {word(channel)} over {horizon:g} s "
                f"lies where {word(variable)} is between {_digits(low)} and {_digits(high)} {unit}"
                f"{' ' if unit else ''}({100 * time:.0f} % of the time).",
                "doubtful",
            )


def worst_quarter(table: Document) -> tuple[float, float, float, float]:
    """From, to, share of time, share of error of the worst neighbouring quarter of the bins.

    ``table``: a region table of the document: edges, time_share, error_share.
    """
    error, time, edges = table["error_share"], table["time_share"], table["edges"]
    width = max(1, len(error) // 4)
    i = max(
        range(len(error) - width + 1),
        key=lambda k: sum(error[k : k + width]) / sum(time[k : k + width]),
    )
    return edges[i], edges[i + width], sum(time[i : i + width]), sum(error[i : i + width])


def remarks_on_comparison(document: Document) -> list[report.Datum]:
    """Pairs of models in sentences."""
    remarks = []
    for pair in document["comparison"]:
        one, other = pair["models"]
        if pair["ratio"] is None:
            continue
        ratio = f"{pair['ratio']:.3g}"
        if pair["ci95"][0] is not None:
            ratio += f" ({pair['ci95'][0]:.3g} to {pair['ci95'][1]:.3g})"
        text = f"{one} errs {ratio} times as much as {other}"
        if not pair["differ"]:
            remarks.append(report.Datum(f"{text}: these recordings do not tell.", "doubtful"))
        elif abs(pair["ratio"] - 1.0) < _SMALL:
            remarks.append(
                report.Datum(f"{text}: more than chance, and next to nothing.", "doubtful")
            )
        else:
            remarks.append(report.Datum(f"{text}: more than chance.", "good"))
    return remarks


def _grade(document: Document, channel: str, row: Document) -> str:
    error, naive = row["rms"], row["unchanged_rms"]
    if error is None:
        return "bad"
    if error <= _AT_THE_NOISE * document["noise_sd"][channel]:
        return "noise"
    if not naive or error > _USEFUL * naive:
        return "bad"
    return "good" if error <= _GOOD * naive else "useful"


def _failed(document: Document) -> list[Document]:
    """The tests that fail, worst first."""
    failed = [test for test in document["residual_tests"]["tests"] if test["failed"]]
    return sorted(failed, key=lambda test: test["p"])


def _last(document: Document) -> str:
    return list(next(iter(document["by_horizon"].values())))[-1]
