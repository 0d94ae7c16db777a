"""The conda recipe and the container: what can be held of them without building them."""

import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet

import trms_cli
from tests.packaging.conftest import PROJECT, ROOT
from trms_cli.cli import COMMANDS

RECIPE = yaml.safe_load((ROOT / ".ci/conda/recipe.yaml").read_text(encoding="utf-8"))
CONTAINER = re.sub(
    r"\\\n\s*", "", (ROOT / ".ci/Containerfile").read_text(encoding="utf-8")
).splitlines()
#: conda-forge's names where they are others than those of pyproject.toml.
CONDA_NAMES = {"matplotlib": "matplotlib-base"}
#: What is not known to be a package there; the program says what it does without it.
NOT_THERE = {"ruckig"}
#: The Python of an image's system.
PYTHON_OF = {"debian:bookworm-slim": "3.11"}


def lines(word: str) -> list[str]:
    """What stands behind an instruction of the container file, for each time it is given."""
    return [line.removeprefix(f"{word} ") for line in CONTAINER if line.startswith(f"{word} ")]


def test_the_recipe_is_of_this_version_and_python():
    assert RECIPE["context"]["version"] == trms_cli.__version__
    assert f">={RECIPE['context']['python_min']}" == PROJECT["requires-python"]
    (entry,) = RECIPE["build"]["python"]["entry_points"]
    name, _, target = entry.partition(" = ")
    assert PROJECT["scripts"] == {name: target} and RECIPE["package"]["name"] == PROJECT["name"]
    assert RECIPE["build"]["noarch"] == "python" and RECIPE["about"]["license"] == "MIT"
    assert (ROOT / ".ci/conda" / RECIPE["source"]["path"]).resolve() == ROOT


def test_the_recipe_has_the_dependencies_of_the_project_with_their_bounds():
    wanted = {}
    for text in PROJECT["dependencies"]:
        requirement = Requirement(text)
        if requirement.name not in NOT_THERE:
            name = CONDA_NAMES.get(requirement.name, requirement.name)
            wanted[name] = str(requirement.specifier)
    there = dict(text.split(" ", 1) for text in RECIPE["requirements"]["run"])
    assert there.pop("python") == ">=${{ python_min }}"
    assert there == wanted


def test_the_commands_of_the_recipe_and_the_container_exist():
    scripts = [line for test in RECIPE["tests"] for line in test.get("script", ())]
    scripts += [command.strip() for line in lines("RUN") for command in line.split("&&")]
    typed = [shlex.split(line)[1] for line in scripts if line.startswith("trms ")]
    words = {word for word in typed if word != "--version"}
    assert "run" in words and words <= set(COMMANDS)


def test_the_container_copies_what_there_is_and_its_python_is_new_enough():
    for line in lines("COPY"):
        *sources, target = line.split()
        assert target.startswith("/opt/source/")
        assert all((ROOT / source).exists() for source in sources), line
    (image,) = lines("FROM")
    python = PYTHON_OF[image.removeprefix("docker.io/library/")]
    assert SpecifierSet(PROJECT["requires-python"]).contains(python)


def test_the_container_installs_what_is_locked_and_runs_as_nobody_in_particular():
    install = next(line for line in lines("RUN") if "pip install" in line)
    extras = re.search(r"/opt/source\[([\w,]+)\]", install)
    assert "--constraint /opt/source/requirements.lock" in install and extras is not None
    assert set(extras[1].split(",")) <= set(PROJECT["optional-dependencies"])
    instructions = [line.split(" ")[0] for line in CONTAINER]
    assert lines("USER") == ["trms"] and lines("ENTRYPOINT") == ['["trms"]']
    assert instructions.index("USER") < instructions.index("ENTRYPOINT")


@pytest.mark.slow
def test_what_the_container_copies_is_enough_for_a_wheel(tmp_path: Path):
    (tmp_path / "source").mkdir()
    for line in lines("COPY"):
        *sources, target = line.split()
        for source in sources:
            place = tmp_path / "source" / target.removeprefix("/opt/source/")
            if (ROOT / source).is_dir():
                shutil.copytree(ROOT / source, place)
            else:
                shutil.copy(ROOT / source, place)
    command = [sys.executable, "-m", "build", "--wheel", "--outdir", str(tmp_path / "dist")]
    done = subprocess.run([*command, str(tmp_path / "source")], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
