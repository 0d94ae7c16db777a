"""``trms run`` with open loops, recordings, networks and white-box models in the usual places."""

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

from tests.models.network_case import LIMITS, rig_like
from trms_cli.cli import main
from trms_cli.composition.catalogue import read_groups
from trms_cli.composition.composer import compose
from trms_cli.core.plugins import build
from trms_cli.library.tasks.run import never_begun
from trms_cli.models.narx_file import NarxFile, write_narx_file
from trms_cli.plants.disturbance import ScheduledDisturbance
from trms_cli.plants.faults.frozen_sensor import FrozenSensor
from trms_cli.recordings.log_reader import read_log
from trms_cli.recordings.read import read_recording
from trms_cli.references.constant import Constant
from trms_cli.references.step import Step

QUICK = ("controller=open_loop", "observer=full_state", "plant=ideal", "picture=false")
#: Every signal that needs no file; a run with each is played to the rig.
KINDS = sorted(set(read_groups()["signal"]) - {"from_csv"})


def run(folder: Path, *overrides: str) -> Path:
    assert main(["run", *QUICK, f"out={folder}", *overrides]) == 0
    return folder


def score_of(folder: Path) -> dict:
    document: dict = json.loads((folder / "score.json").read_text(encoding="utf-8"))
    return document


def command(folder: Path, name: str) -> np.ndarray:
    return read_log(folder / "run.mcap").tables["/command"].columns[name]


@pytest.mark.parametrize("kind", KINDS)
def test_every_signal_is_played_as_it_is(kind, tmp_path):
    words = (f"signal@controller.u_v={kind}", "sim.duration=6")
    run(tmp_path / "run", *words)
    signal = build(compose([*QUICK, *words]).config["controller"]["u_v"], "controller.u_v")
    expected = signal.sample(np.arange(300) * 0.02)
    np.testing.assert_allclose(command(tmp_path / "run", "u_v"), expected, atol=1e-12)


def test_a_csv_of_commands_is_played(tmp_path):
    table = tmp_path / "commands.csv"
    table.write_text("t[s],u_v[V],u_h[mV]\n0,0.5,0\n1,1.0,250\n2,-0.5,-250\n")
    words = [
        f"{key}={value}"
        for name in ("u_v", "u_h")
        for key, value in (
            (f"signal@controller.{name}", "from_csv"),
            (f"controller.{name}.file", table),
            (f"controller.{name}.column", name),
        )
    ]
    folder = run(tmp_path / "run", "sim.duration=3", *words)
    u_v, u_h = (command(folder, name) for name in ("u_v", "u_h"))
    assert u_v[[0, 49, 50, 99, 100, 149]].tolist() == [0.5, 0.5, 1.0, 1.0, -0.5, -0.5]
    assert u_h[[0, 60, 149]] == pytest.approx([0, 0.25, -0.25])


def test_no_tracking_is_scored_and_the_log_says_that_the_loop_was_open(tmp_path, capsys):
    folder = run(tmp_path / "run", "sim.duration=2")
    printed = capsys.readouterr().out
    assert "tracking  " not in printed and "ref " not in printed and "ref=" not in printed
    assert score_of(folder)["channels"] == {}
    log = read_log(folder / "run.mcap")
    assert "/reference" not in log.tables or not len(log.tables["/reference"])
    assert read_recording(folder / "run.mcap").metadata["loop"] == "open"


def test_around_an_operating_point_the_model_stays_there(tmp_path):
    point = ("controller.operating_point={alpha_v: -0.2}", "model=newtonian_vertical")
    constant = (f"signal@controller.{name}=constant" for name in ("u_v", "u_h"))
    folder = run(tmp_path / "run", "sim.duration=2", *point, *constant)
    # 1.06 V holds -0.2 rad: the table of equilibria gives -0.231 at 1.0 and -0.124 at 1.2 V.
    assert 1.0 < command(folder, "u_v")[0] < 1.2


def test_what_is_beyond_the_limits_is_cut_and_said(tmp_path):
    folder = run(tmp_path / "run", "sim.duration=1", "controller.u_v.amplitude=4")
    assert np.abs(command(folder, "u_v")).max() == 2.5
    log = read_log(folder / "run.mcap")
    assert any("u_v cut from" in str(m) for m in log.tables["/controller"].columns["message"])


@pytest.mark.parametrize(
    ("point", "words"),
    [("{alpha_v: 1.4}", "nearest point at which it rests"), ("{alpha: 0}", "alpha_v")],
)
def test_a_point_at_which_nothing_rests_is_refused(refused, point, words):
    refused("run", *QUICK, f"controller.operating_point={point}", words=words)


