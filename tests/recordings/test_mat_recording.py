"""MAT recordings, as MATLAB's save() writes them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat

from trms_cli.core.errors import RecordingError
from trms_cli.recordings.recording import read_recording

GOOD: dict[str, Any] = {
    "t": np.array([[0.0], [0.1], [0.2]]),
    "u_v": np.array([1.0, 2.0, 3.0]),
    "alpha_v": np.array([10.0, np.nan, 30.0]),
}


def test_vectors_and_units(tmp_path: Path) -> None:
    path = tmp_path / "rec.mat"
    savemat(path, {**GOOD, "units": {"alpha_v": "deg"}, "rig": "bench", "gain": np.eye(2)})
    recording = read_recording(path)
    np.testing.assert_allclose(recording.channels["alpha_v"], np.deg2rad(GOOD["alpha_v"]))
    assert recording.units == {"u_v": "V", "alpha_v": "rad"}
    assert recording.metadata == {"rig": "bench"} and recording.missing == {"alpha_v": 1}
    assert recording.notes()[0] == "variables not used: gain"


def test_one_struct_is_opened(tmp_path: Path) -> None:
    path = tmp_path / "rec.mat"
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
