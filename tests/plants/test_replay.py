"""A recording as a rig: what is taken from it, and what is said when it does not fit."""

from pathlib import Path

import numpy as np
import pytest

from trms_cli.core.errors import ConfigurationError, RecordingError
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.tras import Tras
from trms_cli.plants.plant import PlantSetup
from trms_cli.plants.replay import RecordedRig
from trms_cli.plants.sensors import Sensors

HEADER = "t[s],u_v[V],u_h[V],alpha_v[rad],alpha_h[rad],omega_v[rad/s],omega_h[rad/s],r_v[rad]"


@pytest.fixture
def write(tmp_path: Path):
    """A CSV of `rows` samples at 50 Hz: u_v counts the rows, alpha_v is a tenth of it."""

    def write(rows: int = 10, header: str = HEADER, change=lambda k, cells: cells) -> str:
        lines = [header]
        for k in range(rows):
            cells = [f"{k * 0.02:.5f}", f"{k}", "0.5", f"{k / 10}", "0.2", "10", "20", "0.3"]
            cells = change(k, cells[: header.count(",") + 1])
            if cells is not None:
                lines.append(",".join(cells))
        path = tmp_path / "recording.csv"
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
        return str(path)

    return write


def load(file: str, model=None, **keys):
    return RecordedRig(file=file, **keys).load(model or Newtonian())


class TestWhatIsTaken:
    def test_everything_in_the_order_of_the_model_from_a_relative_path_too(
        self, write, monkeypatch
    ):
        run = load(write())
        assert len(run) == 10
        assert run.sample_time == pytest.approx(0.02)
        assert [s.name for s in run.inputs] == ["u_v", "u_h"]
        assert [s.name for s in run.outputs] == ["alpha_v", "alpha_h", "omega_v", "omega_h"]
        assert run.commands[3].tolist() == [3.0, 0.5]
        assert run.measurements[3].tolist() == pytest.approx([0.3, 0.2, 10.0, 20.0])
        assert list(run.references) == ["alpha_v"]
        assert run.happenings == ()
        path = Path(write())
        monkeypatch.chdir(path.parent)
        assert len(load(path.name)) == 10

    def test_the_model_decides_what_is_used_and_what_is_not_measured_is_said(self, write):
        run = load(write(), Newtonian(freedom="vertical"))
        assert [s.name for s in run.inputs] == ["u_v"]
        assert [s.name for s in run.outputs] == ["alpha_v", "omega_v"]
        assert any("not used: u_h, alpha_h, omega_h" in remark for remark in run.remarks)
        run = load(write(header="t[s],u_v[V],u_h[V],alpha_v[rad]"))
        assert [s.name for s in run.outputs] == ["alpha_v"]
        assert any(r.startswith("not measured: alpha_h") for r in run.remarks)

    def test_a_part_by_time_chosen_channels_only_and_commands_that_act_later(self, write):
        run = load(write(), start=0.05, end=0.13)
        assert run.time == pytest.approx([0.06, 0.08, 0.10, 0.12])
        assert run.commands[0, 0] == 3
        run = load(write(), command_delay=2)
        assert run.commands[:5, 0].tolist() == [0, 0, 0, 1, 2]
        run = load(write(), sensors=Sensors(channels=("alpha_h",), quantum={"alpha_h": 0.012**0.5}))
        assert run.measurements.shape == (10, 1)
        assert run.noise_sd["alpha_h"] == pytest.approx(0.1**1.5)

    def test_degrees_and_rpm_become_si_and_commands_are_scaled(self, write):
        header = "t[s],u_v[V],u_h[V],alpha_v[deg],alpha_h[rad],omega_v[rpm]"
        run = load(write(header=header))
        assert run.measurements[5, 0] == pytest.approx(np.radians(0.5))
        assert run.measurements[5, 2] == pytest.approx(10 * np.pi / 30)
        header = HEADER.replace("u_v[V],u_h[V]", "u_v[1],u_h[%]")
        run = load(write(header=header), input_scale={"u_v": 24.0, "u_h": 10.0})
        assert run.commands[2].tolist() == pytest.approx([48.0, 0.05])


