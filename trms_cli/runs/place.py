"""Where the index of this machine's runs lies, and how a run tells of itself.

The index is a file in the user's cache folder: it can be deleted at any time and is made again
from the logs. Each host has its own, because a database file must not be written over a network
by two hosts at once.

A run never touches the database. It writes one line, the path of its log, at the end of a text
file beside it; whoever lists runs next reads the log. That takes a run some tens of microseconds,
waits for nobody, and tells of a run that is killed later, wherever its folder is.
"""

import contextlib
import os
import platform
import re
from collections.abc import Iterator
from pathlib import Path

from trms_cli.core.whole_file import BINARY

#: The folder of the index; ``off``: runs do not tell of themselves.
ENVIRONMENT = "TRMS_RUNS"
_LEDGER = "new-runs"
_LONGEST_LEDGER = 64 * 2**20  # bytes: nobody has listed runs for half a million of them


def index_folder() -> Path:
    """The folder of the index (``TRMS_RUNS``, or beside what else is cached)."""
    setting = os.environ.get(ENVIRONMENT)
    if setting and setting != "off":
        return Path(setting).expanduser()
    cache = os.environ.get("TRMS_CACHE")
    if cache:
        return Path(cache).expanduser() / "runs"
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "trms" / "runs"


def index_file() -> Path:
    """The database of this host."""
    return index_folder() / f"runs-{_host()}.sqlite"


def note_run(log: Path) -> None:
    """Note that a run has begun to write `log`; never raises, a run does not depend on it."""
    if os.environ.get(ENVIRONMENT) == "off":
        return
    with contextlib.suppress(OSError, ValueError, RuntimeError):
        line = os.fsencode(os.path.realpath(log)) + b"\n"
        ledger = index_folder() / f"{_LEDGER}-{_host()}"
        ledger.parent.mkdir(parents=True, exist_ok=True)
        flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | BINARY
        file = os.open(ledger, flags, 0o600)
        try:
            if os.fstat(file).st_size < _LONGEST_LEDGER:
                os.write(file, line)  # one write at the end: lines of others stay whole
        finally:
            os.close(file)


def new_runs() -> Iterator[list[str]]:
    """Take the paths that runs have told of; they are forgotten when the caller comes back.

    A line that is written in the very moment may be lost: that run is found when its folder is
    looked through.
    """
    ledger = index_folder() / f"{_LEDGER}-{_host()}"
    with contextlib.suppress(OSError):
        ledger.rename(ledger.with_name(f"{ledger.name}.{os.getpid()}"))
    with contextlib.suppress(OSError):
        for ledger_file in sorted(
            ledger.parent.glob(f"{ledger.name}.*")
        ):  # also of one that was killed
            with contextlib.suppress(OSError):
                lines = ledger_file.read_bytes().splitlines()
                yield [line.decode() for line in lines if _is_path(line)]
                ledger_file.unlink(missing_ok=True)


def _is_path(line: bytes) -> bool:
    try:
        text = line.decode()
    except UnicodeDecodeError:
        return False
    return os.path.isabs(text) and "\0" not in text


def _host() -> str:
    return re.sub(r"[^A-Za-z0-9.-]", "_", platform.node())[:64] or "host"
