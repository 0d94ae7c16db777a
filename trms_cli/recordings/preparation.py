"""A recording made ready, by request only: freed of outliers, shifted, split, filled, resampled.

The order is fixed: outliers are made missing before anything is averaged over them, channels are
moved to the time at which they were true, gaps are split or filled, and the new rate comes last.
What was done stands in the recording's remarks; what was found and left is said as well.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta

from trms_cli.recordings.delays import shift_channels
from trms_cli.recordings.findings import remarks_on
from trms_cli.recordings.gaps import fill_gaps, split_at_gaps
from trms_cli.recordings.outliers import describe_outliers, find_outliers
from trms_cli.recordings.recording import Recording
from trms_cli.recordings.resampling import resample


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

        Returns
        -------
        list of Recording
            One, unless it is split. Their remarks tell what was found and what was done.

        Raises
        ------
        RecordingError
            If something asked for cannot be done.
        """
        found = remarks_on(recording, {} if self.outliers == "mark" else None)
        recording = replace(recording, remarks=(*recording.remarks, *found))
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
    return replace(
        recording,
        channels=channels,
        remarks=(*recording.remarks, *(said or ["no outliers to make missing"])),
    )
