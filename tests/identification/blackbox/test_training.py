"""The training algorithms, each against what is published or a library gives."""

import contextlib
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import least_squares, minimize
from scipy.sparse.linalg import cg

from trms_cli.composition.catalogue import read_yaml
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import build
from trms_cli.core.resources import config_folder
from trms_cli.identification.blackbox.prediction_error import NormalEquations, OneStepError
from trms_cli.identification.blackbox.trainable import Mlp
from trms_cli.identification.blackbox.training.bayesian_regularisation import (
    BayesianRegularisation,
    effective_parameters,
)
from trms_cli.identification.blackbox.training.conjugate_gradient import ConjugateGradient
from trms_cli.identification.blackbox.training.gradient_descent import GradientDescent
from trms_cli.identification.blackbox.training.levenberg_marquardt import LevenbergMarquardt
from trms_cli.identification.blackbox.training.quasi_newton import _secant
from trms_cli.identification.blackbox.training.resilient import Resilient
from trms_cli.identification.blackbox.training.scaled_conjugate_gradient import (
    ScaledConjugateGradient,
)
from trms_cli.identification.blackbox.training.training import (
    Stopping,
    TrainingOutcome,
    TrainingStopped,
    train,
)

OPTIONS = sorted(path.stem for path in (config_folder() / "training").glob("*.yaml"))


def option(name: str):
    return build(read_yaml(config_folder() / "training" / f"{name}.yaml"), "training")


class LinearLeastSquares:
    """Residuals J θ − t: a quadratic loss, its minimum known."""

    def __init__(self, n: int = 40, size: int = 6, noise: float = 0.1, seed: int = 0) -> None:
        generator = np.random.default_rng(seed)
        self.jacobian = generator.standard_normal((n, size)) * np.geomspace(1.0, 0.3, size)
        self.truth = generator.standard_normal(size)
        self.target = self.jacobian @ self.truth + noise * generator.standard_normal(n)
        self.minimum = np.linalg.lstsq(self.jacobian, self.target)[0]
        self.hessian = 2.0 / n * self.jacobian.T @ self.jacobian

    @property
    def n_residuals(self) -> int:
        return len(self.target)

    def loss(self, theta):
        return self.normal_equations(theta).loss

    def gradient(self, theta):
        equations = self.normal_equations(theta)
        return equations.loss, 2.0 / self.n_residuals * equations.slope

    def normal_equations(self, theta):
        r = self.jacobian @ theta - self.target
        return NormalEquations(r @ r / len(r), self.jacobian.T @ self.jacobian, self.jacobian.T @ r)


class Trace(list):
    """A report that keeps all weights and ends after so many epochs."""

    def __init__(self, epochs: int) -> None:
        super().__init__()
        self.epochs, self.losses, self.effective = epochs, [], []

    def __call__(self, theta, loss, slope, effective=None):
        self.append(theta.copy())
        self.losses.append(loss)
        self.effective.append(effective)
        if len(self) >= self.epochs:
            raise TrainingStopped


def traced(algorithm, objective, start, epochs: int) -> Trace:
    trace = Trace(epochs)
    with contextlib.suppress(TrainingStopped):
        algorithm.minimise(objective, start.copy(), trace)
    return trace


@pytest.fixture
def quadratic():
    return LinearLeastSquares()


@pytest.fixture(scope="module")
def sine() -> OneStepError:
    """A small network on a smooth curve, some noise on it."""
    generator = np.random.default_rng(7)
    z = generator.uniform(-2, 2, (120, 1))
    target = np.sin(1.5 * z) + 0.05 * generator.standard_normal(z.shape)
    return OneStepError(Mlp(1, 1, (2,)), z, target)


@pytest.fixture(scope="module")
def start(sine):
    return sine.network.start(np.random.default_rng(3))


@pytest.fixture(scope="module")
def taught():
    """Data of a network of the same form, and a start in the valley of its minimum."""
    generator = np.random.default_rng(11)
    network = Mlp(2, 1, (2,))
    teacher = np.array([1.2, 0.3, -0.4, 1.5, 0.4, -0.3, 1.0, 0.8, 0.1])
    z = generator.uniform(-2, 2, (300, 2))
    target = network.values(teacher, z) + 0.05 * generator.standard_normal((300, 1))
    objective = OneStepError(network, z, target)
    return objective, teacher + 0.3 * generator.standard_normal(teacher.size)


