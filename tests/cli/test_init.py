"""``trms init``: a rig's folder, what is refused, and that the folder is found from inside."""

import json
import os
import tomllib
from pathlib import Path

import pytest
import yaml

from trms_cli.composition.overrides import default_words
from trms_cli.library.new_rig import EXAMPLES, rig_files

SOURCE = Path(__file__).parents[2] / "examples"


@pytest.fixture
def rig(trms, tmp_path: Path) -> Path:
    trms("init", "my_rig")
    return tmp_path / "my_rig"


@pytest.fixture
def inside(rig: Path, trms):
    """Call the program in a folder of the rig."""

    def call(*argv: str, folder: Path = rig, **keys):
        return trms.func(folder, *argv, **keys)

    return call


def test_a_folder_with_all_that_a_rig_needs(trms, rig: Path) -> None:
    for place in ("my_rig/model.py", "my_rig/driver.py", "configs/model/my_rig.yaml", "Makefile",
                  "configs/plant/simulation.yaml", "configs/plant/hardware.yaml", "trms.toml",
                  ".github/workflows/rig.yml", ".gitignore", "tests/test_rig.py", "README.md",
                  "pyproject.toml"):  # fmt: skip
        assert (rig / place).is_file(), place
    assert "class MyRig(Model)" in (rig / "my_rig/model.py").read_text()
    for file in rig.rglob("*.*"):
        if file.is_file():
            assert not any(f"@{word}@" in file.read_text() for word in ("RIG", "CLASS", "INPUT"))
    assert json.loads(trms("allow", "--json").stdout)["packages"] == {"my_rig": str(rig)}
    tomllib.loads((rig / "pyproject.toml").read_text())
    workflow = yaml.safe_load((rig / ".github/workflows/rig.yml").read_text())
    assert workflow["jobs"]["rig"]["env"]["TRMS_ALLOW"] == "my_rig"


@pytest.mark.parametrize("example", EXAMPLES)
def test_the_examples_are_what_init_writes(example: str) -> None:
    """All but the story that their README tells."""
    written = rig_files(example, example)
    for place, text in written.items():
        if place.name != "README.md":
            assert (SOURCE / example / place).read_text(encoding="utf-8") == text, place
    there = {p.relative_to(SOURCE / example) for p in (SOURCE / example).rglob("*") if p.is_file()}
    ignored = {"__pycache__", "outputs", ".pytest_cache"}
    assert {p for p in there if ignored.isdisjoint(p.parts)} == set(written)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("my-rig", "'my-rig' is no package's name"),
        ("3rd", "'3rd' is no package's name"),
        ("class", "'class' is a word of Python"),
        ("json", "json is a package of Python"),
        ("trms_cli", "trms_cli is a package of this program"),
        ("numpy", "a package numpy is installed already"),
        ("newtonian", "there is a model newtonian already"),
        ("tests", "'tests' is a folder beside the package"),
        ("/proc/my_rig", "cannot be written"),
    ],
)
def test_a_name_or_place_that_will_not_do_is_refused(refused, name: str, words: str) -> None:
    refused("init", name, words=words)


def test_what_is_there_stays(trms, refused, tmp_path: Path) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes.txt").write_text("mine")
    refused("init", "full", words="the folder holds something: notes.txt")
    (tmp_path / "file").write_text("mine")
    refused("init", "file", words="there is a file of this name")
    (tmp_path / "my_rig").mkdir()
    trms("init", "my_rig")
    refused("init", "my_rig", words="it is a rig's already")
    refused("init", "other/my_rig", words="my_rig is allowed already, in another place")
    refused("init", words="required: name")
    refused("init", "b", "--example", "boat", words="allowed: cart_pole, servo_drive")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_an_unwritable_place_is_told(refused, tmp_path: Path) -> None:
    (tmp_path / "locked").mkdir(mode=0o555)
    refused("init", "locked/my_rig", words="cannot be written: Permission denied")


