"""The distributions, built as a user's tool builds them, and environments to install them in."""

import os
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[2]
#: Nothing is compiled where the program is installed: only wheels are taken, but for one package of
#: Python alone that is published as source.
WHEELS_ALONE = ("--only-binary", ":all:", "--no-binary", "antlr4-python3-runtime")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


@dataclass(frozen=True)
class Distributions:
    """The two files that a release consists of."""

    wheel: Path
    sdist: Path


@dataclass(frozen=True)
class Environment:
    """A virtual environment with the wheel in it, and a folder that is not the checkout."""

    python: Path
    work: Path

    def run(self, *words: str, code: int = 0) -> str:
        """What a program of the environment prints; `code` is what it must end in."""
        program = self.python.with_name(words[0])
        outside = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV")}
        if words[0] == "trms":  # what one environment allows, another does not; pip has its own
            outside["XDG_CONFIG_HOME"] = str(self.work / ".settings")
        done = subprocess.run(
            [program, *words[1:]], capture_output=True, text=True, cwd=self.work, env=outside
        )
        assert done.returncode == code, f"{words}: {done.returncode}\n{done.stdout}\n{done.stderr}"
        return done.stdout + done.stderr


@pytest.fixture(scope="session")
def distributions(tmp_path_factory) -> Distributions:
    """Wheel and source distribution, the wheel built from the source distribution."""
    source, built = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("dist")
    for name in tracked():
        place = source / name
        place.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(ROOT / name, place)
    command = [sys.executable, "-m", "build", "--outdir", str(built), str(source)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    (wheel,), (sdist,) = built.glob("*.whl"), built.glob("*.tar.gz")
    return Distributions(wheel, sdist)


@pytest.fixture(scope="session")
def environment_with(
    distributions, tmp_path_factory
) -> Callable[[str, tuple[str, ...]], Environment]:
    """Makes an environment of a Python, with the wheel under some constraints; each once."""

    @cache
    def make(python: str, constraints: tuple[str, ...]) -> Environment:
        folder = tmp_path_factory.mktemp("environment")
        subprocess.run([python, "-m", "venv", str(folder / "venv")], check=True)
        environment = Environment(folder / "venv" / "bin" / "python", folder / "work")
        environment.work.mkdir()
        limits = folder / "constraints.txt"
        limits.write_text("\n".join(constraints) + "\n", encoding="utf-8")
        built = () if constraints else WHEELS_ALONE  # the lowest versions may have none any more
        environment.run(
            *("python", "-m", "pip", "install", "--quiet", *built),
            *("-c", str(limits), str(distributions.wheel)),
        )
        return environment

    return make


@cache
def tracked() -> tuple[str, ...]:
    """What a clean clone has."""
    command = ["git", "ls-files", "-z"]
    said = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    return tuple(name for name in said.split("\0") if name and (ROOT / name).is_file())


def lowest() -> tuple[str, ...]:
    """The lowest version that the project says it works with, of each of its dependencies."""
    found = []
    for text in PROJECT["dependencies"]:
        requirement = Requirement(text)
        (bound,) = (s.version for s in requirement.specifier if s.operator == ">=")
        found.append(f"{requirement.name}=={bound}")
    return tuple(found)


def pythons() -> dict[str, str]:
    """Every Python of this machine that the project supports, by version: this one, others found.

    The environment variable TRMS_PYTHONS names more, parted by colons.
    """
    named = os.environ.get("TRMS_PYTHONS", "").split(":")
    found = {}
    for candidate in [sys.executable, *named, *(f"python3.{n}" for n in range(11, 20))]:
        path = shutil.which(candidate) if candidate else None
        if path is None:
            continue
        told = "import sys; print('%d.%d' % sys.version_info[:2], sys.version_info >= (3, 11))"
        done = subprocess.run([path, "-c", told], capture_output=True, text=True)
        version, _, enough = done.stdout.strip().partition(" ")
        if enough == "True":
            found.setdefault(version, path)
    return found
