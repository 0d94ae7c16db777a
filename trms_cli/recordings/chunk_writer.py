"""Writes MCAP in chunks of many messages at a time.

The file is built from the mcap library's records. Only messages and their index, of which a
run has tens of thousands, are packed here, a chunk's at once: the library's own writer takes 3 µs a
message, which alone would be as much as a whole sample of the loop takes besides.
Specification: https://mcap.dev/spec
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable, Sequence
from itertools import chain
from typing import NamedTuple, Protocol

import numpy as np
import zstandard
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import McapRecord
from mcap.writer import MCAP0_MAGIC

#: What stands before a message's data.
_MESSAGE = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log_time", "<u8"),
        ("publish_time", "<u8"),
    ]
)
_PREFIX = 1 + 8  # bytes of a record that its length does not count
_INDEX = struct.Struct("<BQHI")  # opcode, length, channel, bytes of entries
_FOOTER_HEAD = struct.Struct("<BQQQ")


class Stream(Protocol):
    """Where the bytes go."""

    def write(self, data: bytes) -> int:
        """Take bytes."""

    def tell(self) -> int:
        """Return the position of the next byte."""


class Messages(NamedTuple):
    """Messages of one channel."""

    channel: int
    log_times: Sequence[int]  #: ns
    publish_times: Sequence[int]  #: ns
    data: Sequence[bytes]


class ChunkWriter:
    """An MCAP file in the making; the caller flushes and closes the stream.

    ``stream``: at its beginning. ``library``: names the program in the file's header.
    """

    def __init__(self, stream: Stream, library: str) -> None:
        self._stream = stream
        # Level 1 costs half of level 3 and packs this JSON as tightly.
        self._compressor = zstandard.ZstdCompressor(level=1)
        self._schemas: list[McapRecord] = []
        self._channels: list[McapRecord] = []
        self._chunk_indexes: list[McapRecord] = []
        self._attachment_indexes: list[McapRecord] = []
        self._metadata_indexes: list[McapRecord] = []
        self._counts: dict[int, int] = {}
        self._start: int | None = None
        self._end = 0
        stream.write(MCAP0_MAGIC)
        self._put(records.Header(profile="", library=library))

    def add_channel(self, topic: str, schema_name: str, json_schema: bytes) -> int:
        """Add a channel of JSON messages with its schema; return the channel's id."""
        number = len(self._channels) + 1
        schema_id = self._schema_id(schema_name, json_schema)
        channel = records.Channel(
            id=number, topic=topic, message_encoding="json", metadata={}, schema_id=schema_id
        )
        self._channels.append(channel)
        self._counts[number] = 0
        self._put(channel)
        return number

    def _schema_id(self, name: str, data: bytes) -> int:
        """The id of a schema; topics of one schema share its record."""
        for schema in self._schemas:
            if isinstance(schema, records.Schema) and (schema.name, schema.data) == (name, data):
                return schema.id
        schema = records.Schema(
            id=len(self._schemas) + 1, name=name, encoding="jsonschema", data=data
        )
        self._schemas.append(schema)
        self._put(schema)
        return schema.id

    def add_metadata(self, name: str, values: dict[str, str]) -> None:
        """Add a metadata record."""
        offset, length = self._put(records.Metadata(name=name, metadata=values))
        self._metadata_indexes.append(
            records.MetadataIndex(offset=offset, length=length, name=name)
        )

    def add_attachment(self, name: str, media_type: str, data: bytes, create_time: int) -> None:
        """Add a file; ``create_time`` is the wall clock [ns]."""
        attachment = records.Attachment(
            create_time=create_time, log_time=0, name=name, media_type=media_type, data=data
        )
        offset, length = self._put(attachment)
        self._attachment_indexes.append(
            records.AttachmentIndex(
                offset=offset,
                length=length,
                log_time=0,
                create_time=create_time,
                data_size=len(data),
                name=name,
                media_type=media_type,
            )
        )

    def add_chunk(self, messages: Iterable[Messages]) -> None:
        """Add messages as one chunk, in the order of log time; those of one time as they come."""
        groups = [group for group in messages if group.data]
        if not groups:
            return
        data = list(chain.from_iterable(group.data for group in groups))
        heads = np.empty(len(data), _MESSAGE)
        heads["opcode"] = int(Opcode.MESSAGE)
        start = 0
        for group in groups:
            part = heads[start : start + len(group.data)]
            count = self._counts[group.channel]
            part["channel"] = group.channel
            part["log_time"] = group.log_times
            part["publish_time"] = group.publish_times
            part["sequence"] = np.arange(count, count + len(part))
            part["length"] = np.fromiter(map(len, group.data), np.uint64, len(part))
            self._counts[group.channel] = count + len(part)
            start += len(part)
        heads["length"] += _MESSAGE.itemsize - _PREFIX
        order = np.argsort(heads["log_time"], kind="stable")
        heads = heads[order]
        packed = heads.view(f"V{_MESSAGE.itemsize}").tolist()
        in_order = map(data.__getitem__, order.tolist())
        body = b"".join(chain.from_iterable(zip(packed, in_order, strict=True)))
        self._put_chunk(body, heads, sorted(group.channel for group in groups))

    def finish(self) -> None:
        """Add the summary and the end of the file."""
        self._put(records.DataEnd(0))
        summary_start = self._stream.tell()
        summary = RecordBuilder()
        offsets = []
        for opcode, group in (
            (Opcode.SCHEMA, self._schemas),
            (Opcode.CHANNEL, self._channels),
            (Opcode.STATISTICS, [self._statistics()]),
            (Opcode.CHUNK_INDEX, self._chunk_indexes),
            (Opcode.ATTACHMENT_INDEX, self._attachment_indexes),
            (Opcode.METADATA_INDEX, self._metadata_indexes),
        ):
            start = summary.count
            for record in group:
                record.write(summary)
            if group:
                offsets.append(
                    records.SummaryOffset(
                        group_opcode=opcode,
                        group_start=summary_start + start,
                        group_length=summary.count - start,
                    )
                )
        offset_start = summary_start + summary.count
        for record in offsets:
            record.write(summary)
        data = summary.end()
        # The checksum runs over the summary and the footer's own first fields.
        head = _FOOTER_HEAD.pack(Opcode.FOOTER, 8 + 8 + 4, summary_start, offset_start)
        self._stream.write(data)
        self._put(
            records.Footer(
                summary_start=summary_start,
                summary_offset_start=offset_start,
                summary_crc=zlib.crc32(head, zlib.crc32(data)),
            )
        )
        self._stream.write(MCAP0_MAGIC)

    def _put(self, record: McapRecord) -> tuple[int, int]:
        """Write a record; return its offset and length [bytes]."""
        builder = RecordBuilder()
        record.write(builder)
        offset = self._stream.tell()
        data = builder.end()
        self._stream.write(data)
        return offset, len(data)

    def _put_chunk(self, data: bytes, heads: np.ndarray, channels: Sequence[int]) -> None:
        """Write a chunk's messages, and where in it those of each channel stand."""
        times = heads["log_time"]
        start, end = int(times[0]), int(times[-1])
        compressed = self._compressor.compress(data)
        offset, length = self._put(
            records.Chunk(
                compression="zstd",
                data=compressed,
                message_start_time=start,
                message_end_time=end,
                uncompressed_crc=zlib.crc32(data),
                uncompressed_size=len(data),
            )
        )
        index_start = self._stream.tell()
        index_offsets = {}
        places = np.zeros((len(heads), 2), "<u8")
        places[:, 0] = times
        np.cumsum(heads["length"][:-1] + np.uint64(_PREFIX), out=places[1:, 1])
        owner = heads["channel"].copy()  # side by side
        for channel_id in channels:
            entries = places[owner == channel_id].tobytes()
            index_offsets[channel_id] = self._stream.tell()
            head = _INDEX.pack(Opcode.MESSAGE_INDEX, 6 + len(entries), channel_id, len(entries))
            self._stream.write(head + entries)
        self._chunk_indexes.append(
            records.ChunkIndex(
                chunk_start_offset=offset,
                chunk_length=length,
                compression="zstd",
                compressed_size=len(compressed),
                uncompressed_size=len(data),
                message_start_time=start,
                message_end_time=end,
                message_index_offsets=index_offsets,
                message_index_length=self._stream.tell() - index_start,
            )
        )
        self._start = start if self._start is None else min(self._start, start)
        self._end = max(self._end, end)

    def _statistics(self) -> McapRecord:
        return records.Statistics(
            attachment_count=len(self._attachment_indexes),
            channel_count=len(self._channels),
            channel_message_counts={i: n for i, n in self._counts.items() if n},
            chunk_count=len(self._chunk_indexes),
            message_count=sum(self._counts.values()),
            metadata_count=len(self._metadata_indexes),
            message_start_time=self._start or 0,
            message_end_time=self._end,
            schema_count=len(self._schemas),
        )
