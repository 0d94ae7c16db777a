"""Metrics of sampled signals, each a pure function of arrays.

Conventions of every function here: ``time: (n,) s`` strictly rising, signals ``(n,)`` in their
own unit, NaN where a sample is missing. Missing samples are left out: an integral goes from one
sample that there is to the next, as a sensor slower than the loop wants it. What cannot be
computed is NaN; :mod:`trms_cli.scoring.score` turns it into null.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def rmse(error: Array) -> float:
    """``sqrt(mean(e²))`` over the samples that there are."""
    present = error[~np.isnan(error)]
    return math.sqrt(float(np.mean(present**2))) if present.size else math.nan


def max_abs_error(error: Array) -> float:
    """``max |e|``."""
    present = error[~np.isnan(error)]
    return float(np.max(np.abs(present))) if present.size else math.nan


def integral(time: Array, values: Array) -> float:
    """``∫ values dt`` by the trapezoidal rule."""
    present = ~np.isnan(values)
    if np.count_nonzero(present) < 2:
        return math.nan
    known, times = values[present], time[present]
    return float(np.sum((known[1:] + known[:-1]) / 2 * np.diff(times)))


def iae(time: Array, error: Array) -> float:
    """Integral of the absolute error, ``∫ |e| dt``."""
    return integral(time, np.abs(error))


def ise(time: Array, error: Array) -> float:
    """Integral of the squared error, ``∫ e² dt``."""
    return integral(time, error**2)


def itae(time: Array, error: Array) -> float:
    """Time-weighted integral of the absolute error, ``∫ (t − t_0) |e| dt``.

    ``t_0`` is the first sample of the run, also when the reference steps later: the measure
    stays one number per run, and compares runs of the same reference only.
    """
    if time.size == 0:
        return math.nan
    return integral(time, (time - time[0]) * np.abs(error))


def input_effort(time: Array, command: Array) -> float:
    """``∫ u² dt`` of a command that is held between samples."""
    present = ~np.isnan(command)
    if np.count_nonzero(present) < 2:
        return math.nan
    return float(np.sum(command[present][:-1] ** 2 * np.diff(time[present])))


def total_variation(command: Array) -> float:
    """``Σ |u_k − u_{k−1}|``."""
    present = command[~np.isnan(command)]
    return float(np.sum(np.abs(np.diff(present)))) if present.size else math.nan


def saturation_share(command: Array, lower: float, upper: float) -> float:
    """Share of the samples at a limit, 0 to 1: within 1e-6 of the range of it, or beyond."""
    present = command[~np.isnan(command)]
    if not present.size:
        return math.nan
    close = 1e-6 * (upper - lower) if math.isfinite(upper - lower) else 0.0
    return float(np.mean((present <= lower + close) | (present >= upper - close)))


def excess(values: Array, lower: float, upper: float) -> Array:
    """How far each present value is outside its limits, 0 inside; shorter if some are NaN."""
    present = values[~np.isnan(values)]
    return np.maximum(np.maximum(lower - present, present - upper), 0.0)


def worst(values: Iterable[float]) -> float:
    """The largest; NaN without any."""
    return max(values, default=math.nan)


def median(values: Iterable[float]) -> float:
    """The median; NaN without any."""
    present = list(values)
    return float(np.median(present)) if present else math.nan


def quantile(values: Array, share: float) -> float:
    """A quantile of the samples that there are."""
    present = values[~np.isnan(values)]
    return float(np.quantile(present, share)) if present.size else math.nan
