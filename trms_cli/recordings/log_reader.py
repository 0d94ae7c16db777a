"""Reads run logs, also those of runs that were killed while writing.

Records are taken from the file one after another up to the last intact one; the summary
at the end, which a killed run lacks, is never needed. Decoding the records is the mcap
library's work; only messages, of which there are tens of thousands, are cut out here.

A chunk of a few kilobytes can unpack to gigabytes. So it is unpacked to the size that it claims and
not further, and the chunks of one log together to no more than a limit.

A log that is being written is followed (:class:`LogTail`): each look takes what is new, and only
that. A record that is not wholly there yet is left for the next look, so that what has been read is
always what :func:`read_log` would read of the file as far as it goes. The file is opened for
reading alone; the run that writes it notices nothing.
"""

import errno
import os
import struct
import zlib
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any, Self

import numpy as np
import orjson
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Header, Metadata, Schema
from mcap.writer import MCAP0_MAGIC

from trms_cli.core import data_file
from trms_cli.core.errors import RecordingError
from trms_cli.core.whole_file import BINARY
from trms_cli.recordings.run_log import RUN_SCHEMA
from trms_cli.recordings.topics import (
    CONFIG_ATTACHMENT,
    RUN_METADATA,
    SCORE_METADATA,
    VIEWER_SCHEMAS,
)

#: Messages of one log that are kept, and what one chunk unpacks to, however small the file is.
USUAL_MOST = 256 * data_file.MEBIBYTE
#: A long run has a large log, which unpacks to some four times its size.
_UNPACKED_TO_FILE = 8
#: All chunks of a log together, of which one is in the memory at a time.
_TOGETHER = 16
#: Numbers in the tables of one log, 8 bytes each. A table of a run is as long as its messages say,
#: but a schema may name any number of columns, and the messages leave them out.
_USUAL_MOST_CELLS = 32 * data_file.MEBIBYTE
#: Memory that a compressor may ask for beside the content.
_WINDOW = 64 * data_file.MEBIBYTE


class TooMuch(ValueError):
    """There is no room for what a log would unpack to."""


def message_limit(size: int = 0) -> int:
    """Bytes of messages that are kept of a log in a file of `size` bytes."""
    return max(data_file.largest(USUAL_MOST), _UNPACKED_TO_FILE * size)


def unpacking_limit(size: int = 0) -> int:
    """Bytes that all chunks of such a log may unpack to, one after another."""
    return _TOGETHER * message_limit(size)


