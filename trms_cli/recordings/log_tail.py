"""Reads a run log while it is being written: each look takes what is new, and only that.

A record that is not wholly there yet is left for the next look, so that what has been read is
always what :func:`trms_cli.recordings.log_reader.read_log` would read of the file as far as it
goes. The file is opened for reading alone; the run that writes it notices nothing.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Self

import orjson
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Header, Metadata, Schema
from mcap.writer import MCAP0_MAGIC

from trms_cli.core.data_file import unreadable
from trms_cli.core.errors import RecordingError
from trms_cli.recordings.log_reader import (
    MESSAGE,
    RECORD,
    TopicTable,
    content_of,
    damage_of,
    is_mcap,
    most_cells,
    records,
    table_of,
)
from trms_cli.recordings.topics import CONFIG_ATTACHMENT, RUN_METADATA, VIEWER_SCHEMAS

#: Read in one look: some 30 s of a run at 50 Hz, decoded in a few milliseconds.
_AT_ONCE = 2**20  # bytes
#: A record that claims to be longer was not written by a run; nobody waits for its end.
_LONGEST = 2**28  # bytes

#: Given a topic and a column of it: whether the column is wanted.
Wanted = Callable[[str, str], bool]


@dataclass(frozen=True)
class LogPiece:
    """What one look has found."""

    tables: dict[str, TopicTable]  #: New messages by topic; topics without new ones are absent
    #: For each chunk its latest log time and publish time [ns]: how far the run was by when
    written: tuple[tuple[int, int], ...] = ()


@dataclass
class _Rows:
    """Messages of a channel that are not decoded yet."""

    times: list[int] = field(default_factory=list)
    messages: list[bytes] = field(default_factory=list)


class LogTail:
    """A log that may be growing, or be empty yet. Also a context manager: it closes the file.

    ``wanted``: decides which columns are kept, by topic and name; all by default.

    Raises RecordingError when the file cannot be opened, and from :meth:`read` when it is no MCAP
    file.
    """

    def __init__(self, path: Path | str, wanted: Wanted = lambda topic, column: True) -> None:
        self.path = Path(path)
        self.library = ""  # names the program that wrote the file
        self.run: dict[str, str] = {}  # the last `trms.run` record so far
        self.attachments: dict[str, bytes] = {}
        self.units: dict[str, dict[str, str]] = {}  # of the wanted columns, by topic
        self.finished = False  # the file has its end; nothing comes after it
        self.problems: list[str] = []  # what was damaged, as sentences
        self._wanted = wanted
        self._offset = 0
        self._schemas: dict[int, Schema] = {}
        self._kinds: dict[int, tuple[str, dict[str, str]]] = {}  # topic, JSON type by column
        self._rows: dict[int, _Rows] = {}
        self._published = 0
        self._written: list[tuple[int, int]] = []
        try:
            self._descriptor = os.open(self.path, os.O_RDONLY)
        except FileNotFoundError as error:
            raise RecordingError("there is no such file", where=str(path)) from error
        except OSError as error:
            raise unreadable(error, self.path) from error

    @property
    def of_trms(self) -> bool:
        """Whether this program wrote the file, as far as has been read."""
        return bool(self.run) or self.library.startswith("trms")

    @property
    def config(self) -> str:
        """The resolved config as YAML; empty when the log has none (yet)."""
        return self.attachments.get(CONFIG_ATTACHMENT, b"").decode(errors="replace")

    def read(self, at_once: int = _AT_ONCE) -> LogPiece | None:
        """Take the next whole records, some `at_once` bytes of them; None if there are none yet.

        A piece may be without tables: words of the run alone.
        """
        if self.finished:
            return None
        data = self._next_bytes(at_once)
        taken = 0
        for opcode, body, end in records(memoryview(data)):
            if opcode == Opcode.FOOTER:
                self.finished = data[end : end + len(MCAP0_MAGIC)] == MCAP0_MAGIC
                taken = end if self.finished else taken
                break
            self._take(opcode, body)
            taken = end
        self._offset += taken
        if not taken:
            return None
        written, self._written = tuple(self._written), []
        return LogPiece(self._tables(), written)

    def has_writer(self) -> bool | None:
        """Whether a program has the file open for writing; None where the system does not tell.

        The kernel refuses a lease for reading on a file that somebody has open for writing, and
        where it grants one there is no writer who could be disturbed (fcntl(2), F_SETLEASE).
        """
        try:
            import fcntl

            # Not known to systems other than Linux.
            set_lease, read, unlock = fcntl.F_SETLEASE, fcntl.F_RDLCK, fcntl.F_UNLCK
        except (ImportError, AttributeError):
            return None
        try:
            fcntl.fcntl(self._descriptor, set_lease, read)
        except OSError as error:
            return True if error.errno == errno.EAGAIN else None
        fcntl.fcntl(self._descriptor, set_lease, unlock)
        return False

    def close(self) -> None:
        """Close the file; a second call does nothing."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _next_bytes(self, at_once: int) -> bytes:
        """Bytes from the first record that has not been taken; the whole record if it is long."""
        data = self._bytes(max(at_once, 64))
        if self._offset == 0:
            if not is_mcap(data, self.path):
                return b""  # the run has just created it
            self._offset = len(MCAP0_MAGIC)
            data = data[len(MCAP0_MAGIC) :]
        if len(data) >= RECORD.size:
            whole = RECORD.size + RECORD.unpack_from(data)[1] + len(MCAP0_MAGIC)
            if whole > _LONGEST:
                self.finished = True
                self.problems.append("a damaged record hides what follows it")
                return b""
            if whole > len(data):
                data = self._bytes(whole)
        return data

    def _bytes(self, size: int) -> bytes:
        try:
            return os.pread(self._descriptor, size, self._offset)
        except OSError as error:
            raise unreadable(error, self.path) from error

    def _take(self, opcode: int, body: memoryview) -> None:
        try:
            if opcode == Opcode.MESSAGE:
                self._take_message(body)
                return
            stream = ReadDataStream(BytesIO(body))
            if opcode == Opcode.CHUNK:
                self._open_chunk(Chunk.read(stream))
            elif opcode == Opcode.HEADER:
                self.library = Header.read(stream).library
            elif opcode == Opcode.METADATA:
                metadata = Metadata.read(stream)
                if metadata.name == RUN_METADATA:
                    self.run = metadata.metadata
            elif opcode == Opcode.ATTACHMENT:
                attachment = Attachment.read(stream)
                self.attachments[attachment.name] = attachment.data
            elif opcode == Opcode.SCHEMA:
                schema = Schema.read(stream)
                self._schemas[schema.id] = schema
            elif opcode == Opcode.CHANNEL:
                self._add_channel(Channel.read(stream))
        except Exception as error:  # damage shows as any error of the decoders
            self.problems.append(f"a damaged record was left out ({error})")

    def _open_chunk(self, chunk: Chunk) -> None:
        data = content_of(chunk, _LONGEST)
        damage = damage_of(chunk, data)
        if damage:
            self.problems.append(damage)
            return
        for opcode, body, _ in records(memoryview(data)):
            self._take(opcode, body)
        self._written.append((chunk.message_end_time, self._published))

    def _add_channel(self, channel: Channel) -> None:
        if channel.message_encoding != "json" or channel.id in self._kinds:
            return
        schema = self._schemas[channel.schema_id]
        if schema.name.startswith(VIEWER_SCHEMAS):
            return  # it is there for viewers, and holds no samples
        properties = orjson.loads(schema.data)["properties"]
        wanted = {n: p for n, p in properties.items() if self._wanted(channel.topic, n)}
        if wanted:
            self.units[channel.topic] = {n: p.get("unit", "") for n, p in wanted.items()}
            self._kinds[channel.id] = channel.topic, {n: p["type"] for n, p in wanted.items()}
            self._rows[channel.id] = _Rows()

    def _take_message(self, body: memoryview) -> None:
        channel_id, _, log_time, publish_time = MESSAGE.unpack_from(body)
        rows = self._rows.get(channel_id)
        if rows is not None:
            rows.times.append(log_time)
            rows.messages.append(bytes(body[MESSAGE.size :]))
            self._published = max(self._published, publish_time)

    def _tables(self) -> dict[str, TopicTable]:
        """Decode what has been gathered, and forget it."""
        tables = {}
        for channel_id, rows in self._rows.items():
            if not rows.times:
                continue
            topic, kinds = self._kinds[channel_id]
            try:
                if len(rows.times) * len(kinds) > most_cells():
                    raise ValueError(f"more than {most_cells()} numbers at once")
                tables[topic] = table_of(rows.times, rows.messages, kinds, self.units[topic])
            except (AttributeError, TypeError, ValueError, OverflowError) as error:
                raise RecordingError(
                    f"the messages of {topic} are not as trms writes them ({error})",
                    where=str(self.path),
                ) from error
            finally:
                self._rows[channel_id] = _Rows()
        return tables
