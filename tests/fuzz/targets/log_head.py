"""Logs, their words alone: the row of the index of runs."""

from pathlib import Path

from tests.fuzz.targets.log import seeds

__all__ = ["read", "seeds"]


def read(data: bytes, folder: Path) -> None:
    """The row that the index keeps, written to a database and read from it."""
    from trms_cli.runs.entry import read_entry
    from trms_cli.runs.index import FileStamp, LogReading, RunIndex

    path = folder / "head.mcap"
    path.write_bytes(data)
    entry = read_entry(path)
    if entry is not None:
        with RunIndex(None) as index:
            index.put([LogReading(str(path), FileStamp(0, len(data)), entry)])
            index.more_names()
