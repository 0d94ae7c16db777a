"""A recording on a uniform grid: what a filter in discrete time needs.

Every row goes to the grid point that its step leads to; points without a row are missing samples
(NaN). Steps that lie between two points are refused: a filter that took them for whole samples
would misread every rate.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trms_cli.core.errors import RecordingError
from trms_cli.recordings.recording import Recording

#: More points than this, most of them missing, are a recording of several runs.
_MOST_POINTS = 5_000_000
_LEAST_SHARE_PRESENT = 0.1
#: Largest share of a sample time that a step is advised to be off by.
_MOST_JITTER = 0.4


@dataclass(frozen=True)
class GriddedRecording:
    """Channels of a recording at every sample time."""

    recording: Recording  #: As it was read
    sample_time: float  #: s, the median step
    time: np.ndarray  #: (n,) array; s, the rig's own; between the rows of a gap evenly spaced
    channels: dict[str, np.ndarray]  #: dict of str to (n,) arrays; NaN where there is no sample
    present: np.ndarray  #: (n,) bool array; whether the recording has a row at the point
    jitter: float  #: Largest deviation of a step from whole sample times, as a share of one

    def __len__(self) -> int:
        return len(self.time)

    def runs_without(self, values: np.ndarray) -> list[tuple[int, int]]:
        """First index and length of every run of missing values within the rows."""
        return runs(np.isnan(values) & self.present)

    @property
    def gaps(self) -> list[tuple[int, int]]:
        """First index and length of every run of points without a row."""
        return runs(~self.present)


def on_grid(recording: Recording, tolerance: float) -> GriddedRecording:
    """Put a recording on the grid of its median step.

    Parameters
    ----------
    tolerance : float
        Largest deviation of a step from whole sample times, as a share of one, below 0.5.

    Raises
    ------
    RecordingError
        If the steps are uneven beyond the tolerance, or hardly any point has a row.
    """
    step = recording.sample_time
    steps = np.diff(recording.time) / step
    whole = np.round(steps)
    off = np.abs(steps - whole)
    uneven = np.flatnonzero((off > tolerance) | (whole < 1))
    if len(uneven):
        worst = int(uneven[np.argmax(off[uneven])])
        # A step of a sample and a half could be one or two: no larger share can tell.
        rounded = float(off[uneven].max()) if np.all(whole[uneven] >= 1) else 1.0
        larger = np.ceil(100 * rounded) / 100
        jitters = (
            f"; a clock that only jitters passes with plant.jitter={larger:g} "
            f"(share of the sample time, now {tolerance:g})"
            if larger <= _MOST_JITTER
            else ""
        )
        raise RecordingError(
            f"the samples are not evenly spaced: {len(uneven)} of {len(steps)} steps are not whole "
            f"multiples of the median step {step * 1e3:.4g} ms; at t = "
            f"{recording.time[worst]:.6g} s one takes {steps[worst] * step * 1e3:.4g} ms",
            where=str(recording.source),
            remedy="resample it to a fixed rate before (trms import --resample SECONDS, or "
            f"data.resample=SECONDS; {step:.3g} keeps its rate){jitters}",
        )
    index = np.concatenate([[0], np.cumsum(whole)]).astype(np.int64)
    count = int(index[-1]) + 1
    if count > _MOST_POINTS and len(recording) < _LEAST_SHARE_PRESENT * count:
        start, end = max(recording.gaps, key=lambda gap: gap[1] - gap[0])
        raise RecordingError(
            f"{count} samples lie between the first time and the last, and {len(recording)} are "
            f"there; the longest gap is from {start:.6g} to {end:.6g} s",
            where=str(recording.source),
            remedy="split the file, or take a part of it: plant.start=… plant.end=…",
        )
    present = np.zeros(count, dtype=bool)
    present[index] = True
    channels = {}
    for name, values in recording.channels.items():
        channels[name] = np.full(count, np.nan)
        channels[name][index] = values
    time = np.interp(np.arange(count), index, recording.time)
    return GriddedRecording(
        recording, step, time, channels, present, float(np.max(off, initial=0.0))
    )


def runs(flags: np.ndarray) -> list[tuple[int, int]]:
    """First index and length of every run of true values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    return [(int(a), int(b - a)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