def test_a_reference_that_nobody_follows_is_told(trms):
    quick = ("run", "controller=open_loop", "sim.duration=1", "picture=false")
    told = trms(*quick, "ref=sine", "signal@ref.alpha_v=square", "ref.alpha_h.amplitude=0.1")
    words = "follows no reference; of no effect: ref, signal@ref.alpha_v, ref.alpha_h.amplitude"
    assert words in " ".join(told.stdout.split())
    assert "follows no reference" not in trms(*quick).stdout


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Two seconds of a rig at rest under normalised commands, with two rows lost."""
    path = tmp_path / "mine.csv"
    rows = [
        f"{k / 100:.2f},0.0,0.0,{-0.4888 + 0.0015 * (k % 2)},0.0,0.1,{-0.49 * (k % 2)},-0.5\n"
        for k in range(200)
        if k not in (50, 51)
    ]
    header = "t[s],u_v[1],u_h[1],alpha_v[rad],alpha_h[rad],omega_v[rad/s],omega_h[rad/s],r_v[rad]\n"
    path.write_text("# rig: mine\n" + header + "".join(rows), encoding="utf-8")
    return path


def test_a_recording_is_replayed_scored_and_drawn_and_its_log_is_one_again(
    trms, recording, tmp_path
):
    replay = ("run", "plant=replay", "model=tras")
    done = trms(*replay, "plant.file=mine.csv", "controller=pid", "out=here")
    printed = " ".join(done.stdout.split())
    assert "cannot be steered" in printed and "(controller=pid)" in printed
    assert "a gap in t" in printed
    folder = tmp_path / "here"
    assert (folder / "run.png").stat().st_size > 20_000
    table = json.loads((folder / "innovations.json").read_text(encoding="utf-8"))
    assert table["schema"] == "trms.innovations/1"
    assert table["channels"]["alpha_v"]["samples"] == 198
    score = json.loads(trms("score", "here/run.mcap", "--json").stdout)
    assert score["complete"] and score["duration_s"] == pytest.approx(2.0, abs=0.011)
    assert score["estimate"]["prediction_rmse"]["omega_h"] < 1.0
    trms(*replay, "plant.file=here/run.mcap", "out=b", "picture=false")


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["plant.file=mine.csv"], ["model=tras", "plant.input_scale"]),
        (["plant.file=none.csv", "model=tras"], ["none.csv"]),
        ([], ["plant.file"]),
    ],
)
def test_what_cannot_be_replayed_is_told(refused, recording, words, told):
    refused("run", "plant=replay", *words, words=told)


def test_an_observer_that_looks_inside_has_nothing_to_look_at(trms, recording):
    words = ("plant=replay", "plant.file=mine.csv", "model=tras", "observer=full_state")
    assert "observer=ukf" in trms("run", *words, code=2).stderr


@pytest.fixture
def network(tmp_path) -> Path:
    """A network file that names no rig."""
    model = rig_like()
    path = tmp_path / "net.yaml"
    write_narx_file(
        path, NarxFile(name="net", structure=model.structure, network=model.network, limits=LIMITS)
    )
    return path


def with_rig(network: Path, rig: str) -> str:
    path = network.with_name("with_rig.yaml")
    path.write_text(network.read_text() + f"rig: {rig}  # it was trained on\n")
    return path.name


def composed(trms, *argv: str) -> dict:
    return yaml.safe_load(trms("run", *argv, "--cfg", "job").stdout)


class TestRun:
    @pytest.mark.slow
    def test_with_a_network_file_says_what_it_is_and_is_repeated_from_its_log(
        self, program, network, tmp_path
    ):
        interpreted = {"TRMS_COMPILE": "0"}
        words = ("sim.duration=2", "out=a", "picture=false")
        done = program("run", "model=net.yaml", *words, **interpreted)
        assert "model net · plant simulated (net)" in " ".join(done.stdout.split())
        program("run", "--from", "a/run.mcap", "out=b", "picture=false", **interpreted)
        first, again = (score_of(tmp_path / folder) for folder in "ab")
        assert first["solver"]["failures"] == 0 and first["channels"] == again["channels"]

    @pytest.mark.slow
    def test_with_the_trained_network_reaches_the_reference(self, program, tmp_path):
        """All defaults; interpreted, which is quicker than to compile for so short a run."""
        options = ("controller=newton_mpc", "sim.duration=20", "out=run", "picture=false")
        done = program("run", "model=narx_2dof", *options, TRMS_COMPILE="0")
        assert "model narx_2dof" in done.stdout and "(newtonian)" in done.stdout
        score = score_of(tmp_path / "run")
        assert score["solver"]["failures"] == 0
        for axis in ("alpha_v", "alpha_h"):
            assert score["channels"][axis]["settling_time_s"] < 5.0
            assert score["channels"][axis]["steady_state_error"] < 0.0046  # three encoder quanta

    @pytest.mark.slow
    def test_with_the_trained_network_is_as_good_as_with_the_equations(self, trms, tmp_path):
        """The rig is white-box in both: the network is a model of it, not the rig itself."""
        scores = {}
        usual = ("controller=newton_mpc", "sim.duration=40", "picture=false")
        for name, model, *others in (
            ("known", "newtonian"),
            ("learnt", "narx_2dof"),
            ("aged", "narx_2dof", "plant.parameters.k_fvp=1.45e-5", "effect=[main_dead_zone]"),
        ):
            trms("run", f"model={model}", *usual, f"out={name}", *others)
            scores[name] = score_of(tmp_path / name)["channels"]
        for axis in ("alpha_v", "alpha_h"):
            rmse = {name: score[axis]["rmse"] for name, score in scores.items()}
            assert rmse["learnt"] < 1.1 * rmse["known"]
            for name in ("learnt", "aged"):  # within three quanta of the encoder
                assert scores[name][axis]["steady_state_error"] < 0.0046


class TestRig:
    def test_is_the_one_that_the_file_names_or_the_network_or_another(self, trms, network):
        assert composed(trms, "model=net.yaml")["plant"]["model"]["path"] == "net.yaml"
        model = f"model={with_rig(network, 'newtonian_full')}"
        config = composed(trms, model)
        assert config["plant"]["model"]["currents"] == "dynamic"
        assert config["model"]["path"] == "with_rig.yaml"
        config = composed(trms, model, "model@model.rig=newtonian")
        assert config["plant"]["model"]["currents"] == "quasi_static"
        done = trms("run", f"model={with_rig(network, 'newtonain')}", code=2)
        assert "newtonian" in done.stderr

    @pytest.mark.parametrize(
        "words",
        [
            ["model=newtonian"],
            ["model=net.yaml"],
            # also on a plant that builds on another
            ["model=newtonian", "model.freedom=both", "plant=ideal"],
        ],
    )
    def test_chosen_outright_keeps_no_key_of_the_model(self, trms, network, words):
        rig = composed(trms, *words, "model@plant.model=tras")["plant"]["model"]
        assert set(rig) == set(composed(trms, "model=tras")["model"])


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (("sim.sample_time=0.05",), ("0.02 s", "controller.sample_time")),
        (("plant.parameters.k_g=0.1",), ("constants", "model@plant.model")),
        (("plant.prior_seed=1",), ("plant.prior_seed", "model@plant.model=newtonian")),
        (("model.parameters.W1=1",), ("constants",)),
        (("effect=[yaw_coulomb_friction]",), ("only steps", "model@plant.model=newtonian")),
        (("observer=full_state", "sim.sample_time=0.1"), ("sim.sample_time=0.02",)),
        (("plant.initial.alpha_v=2",), ("mechanical stops",)),
    ],
    ids=" ".join,
)
def test_what_a_network_cannot_do_is_said_in_a_sentence(refused, network, overrides, words):
    refused("run", "model=net.yaml", "out=run", "picture=false", *overrides, words=words)


def test_a_mistake_in_the_file_is_named_by_its_key(refused, network):
    data = yaml.safe_load(network.read_text())
    data["network"]["weights"]["b1"] = [1.0]
    network.write_text(yaml.safe_dump(data))
    refused("run", "model=net.yaml", words="net.yaml: network.weights.b1")


#: Pitches that the maker's tail rotor can hold against the main rotor's reaction.
LOW = ["ref.alpha_v.offset=-0.45", "ref.alpha_v.amplitude=0.15"]
AT_LOW = "{alpha_v: -0.45, alpha_h: 0.0}"


def scored(folder: Path, *words: str, duration: float = 20.0) -> dict[str, float]:
    """Mean errors by channel."""
    out = folder / "run"
    given = ["run", *words, f"sim.duration={duration}", "picture=false", f"out={out}"]
    assert main(given) == 0
    score = score_of(out)
    assert not score["solver"]["failures"]
    return {name: channel["rmse"] for name, channel in score["channels"].items()}


@pytest.mark.parametrize(
    ("words", "most"),
    [
        (["model=motor_main", "ref=speed", "controller=newton_mpc"], {"omega_v": 25.0}),
        (["model=propeller_tail", "ref=speed", "controller=lqr"], {"omega_h": 45.0}),
    ],
)
def test_a_rotor_alone_follows_speeds(words, most, tmp_path: Path) -> None:
    found = scored(tmp_path, *words)
    assert found.keys() == most.keys()
    for name, value in most.items():
        assert found[name] < value


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "pitch", "yaw"),
    [
        (["model=lagrangian", "controller=newton_mpc"], 0.25, 0.15),
        (["model=lagrangian", "controller=pid", "effect=yaw_coulomb_friction"], 0.27, 0.20),
        (["model=lagrangian", "controller=lqr", "effect=main_input_delay"], 0.25, 0.15),
        (["model=lagrangian_full", "controller=pid"], 0.27, 0.20),
        (["model=tastemirov", "controller=newton_mpc"], 0.32, 0.15),
        (["model=feedback_manual", *LOW], 0.09, 0.2),
        (
            ["model=feedback_manual", *LOW, "controller=lqr",
             f"controller.operating_point={AT_LOW}"], 0.09, 0.2,
        ),
        (
            ["model=feedback_manual", *LOW, "controller=pid",
             f"controller.operating_points=[{AT_LOW}]"], 0.16, 0.25,
        ),
        (["model=newtonian", "model@plant.model=lagrangian"], 0.25, 0.15),
    ],
)  # fmt: skip
def test_a_model_is_controlled_and_estimated(words, pitch, yaw, tmp_path: Path) -> None:
    found = scored(tmp_path, *words)
    assert found["alpha_v"] < pitch and found["alpha_h"] < yaw


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["model=motor_main"], ["ref.omega_v", "ref=speed"]),
        (["model=motor_main", "ref=speed", "controller=pid"], ["no axis", "newton_mpc or lqr"]),
        (["model=motor_tail", "ref=speed", "effect=yaw_coulomb_friction"], ["no yaw axis"]),
        (["model=lagrangian", "model.parameter_set=tras"], ["belongs to model 'tras'"]),
        (["model=lagrangian", "model.shields=round"], ["model.shields", "rings"]),
        (["model=newtonian", "model.main_interface=no.csv"], ["model.main_interface", "u[V],v[V]"]),
        (["model=motor_main", "ref=speed", "model.voltage_limit=0"], ["model.voltage_limit"]),
        (
            ["model=feedback_manual", "model@plant.model=newtonian"],
            ["measures omega_v, omega_h", "plant.sensors.channels=[alpha_v,alpha_h]"],
        ),
        (["model=feedback_manual", "controller=lqr"], ["cannot rest", "alpha_v=-0.156"]),
    ],
)
def test_what_makes_no_sense_is_told(words, told, refused) -> None:
    refused("run", *words, words=told)


@pytest.mark.parametrize(("duration", "told"), [(10.0, True), (21.0, True), (22.0, False)])
def test_what_begins_after_the_end_is_told(duration: float, told: bool) -> None:
    fault = FrozenSensor(channel="alpha_h", start=21.0, duration=3.0)
    push = ScheduledDisturbance(equation="yaw_moment", torque=Step(amplitude=0.01, start=21.0))
    rig = SimpleNamespace(faults={"frozen": fault}, disturbances={"push": push})
    said = list(never_begun(rig, duration))
    names = ["fault frozen begins at 21 s", "disturbance push begins at 21 s"]
    assert [words.partition(",")[0] for words in said] == (names if told else [])


def test_a_torque_that_is_there_before_it_begins_acts() -> None:
    torques = Step(amplitude=0.01, start=21.0, offset=0.02), Constant(offset=0.01)
    pushes = {
        str(i): ScheduledDisturbance(equation="yaw_moment", torque=torque)
        for i, torque in enumerate(torques)
    }
    rig = SimpleNamespace(faults={}, disturbances=pushes)
    assert not list(never_begun(rig, 10.0))


def test_a_run_says_it_before_it_begins(trms) -> None:
    done = trms("run", "fault=yaw_encoder_frozen", "sim.duration=0.2", "picture=false")
    words = "note   fault yaw_encoder_frozen begins at 21 s, after the end of the run (0.2 s)"
    assert words in done.stderr
