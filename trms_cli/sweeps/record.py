"""The record of a sweep in its folder, written before its first run, so that it can be resumed.

``sweep.json`` (``trms.sweep/1``) holds what was asked for, ``points.jsonl`` a line for each point
that was proposed, written before a worker gets it. ``.lock`` is held by the process that drives
the sweep; ``.stop`` asks its workers to end.

``status.json`` (``trms.status/1``) in the folder of a run tells how the run stands; it is replaced
whole. Beside it lies a hidden file for each attempt, which only one worker can make: ``.attempt-1``
holds who began it, and is touched again and again while that worker lives. What an attempt that
died has left is moved into ``attempt-1/``, each file with ``.dead`` behind its name, so that no
other command takes it for a run.
"""

import contextlib
import json
import os
import platform
import re
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import Any

import msgspec

from trms_cli.core.errors import ConfigurationError, RecordingError
from trms_cli.core.whole_file import replace_whole
from trms_cli.runs.entry import STATUS_NAME, STATUS_SCHEMA, status_document
from trms_cli.sweeps.space import (
    Choice,
    PackedFigures,
    PriorOfKey,
    Range,
    RunResult,
    Space,
    SweepPoint,
)

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
        self._sweep, self.number = sweep, number

    @cached_property
    def path(self) -> Path:
        """Where it is."""
        return self._sweep / str(self.number)

    def claim(self, attempt: int) -> bool:
        """Begin an attempt; False where somebody has begun it, or a later one.

        Raises OSError if the disk does not take it.
        """
        self.path.mkdir(exist_ok=True)
        if self.last_attempt() > attempt:
            return False
        me = {"host": platform.node(), "pid": os.getpid(), "born": _born(os.getpid())}
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL
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
        matches = (_ATTEMPT.fullmatch(name) for name in names)
        return max((int(match[1]) for match in matches if match), default=0)

    def holder(self) -> Claim | None:
        """Who has begun the latest attempt."""
        attempt = self.last_attempt()
        if not attempt:
            return None
        try:
            claim = json.loads(self.attempt_file(attempt).read_bytes())
            return Claim(attempt, str(claim["host"]), int(claim["pid"]), str(claim["born"]))
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
        return status_of(f"{self._sweep}{os.sep}{self.number}{os.sep}{STATUS_NAME}")

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
        leftovers = [name for name in os.listdir(self.path) if not _is_kept(name)]
        if not leftovers:
            return
        aside = self.path / f"attempt-{max(1, attempt - 1)}"
        aside.mkdir(exist_ok=True)
        for name in leftovers:
            _rename(self.path / name, aside)


def lost_status(
    point: SweepPoint, attempt: int, reason: str, before: Mapping[str, Any]
) -> dict[str, Any]:
    """The status of a run whose worker died each time, the last one in `attempt` for a `reason`.

    `before` is the status that the last worker left, for what is known of it.
    """
    facts = {key: before[key] for key in ("host", "pid", "begin", "choices") if key in before}
    words = "time" if attempt == 1 else "times"
    return {
        "schema": STATUS_SCHEMA,
        "job": point.number,
        "overrides": list(point.overrides),
        "state": "lost",
        **facts,
        "attempt": attempt,
        "end": now(),
        "error": {
            "problem": f"its worker died {attempt} {words}: {reason}",
            "where": "",
            "remedy": "`trms sweep resume FOLDER --retry-failed` tries it again; what it left "
            f"lies in {point.number}/",
        },
    }


def status_of(file: Path | str) -> dict[str, Any]:
    """The content of a ``status.json``; empty where there is none that can be read."""
    try:
        return status_document(file) or {}
    except OSError:
        return {}


def result_of(status: Mapping[str, Any], number: int) -> RunResult | None:
    """A status as a result; None where the run has not ended."""
    state = status.get("state")
    if state not in ENDED:
        return None
    return RunResult(
        number,
        state,
        figures=_figures_of(status),
        objective=objective_of(status),
        problem=problem_of(status),
    )


def _figures_of(status: Mapping[str, Any]) -> Mapping[str, float]:
    figures = status.get("figures")
    if not isinstance(figures, Mapping):
        return {}
    try:
        return PackedFigures(figures)
    except TypeError:  # somebody has written something else into it
        return figures


