"""A recording from a file of any format, told by its ending."""

from pathlib import Path

from trms_cli.core.errors import RecordingError
from trms_cli.recordings.channels import Vocabulary
from trms_cli.recordings.recording import Recording


def read_recording(path: Path | str, vocabulary: Vocabulary | None = None) -> Recording:
    """Read a recording, from CSV, MAT or a run log.

    ``vocabulary``: of the model that it is read for; None: the standard one, or what the file tells
    of its names.

    Raises RecordingError with the line of a CSV that is wrong, what was found there, and what to
    do.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if path.is_dir():
        raise RecordingError("this is a folder", where=str(path), remedy="give a file in it")
    if suffix in (".csv", ".txt"):
        from trms_cli.recordings.csv_recording import read_csv

        return read_csv(path, vocabulary)
    if suffix == ".mat":
        from trms_cli.recordings.mat_recording import read_mat

        return read_mat(path, vocabulary)
    if suffix == ".mcap":
        from trms_cli.recordings.mcap_recording import read_mcap

        return read_mcap(path, vocabulary)
    raise RecordingError(
        f"the ending {suffix!r} tells no format of recordings",
        where=str(path),
        remedy="give a .csv, a .mat or a .mcap file",
    )
