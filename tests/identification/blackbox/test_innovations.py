"""Networks with residuals: NNARMAX and NNSSIF, exact in their slopes; and networks of the past
commands alone."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from tests.identification.blackbox.differences import central
from tests.identification.blackbox.test_methods import MODEL, dataset, method
from tests.identification.watched import Watched
from trms_cli.core.errors import ConfigurationError, ModelError, RecordingError
from trms_cli.identification.blackbox.innovation_error import InnovationError
from trms_cli.identification.blackbox.prediction_error import (
    Samples,
    free_run,
    predict_samples,
    rms,
    sample_signals,
    scaling,
    simulate_network,
)
from trms_cli.identification.blackbox.trainable import Mlp
from trms_cli.identification.problem import FitOutcome, FitProblem, SilentProgress
from trms_cli.models.innovation_network import InnovationNetwork, InnovationStructure
from trms_cli.models.innovation_network import structure_from_data as structure_of
from trms_cli.models.model import names
from trms_cli.models.narx_file import NarxFile, read_narx_file, write_narx_file
from trms_cli.models.network import ACTIVATIONS, NarxStructure, Network

SIGNALS = (("a", "b"), ("u",), ("rad", "rad"), ("V",))


def residual_structure(incremental: bool) -> NarxStructure:
    return NarxStructure(*SIGNALS, (1, 3), (1, 2), 0.1, incremental, True, residual_lags=(1, 4))


def state_structure(incremental: bool, order: int = 2) -> InnovationStructure:
    return InnovationStructure(*SIGNALS, order, 0.1, incremental)


FORMS = [
    residual_structure(True),
    residual_structure(False),
    state_structure(True),
    state_structure(False, 3),
    state_structure(True, 1),
]


@pytest.fixture
def samples() -> Samples:
    generator = np.random.default_rng(0)
    u = generator.uniform(-1, 1, (60, 1))
    y = np.zeros((60, 2))
    for k in range(1, 60):
        y[k, 0] = 0.9 * y[k - 1, 0] + 0.2 * np.tanh(u[k - 1, 0])
        y[k, 1] = 0.8 * y[k - 1, 1] + 0.3 * y[k - 1, 0] ** 2
    y += 0.02 * generator.standard_normal(y.shape)
    y[40, 1] = np.nan
    return Samples(y, u, "r")


def parts(structure, samples, activation="tanh"):
    scale = scaling(structure, [samples])
    sd = scale.regressor_sd.copy()
    sd[structure.n_regressors - structure.n_residuals :] = 0.03
    scale = replace(scale, regressor_sd=sd)
    network = Mlp(structure.n_regressors, structure.n_predicted, (3,), True, activation)
    theta = 0.1 * np.random.default_rng(5).standard_normal(network.n_parameters)
    stored = Network(
        "mlp", network.weights(theta), scale.regressor_mean, scale.regressor_sd,
        scale.output_mean, scale.output_sd, activation,
    )  # fmt: skip
    return scale, network, theta, stored


@pytest.mark.parametrize("structure", FORMS)
def test_slopes_of_the_prediction_error_are_those_of_differences(structure, samples):
    scale, network, theta, _ = parts(structure, samples)
    objective = InnovationError(network, structure, scale, [samples], 25, 5)
    loss, gradient = objective.gradient(theta)
    assert loss == pytest.approx(objective.loss(theta), rel=1e-12)
    expected = central(lambda t: np.array(objective.loss(t)), theta)
    assert gradient == pytest.approx(expected, rel=1e-5, abs=1e-7 * np.abs(expected).max())
    equations = objective.normal_equations(theta)
    assert equations.loss == pytest.approx(loss, rel=1e-12)
    assert 2.0 * equations.slope / objective.n_residuals == pytest.approx(
        gradient, rel=1e-9, abs=1e-10
    )

    def residuals(t):
        errors = (objective.predicted(t) - objective._outputs) / objective._residual_sd
        return errors[objective._present]

    jacobian = central(residuals, theta)
    scale_of = np.abs(jacobian.T @ jacobian).max()
    assert equations.curvature == pytest.approx(
        jacobian.T @ jacobian, rel=1e-4, abs=1e-6 * scale_of
    )


def test_residuals_enter_as_the_equations_say(samples):
    """NNARMAX by hand: each residual is what the prediction of that sample missed."""
    structure = residual_structure(True)
    *_, stored = parts(structure, samples)
    y, u = samples.outputs[:20], samples.inputs
    predicted = predict_samples(structure, stored, samples)[:20]
    e = np.zeros((20, 2))
    for k in range(4, 20):
        lagged = [y[k - 1], y[k - 1] - y[k - 3], u[k - 1], u[k - 2], e[k - 1], e[k - 4]]
        foretold = y[k - 1] + stored.evaluate(np.concatenate(lagged)[None])[0]
        assert predicted[k] == pytest.approx(foretold, abs=1e-12)
        e[k] = y[k] - foretold


def test_innovations_enter_as_the_equations_say(samples):
    """NNSSIF by hand: x(k+1) = S x + g(x, u, e), the outputs are the first states."""
    structure = state_structure(True)
    *_, stored = parts(structure, samples)
    y, u = samples.outputs[:20], samples.inputs
    predicted = predict_samples(structure, stored, samples)[:20]
    x = np.concatenate([y[0], y[1]])
    for k in range(1, 20):
        innovation = y[k - 1] - x[:2]
        g = stored.evaluate(np.concatenate([x, u[k - 1], innovation])[None])[0]
        x = np.concatenate([x[2:], x[2:]]) + g
        if k >= 2:
            assert predicted[k] == pytest.approx(x[:2], abs=1e-12)


@pytest.mark.parametrize("activation", ACTIVATIONS)
@pytest.mark.parametrize("structure", [FORMS[0], FORMS[2]])
def test_the_model_steps_as_the_free_run_without_residuals(structure, activation, samples):
    *_, stored = parts(structure, samples, activation)
    content = NarxFile(name="n", structure=structure, network=stored, limits={"u": 1.0})
    model = content.model()
    at = model.symbols()
    step = ca.Function("step", list(at), [model.transition(*at)])
    first = structure.longest_lag
    run = free_run(structure, stored, samples.outputs[:first, None], samples.inputs[:, None])[:, 0]
    if isinstance(model, InnovationNetwork):
        state, begin = np.concatenate([samples.outputs[0], samples.outputs[1]]), 0
    else:
        # Outputs of the last three samples, newest first, and the command before the last.
        state, begin = np.concatenate([*samples.outputs[first - 3 : first][::-1],
                                       samples.inputs[first - 2]]), first - 1  # fmt: skip
    for k in range(begin, 30):
        state = step(state, samples.inputs[k], [], np.zeros(model.n_w)).full().ravel()
        if k + 1 >= first:
            assert state[:2] == pytest.approx(run[k + 1 - first], abs=1e-10)


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_each_activation_has_exact_slopes_and_one_expression(activation):
    network = Mlp(3, 2, (4, 3), True, activation)
    generator = np.random.default_rng(1)
    theta, z = network.start(generator), 2.0 * generator.standard_normal((7, 3))
    values, by_theta, by_z = network.slopes(theta, z)
    assert by_theta == pytest.approx(central(lambda t: network.values(t, z), theta), abs=1e-7)
    one = np.stack([central(lambda x: network.values(theta, x[None])[0], row) for row in z])
    assert by_z == pytest.approx(one, abs=1e-7)
    weight = generator.standard_normal(values.shape)
    back, back_z = network.pulled_back(theta, z, weight)
    assert back == pytest.approx(np.einsum("no,nop->p", weight, by_theta), abs=1e-12)
    assert back_z == pytest.approx(np.einsum("no,noz->nz", weight, by_z), abs=1e-12)
    stored = Network("mlp", network.weights(theta), np.zeros(3), np.ones(3), np.zeros(2),
                     np.ones(2), activation)  # fmt: skip
    assert stored.evaluate(z) == pytest.approx(values, abs=1e-14)
    symbol = ca.SX.sym("z", 3)
    function = ca.Function("f", [symbol], [stored.expression(symbol)])
    assert pytest.approx(values, abs=1e-12) == function(z.T).full().T
    again = Network.from_data(stored.to_data())
    assert again.activation == activation
    assert ("activation" in stored.to_data()) == (activation != "tanh")


@pytest.fixture(scope="module")
def problem() -> FitProblem:
    return FitProblem(model=MODEL, datasets=(dataset(0),), validation=(dataset(1),))


SMALL = {"nnarmax": {}, "nnssif": {}, "nnfir": {"regressors": {"input_lags": list(range(1, 31))}}}


@pytest.fixture(scope="module", params=SMALL)
def fitted(request, problem):
    return method(request.param, **SMALL[request.param]).fit(problem, SilentProgress())


def test_a_fit_is_near_the_noise_and_its_file_is_a_model(fitted, tmp_path):
    document = fitted.model_document
    structure, network = structure_of(document["structure"]), Network.from_data(document["network"])
    test = sample_signals(dataset(2), structure)
    first = structure.longest_lag
    ahead = (predict_samples(structure, network, test) - test.outputs)[first:]
    free = (simulate_network(structure, network, test) - test.outputs)[first:]
    if fitted.method == "nnfir":  # past outputs make no difference
        assert ahead == pytest.approx(free, abs=1e-12)
    else:
        assert np.all(rms(ahead) < 0.02)  # the noise is 0.01
    assert np.all(rms(free) < 0.5 * test.outputs.std(axis=0))
    content = NarxFile(name="a", structure=structure, network=network, limits=document["limits"])
    write_narx_file(tmp_path / "a.yaml", content)
    again = read_narx_file(str(tmp_path / "a.yaml"))
    assert again.structure == structure
    model = again.model()
    assert names(model.outputs) == structure.outputs
    rest = model.rest()
    x, u, p, w = model.symbols()
    step = ca.Function("step", [x, u, p, w], [model.transition(x, u, p, w)])
    after = step(rest, np.zeros(model.n_u), [], np.zeros(model.n_w)).full().ravel()
    assert after == pytest.approx(rest, abs=1e-6)


def test_residuals_help_where_the_noise_is_of_the_sensors(problem):
    """White noise on the outputs is no white residual of NNARX; a model of the noise is nearer."""

    def error(name: str) -> float:
        details = method(name, stopping={"epochs": 25}).fit(problem, SilentProgress()).details
        return details["normalised_rms"]["validation_one_step"]

    plain = error("narx")
    assert error("nnarmax") < 0.98 * plain
    assert error("nnssif") < 0.98 * plain


def test_an_interrupted_fit_keeps_the_best_so_far(problem):
    for calls in (3, 24):
        result = method("nnarmax").fit(problem, Watched(calls))
        assert result.outcome is FitOutcome.INTERRUPTED
        structure_of(result.model_document["structure"])


@pytest.mark.parametrize(
    ("name", "changes", "key"),
    [
        ("narx", {"regressors": {"output_lags": [], "incremental": False}}, "output_lags"),
        ("nnoe", {"regressors": {"output_lags": [], "incremental": False}}, "output_lags"),
        ("nnfir", {"regressors": {"output_lags": [1]}}, "output_lags"),
        ("nnfir", {"regressors": {"incremental": True}}, "incremental"),
        ("nnarmax", {"regressors": {"residual_lags": []}}, "residual_lags"),
        ("nnarmax", {"regressors": {"residual_lags": [2, 1]}}, "residual_lags"),
        ("nnarmax", {"regressors": {"output_lags": []}}, "output_lags"),
        ("nnssif", {"skip": 10.0}, "skip"),
        ("narx", {"activation": "relu"}, "activation"),
        ("nnssif", {"regressors": {"order": 0}}, "order"),
    ],
)
def test_what_does_not_fit_is_refused_by_its_key(name, changes, key, problem):
    with pytest.raises(ConfigurationError, match=key):
        method(name, **changes).fit(problem, SilentProgress())


def test_a_window_longer_than_the_recordings_is_told(problem):
    with pytest.raises(RecordingError, match=r"method\.window"):
        method("nnarmax", window=1000.0).fit(problem, SilentProgress())


def test_files_that_do_not_fit_are_refused():
    data = state_structure(True).to_data()
    with pytest.raises(ModelError, match="order"):
        structure_of(data | {"order": 0})
    with pytest.raises(ModelError, match="output_lags"):
        structure_of(data | {"output_lags": [1]})
    *_, stored = parts(state_structure(True), _moving())
    with pytest.raises(ModelError, match="regressor_mean"):
        InnovationNetwork(state_structure(True, 3), stored)
    with pytest.raises(ModelError, match="activation"):
        Network.from_data(stored.to_data() | {"activation": "relu"})


def _moving() -> Samples:
    generator = np.random.default_rng(3)
    return Samples(generator.standard_normal((80, 2)), generator.standard_normal((80, 1)), "m")
