"""A NARX model computes what its network says, and a file of it comes back bit for bit."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
import yaml

from trms_cli.core.errors import ConfigurationError, ModelError
from trms_cli.effects.extended_model import effect_names
from trms_cli.effects.model_file import load_model
from trms_cli.identification.dataset import Dataset
from trms_cli.identification.free_runs import measured_states
from trms_cli.models.narx_file import Narx, NarxFile, narx, read_narx_file, write_narx_file
from trms_cli.models.network import NarxStructure, Network

from .network_case import LIMITS, rig_like, structure
from .simulate import rates

STRUCTURES = [
    {},
    {"output_lags": (1, 2, 3), "input_lags": (1, 2)},
    {"output_lags": (1, 4), "input_lags": (2, 5)},
    {"output_lags": (1, 3), "input_lags": (1, 2), "incremental": False},
    {"output_lags": (1, 2), "input_lags": (1,), "differences": False},
]


def history(model: Narx, outputs: np.ndarray, commands: np.ndarray) -> Dataset:
    """A recording of what was before."""
    n, step = len(outputs), model.structure.sample_time
    return Dataset(
        "before", "before.csv", "0" * 64, step, step * np.arange(n), model.inputs, model.outputs,
        commands, outputs, np.zeros(outputs.shape[1]),
    )  # fmt: skip


@pytest.mark.parametrize("kinds", STRUCTURES, ids=str)
def test_runs_as_the_network_evaluated_on_the_history(kinds):
    rng = np.random.default_rng(0)
    made = structure(**kinds)
    n_phi = made.n_regressors
    shapes = {"W1": (6, n_phi), "b1": 6, "W2": (4, 6), "b2": 4}
    network = Network(
        "mlp",
        {name: rng.normal(0, 0.5, shape) for name, shape in shapes.items()},
        rng.normal(0, 1, n_phi),
        np.exp(rng.normal(0, 0.5, n_phi)),
        rng.normal(0, 0.1, 4),
        np.exp(rng.normal(-2, 0.3, 4)),
    )
    model = Narx(made, network, limits=LIMITS)
    past = made.longest_lag
    y, u = rng.normal(size=(past, 4)), rng.normal(size=(past + 30, 2))
    now = past - 1
    x = measured_states(model, history(model, y, u[:past]))[-1]
    found = []
    for k in range(30):
        x = rates(model, x, u[now + k])
        found.append(x[:4])
    # The network's own NumPy evaluation on plain lists.
    known = list(y)
    for k in range(now, now + 30):
        lagged = [known[k + 1 - lag] for lag in made.output_lags]
        lagged += [u[k + 1 - lag] for lag in made.input_lags]
        phi = made.arrangement() @ np.concatenate(lagged)
        out = network.evaluate(phi[None, :])[0]
        known.append(known[k] + out if made.incremental else out)
    np.testing.assert_allclose(found, known[now + 1 :], rtol=1e-9, atol=1e-12)


class TestStates:
    def test_begin_with_the_outputs_under_their_own_names(self):
        model = rig_like((1, 3), (1, 2))
        assert model.state_names == (
            *("alpha_v", "alpha_h", "omega_v", "omega_h"),
            *("alpha_v_lag1", "alpha_h_lag1", "omega_v_lag1", "omega_h_lag1"),
            *("alpha_v_lag2", "alpha_h_lag2", "omega_v_lag2", "omega_h_lag2"),
            *("u_v_lag1", "u_h_lag1"),
        )
        assert model.controlled == ("alpha_v", "alpha_h")
        assert model.states[-1].unit == "V"
        x, u, p, _ = model.symbols()
        measured = ca.Function("y", [x, u, p], [model.measurement(x, u, p)])
        values = np.arange(model.n_x) * 1.0
        assert np.array(measured(values, np.zeros(2), []))[:, 0].tolist() == [0, 1, 2, 3]

    def test_of_one_axis_are_those_of_the_axis(self):
        made = NarxStructure(("alpha_h",), ("u_h",), ("rad",), ("V",), (1, 2), (1,), 0.02)
        network = Network(
            "mlp",
            {"W1": np.full((1, 3), 0.01), "b1": np.zeros(1)},
            np.zeros(3),
            np.ones(3),
            np.zeros(1),
            np.ones(1),
        )
        model = Narx(made, network, limits=LIMITS)
        assert (list(model.axes), list(model.rotors), model.controlled) == (
            ["yaw"],
            ["tail"],
            ("alpha_h",),
        )
        assert model.stops == {"alpha_h": 2.8}


class TestPushes:
    def test_are_accelerations(self):
        """A push moves a speed by T w and an angle by T² w in a sample."""
        model = rig_like()
        x, u = model.rest() + 0.1, np.array([1.0, 0.2])
        w = np.array([0.3, -0.2, 50.0, -7.0])
        moved = rates(model, x, u, w) - rates(model, x, u)
        T = 0.02
        expected = [T**2 * 0.3, -(T**2) * 0.2, T * 50.0, -T * 7.0, *([0.0] * 4)]
        np.testing.assert_allclose(moved, expected, rtol=1e-9, atol=1e-13)
        assert [signal.unit for signal in model.disturbances] == ["rad/s^2"] * 4
        assert model.axes["pitch"].moment == "alpha_v_push"
        assert model.axes["yaw"].moment == "alpha_h_push"


class TestRest:
    @pytest.mark.parametrize("kinds", STRUCTURES[:2], ids=str)
    def test_is_a_fixed_point(self, kinds):
        model = rig_like(**kinds, bend=0.5)
        x = model.rest()
        after = rates(model, x)
        np.testing.assert_allclose(after, x, rtol=0, atol=1e-9)
        assert np.abs(x).max() > 1e-3  # it is not simply zero
        x[:] = 7.0  # a copy
        assert np.abs(model.rest()).max() < 7.0

    def test_of_a_network_that_runs_away_is_still_finite(self):
        model = rig_like()
        wild = replace(
            model.network, weights={**model.network.weights, "A": 1e3 * np.ones((4, 10))}
        )
        assert np.isfinite(Narx(model.structure, wild, limits=LIMITS).rest()).all()


def test_weights_are_no_parameters():
    model = rig_like()
    assert len(model.parameters) == 0
    with pytest.raises(ConfigurationError, match="weights of a network are constants"):
        model.parameters.replaced({"k_fvp": 1.0})


def test_a_record_shorter_than_its_memory_tells_no_state():
    model = rig_like((1, 3))
    before = history(model, np.zeros((4, 4)), np.zeros((4, 2)))
    states = measured_states(model, before)
    assert np.isnan(states[:2]).any(axis=1).all() and np.isfinite(states[2:]).all()


@pytest.mark.parametrize(
    ("made", "limits", "where"),
    [
        (structure((1, 2, 3)), LIMITS, "network.regressor_mean"),  # of another network
        (structure(), {"alpha_w": 1.0}, "limits.alpha_w"),
        (structure(), {"u_v": 0.0}, "limits.u_v"),
        (structure(), {"u_h": float("nan")}, "limits.u_h"),
        # a command of unknown size
        (replace(structure(), input_units=("V", "A")), None, "limits.u_h"),
    ],
)
def test_a_structure_or_limits_that_do_not_fit_are_refused(made, limits, where):
    with pytest.raises(ModelError) as error:
        Narx(made, rig_like().network, limits=limits)
    assert error.value.where == where


@pytest.fixture
def content() -> NarxFile:
    model = rig_like((1, 3), (1, 2))
    return NarxFile(
        name="bent",
        structure=model.structure,
        network=model.network,
        limits=LIMITS,
        source="a few lines of physics",
        rig="newtonian",
        training={"method": "none", "epochs": 0},
    )


def test_comes_back_as_it_was_written_and_is_a_model_that_takes_effects(content, tmp_path):
    file = tmp_path / "bent.yaml"
    write_narx_file(file, content)
    back = read_narx_file(str(file))
    assert back.to_data() == content.to_data()
    for name, weight in content.network.weights.items():
        np.testing.assert_array_equal(back.network.weights[name], weight)
    assert back.structure == content.structure
    assert (back.rig, back.limits, back.training) == (content.rig, LIMITS, content.training)
    for model in (load_model(str(file)), narx(network=str(file))):
        assert (model.name, model.sample_time, model.input_limits["u_v"]) == ("narx", 0.02, 2.5)
    data = content.to_data() | {"effects": {"main_dead_zone": {"width": 0.05}}}
    path = tmp_path / "with_effect.yaml"
    path.write_text(yaml.safe_dump(data))
    assert effect_names(load_model(str(path))) == ("main_dead_zone",)


def _without(key):
    return lambda data: {k: v for k, v in data.items() if k != key}


def _with(place, value):
    def change(data):
        *folders, last = place.split(".")
        node = data
        for folder in folders:
            node = node[folder]
        node[last] = value
        return data

    return change


@pytest.mark.parametrize(
    ("change", "place"),
    [
        (_without("structure"), "structure"),
        (_without("network"), "network"),
        (_without("name"), "name"),
        (_with("colour", "red"), "colour"),
        (_with("model", "newtonian"), "model"),
        (_with("network", [1, 2]), "network"),
        (_with("network.kind", "perceptron"), "network.kind"),
        (_with("network.weights.W1", "wide"), "network.weights.W1"),
        (_with("network.weights.b1", [1.0, float("nan")]), "network.weights.b1"),
        (_with("network.weights.W9", [[1.0]]), "network.weights"),
        (_with("network.regressor_sd", [0.0] * 10), "network"),
        (_with("structure.output_lags", [2, 1]), "structure.output_lags"),
        (_with("structure.output_lags", [1, 2, 3]), "network.regressor_mean"),
        (_with("structure.sample_time", -0.02), "structure.sample_time"),
        (_with("structure.outputs", ["alpha_v"]), "structure.output_units"),
        (_with("limits.u_v", "much"), "limits.u_v"),
        (_with("limits.u_x", 1.0), "limits.u_x"),
        (_with("limits", 3), "limits"),
        (_with("effects", {"yaw_coulomb_friction": {"torque": 0.01}}), "effects"),
        (_with("effects", {"main_dead_zone": {"depth": 0.01}}), "effects.main_dead_zone.depth"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_mistakes_are_named_by_file_and_key(content, tmp_path, change, place):
    path = tmp_path / "wrong.yaml"
    path.write_text(yaml.safe_dump(change(content.to_data())))
    with pytest.raises(ModelError) as error:
        load_model(str(path))
    said = f"{error.value.where} {error.value.problem}"
    assert "wrong.yaml" in said
    assert place in said
    assert error.value.remedy


@pytest.mark.parametrize("text", ["model: narx\nname: [", "- 1\n- 2\n", "network: \x01"])
def test_what_is_no_yaml_mapping_is_refused(tmp_path, text):
    path = tmp_path / "broken.yaml"
    path.write_text(text)
    with pytest.raises(ModelError) as error:
        read_narx_file(str(path))
    assert "broken.yaml" in error.value.where


def test_a_network_that_is_not_there_is_told(tmp_path):
    with pytest.raises(ConfigurationError, match=r"no network 'narx_3dof'"):
        narx(network="narx_3dof")
    with pytest.raises(ConfigurationError, match="cannot read"):
        narx(network=str(tmp_path / "none.yaml"))
