"""A recording's own words, its levels, and its way through a log."""

import errno
import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trms_cli.core.errors import RecordingError
from trms_cli.recordings import run_log
from trms_cli.recordings.log_reader import read_log
from trms_cli.recordings.mcap_recording import write_mcap
from trms_cli.recordings.read import read_recording
from trms_cli.recordings.recording import Recording, on_grid, quantum
from trms_cli.recordings.run_log import RunLog
from trms_cli.recordings.topics import Field, standard_topics


@given(
    step=st.floats(1e-4, 10.0),
    offset=st.floats(-1, 1),
    levels=st.lists(st.integers(-50, 50), min_size=3, max_size=100, unique=True),
)
def test_the_quantum_of_an_encoder(step: float, offset: float, levels: list[int]) -> None:
    used = [*levels, levels[0] + 1]  # neighbours occur, as in any real recording
    found = quantum(offset + step * np.array(used, dtype=float))
    assert found == pytest.approx(step, rel=1e-3)


def test_the_quantum_of_what_has_none_and_seen_through_rounding() -> None:
    rng = np.random.default_rng(0)
    assert quantum(np.ones(10)) is None
    assert quantum(np.full(10, np.nan)) is None
    assert quantum(rng.standard_normal(1000)) is None
    turns = np.round(np.arange(200) * 2 * np.pi / 4096, 6)
    assert quantum(turns) == pytest.approx(2 * np.pi / 4096, rel=1e-4)


def test_a_recording_goes_through_a_log(path: Path, recording: Recording) -> None:
    write_mcap(recording, path, {"imported": "true", "file": "rec.csv"})
    back = read_recording(path)
    np.testing.assert_array_equal(back.time, recording.time)
    assert back.metadata == recording.metadata and back.units == recording.units
    assert back.duration_s == 0.1
    for name, values in recording.channels.items():
        np.testing.assert_array_equal(back.channels[name], values)
    log = read_log(path)
    assert set(log.tables) == {"/command", "/measurement", "/reference", "/event"}
    assert log.run["recording.rig"] == "bench" and log.run["imported"] == "true"
    assert list(log.table("/event").columns["kind"]) == ["gap"]


def test_times_before_zero_and_currents_and_disturbances_survive(tmp_path: Path) -> None:
    names = {"u_v": "1", "omega_h": "rad/s", "i_h": "A", "d_push": "N*m"}
    recording = Recording(
        np.array([-0.5, -0.25, 0.0]),
        {name: np.array([1.0, 2.0, np.nan]) for name in names},
        dict(names),
        {"outcome": "good", "schema": "mine"},  # words that the log has a meaning for
    )
    path = tmp_path / "rec.mcap"
    write_mcap(recording, path, {"imported": "true"})
    back = read_recording(path)
    np.testing.assert_array_equal(back.time, recording.time)
    assert back.units == names and back.metadata == recording.metadata
    np.testing.assert_array_equal(back.channels["d_push"], [1.0, 2.0, np.nan])
    assert read_log(path).outcome == "completed"


def test_a_full_disk_leaves_no_half_log(tmp_path, recording, monkeypatch) -> None:
    def refuse(*_: object) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    path = tmp_path / "rec.mcap"
    monkeypatch.setattr(run_log.os, "write", refuse)
    with pytest.raises(RecordingError, match="no room") as caught:
        write_mcap(recording, path, {})
    assert caught.value.where == str(path) and "safe" not in caught.value.problem
    assert not list(tmp_path.iterdir())


def test_slow_commands_are_held_between_their_samples(tmp_path: Path) -> None:
    topics = standard_topics(inputs=[Field("u_v", "V")], outputs=[Field("alpha_v", "rad")])
    path = tmp_path / "run.mcap"
    with RunLog(path, topics, {}) as log:
        for k in range(6):
            log.write("/measurement", k * 10, (float(k),))
            if k in (1, 4):
                log.write("/command", k * 10, (float(k),))
    u = read_recording(path).channels["u_v"]
    np.testing.assert_array_equal(u, [np.nan, 1, 1, 1, 4, 4])


def test_a_log_without_samples_is_no_recording(tmp_path: Path, topics: list) -> None:
    path = tmp_path / "run.mcap"
    RunLog(path, topics, {}).close("failed")
    with pytest.raises(RecordingError, match="0 measurements"):
        read_recording(path)


@pytest.mark.parametrize("name", ["rec.xlsx", "rec", "rec.mcapp"])
def test_unknown_endings_and_folders_are_no_recordings(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("x")
    with pytest.raises(RecordingError, match="no format") as caught:
        read_recording(tmp_path / name)
    assert ".csv" in caught.value.remedy
    with pytest.raises(RecordingError, match="folder"):
        read_recording(tmp_path)


@pytest.mark.parametrize(
    ("degrees", "told"), [(9000.0, "157.1 rad (9000°)"), (-400.0, "6.981 rad (400°)"), (359.0, "")]
)
def test_an_angle_of_more_than_a_turn_is_doubted(degrees: float, told: str) -> None:
    angle = np.deg2rad([0.0, degrees, np.nan, 0.0])
    recording = Recording(
        np.arange(4.0),
        {"u_v": np.zeros(4), "alpha_v": angle, "omega_v": np.full(4, 300.0)},
        {"u_v": "V", "alpha_v": "rad", "omega_v": "rad/s"},
    )
    doubts = [note for note in recording.notes() if "full turn" in note]
    assert len(doubts) == (1 if told else 0)
    assert not told or f"alpha_v reaches {told}" in doubts[0]


@pytest.mark.parametrize("independent", [True, False])
def test_a_clock_that_jitters_has_no_gaps(independent):
    random = np.random.default_rng(1)
    late = random.normal(0, 0.004, 3000)
    steps = np.maximum(0.02 + late, 0.002)
    time = np.cumsum(steps) if independent else np.sort(0.02 * np.arange(3000) + late)
    recording = Recording(time, {}, {})
    assert recording.gaps == []
    assert any("the clock jitters and hardly any" in note for note in recording.notes())
    lost = np.delete(time, slice(1000, 1030))
    assert len(Recording(lost, {}, {}).gaps) == 1


def test_samples_that_are_lost_are_no_jitter_and_a_slow_clock_is_told():
    recording = Recording(np.delete(0.02 * np.arange(300), [40, 90, 170, 171]), {}, {})
    assert len(recording.gaps) == 3
    assert "3 gaps in t, about 4 samples in all" in recording.notes()[0]
    assert any("t[ms]" in note for note in Recording(20.0 * np.arange(50), {}, {}).notes())


def test_no_larger_jitter_is_advised_than_can_be_told():
    time = 0.02 * np.arange(100.0)
    for late, advised in ((0.006, True), (0.0098, False)):
        shaken = time.copy()
        shaken[50] += late
        with pytest.raises(RecordingError) as error:
            on_grid(Recording(shaken, {}, {}), 0.2)
        assert ("plant.jitter=" in str(error.value.remedy)) is advised
        assert "data.resample" in str(error.value.remedy)
