"""What ``real`` and ``data`` mean: files found, channels taken, preparation done and told."""

import hashlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.recordings.played_rig import BENCH, play
from trms_cli.core.errors import ConfigurationError, RecordingError
from trms_cli.identification.data import DataOptions, files_of, load_datasets
from trms_cli.models.newtonian import Newtonian
from trms_cli.plants.sensors import noise_estimate
from trms_cli.recordings.csv_recording import write_csv

MODEL = Newtonian()
DECLARED = DataOptions(noise_sd=dict(BENCH.noise_sd), quantum=dict(BENCH.quantum))


@pytest.fixture(scope="module")
def file(tmp_path_factory) -> Path:
    recording = play("prbs", duration=30.0)
    path = tmp_path_factory.mktemp("data") / "monday.csv"
    write_csv(replace(recording, metadata={"loop": "open"}), path)
    return path


def test_everything_of_the_model_is_taken(file):
    (dataset,) = load_datasets(str(file), MODEL, DECLARED)
    assert dataset.name == "monday" and len(dataset) == 1500
    assert [s.name for s in dataset.inputs] == ["u_v", "u_h"]
    assert {s.name for s in dataset.outputs} == {"alpha_v", "alpha_h", "omega_v", "omega_h"}
    assert dataset.sha256 == hashlib.sha256(file.read_bytes()).hexdigest()
    expected = np.hypot(1.6, 0.49 / 12**0.5)
    index = [s.name for s in dataset.outputs].index("omega_v")
    assert dataset.noise_sd[index] == pytest.approx(expected)
    assert np.isfinite(dataset.commands).all()
    # Missing outputs are no matter.
    (dataset,) = load_datasets(str(file), MODEL, DataOptions(channels=("alpha_v",)))
    assert dataset.measurements.shape == (1500, 1)
    (vertical,) = load_datasets(str(file), Newtonian(freedom="vertical"), DECLARED)
    assert vertical.commands.shape == (1500, 1)


def test_a_delayed_command_acts_later_and_an_offset_is_added_and_told(file):
    (plain,) = load_datasets(str(file), MODEL)
    (late,) = load_datasets(str(file), MODEL, DataOptions(command_delay=2))
    np.testing.assert_array_equal(late.commands[2:], plain.commands[:-2])
    (moved,) = load_datasets(str(file), MODEL, DataOptions(offset={"alpha_v": -0.62}))
    np.testing.assert_allclose(moved.output("alpha_v"), plain.output("alpha_v") - 0.62)
    np.testing.assert_array_equal(moved.output("alpha_h"), plain.output("alpha_h"))
    assert any("-0.62 rad added to alpha_v" in remark for remark in moved.remarks)
    with pytest.raises(ConfigurationError, match="u_v"):
        load_datasets(str(file), MODEL, DataOptions(offset={"u_v": 1.0}))


def test_the_estimated_noise_is_that_of_the_sensors(file):
    (dataset,) = load_datasets(str(file), MODEL, DataOptions(noise_sd="estimate"))
    index = [s.name for s in dataset.outputs].index("omega_v")
    assert dataset.noise_sd[index] == pytest.approx(1.6, rel=0.15)
    assert any("noise estimated" in remark for remark in dataset.remarks)


@pytest.mark.parametrize("sd", [0.1, 1.0, 30.0])
def test_white_noise_on_a_smooth_motion_is_estimated(sd):
    time = np.arange(5000) * 0.02
    generator = np.random.default_rng(1)
    values = 100 * np.sin(time) + generator.normal(0, sd, 5000)
    values[::50] = np.nan
    values[7::100] += 40 * sd
    assert noise_estimate(values[:, None])[0] == pytest.approx(sd, rel=0.12)


def test_preparation_is_done_and_told(file):
    options = DataOptions(resample=0.04, outliers="mark", delays={"omega_h": 0.02}, gaps=0.1)
    (dataset,) = load_datasets(str(file), MODEL, options)
    assert dataset.sample_time == pytest.approx(0.04)
    words = " ".join(dataset.remarks)
    assert "resampled" in words and "moved earlier" in words and "filled" in words


def test_a_recording_is_split_at_its_gaps(file, tmp_path):
    lines = file.read_text().splitlines()
    (tmp_path / "gappy.csv").write_text("\n".join(lines[:600] + lines[700:]) + "\n")
    parts = load_datasets(str(tmp_path / "gappy.csv"), MODEL, DataOptions(gaps="split"))
    assert [len(p) for p in parts] == [598, 802]
    assert [p.name for p in parts] == ["gappy", "gappy-2"]
    (whole,) = load_datasets(str(tmp_path / "gappy.csv"), MODEL)
    assert len(whole) == 1500 and np.isnan(whole.measurements).any()


class TestFiles:
    def test_patterns_folders_and_lists(self, tmp_path):
        for name in ("b.csv", "a.csv"):
            (tmp_path / name).touch()
        (tmp_path / "night").mkdir()
        (tmp_path / "night" / "run.mcap").touch()
        assert files_of(f"{tmp_path}/*.csv") == [f"{tmp_path}/a.csv", f"{tmp_path}/b.csv"]
        assert files_of(str(tmp_path / "night")) == [str(tmp_path / "night" / "run.mcap")]
        assert len(files_of([f"{tmp_path}/a.csv", f"{tmp_path}/night"])) == 2

    @pytest.mark.parametrize("real", [[], "*.nothing", ["x.csv", "x.csv"], "."])
    def test_nothing_and_twice_are_refused(self, real, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        with pytest.raises(ConfigurationError, match="holds no" if real == "." else None) as error:
            files_of(real)
        assert error.value.where == "real"


class TestErrorsNameTheKeysGiven:
    def test_another_unit(self, tmp_path):
        path = tmp_path / "normalised.csv"
        path.write_text("t[s],u_v[1],u_h[1],alpha_v[rad]\n0,1,1,0\n0.1,1,1,0\n0.2,1,0,1\n")
        with pytest.raises(ConfigurationError) as error:
            load_datasets(str(path), MODEL)
        assert error.value.where == "real" and "data.input_scale" in error.value.remedy

    def test_uneven_rows(self, tmp_path):
        path = tmp_path / "uneven.csv"
        rows = "\n".join(f"{t},1,1,0.1" for t in (0, 0.1, 0.2, 0.33, 0.4, 0.5, 0.57))
        path.write_text(f"t[s],u_v[V],u_h[V],alpha_v[rad]\n{rows}\n")
        with pytest.raises(RecordingError) as error:
            load_datasets(str(path), MODEL)
        assert "data.resample" in error.value.remedy
        (even,) = load_datasets(str(path), MODEL, DataOptions(resample=0.1))
        assert len(even) == 6

    @pytest.mark.parametrize(
        ("options", "where"),
        [
            ({"start": 500.0}, "data.start"),
            ({"channels": ("alpha",)}, "data.channels"),
            ({"delays": {"alpha": 0.1}}, "data.delays.alpha"),
        ],
        ids=["a part beyond the end", "an unknown channel", "a delay of an unknown channel"],
    )
    def test_what_the_file_does_not_hold(self, options, where, file):
        kind = RecordingError if "delays" in options else ConfigurationError
        with pytest.raises(kind) as error:
            load_datasets(str(file), MODEL, DataOptions(**options))
        assert error.value.where == where
