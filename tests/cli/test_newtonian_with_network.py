"""The Newtonian model with a network wherever a white-box model goes: laws, filters, studies, C."""

import json

import numpy as np
import pytest

from trms_cli.cli import main
from trms_cli.core.compilation import compiler
from trms_cli.identification.model_writer import ModelOrigin, model_document, write_model
from trms_cli.models.network import Network
from trms_cli.models.newtonian_with_network import NewtonianWithNetwork, TorqueNetwork

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def model(tmp_path_factory) -> str:
    """A file of a network of some mN m, of both axes."""
    bare = NewtonianWithNetwork()
    regressors = bare.regressor_names()
    random = np.random.default_rng(3)
    n_z = len(regressors)
    weights = {
        "W1": 0.3 * random.normal(size=(3, n_z)),
        "b1": np.zeros(3),
        "W2": random.normal(size=(2, 3)),
        "b2": np.zeros(2),
    }
    scales = np.array([{"o": 150.0, "u": 1.0}.get(name[0], 0.5) for name in regressors])
    network = Network("mlp", weights, np.zeros(n_z), scales, np.zeros(2), np.full(2, 1e-3))
    content = TorqueNetwork(regressors, ("pitch_moment", "yaw_moment"), network)
    document = model_document(
        "rig",
        bare.with_network(content),
        ModelOrigin(option=NewtonianWithNetwork.OPTION),
        values={},
        deviations={},
        free=(),
        source="a test",
    )
    path = tmp_path_factory.mktemp("network") / "model.yaml"
    write_model(document, path)
    return str(path)


def run(model: str, out, *words: str) -> int:
    rig = "model@plant.model=newtonian"
    return main(
        ["run", f"model={model}", rig, *words, "sim.duration=2", "picture=false", f"out={out}"]
    )


@pytest.mark.parametrize("controller", ["newton_mpc", "nmpc", "linear_mpc", "lqr", "pid"])
def test_controllers_take_it(model, controller, tmp_path):
    assert run(model, tmp_path / "run", f"controller={controller}") == 0


@pytest.mark.parametrize("observer", ["ekf", "kalman", "mhe"])
def test_observers_take_it(model, observer, tmp_path):
    assert run(model, tmp_path / "run", "controller=lqr", f"observer={observer}") == 0


def test_stability_takes_it(model, tmp_path):
    assert main(["stability", "study=local", f"model={model}", f"out={tmp_path / 's'}"]) == 0


@pytest.mark.skipif(compiler() is None, reason="needs a C compiler")
def test_it_is_exported(model, tmp_path):
    out = tmp_path / "c"
    words = [f"model={model}", "controller.prediction_horizon=8", "sim.duration=5"]
    assert main(["export-controller", "newton_mpc", *words, "name=rig", f"out={out}"]) == 0
    measured = json.loads((out / "controller.json").read_text())["measured"]
    assert measured["failed"] == 0 and measured["largest_difference"] <= 1e-9
