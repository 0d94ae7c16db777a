"""One-step and simulation errors: equal where they must be, exact in their slopes."""

import numpy as np
import pytest

from tests.identification.blackbox.differences import central
from trms_cli.core.errors import RecordingError
from trms_cli.identification.blackbox.prediction_error import (
    MultiStepError,
    OneStepError,
    Samples,
    rows,
    scaling,
)
from trms_cli.identification.blackbox.trainable import Mlp
from trms_cli.models.network import NarxStructure

PAIRS = [(True, True), (True, False), (False, True), (False, False)]


def structure(incremental: bool = True, differences: bool = True) -> NarxStructure:
    return NarxStructure(
        ("a", "b"), ("u",), ("rad", "rad"), ("V",), (1, 3), (1, 2), 0.1, incremental, differences
    )


@pytest.fixture
def samples() -> Samples:
    generator = np.random.default_rng(0)
    u = generator.uniform(-1, 1, (60, 1))
    y = np.zeros((60, 2))
    for k in range(1, 60):
        y[k, 0] = 0.9 * y[k - 1, 0] + 0.2 * np.tanh(u[k - 1, 0])
        y[k, 1] = 0.8 * y[k - 1, 1] + 0.3 * y[k - 1, 0] ** 2
    return Samples(y + 0.01 * generator.standard_normal(y.shape), u, "r")


def parts(samples, form=(True, True)):
    shape = structure(*form)
    scale = scaling(shape, [samples])
    network = Mlp(shape.n_regressors, 2, (3,))
    theta = 0.3 * np.random.default_rng(5).standard_normal(network.n_parameters)
    return shape, scale, network, theta


def one_step(samples, form=(True, True)):
    shape, scale, network, theta = parts(samples, form)
    regressors, targets, _ = rows(shape, samples)
    z = (regressors - scale.regressor_mean) / scale.regressor_sd
    normalised = (targets - scale.output_mean) / scale.output_sd
    return OneStepError(network, z, normalised), theta


def test_a_row_holds_the_samples_of_its_lags(samples):
    shape = structure(differences=False)
    regressors, targets, place = rows(shape, samples)
    k = 17
    row = list(place).index(k)
    expected = [
        *samples.outputs[k - 1],
        *samples.outputs[k - 3],
        *samples.inputs[[k - 1, k - 2], 0],
    ]
    assert regressors[row] == pytest.approx(expected, abs=1e-15)
    assert targets[row] == pytest.approx(samples.outputs[k] - samples.outputs[k - 1])
    # Differences say the same.
    different, *_ = rows(structure(differences=True), samples)
    assert different[:, 2:4] == pytest.approx(regressors[:, 0:2] - regressors[:, 2:4], abs=1e-14)
    assert np.linalg.matrix_rank(structure().arrangement()) == structure().n_regressors
    # A lost sample takes its rows away and no others.
    outputs = samples.outputs.copy()
    outputs[20, 0] = np.nan
    _, _, place = rows(structure(), Samples(outputs, samples.inputs))
    # as the target, as the sample before it, and at the third lag
    assert sorted(set(range(3, 60)) - set(place)) == [20, 21, 23]


def test_one_step_slopes_are_those_of_differences(samples):
    objective, theta = one_step(samples)
    check_slopes(objective, theta)
    residuals, jacobian = objective.residuals(theta), objective.jacobian(theta)
    equations = objective.normal_equations(theta)
    assert equations.curvature == pytest.approx(jacobian.T @ jacobian, rel=1e-10)
    assert equations.slope == pytest.approx(jacobian.T @ residuals, rel=1e-10, abs=1e-12)


@pytest.mark.parametrize("form", PAIRS)
def test_simulation_slopes_are_those_of_differences(samples, form):
    shape, scale, network, theta = parts(samples, form)
    outputs = samples.outputs.copy()
    outputs[25:27, 1] = np.nan  # a gap inside a window
    objective = MultiStepError(
        network, shape, scale, [Samples(outputs, samples.inputs)], steps=9, stride=5
    )
    check_slopes(objective, theta)


def check_slopes(objective, theta):
    """Gradient against differences of the loss, and the normal equations against the gradient."""
    loss, gradient = objective.gradient(theta)
    assert loss == pytest.approx(objective.loss(theta), rel=1e-12)
    assert gradient == pytest.approx(central(objective.loss, theta), rel=1e-5, abs=1e-8)
    equations = objective.normal_equations(theta)
    assert equations.loss == pytest.approx(loss, rel=1e-12)
    assert 2 * equations.slope / objective.n_residuals == pytest.approx(
        gradient, rel=1e-9, abs=1e-12
    )


def test_the_curvature_of_a_simulation_is_that_of_its_jacobian(samples):
    shape, scale, network, theta = parts(samples)
    objective = MultiStepError(network, shape, scale, [samples], steps=9)

    def errors(t):
        targets = np.stack([samples.outputs[f : f + 9] for f in range(3, 52, 9)], axis=1)
        return ((objective.simulated(t) - targets) / scale.level_sd).ravel()

    jacobian = central(errors, theta)
    found = objective.normal_equations(theta).curvature
    assert found == pytest.approx(jacobian.T @ jacobian, rel=1e-5, abs=1e-5)
    # A window of one step is the one-step error.
    simulated = MultiStepError(network, shape, scale, [samples], steps=1, stride=1)
    predicted, _ = one_step(samples)
    # the same errors, in units of the levels and of the increments
    residuals = predicted.residuals(theta).reshape(-1, 2) * scale.output_sd / scale.level_sd
    assert simulated.loss(theta) == pytest.approx(np.mean(residuals**2), rel=1e-12)


def test_what_cannot_be_fitted_is_refused_with_what_to_record_instead(samples):
    still = Samples(samples.outputs, np.full_like(samples.inputs, 0.3), "r")
    with pytest.raises(RecordingError, match=r"'u' never moves.*excitation"):
        scaling(structure(), [still])
    short = Samples(samples.outputs[:9], samples.inputs[:9], "r")
    with pytest.raises(RecordingError, match=r"only 6 complete samples.*record at least"):
        scaling(structure(), [short])
    shape, scale, network, _ = parts(samples)
    with pytest.raises(RecordingError, match="shorter horizon"):
        MultiStepError(network, shape, scale, [samples], steps=100)
