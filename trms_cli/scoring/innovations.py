"""How well an observer foresaw a recording, one sample ahead: the only truth that a rig tells.

Per channel, of the innovations ν (measured minus predicted) and the deviations σ expected of
them:

- RMSE of ν, beside the RMSE of predicting that nothing changes (the last measured value stays):
  a model earns its place by the ratio of the two;
- the mean of (ν/σ)², 1 for a filter that believes the right amount, and the share within ±2σ;
- whether ν is white: the correlation of neighbours, and the Ljung–Box test over 20 lags.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from trms_cli.scoring import metrics
from trms_cli.scoring.consistency import (
    neighbour_correlation,
    normalised_square,
    whiteness_p,
)
from trms_cli.scoring.metrics import Array
from trms_cli.scoring.tables import Columns

SCHEMA = "trms.innovations/1"
#: Share of the run in which the observer may find its feet before whiteness and spread are judged.
_TRANSIENT = 0.1


def innovation_table(
    estimate: Columns, measurement: Columns, channels: Sequence[str], units: Sequence[str]
) -> dict[str, Any]:
    """Figures of every channel as a document of :data:`SCHEMA`; null for what does not exist.

    Parameters
    ----------
    estimate, measurement : Columns
        The topics of a log, on the same times.
    channels, units : sequences of str
        Measured channels and their units.
    """
    settled = slice(int(_TRANSIENT * len(estimate.time)), None)
    document: dict[str, Any] = {"schema": SCHEMA, "channels": {}}
    for name, unit in zip(channels, units, strict=True):
        innovation = _floats(estimate, f"innovation_{name}")
        deviation = _floats(estimate, f"innovation_sd_{name}")
        share = (innovation / deviation)[settled]
        share = share[~np.isnan(share)]
        measured = _floats(measurement, name)
        figures = {
            "prediction_rmse": metrics.rmse(innovation),
            "unchanged_rmse": metrics.rmse(np.diff(measured[~np.isnan(measured)])),
            "normalised_square": normalised_square(innovation[settled], deviation[settled]),
            "within_2sd": float(np.mean(np.abs(share) <= 2.0)) if share.size else math.nan,
            "correlation": neighbour_correlation(innovation[settled]),
            "whiteness_p": whiteness_p(innovation[settled]),
        }
        document["channels"][name] = {
            "samples": int(np.count_nonzero(~np.isnan(innovation))),
            **{key: value if math.isfinite(value) else None for key, value in figures.items()},
            "unit": unit,
        }
    return document


def _floats(table: Columns, name: str) -> Array:
    return np.asarray(table.columns[name], dtype=float)
