"""The database of runs: a table of logs, and a row of figures for each that is a run.

SQLite of the standard library, in one file (:mod:`~trms_cli.runs.place`). All of it comes from
the logs, so that a file which is damaged, or of another version, is made anew. Several processes
may read and write it at once: they hold no lock while they read logs, write in short
transactions, and what two of them write of the same log is the same.
"""

from __future__ import annotations

import json
import os
import sqlite3
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec

from trms_cli.core.errors import RecordingError
from trms_cli.runs.columns import COLUMNS, IndexColumn, Sql
from trms_cli.runs.entry import IndexEntry

if TYPE_CHECKING:
    from trms_cli.runs.configurations import BaseConfiguration

_TYPES = {"text": "TEXT", "number": "REAL", "whole": "INTEGER", "truth": "INTEGER"}
_LOGS = (
    "CREATE TABLE IF NOT EXISTS logs (log TEXT PRIMARY KEY, mtime_ns INTEGER, size INTEGER,"
    " kind TEXT, problem TEXT) WITHOUT ROWID"
)
_RUNS = (
    "CREATE TABLE IF NOT EXISTS runs ("
    + ", ".join(f'"{column.name}" {_TYPES[column.kind]}' for column in COLUMNS.values())
    + ", typed TEXT, more TEXT, units TEXT, words TEXT, PRIMARY KEY (log))"
)
#: Folders of runs as they were looked through: one that has not changed holds the same files.
_FOLDERS = (
    "CREATE TABLE IF NOT EXISTS folders (folder TEXT PRIMARY KEY, mtime_ns INTEGER) WITHOUT ROWID"
)
#: Coordinates, and the first configuration that had them.
_BASES = (
    "CREATE TABLE IF NOT EXISTS bases"
    " (number INTEGER PRIMARY KEY, coordinates TEXT UNIQUE, config TEXT)"
)
#: Changes with the columns, and with what is put into them.
_CONTENT = 4
_VERSION = zlib.crc32(f"{_CONTENT} {_LOGS} {_RUNS} {_BASES}".encode()) & 0x7FFFFFFF
_PATIENCE = 20.0  # s, for another process that is writing

#: What a file is: a run, a log of something else, or one that cannot be read; or not yet looked at.
RUN, OTHER, UNREADABLE, UNSEEN = "run", "other", "unreadable", "unseen"

#: Rows after which it shows which texts most runs share.
_MANY = 1000
_ALL = Sql("1")  # holds for every run


class FileStamp(NamedTuple):
    """What is known of a log's file."""

    #: ``mtime_ns``, ``size``: When it was looked at; another time or size means that it has
    #: changed. ns, bytes.
    mtime_ns: int
    size: int


@dataclass(frozen=True)
class LogReading:
    """A log that has been looked at."""

    log: str  #: Its absolute path
    stamp: FileStamp
    entry: IndexEntry | None = None  #: None for what is no run
    problem: str = ""  #: Why it cannot be read; "" if it can

    @property
    def kind(self) -> str:
        """``run``, ``other`` or ``unreadable``."""
        return UNREADABLE if self.problem else RUN if self.entry else OTHER


class Row(Mapping[str, Any]):
    """A run's values by their columns: ``cells`` at the ``places`` of their names."""

    __slots__ = ("cells", "places")

    def __init__(self, places: Mapping[str, int], cells: tuple[Any, ...]) -> None:
        self.places, self.cells = places, cells

    def __getitem__(self, name: str) -> Any:
        return self.cells[self.places[name]]

    def get(self, name: str, default: Any = None) -> Any:
        """The value of a column, or what else is said."""
        place = self.places.get(name)
        return default if place is None else self.cells[place]

    def __contains__(self, name: object) -> bool:
        return name in self.places

    def __iter__(self) -> Iterator[str]:
        return iter(self.places)

    def __len__(self) -> int:
        return len(self.places)


class Rows(Sequence[Row]):
    """Runs of one answer, hundreds of thousands: a tuple of cells each, in the order of names."""

    def __init__(self, places: Mapping[str, int], cells: list[tuple[Any, ...]]) -> None:
        self.places, self.cells = places, cells

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return Rows(self.places, self.cells[index])
        return Row(self.places, self.cells[index])

    def __iter__(self) -> Iterator[Row]:
        return (Row(self.places, cells) for cells in self.cells)

    def __len__(self) -> int:
        return len(self.cells)


def column_of(rows: Sequence[Mapping[str, Any]], name: str) -> list[Any]:
    """The values of a column, None for runs without."""
    if not isinstance(rows, Rows):
        return [row.get(name) for row in rows]
    place = rows.places.get(name)
    return [None] * len(rows) if place is None else [cells[place] for cells in rows.cells]


