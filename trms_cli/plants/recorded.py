"""Recordings read and made ready: one run of a rig, or several where a file is split."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Literal

from trms_cli.models.model import Model
from trms_cli.plants.replay import RecordedRig, RecordedRun
from trms_cli.recordings.mcap_recording import sha256_of
from trms_cli.recordings.preparation import Preparation
from trms_cli.recordings.recording import read_recording

#: What is done about missing samples: nothing, a run of each part between gaps, or so many
#: seconds filled.
Gaps = Literal["keep", "split"] | float


def read_runs(
    rig: RecordedRig,
    model: Model,
    *,
    resample: float | None = None,
    outliers: Literal["keep", "mark"] = "keep",
    gaps: Gaps = "keep",
    delays: Mapping[str, float] | None = None,
) -> tuple[list[RecordedRun], str]:
    """Read a recording for a model.

    Parameters
    ----------
    rig : RecordedRig
        Names the file, the part of it to take, and what is known of its channels.
    model : Model
    resample, outliers, gaps, delays
        How the part is made ready: see :class:`trms_cli.recordings.preparation.Preparation`.

    Returns
    -------
    list of RecordedRun
        One, unless the recording is split. Their remarks tell what was found and done.
    str
        SHA-256 of the file's bytes, hexadecimal.

    Raises
    ------
    RecordingError, ConfigurationError
        As :meth:`RecordedRig.load` and :meth:`Preparation.apply` do.
    """
    path = Path(rig.file).expanduser()
    recording = rig.part_of(read_recording(path))
    preparation = Preparation(
        resample=resample,
        outliers=outliers,
        gaps=gaps,
        delays=delays or {},
        jitter=rig.jitter,
    )
    parts = preparation.apply(recording)
    return [rig.take(part, model) for part in parts], sha256_of(path)
