"""The Newtonian model with a network of torques: what the network adds, and how it is written."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
import yaml

from trms_cli.core.errors import ModelError
from trms_cli.core.resources import config_folder
from trms_cli.effects.coulomb_friction import CoulombFriction
from trms_cli.effects.extended_model import extend_model
from trms_cli.effects.model_file import load_model
from trms_cli.identification.model_writer import ModelOrigin, model_document, write_model
from trms_cli.models.model import Model
from trms_cli.models.network import Network
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.newtonian_with_network import NewtonianWithNetwork, TorqueNetwork

RANDOM = np.random.default_rng(7)


def network_of(model: NewtonianWithNetwork, hidden: int = 3) -> TorqueNetwork:
    """A network of all that the model has, of some tenths of a mN m."""
    regressors = model.regressor_names()
    torques = tuple(axis.moment for axis in model.axes.values())
    n_z, n_out = len(regressors), len(torques)
    weights = {
        "W1": RANDOM.normal(size=(hidden, n_z)),
        "b1": RANDOM.normal(size=hidden),
        "W2": RANDOM.normal(size=(n_out, hidden)),
        "b2": RANDOM.normal(size=n_out),
    }
    scales = RANDOM.uniform(0.5, 2.0, n_z)
    network = Network("mlp", weights, np.zeros(n_z), scales, np.zeros(n_out), np.full(n_out, 2e-3))
    return TorqueNetwork(regressors, torques, network)


def rates(model: Model, x, u, w, p=None) -> np.ndarray:
    at = model.symbols()
    function = ca.Function("rates", list(at), [model.dynamics(*at)])
    return np.array(function(x, u, model.parameters.values if p is None else p, w))[:, 0]


def point(model: Model) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    x = RANDOM.normal(size=model.n_x) * np.where(
        [s.name.startswith("omega") for s in model.states], 100.0, 0.3
    )
    return x, RANDOM.normal(size=model.n_u), 1e-2 * RANDOM.normal(size=model.n_w)


@pytest.mark.parametrize("freedom", ["both", "vertical", "horizontal"])
@pytest.mark.parametrize("currents", ["quasi_static", "dynamic"])
def test_without_a_network_it_is_the_newtonian_model(freedom, currents):
    keys = {"freedom": freedom, "currents": currents}
    plain, own = Newtonian(**keys), NewtonianWithNetwork(**keys)
    at = point(plain)
    np.testing.assert_array_equal(rates(own, *at), rates(plain, *at))
    assert own.states == plain.states and own.parameters.names == plain.parameters.names
    np.testing.assert_array_equal(own.rest(), plain.rest())


@pytest.mark.parametrize("freedom", ["both", "vertical", "horizontal"])
def test_its_torques_act_as_the_axes_disturbances(freedom):
    plain, bare = Newtonian(freedom=freedom), NewtonianWithNetwork(freedom=freedom)
    content = network_of(bare)
    model = bare.with_network(content)
    x, u, w = point(plain)
    motion = rates(plain, x, u, w)
    values = dict(zip(plain.state_names, x, strict=True))
    values |= {s.name: v for s, v in zip(plain.inputs, u, strict=True)}
    values |= {f"{a}_rate": motion[plain.state_index(a)] for a in plain.controlled}
    regressor = np.array([[values[name] for name in content.regressors]])
    torque = dict(zip(content.torques, content.network.evaluate(regressor)[0], strict=True))
    pushed = w + [torque.get(s.name, 0.0) for s in plain.disturbances]
    np.testing.assert_allclose(rates(model, x, u, w), rates(plain, x, u, pushed), rtol=1e-12)
    quantities = model.quantities(*model.symbols()[:3])
    assert {f"network_{name}" for name in torque} <= set(quantities)


def test_far_from_all_data_its_torques_are_bounded():
    bare = NewtonianWithNetwork()
    content = network_of(bare)
    far = 1e6 * RANDOM.normal(size=(200, content.network.n_regressors))
    w = content.network.weights
    bound = content.network.output_sd * (np.abs(w["W2"]).sum(axis=1) + np.abs(w["b2"]))
    assert np.all(np.abs(content.network.evaluate(far)) <= bound)


def test_weights_as_parameters_give_the_same_model():
    bare = NewtonianWithNetwork()
    content = network_of(bare)
    fixed, free = bare.with_network(content), bare.with_network(content, free_weights=True)
    at = point(bare)
    np.testing.assert_allclose(rates(free, *at), rates(fixed, *at), rtol=1e-13)
    w = content.network.weights["W1"].copy()
    w[1, 2] += 0.5
    changed = replace(content.network, weights={**content.network.weights, "W1": w})
    place = free.parameters.names.index(f"network_W1_{w.shape[1] + 3}")
    p = free.parameters.values
    p[place] += 0.5
    other = bare.with_network(replace(content, network=changed))
    np.testing.assert_allclose(rates(free, *at, p), rates(other, *at), rtol=1e-13)


def test_a_model_file_holds_it_with_every_bit_and_effects_stand_above(tmp_path):
    bare = NewtonianWithNetwork(parameters={"k_ov": 0.007})
    content = network_of(bare)
    effects = {"yaw_coulomb_friction": CoulombFriction(axis="yaw", torque=0.003)}
    model = extend_model(bare.with_network(content), effects)
    origin = ModelOrigin(option=NewtonianWithNetwork.OPTION, limits={"u_v": 2.0})
    document = model_document(
        "rig", model, origin, values={}, deviations={}, free=(), source="a test"
    )
    write_model(document, tmp_path / "rig.yaml")
    again = load_model(str(tmp_path / "rig.yaml"))
    at = point(model)
    np.testing.assert_array_equal(rates(again, *at), rates(model, *at))
    assert again.parameters["k_ov"].value == 0.007 and again.input_limits["u_v"] == 2.0
    assert again.parameters["yaw_coulomb_friction.torque"].value == 0.003
    # its physics alone, and the set as a model's option
    path = str(tmp_path / "rig.yaml")
    assert NewtonianWithNetwork(parameter_set=path).torque_network is not None
    np.testing.assert_array_equal(
        rates(Newtonian(parameter_set=path), *point(bare)).shape, (bare.n_x,)
    )


@pytest.mark.parametrize(
    ("change", "where"),
    [
        ({"model": "newtonian"}, "torque_network"),
        ({"regressors": ["alpha_v"]}, "torque_network.regressors"),
        ({"regressors": "wind"}, "torque_network.regressors"),
        ({"torques": ["main_motor", "yaw_moment"]}, "torque_network.torques"),
        ({"network": None}, "torque_network.network"),
        ({"wind": 1.0}, "torque_network.wind"),
    ],
)
def test_what_does_not_fit_is_refused_by_its_key(change, where, tmp_path):
    content = yaml.safe_load((config_folder() / "parameters" / "bench.yaml").read_text("utf-8"))
    data = network_of(NewtonianWithNetwork()).to_data()
    if change.get("regressors") == "wind":
        change = {"regressors": ["wind", *data["regressors"][1:]]}
    content["model"] = change.pop("model", NewtonianWithNetwork.OPTION)
    data |= change
    if data["network"] is None:
        del data["network"]
    path = tmp_path / "rig.yaml"
    path.write_text(yaml.safe_dump(content | {"torque_network": data}), encoding="utf-8")
    with pytest.raises(ModelError) as caught:
        load_model(str(path))
    assert where in str(caught.value.where) or where in str(caught.value.problem)
    assert caught.value.remedy


def test_a_network_of_both_axes_does_not_fit_one():
    content = network_of(NewtonianWithNetwork())
    with pytest.raises(ModelError, match="alpha_h"):
        NewtonianWithNetwork(freedom="vertical").with_network(content)
