"""Which code a configuration may name, and what it may refer to."""

import ast
import dataclasses
import importlib
import inspect
import json
import pkgutil
import re
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path

import pytest

import trms_cli
from trms_cli.cli import main
from trms_cli.composition.composer import compose
from trms_cli.core import trust
from trms_cli.core.errors import ConfigurationError, TrmsError
from trms_cli.core.plugins import build, locate
from trms_cli.core.trust import allowed_for_good, allowed_for_now, write_allowed

ROOT = Path(__file__).parents[2]
_CODE = """
import os
import subprocess
from dataclasses import dataclass
from os import system
from pathlib import Path

Path({told!r}).touch()

@dataclass(frozen=True)
class Mine:
    gain: float = 1.0

def made(gain: float = 2.0) -> Mine:
    return Mine(gain)

value = 3
"""


@pytest.fixture
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder of configuration with the package `lab_of_trust` beside it, and nothing allowed."""
    monkeypatch.setenv("TRMS_ALLOW", "")
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "settings"))
    folder = tmp_path / "theirs"
    (folder / "configs" / "controller").mkdir(parents=True)
    (folder / "configs" / "controller" / "mine.yaml").write_text(
        "# mine\n_target_: lab_of_trust.Mine\ngain: 2.0\n"
    )
    (folder / "lab_of_trust.py").write_text(_CODE.format(told=str(folder / "was imported")))
    places = list(trust._folders.places)
    yield folder
    trust._folders.places[:] = places
    sys.modules.pop("lab_of_trust", None)


def imported(lab: Path) -> bool:
    return (lab / "was imported").exists()


def built(lab: Path) -> object:
    composed = compose(["--config-dir", str(lab / "configs"), "controller=mine"])
    return build(composed.config["controller"], "controller")


def test_a_folder_of_configuration_alone_runs_nothing_until_what_is_said_is_typed(
    lab: Path,
) -> None:
    before = list(sys.path)
    with pytest.raises(ConfigurationError) as caught:
        built(lab)
    assert not imported(lab) and sys.path == before
    assert caught.value.where == "controller._target_"
    assert "--allow lab_of_trust" in caught.value.remedy
    line = next(text for text in caught.value.remedy.splitlines() if "trms allow" in text)
    assert f"trms allow lab_of_trust --config-dir {lab / 'configs'}" in line
    assert main(line.split()[1:]) == 0
    assert built(lab).gain == 2.0  # type: ignore[attr-defined]


def test_allowed_for_a_call(lab: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Only what the package itself defines."""
    monkeypatch.setenv("TRMS_ALLOW", "other,lab_of_trust")
    assert built(lab).gain == 2.0  # type: ignore[attr-defined]
    assert locate("lab_of_trust.made", "")().gain == 2.0
    for target in ("os.system", "system", "subprocess.run", "Path", "value", "dataclass", "os"):
        with pytest.raises(ConfigurationError):
            locate(f"lab_of_trust.{target}", "")
    with pytest.raises(ConfigurationError):
        locate("lab_of_trust.__builtins__", "")


def test_allowed_for_good_means_that_place_alone(lab: Path, tmp_path: Path) -> None:
    for place in (tmp_path / "elsewhere", None):  # None: an installed one, which is not there
        write_allowed({"lab_of_trust": place})
        with pytest.raises(ConfigurationError, match="cannot import"):
            built(lab)
        assert not imported(lab)


def test_a_namesake_in_a_folder_replaces_nothing(lab: Path) -> None:
    for name in ("pandas", "submitit", "hydra_plugins"):
        (lab / f"{name}.py").write_text(f"raise SystemExit('{name} was imported')\n")
    with pytest.raises(ConfigurationError):
        built(lab)
    with pytest.raises(ModuleNotFoundError):
        importlib.import_module("submitit_of_nobody")
    assert str(lab) not in sys.path