def objective_of(status: Mapping[str, Any]) -> float | None:
    """What a sweep minimises, as a status tells it."""
    value = status.get("objective")
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return None
    return float(value)


def problem_of(status: Mapping[str, Any]) -> str:
    """Why a run failed: its error is text, or a mapping with the problem."""
    error = status.get("error")
    problem = error.get("problem") if isinstance(error, Mapping) else error
    return str(problem or "")


def is_alive(claim: Claim) -> bool | None:
    """Whether the process of a claim lives; None on another host, and where nobody can ask."""
    if not claim.host:
        return False
    if claim.host != platform.node() or os.name != "posix":
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


#: Held by the process that drives the sweep; the system frees it when that process dies.
LOCK_NAME = ".lock"


def has_driver(folder: Path) -> bool:
    """Whether a process drives the sweep in a folder at present."""
    try:
        import fcntl

        descriptor = os.open(folder / LOCK_NAME, os.O_RDWR)
    except (ImportError, OSError):
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    finally:
        os.close(descriptor)
    return False


SCHEMA = "trms.sweep/1"
RECORD_NAME, POINTS_NAME = "sweep.json", "points.jsonl"
STOP_NAME = ".stop"
_LONGEST = 2**28  # bytes of a file of the record


@dataclass(frozen=True)
class SweepPlan:
    """What a sweep is to do."""

    primary: str  #: Primary configuration of the runs: ``run``, ``identify``, …
    task: str  #: The function that makes a run, ``module:name``
    overrides: tuple[str, ...]  #: Of the runs, as typed, and what sweeps add to them
    #: Of the sweep itself, as typed: ``sampler=…``, ``launcher.workers=4``
    settings: tuple[str, ...]
    space: Space  #: What varies
    sampler: Mapping[str, Any]  #: Their configuration, composed
    launcher: Mapping[str, Any]  #: Their configuration, composed
    retries: int = 1  #: Times that a run is tried again after its worker died
    config_dirs: tuple[str, ...] = ()  #: The user's folders of options
    directory: str = ""  #: The working directory, for paths in overrides
    command: str = ""  #: As typed
    versions: Mapping[str, str] = field(default_factory=dict)  #: Of the packages that compute
    git: str = ""  #: Revision of the checkout; empty if there is none


