"""A recording made ready, by request only: freed of outliers, shifted, split, filled, resampled.

The order is fixed: outliers are made missing before anything is averaged over them, channels are
moved to the time at which they were true, gaps are split or filled, and the new rate comes last.
What was done stands in the recording's remarks; what was found and left is said as well.

At another rate, commands and references are held from row to row; a new sample of a command is the
mean of what acted until the next one. What is measured is low-passed below the new Nyquist
frequency without delay where the new rate is lower, and joined by straight lines where it is
higher. Nothing is invented where nothing was recorded: across gaps the samples are missing.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta

from trms_cli.core.errors import RecordingError
from trms_cli.core.plugins import require_known
from trms_cli.recordings.recording import GAP_FACTOR, Recording, on_grid, refuse
from trms_cli.recordings.summary import describe_outliers, find_outliers, remarks_on

#: Rows that a part needs to be one.
_LEAST_ROWS = 10


def split_at_gaps(recording: Recording) -> list[Recording]:
    """The parts between the gaps of ``t``; parts of fewer than ten rows are left out.

    Raises RecordingError if no part is long enough.
    """
    wide = np.searchsorted(recording.time, [end for _, end in recording.gaps])
    if not len(wide):
        return [recording]
    edges = [0, *wide.tolist(), len(recording)]
    spans = [(a, b) for a, b in pairwise(edges) if b - a >= _LEAST_ROWS]
    if not spans:
        problem = f"none of the {len(edges) - 1} parts between gaps has {_LEAST_ROWS} rows"
        remedy = "fill the gaps instead (gaps=SECONDS), or record without them"
        refuse(recording.source, problem, remedy)
    dropped = len(edges) - 1 - len(spans)
    parts = []
    for number, (a, b) in enumerate(spans, start=1):
        remark = (
            f"part {number} of {len(spans)}: split at {len(wide)} "
            f"gap{'' if len(wide) == 1 else 's'} in t"
        )
        if dropped:
            remark += f", {dropped} of fewer than {_LEAST_ROWS} rows left out"
        parts.append(recording.select_rows(slice(a, b), remark))
    return parts


def fill_gaps(recording: Recording, longest: float, jitter: float) -> Recording:
    """Fill what is missing for at most ``longest`` seconds: rows of ``t`` and empty cells.

    Measurements are joined by straight lines, commands and references held. Longer holes and
    those at either end stay.

    ``longest``: s from the last sample before a hole to the first after it. ``jitter``: how uneven
    the sampling may be, as a share of a sample: see :func:`on_grid`.
    """
    grid = on_grid(recording, jitter)
    held_names = recording.held_channels
    channels, filled = {}, {}
    for name, values in grid.channels.items():
        there = np.isfinite(values)
        if not there.any():
            channels[name] = values
            continue
        index = np.arange(len(values))
        before = np.maximum.accumulate(np.where(there, index, -1))
        after = np.minimum.accumulate(np.where(there, index, len(values))[::-1])[::-1]
        inside = ~there & (before >= 0) & (after < len(values))
        span = grid.time[np.minimum(after, len(values) - 1)] - grid.time[np.maximum(before, 0)]
        mask = inside & (span <= longest * (1 + 1e-9))
        joined = (
            values[np.maximum(before, 0)]
            if name in held_names
            else np.interp(grid.time, grid.time[there], values[there])
        )
        channels[name] = np.where(mask, joined, values)
        if mask.any():
            filled[name] = int(mask.sum())
    # Points of a gap that stays are no rows of the result.
    keep = grid.present | np.any([np.isfinite(v) for v in channels.values()], axis=0)
    words = ", ".join(f"{name} {count}" for name, count in filled.items()) or "nothing"
    remark = f"filled where missing for at most {longest:g} s: {words} (samples)"
    columns = {name: values[keep] for name, values in channels.items()}
    return recording.with_remarks(remark, time=grid.time[keep], channels=columns)


def shift_channels(recording: Recording, delays: Mapping[str, float]) -> Recording:
    """Move channels earlier by the time by which they are recorded late.

    Whole samples are moved; a rest is interpolated by straight lines for measurements, and
    refused for commands and references, which are held. The ends for which a channel has no
    value any more are cut.

    ``delays``: s, by channel; negative for one that is recorded early (a command that acts later).
    Raises RecordingError for an unknown channel, a delay longer than the recording, or a part of a
    sample for a held channel.
    """
    step = recording.sample_time
    held_names = recording.held_channels
    first, last = recording.time[0], recording.time[-1]
    channels = dict(recording.channels)
    for name, delay in delays.items():
        problem = f"the recording has no {name!r} to shift"
        require_known(name, channels, problem, f"delays.{name}", RecordingError)
        whole = round(delay / step)
        if name in held_names and abs(delay - whole * step) > 0.01 * step:
            samples = f"{delay:g} s is {delay / step:.3g} samples"
            remedy = f"give whole samples of {step:g} s, or resample first to a step that fits"
            refuse(f"delays.{name}", f"{samples}, and {name} is held from row to row", remedy)
        first = max(first, recording.time[0] - delay)
        last = min(last, recording.time[-1] - delay)
        values, at = channels[name], recording.time - delay
        if name in held_names:
            row = np.searchsorted(at, recording.time + 0.01 * step, side="right") - 1
            channels[name] = values[np.clip(row, 0, len(values) - 1)]
        else:
            channels[name] = _shifted(at, values, recording.time, step)
    keep = (recording.time >= first - 0.01 * step) & (recording.time <= last + 0.01 * step)
    if np.count_nonzero(keep) < 2:
        lasts = f"it lasts {recording.duration_s:g} s"
        refuse("delays", "the delays leave nothing of the recording", lasts)
    words = ", ".join(f"{name} by {delay:g} s" for name, delay in delays.items())
    return replace(recording, channels=channels).select_rows(keep, f"moved earlier: {words}")


def _shifted(at: np.ndarray, values: np.ndarray, time: np.ndarray, step: float) -> np.ndarray:
    """Straight lines between samples; missing where either neighbour is, or far away."""
    row = np.clip(np.searchsorted(at, time + 0.01 * step, side="right") - 1, 0, len(at) - 1)
    after = np.minimum(row + 1, len(at) - 1)
    width = np.maximum(at[after] - at[row], 1e-300)
    share = np.clip((time - at[row]) / width, 0.0, 1.0)
    share[np.abs(time - at[row]) <= 0.01 * step] = 0.0
    mixed = np.where(share == 0.0, values[row], (1 - share) * values[row] + share * values[after])
    return np.where((share > 0) & (width > 1.5 * step), np.nan, mixed)


#: Edge of the low-pass as a share of the new Nyquist frequency.
_CUT_OFF = 0.8
#: Half length of the filter in new samples: 60 dB of attenuation from 1.2 new Nyquists on.
_HALF_LENGTH = 10
#: Times closer than this share of a step are the same.
_SAME = 1e-6
_MOST_SAMPLES = 20_000_000


def resample(recording: Recording, step: float) -> Recording:
    """Put a recording, evenly sampled or not, on the grid of a step (s), from its first row on.

    Missing samples are NaN and stand in the grid; a remark tells what was done. Raises
    RecordingError if fewer than two or absurdly many samples would result.
    """
    count = int(np.floor(recording.duration_s / step * (1 + _SAME) + _SAME)) + 1
    if not 2 <= count <= _MOST_SAMPLES:
        would = f"would have {count} samples at {step:g} s"
        own = f"the recording's own step is {recording.sample_time:g} s"
        refuse("resample", f"a recording of {recording.duration_s:g} s {would}", own)
    old = recording.sample_time
    offsets = np.arange(count) * step
    even = np.max(np.abs(np.diff(recording.time) - step)) < _SAME * step
    if even:
        return recording.with_remarks(f"already sampled every {step:g} s")
    time = recording.time[0] + offsets
    channels = {}
    held_names = recording.held_channels
    inputs = set(recording.names("input"))
    hole = max(GAP_FACTOR * old, step)
    for name, values in recording.channels.items():
        if name in inputs:
            channels[name] = _mean_held(recording.time, values, time, step, hole)
        elif name in held_names:
            channels[name] = _last_values(recording.time, values, time, hole)
        else:
            channels[name] = _measured(recording.time, values, time, old, step, hole)
    lowered = step > old * (1 + _SAME)
    how = (
        f"low-passed at {_CUT_OFF / (2 * step):.4g} Hz, which takes noise away: what is declared "
        "of it holds for the original rate"
        if lowered
        else "joined by straight lines, which adds no knowledge"
    )
    remark = (
        f"resampled from {old * 1e3:.6g} to {step * 1e3:.6g} ms: commands held"
        f"{' and averaged' if lowered else ''}, measurements {how}"
    )
    return recording.with_remarks(remark, time=time, channels=channels)


def _last_values(at: np.ndarray, values: np.ndarray, time: np.ndarray, hole: float) -> np.ndarray:
    """The last value at each time; missing in a hole, from its last row's own step on."""
    row = np.searchsorted(at, time + _SAME * hole, side="right") - 1
    nearest = np.minimum(row + 1, len(at) - 1)
    wide = (at[nearest] - at[row] > hole) & (time - at[row] > hole / 2)
    return np.where(wide, np.nan, values[row])


