"""The figures of a validation as plain data: what ``validation.json`` and the tables hold."""

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any

import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.core.findings import json_data
from trms_cli.identification.validation import metrics
from trms_cli.identification.validation.residual_tests import MEANING
from trms_cli.identification.validation.validate import ModelValidation
from trms_cli.models.model import names

SCHEMA = "trms.validation/1"
#: Of a signal's figures: its name, and what only a chart shows.
_DRAWN = ("name", "counts", "edges", "autocorrelation")


def document_of(validations: Sequence[ModelValidation]) -> dict[str, Any]:
    """The whole document; figures that do not exist are None, horizons are keys in s.

    One model's figures stand at the top (``error``, ``fit_percent``, …). Of several models each
    has its own under ``models``, with ``ranking`` and ``comparison`` beside.
    """
    first = validations[0]
    document: dict[str, Any] = {
        "schema": SCHEMA,
        "recordings": [
            {
                "name": d.name,
                "file": d.source,
                "sha256": d.sha256,
                "duration_s": d.duration,
                "sample_time_s": d.sample_time,
                "channels": list(names(d.outputs)),
                "inputs": list(names(d.inputs)),
                "missing": {
                    s.name: int(np.count_nonzero(np.isnan(d.measurements[:, i])))
                    for i, s in enumerate(d.outputs)
                },
                "remarks": list(d.remarks),
                "signals": {
                    c.name: {key: value for key, value in vars(c).items() if key not in _DRAWN}
                    for c in metrics.characteristics_of(d)
                },
            }
            for d in first.datasets
        ],
        "window_start": first.options.windows.start,
        "windows": {_key(h): sum(len(w.first) for w in first.windows(h)) for h in first.horizons},
        "left_out_horizons_s": [h for h in first.options.horizons if h not in first.horizons],
        "seed": first.options.seed,
    }
    if len(validations) == 1:
        document |= model_document(first)
    else:
        document["models"] = {v.name: model_document(v) for v in validations}
        document |= comparison_document(validations)
    return json_data(document)


def model_document(validation: ModelValidation) -> dict[str, Any]:
    """The figures of one model."""
    channels = {signal.name: signal for signal in validation.channels}
    table = {name: _horizons(validation, name) for name in channels}
    longest = _key(validation.horizons[-1])
    document = {
        "model": validation.name,
        "units": {name: signal.unit for name, signal in channels.items()},
        "error": {
            name: {h: figures["rms"] for h, figures in rows.items()} for name, rows in table.items()
        },
        "fit_percent": {name: rows[longest]["fit_percent"] for name, rows in table.items()},
        "vaf_percent": {name: rows[longest]["vaf_percent"] for name, rows in table.items()},
        "by_horizon": table,
        "one_step": {name: _one_step(validation, name) for name in channels},
        "free_run": {n: _figures(*validation.free_run_errors(n)) for n in channels},
        "noise_sd": {name: validation.noise_sd(name) for name in channels},
        "predictor": validation.one_steps[0].predictor,
        "process_noise_factors": dict(validation.one_steps[0].noise_factors),
        "residual_tests": _tests(validation),
        "regions": {"horizon_s": validation.region_horizon, "tables": validation.regions},
    }
    if len(validation.datasets) > 1:
        document["error_by_recording"] = {
            dataset.name: {
                channel: {
                    _key(h): metrics.rms(
                        run.windows[h].errors[:, :, run.windows[h].channels.index(channel)]
                    )
                    for h in run.windows
                }
                for channel in names(dataset.outputs)
            }
            for dataset, run in zip(validation.datasets, validation.runs, strict=True)
        }
    return document


def _horizons(validation: ModelValidation, channel: str) -> dict[str, dict[str, Any]]:
    rows = {}
    for horizon in validation.horizons:
        errors = validation.pooled(channel, horizon)
        measured = validation.pooled(channel, horizon, "measured")
        interval = metrics.rms_interval(validation.sums(channel, horizon), validation.options.seed)
        rows[_key(horizon)] = {
            "rms": metrics.rms(errors),
            "ci95": interval.ends,
            "at_end": metrics.rms(errors[:, -1]),
            "max": metrics.largest(errors),
            "fit_percent": metrics.fit_percent(errors, measured),
            "vaf_percent": metrics.vaf_percent(errors, measured),
            "unchanged_rms": metrics.rms(validation.pooled(channel, horizon, "unchanged")),
        }
    return rows


