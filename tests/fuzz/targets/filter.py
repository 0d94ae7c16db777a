"""Filters of ``trms runs``: read, put into SQL, asked of a database."""

from collections.abc import Iterator
from pathlib import Path


def seeds(folder: Path) -> Iterator[bytes]:
    """Lines of the documentation."""
    yield b"controller == 'newton_mpc' and rmse_yaw < 0.05"
    yield b"not complete or failures > 0"
    yield b"controller in ('pid', 'lqr') and effects contains 'friction'"
    yield b"0.1 < rmse_yaw / rmse_pitch <= 2 and plant.prior_seed == 3"
    yield b"settling_time_yaw is None and controller like '*mpc' and ref not like 's?n%'"
    yield b"time > '2025-01-31 12:00' and -seed + 1 * 2 != 1e300"


def read(data: bytes, folder: Path) -> None:
    """How many runs of an index with one in it the filter holds for."""
    from trms_cli.runs.columns import COLUMNS
    from trms_cli.runs.entry import IndexEntry
    from trms_cli.runs.filter import translate_filter
    from trms_cli.runs.index import FileStamp, LogReading, RunIndex

    condition = translate_filter(data.decode("utf-8", "replace"), ())
    values = dict.fromkeys(COLUMNS) | {"path": "a", "log": "a/run.mcap", "controller": "pid"}
    with RunIndex(None) as index:
        entry = IndexEntry("a/run.mcap", values, {"seed": 1})
        index.put([LogReading("a/run.mcap", FileStamp(0, 1), entry)])
        assert index.count(condition) in (0, 1)