def cell_limit(size: int = 0) -> int:
    """Numbers that the tables of such a log may hold."""
    return max(_USUAL_MOST_CELLS, message_limit(size) // 8)


def content_of(chunk: Chunk, room: int) -> bytes:
    """The records of a chunk, of at most ``room`` bytes; its checksum is the caller's.

    Raises TooMuch if it claims more, and ValueError if it is not what it claims: of another size,
    damaged, of an unknown compression.
    """
    size = chunk.uncompressed_size
    most = min(room, message_limit())
    if size > most:
        raise TooMuch(f"it unpacks to more than {most / data_file.MEBIBYTE:,.0f} MiB")
    if chunk.compression == "zstd":
        data = _unpacked_zstd(chunk.data, size)
    elif chunk.compression == "lz4":
        data = _unpacked_lz4(chunk.data, size)
    elif not chunk.compression:
        data = chunk.data
    else:
        raise ValueError(f"the compression {chunk.compression!r} is not known")
    if len(data) != size:
        raise ValueError(f"a chunk is not of the size that it claims ({size} bytes)")
    return data


def _unpacked_zstd(data: bytes, size: int) -> bytes:
    import zstandard

    unpacker = zstandard.ZstdDecompressor(max_window_size=_WINDOW)
    with unpacker.stream_reader(data) as stream:
        return bytes(stream.read(size + 1))


def _unpacked_lz4(data: bytes, size: int) -> bytes:
    from importlib import import_module

    unpacker: Any = import_module("lz4.frame").LZ4FrameDecompressor()
    return bytes(unpacker.decompress(data, max_length=size + 1))


def damage_of(chunk: Chunk, data: bytes) -> str:
    """A sentence if the content does not fit its checksum; a chunk without one is as it is."""
    if not chunk.uncompressed_crc or zlib.crc32(data) == chunk.uncompressed_crc:
        return ""
    start, end = chunk.message_start_time * 1e-9, chunk.message_end_time * 1e-9
    return f"samples from {start:.3f} to {end:.3f} s are damaged (checksum)"


RECORD = struct.Struct("<BQ")  # opcode, length of what follows
MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
#: Of a file, compressed: some four hours of a run at 50 Hz.
_USUAL_MOST = 512 * data_file.MEBIBYTE
#: Bytes that a message takes in the memory at least, however short it is.
_LEAST_MESSAGE = 64
_EMPTY_RUN = "it holds no sample: the run ended before its first flush"


@dataclass(frozen=True)
class TopicTable:
    """The messages of a topic as columns."""

    time: np.ndarray  #: (n,) float array [s]; log time
    time_ns: np.ndarray  #: (n,) int array [ns]; the same, exactly as written
    #: dict of str to (n,) array; floats (NaN for null) for numbers and truth values; objects for
    #: text; objects that are float arrays for array fields
    columns: dict[str, np.ndarray]
    units: dict[str, str]  #: SI unit per column; "" for text

    def __len__(self) -> int:
        return len(self.time)

    def last_values(self, times_ns: np.ndarray) -> dict[str, np.ndarray]:
        """Columns of numbers at some times [ns], the last value held; NaN before the first."""
        latest = np.searchsorted(self.time_ns, times_ns, side="right") - 1
        return {
            name: np.where(latest >= 0, column[np.maximum(latest, 0)], np.nan)
            for name, column in self.columns.items()
            if column.dtype == float
        }


@dataclass(frozen=True)
class LoggedRun:
    """What a log holds."""

    path: Path  #: The file
    complete: bool  #: The file was finished and is undamaged. False for a run that died.
    #: "completed", "interrupted", "landed" or "failed"; "died" when the run left no last word
    outcome: str
    tables: dict[str, TopicTable]  #: By topic
    run: dict[str, str]  #: The last ``trms.run`` record
    #: dict of str to anything; the last ``trms.score`` record; empty when the run was not scored
    score: dict[str, Any]
    attachments: dict[str, bytes]  #: By name
    problems: tuple[str, ...] = ()  #: What is missing or damaged, as sentences

    @property
    def config(self) -> str:
        """The resolved config as YAML; empty when the log has none."""
        return self.attachments.get(CONFIG_ATTACHMENT, b"").decode(errors="replace")

    @property
    def duration_s(self) -> float:
        """From the first sample to the end of the last one's interval, without the landing [s].

        The interval is that of the topic sampled most often: 0, 0.02, …, 79.98 s are 80 s.
        """
        aside = ("/event", "/landing")
        tables = [t for name, t in self.tables.items() if name not in aside and len(t)]
        if not tables:
            return 0.0
        start = min(int(t.time_ns[0]) for t in tables)
        end = max(int(t.time_ns[-1]) for t in tables)
        densest = max(tables, key=len)
        interval = int(np.median(np.diff(densest.time_ns))) if len(densest) > 1 else 0
        return (end - start + interval) / 1e9

    def table(self, topic: str) -> TopicTable:
        """Return a topic's table, or raise RecordingError naming the topics there are."""
        if topic not in self.tables:
            raise RecordingError(
                f"the log has no {topic}",
                where=str(self.path),
                remedy=f"it has {', '.join(self.tables) or 'no topics at all'}",
            )
        return self.tables[topic]


#: Given a topic and a column of it: whether the column is wanted.
Wanted = Callable[[str, str], bool]


@dataclass
class _Rows:
    """Messages of a channel that are not decoded yet."""

    topic: str
    kinds: dict[str, str]  # JSON type of each column that is wanted
    times: list[int] = field(default_factory=list)
    messages: list[bytes] = field(default_factory=list)


class _Content:
    """What the records of a log say, gathered one after another.

    ``wanted``: decides which columns are kept. ``size``: of the file, which limits hang on.
    """

    def __init__(self, wanted: Wanted, size: int = 0) -> None:
        self.library = ""  # names the program that wrote the file
        self.metadata: dict[str, dict[str, str]] = {}  # the last record of each name so far
        self.attachments: dict[str, bytes] = {}
        self.units: dict[str, dict[str, str]] = {}  # of the wanted columns, by topic
        self.finished = False  # the file has its end; nothing comes after it
        self.problems: list[str] = []  # what was damaged, as sentences
        self.topics: dict[int, str] = {}  # of all channels
        self._column_filter, self._size = wanted, size
        self._schemas: dict[int, Schema] = {}
        self._rows: dict[int, _Rows] = {}
        self._published = 0
        #: For each chunk its latest log time and publish time [ns]
        self._progress: list[tuple[int, int]] = []
        self._renew_room()

    @property
    def run(self) -> dict[str, str]:
        """The last `trms.run` record so far."""
        return self.metadata.get(RUN_METADATA, {})

    @property
    def of_trms(self) -> bool:
        """Whether this program wrote the file, as far as has been read."""
        return bool(self.run) or self.library.startswith("trms")

    def take(self, opcode: int, body: memoryview) -> None:
        """Gather a record, or note that it is damaged; raises TooMuch."""
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
                self.metadata[metadata.name] = metadata.metadata
            elif opcode == Opcode.ATTACHMENT:
                attachment = Attachment.read(stream)
                self.attachments[attachment.name] = attachment.data
            elif opcode == Opcode.SCHEMA:
                schema = Schema.read(stream)
                self._schemas[schema.id] = schema
            elif opcode == Opcode.CHANNEL:
                self._add_channel(Channel.read(stream))
        except TooMuch:
            raise
        except Exception as error:  # damage shows as any error of the decoders
            self.problems.append(f"a damaged record was left out ({error})")

    def tables(self, path: Path) -> dict[str, TopicTable]:
        """Decode what has been gathered, and forget it."""
        tables, room = {}, cell_limit(self._size)
        for rows in self._rows.values():
            topic, times, messages = rows.topic, rows.times, rows.messages
            rows.times, rows.messages = [], []
            try:
                room -= len(times) * len(rows.kinds)
                if room < 0:
                    raise ValueError("more numbers than a log of its size has")
                tables[topic] = table_of(times, messages, rows.kinds, self.units[topic])
            except (AttributeError, TypeError, ValueError, OverflowError) as error:
                raise RecordingError(
                    f"the messages of {topic} are not as trms writes them ({error})",
                    where=str(path),
                ) from error
        self._renew_room()
        return tables

    def _renew_room(self) -> None:
        # bytes that chunks may still unpack to, and of messages that may still be kept
        self._room, self._kept_room = unpacking_limit(self._size), message_limit(self._size)

    def _open_chunk(self, chunk: Chunk) -> None:
        data = content_of(chunk, self._room)
        self._room -= len(data)
        damage = damage_of(chunk, data)
        if damage:
            self.problems.append(damage)
            return
        for opcode, body, _ in records(memoryview(data)):
            self.take(opcode, body)
        self._progress.append((chunk.message_end_time, self._published))

    def _add_channel(self, channel: Channel) -> None:
        self.topics[channel.id] = channel.topic
        if channel.message_encoding != "json" or channel.id in self._rows:
            return
        schema = self._schemas[channel.schema_id]
        if schema.name.startswith(VIEWER_SCHEMAS):
            return  # it is there for viewers, and holds no samples
        properties = orjson.loads(schema.data)["properties"]
        columns = {n: p for n, p in properties.items() if self._column_filter(channel.topic, n)}
        if columns:
            self.units[channel.topic] = {n: p.get("unit", "") for n, p in columns.items()}
            kinds = {n: p["type"] for n, p in columns.items()}
            self._rows[channel.id] = _Rows(channel.topic, kinds)

    def _take_message(self, body: memoryview) -> None:
        channel_id, _, log_time, publish_time = MESSAGE.unpack_from(body)
        rows = self._rows.get(channel_id)
        if rows is not None:
            self._kept_room -= max(len(body), _LEAST_MESSAGE)
            if self._kept_room < 0:
                raise TooMuch("its messages take more memory than a log of its size has")
            rows.times.append(log_time)
            rows.messages.append(bytes(body[MESSAGE.size :]))
            self._published = max(self._published, publish_time)


def read_log(path: Path | str, topics: Collection[str] | None = None) -> LoggedRun:
    """Read a run log written by trms, complete or not; only some topics, or all.

    Raises RecordingError when the file cannot be read, is no MCAP file, is of another program or is
    empty.
    """
    path = Path(path)
    data = _read_bytes(path)
    content = _Content(lambda topic, column: topics is None or topic in topics, len(data))
    view = memoryview(data)[len(MCAP0_MAGIC) :]
    try:
        for opcode, body, end in records(view):
            if opcode == Opcode.FOOTER:
                content.finished = view[end:] == MCAP0_MAGIC
                break
            content.take(opcode, body)
    except TooMuch as error:
        remedy = data_file.how_to_raise(2 * message_limit())
        raise RecordingError(str(error), where=str(path), remedy=remedy) from error
    del data, view
    _refuse_newer(content.run, path)
    if not content.of_trms:
        names = ", ".join(sorted(content.topics.values())[:6])
        raise RecordingError(
            f"this MCAP file is of another program ({content.library or 'unnamed'}"
            f"{'; topics ' + names if names else ''})",
            where=str(path),
            remedy="trms reads its own logs; import other recordings from CSV: trms import FILE",
        )
    if not content.finished:
        content.problems.append("the file was not finished: the run died, or it was cut off")
    if not content.topics:
        content.problems.append(_EMPTY_RUN)
    with data_file.not_as_written(str(path)):
        tables = content.tables(path)
    score = content.metadata.get(SCORE_METADATA, {})
    return LoggedRun(
        path=path,
        complete=not content.problems,
        outcome=content.run.get("outcome", "died"),
        tables=tables,
        run=content.run,
        score={key: _json_value(text) for key, text in score.items()},
        attachments=content.attachments,
        problems=tuple(content.problems),
    )


def _refuse_newer(run: Mapping[str, str], path: Path) -> None:
    """What a version to come means by its fields is not known here; older forms are all read."""
    kind, _, number = run.get("schema", "").partition("/")
    known_kind, _, known_version = RUN_SCHEMA.partition("/")
    if kind == known_kind and number.isdecimal() and int(number[:9]) > int(known_version):
        raise RecordingError(
            f"the log is of the form {kind}/{number}, this program reads up to {RUN_SCHEMA}",
            where=str(path),
            remedy="update trms: a newer version wrote it",
        )


def _read_bytes(path: Path) -> bytes:
    data = data_file.recorded_bytes(path, _USUAL_MOST)
    if not data:
        raise RecordingError("the file is empty", where=str(path), remedy="repeat the run")
    if not is_mcap(data, path):
        raise RecordingError(_EMPTY_RUN, where=str(path), remedy="repeat the run")
    return data


def is_mcap(data: bytes, path: Path) -> bool:
    """Whether a file begins as MCAP does; False for one that is cut off before that.

    Raises RecordingError if it begins otherwise.
    """
    if data.startswith(MCAP0_MAGIC):
        return True
    if MCAP0_MAGIC.startswith(data):
        return False
    raise RecordingError(
        "this is not an MCAP file",
        where=str(path),
        remedy="logs of trms end in .mcap; a CSV becomes one by: trms import FILE.csv",
    )


def records(data: memoryview) -> Iterator[tuple[int, memoryview, int]]:
    """Yield (opcode, body, where it ends) of each whole record."""
    position, size = 0, len(data)
    while position + RECORD.size <= size:
        opcode, length = RECORD.unpack_from(data, position)
        start = position + RECORD.size
        if length > size - start:
            return
        position = start + length
        yield opcode, data[start:position], position


def table_of(
    times: Sequence[int],
    messages: Sequence[bytes],
    kinds: Mapping[str, str],
    units: Mapping[str, str],
) -> TopicTable:
    """Messages as columns, in the order of time.

    ``times``: log times, ns. ``messages``: JSON objects. ``kinds``, ``units``: JSON type and SI
    unit of each column that is wanted. Raises ValueError, TypeError, AttributeError or
    OverflowError if the messages are not of this form.
    """
    time_ns = np.array(times, dtype=np.int64)
    rows = orjson.loads(b"[" + b",".join(messages) + b"]")
    if len(rows) != len(time_ns):
        raise ValueError(f"{len(time_ns)} messages hold {len(rows)} values")
    columns = {name: _column([row.get(name) for row in rows], kind) for name, kind in kinds.items()}
    if len(time_ns) > 1 and bool(np.any(np.diff(time_ns) < 0)):
        order = np.argsort(time_ns, kind="stable")
        time_ns = time_ns[order]
        columns = {name: column[order] for name, column in columns.items()}
    # Division, not a product with 1e-9: decimal times then come back exactly.
    return TopicTable(time_ns / 1e9, time_ns, columns, dict(units))


def _column(values: list[Any], json_type: str) -> np.ndarray:
    if json_type in ("number", "integer", "boolean"):
        numbers = np.array(values, dtype=float)  # None becomes NaN
        if numbers.ndim != 1:
            raise ValueError("a list stands where a number belongs")
        return numbers
    column = np.empty(len(values), dtype=object)
    if json_type == "array":
        values = [np.array(() if value is None else value, dtype=float) for value in values]
    for index, value in enumerate(values):  # a slice assignment would stack equal arrays
        column[index] = value
    return column


def _json_value(text: str) -> Any:
    try:
        return orjson.loads(text)
    except orjson.JSONDecodeError:  # written by another tool
        return text


#: Read in one look: some 30 s of a run at 50 Hz, decoded in a few milliseconds.
_AT_ONCE = 2**20  # bytes
#: A record that claims to be longer was not written by a run; nobody waits for its end.
_LONGEST = 2**28  # bytes


@dataclass(frozen=True)
class LogPiece:
    """What one look has found."""

    tables: dict[str, TopicTable]  #: New messages by topic; topics without new ones are absent
    #: For each chunk its latest log time and publish time [ns]: how far the run was by when
    progress: tuple[tuple[int, int], ...] = ()


class LogTail(_Content):
    """A log that may be growing, or be empty yet. Also a context manager: it closes the file.

    ``wanted``: decides which columns are kept, by topic and name; all by default.

    Raises RecordingError when the file cannot be opened, and from :meth:`read` when it is no MCAP
    file.
    """

    def __init__(self, path: Path | str, wanted: Wanted = lambda topic, column: True) -> None:
        super().__init__(wanted)
        self.path = Path(path)
        self._offset = 0
        try:
            self._descriptor = os.open(self.path, os.O_RDONLY | BINARY)
        except FileNotFoundError as error:
            raise data_file.absent(Path(path)) from error
        except OSError as error:
            raise data_file.unreadable(error, self.path) from error

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
        size = 0
        for opcode, body, end in records(memoryview(data)):
            if opcode == Opcode.FOOTER:
                self.finished = data[end : end + len(MCAP0_MAGIC)] == MCAP0_MAGIC
                size = end if self.finished else size
                break
            try:
                self.take(opcode, body)
            except TooMuch as error:
                self.problems.append(f"a record was left out ({error})")
            size = end
        self._offset += size
        if not size:
            return None
        progress, self._progress = tuple(self._progress), []
        tables = {topic: table for topic, table in self.tables(self.path).items() if len(table)}
        return LogPiece(tables, progress)

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
            os.lseek(self._descriptor, self._offset, os.SEEK_SET)
            return os.read(self._descriptor, size)
        except OSError as error:
            raise data_file.unreadable(error, self.path) from error
