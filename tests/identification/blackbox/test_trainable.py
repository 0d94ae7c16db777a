"""Networks with free weights: one statement of the value, exact slopes."""

import casadi as ca
import numpy as np
import pytest
import yaml

from tests.identification.blackbox.differences import central
from trms_cli.core.errors import ModelError
from trms_cli.identification.blackbox.radial_fit import Radial
from trms_cli.identification.blackbox.trainable import Mlp
from trms_cli.models.network import Network

N_Z, N_OUT, N = 3, 2, 7
NETWORKS = {
    "one hidden layer": Mlp(N_Z, N_OUT, (4,)),
    "two hidden layers": Mlp(N_Z, N_OUT, (4, 3)),
    "a direct part": Mlp(N_Z, N_OUT, (4,), direct=True),
    "linear": Mlp(N_Z, N_OUT, ()),
    "rbf": Radial("rbf", N_Z, N_OUT, 5),
    "wavelet": Radial("wavelet", N_Z, N_OUT, 5),
}


@pytest.fixture(params=NETWORKS.values(), ids=NETWORKS.keys())
def network(request):
    return request.param


@pytest.fixture
def theta(network):
    return 0.5 * np.random.default_rng(1).standard_normal(network.n_parameters)


@pytest.fixture
def z():
    return np.random.default_rng(2).standard_normal((N, N_Z))


def stored(network, theta) -> Network:
    generator = np.random.default_rng(3)
    return Network(
        network.kind,
        network.weights(theta),
        generator.standard_normal(N_Z),
        generator.uniform(0.5, 2.0, N_Z),
        generator.standard_normal(N_OUT),
        generator.uniform(0.5, 2.0, N_OUT),
    )


def test_slopes_in_weights_and_regressor_are_those_of_differences(network, theta, z):
    values, jacobian, by_z = network.slopes(theta, z)
    assert jacobian == pytest.approx(central(lambda t: network.values(t, z), theta), abs=2e-8)
    for k in range(N):
        expected = central(lambda row: network.values(theta, row[None])[0], z[k])
        assert by_z[k] == pytest.approx(expected, abs=2e-8)
    # Pulling back is the product with the slopes.
    weight = np.random.default_rng(4).standard_normal((N, N_OUT))
    by_theta, back = network.pulled_back(theta, z, weight)
    assert by_theta == pytest.approx(np.einsum("no,nop->p", weight, jacobian), abs=1e-12)
    assert back == pytest.approx(np.einsum("no,noz->nz", weight, by_z), abs=1e-12)
    assert values == pytest.approx(network.values(theta, z), abs=1e-12)


def test_a_stored_network_and_its_expression_compute_what_was_trained(network, theta, z):
    model = stored(network, theta)
    regressors = model.regressor_mean + model.regressor_sd * z
    values, _, by_z = network.slopes(theta, z)
    found = model.evaluate(regressors)
    assert found == pytest.approx(model.output_mean + model.output_sd * values, abs=1e-12)
    regressor = ca.SX.sym("phi", N_Z)
    output = model.expression(regressor)
    function = ca.Function("f", [regressor], [output, ca.jacobian(output, regressor)])
    slopes = model.output_sd[:, None] * by_z / model.regressor_sd
    for row, expected, slope in zip(regressors, found, slopes, strict=True):
        value, derivative = function(row)
        assert value.full().ravel() == pytest.approx(expected, abs=1e-12)
        assert derivative.full() == pytest.approx(slope, abs=1e-11)


def test_what_is_written_comes_back_with_every_bit(network, theta):
    model = stored(network, theta)
    again = Network.from_data(yaml.safe_load(yaml.safe_dump(model.to_data())))
    assert again.to_data() == model.to_data()
    for name, value in model.weights.items():
        assert again.weights[name].tobytes() == value.tobytes()


@pytest.mark.parametrize(
    ("change", "where"),
    [
        (lambda d: d["weights"].pop("b1"), "network.weights.b1"),
        (lambda d: d["weights"]["b1"].append(0.0), "network.weights.b1"),
        (lambda d: d["weights"].update(W2=[[float("nan")] * 4] * 2), "network.weights.W2"),
        (lambda d: d.pop("output_sd"), "network.output_sd"),
        (lambda d: d.update(output_sd=[1.0]), "network.output_sd"),
        (lambda d: d.update(regressor_sd=[1.0, 0.0, 1.0]), "network.regressor_sd"),
        (lambda d: d.update(kind="svm"), "network.kind"),
        (lambda d: d.update(colour="red"), "network.colour"),
    ],
)
def test_a_file_that_does_not_fit_is_refused_by_its_key(change, where):
    network = NETWORKS["one hidden layer"]
    data = stored(network, np.ones(network.n_parameters)).to_data()
    change(data)
    with pytest.raises(ModelError) as refused:
        Network.from_data(data)
    assert refused.value.where == where
    assert refused.value.remedy


def test_starting_weights_spread_the_units_and_follow_the_seed():
    network = Mlp(4, 2, (30,))
    theta = network.start(np.random.default_rng(0))
    assert np.array_equal(theta, network.start(np.random.default_rng(0)))
    w = network.weights(theta)
    norms = np.linalg.norm(w["W1"], axis=1)
    assert norms == pytest.approx(0.5 * 0.7 * 30 ** (1 / 4))
    assert len(np.unique(np.sign(w["b1"]))) == 2
