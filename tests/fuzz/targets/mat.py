"""MAT recordings of every version that is read."""

import io
from collections.abc import Iterator
from pathlib import Path


def seeds(folder: Path) -> Iterator[bytes]:
    """Vectors and structs, compressed or not, of versions 4 and 5."""
    import numpy as np
    from scipy.io import savemat

    t = np.array([0.0, 0.02, 0.04])
    plain = {"t": t, "u_v": t + 1, "alpha_v": t * 2, "rig": "one"}
    nested = {
        "measurement": {"time": t, "alpha_v": t, "units": {"alpha_v": "deg"}},
        "command": {"time": t, "u_v": t},
        "run": {"seed": "1"},
    }
    units = {**plain, "units": {"alpha_v": "deg"}}
    for content in (plain, units, nested):
        for compressed in (False, True):
            stream = io.BytesIO()
            savemat(stream, content, do_compression=compressed)
            yield stream.getvalue()
    stream = io.BytesIO()
    savemat(stream, plain, format="4")
    yield stream.getvalue()


def read(data: bytes, folder: Path) -> None:
    """The recording and its notes."""
    from trms_cli.recordings.mat_recording import read_mat

    path = folder / "fuzzed.mat"
    path.write_bytes(data)
    read_mat(path).notes()