class TestAll:
    """What holds for every algorithm."""

    @pytest.mark.parametrize("name", OPTIONS)
    def test_reduces_the_loss_of_a_network_and_is_repeated_bit_for_bit(self, name, sine, start):
        training = train(option(name), sine, start, Stopping(epochs=300, patience=0))
        assert training.history.losses[-1] < 0.5 * training.history.losses[0]
        kept = training.history.losses[training.best_epoch]
        assert sine.loss(training.theta) == pytest.approx(kept)
        again = train(option(name), sine, start, Stopping(epochs=15, patience=0))
        assert again.history.losses == training.history.losses[:16]

    @pytest.mark.parametrize("name", ["lm", "bfgs", "cgf", "cgp", "cgb", "scg", "oss", "rp"])
    def test_ends_in_the_minimum_that_scipy_finds(self, name, taught):
        objective, start = taught
        limits = Stopping(epochs=5000, gradient=1e-7, progress=0.0, patience=0)
        training = train(option(name), objective, start, limits)
        squares = least_squares(
            objective.residuals, start, jac=objective.jacobian, method="lm", xtol=1e-13, ftol=1e-13
        )
        general = minimize(
            objective.gradient, start, jac=True, method="BFGS", options={"gtol": 1e-8}
        )
        assert squares.x == pytest.approx(general.x, abs=1e-5)
        assert training.theta == pytest.approx(squares.x, abs=1e-4)
        assert objective.loss(training.theta) == pytest.approx(general.fun, rel=1e-8)


class TestGradientDescent:
    """Plain, with momentum, adaptive."""

    def test_converges_at_the_rate_of_the_slowest_mode(self, quadratic):
        rate = 0.1
        trace = traced(GradientDescent(learning_rate=rate), quadratic, np.zeros(6), 400)
        ratio = np.linalg.norm(trace[-1] - quadratic.minimum) / np.linalg.norm(
            trace[-2] - quadratic.minimum
        )
        assert ratio == pytest.approx(1 - rate * np.linalg.eigvalsh(quadratic.hessian)[0], rel=1e-3)
        # A rate beyond the limit ends instead of overflowing.
        wild = GradientDescent(learning_rate=50.0)
        training = train(wild, quadratic, np.ones(6), Stopping(epochs=10_000))
        assert training.outcome is TrainingOutcome.NO_PROGRESS

    def test_momentum_is_the_heavy_ball(self, quadratic):
        eta, mu = 0.05, 0.8
        trace = traced(GradientDescent(learning_rate=eta, momentum=mu), quadratic, np.zeros(6), 5)
        theta, before = np.zeros(6), np.zeros(6)
        for found in trace:
            step = theta - eta * quadratic.gradient(theta)[1] + mu * (theta - before)
            theta, before = step, theta
            assert found == pytest.approx(theta, abs=1e-12)

    def test_an_adaptive_rate_never_lets_the_loss_rise_beyond_the_tolerance(self, sine, start):
        algorithm = GradientDescent(learning_rate=5.0, momentum=0.9, adaptive=True)
        losses = np.array(traced(algorithm, sine, start, 300).losses)
        assert np.all(losses[1:] <= 1.04 * losses[:-1] * (1 + 1e-12))
        assert losses[-1] < losses[0]


class TestResilient:
    """RPROP follows signs only."""

    def test_the_size_of_the_slopes_plays_no_part(self, sine, start):
        thousandfold = SimpleNamespace(
            gradient=lambda theta: [1000.0 * part for part in sine.gradient(theta)]
        )
        plain = traced(Resilient(), sine, start, 40)
        scaled = traced(Resilient(), thousandfold, start, 40)
        assert all(np.array_equal(a, b) for a, b in zip(plain, scaled, strict=True))

    def test_steps_as_published(self):
        """f = θ²: growth by 1.2, a step back and half the step after the minimum is passed."""

        parabola = SimpleNamespace(gradient=lambda theta: (float(theta @ theta), 2.0 * theta))
        trace = traced(Resilient(first_step=0.4), parabola, np.array([1.0]), 6)
        passed = 1.0 - 0.4 - 0.48 - 0.576
        expected = [0.6, 0.12, passed, 0.12, 0.12 - 0.288, 0.12]
        assert np.ravel(trace) == pytest.approx(expected, abs=1e-12)