def _mean_held(
    at: np.ndarray, values: np.ndarray, time: np.ndarray, step: float, hole: float
) -> np.ndarray:
    """The mean of the held command over each step; a row without a value keeps the one before."""
    there = np.flatnonzero(np.isfinite(values))
    if not len(there):
        return np.full(len(time), np.nan)
    edges, level = at[there], values[there]
    # Integral of the held command, linear between its edges and beyond the last one.
    area = np.concatenate([[0.0], np.cumsum(np.diff(edges) * level[:-1])])

    def integral(t: np.ndarray) -> np.ndarray:
        row = np.clip(np.searchsorted(edges, t, side="right") - 1, 0, None)
        return area[row] + (t - edges[row]) * level[row]

    # The last row's command acts for one step of the recording more.
    end = np.minimum(time + step, max(edges[-1], float(at[-1])) + (at[-1] - at[-2]))
    end = np.maximum(end, time + _SAME * step)
    mean = (integral(end) - integral(time)) / (end - time)
    mean[time < edges[0] - _SAME * step] = np.nan
    # A value that held throughout the step stands as it is, free of rounding.
    row = np.clip(np.searchsorted(edges, time + _SAME * step, side="right") - 1, 0, None)
    last = np.clip(np.searchsorted(edges, end - _SAME * step, side="right") - 1, 0, None)
    mean = np.where((row == last) & np.isfinite(mean), level[row], mean)
    return np.where(np.isnan(_last_values(at, np.zeros(len(at)), time, hole)), np.nan, mean)


