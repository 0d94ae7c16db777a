"""The cost: weights of residuals, its parabola against differences, starts against the truth."""

from dataclasses import replace

import numpy as np
import pytest

from tests.identification.blackbox.differences import central
from tests.identification.greybox.rigs import measuring, recording
from trms_cli.effects.actuator_lag import ActuatorLag
from trms_cli.effects.extended_model import extend_model
from trms_cli.effects.flexible_mode import FlexibleMode
from trms_cli.effects.input_delay import InputDelay
from trms_cli.effects.sensor_delay import SensorDelay
from trms_cli.effects.supply_derating import SupplyDerating
from trms_cli.identification.dataset import Dataset
from trms_cli.identification.greybox.objective import MapObjective, ResidualWeights, sizes
from trms_cli.identification.greybox.windows import StartEstimator, Windows
from trms_cli.identification.problem import FitProblem, free_parameters
from trms_cli.models.model import Model
from trms_cli.models.newtonian import Newtonian
from trms_cli.simulation.rollout import Rollout

RANGES = [(0.4, 1.5)]


@pytest.fixture(scope="module")
def vertical() -> Model:
    return Newtonian(freedom="vertical")


@pytest.fixture(scope="module")
def recorded(vertical: Model) -> tuple[Dataset, np.ndarray]:
    return recording(vertical, ranges=RANGES)


@pytest.fixture(scope="module")
def dataset(recorded: tuple[Dataset, np.ndarray]) -> Dataset:
    return recorded[0]


def objective(
    model: Model, dataset: Dataset, free: list[str], joined: float | None = None, **settings: float
) -> tuple[MapObjective, np.ndarray, np.ndarray]:
    problem = FitProblem(
        model=model,
        datasets=(dataset,),
        free=free_parameters(model.parameters, free),
        window_length=4.0,
        jobs=1,
        **settings,  # type: ignore[arg-type]
    )
    windows = Windows(problem)
    n_y = windows.declared.shape[1]
    own = ResidualWeights(10 * windows.declared, np.ones(n_y), windows.share, 3.0)
    theta = problem.starts
    starts = windows.starts(problem.all_values(theta))
    return MapObjective(windows, own, starts, joined), theta, starts


def largest_slope_error(own: MapObjective, theta: np.ndarray, starts: np.ndarray) -> float:
    """Of the parabola in each scaled variable against central differences, relative."""
    _, quadratic, _ = own.parabola(theta, starts)
    n, still = len(theta), np.zeros_like(starts)

    def cost(move: np.ndarray) -> float:
        return own.cost(theta + move[:n] * own.scales, starts + move[n:] * own.windows.spread)

    def parabola(move: np.ndarray) -> float:
        return quadratic.cost(still + move[n:], move[:n])

    zero = np.zeros(n + starts.shape[1])
    wanted, found = (central(f, zero, 1e-5) for f in (cost, parabola))
    return float(np.max(np.abs(wanted - found)) / np.max(np.abs(wanted)))


@pytest.mark.parametrize("joined", [None, 0.03])
def test_slopes_are_exact(dataset: Dataset, joined: float | None) -> None:
    model = Newtonian(freedom="vertical", parameters={"k_fvp": 1.7e-5, "k_ov": 0.004})
    own, theta, starts = objective(model, dataset, ["k_fvp", "k_ov", "J_mr", "k_uv"], joined)
    assert largest_slope_error(own, theta, starts) < 1e-5


def test_slopes_see_what_commands_before_the_window_left_behind(vertical: Model) -> None:
    effects = {
        "main_input_delay": InputDelay(rotor="main", delay=0.03, longest=0.06),
        "main_actuator_lag": ActuatorLag(rotor="main", time_constant=0.05),
        "main_supply_derating": SupplyDerating(rotor="main", depth=0.1, time_constant=20.0),
    }
    remembering = extend_model(vertical, effects)
    dataset, _ = recording(remembering, ranges=RANGES)
    free = ["*lag.time_constant", "*derating.*", "k_fvp"]
    moved = {"main_supply_derating.depth": 0.15, "main_actuator_lag.time_constant": 0.08}
    remembering.parameters = remembering.parameters.replaced(moved)
    own, theta, starts = objective(remembering, dataset, free)
    assert largest_slope_error(own, theta, starts) < 1e-5


def test_what_sensors_remember_is_free_and_samples_that_are_not_seen_count_for_nothing() -> None:
    sensors = {
        "pitch_sensor_delay": SensorDelay(axis="pitch", delay=0.05, longest=0.1),
        "pitch_flexible_mode": FlexibleMode(axis="pitch", share=0.5, frequency=4.0, damping=0.03),
    }
    model = extend_model(Newtonian(freedom="vertical"), sensors)
    dataset, _ = recording(model, ranges=RANGES)
    own, theta, starts = objective(model, dataset, ["*delay.delay", "*mode.*", "k_fvp"])
    memory = len(model.sensor_memory(dataset.sample_time))
    assert starts.shape[1] == model.n_x + memory == own.windows.n_x
    assert np.all(own.windows.spread > 0)
    assert largest_slope_error(own, theta, starts) < 1e-5
    hidden = Windows(own.windows.problem, unseen=memory)
    assert hidden.measured.sum() == own.windows.measured.sum() - memory * hidden.measured[:, 0].size
    # past angles reach no further than the samples that are not seen
    delay_only = extend_model(Newtonian(freedom="vertical"), dict([*sensors.items()][:1]))
    late, theta, starts = objective(delay_only, dataset, ["k_fvp"])
    past = len(delay_only.sensor_memory(dataset.sample_time))
    windows = Windows(late.windows.problem, unseen=past)
    p = windows.problem.all_values(theta)
    moved = starts.copy()
    moved[:, delay_only.n_x :] += 0.3
    np.testing.assert_array_equal(windows.residuals(p, moved).r, windows.residuals(p, starts).r)
    assert not np.array_equal(
        late.windows.residuals(p, moved).r, late.windows.residuals(p, starts).r
    )


