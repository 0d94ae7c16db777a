"""Files of linear models: what they hold, what they are as models, how a mistake is told."""

import copy
from typing import Any

import casadi as ca
import numpy as np
import pytest
import yaml

from trms_cli.core.errors import ConfigurationError, ModelError
from trms_cli.effects.model_file import load_model
from trms_cli.models.linear_file import LinearFile, StateSpaceModel, read_linear_file
from trms_cli.models.linearisation import Linearisation
from trms_cli.models.rest import resting_state
from trms_cli.models.state_kinds import kinds_of_states
from trms_cli.models.state_space import DiscreteStateSpace
from trms_cli.models.steady_state import SteadyState

T = 0.02
LIMITS = {"u_v": 2.5, "u_h": 2.5, "alpha_v": 1.05, "alpha_h": 2.8}


@pytest.fixture
def space() -> DiscreteStateSpace:
    """Pitch and the main rotor about 0.1 rad at 1.5 V; the rate of the pitch is a state."""
    A = np.array([[1.0, 0.0, T], [0.0, 0.96, 0.0], [-0.06, 0.0004, 0.98]])
    return DiscreteStateSpace(
        outputs=("alpha_v", "omega_v"), inputs=("u_v",), states=("alpha_v_rate",),
        output_units=("rad", "rad/s"), input_units=("V",), state_units=("rad/s",),
        sample_time=T, operating_state=[0.1, 200.0, 0.0], operating_input=[1.5],
        A=A, B=[[0.0], [4.0], [0.0]], E=[[T**2 / 2, 0.0], [0.0, T], [T, 0.0]],
        noise_sd=[0.0, 0.1, 0.003],
    )  # fmt: skip


@pytest.fixture
def content(space) -> LinearFile:
    return LinearFile(name="pitch", state_space=space, limits=LIMITS, source="a test", rig="")


def test_a_file_read_back_has_every_bit(content, tmp_path):
    path = tmp_path / "model.yaml"
    path.write_text(yaml.safe_dump(content.to_data()))
    back = read_linear_file(str(path)).state_space
    for name in ("A", "B", "E", "operating_state", "operating_input", "noise_sd"):
        assert np.array_equal(getattr(back, name), getattr(content.state_space, name))
    assert back.states == ("alpha_v_rate",) and back.sample_time == T
    model = load_model(str(path))
    assert isinstance(model, StateSpaceModel)
    assert model.input_limits == {"u_v": 2.5} and model.stops == {"alpha_v": 1.05}


def test_kinds_of_states_and_the_linearisation_are_those_of_the_matrices(space):
    model = StateSpaceModel(space, limits=LIMITS)
    assert kinds_of_states(model) == ("angle", "speed", "momentum")
    steady = SteadyState(model)
    linear = Linearisation(model, T, steady).at({"alpha_v": 0.2}, "here")
    assert pytest.approx(space.A) == linear.A and pytest.approx(space.B) == linear.B
    twice = Linearisation(model, 2 * T, steady).at({"alpha_v": 0.2}, "here")
    assert pytest.approx(space.A @ space.A) == twice.A
    gain = space.static_gain()[0, 0]
    assert linear.target.u == pytest.approx([1.5 + 0.1 / gain])
    _, _, p, _ = model.symbols()
    noise = ca.Function("noise", [p], [model.noise_sd(p, 4 * T)])([]).full().ravel()
    assert noise == pytest.approx(2 * space.noise_sd)


def test_it_rests_where_a_step_changes_nothing_and_is_met_at_rest(space):
    model = StateSpaceModel(space, limits=LIMITS)
    x, u, p, w = model.symbols()
    step = ca.Function("step", [x, u, p, w], [model.transition(x, u, p, w)])
    after = step(model.rest(), [0.0], [], [0.0, 0.0]).full().ravel()
    assert after == pytest.approx(model.rest(), abs=1e-9)
    # far from where it rests: the measured angle stands still all the same
    met = resting_state(model, {"alpha_v": -0.6, "omega_v": 0.0}, np.zeros(1))
    assert met == pytest.approx([-0.6, 0.0, 0.0], abs=1e-6)


def test_the_start_that_explains_samples_is_found_in_spite_of_holes(space):
    random = np.random.default_rng(0)
    u = 1.5 + random.uniform(-1, 1, (200, 1))
    start = np.array([0.3, 150.0, -0.2])
    y = space.simulate(start, u)
    y[random.uniform(size=y.shape) < 0.3] = np.nan
    assert space.start_from(y, u) == pytest.approx(start, rel=1e-6)


def change(data: dict[str, Any], place: str, value: Any) -> dict[str, Any]:
    data = copy.deepcopy(data)
    node, *keys = data, *place.split(".")
    for key in keys[:-1]:
        node = node[key]
    if value is None:
        del node[keys[-1]]
    else:
        node[keys[-1]] = value
    return data


@pytest.mark.parametrize(
    ("place", "value"),
    [
        ("name", None),
        ("colour", "red"),
        ("model", "newtonian"),
        ("state_space", [1, 2]),
        ("state_space.A", [[1.0]]),
        ("state_space.B", "wide"),
        ("state_space.B", [[0.0], [float("nan")], [0.0]]),
        ("state_space.E", None),
        ("state_space.states", ["alpha_v"]),
        ("state_space.inputs", []),
        ("state_space.output_units", ["rad"]),
        ("state_space.sample_time", -0.02),
        ("state_space.sample_time", "fast"),
        ("state_space.poles", [1.0]),
        ("limits.u_x", 1.0),
        ("limits.u_v", "much"),
        ("effects", {"yaw_coulomb_friction": {"torque": 0.01}}),
    ],
)
def test_mistakes_are_named_by_file_and_key(content, tmp_path, place, value):
    path = tmp_path / "wrong.yaml"
    path.write_text(yaml.safe_dump(change(content.to_data(), place, value)))
    with pytest.raises(ModelError) as error:
        load_model(str(path))
    said = f"{error.value.where} {error.value.problem}"
    assert "wrong.yaml" in said and error.value.remedy
    if place.startswith("state_space.") and place.rpartition(".")[2] not in ("states", "inputs"):
        assert place in said


def test_a_file_that_is_not_there_is_told(tmp_path):
    with pytest.raises(ConfigurationError, match="cannot read"):
        read_linear_file(str(tmp_path / "none.yaml"))
