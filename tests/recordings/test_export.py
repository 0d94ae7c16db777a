"""Logs as CSV, Parquet and MAT: the same numbers, with their units."""

import errno
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from scipy.io import loadmat

from trms_cli.core import whole_file
from trms_cli.core.errors import ConfigurationError, RecordingError
from trms_cli.recordings.export import export_log
from trms_cli.recordings.log_reader import LoggedRun, read_log
from trms_cli.recordings.read import read_recording
from trms_cli.recordings.run_log import RunLog


@pytest.fixture
def log(tmp_path: Path, write_run: Callable[..., Path]) -> LoggedRun:
    return read_log(write_run(tmp_path / "run.mcap", 120))


@pytest.mark.parametrize("close", [True, False])
@pytest.mark.parametrize(("format_", "rounding"), [("csv", 0.0), ("mat", 1e-12)])
def test_a_run_comes_back_a_dead_one_as_far_as_it_goes(
    tmp_path, write_run, format_, rounding, close
) -> None:
    log = read_log(write_run(tmp_path / "run.mcap", 60, close=close))
    export_log(log, tmp_path / f"run.{format_}", format_)
    direct, exported = read_recording(log.path), read_recording(tmp_path / f"run.{format_}")
    np.testing.assert_allclose(exported.time, direct.time, rtol=0, atol=rounding)
    assert exported.units == direct.units and exported.metadata == direct.metadata
    assert list(exported.channels) == list(direct.channels) and "r_v" in exported.channels
    for name, values in direct.channels.items():
        np.testing.assert_array_equal(exported.channels[name], values)
    assert bool(exported.remarks) == (format_ == "mat" and not close)  # a CSV holds no remark


def test_parquet_joins_all_topics_on_time(tmp_path: Path, log: LoggedRun) -> None:
    out = tmp_path / "run.parquet"
    export_log(log, out, "parquet")
    table = pq.read_table(out)
    assert table.schema.field("measurement.alpha_v").metadata == {b"unit": b"rad"}
    assert table.schema.metadata[b"config.yaml"].decode() == log.config
    np.testing.assert_array_equal(np.array(table["time"]), log.table("/command").time)
    rows = table.to_pylist()
    assert rows[3]["command.u_v"] == 4.0 and rows[3]["measurement.alpha_h"] is None
    assert rows[3]["controller.status"] == "optimal" and rows[3]["prediction.time"] is None
    assert rows[0]["prediction.time"] == pytest.approx([0, 0.1, 0.2, 0.3])
    np.testing.assert_array_equal(np.array(table["command.u_v"]), np.arange(1.0, 121.0))
    assert [k for k, row in enumerate(rows) if row["event.kind"] is not None] == [5]
    assert rows[5]["event.kind"] == ["saturation", "note"]


def test_parquet_has_one_row_a_sample_time_whatever_happens_then(tmp_path, topics) -> None:
    with RunLog(tmp_path / "run.mcap", topics, {}) as run:
        run.event(0, "fault", "rig", "before the first sample")
        for time_ns in (10, 20, 30):
            run.write("/command", time_ns * 10**6, (1.0, 2.0))
        run.event(20 * 10**6, "saturation_begin", "u_v", "at its limit", 3.0)
        run.event(20 * 10**6, "note", "person", "pushed the beam")
        run.event(27 * 10**6, "gap", "recording", "between two samples", 0.5)
        run.event(99 * 10**6, "note", "person", "after the last sample")
    export_log(read_log(tmp_path / "run.mcap"), tmp_path / "run.parquet", "parquet")
    table = pq.read_table(tmp_path / "run.parquet")
    rows = table.to_pylist()
    assert [row["time"] for row in rows] == [0.01, 0.02, 0.03]
    assert [row["command.u_v"] for row in rows] == [1.0, 1.0, 1.0]
    assert rows[0]["event.kind"] == ["fault"] and rows[2]["event.time"] == [0.099]
    assert rows[1]["event.time"] == [0.02, 0.02, 0.027]
    assert rows[1]["event.kind"] == ["saturation_begin", "note", "gap"]
    assert rows[1]["event.value"] == [3.0, None, 0.5]
    assert table.schema.field("event.time").metadata == {b"unit": b"s"}
    with RunLog(tmp_path / "events.mcap", topics, {}) as run:
        run.event(0, "fault", "rig", "at once")
    with pytest.raises(RecordingError, match="no sample"):
        export_log(read_log(tmp_path / "events.mcap"), tmp_path / "events.parquet", "parquet")


def test_mat_has_a_struct_per_topic(tmp_path: Path, log: LoggedRun) -> None:
    out = tmp_path / "run.mat"
    export_log(log, out, "mat")
    content = loadmat(out, simplify_cells=True)
    state = content["plant_state"]
    np.testing.assert_array_equal(state["omega_h"], np.arange(120.0))
    assert state["units"]["omega_h"] == "rad/s" and state["units"]["time"] == "s"
    assert content["prediction"]["time_from_now"].shape == (12, 4)
    assert list(content["event"]["kind"]) == ["saturation", "note"]
    assert content["run"]["seed"] == "3" and content["config"] == log.config


def test_a_dead_runs_log_becomes_parquet_as_far_as_it_goes(tmp_path, write_run) -> None:
    log = read_log(write_run(tmp_path / "run.mcap", 20, close=False))
    export_log(log, tmp_path / "out", "parquet")
    assert pq.read_table(tmp_path / "out").num_rows == 20


@pytest.mark.parametrize("format_", ["csv", "parquet", "mat"])
def test_never_half_and_never_over(tmp_path, log, format_, monkeypatch) -> None:
    out = tmp_path / "there"
    out.write_text("mine")
    with pytest.raises(RecordingError, match="already") as caught:
        export_log(log, out, format_)
    assert "--force" in caught.value.remedy and out.read_text() == "mine"

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(whole_file.os, "replace", full)
        with pytest.raises(RecordingError, match="no room"):
            export_log(log, out, format_, force=True)
    assert out.read_text() == "mine"
    export_log(log, out, format_, force=True)
    assert out.read_bytes()[:4] != b"mine"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["run.mcap", "there"]


def test_a_folder_in_the_way_and_an_unknown_format_are_refused(
    tmp_path: Path, log: LoggedRun
) -> None:
    for force in (False, True):
        with pytest.raises(RecordingError, match="a folder of this name"):
            export_log(log, tmp_path, "csv", force=force)
    with pytest.raises(ConfigurationError, match="'xml'") as caught:
        export_log(log, tmp_path / "x", "xml")
    assert "parquet" in caught.value.remedy