class TestConjugateGradient:
    """On a quadratic all are linear conjugate gradients."""

    @pytest.mark.parametrize("update", ["fletcher_reeves", "polak_ribiere", "powell_beale"])
    def test_on_a_quadratic_with_exact_searches_it_is_linear_cg(self, quadratic, update):
        # so small a curvature makes the line search exact on a parabola
        algorithm = ConjugateGradient(update=update, curvature=1e-6)
        trace = traced(algorithm, quadratic, np.zeros(6), 6)
        b, points = quadratic.hessian @ quadratic.minimum, []
        cg(quadratic.hessian, b, rtol=0, maxiter=6, callback=lambda x: points.append(x.copy()))
        for found, expected in zip(trace, points, strict=True):
            assert found == pytest.approx(expected, abs=1e-5)
        assert trace[-1] == pytest.approx(quadratic.minimum, abs=1e-5)

    def test_polak_ribiere_is_scipys(self, sine, start):
        trace = traced(ConjugateGradient(update="polak_ribiere"), sine, start, 30)
        expected = minimize(
            sine.gradient, start, jac=True, method="CG", options={"maxiter": 30, "c2": 0.1}
        )
        assert trace[-1] == pytest.approx(expected.x, rel=1e-6, abs=1e-8)


class TestScaledConjugateGradient:
    def test_solves_a_quadratic_in_as_many_steps_as_it_has_variables(self, quadratic):
        trace = traced(ScaledConjugateGradient(first_scale=1e-12), quadratic, np.zeros(6), 6)
        scale = np.linalg.norm(quadratic.minimum)
        assert np.linalg.norm(trace[-1] - quadratic.minimum) < 1e-5 * scale
        assert np.linalg.norm(trace[-2] - quadratic.minimum) > 1e-3 * scale

    def test_the_loss_never_rises(self, sine, start):
        losses = np.array(traced(ScaledConjugateGradient(), sine, start, 500).losses)
        assert np.all(np.diff(losses) <= 0)


def test_the_secant_direction_is_one_bfgs_update_of_the_identity():
    """The one-step secant method is BFGS without a memory."""
    generator = np.random.default_rng(0)
    g, s, y = generator.standard_normal((3, 5))
    s *= np.sign(s @ y)
    rho, eye = 1.0 / (s @ y), np.eye(5)
    left = eye - rho * np.outer(s, y)
    inverse = left @ left.T + rho * np.outer(s, s)
    assert g @ inverse @ g > 0
    assert _secant(g, s, y) == pytest.approx(-inverse @ g, abs=1e-10)


class TestLevenbergMarquardt:
    """Gauss–Newton where it works, shorter steps where it does not."""

    def test_solves_a_linear_problem_at_once(self, quadratic):
        trace = traced(LevenbergMarquardt(damping=1e-12), quadratic, np.zeros(6), 1)
        assert trace[0] == pytest.approx(quadratic.minimum, abs=1e-8)

    def test_an_unreachable_step_leaves_the_start(self):
        class Stuck(LinearLeastSquares):
            def loss(self, theta):
                return np.inf

        training = train(LevenbergMarquardt(), Stuck(), np.ones(6), Stopping())
        assert training.outcome is TrainingOutcome.NO_PROGRESS
        assert np.array_equal(training.theta, np.ones(6))