def _one_step(validation: ModelValidation, channel: str) -> dict[str, Any]:
    errors, shares, unchanged, measured = [], [], [], []
    for dataset, step in zip(validation.datasets, validation.one_steps, strict=True):
        if channel not in step.channels:
            continue
        column = step.channels.index(channel)
        error, y = step.errors[:, column], dataset.measurements[:, column]
        errors.append(error)
        measured.append(y)
        shares.append(error / step.expected_sd[:, column])
        change = np.concatenate([[np.nan], np.diff(y)])
        unchanged.append(np.where(np.isnan(error), np.nan, change))
    error, y = np.concatenate(errors), np.concatenate(measured)
    return {
        **_figures(error, y),
        "unchanged_rms": metrics.rms(np.concatenate(unchanged)),
        # 1 for a predictor that believes the right amount
        "normalised_square": metrics.rms(np.concatenate(shares)) ** 2,
        "samples": int(np.count_nonzero(~np.isnan(error))),
    }


def _figures(errors: FloatArray, measured: FloatArray) -> dict[str, float]:
    return {
        "rms": metrics.rms(errors),
        "max": metrics.largest(errors),
        "fit_percent": metrics.fit_percent(errors, measured),
        "vaf_percent": metrics.vaf_percent(errors, measured),
    }


def _tests(validation: ModelValidation) -> dict[str, Any]:
    tests = validation.tests
    return {
        "level": tests.level,
        "calibration": validation.options.tests.calibration,
        "whitening_order": dict(tests.whitening_order),
        "count": len(tests.tests),
        "failed": len(tests.failures()),
        "tests": [
            {
                "channel": test.channel,
                "name": test.name,
                "formula": test.formula,
                "inputs": list(test.inputs),
                "statistic": test.result.statistic,
                "degrees": test.result.degrees,
                "p": test.result.p_value,
                "p_holm": test.p_holm,
                "p_benjamini_hochberg": test.p_bh,
                "largest_correlation": _largest(test.result.correlations),
                "failed": test.failed(tests.level),
                "meaning": MEANING[test.kind],
            }
            for test in tests.tests
        ],
    }


def _largest(correlations: Any) -> float:
    present = correlations[~np.isnan(correlations)]
    return float(present[np.argmax(np.abs(present))]) if present.size else np.nan


def comparison_document(validations: Sequence[ModelValidation]) -> dict[str, Any]:
    """Ranking of models and their paired differences.

    Models are ranked by the geometric mean, over channels and horizons, of their RMS relative to
    that of predicting no change; over the channels that all of them have.
    """
    sums = {v.name: _all_sums(v, validations) for v in validations}
    naive = {v.name: _all_sums(v, validations, "unchanged") for v in validations}
    seed = validations[0].options.seed
    scores = {name: metrics.mean_log_ratio(sums[name], naive[name], seed) for name in sums}
    order = sorted(scores, key=lambda n: scores[n].value if np.isfinite(scores[n].value) else 1e300)
    pairs = []
    for one, other in combinations(order, 2):
        overall = metrics.mean_log_ratio(sums[one], sums[other], seed)
        pairs.append(
            {
                "models": [one, other],
                "ratio": overall.value,
                "ci95": overall.ends,
                "differ": bool(overall.upper < 1.0 or overall.lower > 1.0),
                "by_channel": _ratios(sums[one], sums[other], seed),
            }
        )
    return {
        "ranking": [
            {"model": name, "relative_error": scores[name].value, "ci95": scores[name].ends}
            for name in order
        ],
        "comparison": pairs,
        "compared_channels": sorted({channel for channel, _ in sums[order[0]]}),
    }


def _all_sums(
    validation: ModelValidation, all_of: Sequence[ModelValidation], what: str = "errors"
) -> dict[tuple[str, float], metrics.BlockSums]:
    common = [
        s.name
        for s in validation.channels
        if all(s.name in names(other.channels) for other in all_of)
    ]
    return {
        (name, horizon): validation.sums(name, horizon, what)
        for name in common
        for horizon in validation.horizons
    }


def _ratios(
    one: Mapping[tuple[str, float], metrics.BlockSums],
    other: Mapping[tuple[str, float], metrics.BlockSums],
    seed: int,
) -> dict[str, dict[str, Any]]:
    ratios: dict[str, dict[str, Any]] = {}
    for channel, horizon in one:
        interval = metrics.ratio_interval(one[channel, horizon], other[channel, horizon], seed)
        ratios.setdefault(channel, {})[_key(horizon)] = {
            "ratio": interval.value,
            "ci95": interval.ends,
        }
    return ratios


def _key(horizon: float) -> str:
    return repr(float(horizon))
