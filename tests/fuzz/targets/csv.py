"""CSV recordings, and what preparation and units make of them."""

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path


def seeds(folder: Path) -> Iterator[bytes]:
    """What a lab writes, and what the program writes."""
    import numpy as np

    from trms_cli.recordings.csv_recording import write_csv
    from trms_cli.recordings.recording import Recording

    path = folder / "seed.csv"
    channels = {"u_v": np.array([1.0, np.nan, 1.2]), "alpha_v": np.array([0.0, 0.1, 0.2])}
    units = {"u_v": "V", "alpha_v": "rad"}
    recording = Recording(np.array([0.0, 0.02, 0.06]), channels, units, {"rig": "one"})
    write_csv(recording, path, force=True)
    yield path.read_bytes()
    yield (
        b"# rig: INTECO TRAS\n# loop: closed\nt[ms],u_v[%],u_h[1],alpha_v[deg],omega_v[rpm]\n"
        b"0,1,2,3,4\n10,1,2,3,4\n20,,2,3,4\n"
    )
    yield b'\xef\xbb\xbf"t[s]","u_h[V]","alpha_h[rad]","d_wind[N*m]"\r\n0,1,0,0\r\n1,1,1e-3,0\r\n'


def read(data: bytes, folder: Path) -> None:
    """The recording and its notes, and the file as a reference signal."""
    from trms_cli.core.errors import TrmsError
    from trms_cli.recordings.csv_recording import read_csv
    from trms_cli.references.from_csv import read_columns

    path = folder / "fuzzed.csv"
    path.write_bytes(data)
    with suppress(TrmsError):
        read_columns(path, "alpha_v")
    read_csv(path).notes()
