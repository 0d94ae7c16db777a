"""Writes MCAP in chunks of many messages at a time.

The file is built from the mcap library's records. Only messages and their index, of which a
run has tens of thousands, are packed here: the library's own writer takes 3 µs a message,
which alone would be two thirds of what a whole step of the loop may cost; this takes 0.5 µs.
Specification: https://mcap.dev/spec
"""

from __future__ import annotations

import struct
import sys
import zlib
from array import array
from collections import defaultdict
from collections.abc import Iterable
from typing import Protocol

import zstandard
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import McapRecord
from mcap.writer import MCAP0_MAGIC

_MESSAGE = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log and publish time
_MESSAGE_HEAD = 2 + 4 + 8 + 8  # bytes of a message's record before its data
_INDEX = struct.Struct("<BQHI")  # opcode, length, channel, bytes of entries
_FOOTER_HEAD = struct.Struct("<BQQQ")


class Stream(Protocol):
    """Where the bytes go."""

    def write(self, data: bytes) -> int:
        """Take bytes."""

    def tell(self) -> int:
        """Return the position of the next byte."""


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

    def add_chunk(self, messages: Iterable[tuple[int, int, int, bytes]]) -> None:
        """Add messages as one chunk.

        ``messages``: iterable of (channel id, log time [ns], publish time [ns], data); in the order
        of log time.
        """
        pack, opcode = _MESSAGE.pack, int(Opcode.MESSAGE)
        counts = self._counts
        entries: defaultdict[int, list[int]] = defaultdict(list)
        parts: list[bytes] = []
        add = parts.append
        offset = 0
        for channel_id, log_time, publish_time, data in messages:
            size = _MESSAGE_HEAD + len(data)
            number = counts[channel_id]
            counts[channel_id] = number + 1
            add(pack(opcode, size, channel_id, number, log_time, publish_time))
            add(data)
            entries[channel_id] += (log_time, offset)
            offset += 9 + size
        if not parts:
            return
        start = min(index[0] for index in entries.values())
        end = max(index[-2] for index in entries.values())
        indexes = {channel_id: array("Q", index) for channel_id, index in entries.items()}
        self._put_chunk(b"".join(parts), start, end, indexes)

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

    def _put_chunk(self, data: bytes, start: int, end: int, indexes: dict[int, array[int]]) -> None:
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
        for channel_id, index in indexes.items():
            if sys.byteorder == "big":
                index.byteswap()
            entries = index.tobytes()
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