@pytest.mark.parametrize(
    "target",
    [
        *("os.system", "builtins.eval", "subprocess.run", "numpy.save", "shutil.rmtree"),
        "trms_cli.core.plugins.importlib.import_module",
        "trms_cli.core.trust.importlib",
        "trms_cli.core.whole_file.replace_whole",
        "trms_cli.core.trust.write_allowed",
        "trms_cli.core.trust.allow_for_now",
        "trms_cli.runs.run_folder.new_folder",
        "trms_cli.library.tasks.git_revision.subprocess",
        "trms_cli.recordings.run_log.RunLog",
        "trms_cli.core.whole_file.whole_file",
        "trms_cli.identification.population.Journal",
        *("trms_cli.cli.main", "trms_cli.__main__.main", "trms_cli", ".os.system", ""),
        "trms_cli.core.compilation.compiled_source",
        "trms_cli.runs.index.RunIndex",
        "trms_cli.runs.index.remove",
        "trms_cli.controllers.pid.dataclass",
        "trms_cli.controllers..pid.Pid",
        "trms_cli.controllers.pid.",
    ],
)
def test_what_is_no_plugin_is_refused(target: str) -> None:
    with pytest.raises(ConfigurationError):
        build({"_target_": target}, "x")
    with pytest.raises(TrmsError):
        build(compose([f"++controller._target_='{target}'"]).config["controller"], "controller")


def test_every_target_of_our_own_configuration_is_a_plugin() -> None:
    targets = set()
    for folder in ("configs", "experiments"):
        for file in (ROOT / folder).rglob("*.yaml"):
            text = file.read_text(encoding="utf-8")
            targets |= set(re.findall(r"_target_:\s*['\"]?([\w.]+)", text))
    assert len(targets) > 80
    for target in sorted(targets):
        if target.startswith("experiments."):  # beside the program: its study allows it to itself
            with pytest.raises(ConfigurationError, match="--allow experiments"):
                trust.check_allowed(target, "")
            assert inspect.isclass(_named(target))
            continue
        trust.check_allowed(target, "")
        locate(target, "")


def _named(target: str) -> object:
    module, _, name = target.rpartition(".")
    return getattr(importlib.import_module(module), name)


def _plugins() -> Iterator[type]:
    for found in pkgutil.walk_packages(trms_cli.__path__, "trms_cli."):
        if found.name.endswith("__main__"):
            continue
        for kind in vars(importlib.import_module(found.name)).values():
            if inspect.isclass(kind) and kind.__module__ == found.name and trust._is_plugin(kind):
                yield kind


def test_no_value_class_of_ours_does_anything_when_it_is_made() -> None:
    """A frozen dataclass may be named by anyone: making one must not write, remove or start."""
    acts = {"unlink", "rmtree", "write_text", "write_bytes", "mkdir", "rename", "replace_whole"}
    acts |= {"system", "run", "Popen", "remove", "rmdir", "symlink_to", "touch", "chmod"}
    checked = 0
    for kind in _plugins():
        checked += 1
        for method in ("__post_init__", "__init__", "__new__"):
            code = vars(kind).get(method)
            made = method == "__init__" and dataclasses.is_dataclass(kind)
            if not inspect.isfunction(code) or made:
                continue
            for node in ast.walk(ast.parse(textwrap.dedent(inspect.getsource(code)))):
                if isinstance(node, ast.Call):
                    word = getattr(node.func, "attr", getattr(node.func, "id", ""))
                    assert word not in acts, f"{kind.__module__}.{kind.__qualname__}: {word}"
    assert checked > 300


@pytest.mark.parametrize(
    "name", ["os", "trms_cli", "builtins", "my_lab.x", "a b", "", "../x", "1a"]
)
def test_what_cannot_be_allowed(name: str, lab: Path) -> None:
    from trms_cli.composition.catalogue import take_allowed

    with pytest.raises(ConfigurationError):
        take_allowed(["--allow", name])
    assert not allowed_for_now()


