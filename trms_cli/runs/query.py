"""Brings the index up to date with the folders, and asks it.

A folder is looked through for logs (``*.mcap``), however deep, and for jobs of sweeps that left
none. Those that are new, or whose time or size has changed, are read; those that are gone are
taken out. So runs that were copied in, moved, deleted or killed are right without anybody having
told of them.
"""

import contextlib
import os
import sqlite3
import stat
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from trms_cli.core.errors import ConfigurationError, RecordingError
from trms_cli.recordings.log_head import read_log_head
from trms_cli.runs.columns import IndexColumn, Sql, column_sql, expanded, nearest
from trms_cli.runs.entry import LOG_NAME, STATUS_NAME, read_entry, read_status
from trms_cli.runs.filter import translate_filter
from trms_cli.runs.index import FileStamp, LogReading, RunIndex, is_damage, remove, scope_sql
from trms_cli.runs.place import ENVIRONMENT, index_file, new_runs
from trms_cli.runs.run_folder import SCORE_NAME

_BATCH = 200  # logs between two writes
#: Entries of the working folder that are looked at when no folder is named: about a second.
MOST_ENTRIES = 200_000
_SUFFIX = ".mcap"
#: Folders in which nobody keeps runs, and which hold many files.
_PASSED_OVER = frozenset({"__pycache__", "node_modules", "site-packages"})

Tell = Callable[[int, int], None]


@dataclass(frozen=True, kw_only=True)
class Query:
    """What is asked of the index."""

    filter: str = ""  #: :mod:`~trms_cli.runs.filter`; empty: every run
    folders: tuple[str | os.PathLike[str], ...] = ()  #: Where to look; empty: the working folder
    everywhere: bool = False  #: Every run that this host knows of, instead
    sort: str = "time"  #: A column
    descending: bool = True  #: Largest, or latest, first
    #: Empty: all, as by "*"; "rmse_*" for those of other channels than the twin rotor's
    columns: tuple[str, ...] = ()
    limit: int | None = None  #: Runs at most
    rebuild: bool = False  #: Read every log again
    refresh: bool = True  #: Read logs that are new first; False answers from what is known
    compact: bool = False  #: Rows that take little room, :class:`~trms_cli.runs.index.Rows`


@dataclass(frozen=True)
class QueryResult:
    """The answer."""

    #: A run each: values by column, None for what it does not have
    runs: Sequence[Any]
    columns: dict[str, IndexColumn]  #: As asked for, by the names that they were asked for by
    matching: int  #: Runs for which the filter holds, also those beyond the limit
    of: int  #: Runs in the folders
    folders: tuple[str, ...]  #: That were looked through; empty for everywhere
    unreadable: tuple[tuple[str, str], ...]  #: Logs that could not be read, with the reason
    remarks: tuple[str, ...] = ()  #: What limits the answer, as sentences


@dataclass
class _Walk:
    """What a walk through folders has found."""

    logs: dict[str, FileStamp] = field(default_factory=dict)
    #: Folders of scores alone, without a log or a status
    scores: list[str] = field(default_factory=list)
    known: dict[str, int] = field(default_factory=dict)  # folders as the index has them, ns
    members: dict[str, list[str]] = field(default_factory=dict)  # and the logs in them
    folders: dict[str, int] = field(default_factory=dict)  # folders that may be passed next time
    odd: list[tuple[str, str]] = field(default_factory=list)
    remaining: int | None = None  # entries that may still be looked at
    remarks: list[str] = field(default_factory=list)


def find(question: Query, tell: Tell = lambda count, of: None) -> QueryResult:
    """Bring the index up to date, and ask it.

    `tell` is called with the number of logs read and of those to be read. Raises FilterError if the
    filter cannot be used, ConfigurationError if a folder or column does not exist.
    """
    try:
        return _find(question, tell)
    except sqlite3.DatabaseError as error:
        if not is_damage(error):
            raise
        remove(index_file())
        return _find(question, tell)


