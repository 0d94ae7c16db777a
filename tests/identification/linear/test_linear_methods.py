"""ARX, ARMAX and subspace: known systems from noisy data, orders, files, what is refused."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from scipy.signal import cont2discrete

from tests.identification.greybox.rigs import dataset_of
from tests.identification.watched import Watched
from trms_cli.composition.catalogue import read_yaml
from trms_cli.core.errors import ConfigurationError, RecordingError
from trms_cli.core.plugins import build
from trms_cli.core.resources import config_folder
from trms_cli.effects.model_file import load_model
from trms_cli.identification.dataset import Dataset
from trms_cli.identification.free_runs import measured_states, window_runs
from trms_cli.identification.linear import linear_fit
from trms_cli.identification.linear.armax import _inside
from trms_cli.identification.linear.subspace import _stable_gain
from trms_cli.identification.model_writer import write_model
from trms_cli.identification.problem import (
    FitOutcome,
    FitProblem,
    FitResult,
    Method,
    SilentProgress,
)
from trms_cli.models.linear_file import StateSpaceModel
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.state_kinds import kinds_of_states
from trms_cli.models.state_space import DiscreteStateSpace

MODEL = Newtonian(freedom="horizontal")
STEP = 0.1
#: Where the known systems operate: alpha_h, omega_h; u_h.
LEVEL, COMMAND = np.array([0.3, 50.0]), 0.4
SCALE = np.array([0.2, 20.0])
#: Of the difference equation, in units of the scale: y(k) = F₁ y(k−1) + F₂ y(k−2) + G u(k−d) + e
F = np.array([[[1.5, 0.08], [0.0, 0.6]], [[-0.6, 0.02], [0.0, 0.1]]])
G = np.array([0.0, 0.5])
NOISE = 0.02


def method(name: str, **changes) -> Method:
    """A method as configuration has it."""
    return build({**read_yaml(config_folder() / "method" / f"{name}.yaml"), **changes}, "method")


def commands(seed: int, n: int) -> np.ndarray:
    return np.repeat(np.random.default_rng(seed).uniform(-1, 1, n // 8 + 1), 8)[:n]


def recording(u: np.ndarray, y: np.ndarray, name: str = "known") -> Dataset:
    """Deviations in units of the scale, as a recording about the operating point."""
    measured = LEVEL + SCALE * y
    return dataset_of(MODEL, (COMMAND + u)[:, None], measured, NOISE * SCALE, step=STEP, name=name)


def difference_equation(
    seed: int, n: int = 4000, dead_time: int = 1, average: tuple[float, ...] = ()
) -> Dataset:
    """The known equation, its noise a moving average where one is given."""
    u, e = commands(seed, n), NOISE * np.random.default_rng(seed + 100).standard_normal((n, 2))
    y = np.zeros((n, 2))
    for k in range(3, n):
        y[k] = F[0] @ y[k - 1] + F[1] @ y[k - 2] + G * u[k - dead_time] + e[k]
        for lag, c in enumerate(average, start=1):
            y[k] += c * e[k - lag]
    return recording(u[3:], y[3:], f"d{seed}")  # the first do not follow the equation


def sampled_rig(
    seed: int, n: int = 4000, feedback: float = 0.0
) -> tuple[DiscreteStateSpace, Dataset]:
    """A pendulum that a lagged rotor drives, exact, and measured with white noise."""
    a = np.array([[0, 0, 1.0], [0, -2.0, 0], [-2.0, 1.0, -0.6]])  # angle, rotor, rate
    A, B, *_ = cont2discrete((a, np.array([[0], [2.0], [0]]), np.eye(3), np.zeros((3, 1))), STEP)
    known = DiscreteStateSpace(
        ("alpha_h", "omega_h"), ("u_h",), ("rate",), ("rad", "rad/s"), ("V",), ("rad/s",), STEP,
        np.zeros(3), np.zeros(1), A, B, np.zeros((3, 2)), np.zeros(3),
    )  # fmt: skip
    random = np.random.default_rng(seed + 7)
    u, x = commands(seed, n), np.zeros(3)
    y = np.empty((n, 2))
    for k in range(n):
        y[k] = x[:2] + NOISE * random.standard_normal(2)
        u[k] -= feedback * y[k, 0]
        x = A @ x + B[:, 0] * u[k]
    return known, recording(u, y, f"r{seed}")


def problem(*datasets: Dataset, **changes) -> FitProblem:
    return FitProblem(model=MODEL, datasets=datasets, **changes)


def fit(name: str, *datasets: Dataset, held_out: Dataset | None = None, **changes) -> FitResult:
    validation = (held_out,) if held_out is not None else ()
    return method(name, **changes).fit(problem(*datasets, validation=validation), SilentProgress())


def space_of(result: FitResult) -> DiscreteStateSpace:
    return DiscreteStateSpace.from_data(result.model_document["state_space"])


EQUATION = {"output_order": 2, "input_order": 1}


def known_coefficients() -> dict[str, dict[str, float]]:
    outputs = MODEL.outputs
    assert [signal.name for signal in outputs] == ["alpha_h", "omega_h"]
    table = {}
    for i, name in enumerate(("alpha_h", "omega_h")):
        table[name] = {
            f"{other}(k-{lag})": F[lag - 1, i, j] * SCALE[i] / SCALE[j]
            for lag in (1, 2)
            for j, other in enumerate(("alpha_h", "omega_h"))
        } | {"u_h(k-1)": G[i] * SCALE[i]}
    return table


@pytest.mark.parametrize(("name", "average"), [("arx", ()), ("armax", (0.7, 0.2))])
def test_known_coefficients_lie_within_their_deviations(name, average):
    """Over six draws of the noise, errors over deviations have a mean square of about one."""
    extra = {"noise_order": 2} if average else {}
    squares = []
    for seed in range(6):
        result = fit(name, difference_equation(seed, average=average), **EQUATION, **extra)
        coefficients = result.details["coefficients"]
        for output, terms in known_coefficients().items():
            for term, value in terms.items():
                told = coefficients[output][term]
                assert told["value"] == pytest.approx(value, abs=5 * told["sd"])
                squares.append(((told["value"] - value) / told["sd"]) ** 2)
            for lag, c in enumerate(average, start=1):
                told = coefficients[output][f"e(k-{lag})"]
                assert told["value"] == pytest.approx(c, abs=5 * told["sd"])
        assert result.details["residual_sd"]["omega_h"] == pytest.approx(NOISE * SCALE[1], rel=0.05)
    assert 0.6 < np.mean(squares) < 1.5


def test_a_moving_average_of_the_noise_biases_arx_and_not_armax():
    data = difference_equation(1, average=(0.7, 0.2))
    known = known_coefficients()["omega_h"]["omega_h(k-1)"]
    of_arx, of_armax = (
        fit(name, data, **EQUATION).details["coefficients"]["omega_h"]["omega_h(k-1)"]
        for name in ("arx", "armax")
    )
    assert abs(of_arx["value"] - known) > 5 * of_arx["sd"]
    assert abs(of_armax["value"] - known) < 5 * of_armax["sd"]


def test_without_noise_the_equation_is_exact_and_so_are_its_poles():
    u, n = commands(0, 400), 400
    y = np.zeros((n, 2))
    for k in range(2, n):
        y[k] = F[0] @ y[k - 1] + F[1] @ y[k - 2] + G * u[k - 1]
    zero = {"alpha_h": 0.3, "omega_h": 50.0, "u_h": 0.4}
    space = space_of(fit("arx", recording(u, y), **EQUATION, operating_point=zero))
    companion = np.block([[F[0], F[1]], [np.eye(2), np.zeros((2, 2))]])
    expected = np.sort_complex(np.linalg.eigvals(companion))
    assert np.sort_complex(space.poles) == pytest.approx(expected, abs=1e-9)
    gain = np.linalg.solve(np.eye(2) - F[0] - F[1], G) * SCALE
    assert space.static_gain()[:, 0] == pytest.approx(gain, rel=1e-9)


@pytest.mark.parametrize("feedback", [0.0, 0.8])
def test_subspace_tells_the_poles_and_gains_of_a_known_system(feedback):
    """Also where the commands answer to the measured outputs."""
    known, data = sampled_rig(0, feedback=feedback)
    result = fit("subspace", data, order=3)
    space = space_of(result)
    assert space.states == ("alpha_h_rate",)
    assert np.sort_complex(space.poles) == pytest.approx(np.sort_complex(known.poles), abs=0.02)
    gain = known.static_gain()[:, 0] * SCALE
    for output, value in zip(("alpha_h", "omega_h"), gain, strict=True):
        told = result.details["static_gain"][f"{output} by u_h"]
        assert told["value"] == pytest.approx(value, rel=0.03)
        assert 0 < told["sd"] < 0.05 * abs(value)
    # what the rate is: the angle's change in a step
    assert space.A[0] == pytest.approx([1.0, 0.0, STEP], abs=1e-12)
    assert np.all(np.array(result.details["A_sd"]) >= 0)


def test_the_deviations_of_a_subspace_model_are_those_of_repeated_recordings():
    fits = [fit("subspace", sampled_rig(seed, 1200)[1], order=3) for seed in range(6)]
    gains = [result.details["static_gain"]["alpha_h by u_h"] for result in fits]
    scatter = np.std([gain["value"] for gain in gains], ddof=1)
    assert 0.4 * scatter < np.median([gain["sd"] for gain in gains]) < 2.5 * scatter


@pytest.mark.parametrize("name", ["arx", "armax", "subspace"])
def test_several_recordings_with_missing_samples_count_together(name):
    first, second = difference_equation(3, 1500), difference_equation(4, 1500)
    measurements = first.measurements.copy()
    measurements[400:430] = np.nan
    measurements[900, 1] = np.nan
    lost = replace(first, measurements=measurements)
    result = fit(name, lost, second, **({"order": 4} if name == "subspace" else EQUATION))
    look_back = 40 if name == "subspace" else 2
    # each hole costs its own samples, and those that look back to it; each recording its first
    expected = 2994 - 2 * look_back - (30 + look_back) - (1 + look_back)
    assert result.details["rows"] == expected
    gain = (np.linalg.solve(np.eye(2) - F[0] - F[1], G) * SCALE)[0]
    assert result.details["static_gain"]["alpha_h by u_h"]["value"] == pytest.approx(gain, rel=0.05)


@pytest.mark.parametrize("criterion", ["held_out", "bic"])
def test_the_dead_time_and_the_order_are_found(criterion):
    data, other = difference_equation(5, dead_time=3), difference_equation(6, dead_time=3)
    result = fit(
        "arx", data, held_out=other, criterion=criterion,
        output_order=[1, 2, 4], input_order=1, dead_time=[1, 2, 3, 4],
    )  # fmt: skip
    assert result.details["orders"] == {"output_order": 2, "input_order": 1, "dead_time": 3}
    assert len(result.details["candidates"]) == 12
    terms = result.details["coefficients"]["alpha_h"]
    assert "u_h(k-3)" in terms and "u_h(k-1)" not in terms


def test_the_order_of_a_subspace_model_is_found():
    data, other = sampled_rig(1)[1], sampled_rig(2)[1]
    result = fit("subspace", data, held_out=other, order=[2, 3, 5, 8])
    assert result.details["orders"] == {"order": 3}
    singular_values = result.details["singular_values"]
    assert singular_values[2] > 4 * singular_values[3]


def test_uncoupled_equations_have_their_own_past_only():
    result = fit("arx", difference_equation(0), **EQUATION, coupled=False)
    assert set(result.details["coefficients"]["alpha_h"]) == {
        "alpha_h(k-1)", "alpha_h(k-2)", "u_h(k-1)"
    }  # fmt: skip
    space = space_of(result)
    assert space.A[0, 1] == 0 == space.A[1, 0]


@pytest.mark.parametrize("name", ["arx", "armax", "subspace"])
def test_the_file_is_a_model_that_runs_as_the_fit_does(name, tmp_path):
    """Free runs before and after saving are equal, and those of the CasADi model beside them."""
    data = difference_equation(7, 1000)
    own = {"order": 4} if name == "subspace" else {**EQUATION, "dead_time": 2, "input_order": 2}
    result = fit(name, data, **own)
    space = space_of(result)
    write_model(result.model_document, tmp_path / "model.yaml", "a test")
    model = load_model(str(tmp_path / "model.yaml"))
    assert isinstance(model, StateSpaceModel)
    assert model.sample_time == STEP and model.controlled == ("alpha_h",)
    assert model.input_limits == {"u_h": MODEL.input_limits["u_h"]}
    start = space.operating_state + 0.1 * np.arange(space.n_x)
    expected = space.simulate(start, data.commands)
    assert np.array_equal(model.state_space.simulate(start, data.commands), expected)
    x, u, p, w = model.symbols()
    step = ca.Function("step", [x, u, p, w], [model.transition(x, u, p, w)])
    state = start
    for k in range(200):
        assert state[:2] == pytest.approx(expected[k], rel=1e-9, abs=1e-9)
        state = step(state, data.commands[k], [], np.zeros(2)).full().ravel()
    # it rests where a step changes nothing
    still = step(model.rest(), np.zeros(1), [], np.zeros(2)).full().ravel()
    assert still == pytest.approx(model.rest(), abs=1e-8)


def test_remembered_signals_are_copies_and_their_past_is_measured():
    data = difference_equation(8, 600)
    own = {**EQUATION, "dead_time": 2, "input_order": 2}
    model = StateSpaceModel(space_of(fit("arx", data, **own)))
    kinds = dict(zip(model.state_names, kinds_of_states(model), strict=True))
    assert kinds == {
        "alpha_h": "angle", "omega_h": "speed", "alpha_h_lag1": "past", "omega_h_lag1": "past",
        "u_h_lag1": "past", "u_h_lag2": "past",
    }  # fmt: skip
    states = measured_states(model, data)
    assert states[10] == pytest.approx(
        [*data.measurements[10], *data.measurements[9], data.commands[9, 0], data.commands[8, 0]]
    )
    [run] = window_runs(model, [data], 5.0)
    assert np.nanstd(run.errors[:, 0]) < np.std(data.measurements[:, 0])


def test_windows_of_a_model_with_a_state_that_is_not_measured_start_from_what_lies_before():
    _, data = sampled_rig(4, 600)
    model = StateSpaceModel(space_of(fit("subspace", data, order=3)))
    assert measured_states(model, data) is None
    [run] = window_runs(model, [data], 10.0)
    assert np.nanstd(run.errors, axis=0) == pytest.approx(NOISE * SCALE, rel=0.25)


def test_an_acceleration_moves_an_angle_as_an_acceleration_does():
    """Of a subspace model, and of equations of any order."""
    _, data = sampled_rig(3)
    fits = [fit("subspace", data, order=3), fit("armax", data, output_order=4, input_order=1)]
    for result in fits:
        model = StateSpaceModel(space_of(result))
        x, u, p, w = model.symbols()
        step = ca.Function("step", [x, u, p, w], [model.transition(x, u, p, w)])
        operating = model.state_space.operating_state, model.state_space.operating_input
        pushed, still = operating[0], operating[0]
        for _ in range(5):
            pushed = step(pushed, operating[1], [], [1.0, 0.0]).full().ravel()
            still = step(still, operating[1], [], [0.0, 0.0]).full().ravel()
        assert (pushed - still)[0] == pytest.approx(0.5 * (5 * STEP) ** 2, rel=0.25)


def test_an_unstable_system_has_no_free_run_and_says_so():
    u, n = commands(0, 120), 120
    y = np.zeros((n, 2))
    for k in range(1, n):
        y[k] = 1.03 * y[k - 1] + 0.1 * u[k - 1]
    y += 1e-3 * np.random.default_rng(0).standard_normal(y.shape)
    data = recording(u, y)
    with pytest.raises(RecordingError, match="no stable arx model") as caught:
        fit("arx", data, output_order=1, input_order=1)
    assert "method=subspace" in caught.value.remedy
    result = fit("subspace", data, order=2, past=10, future=5)
    assert result.details["poles_reflected"] > 0
    assert space_of(result).spectral_radius < 1.0


def test_what_cannot_be_fitted_is_refused_with_what_to_do():
    data = difference_equation(0, 400)
    with pytest.raises(RecordingError, match="complete samples for") as short:
        fit("arx", data.part(0, 42), output_order=4, input_order=24)
    assert "record at least" in short.value.remedy
    with pytest.raises(RecordingError, match="complete samples for"):
        fit("subspace", data.part(0, 60), order=3)
    holes = data.measurements.copy()
    holes[::3] = np.nan  # no stretch of four samples is left
    with pytest.raises(RecordingError, match="only 0 complete samples"):
        fit("armax", replace(data, measurements=holes), output_order=4, input_order=1)
    with pytest.raises(RecordingError, match="'omega_h' has no sample"):
        lost = data.measurements * [1.0, np.nan]
        fit("arx", replace(data, measurements=lost), **EQUATION)
    with pytest.raises(RecordingError, match="'u_h' never moves"):
        fit("arx", replace(data, commands=np.ones_like(data.commands)), **EQUATION)
    with pytest.raises(RecordingError, match=r"method\.sample_time=0\.2") as times:
        fit("arx", data, **EQUATION, sample_time=0.17)
    assert "whole multiple" in times.value.remedy
    with pytest.raises(ConfigurationError, match="nothing is held out"):
        fit("arx", data, output_order=[1, 2], input_order=1)
    with pytest.raises(ConfigurationError, match="for 2 outputs") as order:
        fit("subspace", data, order=1)
    assert order.value.where == "method.order" and "from 2" in order.value.remedy
    with pytest.raises(ConfigurationError, match="no order is given"):
        fit("armax", data, output_order=[])
    with pytest.raises(ConfigurationError, match="look ahead no farther"):
        fit("subspace", data, order=2, past=10, future=20)
    with pytest.raises(ConfigurationError, match="'u_v'") as signal:
        fit("arx", data, **EQUATION, operating_point={"u_v": 1.0})
    assert "u_h" in signal.value.remedy
    for wrong in ({"output_order": 0}, {"criterion": "fpe"}, {"dead_time": 1.5}):
        with pytest.raises(ConfigurationError, match=f"method.{next(iter(wrong))}"):
            method("arx", **wrong)


def test_the_operating_point_is_the_mean_or_what_is_chosen():
    data = difference_equation(2, 800)
    space = space_of(fit("arx", data, **EQUATION))
    assert space.operating_state[:2] == pytest.approx(data.measurements.mean(axis=0))
    assert space.operating_input == pytest.approx(data.commands.mean(axis=0))
    chosen = space_of(fit("arx", data, **EQUATION, operating_point={"u_h": 0.4, "alpha_h": 0.3}))
    assert (chosen.operating_input[0], chosen.operating_state[0]) == (0.4, 0.3)


def test_a_slower_model_takes_means_of_the_commands():
    data = difference_equation(0, 1000)
    space = space_of(fit("arx", data, **EQUATION, sample_time=0.2))
    assert space.sample_time == 0.2
    assert space.static_gain() == pytest.approx(
        space_of(fit("arx", data, **EQUATION)).static_gain(), rel=0.1
    )


def test_an_interrupted_choice_keeps_the_best_so_far():
    data = difference_equation(0, 800)
    chosen = method("arx", output_order=[1, 2, 4], input_order=1, criterion="bic")
    result = chosen.fit(problem(data), Watched(2))
    assert result.outcome is FitOutcome.INTERRUPTED
    assert result.details["orders"]["output_order"] <= 2


def test_of_free_runs_that_are_as_good_the_one_of_fewest_coefficients_is_kept():
    data, other = difference_equation(0, 2000), difference_equation(9, 2000)
    details = fit("arx", data, held_out=other, output_order=[2, 3, 6], input_order=1).details
    lowest = min(row["criterion"] for row in details["candidates"])
    assert details["orders"]["output_order"] == 2
    assert details["candidates"][0]["criterion"] <= lowest * (1 + linear_fit._AS_GOOD)


def test_a_predictor_that_would_not_forget_has_its_zero_reflected():
    """In closed form: A − K of −2.1 becomes 1/−2.1."""
    A, one = np.array([[0.9]]), np.eye(1)
    gain = _stable_gain(A, np.array([[3.0]]), one)
    assert gain[0, 0] == pytest.approx(0.9 + 1 / 2.1, rel=1e-9)
    assert _stable_gain(A, np.array([[0.4]]), one)[0, 0] == 0.4


def test_roots_of_a_moving_average_are_reflected_into_the_unit_circle():
    assert _inside(np.array([-2.5, 1.0])) == pytest.approx([-1.0, 0.25])  # roots 2, ½ → ½, ½
    assert _inside(np.array([0.5, 0.06])) == pytest.approx([0.5, 0.06])
    assert _inside(np.zeros(2)) == pytest.approx([0.0, 0.0])
