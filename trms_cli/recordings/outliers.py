"""Outliers of a measured channel: samples that neither neighbour leads to.

A Hampel filter (running median, and a robust measure of what is usual around; Pearson 2002) finds
candidates. A rotor that turns round within one sample has such a peak too, but both slopes lead
up to it, so a candidate counts only if it lies off the straight lines of both sides.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from trms_cli.recordings.recording import Recording, quantum

#: Half width of the running median, samples; more than half of it wrong is no outlier.
_HALF_WIDTH = 3
#: Samples over which the usual deviation from the median is taken.
_SCALE_WIDTH = 61
#: Deviations of usual size that make an outlier: 6 keep white noise of hours below one.
THRESHOLD = 6.0
#: The share of samples that is usual, and the quantile of it over a normal's deviation. Higher
#: than a median, so that a rotor that turns round at every tenth sample sets the scale.
_USUAL_PERCENT, _QUANTILE_TO_SD = 90, 1 / 1.645


def outliers(values: np.ndarray, threshold: float = THRESHOLD) -> np.ndarray:
    """Which samples are outliers.

    Parameters
    ----------
    values : (n,) float array
        Evenly spaced but for what is missing (NaN).
    threshold : float
        In standard deviations of what is usual around the sample.

    Returns
    -------
    (n,) bool array
        Runs of up to three samples. Channels of fewer than 15 samples have none.
    """
    from scipy.ndimage import median_filter, percentile_filter

    found = np.zeros(len(values), dtype=bool)
    there = np.flatnonzero(np.isfinite(values))
    y = values[there]
    if len(y) < 2 * (2 * _HALF_WIDTH + 1) + 1:
        return found
    off = np.abs(y - median_filter(y, 2 * _HALF_WIDTH + 1, mode="reflect"))
    width = min(_SCALE_WIDTH, len(y))
    usual = percentile_filter(off, _USUAL_PERCENT, width, mode="reflect")
    floor = max(
        # Of the samples that are surely none: an outlier need not lie on the sensor's grid.
        (quantum(y[off <= np.percentile(off, 95)]) or 0.0) / _QUANTILE_TO_SD,
        float(np.percentile(off, _USUAL_PERCENT)),
        1e-9 * float(np.ptp(y)),
    )
    limit = threshold * _QUANTILE_TO_SD * np.maximum(usual, floor)
    work = y.copy()
    candidates = set(np.flatnonzero(off > limit).tolist())
    # The farthest first: the median beside a spike is off as well, until the spike is mended.
    for k in sorted(candidates, key=lambda k: -off[k]):
        around = work[max(k - _HALF_WIDTH, 0) : k + _HALF_WIDTH + 1]
        if abs(work[k] - float(np.median(around))) <= limit[k]:
            continue
        run = _run_around(work, k, candidates, limit[k])
        if run is not None:
            found[there[run.start : run.stop]] = True
            sides = [i for i in (run.start - 1, run.stop) if 0 <= i < len(y)]
            work[run.start : run.stop] = np.interp(run, sides, work[sides])
    return found


def _run_around(y: np.ndarray, k: int, candidates: set[int], limit: float) -> range | None:
    """The shortest run of candidates around one that stands apart from both sides."""
    for count in range(1, _HALF_WIDTH + 1):
        for first in range(k - count + 1, k + 1):
            run = range(first, first + count)
            if candidates.issuperset(run) and _stands_apart(y, run, limit):
                return run
    return None


def _stands_apart(y: np.ndarray, run: range, limit: float) -> bool:
    """Whether every sample of a run is off the straight lines of both sides."""
    lines = [_beyond(y, run.start, len(run), side) for side in (-1, 1)]
    known = [line for line in lines if line is not None]
    return bool(known) and all(abs(y[k] - line(k)) > limit for k in run for line in known)


def _beyond(y: np.ndarray, first: int, count: int, direction: int) -> Callable[[int], float] | None:
    """The straight line through the two samples before or after a run; None beyond an end."""
    near, far = (first - 1, first - 2) if direction < 0 else (first + count, first + count + 1)
    if min(near, far) < 0 or max(near, far) >= len(y):
        return None
    slope = (y[far] - y[near]) / (far - near)
    return lambda k: float(y[near] + slope * (k - near))


def find_outliers(recording: Recording) -> dict[str, np.ndarray]:
    """Outliers of every measured channel that has any: masks of shape (n,)."""
    measured = (*recording.names("output"), *recording.names("current"))
    masks = {name: outliers(recording.channels[name]) for name in measured}
    return {name: mask for name, mask in masks.items() if mask.any()}


def describe_outliers(recording: Recording, masks: dict[str, np.ndarray]) -> list[str]:
    """A sentence a channel."""
    sentences = []
    for name, mask in masks.items():
        times = ", ".join(f"{t:.6g}" for t in recording.time[mask][:3])
        count = int(mask.sum())
        more = ", …" if count > 3 else ""
        sentences.append(
            f"{name}: {count} outlier{'' if count == 1 else 's'} of {len(mask)} samples "
            f"(at {times}{more} s)"
        )
    return sentences
