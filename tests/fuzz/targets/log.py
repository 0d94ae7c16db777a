"""Logs, whole: read_log, and the recording and the score that are made of one."""

import io
import json
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from mcap.writer import CompressionType, Writer

from trms_cli.recordings.run_log import RunLog
from trms_cli.recordings.topics import Field, standard_topics


def seeds(folder: Path) -> Iterator[bytes]:
    """A run as the program writes it, and the same without compression, checksums and chunks."""
    path = folder / "seed.mcap"
    path.unlink(missing_ok=True)
    topics = standard_topics(
        references=[Field("alpha_v", "rad", "")],
        inputs=[Field("u_v", "V", "")],
        outputs=[Field("alpha_v", "rad", "")],
    )
    config = b"sim:\n  duration: 1.0\n  sample_time: 0.02\nseed: 1\n"
    about = {"command": "run", "seed": "1", "overrides": '["seed=1"]', "choices": '{"ref": "sine"}'}
    with RunLog(path, topics, about, {"config.yaml": ("text/yaml", config)}) as log:
        for index in range(4):
            time_ns = index * 20_000_000
            log.write("/reference", time_ns, (0.1,))
            log.write("/command", time_ns, (1.0 + index,))
            log.write("/measurement", time_ns, (0.01 * index,))
        log.event(0, "note", "person", "a word", None)
    yield path.read_bytes()
    for compression in (CompressionType.NONE, CompressionType.LZ4, CompressionType.ZSTD):
        yield _small(compression, chunks=True)
    yield _small(CompressionType.NONE, chunks=False)


def _small(compression: CompressionType, *, chunks: bool) -> bytes:
    stream = io.BytesIO()
    writer = Writer(
        stream, compression=compression, use_chunking=chunks, enable_crcs=False, chunk_size=200
    )
    writer.start(library="trms 0")
    writer.add_metadata("trms.run", {"schema": "trms.run/1", "command": "run", "end": "", "x": "1"})
    writer.add_metadata("trms.score", {"duration_s": "1.0", "channels": "{}"})
    writer.add_attachment(0, 0, "config.yaml", "text/yaml", b"sim: {sample_time: 0.02}\n")
    fields = {"/command": "u_v", "/measurement": "alpha_v"}
    channels = {}
    for topic, name in fields.items():
        properties = {name: {"type": "number", "unit": "rad"}, "text": {"type": "string"}}
        schema = {"type": "object", "properties": properties}
        schema_id = writer.register_schema(topic, "jsonschema", json.dumps(schema).encode())
        channels[topic] = writer.register_channel(topic, "json", schema_id)
    for index in range(3):
        for topic, name in fields.items():
            message = json.dumps({name: 0.5 * index, "text": "a"}).encode()
            writer.add_message(channels[topic], index, message, index)
    writer.finish()
    return stream.getvalue()


def read(data: bytes, folder: Path) -> None:
    """Everything that commands make of a log."""
    from trms_cli.core.errors import TrmsError
    from trms_cli.recordings.log_reader import read_log
    from trms_cli.recordings.mcap_recording import recording_of
    from trms_cli.scoring.score import score_log

    path = folder / "run.mcap"
    path.write_bytes(data)
    log = read_log(path)
    log.duration_s, log.config  # noqa: B018
    with suppress(TrmsError):
        recording_of(log).notes()
    score_log(log)
