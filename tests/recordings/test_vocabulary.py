"""Recordings of a rig with names and units of its own: their roles, columns and conversions."""

import re
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from scipy.io import savemat

from trms_cli.core.errors import ConfigurationError, RecordingError
from trms_cli.identification.data import DataOptions, load_datasets
from trms_cli.models.model import Model, Signal
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.parameters import ParameterSet
from trms_cli.plants.replay import RecordedRig
from trms_cli.plants.sensors import Sensors
from trms_cli.recordings.channels import STANDARD, Vocabulary, reference_of, signal_of
from trms_cli.recordings.csv_recording import read_csv, write_csv
from trms_cli.recordings.export import export_log
from trms_cli.recordings.for_model import RecordedRun, Selection
from trms_cli.recordings.log_reader import read_log
from trms_cli.recordings.mcap_recording import write_mcap
from trms_cli.recordings.read import read_recording
from trms_cli.recordings.summary import outliers, summarise

N = 40
TIME = np.arange(N) * 0.01
COLUMNS = {
    "current": np.sin(3 * TIME),
    "position": 0.1 * np.sin(2 * TIME),
    "angle": 0.02 * np.cos(5 * TIME),
    "r_position": np.full(N, 0.1),
}


class Cart(Model):
    """One input and two outputs, none of them with a name of a twin rotor."""

    def __init__(self) -> None:
        self.name = "cart"
        self.parameters = ParameterSet([])
        self.states = (
            Signal("position", "m", "position of the cart"),
            Signal("angle", "rad", "angle of the pole"),
            Signal("velocity", "m/s", "velocity of the cart"),
        )
        self.inputs = (Signal("current", "A", "current of the motor"),)
        self.outputs = self.states[:2]
        self.disturbances = (Signal("force", "N"),)
        self.controlled = ("position",)
        self.input_limits = {"current": 5.0}

    def dynamics(self, x: ca.SX, u: ca.SX, p: ca.SX, w: ca.SX) -> ca.SX:
        return ca.vertcat(x[2], -x[1], u + w)


CART = Cart()


def csv(path: Path, header: str, columns: list[np.ndarray], above: str = "") -> Path:
    rows = "".join(
        ",".join(cell if isinstance(cell, str) else repr(float(cell)) for cell in row) + "\n"
        for row in zip(*columns, strict=True)
    )
    path.write_text(f"{above}{header}\n{rows}")
    return path


def plain(path: Path, names: str = "current[A],position[m],angle[rad]", above: str = "") -> Path:
    wanted = [name.partition("[")[0] for name in names.split(",")]
    return csv(path, f"t[s],{names}", [TIME, *(COLUMNS[name] for name in wanted)], above)


def read(path: Path, **options) -> RecordedRun:
    return Selection(sensors=Sensors(), **options).read(str(path), CART)[0]


class TestOfAModel:
    def test_its_signals_have_their_roles_and_units(self):
        own = Vocabulary.of(CART)
        assert own.of_role(own.channels, "input") == ["current"]
        assert own.of_role(own.channels, "output") == ["position", "angle", "velocity"]
        assert own.find("r_position").role == "reference" and own.find("d_load").role
        assert own.find("r_position").units == ("m",) and own.find("alpha_v") is None

    def test_one_of_a_twin_rotor_has_the_standard_names(self):
        for model in (Newtonian(), Newtonian(freedom="horizontal")):
            assert Vocabulary.of(model).channels is STANDARD.channels
            assert Vocabulary.of(model).origin == "standard"

    @pytest.mark.parametrize(("signal", "name"), [("alpha_h", "r_h"), ("position", "r_position")])
    def test_a_reference_is_named_by_its_signal(self, signal, name):
        assert reference_of(signal) == name and signal_of(name) == signal

    def test_a_recording_is_read_in_its_order_and_its_units(self, tmp_path):
        header = "t[ms],angle[deg],mode,r_position[cm],position[mm],current[mA],temp[degC]"
        c = COLUMNS
        scaled = [1e3 * TIME, np.rad2deg(c["angle"]), ["auto"] * N, 100 * c["r_position"]]
        scaled += [1e3 * c["position"], 1e3 * c["current"], np.full(N, np.inf)]
        run = read(csv(tmp_path / "rig.csv", header, scaled))
        np.testing.assert_allclose(run.commands[:, 0], c["current"], atol=1e-12)
        np.testing.assert_allclose(run.measurements.T, [c["position"], c["angle"]], atol=1e-12)
        np.testing.assert_allclose(run.references["position"], 0.1)
        assert run.sample_time == pytest.approx(0.01)
        assert "not used: mode, temp" in run.remarks  # whatever they hold, and in whatever unit

    def test_what_is_not_measured_is_said(self, tmp_path):
        run = read(plain(tmp_path / "rig.csv", "current[A],angle[rad]"))
        assert [s.name for s in run.outputs] == ["angle"]
        assert "not measured: position (position of the cart)" in run.remarks

    @pytest.mark.parametrize(
        ("header", "error", "problem", "remedy"),
        [
            (
                "current[A],positon[m]",
                RecordingError,
                "'positon'.*'position' is",
                "names={position",
            ),
            ("Current[A],position[m]", RecordingError, "'Current'.*'current' is", "names={current"),
            ("current[N],position[m]", RecordingError, "'current': the unit 'N'", r"\[A\]"),
            (
                "current[A],position[rad]",
                RecordingError,
                "'position'.*'rad' does not fit",
                r"\[m\]",
            ),
            ("current[A],position", RecordingError, "'position' has no unit", r"position\[m\]"),
            ("temperature[K],position[m]", RecordingError, "lacks an input", "of current is"),
            ("current[A],temperature[K]", RecordingError, "lacks an output", "position, angle"),
            ("current[%],position[m]", ConfigurationError, r"\[1\] \(share", r"\{current: 5\}"),
        ],
    )
    def test_what_is_wrong_is_told(self, tmp_path, header, error, problem, remedy):
        path = csv(tmp_path / "rig.csv", f"t[s],{header}", [TIME, TIME, TIME])
        with pytest.raises(error, match=problem) as caught:
            read(path)
        assert re.search(remedy, caught.value.remedy)
        assert "newtonian" not in caught.value.remedy

    def test_a_share_of_the_full_command_is_scaled(self, tmp_path):
        path = csv(
            tmp_path / "rig.csv",
            "t[s],current[%],position[m]",
            [TIME, 20 * COLUMNS["current"], COLUMNS["position"]],
        )
        run = read(path, input_scale={"current": 5.0})
        np.testing.assert_allclose(run.commands[:, 0], COLUMNS["current"], atol=1e-12)

    def test_what_resembles_an_output_that_nobody_takes_is_no_slip(self, tmp_path):
        path = csv(tmp_path / "rig.csv", "t[s],current[A],position[m],angel", [TIME] * 4)
        with pytest.raises(RecordingError, match="'angel'"):
            read(path)
        run = Selection(sensors=Sensors(channels=("position",))).read(str(path), CART)[0]
        assert [s.name for s in run.outputs] == ["position"]


