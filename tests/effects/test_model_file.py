"""Models from files: what is accepted, and how a mistake is told."""

import numpy as np
import pytest
import yaml

from trms_cli.core.errors import ConfigurationError, ModelError, TrmsError
from trms_cli.core.plugins import build
from trms_cli.core.resources import config_folder
from trms_cli.effects.model_file import load_model
from trms_cli.models.newtonian import Newtonian


@pytest.fixture
def content():
    return yaml.safe_load((config_folder() / "parameters" / "bench.yaml").read_text("utf-8"))


@pytest.fixture
def written(tmp_path, content):
    def write(**changes):
        path = tmp_path / "rig.yaml"
        path.write_text(yaml.safe_dump(content | changes, sort_keys=False), encoding="utf-8")
        return str(path)

    return write


def test_a_parameter_set_is_a_model_also_as_an_option(written):
    node = yaml.safe_load((config_folder() / "model" / "from_file.yaml").read_text("utf-8"))
    assert node["path"] == "???"
    del node["defaults"]  # Hydra's
    for model in (load_model(written()), build(node | {"path": written()}, "model")):
        assert isinstance(model, Newtonian)
        np.testing.assert_array_equal(model.parameters.values, Newtonian().parameters.values)
        assert model.input_limits == Newtonian().input_limits


def test_a_set_may_stand_in_the_place_of_parameters(tmp_path):
    path = tmp_path / "rig.yaml"
    effects = "effects: {yaw_coulomb_friction: {torque: 0.004}}"
    for limits in ("", "limits: {u_v: 1.0}\n"):
        path.write_text(f"name: rig\nmodel: newtonian\nparameters: rahideh\n{limits}{effects}\n")
        model = load_model(str(path))
        expected = Newtonian(parameter_set="rahideh")
        assert model.parameters.names[:-1] == expected.parameters.names
        np.testing.assert_array_equal(model.parameters.values[:-1], expected.parameters.values)
        assert model.parameters.values[-1] == 0.004
        assert model.input_limits["u_v"] == (1.0 if limits else expected.input_limits["u_v"])
    for name in ("rahidey", str(path), "../model/newtonian"):
        path.write_text(f"name: rig\nmodel: newtonian\nparameters: {name}\n")
        with pytest.raises(ConfigurationError, match="no parameter set") as caught:
            load_model(str(path))
        assert "rahideh" in caught.value.remedy


def test_effects_come_with_their_sizes_and_names(rig, written):
    """Those of the library, and one that is written out under a name of its own."""
    own = {"_target_": "trms_cli.effects.actuator_lag.ActuatorLag", "rotor": "tail"}
    sizes = {
        "yaw_coulomb_friction": {"torque": 0.004},
        "main_input_delay": {},
        "second_lag": own | {"time_constant": 0.01},
    }
    model = load_model(written(effects=sizes))
    same = rig.extended(
        Newtonian(),
        {
            "yaw_coulomb_friction": rig.effect("yaw_coulomb_friction", torque=0.004),
            "main_input_delay": rig.effect("main_input_delay"),
            "second_lag": rig.effect("tail_actuator_lag", time_constant=0.01),
        },
    )
    assert model.parameters.names == same.parameters.names
    np.testing.assert_array_equal(model.parameters.values, same.parameters.values)
    u = rig.rich_input(100)
    np.testing.assert_array_equal(rig.simulate(model, u), rig.simulate(same, u))


def test_values_are_replaced_by_name(written):
    path = written(effects={"yaw_coulomb_friction": {}})
    changed = {"k_g": 0.05, "yaw_coulomb_friction.torque": 0.003}
    model = load_model(path, changed)
    assert {name: model.parameters[name].value for name in changed} == changed
    nested = load_model(path, {"yaw_coulomb_friction": {"torque": 0.002}})
    assert nested.parameters["yaw_coulomb_friction.torque"].value == 0.002
    with pytest.raises(ConfigurationError) as caught:
        load_model(path, {"k_q": 0.05})
    assert caught.value.where == "model.parameters.k_q"


@pytest.mark.parametrize("option", ["newtonian_full", "newtonian_vertical", "newtonian_horizontal"])
def test_it_names_any_built_in_form(written, option):
    model = load_model(written(model=option))
    node = yaml.safe_load((config_folder() / "model" / f"{option}.yaml").read_text("utf-8"))
    assert model.state_names == build(node, "model").state_names


def test_a_fitted_file_keeps_its_standard_deviations_and_scientific_numbers(written, content):
    entry = {"value": "1.7e-5", "unit": "N*s^2", "sd": "2e-7", "prior_sd": 0.06}
    model = load_model(written(parameters=content["parameters"] | {"k_fvp": entry}))
    assert model.parameters["k_fvp"].value == 1.7e-5


def of_effect(name="yaw_coulomb_friction", **sizes):
    return {"effects": {name: sizes}}


TORQUE = "effects.yaw_coulomb_friction.torque"
MISTAKES = [
    ({"model": "newtonain"}, "model", "newtonian"),
    ({"model": "from_file"}, "model", "newtonian"),
    (of_effect("yaw_columb_friction"), "effects.yaw_columb_friction", "yaw_coulomb"),
    (of_effect(toque=1.0), "effects.yaw_coulomb_friction.toque", "torque"),
    (of_effect(torque=-1.0), TORQUE, ">= 0"),
    (of_effect(torque="much"), TORQUE, "number"),
    (of_effect(axis="pitch", torque=float("nan")), TORQUE, ""),
    (of_effect("mine", _target_="no.such.Class"), "effects.mine._target_", "allow no"),
    (of_effect("mine", _target_="trms_cli.models.tras.Tras"), "effects.mine._target_", ""),
    ({"model": "newtonian_vertical"} | of_effect(), "effects", "pitch"),
    ({"limits": {"u_x": 1.0}}, "limits.u_x", "u_v"),
    ({"limits": {"u_v": -1.0}}, "limits.u_v", "positive"),
]


@pytest.mark.parametrize(("changes", "key", "remedy"), MISTAKES)
def test_a_mistake_is_told_by_file_and_key(written, changes, key, remedy):
    path = written(**changes)
    with pytest.raises(TrmsError) as caught:
        load_model(path)
    assert isinstance(caught.value, ModelError)
    assert caught.value.where == f"{path}: {key}"
    assert remedy in caught.value.remedy


def test_a_missing_or_misspelt_parameter_is_named(written, content):
    for name in ("k_fvp", "k_chn", "g"):
        parameters = {key: value for key, value in content["parameters"].items() if key != name}
        path = written(parameters=parameters)
        with pytest.raises(ModelError) as caught:
            load_model(path)
        assert name in str(caught.value) and caught.value.where.startswith(f"{path}: parameters")
    path = written(parameters=content["parameters"] | {"k_fvq": {"value": 1.0}})
    with pytest.raises(ModelError, match="k_fvq") as caught:
        load_model(path)
    assert "did you mean k_fvp" in caught.value.remedy


@pytest.mark.parametrize("text", ["", "[1, 2]", "name: [", "name: a\nmodel: newtonian\n"])
def test_another_kind_of_file_is_refused(tmp_path, text):
    path = tmp_path / "other.yaml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ModelError) as caught:
        load_model(str(path))
    assert str(path) in caught.value.where


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(ConfigurationError, match="nowhere") as caught:
        load_model(str(tmp_path / "nowhere.yaml"))
    assert caught.value.where == "model.path"