def test_nothing_is_left_of_what_could_not_be_written(trms, tmp_path, monkeypatch) -> None:
    write, count = Path.write_text, iter(range(100))

    def full(self: Path, *args, **keys):
        if next(count) == 5:
            raise OSError(28, "No space left on device")
        return write(self, *args, **keys)

    monkeypatch.setattr(Path, "write_text", full)
    said = trms("init", "my_rig", code=2).said
    assert "No space left on device" in said
    assert not [p for p in tmp_path.iterdir() if p.name != "settings"]
    monkeypatch.undo()


def test_options_are_found_in_the_folder_and_below(rig: Path, inside) -> None:
    for folder in (rig, rig / "tests"):
        assert "my_rig" in inside("list", "model", folder=folder).stdout
        shown = yaml.safe_load(inside("run", "--cfg", "job", folder=folder).stdout)
        assert shown["model"]["_target_"] == "my_rig.model.MyRig"
        assert shown["plant"]["sensors"]["quantum"] == {"position": 5e-6}
        shown = yaml.safe_load(inside("diagnose", "real=x.csv", "--cfg", "job").stdout)
        assert shown["model"]["_target_"] == "my_rig.model.MyRig" and "quantum" in shown["data"]


def test_what_is_typed_comes_before_what_the_folder_says(inside) -> None:
    shown = yaml.safe_load(
        inside(
            "run", "model=newtonian", "plant=ideal", "controller=pid", "ref=sine", "--cfg", "job"
        ).stdout
    )
    assert shown["model"]["_target_"].startswith("trms_cli.")


def test_a_scenario_chooses_before_the_folder_does(rig: Path, monkeypatch) -> None:
    monkeypatch.chdir(rig)
    words = default_words(["experiment=record"], "run")
    assert "model=my_rig" in words and "ref=my_rig" not in words
    assert "controller=my_rig" in default_words([], "run")
    assert "controller=my_rig" not in default_words(["controller=lqr"], "run")
    assert default_words([], "identify") == ["model=my_rig", "data=my_rig"]


def test_somebody_elses_folder_grants_nothing_and_says_what_to_type(trms, inside) -> None:
    trms("allow", "--remove", "my_rig")
    told = " ".join(inside("allow").stdout.split())
    assert "my_rig not allowed, and used here: trms allow my_rig" in told
    assert "trms allow my_rig" in inside("run", code=2).stderr
    assert "my_rig" in inside("list", "model").stdout  # data
    inside("allow", "my_rig")
    inside("run", "--cfg", "job")


def test_folders_can_be_named_by_the_environment(trms, rig: Path) -> None:
    configs = str(rig / "configs")
    assert "my_rig" in trms("list", "model", TRMS_CONFIG_DIR=configs).stdout
    shown = yaml.safe_load(trms("run", "--cfg", "job", TRMS_CONFIG_DIR=configs).stdout)
    assert shown["model"]["_target_"].startswith("trms_cli.")  # defaults are trms.toml's
    assert "there is no folder" in trms("list", code=2, TRMS_CONFIG_DIR="nowhere").stderr


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("config = [", "cannot be read"),
        ("config = " + "[" * 20000, "cannot be read"),
        ('configs = ["configs"]', "unknown key 'configs'"),
        ('config = "configs"', "config is not as it should be"),
        ('config = ["nowhere"]', "there is no folder"),
        ('config = ["configs"]\n[defaults]\nmodell = "my_rig"', "there is no group 'modell'"),
        ('config = ["configs"]\n[defaults]\nmodel = 3', "defaults is not as it should be"),
    ],
)
def test_a_file_that_is_wrong_is_told(rig: Path, inside, text: str, words: str) -> None:
    (rig / "trms.toml").write_text(text)
    done = inside("run", "--cfg", "job", code=2)
    assert words in done.said and "trms.toml" in done.said


def test_another_users_file_is_not_read(rig: Path, inside, monkeypatch) -> None:
    monkeypatch.setattr(os, "getuid", lambda: 4711)
    os.chown(rig / "trms.toml", 4712, -1) if os.geteuid() == 0 else pytest.skip("needs root")
    done = inside("list", "model")
    assert "my_rig" not in done.stdout
    assert "is another user's and was not read" in done.stderr
