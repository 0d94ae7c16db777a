"""Method genetic_structure: terms and coefficients of known systems, files, what it builds on."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from tests.identification.greybox.rigs import dataset_of
from tests.identification.watched import Watched
from trms_cli.composition.catalogue import read_yaml
from trms_cli.core.errors import ModelError
from trms_cli.core.plugins import build
from trms_cli.core.resources import config_folder
from trms_cli.effects.model_file import load_model
from trms_cli.identification.blackbox.genetic_structure import (
    Monomials,
    SimulatedPolynomials,
    simulated_errors,
)
from trms_cli.identification.blackbox.network_fit import Regressors, prepare_samples
from trms_cli.identification.blackbox.prediction_error import free_run
from trms_cli.identification.dataset import Dataset
from trms_cli.identification.model_writer import write_model
from trms_cli.identification.problem import FitOutcome, FitProblem, Method, SilentProgress
from trms_cli.models.linear_file import StateSpaceModel
from trms_cli.models.narx_file import Narx
from trms_cli.models.network import NarxStructure, Network
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.state_space import DiscreteStateSpace
from trms_cli.simulation.rollout import Rollout

MODEL = Newtonian(freedom="horizontal")
STEP, NOISE = 0.1, 0.002
PLAIN = {"output_lags": [1, 2], "input_lags": [1], "incremental": False, "differences": False}


def dataset(seed: int, *, bend: float = 0.0, n: int = 500, noise: float = NOISE) -> Dataset:
    """A known difference equation under the names of a rig, measured with noise.

    y₁(k) = 0.9 y₁(k−1) + 0.1 y₂(k−1) + bend y₂(k−1)²,  y₂(k) = 0.8 y₂(k−1) + 0.3 u(k−1)
    """
    random = np.random.default_rng(seed)
    u = np.repeat(random.uniform(-1, 1, n // 10 + 1), 10)[:n]
    y = np.zeros((n, 2))
    for k in range(1, n):
        y[k, 1] = 0.8 * y[k - 1, 1] + 0.3 * u[k - 1]
        y[k, 0] = 0.9 * y[k - 1, 0] + 0.1 * y[k - 1, 1] + bend * y[k - 1, 1] ** 2
    y += noise * random.standard_normal(y.shape)
    sd = np.full(2, max(noise, 1e-9))
    return dataset_of(MODEL, u[:, None], y, sd, step=STEP, name=f"d{seed}")


def method(**changes) -> Method:
    node = dict(read_yaml(config_folder() / "method" / "genetic_structure.yaml"))
    node |= {"individuals": 16, "generations": 12, "horizon": 2.0}
    node["regressors"] = {**node["regressors"], **PLAIN, "smoothing": 0.0}
    chosen = build(node | changes, "method")
    assert isinstance(chosen, Method)
    return chosen


def problem(**settings) -> FitProblem:
    return FitProblem(
        model=MODEL, datasets=(dataset(0, **settings),), validation=(dataset(1, **settings),)
    )


@pytest.fixture(scope="module")
def linear():
    return method().fit(problem(), SilentProgress())


@pytest.fixture(scope="module")
def bent():
    return method(degree=2).fit(problem(bend=0.05), SilentProgress())


def test_candidates_are_all_monomials_and_what_they_are():
    candidates = Monomials.up_to(3, 3)
    assert len(candidates) == 20  # (3 + 3)! / (3! 3!)
    z = np.random.default_rng(0).normal(size=(5, 3))
    expected = np.prod(z[:, None, :] ** candidates.exponents, axis=2)
    np.testing.assert_allclose(candidates.values(z), expected, rtol=1e-13)


def test_coefficients_without_moves_are_least_squares_over_the_terms_that_are_there():
    asked = problem()
    data = prepare_samples(Regressors(output_lags=(1, 2), input_lags=(1,)), asked)
    candidates = Monomials.up_to(data.structure.n_regressors, 2)
    windows = method()._windows(data, "fitted")
    polynomials = SimulatedPolynomials(data, candidates, windows, 3.0)
    random = np.random.default_rng(2)
    present = random.uniform(size=(2, 2, len(candidates))) < 0.5
    theta = polynomials.coefficients(present, np.zeros(present.shape))
    z, targets = data.normalised(data.fitted)
    columns = candidates.values(z)
    for individual in range(2):
        for output in range(2):
            own = columns[:, present[individual, output]]
            _, squares, *_ = np.linalg.lstsq(own, targets[:, output], rcond=None)
            chosen = theta[individual, output][present[individual, output]]
            residual = targets[:, output] - own @ chosen
            assert residual @ residual <= squares[0] * (1 + 1e-6)
    assert not np.any(theta[~present])
    moved = polynomials.coefficients(present, np.ones(present.shape))
    assert np.all((moved > theta)[present])


def test_models_side_by_side_are_simulated_as_each_alone():
    asked = problem()
    data = prepare_samples(Regressors(output_lags=(1, 3), input_lags=(1, 2)), asked)
    candidates = Monomials.up_to(data.structure.n_regressors, 1)
    windows = method()._windows(data, "fitted")
    theta = 0.1 * np.random.default_rng(3).normal(size=(3, 2, len(candidates)))
    errors = simulated_errors(windows, candidates, theta)
    past, inputs, targets, present = windows.samples
    for one, expected in zip(theta, errors, strict=True):
        scaling = data.scaling
        network = Network(
            "mlp",
            {"W1": one[:, 1:], "b1": one[:, 0]},
            *(scaling.regressor_mean, scaling.regressor_sd),
            *(scaling.output_mean, scaling.output_sd),
        )
        run = free_run(data.structure, network, past, inputs)
        squares = ((run - targets) / scaling.level_sd)[present] ** 2
        assert squares.sum() / windows.n_residuals == pytest.approx(expected, rel=1e-9)


def test_a_known_linear_system_comes_out(linear):
    """Its coefficients as near as the noise allows, and a rest where its gain says."""
    assert linear.details["linear"] and linear.outcome is FitOutcome.BUDGET_SPENT
    assert linear.details["normalised_rms"]["validation_free_run"] < 0.05
    assert linear.cost <= linear.details["cost_of_first_generation"]
    space = DiscreteStateSpace.from_data(linear.model_document["state_space"])
    # y₂ = 0.3/(1 − 0.8) u at rest, y₁ = 0.1/(1 − 0.9) y₂
    np.testing.assert_allclose(space.static_gain()[:, 0], [1.5, 1.5], rtol=0.05)


def test_a_bend_is_seen_by_a_polynomial_and_not_by_lines(bent):
    lines = method().fit(problem(bend=0.05), SilentProgress())
    assert not bent.details["linear"]
    errors = [fit.details["normalised_rms"]["validation_free_run"] for fit in (bent, lines)]
    assert errors[0] < 0.5 * errors[1]
    squares = [word for word in bent.details["coefficients"]["alpha_h"] if "*" in word]
    assert "[omega_h(k-1)]*[omega_h(k-1)]" in squares


def test_the_same_seed_gives_the_same_model_and_a_stopped_search_goes_on_to_it(linear):
    stopped = Watched(after=5)
    half = method().fit(problem(), stopped)
    assert half.outcome is FitOutcome.INTERRUPTED
    again = method().fit(problem(), Watched(kept=stopped.kept))
    assert again.model_document["state_space"] == linear.model_document["state_space"]


def test_a_linear_file_is_a_linear_model_that_runs_as_the_polynomial(linear, tmp_path):
    path = tmp_path / "model.yaml"
    write_model(linear.model_document, path)
    model = load_model(str(path))
    assert isinstance(model, StateSpaceModel) and model.state_space.spectral_radius < 1.0
    other = dataset(5, noise=0.0)
    rollout = Rollout(model, STEP)
    start = np.zeros(model.n_x)
    start[:2] = other.measurements[1]
    lags = [i for i, name in enumerate(model.state_names) if name.endswith("_lag1")]
    start[lags] = other.measurements[0][: len(lags)]
    y = rollout.outputs(other.commands, [1], [400], start[None]).y
    error = np.sqrt(np.mean((y - other.measurements[1:401]) ** 2, axis=0))
    assert np.all(error < 0.05 * other.measurements.std(axis=0))


def test_a_polynomial_file_steps_as_the_polynomial(bent, tmp_path):
    path = tmp_path / "model.yaml"
    write_model(bent.model_document, path)
    model = load_model(str(path))
    assert isinstance(model, Narx) and model.network.kind == "polynomial"
    structure = NarxStructure.from_data(bent.model_document["structure"])
    at = model.symbols()
    step = ca.Function("step", list(at), [model.transition(*at)])
    random = np.random.default_rng(4)
    past, u = random.normal(size=(2, 1, 2)), random.normal(size=(3, 1, 1))
    expected = free_run(structure, model.network, past, u)[0, 0]
    x = np.concatenate([past[1, 0], past[0, 0]])[: model.n_x]
    after = np.array(step(x, u[1, 0], [], np.zeros(2)))[:2, 0]
    np.testing.assert_allclose(after, expected, rtol=1e-12)


def test_what_is_no_polynomial_is_refused():
    good = {"exponents": [[1.0, 1.0]], "W": [[1.0]], "A": [[0.0, 1.0]], "b": [0.0]}
    scales = (np.zeros(2), np.ones(2), np.zeros(1), np.ones(1))
    Network("polynomial", good, *scales)
    for change in ({"exponents": [[0.5, 1.0]]}, {"exponents": [[0.0, 0.0]]}):
        with pytest.raises(ModelError) as caught:
            Network("polynomial", good | change, *scales)
        assert caught.value.where == "weights.exponents"
    with pytest.raises(ModelError):
        Network("polynomial", {**good, "widths": [1.0]}, *scales)


def test_a_recording_held_out_takes_no_part(linear):
    other = replace(problem(), validation=(dataset(7),))
    again = method().fit(other, SilentProgress())
    assert again.model_document["state_space"] == linear.model_document["state_space"]