class RunIndex:
    """The open index, in a file that is made if it is not there; None: in memory, of this process.

    Raises OSError or sqlite3.OperationalError if the file cannot be opened or made.
    """

    def __init__(self, file: Path | None) -> None:
        self.file = file
        self._bases: dict[str, BaseConfiguration] = {}
        if file is not None:
            file.parent.mkdir(parents=True, exist_ok=True)
        try:
            self._open()
        except sqlite3.DatabaseError as error:
            self._connection.close()
            if file is None or not is_damage(error):
                raise
            remove(file)
            self._open()

    def _open(self) -> None:
        name = ":memory:" if self.file is None else str(self.file)
        self._connection = sqlite3.connect(name, timeout=_PATIENCE, isolation_level=None)
        # of a new file: most questions go through all rows, which are two kilobytes each
        self._connection.execute("PRAGMA page_size = 16384")
        self._connection.execute("PRAGMA journal_mode = WAL")
        self._connection.execute("PRAGMA synchronous = NORMAL")
        if self._version() != _VERSION:
            with self._writing():
                if self._version() != _VERSION:  # nobody else was faster
                    self._connection.execute(_LOGS)
                    # The paths stay: what was run elsewhere is read again, not forgotten.
                    self._connection.execute("UPDATE logs SET mtime_ns = -1, kind = 'unseen'")
                    self._connection.execute("DROP TABLE IF EXISTS runs")
                    self._connection.execute(_RUNS)
                    self._connection.execute("DROP TABLE IF EXISTS bases")
                    self._connection.execute(_BASES)
                    self._connection.execute(_FOLDERS)
                    self._connection.execute(f"PRAGMA user_version = {_VERSION}")
        with self._writing():  # a file that cannot be written is told now
            self._connection.execute("SELECT 1 FROM runs, logs LIMIT 1").fetchall()

    def _version(self) -> int:
        return int(self._connection.execute("PRAGMA user_version").fetchone()[0])

    def close(self) -> None:
        """Close it; a second call does nothing."""
        self._connection.close()

    def __enter__(self) -> RunIndex:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @contextmanager
    def _writing(self) -> Iterator[None]:
        self._connection.execute("BEGIN IMMEDIATE")
        try:
            yield
        except BaseException:
            with suppress(sqlite3.Error):
                self._connection.execute("ROLLBACK")
            raise
        self._connection.execute("COMMIT")

    def stamps(self, roots: Sequence[str] | None) -> dict[str, FileStamp]:
        """The logs under folders (None: all) that the index has, and when they were looked at."""
        scope = scope_sql(roots)
        rows = self._connection.execute(
            f"SELECT log, mtime_ns, size FROM logs WHERE {scope.text}", scope.values
        )
        return {log: FileStamp(mtime_ns, size) for log, mtime_ns, size in rows}

    def folders(self, roots: Sequence[str] | None) -> dict[str, int]:
        """Folders of runs under folders (None: all), and when they had last changed, ns."""
        scope = scope_sql(roots)
        rows = self._connection.execute(
            f"SELECT folder, mtime_ns FROM folders WHERE {scope.text.replace('log', 'folder')}",
            scope.values,
        )
        return dict(rows)

    def note_folders(self, folders: Mapping[str, int]) -> None:
        """Note when folders of runs had last changed before they were looked through, ns."""
        if folders:
            with self._writing():
                self._connection.executemany(
                    "INSERT OR REPLACE INTO folders VALUES (?, ?)", folders.items()
                )

    def expect(self, logs: Iterable[str]) -> None:
        """Note logs that runs have told of; what is known of them already stays."""
        rows = [(log, UNSEEN) for log in logs]
        if rows:
            with self._writing():
                self._connection.executemany(
                    "INSERT OR IGNORE INTO logs VALUES (?, -1, -1, ?, '')", rows
                )

    def put(self, readings: Sequence[LogReading]) -> None:
        """Write what was found out of logs, in place of what was known of them."""
        names = [*COLUMNS, "typed", "more", "units", "words"]
        columns = ", ".join(f'"{name}"' for name in names)
        marks = ", ".join("?" * len(names))
        statement = f"INSERT OR REPLACE INTO runs ({columns}) VALUES ({marks})"
        logs = [(a.log, a.stamp.mtime_ns, a.stamp.size, a.kind, a.problem) for a in readings]
        entries = [a.entry for a in readings if a.entry is not None]
        with self._writing():
            rows = [[*_row(entry), self._words(entry)] for entry in entries]
            self._connection.executemany("DELETE FROM runs WHERE log = ?", [(a[0],) for a in logs])
            self._connection.executemany("INSERT OR REPLACE INTO logs VALUES (?, ?, ?, ?, ?)", logs)
            self._connection.executemany(statement, rows)

    def _words(self, entry: IndexEntry) -> str | None:
        """What a comparison needs of a run, its configuration as what it changes of another's."""
        import yaml

        words = entry.words
        if words is None:
            return None
        coordinates = json.dumps(words.coordinates, ensure_ascii=False)
        try:
            base = self._base(coordinates, words.config)
            changes = base.changes(words.config)
        except yaml.YAMLError:
            return None
        parts = [words.state, words.message, words.non_finite, words.seed, base.number, changes]
        return json.dumps(parts, ensure_ascii=False)

    def _base(self, coordinates: str, config: str) -> BaseConfiguration:
        """The configuration that others with such coordinates are held against."""
        from trms_cli.runs.configurations import BaseConfiguration

        if coordinates not in self._bases:
            self._connection.execute(
                "INSERT OR IGNORE INTO bases (coordinates, config) VALUES (?, ?)",
                (coordinates, config),
            )
            number, own = self._connection.execute(
                "SELECT number, config FROM bases WHERE coordinates = ?", (coordinates,)
            ).fetchone()
            self._bases[coordinates] = BaseConfiguration(own, number)
        return self._bases[coordinates]

    def bases(self) -> dict[int, tuple[dict[str, str], dict[str, str]]]:
        """Of each base by its number the coordinates, and the configuration by dotted keys."""
        from trms_cli.runs.configurations import flat_of

        rows = self._connection.execute("SELECT number, coordinates, config FROM bases")
        return {n: (json.loads(coordinates), flat_of(own)) for n, coordinates, own in rows}

    def compared(
        self, figures: Sequence[str], condition: Sql
    ) -> Iterator[tuple[str, str | None, tuple[float | None, ...]]]:
        """Of each run its log, what a comparison needs of it, and some figures by their columns.

        The words are a JSON list: state, message, commands that were not finite, seed, number of
        the base, and what it changes of that; None where the log itself has to be read.
        """
        columns = "".join(f', "{name}"' for name in figures)
        for log, words, *values in self._connection.execute(
            f"SELECT log, words{columns} FROM runs WHERE {condition.text}", condition.values
        ):
            yield log, words, tuple(values)

    def logs(self, condition: Sql) -> list[str]:
        """Logs of the runs for which a condition holds."""
        rows = self._connection.execute(
            f"SELECT log FROM runs WHERE {condition.text}", condition.values
        )
        return [log for (log,) in rows]

    def groups(self, columns: Sequence[str], condition: Sql) -> list[tuple[Any, ...]]:
        """Each combination of values of columns, by their own names, and how many runs have it."""
        names = ", ".join(f'"{COLUMNS[name].name}"' for name in columns)
        return self._connection.execute(
            f"SELECT {names}, count(*) FROM runs WHERE {condition.text} GROUP BY {names}",
            condition.values,
        ).fetchall()

    def others(self, roots: Sequence[str]) -> list[str]:
        """Files under folders that are no runs, or cannot be read."""
        scope = scope_sql(roots)
        rows = self._connection.execute(
            f"SELECT log FROM logs WHERE kind != 'run' AND {scope.text}", scope.values
        )
        return [log for (log,) in rows]

    def forget(self, logs: Iterable[str]) -> None:
        """Take out logs that are gone."""
        rows = [(log,) for log in logs]
        if rows:
            with self._writing():
                self._connection.executemany("DELETE FROM runs WHERE log = ?", rows)
                self._connection.executemany("DELETE FROM logs WHERE log = ?", rows)

    def doubt(self, roots: Sequence[str] | None) -> None:
        """Have every log under folders (None: all) read again, whether it has changed or not.

        What is known of it stays until then: others may be asking meanwhile.
        """
        scope = scope_sql(roots)
        with self._writing():
            self._connection.execute(
                f"UPDATE logs SET mtime_ns = -1 WHERE {scope.text}", scope.values
            )

    def more_names(self, condition: Sql = _ALL) -> list[str]:
        """Figures beside the columns, by name, that some runs have for which a condition holds."""
        rows = self._connection.execute(
            f"SELECT more FROM runs WHERE {condition.text}", condition.values
        )
        # a third of the time that SQLite's json_each takes
        names: set[str] = set()
        for (text,) in rows:
            names.update(msgspec.json.decode(text or "{}", type=dict[str, msgspec.Raw]))
        return sorted(names)

    def units(self, condition: Sql) -> dict[str, str]:
        """Units of figures, where they are not those of the columns; "" where they differ.

        A column of all rigs has another unit where every run that has a figure in it does.
        """
        rows = self._connection.execute(
            "SELECT j.key, j.value, count(*) FROM"
            f" (SELECT units FROM runs WHERE {condition.text}) AS r, json_each(r.units) AS j"
            " GROUP BY j.key, j.value",
            condition.values,
        ).fetchall()
        units: dict[str, str] = {}
        for name, unit, count in rows:
            own = Sql(f'"{name}" IS NOT NULL AND {condition.text}', condition.values)
            whole = name not in COLUMNS or count == self.count(own)
            units[name] = unit if whole and name not in units else ""
        return units

    def count(self, condition: Sql) -> int:
        """The number of runs for which a condition holds.

        Raises RecordingError if the database refuses: a filter that is too large for it.
        """
        statement = f"SELECT count(*) FROM runs WHERE {condition.text}"
        try:
            return int(self._connection.execute(statement, condition.values).fetchone()[0])
        except sqlite3.OperationalError as error:
            raise _query_error(error) from error

    def select(
        self,
        columns: Mapping[str, tuple[IndexColumn, Sql]],
        condition: Sql,
        order: Sql,
        *,
        descending: bool,
        limit: int | None,
        compact: bool = False,
    ) -> Sequence[Any]:
        """Rows with the columns asked for; None for what a run does not have, always last.

        ``compact``: as :class:`Rows` and not as dicts, for hundreds of thousands. Raises
        RecordingError if the database refuses: a filter that is too large for it.
        """
        # Positions instead of names: a name is whatever was typed.
        selection = ", ".join(f"{sql.text} AS c{i}" for i, (_, sql) in enumerate(columns.values()))
        direction = "DESC" if descending else "ASC"
        values = [value for _, sql in columns.values() for value in sql.values]
        values += [*condition.values, *order.values, *order.values]
        statement = (
            f"SELECT {selection} FROM runs WHERE {condition.text}"
            f" ORDER BY {order.text} IS NULL, {order.text} {direction}, time {direction},"
            f" log {direction}"
        )
        if limit is not None:  # SQLite sorts by another way with one, slower for a whole answer
            statement, values = f"{statement} LIMIT ?", [*values, limit]
        try:
            rows = self._connection.execute(statement, values)
            kinds = [column.kind for column, _ in columns.values()]
            truths = [place for place, kind in enumerate(kinds) if kind == "truth"]
            # Of texts that most runs share one copy is kept.
            texts: dict[int, dict[str, str]] = {
                place: {} for place, kind in enumerate(kinds) if compact and kind in ("text", "any")
            }
            made: list[tuple[Any, ...]] = []
            for number, row in enumerate(rows):
                if number == _MANY:
                    texts = {place: own for place, own in texts.items() if len(own) < _MANY / 2}
                values = list(row)
                for place in truths:
                    if values[place] is not None:
                        values[place] = bool(values[place])
                for place, own in texts.items():
                    if isinstance(value := values[place], str):
                        values[place] = own.setdefault(value, value)
                made.append(tuple(values))
            if compact:
                return Rows({name: place for place, name in enumerate(columns)}, made)
            return [dict(zip(columns, values, strict=True)) for values in made]
        except sqlite3.OperationalError as error:
            raise _query_error(error) from error

    def unreadable(self, roots: Sequence[str] | None) -> list[tuple[str, str]]:
        """Logs under folders that cannot be read, with the reason."""
        scope = scope_sql(roots)
        rows = self._connection.execute(
            "SELECT log, problem FROM logs"
            f" WHERE kind = 'unreadable' AND {scope.text} ORDER BY log",
            scope.values,
        )
        return [(log, problem) for log, problem in rows]


