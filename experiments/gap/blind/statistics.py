"""Intervals of shares, medians and percentiles, and how far probabilities can be believed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

_Z95 = 1.959963984540054


@dataclass(frozen=True)
class Estimate:
    """A figure with its 95 % interval."""

    value: float | None  #: None where there is no case to take it from
    low: float | None  #: None where there are too few for an interval
    high: float | None  #: None where there are too few for an interval
    count: int  #: Cases that it is taken from


def share(hits: Sequence[bool]) -> Estimate:
    """Share of hits, with Wilson's interval (J. Am. Stat. Assoc. 22, 1927)."""
    n = len(hits)
    if not n:
        return Estimate(None, None, None, 0)
    p, z2 = sum(hits) / n, _Z95**2
    middle = (p + z2 / (2 * n)) / (1 + z2 / n)
    half = _Z95 * np.sqrt(p * (1 - p) / n + z2 / (4 * n**2)) / (1 + z2 / n)
    return Estimate(p, max(0.0, float(middle - half)), min(1.0, float(middle + half)), n)


def quantile(values: Sequence[float], q: float, draws: int, seed: int) -> Estimate:
    """A quantile, with the interval of the bootstrap's percentiles."""
    n = len(values)
    if not n:
        return Estimate(None, None, None, 0)
    data = np.asarray(values, dtype=float)
    estimate = float(np.quantile(data, q))
    if n < 3:
        return Estimate(estimate, None, None, n)
    picked = np.random.default_rng(seed).integers(n, size=(draws, n))
    replicates = np.quantile(data[picked], q, axis=1)
    low, high = np.quantile(replicates, [0.025, 0.975])
    return Estimate(estimate, float(low), float(high), n)


def bootstrapped(
    statistic: Callable[[IntArray], float], count: int, draws: int, seed: int
) -> Estimate:
    """A statistic of all cases, with the interval of the bootstrap's percentiles over cases.

    ``statistic``: of the indices of some cases, which may come more than once.
    """
    if not count:
        return Estimate(None, None, None, 0)
    estimate = float(statistic(np.arange(count)))
    if count < 3:
        return Estimate(estimate, None, None, count)
    random = np.random.default_rng(seed)
    replicates = [statistic(random.integers(count, size=count)) for _ in range(draws)]
    low, high = np.quantile(replicates, [0.025, 0.975])
    return Estimate(estimate, float(low), float(high), count)


@dataclass(frozen=True)
class Reliability:
    """Predicted probabilities against what came true."""

    #: ``low, high, count, predicted`` (mean), ``right`` (share), ``right_ci95``; empty bins are
    #: left out
    bins: list[dict[str, object]]
    #: Expected calibration error: mean distance between the two over the bins, by count
    calibration_error: float | None
    brier: float | None  #: Mean squared distance between a probability and what came true


def reliability(predicted: Sequence[float], right: Sequence[bool], bins: int = 10) -> Reliability:
    """How often what was said with a probability was right; bins of equal width."""
    if not len(predicted):
        return Reliability([], None, None)
    p, hit = np.asarray(predicted, dtype=float), np.asarray(right, dtype=bool)
    of_bin = np.minimum((p * bins).astype(int), bins - 1)
    bin_rows: list[dict[str, object]] = []
    error = 0.0
    for i in range(bins):
        inside = of_bin == i
        if not inside.any():
            continue
        estimate = share(hit[inside].tolist())
        assert estimate.value is not None
        mean = float(p[inside].mean())
        error += inside.mean() * abs(mean - estimate.value)
        bin_rows.append(
            {
                "low": i / bins,
                "high": (i + 1) / bins,
                "count": int(inside.sum()),
                "predicted": mean,
                "right": estimate.value,
                "right_ci95": [estimate.low, estimate.high],
            }
        )
    return Reliability(bin_rows, float(error), float(np.mean((p - hit) ** 2)))


def calibration_error(predicted: FloatArray, right: npt.NDArray[np.bool_], bins: int = 10) -> float:
    """Expected calibration error: of :func:`reliability`, quickly.

    ``predicted``, ``right``: (n,) arrays of probabilities and of what came true.
    """
    of_bin = np.minimum((predicted * bins).astype(int), bins - 1)
    apart = np.bincount(of_bin, weights=predicted - right, minlength=bins)
    return float(np.abs(apart).sum() / len(predicted))
