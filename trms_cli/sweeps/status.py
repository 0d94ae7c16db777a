"""The folder of one run of a sweep: who has begun it, how it stands, what a dead worker left.

``status.json`` (``trms.status/1``) tells how the run stands; it is replaced whole. Beside it lies
a hidden file for each attempt, which only one worker can make: ``.attempt-1`` holds who began it,
and is touched again and again while that worker lives. What an attempt that died has left is
moved into ``attempt-1/``, each file with ``.dead`` behind its name, so that no other command takes
it for a run.
"""

from __future__ import annotations

import contextlib
import json
import os
import platform
import re
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from trms_cli.core.whole_file import replace_whole
from trms_cli.runs.entry import STATUS_NAME, STATUS_SCHEMA, status_document
from trms_cli.sweeps.space import RunResult, SweepPoint

#: States after which nothing more comes of a run by itself.
ENDED = ("done", "failed", "interrupted", "lost")
_ATTEMPT = re.compile(r"\.attempt-(\d+)")
#: s: a worker gives a sign of life this often, and is taken for dead after so long without one.
#: Where the process can be asked for (same host), it is asked.
SIGN_EVERY, SILENT_AFTER = 5.0, 60.0


@dataclass(frozen=True)
class Claim:
    """An attempt that a worker has begun."""

    number: int  #: From 1 on
    host: str
    pid: int
    #: When the process was started, as its system tells it: another process of the same number has
    #: another
    born: str


class RunFolder:
    """The folder of a sweep's run, by its number."""

    def __init__(self, sweep: Path, number: int) -> None:
        self.path = sweep / str(number)
        self.number = number

    def claim(self, attempt: int) -> bool:
        """Begin an attempt; False where somebody has begun it, or a later one.

        Raises OSError if the disk does not take it.
        """
        self.path.mkdir(exist_ok=True)
        if self.last_attempt() > attempt:
            return False
        me = {"host": platform.node(), "pid": os.getpid(), "born": _born(os.getpid())}
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC
        try:
            file = os.open(self.attempt_file(attempt), flags, 0o644)
        except FileExistsError:
            return False
        with os.fdopen(file, "wb") as stream:
            stream.write(json.dumps(me).encode())
        return True

    def attempt_file(self, attempt: int) -> Path:
        """Where it stands who makes an attempt."""
        return self.path / f".attempt-{attempt}"

    def last_attempt(self) -> int:
        """The latest attempt that was begun; 0 if none was."""
        try:
            names = os.listdir(self.path)
        except OSError:
            return 0
        found = (_ATTEMPT.fullmatch(name) for name in names)
        return max((int(match[1]) for match in found if match), default=0)

    def holder(self) -> Claim | None:
        """Who has begun the latest attempt."""
        attempt = self.last_attempt()
        if not attempt:
            return None
        try:
            told = json.loads(self.attempt_file(attempt).read_bytes())
            return Claim(attempt, str(told["host"]), int(told["pid"]), str(told["born"]))
        except (OSError, ValueError, KeyError, TypeError):
            return Claim(attempt, "", 0, "")  # it died between making the file and writing it

    def sign_of_life(self) -> float:
        """When the worker of the latest attempt last gave one, on the clock of the disk, s."""
        try:
            return self.attempt_file(self.last_attempt()).stat().st_mtime
        except OSError:
            return 0.0

    def status(self) -> dict[str, Any]:
        """The content of ``status.json``; empty where there is none that can be read."""
        try:
            return status_document(self.path / STATUS_NAME) or {}
        except OSError:
            return {}

    def result(self) -> RunResult | None:
        """What came of the run, if its status tells; None while it has not ended."""
        return result_of(self.status(), self.number)

    def write(self, status: Mapping[str, Any]) -> None:
        """Replace the status in one step: a reader never sees half of it.

        Raises OSError if the disk does not take it.
        """
        text = json.dumps(status, ensure_ascii=False, indent=1, allow_nan=False) + "\n"
        replace_whole(self.path / STATUS_NAME, text.encode())

    def put_aside(self, attempt: int) -> None:
        """Move what earlier attempts left, so that the folder is as new.

        ``attempt``: the one that begins.
        """
        left = [name for name in os.listdir(self.path) if not _is_kept(name)]
        if not left:
            return
        aside = self.path / f"attempt-{max(1, attempt - 1)}"
        aside.mkdir(exist_ok=True)
        for name in left:
            _rename(self.path / name, aside)


def lost(point: SweepPoint, attempt: int, reason: str, before: Mapping[str, Any]) -> dict[str, Any]:
    """The status of a run whose worker died each time, the last one in `attempt` for a `reason`.

    `before` is the status that the last worker left, for what is known of it.
    """
    known = {key: before[key] for key in ("host", "pid", "begin", "choices") if key in before}
    words = "time" if attempt == 1 else "times"
    return {
        "schema": STATUS_SCHEMA,
        "job": point.number,
        "overrides": list(point.overrides),
        "state": "lost",
        **known,
        "attempt": attempt,
        "end": now(),
        "error": {
            "problem": f"its worker died {attempt} {words}: {reason}",
            "where": "",
            "remedy": "`trms sweep resume FOLDER --retry-failed` tries it again; what it left "
            f"lies in {point.number}/",
        },
    }


def result_of(status: Mapping[str, Any], number: int) -> RunResult | None:
    """A status as a result; None where the run has not ended."""
    state = status.get("state")
    if state not in ENDED:
        return None
    error = status.get("error")
    problem = error.get("problem", "") if isinstance(error, Mapping) else error
    figures = status.get("figures")
    objective = status.get("objective")
    return RunResult(
        number,
        state,
        figures=figures if isinstance(figures, Mapping) else {},
        objective=float(objective)
        if isinstance(objective, (int, float)) and not isinstance(objective, bool)
        else None,
        problem=str(problem or ""),
    )


def is_alive(claim: Claim) -> bool | None:
    """Whether the process of a claim lives; None where it is of another host."""
    if not claim.host:
        return False
    if claim.host != platform.node():
        return None
    try:
        os.kill(claim.pid, 0)  # asks; sends nothing
    except ProcessLookupError:
        return False
    except OSError:
        pass  # somebody else's process
    born = _born(claim.pid)
    return not (born and claim.born and born != claim.born)


def now() -> str:
    """The present time as the documents of a sweep have it."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


def _born(pid: int) -> str:
    """When a process was started, in the system's own counting; empty where it does not tell."""
    try:
        text = Path(f"/proc/{pid}/stat").read_text(encoding="latin-1")
        boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="latin-1").strip()
    except OSError:
        return ""
    fields = text.rpartition(")")[2].split()
    if fields and fields[0] in ("Z", "X"):
        return "ended"  # it is dead, and nobody has asked how
    return f"{fields[19]}@{boot[:8]}" if len(fields) > 19 else ""


def _is_kept(name: str) -> bool:
    return _ATTEMPT.fullmatch(name) is not None or re.fullmatch(r"attempt-\d+", name) is not None


def _rename(file: Path, aside: Path) -> None:
    """Move a file under a name that is not taken, and a folder with all that it holds."""
    if file.is_dir() and not file.is_symlink():
        inside = aside / file.name
        inside.mkdir(exist_ok=True)
        for name in os.listdir(file):
            _rename(file / name, inside)
        with contextlib.suppress(OSError):
            file.rmdir()
        return
    target = aside / f"{file.name}.dead"
    if target.exists():
        target = aside / f"{file.name}.{time.time_ns()}.dead"
    file.rename(target)


#: Set once; the run that is being made ends as interrupted, and none is begun.
leaving = threading.Event()
