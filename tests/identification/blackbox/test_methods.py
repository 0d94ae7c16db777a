"""From a problem to a network file: what methods of networks promise, where radial ones start."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from tests.identification.greybox.rigs import dataset_of
from tests.identification.watched import Watched
from trms_cli.composition.catalogue import read_yaml
from trms_cli.core.errors import ConfigurationError, RecordingError
from trms_cli.core.plugins import build
from trms_cli.core.resources import config_folder
from trms_cli.identification.blackbox.prediction_error import (
    free_run,
    predict_samples,
    rms,
    sample_signals,
    simulate_network,
)
from trms_cli.identification.blackbox.radial_fit import (
    Radial,
    cluster_centres,
    dyadic,
    select_columns,
    with_linear_weights,
)
from trms_cli.identification.dataset import Dataset
from trms_cli.identification.problem import FitOutcome, FitProblem, Method, SilentProgress
from trms_cli.models.narx_file import NarxFile, read_narx_file, write_narx_file
from trms_cli.models.network import NarxStructure, Network
from trms_cli.models.newtonian import Newtonian

METHODS = ["narx", "nnoe", "rbf", "wavelet"]
MODEL = Newtonian(freedom="horizontal")
NOISE = 0.01


def method(name: str, training: str = "lm", **changes):
    """A method as configuration has it, small."""
    node = dict(read_yaml(config_folder() / "method" / f"{name}.yaml"))
    node.pop("defaults")
    node["training"] = read_yaml(config_folder() / "training" / f"{training}.yaml")
    small = {"stopping": {**node["stopping"], "epochs": 15}}
    small |= {"units": 6} if name in ("rbf", "wavelet") else {"hidden": [4]}
    for key, value in (small | changes).items():
        node[key] = {**node[key], **value} if isinstance(value, dict) else value
    return build(node, "method")


def dataset(seed: int, n: int = 400, step: int = 1) -> Dataset:
    """A small nonlinear system under the names of a rig: an integrator-free yaw with a rotor."""
    generator = np.random.default_rng(seed)
    u = np.repeat(generator.uniform(-1, 1, n // 10 + 1), 10)[:n]
    y = np.zeros((n, 2))
    for k in range(1, n):
        y[k, 1] = 0.8 * y[k - 1, 1] + 0.3 * u[k - 1]
        y[k, 0] = 0.95 * y[k - 1, 0] + 0.1 * y[k - 1, 1] * abs(y[k - 1, 1])
    y += NOISE * generator.standard_normal(y.shape)
    u, y = np.repeat(u, step), np.repeat(y, step, axis=0)
    return dataset_of(MODEL, u[:, None], y, np.full(2, NOISE), step=0.1 / step, name=f"d{seed}")


@pytest.fixture(scope="module")
def problem() -> FitProblem:
    return FitProblem(model=MODEL, datasets=(dataset(0),), validation=(dataset(1),))


@pytest.fixture(scope="module", params=METHODS)
def chosen(request):
    return method(request.param)


@pytest.fixture(scope="module")
def fitted(chosen, problem):
    assert isinstance(chosen, Method)
    return chosen.fit(problem, SilentProgress())


def network_of(result) -> tuple[NarxStructure, Network]:
    document = result.model_document
    return NarxStructure.from_data(document["structure"]), Network.from_data(document["network"])


def test_the_network_is_near_the_noise_one_step_ahead_and_stays_near_in_free_run(fitted):
    structure, network = network_of(fitted)
    test = sample_signals(dataset(2), structure)
    first = structure.longest_lag
    ahead = (predict_samples(structure, network, test) - test.outputs)[first:]
    free = (simulate_network(structure, network, test) - test.outputs)[first:]
    assert np.all(rms(ahead) < 3 * NOISE)
    # far better than the mean, though one-step training promises nothing over many steps
    assert np.all(rms(free) < 0.5 * test.outputs.std(axis=0))


def test_the_same_seed_gives_the_same_network(chosen, fitted, problem):
    again = chosen.fit(problem, SilentProgress())
    assert again.model_document["network"] == fitted.model_document["network"]


def test_the_file_is_a_model_that_steps_as_the_network_runs(fitted, tmp_path):
    structure, network = network_of(fitted)
    document = dict(fitted.model_document)
    content = NarxFile(name="a", structure=structure, network=network, limits=document["limits"])
    write_narx_file(tmp_path / "a.yaml", content)
    model = read_narx_file(str(tmp_path / "a.yaml")).model()
    assert model.input_limits == pytest.approx({"u_h": MODEL.input_limits["u_h"]})
    x, u, p, w = model.symbols()
    step = ca.Function("step", [x, u, p, w], [model.transition(x, u, p, w)])
    test = sample_signals(dataset(3), structure)
    first = structure.longest_lag
    past = test.outputs[:first]
    state = np.concatenate(
        [past[::-1][: structure.output_lags[-1]].ravel(),
         test.inputs[: first - 1][::-1][: structure.input_lags[-1] - 1].ravel()]
    )  # fmt: skip
    expected = free_run(structure, network, past[:, None], test.inputs[:30, None])[:, 0]
    for k, row in enumerate(expected):
        state = step(state, test.inputs[first - 1 + k], [], np.zeros(model.n_w)).full().ravel()
        assert state[:2] == pytest.approx(row, abs=1e-9)


def test_simulation_training_runs_freely_better_than_one_step_training(problem):
    def error(name: str) -> float:
        details = method(name, stopping={"epochs": 40}).fit(problem, SilentProgress()).details
        return details["normalised_rms"]["validation_free_run"]

    assert error("nnoe") <= 1.02 * error("narx")


def test_a_slower_network_takes_means_of_the_commands():
    fast = dataset(0, step=2)
    result = method("narx", regressors={"sample_time": 0.1}).fit(
        FitProblem(model=MODEL, datasets=(fast,)), SilentProgress()
    )
    structure, _ = network_of(result)
    assert structure.sample_time == 0.1
    slow = sample_signals(fast, structure)
    assert slow.inputs == pytest.approx(dataset(0).commands)
    assert slow.outputs == pytest.approx(dataset(0).measurements)


def test_an_interrupted_fit_keeps_the_best_so_far(problem):
    result = method("nnoe").fit(problem, Watched(6))
    assert result.outcome is FitOutcome.INTERRUPTED
    assert len(result.details["stages"]) == 1
    network_of(result)


def test_of_several_starts_the_best_by_validation_is_kept(problem):
    alone = [
        method("narx").fit(FitProblem(**{**vars(problem), "seed": seed}), SilentProgress())
        for seed in range(3)
    ]
    best = min(result.details["stages"][0]["validation_loss"] for result in alone)
    together = method("narx", starts=3).fit(problem, SilentProgress())
    assert together.details["stages"][0]["validation_loss"] == best


def test_what_cannot_be_fitted_is_refused_with_what_to_do(problem):
    """A sample time without a whole ratio, a lost channel, lags that do not rise, no training."""
    with pytest.raises(RecordingError, match=r"method\.sample_time|regressors\.sample_time"):
        method("narx", regressors={"sample_time": 0.15}).fit(problem, SilentProgress())
    lost = replace(dataset(0), measurements=dataset(0).measurements * [1.0, np.nan])
    with pytest.raises(RecordingError, match="omega_h"):
        method("narx").fit(FitProblem(model=MODEL, datasets=(lost,)), SilentProgress())
    with pytest.raises(ConfigurationError, match=r"method\.regressors\.output_lags"):
        method("narx", regressors={"output_lags": [2, 1]}).fit(problem, SilentProgress())
    with pytest.raises(ConfigurationError, match="trms list training"):
        replace(method("narx"), training=3).fit(problem, SilentProgress())


@pytest.fixture
def generator() -> np.random.Generator:
    return np.random.default_rng(0)


def test_each_choice_is_the_one_that_leaves_the_least(generator):
    """The error reduction ratio against a least-squares fit with every candidate in turn."""
    candidates, targets = generator.standard_normal((60, 8)), generator.standard_normal((60, 2))
    fixed = generator.standard_normal((60, 2))

    def left(columns: list[int]) -> float:
        basis = np.hstack([fixed, candidates[:, columns]])
        return float(((targets - basis @ np.linalg.lstsq(basis, targets)[0]) ** 2).sum())

    chosen = select_columns(candidates, targets, fixed, 4)
    for count in range(4):
        rest = [c for c in range(8) if c not in chosen[:count]]
        assert chosen[count] == min(rest, key=lambda c: left([*chosen[:count], c]))
    # A column that says nothing new is not chosen.
    one = generator.standard_normal((50, 1))
    candidates = np.hstack([one, 2.0 * one])
    assert len(select_columns(candidates, one, np.ones((50, 1)), 2)) == 1


def test_dyadic_grids_halve_their_spacing_and_stay_where_data_are(generator):
    z = generator.uniform(-1, 1, (500, 2))
    centres, widths = dyadic(z, 3)
    for level, spacing in enumerate((2.0, 1.0, 0.5)):
        own = centres[np.isclose(widths, spacing * np.sqrt(2))]
        assert len(own), level
        assert own / spacing == pytest.approx(np.round(own / spacing))
        assert np.abs(own).max() <= 1.0 + 2 * spacing


def test_clusters_lie_among_their_data(generator):
    spots = np.array([[0.0, 0.0], [5.0, 0.0], [0.0, 5.0]])
    z = np.repeat(spots, 50, axis=0) + 0.1 * generator.standard_normal((150, 2))
    centres, widths = cluster_centres(z, 3, 1.0, generator)
    distance = np.sqrt(((centres[:, None] - spots[None]) ** 2).sum(axis=2)).min(axis=0)
    assert distance.max() < 0.1
    assert np.all((widths > 4) & (widths < 8))


@pytest.mark.parametrize("kind", ["rbf", "wavelet"])
def test_linear_weights_solve_the_least_squares_problem(kind, generator):
    z, targets = generator.standard_normal((80, 2)), generator.standard_normal((80, 3))
    centres, widths = z[:5], np.full(5, 1.5)
    network = Radial(kind, 2, 3, 5)
    theta = with_linear_weights(network, centres, widths, z, targets, 0.0)
    residual = network.values(theta, z) - targets
    columns = np.hstack([network.units(centres, widths, z), z, np.ones((80, 1))])
    assert columns.T @ residual == pytest.approx(np.zeros((8, 3)), abs=1e-9)