class TestNames:
    """``data.names``: the column of a signal."""

    @pytest.fixture
    def file(self, tmp_path) -> Path:
        c = COLUMNS
        columns = [TIME, 1e3 * c["position"], c["current"], c["angle"], c["position"] + 1]
        return csv(tmp_path / "rig.csv", "time[s],q[mm],tau[A],angle[rad],position[m]", columns)

    def test_columns_are_taken_by_the_names_given(self, file):
        run = read(file, names={"t": "time", "position": "q", "current": "tau"})
        np.testing.assert_allclose(run.measurements[:, 0], COLUMNS["position"], atol=1e-12)
        np.testing.assert_allclose(run.commands[:, 0], COLUMNS["current"])
        assert "not used: position" in run.remarks  # the file's own, which was not meant

    def test_of_a_twin_rotor(self, tmp_path):
        path = csv(tmp_path / "rig.csv", "t[s],u_v[V],u_h[V],elevation[deg]", [TIME] * 4)
        names = {"alpha_v": "elevation"}
        run = Selection(sensors=Sensors(), names=names).read(str(path), Newtonian())[0]
        np.testing.assert_allclose(run.measurements[:, 0], np.deg2rad(TIME))

    @pytest.mark.parametrize(
        ("names", "error", "problem"),
        [
            ({"position": "p"}, RecordingError, "no column 'p', which is to be position"),
            ({"positon": "q"}, ConfigurationError, "no signal 'positon'"),
            ({"position": "q", "angle": "q"}, ConfigurationError, "'q' is given twice"),
        ],
    )
    def test_what_is_wrong_is_told_by_the_key(self, file, names, error, problem):
        with pytest.raises(error, match=problem) as caught:
            load_datasets(str(file), CART, DataOptions(names=names))
        assert caught.value.where.startswith("data.names" if error is ConfigurationError else "/")

    def test_a_replay_takes_them_too(self, file):
        names = {"t": "time", "position": "q", "current": "tau"}
        run = RecordedRig(file=str(file), names=names).load(CART)
        np.testing.assert_allclose(run.measurements[:, 0], COLUMNS["position"], atol=1e-12)