def test_a_damaged_list_of_what_is_allowed_is_told(lab: Path, tmp_path: Path) -> None:
    file = tmp_path / "settings" / "trms" / "allowed.json"
    file.parent.mkdir(parents=True)
    for content in ("{", "[]", '{"packages": 3}', "[" * 100_000):
        file.write_text(content)
        with pytest.raises(ConfigurationError, match="cannot be read"):
            built(lab)
    file.write_text(json.dumps({"packages": {"os": None, "my lab": None, "lab_of_trust": None}}))
    assert set(allowed_for_good()) == {"lab_of_trust"}


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("_target_: x.Y\nx: ${oc.env:HOME}\n", "outside of the configuration"),
        ("_target_: x.Y\nx: ${oc.decode:'3'}\n", "outside of the configuration"),
        ("_target_: x.Y\nx: ${hydra:runtime.cwd}\n", "outside of the configuration"),
        ("_target_: x.Y\nx: ${now:%Y}\n", "outside of the configuration"),
        ("_target_: x.Y\nx: ${${y}:HOME}\ny: oc.env\n", "outside of the configuration"),
        ("defaults:\n  - optional /ref: ${oc.env:HOME}\n", "outside of the configuration"),
        ("hydra: {searchpath: [pkg://os]}\n", "Hydra's own"),
        ("# @package hydra.job\nname: x\n", "Hydra's own"),
        ("x: ${.y}\ny: ${.x}\n", "circle"),
        ("a: &a [*a]\n", "inside of itself"),
        ("a: 1\na: 2\n", "stands twice|duplicate"),
        ("[" * 5000, "deeper"),
        ("_target_: !!python/object/apply:os.system [ls]\n", "not valid YAML"),
        ("a: 2001-99-99\n", "cannot be read|cannot be composed|month"),
        ("a: \xff\xfe", ""),
    ],
)
def test_an_option_of_a_stranger_is_plain_data(lab: Path, content: str, words: str) -> None:
    file = lab / "configs" / "controller" / "theirs.yaml"
    file.write_bytes(content.encode("latin-1"))
    with pytest.raises(TrmsError, match=words or None):
        composed = compose(["--config-dir", str(lab / "configs"), "controller=theirs"])
        build(composed.config["controller"], "controller")


def test_references_that_multiply_are_refused_before_they_are_resolved(lab: Path) -> None:
    lines = ["a0: " + "x" * 1000]
    lines += [f"a{i}: ${{.a{i - 1}}}${{.a{i - 1}}}" for i in range(1, 40)]
    (lab / "configs" / "controller" / "bomb.yaml").write_text("\n".join(lines))
    with pytest.raises(ConfigurationError, match="more than there is room for"):
        compose(["--config-dir", str(lab / "configs"), "controller=bomb"])


def test_references_to_other_keys_stay(lab: Path) -> None:
    folder = lab / "configs" / "experiment"
    folder.mkdir()
    (folder / "half.yaml").write_text(
        "# @package _global_\nseed: ${oc.select:sim.nothing,4}\n"
        "sim:\n  duration: 3.0\n  sample_time: ${.duration}\n"
    )
    config = compose(["--config-dir", str(lab / "configs"), "experiment=half"]).config
    assert config["seed"] == 4 and config["sim"]["sample_time"] == 3.0


def test_options_that_a_log_holds_are_not_followed(tmp_path: Path) -> None:
    from trms_cli.library.tasks.repeat import repetition
    from trms_cli.recordings.run_log import RunLog

    words = ["--allow", "evil", "--config-dir", str(tmp_path)]
    for key in ("overrides", "config_dirs"):
        log = tmp_path / f"{key}.mcap"
        about = {"command": "run", key: json.dumps(words)}
        with RunLog(log, [], about, {"config.yaml": ("text/yaml", b"seed: 1\n")}):
            pass
        with pytest.raises(TrmsError, match="what was typed"):
            repetition(log, [], "run")
        assert "evil" not in allowed_for_now()


def test_a_module_that_trms_lacks_is_not_to_be_allowed() -> None:
    with pytest.raises(ConfigurationError) as caught:
        locate("trms_cli.x.os.system", "controller")
    assert "--allow" not in caught.value.remedy and "trms list" in caught.value.remedy