class TestBayesianRegularisation:
    """MacKay's figures on a problem where they are known."""

    def test_the_effective_number_is_that_of_mackay(self, quadratic):
        alpha, beta = 0.7, 3.0
        curvature = quadratic.jacobian.T @ quadratic.jacobian
        hessian = 2 * beta * curvature + 2 * alpha * np.eye(6)
        expected = 6 - 2 * alpha * np.trace(np.linalg.inv(hessian))
        assert effective_parameters(curvature, alpha, beta) == pytest.approx(expected)
        assert effective_parameters(curvature, 0.0, beta) == pytest.approx(6)

    def test_a_linear_problem_ends_in_its_fixed_point(self):
        """θ is the ridge solution, and α, β those of MacKay's conditions at it."""
        problem = LinearLeastSquares(n=200, noise=0.5)
        trace = traced(BayesianRegularisation(), problem, np.zeros(6) + 0.1, 60)
        theta, gamma = trace[-1], trace.effective[-1]
        squares = problem.loss(theta) * problem.n_residuals
        alpha = gamma / (2 * theta @ theta)
        beta = (problem.n_residuals - gamma) / (2 * squares)
        curvature = problem.jacobian.T @ problem.jacobian
        ridge = np.linalg.solve(
            curvature + alpha / beta * np.eye(6), problem.jacobian.T @ problem.target
        )
        assert theta == pytest.approx(ridge, rel=1e-4)
        assert gamma == pytest.approx(effective_parameters(curvature, alpha, beta), rel=1e-4)
        # the noise that was put in: its standard deviation is 1/sqrt(2 β)
        assert (2 * beta) ** -0.5 == pytest.approx(0.5, rel=0.15)

    def test_more_units_than_the_data_need_are_not_used(self, sine):
        crowded = OneStepError(Mlp(1, 1, (15,)), sine.z, sine.targets)
        first = crowded.network.start(np.random.default_rng(0))
        training = train(BayesianRegularisation(), crowded, first, Stopping(epochs=150))
        assert training.history.effective[-1] < 0.6 * first.size


def until(epoch: int):
    """A watcher that interrupts."""

    def impatient(now, loss, validation):
        if now == epoch:
            raise KeyboardInterrupt

    return impatient


class TestStopping:
    """When a training ends, and what it keeps."""

    def test_early_stopping_keeps_the_weights_of_the_smallest_validation_error(self):
        generator = np.random.default_rng(0)
        z = generator.uniform(-2, 2, (14, 1))
        noisy = np.sin(z) + 0.4 * generator.standard_normal(z.shape)
        other = generator.uniform(-2, 2, (200, 1))
        network = Mlp(1, 1, (10,))
        fitted = OneStepError(network, z, noisy)
        validation = OneStepError(network, other, np.sin(other))
        training = train(
            LevenbergMarquardt(),
            fitted,
            network.start(generator),
            Stopping(epochs=200, patience=6),
            validation=validation,
        )
        errors = training.history.validation
        assert training.outcome is TrainingOutcome.VALIDATION
        assert training.best_epoch == int(np.argmin(errors)) == len(errors) - 1 - 6
        assert validation.loss(training.theta) == min(errors)

    def test_each_reason_is_told(self, sine, start):
        def outcome(**keys):
            return train(LevenbergMarquardt(), sine, start, Stopping(**keys)).outcome

        assert outcome(epochs=2) is TrainingOutcome.EPOCHS
        assert outcome(goal=0.05) is TrainingOutcome.GOAL
        assert outcome(gradient=0.05) is TrainingOutcome.GRADIENT
        assert outcome(progress=0.9, gradient=0.0) is TrainingOutcome.SETTLED
        with pytest.raises(ConfigurationError, match="diverges"):
            train(LevenbergMarquardt(), sine, np.full_like(start, np.inf), Stopping())

    def test_an_interruption_keeps_what_there_is(self, sine, start):
        training = train(LevenbergMarquardt(), sine, start, Stopping(), watcher=until(5))
        assert training.outcome is TrainingOutcome.INTERRUPTED
        assert training.history.epochs == 5
        assert sine.loss(training.theta) == training.history.losses[5]

    def test_without_validation_the_weights_of_the_smallest_loss_are_kept(self, sine, start):
        wild = GradientDescent(learning_rate=1.5, momentum=0.9)
        training = train(wild, sine, start, Stopping(progress=0.0), watcher=until(60))
        losses = training.history.losses
        assert training.best_epoch == int(np.argmin(losses)) < 60  # the last is not the best
        assert sine.loss(training.theta) == min(losses)
        # A regularised training keeps its last.
        training = train(BayesianRegularisation(), sine, start, Stopping(epochs=30))
        assert training.best_epoch == training.history.epochs
        assert sine.loss(training.theta) == training.history.losses[-1]