def _find(question: Query, tell: Tell) -> QueryResult:
    # What is misspelt is told before logs are read.
    translate_filter(question.filter, None)
    for name in (*question.columns, question.sort):
        if name.endswith("*"):
            continue
        _column(name, None, "--sort" if name == question.sort else "--columns")
    roots = None if question.everywhere else [_folder(folder) for folder in question.folders]
    bounded = roots == []
    if bounded:
        roots = [_folder(os.curdir)]
    remaining = MOST_ENTRIES if bounded else None
    with current_index(
        roots, tell, remaining, rebuild=question.rebuild, update=question.refresh
    ) as (index, walk):
        scope = scope_sql(roots)
        asked = question.columns or ("*",)
        of_these = index.more_names(scope) if any(name.endswith("*") for name in asked) else ()
        # Figures beside the columns are looked for in all runs, which takes as long as a listing,
        # where one is named that is not known.
        plain = [name for name in (*asked, question.sort) if not name.endswith("*")]
        is_known = not question.filter and all(column_sql(name, ()) for name in plain)
        more = of_these if is_known else index.more_names()
        condition = translate_filter(question.filter, more)
        within = Sql(f"({condition.text}) AND {scope.text}", condition.values + scope.values)
        columns = {name: _column(name, more, "--columns") for name in expanded(asked, of_these)}
        units = index.units(within)
        _, order = _column(question.sort, more, "--sort")
        runs = index.select(
            columns,
            within,
            order,
            descending=question.descending,
            limit=question.limit,
            compact=question.compact,
        )
        return QueryResult(
            runs=runs,
            columns={
                name: replace(column, unit=units.get(column.name, column.unit))
                for name, (column, _) in columns.items()
            },
            matching=index.count(within),
            of=index.count(scope),
            folders=tuple(roots or ()),
            unreadable=tuple(sorted([*index.unreadable(roots), *walk.odd])),
            remarks=tuple(walk.remarks),
        )


@contextlib.contextmanager
def current_index(
    roots: Sequence[str] | None,
    tell: Tell | None = None,
    remaining: int | None = None,
    *,
    rebuild: bool = False,
    update: bool = True,
) -> Iterator[tuple[RunIndex, _Walk]]:
    """The index of this host, up to date with folders (real paths; None: all that it knows of).

    Without `update` as it is, unless it is kept in no file.
    """
    walk = _Walk(remaining=remaining)
    with _open_index(walk.remarks) as index:
        if not update and index.file is not None:
            yield index, walk
            return
        for paths in new_runs():
            index.expect(paths)
        if rebuild:
            index.doubt(roots)
        refresh(index, roots, walk, tell)
        yield index, walk


@dataclass(frozen=True)
class Inventory:
    """All runs in folders, and how many there are of each value of some columns."""

    logs: tuple[str, ...]  #: Of each run, by its absolute path, or the status of a job without one
    counts: dict[str, dict[str, int]]  #: By column and value, the most frequent first


def inventory(folders: Sequence[str | os.PathLike[str]], columns: Sequence[str]) -> Inventory:
    """The runs of the index in folders (none named: all that it knows of), as it is.

    `columns`: of texts, by their own names. Raises ConfigurationError if a folder does not exist.
    """
    roots = [_folder(folder) for folder in folders] or None
    with current_index(roots, update=False) as (index, _):
        scope = scope_sql(roots)
        counts: dict[str, Counter[str]] = {name: Counter() for name in columns}
        for *values, amount in index.groups(columns, scope):
            for name, value in zip(columns, values, strict=True):
                if value:
                    counts[name][str(value)] += amount
        return Inventory(
            tuple(index.logs(scope)), {name: dict(c.most_common()) for name, c in counts.items()}
        )


def take_in(logs: Sequence[str]) -> None:
    """Read logs that have just been written into the index of this host.

    Nothing happens where runs do not tell of themselves (``TRMS_RUNS=off``), or the index cannot be
    written: whoever lists the runs reads the logs then.
    """
    if os.environ.get(ENVIRONMENT) == "off":
        return
    with contextlib.suppress(OSError, sqlite3.Error, RecordingError), _open_index([]) as index:
        stamps = {log: stamp for log in logs if (stamp := _stamp_of(log)) is not None}
        index.put([_look(log, stamp) for log, stamp in stamps.items()])


