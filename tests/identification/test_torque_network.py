"""Method torque_network: exact slopes, a known torque learnt, a plain fit kept where none is."""

from dataclasses import replace

import numpy as np
import pytest

from tests.identification.blackbox.differences import central
from tests.identification.greybox.rigs import recording
from trms_cli.composition.catalogue import read_yaml
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import build
from trms_cli.core.resources import config_folder
from trms_cli.effects.extended_model import extend_model
from trms_cli.effects.quadratic_damping import QuadraticDamping
from trms_cli.identification.findings import _of_network
from trms_cli.identification.free_runs import error_figures, window_runs
from trms_cli.identification.multiple_shooting import MultipleShooting
from trms_cli.identification.problem import (
    FitProblem,
    Method,
    SilentProgress,
    free_parameters,
    with_values,
)
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.newtonian_with_network import NewtonianWithNetwork

RANGES = [(0.2, 1.6)]
MODEL = NewtonianWithNetwork(freedom="vertical")
FREE = ("k_fvp", "k_ov", "l_cb")


def method(training: str = "lm", **changes):
    """The method as configuration has it, small."""
    node = dict(read_yaml(config_folder() / "method" / "torque_network.yaml"))
    node.pop("defaults")
    node["training"] = read_yaml(config_folder() / "training" / f"{training}.yaml")
    node |= {"hidden": [3], "parameters": {"starts": 1}}
    node["stopping"] = {**node["stopping"], "epochs": 60}
    return build(node | changes, "method")


def problem(rig, seconds: float = 40.0) -> FitProblem:
    parts = [recording(rig, ranges=RANGES, seconds=seconds, seed=s)[0] for s in (0, 5)]
    free = free_parameters(MODEL.parameters, FREE)
    return FitProblem(
        model=MODEL,
        datasets=(parts[0],),
        validation=(parts[1],),
        free=free,
        window_length=5.0,
        jobs=1,
    )


@pytest.fixture(scope="module")
def damped():
    """A rig that the equations cannot follow: a damping by the square of the rate."""
    effect = QuadraticDamping(axis="pitch", coefficient=0.05)
    return extend_model(Newtonian(freedom="vertical"), {"pitch_quadratic_damping": effect})


@pytest.fixture(scope="module")
def asked(damped):
    return problem(damped)


@pytest.fixture(scope="module")
def fitted(asked):
    chosen = method()
    assert isinstance(chosen, Method)
    return chosen.fit(asked, SilentProgress())


def trained(asked, result):
    return result.remodel(with_values(asked.model, result.values))


@pytest.mark.slow
def test_it_foretells_another_recording_better_than_the_parameters_alone(asked, fitted, damped):
    plain = MultipleShooting(starts=1).fit(asked, SilentProgress())
    other = [recording(damped, ranges=RANGES, seconds=30.0, seed=9)[0]]
    errors = [
        error_figures(window_runs(model, other, 5.0))["alpha_v"]["rmse"]
        for model in (with_values(MODEL, plain.values), trained(asked, fitted))
    ]
    assert fitted.details["network"]["kept"]
    assert errors[1] < 0.6 * errors[0]


@pytest.mark.slow
def test_parameters_come_with_their_doubts(fitted):
    assert fitted.covariance.shape == (len(FREE), len(FREE))
    sd = np.sqrt(np.diag(fitted.covariance))
    assert np.all(sd > 0)
    truth = np.array([MODEL.parameters[name].value for name in fitted.values])
    assert np.all(np.abs(fitted.theta - truth) < 5 * sd)


@pytest.mark.slow
def test_the_same_seed_gives_the_same_network(asked, fitted):
    again = trained(asked, method().fit(asked, SilentProgress())).torque_network.to_data()
    assert again == trained(asked, fitted).torque_network.to_data()


@pytest.mark.slow
def test_where_nothing_is_to_be_learnt_the_plain_fit_is_kept():
    asked = problem(Newtonian(freedom="vertical"))
    result = method().fit(asked, SilentProgress())
    assert not result.details["network"]["kept"]
    assert trained(asked, result).torque_network is None
    plain = MultipleShooting(starts=1).fit(asked, SilentProgress())
    assert result.values == plain.values


@pytest.mark.slow
def test_slopes_are_those_of_the_loss(asked):
    """In weights and parameters, with the starts eliminated; by differences."""
    chosen = method()
    plain = MultipleShooting(starts=1).fit(asked, SilentProgress())
    fitted = replace(asked, model=with_values(MODEL, plain.values))
    network = chosen._untrained(replace(fitted, free=()))
    _, objective, _ = replace(chosen, stopping=replace(chosen.stopping, epochs=1))._trained(
        fitted, plain, network, SilentProgress()
    )
    z = 0.3 * np.random.default_rng(1).standard_normal(len(FREE) + len(objective._prior) - 3)
    z[: len(FREE)] *= 0.1
    loss, slope = objective.gradient(z)
    assert loss == pytest.approx(objective.loss(z), rel=1e-9)
    expected = central(lambda at: np.array(objective.loss(at)), z, 1e-4)
    np.testing.assert_allclose(slope, expected, rtol=0.02, atol=0.02 * np.abs(expected).max())


def test_a_model_without_a_place_for_it_is_refused(asked):
    plain = replace(asked, model=Newtonian(freedom="vertical"))
    with pytest.raises(ConfigurationError) as caught:
        method().fit(plain, SilentProgress())
    assert caught.value.where == "model"
    assert "newtonian_with_network" in caught.value.remedy


def test_an_unknown_regressor_is_refused_with_those_that_there_are(asked):
    with pytest.raises(ConfigurationError) as caught:
        method(regressors=["wind"])._untrained(replace(asked, free=()))
    assert caught.value.where == "method.regressors" and "alpha_v_rate" in caught.value.remedy


@pytest.mark.parametrize(
    ("record", "words"),
    [
        ({"kept": True, "validation_loss": [1.0, 0.64]}, "takes 20 % off"),
        ({"kept": False, "validation_loss": [1.0, 0.95]}, "No network is kept"),
        ({"kept": True, "validation_loss": [None, None]}, "nothing was held out"),
    ],
)
def test_what_decided_is_told(record, words):
    assert words in _of_network(record)