class TestWhatIsMissing:
    def test_a_gap_becomes_missing_samples_with_the_last_command_held(self, write):
        run = load(write(change=lambda k, cells: None if 4 <= k <= 6 else cells))
        assert len(run) == 10
        assert np.isnan(run.measurements[4:7]).all()
        assert not np.isnan(run.measurements[[3, 7]]).any()
        assert run.commands[3:8, 0].tolist() == [3, 3, 3, 3, 7]
        assert run.time == pytest.approx(np.arange(10) * 0.02)
        (gap,) = run.happenings
        assert (gap.sample, gap.kind) == (4, "gap")
        assert gap.value == pytest.approx(0.06)

    def test_empty_cells_are_missing_and_said(self, write):
        def without(k, cells):
            if k in (2, 3):
                cells[3] = ""
            if k == 5:
                cells[1] = ""
            return cells

        run = load(write(change=without))
        assert np.isnan(run.measurements[2:4, 0]).all()
        assert not np.isnan(run.measurements[2:4, 1:]).any()
        assert run.commands[5, 0] == 4
        found = [(h.sample, h.source) for h in run.happenings]
        assert found == [(2, "alpha_v"), (5, "u_v")]

    def test_a_slow_sensor_is_one_event(self, write):
        def slow(k, cells):
            cells[5] = cells[5] if k % 2 == 0 else ""
            return cells

        run = load(write(100, change=slow))
        (event,) = run.happenings
        assert event.source == "omega_v" and "50 samples" in event.message

    def test_jitter_is_snapped(self, write):
        def shaken(k, cells):
            cells[0] = f"{k * 0.02 + 0.001 * (-1) ** k:.5f}"
            return cells

        run = load(write(change=shaken), jitter=0.3)
        assert len(run) == 10
        assert not np.isnan(run.measurements).any()


class TestWhatIsRefused:
    def test_commands_in_another_unit_lead_to_the_right_model(self, write):
        with pytest.raises(ConfigurationError) as caught:
            load(write(header=HEADER.replace("[V]", "[1]")))
        assert caught.value.where == "plant.file"
        assert "u_v, u_h in [1]" in caught.value.problem and "takes [V]" in caught.value.problem
        assert "model=tras" in caught.value.remedy
        assert "plant.input_scale={u_v: 2.5, u_h: 2.5}" in caught.value.remedy
        with pytest.raises(ConfigurationError) as caught:
            load(write(), Tras())
        assert "model=newtonian" in caught.value.remedy
        assert "0.04167" in caught.value.remedy

    @pytest.mark.parametrize(
        ("channel", "model", "problem", "remedy"),
        [
            ("alpha_v", Newtonian(), "no u_h", "newtonian_vertical"),
            ("alpha_h", Newtonian(freedom="vertical"), "measures alpha_h", ""),
        ],
    )
    def test_a_channel_that_is_missing(self, write, channel, model, problem, remedy):
        with pytest.raises(ConfigurationError, match=problem) as caught:
            load(write(header=f"t[s],u_v[V],{channel}[rad]"), model)
        assert remedy in caught.value.remedy

    @pytest.mark.parametrize(
        ("rows", "shift", "problem", "remedies"),
        [
            ({6}, 0.008, "2 of 9 steps", ("resample", "plant.jitter")),
            ({6}, -0.0199, "not evenly spaced", ()),
            (range(5, 10), 172_800.0, "longest gap", ("plant.start",)),
        ],
        ids=["uneven", "doubled", "of two days"],
    )
    def test_times_that_are_not_even(self, write, rows, shift, problem, remedies):
        def shifted(k, cells):
            return [f"{k * 0.02 + (shift if k in rows else 0):.5f}", *cells[1:]]

        with pytest.raises(RecordingError, match=problem) as caught:
            load(write(change=shifted))
        assert all(remedy in caught.value.remedy for remedy in remedies)

    def test_no_first_command(self, write):
        def late(k, cells):
            cells[2] = "" if k < 3 else cells[2]
            return cells

        with pytest.raises(ConfigurationError, match="without a value of u_h") as caught:
            load(write(change=late))
        assert "plant.start=0.06" in caught.value.remedy

    def test_no_file_a_part_beyond_its_end_a_scale_for_no_input_and_a_loop_over_it(self, write):
        with pytest.raises(ConfigurationError, match="fewer than two") as caught:
            load(write(), start=5.0)
        assert "0 to 0.18" in caught.value.remedy
        with pytest.raises(ConfigurationError, match="no input 'u_x'"):
            load(write(), input_scale={"u_x": 2.0})
        with pytest.raises(ConfigurationError, match="cannot be controlled"):
            RecordedRig(file=write()).init(PlantSetup(0.02, 10, 0))
        with pytest.raises(RecordingError, match="no such file"):
            load("absent.csv")

    @pytest.mark.parametrize(
        "keys", [{"input_scale": {"u_v": 0.0}}, {"sensors": Sensors(loss_probability=0.1)}]
    )
    def test_nonsense_in_the_configuration(self, keys):
        with pytest.raises(ConfigurationError):
            RecordedRig(file="any.csv", **keys)
