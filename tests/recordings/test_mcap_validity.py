"""The files are MCAP to the letter: what `mcap doctor` checks, by the library's records.

The Go program is not a dependency of the tests; these are its checks in Python.
"""

import io
import struct
import zlib
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import mcap.records as r
import orjson
import pytest
from mcap.data_stream import ReadDataStream
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader, breakup_chunk, get_chunk_data_stream

from trms_cli import __version__
from trms_cli.core.scene import Ring, Scene
from trms_cli.recordings.foxglove.messages import SceneEncoder
from trms_cli.recordings.foxglove.scene_log import Sources, find_sources, write_with_scene
from trms_cli.recordings.log_reader import read_log
from trms_cli.recordings.run_log import RunLog
from trms_cli.recordings.topics import Field, Topic


@pytest.fixture(params=["full", "empty", "viewed"])
def log_path(
    request: pytest.FixtureRequest, tmp_path: Path, write_run: Callable[..., Path]
) -> Path:
    if request.param == "full":
        return write_run(tmp_path / "run.mcap")
    if request.param == "viewed":
        return viewed(write_run(tmp_path / "run.mcap"), tmp_path / "viewed.mcap")
    path = tmp_path / "empty.mcap"
    RunLog(path, [Topic("/t", (Field("x"),))], {"seed": "1"}).close("failed")
    return path


def viewed(path: Path, out: Path) -> Path:
    """The same log with the 3D view added: topics that share a schema, encoded by others."""
    log = read_log(path)
    fields = {topic: list(table.columns) for topic, table in log.tables.items()}
    sources = find_sources(fields, {"u_v": 2.5})
    assert sources is not None
    body = Scene((Ring("guard", "beam", (0.2, 0, 0), (0, 0, 1), 0.1, 0.01, "main"),), (), 0.4, 0, 1)
    arrows = Sources(sources.attitudes, ())
    write_with_scene(log, SceneEncoder(body, sources.ghosts), arrows, 4, out)
    return out


def test_records_and_summary_agree(log_path: Path) -> None:
    data = log_path.read_bytes()
    records = list(StreamReader(io.BytesIO(data), emit_chunks=True, validate_crcs=True).records)
    assert isinstance(records[0], r.Header)
    assert records[0].library == f"trms {__version__}" and records[0].profile == ""
    end = next(i for i, record in enumerate(records) if isinstance(record, r.DataEnd))
    body, summary = records[:end], records[end + 1 :]

    schemas = {s.id: s for s in body if isinstance(s, r.Schema)}
    channels = {c.id: c for c in body if isinstance(c, r.Channel)}
    assert 0 not in schemas
    assert [s for s in summary if isinstance(s, r.Schema)] == list(schemas.values())
    assert [c for c in summary if isinstance(c, r.Channel)] == list(channels.values())
    assert all(channel.schema_id in schemas for channel in channels.values())
    assert all(s.encoding == "jsonschema" and orjson.loads(s.data) for s in schemas.values())
    assert all(channel.message_encoding == "json" for channel in channels.values())

    counts: Counter[int] = Counter()
    last = 0
    times = []
    chunks = [c for c in body if isinstance(c, r.Chunk)]
    for chunk in chunks:
        chunk_times = [m.log_time for m in messages_of(chunk)]
        assert (min(chunk_times), max(chunk_times)) == (
            chunk.message_start_time,
            chunk.message_end_time,
        )
        for message in messages_of(chunk):
            assert message.log_time >= last  # the doctor warns when time runs back
            last = message.log_time
            assert message.sequence == counts[message.channel_id]
            counts[message.channel_id] += 1
        times += chunk_times
    (statistics,) = [s for s in summary if isinstance(s, r.Statistics)]
    assert statistics.message_count == sum(counts.values())
    assert statistics.channel_message_counts == dict(counts)
    assert statistics.chunk_count == len(chunks)
    assert statistics.metadata_count == len([m for m in body if isinstance(m, r.Metadata)])
    assert statistics.attachment_count == len([a for a in body if isinstance(a, r.Attachment)])
    assert (statistics.message_start_time, statistics.message_end_time) == (
        min(times, default=0),
        max(times, default=0),
    )
    (footer,) = [f for f in summary if isinstance(f, r.Footer)]
    crc = zlib.crc32(data[footer.summary_start : len(data) - 8 - 4])
    assert crc == footer.summary_crc
    check_indexes(data, summary, chunks)


