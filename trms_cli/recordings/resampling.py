"""Another rate: a recording put on a grid of fixed steps.

Commands and references are held from row to row; a new sample of a command is the mean of what
acted until the next one. What is measured is low-passed below the new Nyquist frequency without
delay where the new rate is lower, and joined by straight lines where it is higher. Nothing is
invented where nothing was recorded: across gaps the samples are missing.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from trms_cli.core.errors import RecordingError
from trms_cli.recordings.recording import GAP_FACTOR, Recording

#: Edge of the low-pass as a share of the new Nyquist frequency.
_CUT_OFF = 0.8
#: Half length of the filter in new samples: 60 dB of attenuation from 1.2 new Nyquists on.
_HALF_LENGTH = 10
#: Times closer than this share of a step are the same.
_SAME = 1e-6
_MOST_SAMPLES = 20_000_000


def resample(recording: Recording, step: float) -> Recording:
    """Put a recording on the grid of a step, from its first row on.

    Parameters
    ----------
    recording : Recording
        Evenly sampled or not.
    step : float
        s, above zero.

    Returns
    -------
    Recording
        Missing samples are NaN and stand in the grid; a remark tells what was done.

    Raises
    ------
    RecordingError
        If fewer than two or absurdly many samples would result.
    """
    count = int(np.floor(recording.duration_s / step * (1 + _SAME) + _SAME)) + 1
    if not 2 <= count <= _MOST_SAMPLES:
        raise RecordingError(
            f"a recording of {recording.duration_s:g} s would have {count} samples at {step:g} s",
            where="resample",
            remedy=f"the recording's own step is {recording.sample_time:g} s",
        )
    old = recording.sample_time
    offsets = np.arange(count) * step
    even = np.max(np.abs(np.diff(recording.time) - step)) < _SAME * step
    if even:
        return replace(recording, remarks=(*recording.remarks, f"already sampled every {step:g} s"))
    time = recording.time[0] + offsets
    channels = {}
    held = {*recording.names("input"), *recording.names("reference")}
    inputs = set(recording.names("input"))
    hole = max(GAP_FACTOR * old, step)
    for name, values in recording.channels.items():
        if name in inputs:
            channels[name] = _mean_held(recording.time, values, time, step, hole)
        elif name in held:
            channels[name] = _held(recording.time, values, time, hole)
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
    return replace(recording, time=time, channels=channels, remarks=(*recording.remarks, remark))


def _held(at: np.ndarray, values: np.ndarray, time: np.ndarray, hole: float) -> np.ndarray:
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
    return np.where(np.isnan(_held(at, np.zeros(len(at)), time, hole)), np.nan, mean)


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
