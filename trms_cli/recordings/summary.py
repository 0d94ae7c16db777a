"""What a recording is like, before anything is done with it: figures, and sentences for people.

Outliers are samples of a measured channel that neither neighbour leads to. A Hampel filter (running
median, and a robust measure of what is usual around; Pearson 2002) finds candidates. A rotor that
turns round within one sample has such a peak too, but both slopes lead up to it, so a candidate
counts only if it lies off the straight lines of both sides. So has a fast motion with hardly any
noise where it turns: a candidate has to be off the cubic through both sides as well, by more than
others are.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from trms_cli.core.arrays import stretches
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
#: A sample less the cubic through two samples on each side of it.
_OFF_CUBIC = np.array([1.0, -4.0, 6.0, -4.0, 1.0]) / 6


def outliers(values: np.ndarray, threshold: float = THRESHOLD) -> np.ndarray:
    """Which samples are outliers, (n,) bool array.

    Runs of up to three samples. Channels of fewer than 15 samples have none.

    ``values``, (n,) array: evenly spaced but for what is missing (NaN). ``threshold``: in standard
    deviations of what is usual around the sample.
    """
    from scipy.ndimage import median_filter, percentile_filter

    is_outlier = np.zeros(len(values), dtype=bool)
    there = np.flatnonzero(np.isfinite(values))
    y = values[there]
    if len(y) < 2 * (2 * _HALF_WIDTH + 1) + 1:
        return is_outlier
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
    smooth = np.abs(np.convolve(y, _OFF_CUBIC, mode="valid"))
    bend = threshold / 2 * _QUANTILE_TO_SD * float(np.percentile(smooth, _USUAL_PERCENT))
    work = y.copy()
    candidates = set(np.flatnonzero(off > limit).tolist())
    # The farthest first: the median beside a spike is off as well, until the spike is mended.
    for k in sorted(candidates, key=lambda k: -off[k]):
        around = work[max(k - _HALF_WIDTH, 0) : k + _HALF_WIDTH + 1]
        if abs(work[k] - float(np.median(around))) <= limit[k]:
            continue
        run = _run_around(work, k, candidates, limit[k])
        if run is not None and _off_cubic(work, run) > bend:
            is_outlier[there[run.start : run.stop]] = True
            sides = [i for i in (run.start - 1, run.stop) if 0 <= i < len(y)]
            work[run.start : run.stop] = np.interp(run, sides, work[sides])
    return is_outlier


def _run_around(y: np.ndarray, k: int, candidates: set[int], limit: float) -> range | None:
    """The shortest run of candidates around one that stands apart from both sides."""
    lengths = range(1, _HALF_WIDTH + 1)
    runs = (range(first, first + n) for n in lengths for first in range(k - n + 1, k + 1))
    apart = (run for run in runs if candidates.issuperset(run) and _stands_apart(y, run, limit))
    return next(apart, None)


def _off_cubic(y: np.ndarray, run: range) -> float:
    """How far a run is off the cubic through two samples on each side.

    At an end it is the parabola through three samples.
    """
    around = [run.start - i for i in (3, 2, 1)], [run.stop + i for i in (0, 1, 2)]
    sides = [*around[0][1:], *around[1][:2]]
    if sides[0] < 0 or sides[-1] >= len(y):
        sides = around[1] if sides[0] < 0 else around[0]
    centre = run.start
    curve = np.polyfit([i - centre for i in sides], y[sides], len(sides) - 1)
    return float(np.max(np.abs(y[run] - np.polyval(curve, [k - centre for k in run]))))


def _stands_apart(y: np.ndarray, run: range, limit: float) -> bool:
    """Whether every sample of a run is off the straight lines of both sides."""
    lines = [_beyond(y, run.start, len(run), side) for side in (-1, 1)]
    side_lines = [line for line in lines if line is not None]
    return bool(side_lines) and all(abs(y[k] - line(k)) > limit for k in run for line in side_lines)


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


#: A channel with fewer levels is a switched signal: being at its largest is no saturation.
_LEAST_LEVELS = 12
#: A signal that stays as it was at more samples than this is held between levels.
_HELD_SHARE = 0.5
#: A command at its extreme value for more of the time than this is worth a sentence.
_SATURATED_SHARE = 0.02
#: s for which an angle must keep still to be at rest.
_REST_TIME = 0.5
#: Share of the largest size beyond which a change of sign counts.
_CROSSING_SHARE = 0.05
_SMOOTHING_TIME = 0.2


@dataclass(frozen=True)
class ChannelSummary:
    """Figures of a channel."""

    minimum: float | None  #: In the channel's unit
    maximum: float | None  #: None for a channel without a value
    quantum: float | None  #: Distance between levels, where they lie on a grid
    missing: int  #: Samples without a value among the rows
    outliers: int  #: Samples that neither neighbour leads to
    constant: bool  #: Whether it never changes
    #: Inputs: share of the time at the largest or smallest value taken, when many are taken
    extreme_share: float | None = None
    #: Angles and positions: share of the time at which it keeps still for half a second around
    rest_share: float | None = None
    #: Likewise: how often the rate changes its sign. Others: how often the sign changes.
    turns: int | None = None


@dataclass(frozen=True)
class RecordingSummary:
    """What was found in a recording."""

    channels: dict[str, ChannelSummary]
    sentences: list[str]  #: For people: what may be wrong with the channels


def summarise(recording: Recording) -> RecordingSummary:
    """Look at a recording, as read with its gaps; nothing is changed."""
    masks = find_outliers(recording)
    channels = {name: _channel(recording, name, masks) for name in recording.channels}
    return RecordingSummary(channels, remarks_on(recording, masks))


def remarks_on(recording: Recording, masks: dict[str, np.ndarray] | None = None) -> list[str]:
    """Sentences on what may be wrong with the channels: cheap enough for every reading."""
    if masks is None:
        masks = find_outliers(recording)
    sentences = [
        f"{sentence}; --outliers mark, or data.outliers=mark, makes them missing"
        for sentence in describe_outliers(recording, masks)
    ]
    for name, values in recording.channels.items():
        there = values[np.isfinite(values)]
        if not len(there):
            sentences.append(f"{name}: not a single value")
        elif float(np.ptp(there)) == 0 and name not in recording.names("disturbance"):
            sentences.append(f"{name} is constant at {there[0]:.4g} {recording.units[name]}")
    for name in recording.names("input"):
        share = _extreme_share(recording.channels[name])
        if share is not None and share > _SATURATED_SHARE:
            largest = float(np.nanmax(np.abs(recording.channels[name])))
            unit = recording.units[name]
            size = f"{largest:.4g}" + (f" {unit}" if unit != "1" else "")
            sentences.append(f"{name} is at its largest, {size}, for {share:.0%} of the time")
    return sentences


def _channel(recording: Recording, name: str, masks: dict[str, np.ndarray]) -> ChannelSummary:
    values = recording.channels[name]
    there = values[np.isfinite(values)]
    mask = masks.get(name)
    inputs, outputs = recording.names("input"), recording.names("output")
    angle = name in outputs and recording.units[name] in ("rad", "m")
    rest, turns = None, None
    if name in outputs and len(there) > 10:
        rest, turns = _motion(there, recording.sample_time, angle)
    return ChannelSummary(
        float(there.min()) if len(there) else None,
        float(there.max()) if len(there) else None,
        quantum(values),
        recording.missing.get(name, 0),
        int(mask.sum()) if mask is not None else 0,
        len(there) > 0 and float(np.ptp(there)) == 0,
        _extreme_share(values) if name in inputs else None,
        rest,
        turns,
    )


def _extreme_share(values: np.ndarray) -> float | None:
    """Share of the time at the extreme values, by runs of at least two.

    None where that tells nothing: for few levels, and for a signal that is held at every level.
    """
    there = values[np.isfinite(values)]
    if len(np.unique(there)) < _LEAST_LEVELS:
        return None
    near = 1e-6 * float(np.ptp(there))
    at_limit = (there >= there.max() - near) | (there <= there.min() + near)
    elsewhere = ~at_limit[1:]
    if np.any(elsewhere) and np.mean(np.diff(there)[elsewhere] == 0) > _HELD_SHARE:
        return None
    return sum(end - begin for begin, end in stretches(at_limit) if end - begin > 1) / len(there)


def _motion(values: np.ndarray, step: float, angle: bool) -> tuple[float | None, int]:
    """Share of rest (angles) and number of reversals, of the samples that there are."""
    from scipy.ndimage import maximum_filter1d, minimum_filter1d, uniform_filter1d

    width = max(3, round(_SMOOTHING_TIME / step))
    smooth = uniform_filter1d(values, width)
    if not angle:
        return None, _sign_changes(smooth)
    third = np.diff(values, 3)
    noise = 1.4826 * float(np.median(np.abs(third))) / 20**0.5
    still = max(2.01 * (quantum(values) or 0.0), 6 * noise)
    around = max(3, round(_REST_TIME / step))
    spread = maximum_filter1d(values, around) - minimum_filter1d(values, around)
    return float(np.mean(spread <= still)), _sign_changes(np.diff(smooth))


def _sign_changes(values: np.ndarray) -> int:
    """Changes of sign between sizes above a share of the largest."""
    size = _CROSSING_SHARE * float(np.abs(values).max(initial=0.0))
    signs = np.sign(values[np.abs(values) > size])
    return int(np.count_nonzero(np.diff(signs)))
