"""The first hour of a stranger, in its order, with the program that a user installs.

A clone and ``make run``; then README, tutorial, a table of their own, a controller of their own and
a diagnosis with its page, typed as they stand, each in a folder that is not the checkout.
"""

import os
import shlex
import subprocess
from pathlib import Path

import pytest

from tests.docs.test_docs import ROOT, shortened, type_page
from tests.program import Done

from .conftest import Environment, pythons

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("newest")]

#: Pages, and whether a run in them may end soon; what they print is held where it may not.
PAGES = {
    "README.md": True,
    "docs/tutorial.md": False,
    "docs/how-to/own-rig-from-csv.md": True,
    "docs/how-to/own-controller.md": True,
    "docs/diagnose.md": False,
}


@pytest.fixture(scope="module")
def environment(environment_with) -> Environment:
    environment = environment_with(pythons()[min(pythons())], ())
    # `make setup`, by which README and tutorial begin, installs it too: frames of runs need it
    environment.run("python", "-m", "pip", "install", "--quiet", "pandas")
    return environment


def test_make_run_flies_the_square_in_a_clone(environment, tmp_path):
    clone, ready = tmp_path / "trms", environment.python.parents[1] / ".ready"
    subprocess.run(["git", "clone", "--quiet", str(ROOT), str(clone)], check=True)
    ready.touch()  # the environment is there; how it is made is what CI begins with
    command = ["make", "run", f"VENV={ready.parent}"]
    # what was typed for `make package` is not for this one
    own = ("ARGS", "MFLAGS", "MAKEFLAGS", "MAKELEVEL", "MAKEOVERRIDES")
    env = {name: value for name, value in os.environ.items() if name not in own}
    done = subprocess.run(command, cwd=clone, env=env, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    (log,) = clone.glob("outputs/**/run.mcap")
    assert (log.parent / "score.json").is_file() and "RMSE" in done.stdout


@pytest.mark.parametrize("name", PAGES)
def test_a_page_works_as_typed(environment, tmp_path, name):
    programs = f"{environment.python.parent}{os.pathsep}{os.environ['PATH']}"
    outside = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV")}
    variables = {"PATH": programs, "COLUMNS": "92", "NO_COLOR": "1", "TRMS_ALLOW": ""}

    def typed(command: str, folder: Path, settings: Path | None = None) -> Done:
        home = {"XDG_CONFIG_HOME": str((settings or folder) / ".settings")}
        done = subprocess.run(
            ["bash", "-c", command],
            cwd=folder,
            env=outside | variables | home,
            capture_output=True,
            text=True,
            encoding="utf-8",
            timeout=600,
        )
        assert "Traceback" not in done.stderr, f"{shlex.quote(command)}\n{done.stderr}"
        return Done(done.returncode, done.stdout, done.stderr)

    (tmp_path / "docs").symlink_to(ROOT / "docs")
    assert type_page(name, tmp_path, shortened if PAGES[name] else str, typed) >= 1
