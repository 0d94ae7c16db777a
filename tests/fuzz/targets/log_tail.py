"""Logs that grow: each look takes what is new."""

from pathlib import Path

from tests.fuzz.targets.log import seeds

__all__ = ["read", "seeds"]


def read(data: bytes, folder: Path) -> None:
    """The file in two halves, looked at until nothing comes."""
    from trms_cli.recordings.log_reader import LogTail

    path = folder / "tail.mcap"
    path.write_bytes(data[: len(data) // 2])
    with LogTail(path) as tail:
        while tail.read(1000) is not None:
            pass
        path.write_bytes(data)
        while tail.read(1000) is not None:
            pass
        tail.config  # noqa: B018