class TestWithoutAModel:
    def test_a_file_tells_the_roles_of_its_columns(self, tmp_path):
        above = "# inputs: current\n# outputs: position, angle\n"
        path = plain(
            tmp_path / "rig.csv", "current[mA],position[m],angle[deg],r_position[m]", above
        )
        recording = read_recording(path)
        assert recording.names("input") == ["current"]
        assert recording.names("output") == ["position", "angle"]
        assert recording.names("reference") == ["r_position"]
        assert recording.units["current"] == "A" and recording.units["angle"] == "rad"
        assert summarise(recording).channels["position"].turns is not None

    @pytest.mark.parametrize(
        ("above", "problem", "remedy"),
        [
            ("", "'current' is not known", "# inputs: NAME"),
            ("# inputs: current\n", "'position' is not known", "# outputs: NAME"),
            ("# inputs: tau\n# outputs: position\n", "no column 'tau'", "allowed"),
        ],
    )
    def test_roles_that_are_not_known_are_told(self, tmp_path, above, problem, remedy):
        path = plain(tmp_path / "rig.csv", "current[A],position[m]", above)
        with pytest.raises(RecordingError, match=problem) as caught:
            read_recording(path)
        assert remedy in caught.value.remedy and str(path) in caught.value.where

    def test_words_of_a_twin_rotors_file_are_metadata(self, tmp_path):
        text = "# inputs: two motors\nt[s],u_v[V],alpha_v[rad]\n0,0,0\n1,0,0\n"
        (tmp_path / "rig.csv").write_text(text)
        recording = read_csv(tmp_path / "rig.csv")
        assert recording.vocabulary is STANDARD and recording.metadata["inputs"] == "two motors"

    def test_it_goes_through_all_formats(self, tmp_path):
        above = "# inputs: current\n# outputs: position, angle\n"
        names = "current[A],position[m],angle[rad],r_position[m]"
        first = read_recording(plain(tmp_path / "rig.csv", names, above))
        write_mcap(first, tmp_path / "rig.mcap", {"imported": "true"})
        log = read_log(tmp_path / "rig.mcap")
        assert list(log.tables["/reference"].columns) == ["position"]
        for ending in ("csv", "mat"):
            export_log(log, tmp_path / f"again.{ending}", ending)
        write_csv(replace(first, metadata={}), tmp_path / "third.csv")
        for path in ("rig.mcap", "again.csv", "again.mat", "third.csv"):
            for vocabulary in (None, Vocabulary.of(CART)):
                back = read_recording(tmp_path / path, vocabulary)
                assert back.units == first.units, path
                for role in ("input", "output", "reference"):
                    assert back.names(role) == first.names(role), (path, role)
                for name, values in first.channels.items():
                    np.testing.assert_allclose(back.channels[name], values, atol=1e-15)

    def test_vectors_of_matlab(self, tmp_path):
        vectors = {"t": TIME, **COLUMNS, "gain": 3.0, "units": {"position": "mm"}}
        path = tmp_path / "rig.mat"
        savemat(path, vectors)
        run = read(path)
        np.testing.assert_allclose(run.measurements[:, 0], 1e-3 * COLUMNS["position"])
        assert "variables not used: gain" in run.remarks
        with pytest.raises(RecordingError, match="lacks an input"):
            read_recording(path)
        savemat(path, vectors | {"inputs": "current", "outputs": "position, angle"})
        recording = read_recording(path)
        assert recording.names("output") == ["position", "angle"] and recording.units["current"]


class TestNoise:
    """What the bench's defaults declare says nothing of a rig with other names."""

    BENCH = DataOptions(noise_sd={"omega_v": 1.6}, quantum={"alpha_v": 1.5e-3})

    def test_what_is_not_declared_is_estimated_and_told(self, tmp_path):
        generator = np.random.default_rng(0)
        time = np.arange(2000) * 0.01
        position = 0.1 * np.sin(time) + generator.normal(0, 2e-4, len(time))
        angle = np.round(0.3 * np.sin(time) / 1e-3) * 1e-3
        columns = [time, np.sign(np.sin(7 * time)), position, angle]
        path = csv(tmp_path / "rig.csv", "t[s],current[A],position[m],angle[rad]", columns)
        (dataset,) = load_datasets(str(path), CART, self.BENCH)
        np.testing.assert_allclose(dataset.noise_sd[0], 2e-4, rtol=0.1)
        assert dataset.noise_sd[1] >= 1e-3 / 12**0.5  # an encoder's step shows in its levels
        assert any("noise estimated from the data: position" in r for r in dataset.remarks)
        replayed = RecordedRig(file=str(path), sensors=self.BENCH.sensors()).load(CART)
        assert list(replayed.noise_sd.values()) == dataset.noise_sd.tolist()
        declared = DataOptions(noise_sd={"position": 5e-4}, quantum={"angle": 0.0})
        (dataset,) = load_datasets(str(path), CART, declared)
        assert dataset.noise_sd.tolist() == [5e-4, 1e-6]
        (dataset,) = load_datasets(str(path), CART, DataOptions())
        assert dataset.noise_sd.tolist() == [1e-6, 1e-6]  # nothing at all is declared


def test_a_fast_motion_with_little_noise_has_no_outliers_where_it_turns():
    time = np.arange(4000) * 0.01
    motion = 0.2 * np.sin(9 * time) + np.random.default_rng(0).normal(0, 2e-5, len(time))
    assert outliers(motion).sum() <= 4
    slow = motion * np.linspace(0, 1, len(time))  # the same with spikes where it is slow
    slow[[50, 120, 300]] += 0.05
    assert outliers(slow)[[50, 120, 300]].all()
