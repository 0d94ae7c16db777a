"""How good an observer was, and whether it believed the right amount of itself."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from trms_cli.scoring import consistency, metrics
from trms_cli.scoring.metrics import Array
from trms_cli.scoring.tables import Columns, Series, floats, held, unit

#: Share of a run in which an observer may find its feet before its innovations are judged.
_TRANSIENT = 0.1
#: Kind of the events that tell of a sample that was not believed.
_OUTLIER = "outlier"


def estimate_figures(tables: Mapping[str, Columns]) -> dict[str, Any]:
    """The ``estimate`` of a score; see :mod:`trms_cli.scoring.score`.

    Samples that the observer rejected as outliers are counted, and left out of all that is said
    of innovations.
    """
    estimate = tables.get("/estimate")
    if estimate is None or len(estimate.time) == 0:
        estimate = Series(np.zeros(0), {})
    errors = _errors(estimate, tables.get("/plant/state"))
    nees, states = _nees(estimate, errors)
    rejected = _rejected(estimate, tables.get("/event"))
    innovations, spreads, missing = _innovations(estimate, rejected)
    settled = estimate.time >= _end_of_transient(estimate.time)
    late = {name: values[settled] for name, values in innovations.items()}
    p_values = {name: consistency.whiteness_p(values) for name, values in late.items()}
    return {
        "rmse": {name: metrics.rmse(error) for name, error in errors.items()},
        "nees_mean": nees,
        "nees_expected": states or math.nan,
        **_nis(late, {name: values[settled] for name, values in spreads.items()}),
        "innovation_whiteness_p": consistency.joint_p(list(p_values.values())),
        "innovations": {
            name: {
                "normalised_square": consistency.normalised_square(values, spreads[name][settled]),
                "correlation": consistency.neighbour_correlation(values),
                "whiteness_p": p_values[name],
                "missing": missing[name],
                "rejected": int(np.count_nonzero(rejected[name])),
            }
            for name, values in late.items()
        },
        "missing_samples": sum(missing.values()),
        "rejected_samples": sum(int(np.count_nonzero(which)) for which in rejected.values()),
        "prediction_rmse": {name: metrics.rmse(values) for name, values in innovations.items()},
        "units": {name: unit(estimate, name) for name in errors}
        | {name: unit(estimate, f"innovation_{name}") for name in innovations},
    }


def _errors(estimate: Columns, truth: Columns | None) -> dict[str, Array]:
    """Estimate less truth of each state that both have."""
    if truth is None or len(truth.time) == 0:
        return {}
    return {
        name: floats(estimate, name) - held(truth, name, estimate.time)
        for name in truth.columns
        if name in estimate.columns
    }


def _innovations(
    estimate: Columns, rejected: Mapping[str, Array]
) -> tuple[dict[str, Array], dict[str, Array], dict[str, int]]:
    """Innovations that were believed, their expected deviations, and how many were missing."""
    innovations, spreads, missing = {}, {}, {}
    for name in rejected:
        values = floats(estimate, f"innovation_{name}")
        missing[name] = int(np.count_nonzero(np.isnan(values)))
        innovations[name] = np.where(rejected[name], np.nan, values)
        spread = f"innovation_sd_{name}"
        known = spread in estimate.columns
        spreads[name] = floats(estimate, spread) if known else np.full(values.shape, np.nan)
    return innovations, spreads, missing


def _rejected(estimate: Columns, events: Columns | None) -> dict[str, Array]:
    """By measured channel: at which samples of the estimate it was taken for an outlier."""
    channels = [
        name.removeprefix("innovation_")
        for name in estimate.columns
        if name.startswith("innovation_") and not name.startswith("innovation_sd_")
    ]
    rejected = {name: np.zeros(len(estimate.time), dtype=bool) for name in channels}
    if events is None or len(events.time) == 0:
        return rejected
    outlier = np.asarray(events.columns["kind"], dtype=object) == _OUTLIER
    sources = np.asarray(events.columns["source"], dtype=object)
    for name, which in rejected.items():
        times = events.time[outlier & (sources == name)]
        # An event has the time of its sample, to the nanosecond.
        at = np.searchsorted(estimate.time, times - 1e-9)
        which[at[at < which.size]] = True
    return rejected


def _nis(innovations: Mapping[str, Array], spreads: Mapping[str, Array]) -> dict[str, Any]:
    """Normalised innovation squared, summed over the channels, of the samples that have all."""
    figures: dict[str, Any] = {
        "nis_mean": math.nan,
        "nis_expected": math.nan,
        "nis_interval": None,
        "nis_share_inside": math.nan,
    }
    if not innovations:
        return figures
    normalised = [
        values / np.where(spreads[name] > 0, spreads[name], np.nan)
        for name, values in innovations.items()
    ]
    squares = np.sum(np.stack(normalised, axis=1) ** 2, axis=1)
    squares = squares[~np.isnan(squares)]
    if not squares.size:
        return figures
    low, high = consistency.chi_square_interval(len(normalised))
    return {
        "nis_mean": float(np.mean(squares)),
        "nis_expected": len(normalised),
        "nis_interval": [low, high],
        "nis_share_inside": float(np.mean((low <= squares) & (squares <= high))),
    }


def _nees(estimate: Columns, errors: Mapping[str, Array]) -> tuple[float, int]:
    """Mean NEES, and of how many states; only of those with a deviation above zero."""
    columns = []
    for name, error in errors.items():
        if f"sd_{name}" in estimate.columns:
            deviation = floats(estimate, f"sd_{name}")
            if np.all(deviation[~np.isnan(deviation)] > 0) and not np.all(np.isnan(deviation)):
                columns.append((error, deviation))
    if not columns:
        return math.nan, 0
    error, deviation = (np.stack(part, axis=1) for part in zip(*columns, strict=True))
    values = consistency.nees(error, deviation)
    present = values[~np.isnan(values)]
    return (float(np.mean(present)) if present.size else math.nan), len(columns)


def _end_of_transient(time: Array) -> float:
    return float(time[0] + _TRANSIENT * (time[-1] - time[0])) if time.size else 0.0
