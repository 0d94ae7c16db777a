"""The record of a sweep in its folder, written before its first run, so that it can be resumed.

``sweep.json`` (``trms.sweep/1``) holds what was asked for, ``points.jsonl`` a line for each point
that was proposed, written before a worker gets it. ``.lock`` is held by the process that drives
the sweep; ``.stop`` asks its workers to end.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import platform
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from trms_cli.core.errors import ConfigurationError, RecordingError
from trms_cli.core.whole_file import replace_whole
from trms_cli.runs.driving import LOCK_NAME
from trms_cli.sweeps.space import Choice, PriorOfKey, Range, Space, SweepPoint
from trms_cli.sweeps.status import now

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
        document = {"schema": SCHEMA, **asdict(plan), "state": "running", "begin": now()}
        self._write(document)

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
            raise explained(error, file) from error

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
        found = []
        for number, line in enumerate(whole.splitlines()):
            try:
                told = json.loads(line)
                point = SweepPoint(
                    int(told["number"]),
                    tuple(map(str, told["overrides"])),
                    dict(told["values"]),
                    told["trial"],
                )
                if point.number != number:
                    raise ValueError(f"point {point.number}")
            except (ValueError, KeyError, TypeError) as error:
                raise RecordingError(
                    f"no point number {number} ({error})",
                    where=f"{file}, line {number + 1}",
                    remedy="points are numbered from 0 without gaps; make the sweep anew",
                ) from error
            found.append(point)
        return found

    def _write(self, document: Mapping[str, Any]) -> None:
        file = self.folder / RECORD_NAME
        text = json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False) + "\n"
        try:
            replace_whole(file, text.encode())
        except OSError as error:
            raise explained(error, file) from error


@contextlib.contextmanager
def driving(folder: Path) -> Iterator[None]:
    """Be the one process that drives a sweep; the system frees it when the process dies.

    Raises ConfigurationError if another process drives it.
    """
    file = folder / LOCK_NAME
    try:
        descriptor = os.open(file, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    except OSError as error:
        raise explained(error, file) from error
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


def explained(error: OSError, file: Path) -> RecordingError:
    """A disk that does not take what is written, in words."""
    return RecordingError(
        f"cannot write {str(file)!r}: {error.strerror or error}",
        where=str(file.parent),
        remedy=f"free space or mend the permissions, then go on: trms sweep resume {file.parent}",
    )


def _space(told: Mapping[str, Any]) -> Space:
    continuous = tuple(
        PriorOfKey(**each) if "mean" in each else Range(**each) for each in told["continuous"]
    )
    choices = tuple(Choice(each["key"], tuple(each["values"])) for each in told["choices"])
    return Space(tuple(told["fixed"]), choices, continuous)