def _measured(
    at: np.ndarray, values: np.ndarray, time: np.ndarray, old: float, step: float, hole: float
) -> np.ndarray:
    """Each run of samples without a hole, filtered and interpolated by itself."""
    result = np.full(len(time), np.nan)
    there = np.flatnonzero(np.isfinite(values))
    if not len(there):
        return result
    breaks = np.flatnonzero(np.diff(at[there]) > hole * (1 + _SAME)) + 1
    for part in np.split(there, breaks):
        t, y = at[part], values[part]
        inside = (time >= t[0] - _SAME * step) & (time <= t[-1] + _SAME * step)
        if not inside.any():
            continue
        if len(t) < 2 or step <= old * (1 + _SAME):
            result[inside] = np.interp(time[inside], t, y)
            continue
        fine = t[0] + np.arange(round((t[-1] - t[0]) / old) + 1) * old
        smooth = _low_passed(np.interp(fine, t, y), step / old)
        result[inside] = _interpolated(fine, smooth, time[inside])
    return result


def _low_passed(y: np.ndarray, ratio: float) -> np.ndarray:
    """Without delay: a symmetric filter over the samples, mirrored oddly at their ends."""
    from scipy.signal import firwin, oaconvolve

    half = min(int(np.ceil(_HALF_LENGTH * ratio)), len(y) - 1)
    if half < 1:
        return y
    kernel = firwin(2 * half + 1, min(_CUT_OFF / ratio, 0.99), window=("kaiser", 5.65))
    padded = np.concatenate([2 * y[0] - y[half:0:-1], y, 2 * y[-1] - y[-2 : -half - 2 : -1]])
    return np.asarray(oaconvolve(padded, kernel, mode="valid"))


def _interpolated(fine: np.ndarray, y: np.ndarray, time: np.ndarray) -> np.ndarray:
    if len(fine) < 4:
        return np.interp(time, fine, y)
    from scipy.interpolate import CubicSpline

    return np.asarray(CubicSpline(fine, y)(np.clip(time, fine[0], fine[-1])))


@dataclass(frozen=True, kw_only=True)
class Preparation:
    """What is done to a recording. The defaults do nothing."""

    #: New sample time, s; None keeps the recording's
    resample: Annotated[float, Meta(gt=0)] | None = None
    #: "keep" or "mark"; whether outliers of measured channels become missing samples
    outliers: Literal["keep", "mark"] = "keep"
    #: "keep", "split" or float; ``keep`` leaves missing samples missing; ``split`` makes a
    #: recording of each part between gaps of ``t``; a number fills what is missing for at most so
    #: many seconds
    gaps: Literal["keep", "split"] | Annotated[float, Meta(gt=0)] = "keep"
    #: s by which a channel is recorded late: it is moved earlier. Negative for one that is early,
    #: as a command that is written down before it acts.
    delays: Mapping[str, float] = field(default_factory=dict)
    #: Largest deviation of a step from whole sample times, as a share of one
    jitter: Annotated[float, Meta(gt=0, lt=0.5)] = 0.2

    def apply(self, recording: Recording) -> list[Recording]:
        """Make a recording ready.

        Returns one, unless it is split. Their remarks tell what was found and what was done. Raises
        RecordingError if something asked for cannot be done.
        """
        remarks = remarks_on(recording, {} if self.outliers == "mark" else None)
        recording = recording.with_remarks(*remarks)
        if self.outliers == "mark":
            recording = _without_outliers(recording)
        delays = {name: delay for name, delay in self.delays.items() if delay != 0}
        if delays:
            recording = shift_channels(recording, delays)
        parts = split_at_gaps(recording) if self.gaps == "split" else [recording]
        if not isinstance(self.gaps, str):
            # Uneven rows have no grid to fill; a new rate bridges what is short by itself.
            parts = [fill_gaps(part, self.gaps, self.jitter) for part in parts]
        if self.resample is not None:
            parts = [resample(part, self.resample) for part in parts]
        return parts


def _without_outliers(recording: Recording) -> Recording:
    masks = find_outliers(recording)
    channels = dict(recording.channels)
    for name, mask in masks.items():
        channels[name] = np.where(mask, np.nan, channels[name])
    said = [f"{sentence}: made missing" for sentence in describe_outliers(recording, masks)]
    return recording.with_remarks(*(said or ["no outliers to make missing"]), channels=channels)