def messages_of(chunk: r.Chunk) -> list[r.Message]:
    return [m for m in breakup_chunk(chunk, validate_crc=True) if isinstance(m, r.Message)]


def check_indexes(data: bytes, summary: list[r.McapRecord], chunks: list[r.Chunk]) -> None:
    indexes = [c for c in summary if isinstance(c, r.ChunkIndex)]
    assert len(indexes) == len(chunks)
    for index, chunk in zip(indexes, chunks, strict=True):
        opcode, length = struct.unpack_from("<BQ", data, index.chunk_start_offset)
        assert opcode == 6 and index.chunk_length == length + 9
        assert index.compressed_size == len(chunk.data)
        assert index.uncompressed_size == chunk.uncompressed_size
        assert index.compression == chunk.compression
        stream, size = get_chunk_data_stream(chunk, validate_crc=True)
        content = stream.read(size)
        entries = 0
        for channel_id, offset in index.message_index_offsets.items():
            at = ReadDataStream(io.BytesIO(data[offset + 9 :]))
            message_index = r.MessageIndex.read(at)
            assert message_index.channel_id == channel_id
            for log_time, position in message_index.records:
                opcode, _, channel, _, time_ns = struct.unpack_from("<BQHIQ", content, position)
                assert (opcode, channel, time_ns) == (5, channel_id, log_time)
                entries += 1
        assert entries == len(messages_of(chunk))
        behind = position = index.chunk_start_offset + index.chunk_length
        while data[position] == 0x07:  # the message indexes behind the chunk
            position += 9 + struct.unpack_from("<Q", data, position + 1)[0]
        assert position == behind + index.message_index_length
    for offset in (s for s in summary if isinstance(s, r.SummaryOffset)):
        assert data[offset.group_start] == offset.group_opcode
    for item in summary:
        if isinstance(item, r.MetadataIndex):
            assert data[item.offset] == 0x0C
        if isinstance(item, r.AttachmentIndex):
            assert data[item.offset] == 0x09


def test_an_indexed_reader_seeks_and_messages_satisfy_their_schemas(
    tmp_path: Path, write_run: Callable[..., Path]
) -> None:
    path = write_run(tmp_path / "run.mcap")
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        part = list(
            reader.iter_messages(
                ["/command"], starting_at=1_500_000_000, ending_before=1_600_000_000
            )
        )
        assert [orjson.loads(m.data)["u_v"] for _, _, m in part] == [151.0 + k for k in range(10)]
        names = [metadata.name for metadata in reader.iter_metadata()]
        assert names == ["trms.run", "trms.run", "trms.score"]
        (attachment,) = reader.iter_attachments()
        assert attachment.name == "config.yaml"
        assert attachment.media_type == "application/yaml"
        for schema, _, message in reader.iter_messages():
            assert schema is not None
            properties = orjson.loads(schema.data)["properties"]
            values = orjson.loads(message.data)
            assert list(values) == list(properties)


def test_publish_time_is_the_wall_clock_or_the_log_time(tmp_path: Path) -> None:
    for kind in ("wall", "log"):
        path = tmp_path / f"{kind}.mcap"
        topic = Topic("/t", (Field("x"),))
        with RunLog(path, [topic], {}, publish_time=kind) as log:
            log.write("/t", 5, (1.0,))
        with path.open("rb") as file:
            (_, _, message), *_ = make_reader(file).iter_messages()
        assert (message.publish_time == 5) == (kind == "log")
        assert kind == "log" or message.publish_time > 1.7e18
