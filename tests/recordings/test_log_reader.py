"""Reading logs that are whole, cut off, damaged, or not ours."""

import io

import numpy as np
import orjson
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from trms_cli.core.errors import RecordingError
from trms_cli.recordings.log_reader import LoggedRun, read_log
from trms_cli.recordings.read import read_recording
from trms_cli.recordings.run_log import RunLog
from trms_cli.recordings.topics import Field, Topic


def test_a_log_cut_anywhere_keeps_what_is_before(tmp_path, write_run):
    data = write_run(tmp_path / "run.mcap", 250).read_bytes()
    whole = read_log(tmp_path / "run.mcap")
    cut = tmp_path / "cut.mcap"
    header_end = 8 + 9 + int.from_bytes(data[9:17], "little")
    rng = np.random.default_rng(0)
    lengths = {*range(9, 400, 7), *rng.integers(400, len(data), 150).tolist()}
    lengths |= {len(data) - k for k in range(1, 60)}
    samples = []
    for length in sorted(lengths):
        cut.write_bytes(data[:length])
        if length < header_end:
            with pytest.raises(RecordingError):
                read_log(cut)
            continue
        log = read_log(cut)
        assert not log.complete and log.problems
        samples.append(check_is_prefix(log, whole))
    assert samples == sorted(samples)  # more file, never fewer samples
    assert samples[0] == 0 and samples[-1] == 250 and {100, 200} <= set(samples)


def check_is_prefix(log: LoggedRun, whole: LoggedRun) -> int:
    for topic, table in log.tables.items():
        n = len(table)
        np.testing.assert_array_equal(table.time_ns, whole.tables[topic].time_ns[:n])
    if "/command" not in log.tables:
        return 0
    n = len(log.tables["/command"])
    reference = whole.tables["/command"].columns["u_v"]
    np.testing.assert_array_equal(log.tables["/command"].columns["u_v"], reference[:n])
    return n


@given(st.binary(max_size=200))
def test_any_bytes_end_in_a_log_or_a_clear_error(tmp_path_factory, data):
    path = tmp_path_factory.mktemp("bytes") / "x.mcap"
    for content in (data, b"\x89MCAP0\r\n" + data):
        path.write_bytes(content)
        with pytest.raises(RecordingError):
            read_log(path)


@given(position=st.integers(8, 5000), flip=st.integers(1, 255))
def test_any_flipped_byte_ends_in_a_log_or_a_clear_error(
    tmp_path_factory, good_log, position, flip
):
    data = bytearray(good_log)
    data[position % len(data)] ^= flip
    path = tmp_path_factory.mktemp("flip") / "x.mcap"
    path.write_bytes(data)
    try:
        read_log(path)
    except RecordingError as error:
        assert str(path) in str(error)


@pytest.fixture(scope="module")
def good_log(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("good") / "run.mcap"
    topic = Topic("/command", (Field("u_v", "V"), Field("z", kind="array")))
    with RunLog(path, [topic], {"seed": "1"}) as log:
        for k in range(40):
            log.write("/command", k, (float(k), [1.0, 2.0]))
            if k % 10 == 9:
                log.flush()
    return path.read_bytes()


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (b"", "empty"),
        (b"t[s],u_v[V]\n0,1\n", "not an MCAP file"),
        (b"\x89MCA", "holds no sample"),
        (b"\x89MCAP0\r\n", "another program"),
    ],
)
def test_files_that_are_no_logs(path, content, problem):
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=problem) as caught:
        read_log(path)
    assert str(path) in str(caught.value) and caught.value.remedy


def test_a_log_of_another_program(path):
    writer = Writer(str(path))
    writer.start(library="robot 1.0")
    schema = writer.register_schema("x", "jsonschema", b"{}")
    channel = writer.register_channel("/odometry", "json", schema)
    writer.add_message(channel, 0, b"{}", 0)
    writer.finish()
    with pytest.raises(RecordingError, match=r"another program \(robot 1\.0; topics /odometry\)"):
        read_log(path)


@pytest.mark.parametrize("chunked", [True, False])
@pytest.mark.parametrize("compression", list(CompressionType))
def test_a_log_rewritten_by_another_tool(tmp_path, write_run, chunked, compression):
    """`mcap compress` or `mcap recover` change the library's name, chunks and compression."""
    path = write_run(tmp_path / "run.mcap", 30)
    out = io.BytesIO()
    writer = Writer(out, compression=compression, use_chunking=chunked)
    writer.start(library="mcap tool")
    with path.open("rb") as file:
        reader = make_reader(file)
        channels: dict[int, int] = {}
        for metadata in reader.iter_metadata():
            writer.add_metadata(metadata.name, metadata.metadata)
        for schema, channel, message in reader.iter_messages():
            assert schema is not None
            if channel.id not in channels:
                schema_id = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, "json", schema_id)
            writer.add_message(channels[channel.id], message.log_time, message.data, 0)
    writer.finish()
    other = tmp_path / "other.mcap"
    other.write_bytes(out.getvalue())
    before, after = read_log(path), read_log(other)
    assert after.complete and after.run == before.run and after.score == before.score
    np.testing.assert_array_equal(
        before.table("/command").columns["u_v"], after.table("/command").columns["u_v"]
    )


def test_only_the_topics_asked_for(tmp_path, write_run):
    log = read_log(write_run(tmp_path / "run.mcap", 10), ["/command"])
    assert set(log.tables) == {"/command"}
    with pytest.raises(RecordingError, match="has no /reference") as caught:
        log.table("/reference")
    assert "/command" in caught.value.remedy


def test_messages_that_do_not_fit_are_a_clear_error(path):
    writer = Writer(str(path))
    writer.start(library="trms 0")
    schema = orjson.dumps({"type": "object", "properties": {"x": {"type": "number"}}})
    channel = writer.register_channel(
        "/t", "json", writer.register_schema("x", "jsonschema", schema)
    )
    writer.add_message(channel, 0, b'{"x": "text"}', 0)
    writer.finish()
    with pytest.raises(RecordingError, match="/t are not as trms writes them"):
        read_log(path)


def test_a_run_as_a_recording(tmp_path, write_run):
    recording = read_recording(write_run(tmp_path / "run.mcap", close=False))
    assert set(recording.channels) == {"u_v", "u_h", "alpha_v", "alpha_h", "r_v", "r_h"}
    assert recording.units["u_v"] == "V" and recording.metadata["seed"] == "3"
    assert recording.sample_time == 0.01 and len(recording) == 250
    assert recording.missing == {"alpha_h": 125}
    assert any("incomplete" in note for note in recording.notes())
