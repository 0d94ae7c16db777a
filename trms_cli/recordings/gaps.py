"""Gaps: a recording split at them, or short ones filled."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np

from trms_cli.core.errors import RecordingError
from trms_cli.recordings.grid import on_grid
from trms_cli.recordings.recording import Recording

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
        raise RecordingError(
            f"none of the {len(edges) - 1} parts between gaps has {_LEAST_ROWS} rows",
            where=str(recording.source),
            remedy="fill the gaps instead (gaps=SECONDS), or record without them",
        )
    dropped = len(edges) - 1 - len(spans)
    parts = []
    for number, (a, b) in enumerate(spans, start=1):
        remark = (
            f"part {number} of {len(spans)}: split at {len(wide)} "
            f"gap{'' if len(wide) == 1 else 's'} in t"
        )
        if dropped:
            remark += f", {dropped} of fewer than {_LEAST_ROWS} rows left out"
        parts.append(
            replace(
                recording,
                time=recording.time[a:b],
                channels={name: values[a:b] for name, values in recording.channels.items()},
                remarks=(*recording.remarks, remark),
            )
        )
    return parts


def fill_gaps(recording: Recording, longest: float, jitter: float) -> Recording:
    """Fill what is missing for at most ``longest`` seconds: rows of ``t`` and empty cells.

    Measurements are joined by straight lines, commands and references held. Longer holes and
    those at either end stay.

    Parameters
    ----------
    recording : Recording
    longest : float
        s from the last sample before a hole to the first after it.
    jitter : float
        How uneven the sampling may be, as a share of a sample: see :func:`on_grid`.
    """
    grid = on_grid(recording, jitter)
    held = {*recording.names("input"), *recording.names("reference")}
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
        chosen = inside & (span <= longest * (1 + 1e-9))
        joined = (
            values[np.maximum(before, 0)]
            if name in held
            else np.interp(grid.time, grid.time[there], values[there])
        )
        channels[name] = np.where(chosen, joined, values)
        if chosen.any():
            filled[name] = int(chosen.sum())
    # Points of a gap that stays are no rows of the result.
    keep = grid.present | np.any([np.isfinite(v) for v in channels.values()], axis=0)
    words = ", ".join(f"{name} {count}" for name, count in filled.items()) or "nothing"
    remark = f"filled where missing for at most {longest:g} s: {words} (samples)"
    return replace(
        recording,
        time=grid.time[keep],
        channels={name: values[keep] for name, values in channels.items()},
        remarks=(*recording.remarks, remark),
    )
