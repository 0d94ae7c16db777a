"""Reading logs that are whole, cut off, damaged, not ours, or that grow."""

import io

import numpy as np
import orjson
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from trms_cli.core.errors import RecordingError
from trms_cli.recordings.log_reader import LoggedRun, LogPiece, LogTail, TopicTable, read_log
from trms_cli.recordings.read import read_recording
from trms_cli.recordings.run_log import RunLog
from trms_cli.recordings.topics import Field, Topic, standard_topics

from .conftest import write_sample


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


@pytest.mark.parametrize(
    ("library", "topic", "message", "problem"),
    [
        ("robot 1.0", "/odometry", b"{}", r"another program \(robot 1\.0; topics /odometry\)"),
        ("trms 0", "/t", b'{"x": "text"}', "/t are not as trms writes them"),
    ],
)
def test_messages_of_another_program_or_that_do_not_fit(path, library, topic, message, problem):
    writer = Writer(str(path))
    writer.start(library=library)
    schema = orjson.dumps({"type": "object", "properties": {"x": {"type": "number"}}})
    schema_id = writer.register_schema("x", "jsonschema", schema)
    writer.add_message(writer.register_channel(topic, "json", schema_id), 0, message, 0)
    writer.finish()
    with pytest.raises(RecordingError, match=problem):
        read_log(path)


def test_a_run_as_a_recording(tmp_path, write_run):
    recording = read_recording(write_run(tmp_path / "run.mcap", close=False))
    assert set(recording.channels) == {"u_v", "u_h", "alpha_v", "alpha_h", "r_v", "r_h"}
    assert recording.units["u_v"] == "V" and recording.metadata["seed"] == "3"
    assert recording.sample_time == 0.01 and len(recording) == 250
    assert recording.missing == {"alpha_h": 125}
    assert any("incomplete" in note for note in recording.notes())


def joined(pieces: list[LogPiece]) -> dict[str, TopicTable]:
    """The pieces of each topic as one table."""
    found: dict[str, TopicTable] = {}
    for topic in {topic for piece in pieces for topic in piece.tables}:
        parts = [piece.tables[topic] for piece in pieces if topic in piece.tables]
        columns = {
            name: np.concatenate([part.columns[name] for part in parts])
            for name in parts[0].columns
        }
        time_ns = np.concatenate([part.time_ns for part in parts])
        time = np.concatenate([part.time for part in parts])
        found[topic] = TopicTable(time, time_ns, columns, parts[0].units)
    return found


def read_all(tail: LogTail, at_once: int = 1 << 20) -> list[LogPiece]:
    pieces = []
    while (piece := tail.read(at_once)) is not None:
        pieces.append(piece)
    return pieces


def check_same(tables: dict[str, TopicTable], log: LoggedRun) -> None:
    assert set(tables) == {topic for topic, table in log.tables.items() if len(table)}
    for topic, table in tables.items():
        whole = log.tables[topic]
        np.testing.assert_array_equal(table.time_ns, whole.time_ns)
        np.testing.assert_array_equal(table.time, whole.time)
        assert table.units == whole.units
        assert list(table.columns) == list(whole.columns)
        for name, column in table.columns.items():
            assert column.dtype == whole.columns[name].dtype
            if column.dtype == object:
                assert len(column) == len(whole.columns[name])
                for a, b in zip(column, whole.columns[name], strict=True):
                    np.testing.assert_array_equal(a, b)
            else:
                np.testing.assert_array_equal(column, whole.columns[name])


@pytest.mark.parametrize("at_once", [1, 1000, 20_000, 1 << 20])
def test_a_finished_log_is_what_the_log_reader_reads(tmp_path, write_run, at_once):
    path = write_run(tmp_path / "run.mcap", 350)
    log = read_log(path)
    with LogTail(path) as tail:
        check_same(joined(read_all(tail, at_once)), log)
        assert tail.finished and tail.of_trms and not tail.problems
        assert tail.run == log.run
        assert tail.attachments == log.attachments
        assert tail.config == log.config


@settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(steps=st.lists(st.integers(0, 60), min_size=1, max_size=12))
def test_a_log_that_grows(tmp_path_factory, topics, steps):
    path = tmp_path_factory.mktemp("log") / "run.mcap"
    log, done, pieces = RunLog(path, topics, {"command": "trms run"}), 0, []
    with LogTail(path) as tail:
        for samples in steps:
            for _ in range(samples):
                write_sample(log, done)
                done += 1
            before = read_all(tail)
            assert not any(piece.tables for piece in before)  # nothing before the flush
            log.flush()
            found = read_all(tail)
            assert any(piece.tables for piece in found) == (samples > 0)
            pieces += found
            assert not tail.finished
            if done:
                check_same(joined(pieces), read_log(path))
        log.close("completed")
        pieces += read_all(tail)
        assert tail.finished
        assert tail.run["outcome"] == "completed"
        check_same(joined(pieces), read_log(path))


@pytest.fixture(scope="module")
def last_chunk(tmp_path_factory) -> tuple[bytes, bytes]:
    """A log up to a flush, and what the next flush adds."""
    path = tmp_path_factory.mktemp("chunk") / "run.mcap"
    angle = [Field("alpha_h", "rad")]
    topics = standard_topics(references=angle, outputs=angle)
    topics.append(Topic("/ahead", (Field("z", kind="array"),)))
    log = RunLog(path, topics, {"command": "trms run"})
    sizes = [path.stat().st_size]
    for second in range(2):
        for k in range(4):
            t = second * 10**9 + k * 10**7
            log.write("/reference", t, (0.5,))
            log.write("/measurement", t, (0.1 * k + second,))
            log.write("/ahead", t, ([1.0, 2.0],))
        log.flush()
        sizes.append(path.stat().st_size)
    data = path.read_bytes()
    log.close("completed")
    return data[: sizes[1]], data[sizes[1] :]


