"""The run that is going on in a folder, or the latest one that was.

Folders are looked through as :mod:`trms_cli.runs.query` does, but no index is asked or written:
whoever watches wants the one run that began a moment ago, not the figures of a thousand.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from trms_cli.core.errors import RecordingError
from trms_cli.recordings.log_head import read_log_head
from trms_cli.recordings.log_tail import LogTail
from trms_cli.runs.entry import LOG_NAME
from trms_cli.runs.query import logs_in

_END = b"\x89MCAP0\r\n"
#: Logs, the latest first, of which it is asked whether they are being written.
_ASKED = 2000


@dataclass(frozen=True)
class Latest:
    """The run that was found."""

    log: Path
    running: bool  #: Whether it is being written


def latest_run(folder: Path) -> Latest | None:
    """The latest run under a folder that is going on, else the latest one; None without any."""
    logs = sorted(((seen.mtime_ns, log) for log, seen in logs_in(folder).items()), reverse=True)
    for _, log in logs[:_ASKED]:
        if _is_written(log) and _is_run(log):
            return Latest(Path(log), True)
    for _, log in logs:
        if _is_run(log):
            return Latest(Path(log), False)
    return None


def log_in(folder: Path) -> Path | None:
    """The log of the run whose folder it is; None if it is no run's folder."""
    return folder / LOG_NAME if (folder / LOG_NAME).is_file() else None


def _is_written(log: str) -> bool:
    """Whether a log has no end and somebody has it open to write one."""
    try:
        with open(log, "rb") as file:
            size = file.seek(0, os.SEEK_END)
            file.seek(max(0, size - len(_END)))
            if size > len(_END) and file.read() == _END:
                return False
        with LogTail(log) as tail:
            return tail.has_writer() is True
    except (OSError, RecordingError):
        return False


def _is_run(log: str) -> bool:
    """Whether it is the log of a run, not an imported recording or somebody else's."""
    try:
        head = read_log_head(log)
    except (OSError, RecordingError):
        return False
    return head.of_trms and bool(head.config or "choices" in head.run)