@pytest.mark.parametrize("first", [np.arange(0, 500, 50), np.arange(20, 500, 60)])
def test_starts_at_once_are_those_of_one_after_another(first):
    """What is measured is put right at all starts together where nothing else decides it."""
    rig = Newtonian()
    dataset = recording(rig, ranges=[*RANGES, (-0.5, 0.5)])[0]
    effects = {
        "tail_actuator_lag": ActuatorLag(rotor="tail", time_constant=0.1),
        "main_input_delay": InputDelay(rotor="main", delay=0.05),
        "main_supply_derating": SupplyDerating(rotor="main", depth=0.1, time_constant=5.0),
    }
    model = extend_model(rig, effects)
    estimator = StartEstimator(Rollout(model, dataset.sample_time), dataset, first)
    assert estimator._at_once
    p = model.parameters.values
    together = estimator.at(p)
    estimator._at_once = False
    in_turn = estimator.at(p)
    np.testing.assert_allclose(together.states, in_turn.states, rtol=1e-9, atol=1e-12)
    assert together.memory_slopes.shape == in_turn.memory_slopes.shape


def test_starts_are_near_the_truth_also_of_rotors_that_are_not_measured(vertical, recorded):
    dataset, states = recorded
    own, _, starts = objective(vertical, dataset, ["k_ov"])
    error = np.abs(starts - states[own.windows.first])
    assert np.all(error < 0.2 * own.windows.spread)
    own, _, starts = objective(vertical, measuring(dataset, 1), ["k_ov"])
    row = vertical.state_index("omega_v")
    # The rig began at rest, its estimate at the speed of the first command: forgotten in 8 s.
    np.testing.assert_allclose(starts[2:, row], states[own.windows.first[2:], row], atol=0.1)
    assert own.windows.measured.sum() == len(dataset)  # one output of two


def test_missing_samples_have_no_part(vertical: Model, dataset: Dataset) -> None:
    own, theta, starts = objective(vertical, dataset, ["k_ov"])
    full = own.cost(theta, starts)
    holes = dataset.measurements.copy()
    holes[300:350] = np.nan
    own, theta, _ = objective(vertical, replace(dataset, measurements=holes), ["k_ov"])
    assert own.cost(theta, starts) < full
    assert np.isfinite(own.parabola(theta, starts)[1].triangles).all()


def test_overlapping_windows_count_each_sample_once(vertical: Model) -> None:
    dataset, _ = recording(vertical, ranges=RANGES, seconds=24.0)
    alone, _, starts = objective(vertical, dataset, ["k_ov"])
    twice, _, more = objective(vertical, dataset, ["k_ov"], window_stride=2.0)
    ratio = twice.weights.share * twice.windows.measured.sum() / alone.windows.measured.sum()
    assert ratio == pytest.approx(1.0, abs=0.1)
    assert len(more) > 1.8 * len(starts)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("angle", [1e170, np.inf])
def test_a_simulation_that_runs_away_costs_without_end_and_without_words(
    vertical: Model, dataset: Dataset, angle: float
) -> None:
    """At 1e170 rad it is finite yet, and its square is not."""
    own, theta, starts = objective(vertical, dataset, ["k_ov"])
    away = starts.copy()
    away[1, vertical.state_index("alpha_v")] = angle
    assert own.cost(theta, away) == np.inf
    assert own.parabola(theta, away)[0] == np.inf
    cost, chosen = own.better_starts(theta, away, starts)
    assert cost == pytest.approx(own.cost(theta, starts))
    np.testing.assert_array_equal(chosen, starts)


def weights(robust: float | None) -> ResidualWeights:
    return ResidualWeights(np.full((2, 3), 0.5), np.array([1.0, 2.0, 8.0]), 0.5, robust)


@pytest.mark.parametrize("robust", [None, 1.5])
def test_parabola_touches_the_cost_and_lies_above(robust: float | None) -> None:
    generator = np.random.default_rng(0)
    at = generator.standard_normal((2, 30, 3)) * 2
    own = weights(robust)
    roots = own.roots(at)

    def parabola(r: np.ndarray) -> float:
        return 0.5 * float(np.sum((roots * r) ** 2) - np.sum((roots * at) ** 2))

    for _ in range(30):
        other = at + generator.standard_normal(at.shape)
        assert own.cost(other) - own.cost(at) <= parabola(other) + 1e-9
    step = 1e-6 * generator.standard_normal(at.shape)
    slope = (own.cost(at + step) - own.cost(at - step)) / 2
    assert slope == pytest.approx((parabola(at + step) - parabola(at - step)) / 2, rel=1e-4)


def test_an_outlier_counts_linearly_and_moves_no_size() -> None:
    r = np.zeros((2, 30, 3))
    costs = []
    for size in (10.0, 20.0, 30.0):
        r[0, 0, 0] = size
        costs.append(weights(3.0).cost(r))
    assert costs[2] - costs[1] == pytest.approx(costs[1] - costs[0])
    generator = np.random.default_rng(0)
    r = generator.standard_normal((4, 500, 2)) * [1.0, 3.0]
    measured = np.ones(r.shape, dtype=bool)
    r[0, :5, 0] = 1e4
    found = sizes(r, measured, np.ones((4, 2)))
    np.testing.assert_allclose(found, [1.0, 3.0], rtol=0.1)