def refresh(
    index: RunIndex,
    roots: Sequence[str] | None,
    walk: _Walk | None = None,
    tell: Tell | None = None,
) -> None:
    """Make the index say of folders what lies in them; None: of all logs that it knows."""
    walk = walk or _Walk()
    earlier_stamps = index.stamps(roots)
    walk.known = index.folders(roots)
    for log in earlier_stamps:
        folder = log.rpartition(os.sep)[0]
        if folder in walk.known:
            walk.members.setdefault(folder, []).append(log)
    for root in roots or ():
        _look_through(root, walk)
    index.note_folders(walk.folders)
    stamps, absent_logs = walk.logs, []
    for log in earlier_stamps.keys() - stamps.keys():  # in folders that were passed over, or gone
        stamp = _stamp_of(log)
        if stamp is None:
            absent_logs.append(log)
        else:
            stamps[log] = stamp
    changed = sorted(log for log, stamp in stamps.items() if earlier_stamps.get(log) != stamp)
    batch: list[LogReading] = []
    for count, log in enumerate(changed):
        if tell is not None:
            tell(count, len(changed))
        batch.append(_look(log, stamps[log]))
        if len(batch) == _BATCH:
            index.put(batch)
            batch = []
    if batch:
        index.put(batch)
    index.forget(log for log in absent_logs if _stamp_of(log) is None)


def _look(log: str, stamp: FileStamp) -> LogReading:
    try:
        read = read_status if os.path.basename(log) == STATUS_NAME else read_entry
        return LogReading(log, stamp, read(Path(log)))
    except RecordingError as error:
        return LogReading(log, stamp, problem=error.problem or "it cannot be read")


def _look_through(root: str, walk: _Walk) -> None:
    """Find the logs in a folder, or the one that it is."""
    if os.path.isfile(root):
        stamp = _stamp_of(root)
        if stamp is not None:
            walk.logs[root] = stamp
        return
    waiting = [root]
    while waiting:
        folder = waiting.pop()
        with contextlib.suppress(OSError):  # a folder of somebody else
            if not _is_as_known(folder, walk) and not _look_into(folder, waiting, walk, root):
                return


#: ns: a folder that has changed so shortly before it was looked through is looked through again,
#: since a file that came in the same tick of the disk's clock would not show.
_SETTLED = 60 * 10**9


def _is_as_known(folder: str, walk: _Walk) -> bool:
    """Take the logs of a folder of runs in which no file has come or gone since."""
    known = walk.known.get(folder)
    if known is None or folder not in walk.members or os.stat(folder).st_mtime_ns != known:
        return False
    for log in walk.members[folder]:
        stamp = _stamp_of(log)
        if stamp is not None:
            walk.logs[log] = stamp
    return True


def _look_into(folder: str, waiting: list[str], walk: _Walk, root: str) -> bool:
    """Take the logs of a folder; False where no more may be looked at."""
    changed, now = os.stat(folder).st_mtime_ns, time.time_ns()
    logs: list[str] = []
    names: set[str] = set()
    is_leaf = True
    with os.scandir(folder) as entries:
        for entry in entries:
            if walk.remaining is not None:
                walk.remaining -= 1
                if walk.remaining < 0:
                    walk.remarks.append(
                        f"only {MOST_ENTRIES} files of {root} were looked at: "
                        "name the folder of the runs with --in"
                    )
                    return False
            with contextlib.suppress(OSError):
                if entry.is_dir(follow_symlinks=False):
                    is_leaf = False
                    if not entry.name.startswith(".") and entry.name not in _PASSED_OVER:
                        waiting.append(entry.path)
                elif entry.name.endswith(_SUFFIX) and not entry.name.startswith("."):
                    if _is_text(entry, walk):
                        logs.append(entry.path)
                else:
                    names.add(entry.name)
    if STATUS_NAME in names and os.path.join(folder, LOG_NAME) not in logs:
        logs.append(os.path.join(folder, STATUS_NAME))
    for log in logs:
        stamp = _stamp_of(log)
        if stamp is not None:
            walk.logs[log] = stamp
    if not logs and SCORE_NAME in names:
        walk.scores.append(folder)
    if is_leaf and logs and now - changed > _SETTLED:
        walk.folders[folder] = changed
    return True


