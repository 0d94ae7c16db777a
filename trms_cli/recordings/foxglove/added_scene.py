"""The 3D view of a log that was written already: poses from its samples, and a copy that has them.

The poses are those that the run itself would have logged; a log that has some is given new ones.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from mcap.records import Attachment, Channel, Message, Metadata, Schema
from mcap.stream_reader import StreamReader

from trms_cli.recordings.chunk_writer import ChunkWriter
from trms_cli.recordings.foxglove.messages import SceneEncoder, log_line
from trms_cli.recordings.foxglove.scene_log import PoseMemory, Sources
from trms_cli.recordings.foxglove.types import (
    ARROWS,
    BODIES,
    LOG_LINES,
    SCENE_TOPICS,
    TRANSFORMS,
    encoded_topics,
)
from trms_cli.recordings.log_reader import LoggedRun
from trms_cli.recordings.output_file import whole_file
from trms_cli.recordings.run_log import LIBRARY

_SECOND = 1_000_000_000  # ns


def scene_messages(
    log: LoggedRun, encoder: SceneEncoder, sources: Sources, every: int
) -> Iterator[tuple[str, int, bytes]]:
    """Topic, time (ns) and JSON of the bodies, of each pose and of each event's line.

    ``sources``: places in the log's columns, in their order. ``every``: samples from one pose to
    the next.
    """
    times = log.tables[sources.attitudes[""][0]].time_ns[::every]
    rows = {
        topic: np.column_stack(list(log.tables[topic].held(times).values())).tolist()
        for topic in {source[0] for source in sources.attitudes.values()} | {"/command"}
        if topic in log.tables and len(log.tables[topic])
    }
    memory = PoseMemory(sources)
    for k, time_ns in enumerate(times.tolist()):
        if k == 0:
            yield BODIES, time_ns, encoder.bodies(time_ns)
        attitudes, shares = memory.take({topic: held[k] for topic, held in rows.items()})
        yield TRANSFORMS, time_ns, encoder.transforms(time_ns, attitudes)
        yield ARROWS, time_ns, encoder.commands(time_ns, shares)
    events = log.tables.get("/event")
    if events is not None:
        told = (events.columns[name] for name in ("kind", "source", "message"))
        for time_ns, *words in zip(events.time_ns.tolist(), *told, strict=True):
            yield LOG_LINES, time_ns, log_line(time_ns, *(word or "" for word in words))


def write_with_scene(
    log: LoggedRun,
    encoder: SceneEncoder,
    sources: Sources,
    every: int,
    path: Path,
    *,
    force: bool = False,
) -> int:
    """Copy a log and add the 3D view; the number of poses. The file appears when it is whole.

    Messages, metadata and attachments are those of the log, byte for byte, as far as it is intact.

    Raises RecordingError when the file exists and ``force`` is not given, or cannot be written.
    """
    added = list(scene_messages(log, encoder, sources, every))
    with whole_file(path, force=force) as temporary, temporary.open("wb") as file:
        writer = ChunkWriter(file, LIBRARY)
        pending, last_words = _copy_words(log.path, writer)
        numbers = {
            topic.name: writer.add_channel(topic.name, topic.schema_name, topic.schema)
            for topic in encoded_topics()
        }
        pending += [(numbers[topic], time_ns, time_ns, data) for topic, time_ns, data in added]
        pending.sort(key=lambda message: message[1])
        _write_chunks(writer, pending)
        for metadata in last_words:
            writer.add_metadata(metadata.name, metadata.metadata)
        writer.finish()
    return sum(topic == TRANSFORMS for topic, _, _ in added)


_Pending = list[tuple[int, int, int, bytes]]


def _copy_words(path: Path, writer: ChunkWriter) -> tuple[_Pending, list[Metadata]]:
    """Copy attachments, channels and the metadata before the samples; samples, and the rest."""
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
                    if record.id not in numbers and record.topic not in SCENE_TOPICS:
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
