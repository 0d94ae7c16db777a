"""Writing a log: its topics, what a run may do to it, and what may happen to a run."""

import errno
import os
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import orjson
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader

from trms_cli.core.errors import RecordingError
from trms_cli.recordings import run_log
from trms_cli.recordings.log_reader import read_log
from trms_cli.recordings.run_log import RunLog
from trms_cli.recordings.topics import Field, Topic, standard_topics

NUMBERS = Topic("/numbers", (Field("a", "rad"), Field("b", "1", kind="integer")))


def test_a_run_comes_back(tmp_path: Path, write_run: Callable[..., Path]) -> None:
    log = read_log(write_run(tmp_path / "new" / "folder" / "run.mcap"))
    assert log.complete and log.outcome == "completed" and not log.problems
    assert log.run["seed"] == "3" and log.run["start"] <= log.run["end"]
    assert log.score == {"rmse": {"alpha_h": 0.5}, "complete": True}
    assert log.config.startswith("seed: 3")
    assert log.duration_s == 2.5
    measurement = log.table("/measurement")
    np.testing.assert_array_equal(measurement.time, np.arange(250) / 100)
    np.testing.assert_array_equal(measurement.columns["alpha_v"], 0.1 * np.arange(250))
    assert np.isnan(measurement.columns["alpha_h"][1::2]).all()
    assert measurement.units["alpha_v"] == "rad"
    controller = log.table("/controller").columns
    assert controller["status"][0] == "optimal" and controller["deadline_missed"][7] == 1.0
    prediction = log.table("/prediction").columns
    np.testing.assert_allclose(prediction["time"][3], [0, 0.1, 0.2, 0.3])
    assert list(log.table("/event").columns["kind"]) == ["saturation", "note"]


@given(st.floats(), st.integers(-(2**53), 2**53))
def test_numbers_are_exact_and_non_finite_ones_null(tmp_path_factory, a, b) -> None:
    path = tmp_path_factory.mktemp("log") / "run.mcap"
    with RunLog(path, [NUMBERS], {}) as log:
        log.write("/numbers", 0, (a, b))
    columns = read_log(path).table("/numbers").columns
    assert columns["b"][0] == b
    if np.isfinite(a):
        assert columns["a"][0] == a
    else:
        assert np.isnan(columns["a"][0])
        assert b'"a":null' in raw_messages(path)[0]


def raw_messages(path: Path) -> list[bytes]:
    with path.open("rb") as file:
        return [message.data for _, _, message in make_reader(file).iter_messages()]


def test_values_of_numpy_are_written_as_numbers_and_copies(path: Path) -> None:
    topic = Topic("/t", (Field("x"), Field("y", kind="boolean"), Field("z", kind="array")))
    values: list[Any] = [np.float64(0.1), np.bool_(True), np.array([1.0, np.inf])]
    with RunLog(path, [topic], {}) as log:
        log.write("/t", 0, values)
        values[0] = values[2][0] = 2.0
        log.write("/t", 1, (np.float32(0.5), np.int64(0), [2, 3]))
    first, second = (orjson.loads(data) for data in raw_messages(path))
    assert first == {"x": 0.1, "y": True, "z": [1.0, None]}
    assert second == {"x": 0.5, "y": 0, "z": [2, 3]}


def test_a_wrong_topic_or_number_of_values_names_those_there_are(path: Path) -> None:
    log = RunLog(path, [NUMBERS], {})
    with pytest.raises(KeyError, match="'/x' in this log: /numbers, /event"):
        log.write("/x", 0, ())
    log.write("/numbers", 0, (1.0,))
    with pytest.raises(ValueError, match=r"/numbers takes 2 values \(a, b\), got 1"):
        log.flush()


def test_nothing_is_overwritten_and_a_folder_that_is_a_file_is_told(
    tmp_path: Path, write_run: Callable[..., Path]
) -> None:
    path = write_run(tmp_path / "run.mcap")
    before = path.read_bytes()
    with pytest.raises(RecordingError, match="already") as caught:
        RunLog(path, [NUMBERS], {})
    assert "out=" in caught.value.remedy
    assert path.read_bytes() == before
    (tmp_path / "file").write_text("x")
    for path in (tmp_path / "file" / "run.mcap", tmp_path / "file" / "deeper" / "run.mcap"):
        with pytest.raises(RecordingError, match="is a file") as caught:
            RunLog(path, [NUMBERS], {})
        assert caught.value.remedy