def _is_text(entry: os.DirEntry[str], walk: _Walk) -> bool:
    try:
        entry.path.encode()
    except UnicodeEncodeError:
        name = os.fsencode(entry.path).decode(errors="backslashreplace")
        walk.odd.append((name, "its name is no text"))
        return False
    return True


def logs_in(folder: Path) -> dict[str, FileStamp]:
    """The logs under a folder, as far as the working folder is looked through."""
    walk = _Walk(remaining=MOST_ENTRIES)
    _look_through(str(folder), walk)
    return {log: stamp for log, stamp in walk.logs.items() if log.endswith(_SUFFIX)}


def _stamp_of(log: str) -> FileStamp | None:
    """A file's time and size; None if there is no such file, or its word does not count.

    The status of a job counts only where the job has left no log; beside a log it counts with it.
    """
    folder, _, name = log.rpartition(os.sep)
    try:
        if name == STATUS_NAME and os.path.exists(f"{folder}{os.sep}{LOG_NAME}"):
            return None
        about = os.stat(log)
    except (OSError, ValueError):
        return None
    if not stat.S_ISREG(about.st_mode):
        return None
    if name == LOG_NAME:
        try:
            job = os.stat(f"{folder}{os.sep}{STATUS_NAME}")
        except OSError:  # of no sweep
            return FileStamp(about.st_mtime_ns, about.st_size)
        return FileStamp(max(about.st_mtime_ns, job.st_mtime_ns), about.st_size + job.st_size)
    return FileStamp(about.st_mtime_ns, about.st_size)


def _folder(folder: str | os.PathLike[str]) -> str:
    try:
        path = os.path.realpath(os.path.expanduser(os.fspath(folder)))
        there = os.path.exists(path)
    except (OSError, ValueError):  # the working folder is gone
        there = False
    if not there:
        raise ConfigurationError(
            f"there is no folder {os.fspath(folder)!r}", where="--in", remedy="name one of runs"
        )
    return path


def _column(name: str, more: Sequence[str] | None, where: str) -> tuple[IndexColumn, Sql]:
    entry = column_sql(name, more)
    if entry is None:
        raise ConfigurationError(
            f"there is no column {name!r}", where=where, remedy=nearest(name, more)
        )
    return entry


@contextlib.contextmanager
def _open_index(remarks: list[str]) -> Iterator[RunIndex]:
    """The index of this host, or one for this time where it cannot be kept."""
    file = index_file()
    try:
        index = RunIndex(file)
    except (OSError, sqlite3.OperationalError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        remarks.append(f"the index {file} cannot be kept ({reason}): all logs are read each time")
        index = RunIndex(None)
    with index:
        try:
            yield index
        except sqlite3.OperationalError as error:
            raise RecordingError(
                f"the index cannot be written ({error})",
                where=str(file),
                remedy="try again, or delete the file: it is made anew from the logs",
            ) from error


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
    logs = sorted(((stamp.mtime_ns, log) for log, stamp in logs_in(folder).items()), reverse=True)
    for _, log in logs[:_ASKED]:
        if is_written(log) and _is_run(log):
            return Latest(Path(log), True)
    for _, log in logs:
        if _is_run(log):
            return Latest(Path(log), False)
    return None


def is_written(log: str) -> bool:
    """Whether a log has no end and somebody has it open to write one, as far as can be seen."""
    from trms_cli.recordings.log_reader import LogTail  # loads NumPy

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