def test_a_chunk_cut_at_every_byte_is_left_for_the_next_look(tmp_path, last_chunk):
    before, after = last_chunk
    path = tmp_path / "run.mcap"
    whole = 0
    for length in range(len(after)):
        path.write_bytes(before + after[:length])
        with LogTail(path) as tail:
            pieces = read_all(tail)
            check_same(joined(pieces), read_log(path))
            assert not tail.finished and not tail.problems
            early = len(joined(pieces)["/measurement"])
            assert early in (4, 8)
            whole += early == 8
            with path.open("ab") as file:
                file.write(after[length:])
            pieces += read_all(tail)
            check_same(joined(pieces), read_log(path))
            assert len(joined(pieces)["/measurement"]) == 8
    # the samples are there once their chunk is, whether its index is or not; never before
    assert 0 < whole < len(after) / 2


def test_a_log_that_comes_byte_by_byte(tmp_path, last_chunk):
    data = b"".join(last_chunk)
    path = tmp_path / "run.mcap"
    path.touch()
    pieces = []
    with LogTail(path) as tail, path.open("ab", buffering=0) as file:
        for k in range(len(data)):
            file.write(data[k : k + 1])
            pieces += read_all(tail)
            assert not tail.finished and not tail.problems
    check_same(joined(pieces), read_log(path))


def test_only_what_is_wanted_is_read_and_progress_is_told_by_chunk(tmp_path, write_run):
    path = write_run(tmp_path / "run.mcap")
    with LogTail(path, lambda topic, column: (topic, column) == ("/command", "u_h")) as tail:
        tables = joined(read_all(tail))
    assert set(tables) == {"/command"} and set(tables["/command"].columns) == {"u_h"}
    assert tail.units == {"/command": {"u_h": "V"}}
    log = read_log(path, ["/command"])
    assert set(log.tables) == {"/command"}
    with pytest.raises(RecordingError, match="has no /reference") as caught:
        log.table("/reference")
    assert "/command" in caught.value.remedy
    with LogTail(path) as tail:
        written = [pair for piece in read_all(tail) for pair in piece.progress]
    assert [log for log, _ in written] == [990_000_000, 1_990_000_000, 2_490_000_000]
    assert sorted(written) == written and written[0][1] > 10**17


def test_damage_is_left_out_and_told_by_either_reader(tmp_path, write_run):
    path = write_run(tmp_path / "run.mcap")
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    second = summary.chunk_indexes[1]
    data = bytearray(path.read_bytes())
    data[second.chunk_start_offset + second.chunk_length // 2] ^= 0xFF
    path.write_bytes(data)
    log = read_log(path)
    assert not log.complete and len(log.problems) == 1
    assert log.outcome == "completed"
    time = log.table("/command").time
    assert len(time) == 150 and not np.any((time >= 1.0) & (time < 2.0))
    with LogTail(path) as tail:
        check_same(joined(read_all(tail)), log)
        assert len(tail.problems) == len([p for p in log.problems if "damaged" in p]) == 1


class TestWriter:
    """Whether somebody writes the log."""

    def test_a_run_has_one_until_it_closes(self, tmp_path, topics):
        log = RunLog(tmp_path / "run.mcap", topics, {})
        with LogTail(log.path) as tail:
            first = tail.has_writer()
            if first is None:
                pytest.skip("this system does not tell")
            assert first is True
            write_sample(log, 0)
            log.flush()
            assert tail.has_writer() is True
            log.close("completed")
            assert tail.has_writer() is False

    def test_a_reader_is_none(self, tmp_path, write_run):
        path = write_run(tmp_path / "run.mcap")
        with LogTail(path) as tail, LogTail(path) as other, path.open("rb"):
            assert tail.has_writer() in (False, None)
            assert other.has_writer() in (False, None)


class TestBadFiles:
    def test_none_no_mcap_and_a_folder(self, path):
        with pytest.raises(RecordingError, match="no such file"):
            LogTail(path)
        path.write_text("t[s],u_v[V]\n0,1\n")
        with LogTail(path) as tail, pytest.raises(RecordingError, match="not an MCAP file"):
            tail.read()
        with pytest.raises(RecordingError), LogTail(path.parent) as tail:
            tail.read()

    def test_a_record_of_a_length_that_cannot_be(self, path, last_chunk):
        path.write_bytes(last_chunk[0] + b"\x06" + (2**60).to_bytes(8, "little") + bytes(100))
        with LogTail(path) as tail:
            pieces = read_all(tail)
            assert tail.finished and "damaged" in tail.problems[-1]
        assert len(joined(pieces)["/measurement"]) == 4

    @settings(max_examples=200, suppress_health_check=[HealthCheck.function_scoped_fixture])
    @given(spoilt=st.lists(st.tuples(st.integers(8, 10**6), st.integers(0, 255)), min_size=1))
    def test_damage_anywhere_ends_in_a_message_or_in_fewer_samples(
        self, tmp_path, last_chunk, spoilt
    ):
        data = bytearray(b"".join(last_chunk))
        for place, value in spoilt:
            data[8 + place % (len(data) - 8)] = value
        path = tmp_path / "spoilt.mcap"
        path.write_bytes(data)
        try:
            with LogTail(path) as tail:
                read_all(tail)
        except RecordingError:
            pass
        try:
            read_log(path)
        except RecordingError as error:
            assert str(path) in str(error)