def _query_error(error: sqlite3.Error) -> RecordingError:
    return RecordingError(
        f"the index does not answer ({error})", where="trms runs", remedy="ask for less"
    )


def is_damage(error: sqlite3.Error) -> bool:
    """Whether the file is no database, or a damaged one: it is made anew from the logs."""
    return getattr(error, "sqlite_errorcode", 0) & 0xFF in (
        sqlite3.SQLITE_CORRUPT,
        sqlite3.SQLITE_NOTADB,
    )


def remove(file: Path) -> None:
    """Delete a database with what it keeps beside its file."""
    for name in (file, f"{file}-wal", f"{file}-shm"):
        Path(name).unlink(missing_ok=True)


def scope_sql(roots: Sequence[str] | None) -> Sql:
    """The condition that a log lies in one of some folders, or is one of them; None: any."""
    if roots is None:
        return Sql("1")
    parts, values = [], []
    for root in roots:
        stem = root.rstrip(os.sep)
        # between "folder/" and the character after the slash: the key's own order finds them
        parts.append("(log = ? OR (log >= ? AND log < ?))")
        values += [root, f"{stem}/", f"{stem}0"]
    return Sql(f"({' OR '.join(parts) or '0'})", tuple(values))


def _row(entry: IndexEntry) -> list[Any]:
    parts = (entry.typed, entry.more, entry.units)
    texts = [json.dumps(part, ensure_ascii=False) for part in parts]
    return [entry.values.get(name) for name in COLUMNS] + texts
