"""Measured curves as CSV: thrust curves of propellers."""

from collections.abc import Iterator
from pathlib import Path

_COLUMNS = {"omega": {"rad/s": 1.0, "rpm": 0.1047}, "thrust": {"N": 1.0, "mN": 1e-3}}


def seeds(folder: Path) -> Iterator[bytes]:
    """A curve, and one in other units."""
    yield b"# main\nomega[rad/s],thrust[N]\n-10,-1\n0,0\n10,1\n"
    yield b"thrust[mN],omega[rpm]\n-1,-10\n0,0\n1,10\n"


def read(data: bytes, folder: Path) -> None:
    """The table."""
    from trms_cli.models.static_curve import read_table

    path = folder / "curve.csv"
    path.write_bytes(data)
    read_table(
        str(path),
        "model.curve",
        what="a curve",
        header="omega[rad/s],thrust[N]",
        columns=_COLUMNS,
        fewest=3,
    )
