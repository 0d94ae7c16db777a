"""Network files: every weight comes back with its bits, and each mistake is named by its key."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from trms_cli.core.errors import ConfigurationError, ModelError
from trms_cli.effects.extended_model import effect_names
from trms_cli.effects.model_file import load_model
from trms_cli.models.narx_file import NarxFile, narx, read_narx_file, write_narx_file

from .network_case import LIMITS, rig_like


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


@pytest.fixture
def file(content, tmp_path) -> Path:
    path = tmp_path / "bent.yaml"
    write_narx_file(path, content)
    return path


def test_comes_back_as_it_was_written_and_is_a_model(content, file):
    back = read_narx_file(str(file))
    assert back.to_data() == content.to_data()
    for name, weight in content.network.weights.items():
        np.testing.assert_array_equal(back.network.weights[name], weight)
    assert back.structure == content.structure
    assert (back.rig, back.limits, back.training) == (content.rig, LIMITS, content.training)
    for model in (load_model(str(file)), narx(network=str(file))):
        assert (model.name, model.sample_time, model.input_limits["u_v"]) == ("narx", 0.02, 2.5)


def test_takes_effects_on_the_command(content, tmp_path):
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
