"""Reads run logs, also those of runs that were killed while writing.

Records are taken from the file one after another up to the last intact one; the summary
at the end, which a killed run lacks, is never needed. Decoding the records is the mcap
library's work; only messages, of which there are tens of thousands, are cut out here.

A chunk of a few kilobytes can unpack to gigabytes. So it is unpacked to the size that it claims and
not further, and the chunks of one log together to no more than a limit.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import orjson
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Header, Metadata, Schema
from mcap.writer import MCAP0_MAGIC

from trms_cli.core.data_file import MEBIBYTE, how_to_raise, largest, not_as_written, recorded_bytes
from trms_cli.core.errors import RecordingError
from trms_cli.recordings.run_log import RUN_SCHEMA
from trms_cli.recordings.topics import (
    CONFIG_ATTACHMENT,
    RUN_METADATA,
    SCORE_METADATA,
    VIEWER_SCHEMAS,
)

#: Messages of one log that are kept, and what one chunk unpacks to, however small the file is.
USUAL_MOST = 256 * MEBIBYTE
#: A long run has a large log, which unpacks to some four times its size.
_UNPACKED_TO_FILE = 8
#: All chunks of a log together, of which one is in the memory at a time.
_TOGETHER = 16
#: Numbers in the tables of one log, 8 bytes each. A table of a run is as long as its messages say,
#: but a schema may name any number of columns, and the messages leave them out.
_USUAL_MOST_CELLS = 32 * MEBIBYTE
#: Memory that a compressor may ask for beside the content.
_WINDOW = 64 * MEBIBYTE


class TooMuch(ValueError):
    """There is no room for what a log would unpack to."""


def most_kept(size: int = 0) -> int:
    """Bytes of messages that are kept of a log in a file of `size` bytes."""
    return max(largest(USUAL_MOST), _UNPACKED_TO_FILE * size)


def most_unpacked(size: int = 0) -> int:
    """Bytes that all chunks of such a log may unpack to, one after another."""
    return _TOGETHER * most_kept(size)


def most_cells(size: int = 0) -> int:
    """Numbers that the tables of such a log may hold."""
    return max(_USUAL_MOST_CELLS, most_kept(size) // 8)


def content_of(chunk: Chunk, room: int) -> bytes:
    """The records of a chunk, of at most ``room`` bytes; its checksum is the caller's.

    Raises TooMuch if it claims more, and ValueError if it is not what it claims: of another size,
    damaged, of an unknown compression.
    """
    size = chunk.uncompressed_size
    if size > min(room, most_kept()):
        raise TooMuch(f"it unpacks to more than {min(room, most_kept()) / MEBIBYTE:,.0f} MiB")
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
_USUAL_MOST = 512 * MEBIBYTE
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

    def held(self, times_ns: np.ndarray) -> dict[str, np.ndarray]:
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
    outcome: str  #: "completed", "interrupted" or "failed"; "died" when the run left no last word
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
        """From the first sample to the end of the last one's interval, of any topic but /event [s].

        The interval is that of the topic sampled most often: 0, 0.02, …, 79.98 s are 80 s.
        """
        tables = [t for name, t in self.tables.items() if name != "/event" and len(t)]
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


@dataclass
class _Content:
    """What has been gathered from the records so far."""

    topics: Collection[str] | None
    where: str
    room: int  # bytes that chunks may still unpack to
    kept_room: int  # bytes of messages that may still be kept
    library: str = ""
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    times: dict[int, list[int]] = field(default_factory=dict)
    messages: dict[int, list[bytes]] = field(default_factory=dict)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    attachments: dict[str, bytes] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)
    finished: bool = False


def read_log(path: Path | str, topics: Collection[str] | None = None) -> LoggedRun:
    """Read a run log written by trms, complete or not; only some topics, or all.

    Raises RecordingError when the file cannot be read, is no MCAP file, is of another program or is
    empty.
    """
    path = Path(path)
    data = _read_bytes(path)
    content = _Content(topics, str(path), most_unpacked(len(data)), most_kept(len(data)))
    cells = most_cells(len(data))
    _walk(data, content)
    del data
    run = content.metadata.get(RUN_METADATA, {})
    _refuse_newer(run, path)
    if not run and not content.library.startswith("trms"):
        names = ", ".join(sorted(c.topic for c in content.channels.values())[:6])
        raise RecordingError(
            f"this MCAP file is of another program ({content.library or 'unnamed'}"
            f"{'; topics ' + names if names else ''})",
            where=str(path),
            remedy="trms reads its own logs; import other recordings from CSV: trms import FILE",
        )
    if not content.finished:
        content.problems.append("the file was not finished: the run died, or it was cut off")
    if not content.channels:
        content.problems.append(_EMPTY_RUN)
    score = content.metadata.get(SCORE_METADATA, {})
    with not_as_written(str(path)):
        tables = _tables(content, path, cells)
    return LoggedRun(
        path=path,
        complete=not content.problems,
        outcome=run.get("outcome", "died"),
        tables=tables,
        run=run,
        score={key: _json_value(text) for key, text in score.items()},
        attachments=content.attachments,
        problems=tuple(content.problems),
    )


def _refuse_newer(run: Mapping[str, str], path: Path) -> None:
    """What a version to come means by its fields is not known here; older forms are all read."""
    kind, _, number = run.get("schema", "").partition("/")
    known_kind, _, known = RUN_SCHEMA.partition("/")
    if kind == known_kind and number.isdecimal() and int(number[:9]) > int(known):
        raise RecordingError(
            f"the log is of the form {kind}/{number}, this program reads up to {RUN_SCHEMA}",
            where=str(path),
            remedy="update trms: a newer version wrote it",
        )


def _read_bytes(path: Path) -> bytes:
    data = recorded_bytes(path, _USUAL_MOST)
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


def _walk(data: bytes, content: _Content) -> None:
    """Gather all intact records; stop where one is cut off."""
    for opcode, body, _ in records(memoryview(data)[len(MCAP0_MAGIC) :]):
        stream = ReadDataStream(BytesIO(body))
        try:
            if opcode == Opcode.HEADER:
                content.library = Header.read(stream).library
            elif opcode == Opcode.CHUNK:
                _open_chunk(Chunk.read(stream), content)
            elif opcode == Opcode.METADATA:
                metadata = Metadata.read(stream)
                content.metadata[metadata.name] = metadata.metadata
            elif opcode == Opcode.ATTACHMENT:
                attachment = Attachment.read(stream)
                content.attachments[attachment.name] = attachment.data
            elif opcode == Opcode.FOOTER:
                content.finished = data.endswith(MCAP0_MAGIC)
                return
            else:
                _take(opcode, body, content)
        except TooMuch as error:
            raise RecordingError(
                str(error), where=content.where, remedy=how_to_raise(2 * most_kept())
            ) from error
        except Exception as error:  # damage shows as any error of the decoders
            content.problems.append(f"a damaged record was left out ({error})")


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


def _open_chunk(chunk: Chunk, content: _Content) -> None:
    data = content_of(chunk, content.room)
    content.room -= len(data)
    damage = damage_of(chunk, data)
    if damage:
        content.problems.append(damage)
        return
    for opcode, body, _ in records(memoryview(data)):
        _take(opcode, body, content)


def _take(opcode: int, body: memoryview, content: _Content) -> None:
    if opcode == Opcode.MESSAGE:
        channel_id, _, log_time, _ = MESSAGE.unpack_from(body)
        if channel_id in content.times:
            content.kept_room -= max(len(body), _LEAST_MESSAGE)
            if content.kept_room < 0:
                raise TooMuch("its messages take more memory than a log of its size has")
            content.times[channel_id].append(log_time)
            content.messages[channel_id].append(bytes(body[MESSAGE.size :]))
    elif opcode == Opcode.SCHEMA:
        read = Schema.read(ReadDataStream(BytesIO(body)))
        content.schemas[read.id] = read
    elif opcode == Opcode.CHANNEL:
        channel = Channel.read(ReadDataStream(BytesIO(body)))
        content.channels[channel.id] = channel
        wanted = content.topics is None or channel.topic in content.topics
        schema = content.schemas.get(channel.schema_id)
        for_viewers = schema is not None and schema.name.startswith(VIEWER_SCHEMAS)
        if wanted and not for_viewers and channel.message_encoding == "json":
            content.times.setdefault(channel.id, [])
            content.messages.setdefault(channel.id, [])


def _tables(content: _Content, path: Path, room: int) -> dict[str, TopicTable]:
    tables: dict[str, TopicTable] = {}
    for channel_id, times in content.times.items():
        channel = content.channels[channel_id]
        try:
            schema = orjson.loads(content.schemas[channel.schema_id].data)
            room -= len(times) * len(schema["properties"])
            if room < 0:
                raise ValueError("more numbers than a log of its size has")
            kinds = {name: one["type"] for name, one in schema["properties"].items()}
            units = {name: one.get("unit", "") for name, one in schema["properties"].items()}
            tables[channel.topic] = table_of(times, content.messages[channel_id], kinds, units)
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise RecordingError(
                f"the messages of {channel.topic} are not as trms writes them ({error})",
                where=str(path),
            ) from error
    return tables


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
