"""Recordings read and made ready: one run of a rig, or several where a file is split."""

from __future__ import annotations

from pathlib import Path

from trms_cli.models.model import Model
from trms_cli.plants.replay import RecordedRig, RecordedRun
from trms_cli.recordings.mcap_recording import sha256_of
from trms_cli.recordings.recording import read_recording


def read_runs(rig: RecordedRig, model: Model) -> tuple[list[RecordedRun], str]:
    """Read a recording for a model.

    Returns
    -------
    list of RecordedRun
        One, unless the recording is split.
    str
        SHA-256 of the file's bytes, hexadecimal.

    Raises
    ------
    RecordingError, ConfigurationError
        As :meth:`RecordedRig.load` does.
    """
    path = Path(rig.file).expanduser()
    recording = rig.part_of(read_recording(path))
    return [rig.take(recording, model)], sha256_of(path)
