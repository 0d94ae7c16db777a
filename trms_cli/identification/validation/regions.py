"""Where in the operating range the error lies.

Each sample of the free-run windows belongs to a bin of every operating variable (the measured
outputs and the commands). Bins hold equally many samples, so that a share of the squared error is
to be compared with one over the number of bins.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from trms_cli.identification.dataset import FloatArray

#: Bins of an operating variable.
BINS = 8


@dataclass(frozen=True)
class RegionTable:
    """The error of one channel over one operating variable."""

    channel: str
    variable: str
    edges: FloatArray  #: (b + 1,) array; of the bins, in the variable's unit
    rms: FloatArray  #: (b,) array; of the error in each bin, in the channel's unit
    #: ``time_share``, ``error_share``: (b,) arrays; of the samples, and of the squared error
    time_share: FloatArray
    error_share: FloatArray


def region_tables(
    errors: Mapping[str, FloatArray], variables: Mapping[str, FloatArray], bins: int = BINS
) -> list[RegionTable]:
    """Tables of all channels over all variables.

    Parameters
    ----------
    errors : dict of str to (N,) arrays
        By channel; NaN where there is none.
    variables : dict of str to (N,) arrays
        Operating variables at the same samples; NaN where missing.
    """
    tables = []
    for variable, values in variables.items():
        present = values[~np.isnan(values)]
        if present.size < 10 * bins:
            continue
        edges = np.unique(np.quantile(present, np.linspace(0, 1, bins + 1)))
        if len(edges) < 3:
            continue  # it hardly moves
        for channel, error in errors.items():
            table = _table(channel, variable, error, values, edges)
            if table is not None:
                tables.append(table)
    return tables


def _table(
    channel: str, variable: str, error: FloatArray, values: FloatArray, edges: FloatArray
) -> RegionTable | None:
    known = np.isfinite(error) & ~np.isnan(values)
    square = error[known] ** 2
    if not square.size or not np.isfinite(square.sum()) or not square.sum() > 0:
        return None
    n = len(edges) - 1
    bin_of = np.clip(np.searchsorted(edges, values[known], side="right") - 1, 0, n - 1)
    counts = np.bincount(bin_of, minlength=n).astype(float)
    sums = np.bincount(bin_of, square, minlength=n)
    if np.any(counts == 0):
        return None
    return RegionTable(
        channel,
        variable,
        edges,
        np.sqrt(sums / counts),
        counts / counts.sum(),
        sums / sums.sum(),
    )
