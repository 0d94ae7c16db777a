"""Figures of an error: RMS, largest, fit, variance accounted for.

    fit = 100 (1 − ‖e‖/‖y − ȳ‖)        VAF = 100 (1 − var e / var y)

Fit counts a constant error, VAF does not; both are 100 for no error and may be negative.
"""

from __future__ import annotations

import numpy as np

from trms_cli.identification.dataset import FloatArray


def rms(errors: FloatArray) -> float:
    """Root mean square of what is present; NaN if nothing is, infinite if the model overflowed."""
    present = errors[~np.isnan(errors)]
    if not present.size:
        return np.nan
    with np.errstate(over="ignore"):
        return float(np.sqrt(np.mean(present**2)))


def largest(errors: FloatArray) -> float:
    """Largest absolute error."""
    present = np.abs(errors[~np.isnan(errors)])
    return float(present.max()) if present.size else np.nan


def fit_percent(errors: FloatArray, measured: FloatArray) -> float:
    """Fit in %; NaN for a signal that does not move."""
    present = ~np.isnan(errors) & ~np.isnan(measured)
    e, y = errors[present], measured[present]
    if not e.size or not np.ptp(y) > 0:
        return np.nan
    moving = float(np.linalg.norm(y - y.mean()))
    with np.errstate(over="ignore"):
        return 100.0 * (1.0 - float(np.linalg.norm(e)) / moving)


def vaf_percent(errors: FloatArray, measured: FloatArray) -> float:
    """Variance accounted for in %; NaN for a signal that does not move."""
    present = ~np.isnan(errors) & ~np.isnan(measured)
    e, y = errors[present], measured[present]
    if not e.size or not np.ptp(y) > 0:
        return np.nan
    with np.errstate(over="ignore", invalid="ignore"):
        return 100.0 * (1.0 - float(np.var(e)) / float(np.var(y)))