class Record:
    """The record in a sweep's folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @property
    def stop_file(self) -> Path:
        """While it is there, workers end their run."""
        return self.folder / STOP_NAME

    def begin(self, plan: SweepPlan) -> None:
        """Write down what is to be done; raises RecordingError if the disk does not take it."""
        self._write({"schema": SCHEMA, **asdict(plan), "state": "running", "begin": now()})

    def note(self, **words: Any) -> None:
        """Change top-level keys of ``sweep.json``: ``state``, ``total``, ``summary``, …

        Raises RecordingError if the disk does not take it.
        """
        self._write(self.document() | words)

    def document(self) -> dict[str, Any]:
        """The content of ``sweep.json``.

        Raises RecordingError if there is none that can be read.
        """
        file = self.folder / RECORD_NAME
        remedy = "name the folder of a sweep: `trms run -m … out=FOLDER` makes one"
        try:
            with file.open("rb") as stream:
                document = json.loads(stream.read(_LONGEST))
        except FileNotFoundError:
            problem = f"{str(self.folder)!r} holds no {RECORD_NAME}"
            if (self.folder / "multirun.yaml").exists():
                problem += ": it is of a version that could not resume"
            raise RecordingError(problem, where=str(self.folder), remedy=remedy) from None
        except (OSError, ValueError, RecursionError) as error:
            raise RecordingError(
                f"it cannot be read ({error})", where=str(file), remedy=remedy
            ) from error
        if not isinstance(document, dict) or document.get("schema") != SCHEMA:
            raise RecordingError(f"it is not {SCHEMA}", where=str(file), remedy=remedy)
        return document

    def plan(self) -> SweepPlan:
        """What is to be done, read back; raises RecordingError if the record cannot be used."""
        document = self.document()
        try:
            words = {each.name: document[each.name] for each in fields(SweepPlan)}
            words["space"] = _space(words["space"])
            for key in ("overrides", "settings", "config_dirs"):
                words[key] = tuple(map(str, words[key]))
            return SweepPlan(**words)
        except (KeyError, TypeError, ValueError) as error:
            raise RecordingError(
                f"it lacks what is needed to go on ({type(error).__name__}: {error})",
                where=str(self.folder / RECORD_NAME),
                remedy="make the sweep anew",
            ) from error

    def append(self, points: Sequence[SweepPoint]) -> None:
        """Write points down before anybody gets them.

        Raises RecordingError if the disk does not take it.
        """
        lines = "".join(
            json.dumps(asdict(point), ensure_ascii=False, allow_nan=False) + "\n"
            for point in points
        )
        file = self.folder / POINTS_NAME
        try:
            with file.open("ab") as stream:
                stream.write(lines.encode())
                stream.flush()
                os.fsync(stream.fileno())
        except OSError as error:
            raise explain_disk_error(error, file) from error

    def points(self, *, mend: bool = False) -> list[SweepPoint]:
        """The points that were proposed, in their order.

        ``mend``: cut off a last line that was left half-written. Raises RecordingError if a line
        before the last cannot be read.
        """
        file = self.folder / POINTS_NAME
        try:
            content = file.read_bytes()
        except FileNotFoundError:
            return []
        whole = content[: content.rfind(b"\n") + 1]
        if mend and len(whole) < len(content):
            with file.open("r+b") as stream:
                stream.truncate(len(whole))
        proposals = []
        shared: dict[str, str] = {}  # points of a sweep have most words in common
        for number, line in enumerate(whole.splitlines()):
            try:
                entry = msgspec.json.decode(line)
                point = SweepPoint(
                    int(entry["number"]),
                    tuple([shared.setdefault(word, word) for word in entry["overrides"]]),
                    dict(entry["values"]),
                    entry["trial"],
                )
                if point.number != number:
                    raise ValueError(f"point {point.number}")
            except (ValueError, KeyError, TypeError, msgspec.DecodeError) as error:
                raise RecordingError(
                    f"no point number {number} ({error})",
                    where=f"{file}, line {number + 1}",
                    remedy="points are numbered from 0 without gaps; make the sweep anew",
                ) from error
            proposals.append(point)
        return proposals

    def _write(self, document: Mapping[str, Any]) -> None:
        file = self.folder / RECORD_NAME
        text = json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False) + "\n"
        try:
            replace_whole(file, text.encode())
        except OSError as error:
            raise explain_disk_error(error, file) from error


@contextlib.contextmanager
def drive_sweep(folder: Path) -> Iterator[None]:
    """Be the one process that drives a sweep; the system frees it when the process dies.

    Raises ConfigurationError if another process drives it.
    """
    try:
        import fcntl
    except ImportError:  # a system without these locks
        yield
        return
    file = folder / LOCK_NAME
    try:
        descriptor = os.open(file, os.O_RDWR | os.O_CREAT, 0o644)
    except OSError as error:
        raise explain_disk_error(error, file) from error
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            who = os.read(descriptor, 300).decode(errors="replace").strip()
            raise ConfigurationError(
                f"another process drives this sweep{f' ({who})' if who else ''}",
                where=str(folder),
                remedy="wait for it (`trms watch FOLDER`), or end it first",
            ) from None
        except OSError:
            pass  # a file system without locks: nothing better can be had there
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, f"process {os.getpid()} on {platform.node()}".encode(), 0)
        yield
    finally:
        os.close(descriptor)


def explain_disk_error(error: OSError, file: Path) -> RecordingError:
    """A disk that does not take what is written, in words."""
    return RecordingError(
        f"cannot write {str(file)!r}: {error.strerror or error}",
        where=str(file.parent),
        remedy=f"free space or mend the permissions, then go on: trms sweep resume {file.parent}",
    )


def _space(document: Mapping[str, Any]) -> Space:
    continuous = tuple(
        PriorOfKey(**each) if "mean" in each else Range(**each) for each in document["continuous"]
    )
    choices = tuple(Choice(each["key"], tuple(each["values"])) for each in document["choices"])
    return Space(tuple(document["fixed"]), choices, continuous)