@pytest.mark.parametrize(
    ("call", "code", "words"),
    [
        # The mode bits of a folder do not stop root, as whom containers run tests.
        ("open", errno.EACCES, "does not let you write.*out="),
        ("open", errno.EROFS, "does not let you write.*out="),
        ("write", errno.ENOSPC, "nothing of the run is in the log"),
    ],
)
def test_a_read_only_folder_and_a_full_disk_at_the_start(path, monkeypatch, call, code, words):
    def refuse(*_: object) -> int:
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(run_log.os, call, refuse)
    with pytest.raises(RecordingError, match=f"(?s){words}"):
        RunLog(path, [NUMBERS], {})


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="mode bits do not stop root")
def test_read_only_folder_for_real(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    with pytest.raises(RecordingError, match="does not let you write"):
        RunLog(tmp_path / "run.mcap", [NUMBERS], {})
    tmp_path.chmod(0o700)


def run_python(code: str, *arguments: object) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", textwrap.dedent(code), *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def test_full_disk_keeps_all_seconds_before(path: Path) -> None:
    """The file size limit of the process stops a write half-way, as a full disk does."""
    process = run_python(
        """
        import random, resource, signal, sys
        from trms_cli.core.errors import RecordingError
        from trms_cli.recordings.run_log import RunLog
        from trms_cli.recordings.topics import Field, Topic
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (30_000, 30_000))
        topic = Topic("/t", tuple(Field(f"x{i}") for i in range(5)))
        try:
            with RunLog(sys.argv[1], [topic], {"seed": "1"}) as log:
                for k in range(6000):
                    log.write("/t", k * 10_000_000, [random.random() for _ in range(5)])
                    if k % 100 == 99:
                        log.flush()
        except RecordingError as error:
            print(error)
        """,
        path,
    )
    message, errors = process.communicate(timeout=60)
    assert not errors
    assert "no room" in message and "safe up to" in message and "free space" in message
    safe = float(message.split("safe up to ")[1].split(" s")[0])
    log = read_log(path)
    assert not log.complete and log.outcome == "died" and log.run["seed"] == "1"
    assert log.table("/t").time[-1] == pytest.approx(safe)
    assert safe > 2 and len(log.table("/t")) == round(safe * 100) + 1


def test_closing_on_a_full_disk_keeps_the_samples(path, monkeypatch) -> None:
    log = RunLog(path, [NUMBERS], {})
    log.write("/numbers", 1_000_000_000, (1.0, 1))
    log.flush()
    write = os.write

    def write_half(descriptor: int, data: memoryview) -> int:
        if len(data) < 10:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return write(descriptor, data[: len(data) // 2])

    monkeypatch.setattr(run_log.os, "write", write_half)
    with pytest.raises(RecordingError, match=r"safe up to 1\.000 s"):
        log.close("completed")
    log.close("completed")  # and again, as a `finally` would
    assert len(read_log(path).table("/numbers")) == 1


KILLED = """
    import sys
    from trms_cli.recordings.run_log import RunLog
    from trms_cli.recordings.topics import Field, Topic
    log = RunLog(sys.argv[1], [Topic("/t", (Field("x"),))], {"seed": "1"},
                 {"config.yaml": ("application/yaml", b"seed: 1")})
    k = 0
    while True:
        log.write("/t", k * 10_000_000, (float(k),))
        if k % 100 == 99:
            log.flush()
            print(k, flush=True)
        k += 1
"""


@pytest.mark.parametrize("seconds", [1, 7])
def test_sigkill_loses_nothing_that_was_flushed(path: Path, seconds: int) -> None:
    process = run_python(KILLED, path)
    assert process.stdout is not None
    told = [int(process.stdout.readline()) for _ in range(seconds)][-1]
    process.send_signal(signal.SIGKILL)
    process.communicate(timeout=60)
    log = read_log(path)
    assert not log.complete and log.outcome == "died"
    assert log.config == "seed: 1" and log.run["seed"] == "1" and "end" not in log.run
    table = log.table("/t")
    assert len(table) >= told + 1
    np.testing.assert_array_equal(table.columns["x"], np.arange(len(table)))


def test_ctrl_c_leaves_a_complete_marked_log(path: Path) -> None:
    head, loop = textwrap.dedent(KILLED).split("k = 0\n")
    guarded = f"{head}with log:\n" + textwrap.indent("k = 0\n" + loop, "    ")
    process = run_python(guarded, path)
    assert process.stdout is not None
    process.stdout.readline()
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert "KeyboardInterrupt" in errors
    log = read_log(path)
    assert log.complete and log.outcome == "interrupted"
    x = log.table("/t").columns["x"]
    np.testing.assert_array_equal(x, np.arange(len(x)))


def test_ctrl_c_within_a_flush_is_held_back(path, monkeypatch) -> None:
    write = os.write

    def interrupted(descriptor: int, data: memoryview) -> int:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.01)
        return write(descriptor, data)

    with pytest.raises(KeyboardInterrupt), RunLog(path, [NUMBERS], {}) as log:
        log.write("/numbers", 0, (1.0, 1))
        with monkeypatch.context() as patch:
            patch.setattr(run_log.os, "write", interrupted)
            log.flush()
    log_back = read_log(path)
    assert log_back.complete and log_back.outcome == "interrupted"
    assert len(log_back.table("/numbers")) == 1
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_an_exception_marks_the_log_failed(path: Path) -> None:
    with pytest.raises(ZeroDivisionError), RunLog(path, [NUMBERS], {}) as log:
        log.write("/numbers", 0, (1.0, 1))
        raise ZeroDivisionError
    assert read_log(path).outcome == "failed" and len(read_log(path).table("/numbers")) == 1


def test_a_run_without_samples_is_a_clean_log(path: Path) -> None:
    RunLog(path, [NUMBERS], {}).close("interrupted")
    log = read_log(path)
    assert log.complete and log.duration_s == 0.0 and len(log.table("/numbers")) == 0


def test_late_messages_are_put_in_order(path: Path) -> None:
    with RunLog(path, [NUMBERS], {}) as log:
        for time_ns in (30, 10, 20):
            log.write("/numbers", time_ns, (float(time_ns), 0))
    with path.open("rb") as file:
        times = [m.log_time for _, _, m in make_reader(file).iter_messages(log_time_order=False)]
    assert times == [10, 20, 30]


def test_absent_signals_make_no_topic():
    replayed = standard_topics(inputs=[Field("u_v", "V")], outputs=[Field("alpha_v", "rad")])
    names = [topic.name for topic in replayed]
    assert "/plant/state" not in names and "/reference" not in names
    assert names == ["/command", "/measurement", "/controller", "/event"]


def test_all_topics_of_the_file_contract(topics):
    assert {topic.name for topic in topics} == {
        "/reference",
        "/command",
        "/measurement",
        "/plant/state",
        "/estimate",
        "/controller",
        "/prediction",
        "/event",
    }
    estimate = next(topic for topic in topics if topic.name == "/estimate")
    assert set(estimate.field_names) == {
        *("omega_h", "alpha_h", "sd_omega_h", "sd_alpha_h"),
        *("predicted_alpha_v", "innovation_alpha_v", "innovation_sd_alpha_v"),
        *("predicted_alpha_h", "innovation_alpha_h", "innovation_sd_alpha_h"),
    }


def test_foxglove_accepts_the_schemas_and_units_stand_in_descriptions(topics):
    """Foxglove knows a subset of JSON schema: one type per property, typed array items."""
    for topic in topics:
        schema = topic.json_schema()
        assert schema["type"] == "object"
        assert schema["additionalProperties"] is False
        assert schema["title"] == topic.schema_name
        assert set(schema["required"]) == set(schema["properties"])
        for property_ in schema["properties"].values():
            assert property_["type"] in ("number", "integer", "string", "boolean", "array")
            if property_["type"] == "array":
                assert property_["items"]["type"] == "number"
        for field in topic.fields:
            text = field.json_schema()["description"]
            if field.kind in ("number", "integer", "array"):
                assert f"[{field.unit}]" in text


def test_a_field_named_twice_is_refused():
    with pytest.raises(ValueError, match="twice: x"):
        Topic("/t", (Field("x"), Field("x")))


@given(st.lists(st.integers(0, 7), min_size=1, max_size=6), st.integers(0, 5))
def test_a_thinned_topic_has_each_so_many_th_row_however_the_rows_come(
    tmp_path_factory, sizes: list[int], every: int
) -> None:
    """``sizes``: of the blocks of rows, a chunk each."""
    path = tmp_path_factory.mktemp("log") / "run.mcap"
    other = Topic("/other", (Field("x", "1"),))
    with RunLog(path, [NUMBERS, other], {}, every={"/numbers": every}) as log:
        begin = 0
        for size in sizes:
            times = list(range(begin, begin + size))
            log.write_rows(
                times,
                [10**18 + t for t in times],
                {"/numbers": [(float(t), t) for t in times], "/other": np.array([times]).T / 2},
            )
            log.flush()
            begin += size
    written = read_log(path)
    kept = [t for t in range(begin) if every and t % every == 0]
    for topic, name, values in (("/numbers", "b", kept), ("/other", "x", range(begin))):
        if values:
            table = written.table(topic)
            assert list(table.time_ns) == list(values)
            expected = np.array(values) / (2 if topic == "/other" else 1)
            np.testing.assert_array_equal(table.columns[name], expected)
    with path.open("rb") as file:
        stamps = [(m.log_time, m.publish_time) for _, _, m in make_reader(file).iter_messages()]
    assert all(published == 10**18 + time for time, published in stamps)


def test_messages_stand_in_the_order_of_time_and_the_index_finds_each(path: Path) -> None:
    """Rows are packed topic by topic; a reader of the file from front to end sees them by time."""
    other = Topic("/other", (Field("x", "1"),))
    with RunLog(path, [NUMBERS, other], {}) as log:
        log.write_rows([10, 30, 50], [0, 0, 0], {"/numbers": [(1.0, 1), (2.0, 2), (3.0, 3)]})
        log.event(30, "note", "test", "between")
        log.write_rows([20, 40], [0, 0], {"/other": np.array([[0.5], [1.5]])})
    with path.open("rb") as file:
        reader = make_reader(file)
        in_file = [m.log_time for _, _, m in reader.iter_messages(log_time_order=False)]
        assert in_file == [10, 20, 30, 30, 40, 50]
        numbers = reader.iter_messages(topics=["/numbers"], start_time=25, end_time=51)
        found = [(m.log_time, m.sequence, orjson.loads(m.data)) for _, _, m in numbers]
        assert found == [(30, 1, {"a": 2.0, "b": 2}), (50, 2, {"a": 3.0, "b": 3})]
