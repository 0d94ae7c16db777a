"""MAT recordings, as MATLAB's save() writes them."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat

from trms_cli.core.errors import RecordingError
from trms_cli.recordings.export import export_log
from trms_cli.recordings.log_reader import read_log
from trms_cli.recordings.mcap_recording import write_mcap
from trms_cli.recordings.read import read_recording
from trms_cli.recordings.recording import Recording

GOOD: dict[str, Any] = {
    "t": np.array([[0.0], [0.1], [0.2]]),
    "u_v": np.array([1.0, 2.0, 3.0]),
    "alpha_v": np.array([10.0, np.nan, 30.0]),
}


def test_vectors_and_units_alone_or_in_one_struct(tmp_path: Path) -> None:
    path = tmp_path / "rec.mat"
    savemat(path, {**GOOD, "units": {"alpha_v": "deg"}, "rig": "bench", "gain": np.eye(2)})
    recording = read_recording(path)
    np.testing.assert_allclose(recording.channels["alpha_v"], np.deg2rad(GOOD["alpha_v"]))
    assert recording.units == {"u_v": "V", "alpha_v": "rad"}
    assert recording.metadata == {"rig": "bench"} and recording.missing == {"alpha_v": 1}
    assert recording.notes()[0] == "variables not used: gain"
    savemat(path, {"run1": GOOD})
    assert len(read_recording(path)) == 3


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"u_v": np.ones(2)}, "'u_v' has 2 samples, t has 3"),
        ({"u_v": np.ones((3, 3))}, "'u_v' is not a vector"),
        ({"u_v": "text"}, "'u_v' is not a vector"),
        ({"u_v": np.array([1, np.inf, 1])}, r"u_v\(2\) is not finite"),
        ({"t": np.array([0.0, 0.2, 0.1])}, r"does not rise at t\(3\)"),
        ({"t": np.array([0.0, np.nan, 0.1])}, r"does not rise at t\(2\)"),
        ({"t": 0.0, "u_v": 1.0, "alpha_v": 1.0}, "single sample"),
        ({"units": {"alpha_v": "V"}}, "'V' does not fit"),
        ({"units": "deg"}, "not a struct"),
        ({"t": None}, "lacks time"),
        ({"alpha_v": np.full(3, np.nan)}, "no output has a single value"),
    ],
)
def test_what_is_wrong_is_told(tmp_path: Path, change: dict[str, Any], problem: str) -> None:
    path = tmp_path / "rec.mat"
    savemat(path, {k: v for k, v in {**GOOD, **change}.items() if v is not None})
    with pytest.raises(RecordingError, match=problem) as caught:
        read_recording(path)
    assert str(path) in caught.value.where and caught.value.remedy


def test_not_a_mat_file(tmp_path: Path) -> None:
    path = tmp_path / "rec.mat"
    for content in (
        b"",
        b"hello",
        b"MATLAB 7.3 MAT-file" + b" " * 105 + b"\x00\x02IM" + b"\0" * 64,
    ):
        path.write_bytes(content)
        with pytest.raises(RecordingError):
            read_recording(path)


def test_an_imported_recording_comes_back_from_mat(tmp_path: Path, recording: Recording) -> None:
    shifted = replace(recording, time=recording.time - 0.5)
    write_mcap(shifted, tmp_path / "rec.mcap", {"imported": "true"})
    export_log(read_log(tmp_path / "rec.mcap"), tmp_path / "rec.mat", "mat")
    back = read_recording(tmp_path / "rec.mat")
    np.testing.assert_allclose(back.time, shifted.time, rtol=0, atol=1e-12)
    assert back.metadata == recording.metadata
    for name, values in recording.channels.items():
        np.testing.assert_array_equal(back.channels[name], values)


NESTED: dict[str, Any] = {
    "measurement": {
        "time": np.array([0.0, 0.1, 0.2]),
        "alpha_v": np.array([0.0, 90.0, np.nan]),
        "units": {"alpha_v": "deg"},
    },
    "command": {"time": np.array([0.0, 0.15]), "u_v": np.array([1.0, 2.0])},
}


def test_a_struct_per_topic_by_hand(tmp_path: Path) -> None:
    savemat(tmp_path / "rec.mat", NESTED)
    recording = read_recording(tmp_path / "rec.mat")
    np.testing.assert_allclose(recording.channels["alpha_v"], [0.0, np.pi / 2, np.nan])
    np.testing.assert_array_equal(recording.channels["u_v"], [1.0, 1.0, 2.0])  # held


@pytest.mark.parametrize(
    ("topic", "change", "problem"),
    [
        ("command", {"u_v": np.ones(3)}, "'command.u_v' has 3 samples, command.time has 2"),
        ("measurement", {"time": np.array([0.0, 0.2, 0.1])}, r"at measurement.time\(3\)"),
        ("measurement", {"units": {"alpha_v": "V"}}, "'V' does not fit"),
        ("measurement", {"units": "deg"}, "'measurement.units' is not a struct"),
        ("measurement", {"time": None}, "'measurement' is not a struct with a time"),
        ("command", None, "has no /command"),
        ("command", {"u_v": None}, "lacks an input"),
    ],
)
def test_what_is_wrong_with_a_topic_is_told(tmp_path, topic, change, problem) -> None:
    struct = {k: v for k, v in {**NESTED[topic], **(change or {})}.items() if v is not None}
    content = {"complete": True, **NESTED, topic: struct}
    if change is None:
        del content[topic]
    savemat(tmp_path / "rec.mat", content)
    with pytest.raises(RecordingError, match=problem) as caught:
        read_recording(tmp_path / "rec.mat")
    assert str(tmp_path / "rec.mat") in caught.value.where and caught.value.remedy
