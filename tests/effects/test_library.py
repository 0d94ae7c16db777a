"""The library as the command line meets it: YAML options, ranges, overrides."""

import dataclasses
import re

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trms_cli.composition.composer import compose
from trms_cli.core.errors import ConfigurationError, ModelError
from trms_cli.core.plugins import build
from trms_cli.core.resources import config_folder


def test_each_size_has_a_unit_a_meaning_and_the_typical_range_that_the_option_tells(
    rig, effect_name
):
    text = (config_folder() / "effect" / f"{effect_name}.yaml").read_text(encoding="utf-8")
    effect = rig.effect(effect_name)
    for parameter in effect.parameters():
        assert parameter.unit and parameter.description
        assert getattr(effect, parameter.name) == parameter.value
        assert parameter.lower <= parameter.value <= parameter.upper
        low, high = parameter.typical
        assert parameter.lower <= low < high <= parameter.upper
        told = re.search(
            rf"^  {parameter.name}: .*typical (\S+) to (\S+?)(?:[;:,].*)?$", text, re.M
        )
        assert told, f"{parameter.name} has no typical range"
        assert (float(told[1]), float(told[2])) == (low, high)


def test_a_size_out_of_range_is_refused_by_its_key(rig, effect_name):
    for size in rig.effect(effect_name).parameters():
        with pytest.raises(ConfigurationError) as caught:
            build(rig.node(effect_name) | {size.name: size.lower - 1.0}, f"effect.{effect_name}")
        assert caught.value.where == f"effect.{effect_name}.{size.name}"


@given(value=st.one_of(st.floats(max_value=-1e-9), st.text(), st.booleans()))
@settings(max_examples=50)
def test_nothing_but_a_size_is_taken_for_one(rig, value):
    with pytest.raises(ConfigurationError):
        build(rig.node("yaw_coulomb_friction") | {"torque": value}, "effect.yaw_coulomb_friction")


def test_an_axis_that_does_not_exist_is_refused(rig):
    effect = build(rig.node("yaw_coulomb_friction") | {"axis": "roll"}, "effect.mine")
    with pytest.raises(ModelError, match="no roll axis") as caught:
        rig.extended(rig.newtonian(), {"mine": effect})
    assert caught.value.where == "effect.mine" and "pitch, yaw" in caught.value.remedy


def test_effects_are_data(rig, effect_name):
    """Equal by value, hashable, unchangeable."""
    effect = rig.effect(effect_name)
    assert effect == rig.effect(effect_name)
    assert hash(effect) == hash(rig.effect(effect_name))
    with pytest.raises(dataclasses.FrozenInstanceError):
        effect.anything = 1
    assert msgspec.json.encode(dataclasses.asdict(effect))


DOCUMENT = config_folder().parent / "docs" / "effects.md"


def _commands():
    if not DOCUMENT.exists():  # an installed package has no docs
        return []
    return re.findall(r"^    trms run (effect=.*)$", DOCUMENT.read_text("utf-8"), re.MULTILINE)


@pytest.mark.parametrize("line", _commands())
def test_each_command_of_the_document_composes(line):
    effects = compose(line.split()).config["effect"]
    assert effects
    for name, node in effects.items():
        build(node, f"effect.{name}")


@pytest.mark.skipif(not DOCUMENT.exists(), reason="an installed package has no docs")
def test_the_document_knows_every_effect_and_every_key(rig, effect_name):
    text = DOCUMENT.read_text("utf-8")
    kind = rig.kind(effect_name)
    title = kind.replace("_", " ").capitalize()
    section = re.search(rf"^## {title}\n(.*?)^## ", text, re.MULTILINE | re.DOTALL)[1]
    assert f"figures/effects/{kind}.png" in section
    assert (DOCUMENT.parent / "figures" / "effects" / f"{kind}.png").exists()
    assert "*Limits.*" in section
    for key in rig.node(effect_name):
        if key not in ("_target_", "axis", "rotor"):
            assert f"| `{key}` |" in section


@pytest.mark.skipif(not DOCUMENT.exists(), reason="an installed package has no docs")
def test_the_effect_that_the_document_writes_works(rig, tmp_path, monkeypatch):
    text = DOCUMENT.read_text("utf-8")
    code = re.search(r"```python\n(.*?)```", text, re.DOTALL)[1]
    option = re.search(r"```yaml\n(# a draught.*?)```", text, re.DOTALL)[1]
    (tmp_path / "mine" / "effect").mkdir(parents=True)
    (tmp_path / "my_effects.py").write_text(code, encoding="utf-8")
    (tmp_path / "mine" / "effect" / "yaw_draught.yaml").write_text(option, encoding="utf-8")
    monkeypatch.setenv("TRMS_ALLOW", "my_effects")
    folder = str(tmp_path / "mine")
    node = compose(["--config-dir", folder, "effect=yaw_draught"]).config["effect"]["yaw_draught"]
    u = rig.rich_input(100)
    absent = rig.extended(rig.newtonian(), {"d": build(node | {"torque": 0.0}, "d")})
    present = rig.extended(rig.newtonian(), {"d": build(node, "d")})
    expected = rig.simulate(rig.newtonian(), u)
    np.testing.assert_array_equal(rig.simulate(absent, u), expected)
    assert np.any(rig.simulate(present, u) != expected)
