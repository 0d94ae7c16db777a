"""The page of a validation: sentences, tables and figures in one file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from trms_cli.commands.validate_pictures import (
    correlation_rows,
    error_growths,
    free_run_traces,
    spectra_of,
)
from trms_cli.core import wording
from trms_cli.core.findings import Judged, Judgement
from trms_cli.core.invocation import command_line
from trms_cli.identification.admission import Issue
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
from trms_cli.reporting import validation_figures, validation_spectra
from trms_cli.reporting.page import Page

_START_WORDS = {
    "estimated": "estimated by the filter from all samples before the window",
    "moving_horizon": "the end of the model's own best run over the seconds before the window",
    "fitted": "fitted to the window itself, which flatters the model",
}


def page_of(document: Mapping[str, Any], validations: Sequence[ModelValidation]) -> Page:
    """The page, ready to be written."""
    models = _models(document)
    page = Page(f"Validation of {_listed(list(models))}", lead_of(document), _facts(document))
    if len(models) > 1:
        _comparison(page, document)
    for name, of in models.items():
        heading = "What is good and what is not" if len(models) == 1 else f"{name} in sentences"
        page.section(heading)
        page.points([_marked(remark) for remark in remarks_on(of)])
    _errors(page, document, models, validations)
    _regions(page, validations)
    _tests(page, models, validations)
    _spectra(page, validations)
    _signals(page, validations)
    _method(page, document, models)
    return page


def _models(document: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    return dict(document["models"]) if "models" in document else {document["model"]: document}


def _facts(document: Mapping[str, Any]) -> dict[str, str]:
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
    for i, warning in enumerate(document["warnings"]):
        key = f"warning {i + 1}" if len(document["warnings"]) > 1 else "warning"
        facts[key] = str(Issue(**warning))
    facts["command"] = f"`{command_line()}`"
    facts["versions"] = ", ".join(f"{name} {v}" for name, v in document["versions"].items())
    return facts


def _comparison(page: Page, document: Mapping[str, Any]) -> None:
    page.section(
        "Which model",
        "The same windows for all models. The error is the geometric mean, over channels and "
        "horizons, of the RMS over that of predicting no change; intervals from a bootstrap over "
        "blocks of time, paired between models.",
    )
    rows: list[list[Any]] = []
    for rank, row in enumerate(document["ranking"], 1):
        rows.append([f"{rank}. {row['model']}", row["relative_error"], *row["ci95"]])
    page.table(["model", "error over no change", "from", "to"], rows)
    page.points([_marked(remark) for remark in remarks_on_comparison(document)])
    detail: list[list[Any]] = []
    for pair in document["comparison"]:
        for channel, horizons in pair["by_channel"].items():
            cells: list[Any] = []
            for figures in horizons.values():
                low, high = figures["ci95"]
                mark: Judgement = ""
                if low is not None and abs(figures["ratio"] - 1.0) >= SMALL:
                    mark = "good" if high < 1 else "bad" if low > 1 else ""
                text = "–" if figures["ratio"] is None else f"{figures['ratio']:.3g}"
                if low is not None:
                    text += f" ({low:.3g} … {high:.3g})"
                cells.append(Judged(text, mark))
            detail.append([" / ".join(pair["models"]), word(channel), *cells])
    horizons = list(next(iter(document["comparison"][0]["by_channel"].values()), {}))
    if detail:
        page.table(
            ["models", "channel", *(f"{float(h):g} s" for h in horizons)],
            detail,
            "RMS of the first over RMS of the second, with 95 % intervals; coloured where they "
            f"differ by more than chance and more than {100 * SMALL:g} %.",
            heads=2,
        )


def _errors(
    page: Page,
    document: Mapping[str, Any],
    models: Mapping[str, Mapping[str, Any]],
    validations: Sequence[ModelValidation],
) -> None:
    page.section(
        "Errors",
        "The model runs alone from the start of each window. RMS over all samples of the windows "
        "of a horizon, with the 95 % interval; **at its end** that much time after the last "
        "measurement. Fit is 1 − ‖e‖/‖y − ȳ‖, VAF 1 − var e/var y.",
    )
    for name, of in models.items():
        rows: list[list[Any]] = []
        for channel, horizons in of["by_horizon"].items():
            unit = of["units"][channel]
            step = of["one_step"][channel]
            rows.append(
                [f"{word(channel)} [{unit}]", "one step", step["rms"], None, step["rms"],
                 step["max"], step["unchanged_rms"], step["fit_percent"], step["vaf_percent"]]
            )  # fmt: skip
            for horizon, figures in horizons.items():
                better = figures["rms"] is not None and (
                    figures["rms"] < (figures["unchanged_rms"] or 0)
                )
                rows.append(
                    ["", f"{float(horizon):g} s", Judged(figures["rms"], "" if better else "bad"),
                     _between(figures["ci95"]), figures["at_end"], figures["max"],
                     figures["unchanged_rms"], figures["fit_percent"], figures["vaf_percent"]]
                )  # fmt: skip
            whole = of["free_run"][channel]
            rows.append(
                ["", "to the end", whole["rms"], None, None, whole["max"], None,
                 whole["fit_percent"], whole["vaf_percent"]]
            )  # fmt: skip
        page.table(
            ["channel", "free for", "RMS", "95 % interval", "at its end", "largest", "no change",
             "fit [%]", "VAF [%]"],
            rows,
            f"{name}. Red: no better than predicting no change.",
            heads=2,
        )  # fmt: skip
    growths = error_growths(validations)
    page.figure(
        validation_figures.growth_figure(growths),
        "How the error grows with the time since the last measurement. Lines: at exactly that "
        "time; points: over whole windows, with 95 % intervals.",
    )
    horizon, traces = free_run_traces(validations)
    page.figure(
        validation_figures.free_run_figure(traces),
        f"Free runs of {horizon:g} s one after another through {document['recordings'][0]['name']}"
        "; each vertical line begins one.",
    )


def _regions(page: Page, validations: Sequence[ModelValidation]) -> None:
    tables = {v.name: v.regions for v in validations}
    if not any(tables.values()):
        return
    first = validations[0]
    horizon = first.region_horizon
    page.section(
        "Where the error lies",
        "The error over the operating range: a row a channel, a column a signal that tells where "
        "the rig was. The bins of a column hold equally many samples.",
    )
    units = {s.name: s.unit for v in validations for s in (*v.model.inputs, *v.model.outputs)}
    page.figure(
        validation_figures.region_figure(tables, units, horizon),
        f"RMS over windows of {horizon:g} s. A flat row is an error that is everywhere alike.",
    )


def _tests(
    page: Page,
    models: Mapping[str, Mapping[str, Any]],
    validations: Sequence[ModelValidation],
) -> None:
    first = next(iter(models.values()))
    tests = first["residual_tests"]
    source = (
        "from simulations of the model with the sensors' noise and quanta"
        if tests["calibration"] == "simulated"
        else "from the limit of long recordings, valid for any input and in closed loop"
    )
    page.section(
        "Residual tests",
        "What the past foretells of the one-step error, a right model has foretold. The p-values "
        f"are {source}, and hold for all tests together (Holm): "
        f"a right model fails any of them with a probability of {100 * tests['level']:g} %.",
    )
    for name, of in models.items():
        channels = list(of["by_horizon"])
        rows: list[list[Any]] = []
        found = {(t["channel"], t["name"]): t for t in of["residual_tests"]["tests"]}
        for test in dict.fromkeys(key[1] for key in found):
            cells: list[Any] = []
            meaning = ""
            formula = ""
            for channel in channels:
                one = found.get((channel, test))
                if one is None or one["p_holm"] is None:
                    cells.append("–")
                    continue
                meaning, formula = one["meaning"], one["formula"]
                text = p_words(one["p_holm"]).removeprefix("p ").removeprefix("= ")
                cells.append(Judged(("✗ " if one["failed"] else "") + text,
                                    "bad" if one["failed"] else "good"))  # fmt: skip
            rows.append([formula, *cells, meaning])
        page.table(
            ["test", *(word(channel) for channel in channels), "if it fails"],
            rows,
            f"{name}: p over all {of['residual_tests']['count']} tests. {_predictor(of)}",
        )
    for validation in validations:
        correlations = correlation_rows(validation)
        if not correlations:
            page.text(f"{validation.name}: the recording is too short for tests of correlation.")
            continue
        page.figure(
            validation_spectra.correlation_figure(correlations),
            f"{validation.name}: correlations, and the band in which all lags of a right model lie "
            "together with probability 0.95. Red: fails over all tests.",
        )


def _predictor(of: Mapping[str, Any]) -> str:
    orders = of["residual_tests"]["whitening_order"]
    taken = ", ".join(f"{word(c)} {order}" for c, order in orders.items() if order)
    text = f"Predictor: {of['predictor']}."
    if taken:
        text += (
            f" An autoregression (order: {taken}) was taken out before all tests but the first "
            "two of correlation in time."
        )
    return text


def _spectra(page: Page, validations: Sequence[ModelValidation]) -> None:
    spectra = spectra_of(validations)
    if not spectra:
        return
    page.section(
        "Spectra",
        "Power spectral densities of the measured channel, of the free run to the end of the "
        "recording and of its error; the coherence tells how much of the error follows an input "
        "linearly.",
    )
    page.figure(
        validation_spectra.spectra_figure(spectra),
        f"Grey band: 95 % interval of the measured density. Coherence: error of "
        f"{validations[0].name}; dashed: reached by chance at one frequency in twenty. "
        "In closed loop a command follows the sensor's noise, and so coherence where the error is "
        "noise is the controller's doing.",
    )


def _signals(page: Page, validations: Sequence[ModelValidation]) -> None:
    page.section(
        "Signals",
        "What the recording excites. A small p of drift means that mean or power changed over the "
        "recording: averages over it then hide something.",
    )
    shown = None
    for dataset in validations[0].datasets:
        found = characteristics_of(dataset)
        shown = shown or found
        rows: list[list[Any]] = [
            [f"{c.name} [{c.unit}]", c.mean, c.sd, c.least, c.largest, c.skewness, c.kurtosis,
             c.correlation_time, c.peak_frequency, c.band_edge, c.trend_of_mean, c.trend_of_power,
             c.missing]
            for c in found
        ]  # fmt: skip
        page.table(
            ["signal", "mean", "sd", "least", "largest", "skewness", "kurtosis",
             "correlation time [s]", "peak [Hz]", "95 % of power below [Hz]", "p: mean drifts",
             "p: power drifts", "missing"],
            rows,
            f"{dataset.name}. Kurtosis is 3 for a normal distribution.",
        )  # fmt: skip
    if shown:
        page.figure(
            validation_spectra.signal_figure(shown, validations[0].sample_time),
            "Amplitude distribution (dashed: a normal one of the same mean and deviation) and "
            "autocorrelation.",
        )


def _method(
    page: Page, document: Mapping[str, Any], models: Mapping[str, Mapping[str, Any]]
) -> None:
    one = next(iter(models.values()))
    left = document["left_out_horizons_s"]
    page.section("How it was made")
    page.points(
        [
            f"Start of a window: {_START_WORDS[document['window_start']]}. Predicting no change "
            "starts from the last sample before the window.",
            f"One-step errors: {one['predictor']}.",
            "Where a test or an interval does not exist, there is a dash. All figures are in "
            "validation.json beside this page.",
            *(
                [f"Horizons that do not fit the recording: {', '.join(f'{h:g} s' for h in left)}."]
                if left
                else []
            ),
        ]
    )


def _between(ends: Sequence[float | None]) -> str | None:
    low, high = ends
    return None if low is None or high is None else f"{wording.cell(low)} … {wording.cell(high)}"


def _marked(remark: Remark) -> Judged:
    return Judged(remark.text, remark.judgement)


def _listed(items: Sequence[str]) -> str:
    return items[0] if len(items) == 1 else f"{', '.join(items[:-1])} and {items[-1]}"
