"""Copies of run logs with further topics."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from trms_cli.core.whole_file import whole_file
from trms_cli.recordings.chunk_writer import ChunkWriter
from trms_cli.recordings.run_log import LIBRARY
from trms_cli.recordings.topics import EncodedTopic

if TYPE_CHECKING:
    from mcap.records import Metadata

_SECOND = 1_000_000_000  # ns


def copy_with(
    source: Path,
    topics: Sequence[EncodedTopic],
    messages: Iterable[tuple[str, int, bytes]],
    path: Path,
    *,
    force: bool = False,
) -> None:
    """Copy a log and add messages; the file appears when it is whole.

    Messages, metadata and attachments are those of the log, byte for byte, as far as it is intact.
    ``topics``: of the new messages, whose place it takes if the log has one of that name.
    ``messages``: topic, time (ns) and JSON of each. Raises RecordingError when the file exists and
    ``force`` is not given, or cannot be written.
    """
    with whole_file(path, force=force) as temporary, temporary.open("wb") as file:
        writer = ChunkWriter(file, LIBRARY)
        pending, last_words = _copy_words(source, writer, [topic.name for topic in topics])
        numbers = {
            topic.name: writer.add_channel(topic.name, topic.schema_name, topic.schema)
            for topic in topics
        }
        pending += [(numbers[topic], time_ns, time_ns, data) for topic, time_ns, data in messages]
        pending.sort(key=lambda message: message[1])
        _write_chunks(writer, pending)
        for metadata in last_words:
            writer.add_metadata(metadata.name, metadata.metadata)
        writer.finish()


_Pending = list[tuple[int, int, int, bytes]]


def _copy_words(
    path: Path, writer: ChunkWriter, names: Collection[str]
) -> tuple[_Pending, list[Metadata]]:
    """Copy attachments, channels and the metadata before the samples; samples, and the rest.

    ``names``: of topics that are left out.
    """
    from mcap.records import Attachment, Channel, Message, Metadata, Schema
    from mcap.stream_reader import StreamReader

    pending: _Pending = []
    schemas: dict[int, Schema] = {}
    numbers: dict[int, int] = {}
    last_words: list[Metadata] = []
    with path.open("rb") as file:
        try:
            for record in StreamReader(file, validate_crcs=False).records:
                if isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Channel):
                    if record.id not in numbers and record.topic not in names:
                        schema = schemas[record.schema_id]
                        numbers[record.id] = writer.add_channel(
                            record.topic, schema.name, schema.data
                        )
                elif isinstance(record, Message):
                    if record.channel_id in numbers:
                        number = numbers[record.channel_id]
                        times = record.log_time, record.publish_time
                        pending.append((number, *times, record.data))
                elif isinstance(record, Attachment):
                    writer.add_attachment(
                        record.name, record.media_type, record.data, record.create_time
                    )
                elif isinstance(record, Metadata):
                    if pending:
                        last_words.append(record)
                    else:
                        writer.add_metadata(record.name, record.metadata)
        except Exception:  # the log of a run that died ends in the middle of a record
            if not pending:
                raise
    return pending, last_words


def _write_chunks(writer: ChunkWriter, messages: _Pending) -> None:
    """One chunk a second of the run, as a run writes them."""
    start = 0
    for k, message in enumerate(messages):
        if message[1] - messages[start][1] >= _SECOND:
            writer.add_chunk(messages[start:k])
            start = k
    writer.add_chunk(messages[start:])
