"""Figures of a model's errors, what chance leaves open between two models, and where errors lie.

    fit = 100 (1 − ‖e‖/‖y − ȳ‖)        VAF = 100 (1 − var e / var y)

Fit counts a constant error, VAF does not; both are 100 for no error and may be negative.

Errors of several models are of the same windows of the same recordings, so they are paired. Windows
overlap and neighbours resemble each other, so whole blocks of time are drawn anew, with all that
lies in them (H. R. Künsch, "The jackknife and the bootstrap for general stationary observations",
Ann. Statist. 17, 1989, without overlap of the blocks).

By region: each sample of the free-run windows belongs to a bin of every operating variable (the
measured outputs and the commands). Bins hold equally many samples, so that a share of the squared
error is to be compared with one over the number of bins.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from trms_cli.core.arrays import FloatArray, IntArray


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
    return _percent(errors, measured, lambda e, y: np.linalg.norm(e) / np.linalg.norm(y - y.mean()))


def vaf_percent(errors: FloatArray, measured: FloatArray) -> float:
    """Variance accounted for in %; NaN for a signal that does not move."""
    return _percent(errors, measured, lambda e, y: np.var(e) / np.var(y))


def _percent(
    errors: FloatArray, measured: FloatArray, share: Callable[[FloatArray, FloatArray], Any]
) -> float:
    """What a share of the measured signal leaves of 100 %, over what is present."""
    present = ~np.isnan(errors) & ~np.isnan(measured)
    e, y = errors[present], measured[present]
    if not e.size or not np.ptp(y) > 0:
        return np.nan
    with np.errstate(over="ignore", invalid="ignore"):
        return 100.0 * (1.0 - float(share(e, y)))


_DRAWS = 2000


@dataclass(frozen=True)
class WindowErrors:
    """Errors of the windows of one horizon in one recording."""

    channels: tuple[str, ...]
    first: IntArray  #: (m,) array of int; first sample of each window
    errors: FloatArray  #: (m, k, n_y) array; measured minus simulated; NaN where not measured
    measured: FloatArray  #: (m, k, n_y) array
    #: (m, k, n_y) array; error of the prediction that nothing changes from the last sample before
    #: the window
    unchanged: FloatArray


@dataclass(frozen=True)
class BlockSums:
    """Squared errors of one model, channel and horizon, summed over blocks of time."""

    #: ``squares``, ``counts``: (b,) arrays; sum of the squared errors in each block, and how many
    #: samples they are
    squares: FloatArray
    counts: FloatArray

    @property
    def rms(self) -> float:
        """Over all blocks."""
        total = self.counts.sum()
        return float(np.sqrt(self.squares.sum() / total)) if total else np.nan


@dataclass(frozen=True)
class BootstrapInterval:
    """An estimate with its 95 % interval."""

    value: float  #: the estimate
    lower: float  #: 2.5 % of the draws lie below
    upper: float  #: 2.5 % of the draws lie above

    @property
    def ends(self) -> list[float]:
        """Of the interval."""
        return [self.lower, self.upper]


def block_sums(
    recordings: Sequence[WindowErrors], channel: str, block: int, errors: str = "errors"
) -> BlockSums:
    """Sum the squared errors of a channel over blocks.

    ``recordings``: of one horizon; a block never reaches over the end of a recording. ``block``:
    samples; windows that begin in it belong to it.
    """
    squares: list[float] = []
    counts: list[float] = []
    for windows in recordings:
        if channel not in windows.channels or not len(windows.first):
            continue
        column = getattr(windows, errors)[:, :, windows.channels.index(channel)]
        with np.errstate(over="ignore"):
            each = np.nansum(column**2, axis=1)
        present = np.count_nonzero(~np.isnan(column), axis=1)
        of = (windows.first - windows.first[0]) // block
        squares += np.bincount(of, each).tolist()
        counts += np.bincount(of, present).tolist()
    return BlockSums(np.array(squares), np.array(counts))


def rms_interval(sums: BlockSums, seed: int) -> BootstrapInterval:
    """The RMS with its interval; without one for fewer than four blocks."""
    return _interval(sums.rms, [sums], lambda rms: rms[0], seed)


def ratio_interval(one: BlockSums, other: BlockSums, seed: int) -> BootstrapInterval:
    """RMS of the one over RMS of the other, paired by blocks."""
    value = one.rms / other.rms if other.rms > 0 else np.nan
    return _interval(value, [one, other], lambda rms: rms[0] / rms[1], seed)


def mean_log_ratio(
    one: Mapping[tuple[str, float], BlockSums],
    other: Mapping[tuple[str, float], BlockSums],
    seed: int,
) -> BootstrapInterval:
    """Geometric mean over channels and horizons of the ratios of RMS, paired by blocks.

    Horizons have different numbers of windows; a draw takes the same share of each.
    """
    keys = [key for key in one if key in other and one[key].rms > 0 and other[key].rms > 0]
    if not keys:
        return BootstrapInterval(np.nan, np.nan, np.nan)
    value = float(np.exp(np.mean([np.log(one[k].rms / other[k].rms) for k in keys])))
    blocks = {key: min(len(one[key].squares), len(other[key].squares)) for key in keys}
    most = max(blocks.values())
    if most < 4:
        return BootstrapInterval(value, np.nan, np.nan)
    draws = _draws(most, seed)
    logs = np.zeros(len(draws))
    for key in keys:
        # blocks that only shorter horizons reach are taken from the same places, wrapped
        chosen = draws % blocks[key]
        a, b = (_rms_of_draws(x[key], chosen) for x in (one, other))
        with np.errstate(divide="ignore", invalid="ignore"):
            logs += np.log(a / b) / len(keys)
    lower, upper = np.exp(np.nanquantile(logs, [0.025, 0.975]))
    return BootstrapInterval(value, float(lower), float(upper))


def _interval(
    value: float,
    sums: Sequence[BlockSums],
    figure: Callable[[list[FloatArray]], FloatArray],
    seed: int,
) -> BootstrapInterval:
    blocks = len(sums[0].squares)
    if blocks < 4 or not np.isfinite(value):
        return BootstrapInterval(value, np.nan, np.nan)
    draws = _draws(blocks, seed)
    with np.errstate(divide="ignore", invalid="ignore"):
        drawn = figure([_rms_of_draws(each, draws) for each in sums])
    drawn = drawn[np.isfinite(drawn)]
    if not drawn.size:
        return BootstrapInterval(value, np.nan, np.nan)
    lower, upper = np.quantile(drawn, [0.025, 0.975])
    return BootstrapInterval(value, float(lower), float(upper))


def _draws(blocks: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, blocks, (_DRAWS, blocks))


def _rms_of_draws(sums: BlockSums, draws: np.ndarray) -> FloatArray:
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        return np.asarray(np.sqrt(sums.squares[draws].sum(axis=1) / sums.counts[draws].sum(axis=1)))


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

    ``errors``: dict of str to (N,) arrays; by channel; NaN where there is none. ``variables``: dict
    of str to (N,) arrays; operating variables at the same samples; NaN where missing.
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
        channel, variable, edges, np.sqrt(sums / counts), counts / counts.sum(), sums / sums.sum()
    )
