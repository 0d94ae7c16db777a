"""Networks on the command line: as the model of a run, with the rig they were trained on."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml

from tests.models.network_case import LIMITS, rig_like
from trms_cli.models.narx_file import NarxFile, write_narx_file


@pytest.fixture
def network(tmp_path) -> Path:
    """A network file that names no rig."""
    model = rig_like()
    path = tmp_path / "net.yaml"
    write_narx_file(
        path,
        NarxFile(name="net", structure=model.structure, network=model.network, limits=LIMITS),
    )
    return path


def with_rig(network: Path, rig: str) -> str:
    path = network.with_name("with_rig.yaml")
    path.write_text(network.read_text() + f"rig: {rig}  # it was trained on\n")
    return path.name


def composed(trms, *argv: str) -> dict:
    shown = trms("run", *argv, "--cfg", "job")
    assert shown.returncode == 0, shown.stderr
    return yaml.safe_load(shown.stdout)


class TestRun:
    def test_with_a_network_file_says_what_model_and_rig_are(self, trms, network, tmp_path):
        options = ("sim.duration=2", "out=run", "picture=false")
        done = trms("run", "model=net.yaml", *options, TRMS_COMPILE="0")
        assert done.returncode == 0, done.stderr
        assert "model net" in done.stdout and "(narx)" in done.stdout
        score = json.loads((tmp_path / "run" / "score.json").read_text())
        assert score["solver"]["failures"] == 0

    def test_with_the_trained_network_reaches_the_reference(self, trms, tmp_path):
        """All defaults; interpreted, which is quicker than to compile for so short a run."""
        options = ("controller=newton_mpc", "sim.duration=20", "out=run", "picture=false")
        done = trms("run", "model=narx_2dof", *options, TRMS_COMPILE="0")
        assert done.returncode == 0, done.stderr
        assert "model narx_2dof" in done.stdout and "(newtonian)" in done.stdout
        score = json.loads((tmp_path / "run" / "score.json").read_text())
        assert score["solver"]["failures"] == 0
        for axis in ("alpha_v", "alpha_h"):
            assert score["channels"][axis]["settling_time_s"] < 5.0
            assert score["channels"][axis]["steady_state_error"] < 0.0046  # three encoder quanta

    @pytest.mark.slow
    def test_with_the_trained_network_is_as_good_as_with_the_equations(self, trms, tmp_path):
        """The rig is white-box in both: the network is a model of it, not the rig itself."""
        scores = {}
        for name, model, *others in (
            ("known", "newtonian"),
            ("learnt", "narx_2dof"),
            ("aged", "narx_2dof", "plant.parameters.k_fvp=1.45e-5", "effect=[main_dead_zone]"),
        ):
            done = trms(
                "run",
                f"model={model}",
                "controller=newton_mpc",
                "sim.duration=40",
                f"out={name}",
                "picture=false",
                *others,
            )
            assert done.returncode == 0, done.stderr
            scores[name] = json.loads((tmp_path / name / "score.json").read_text())["channels"]
        for axis in ("alpha_v", "alpha_h"):
            rmse = {name: score[axis]["rmse"] for name, score in scores.items()}
            assert rmse["learnt"] < 1.1 * rmse["known"]
            for name in ("learnt", "aged"):  # within three quanta of the encoder
                assert scores[name][axis]["steady_state_error"] < 0.0046

    def test_is_repeated_from_its_log(self, trms, network, tmp_path):
        options = ("sim.duration=1", "out=a", "picture=false")
        first = trms("run", "model=net.yaml", *options, TRMS_COMPILE="0")
        again = trms("run", "--from", "a/run.mcap", "out=b", "picture=false", TRMS_COMPILE="0")
        assert (first.returncode, again.returncode) == (0, 0), again.stderr
        scores = [json.loads((tmp_path / f / "score.json").read_text()) for f in "ab"]
        assert scores[0]["channels"] == scores[1]["channels"]


class TestRig:
    def test_of_a_file_that_names_none_is_the_network(self, trms, network):
        assert composed(trms, "model=net.yaml")["plant"]["model"]["path"] == "net.yaml"

    def test_is_the_one_that_the_file_names(self, trms, network):
        config = composed(trms, f"model={with_rig(network, 'newtonian_full')}")
        assert config["plant"]["model"]["currents"] == "dynamic"
        assert config["model"]["path"] == "with_rig.yaml"

    def test_may_be_another(self, trms, network):
        config = composed(
            trms, f"model={with_rig(network, 'newtonian_full')}", "model@model.rig=newtonian"
        )
        assert config["plant"]["model"]["currents"] == "quasi_static"

    @pytest.mark.parametrize("model", ["newtonian", "net.yaml"])
    def test_chosen_outright_keeps_no_key_of_the_model(self, trms, network, model):
        rig = composed(trms, f"model={model}", "model@plant.model=tras")["plant"]["model"]
        assert set(rig) == set(composed(trms, "model=tras")["model"])

    def test_chosen_outright_stays_what_it_is_on_a_plant_that_builds_on_another(self, trms):
        config = composed(
            trms, "model=newtonian", "model.freedom=both", "plant=ideal", "model@plant.model=tras"
        )
        assert "freedom" not in config["plant"]["model"]

    def test_that_there_is_not(self, trms, network):
        done = trms("run", f"model={with_rig(network, 'newtonain')}")
        assert done.returncode == 2
        assert "newtonian" in done.stderr


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
def test_what_a_network_cannot_do_is_said_in_a_sentence(trms, network, overrides, words):
    done = trms("run", "model=net.yaml", "out=run", "picture=false", *overrides)
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    said = " ".join(done.stderr.split())
    for word in words:
        assert word in said


def test_a_mistake_in_the_file_is_named_by_its_key(trms, network):
    data = yaml.safe_load(network.read_text())
    data["network"]["weights"]["b1"] = [1.0]
    network.write_text(yaml.safe_dump(data))
    done = trms("run", "model=net.yaml")
    assert done.returncode == 2
    assert "net.yaml: network.weights.b1" in " ".join(done.stderr.split())
