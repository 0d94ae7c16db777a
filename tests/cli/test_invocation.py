"""What the program tells to type next can be typed where it stands."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from trms_cli.core.invocation import program


@pytest.fixture
def called(monkeypatch, tmp_path):
    """Call a made-up program in `tmp_path` as ``argv0``, with these folders on the path."""
    script = tmp_path / "my venv" / "trms"
    script.parent.mkdir()
    script.write_text("#!/bin/sh\n")
    script.chmod(0o755)
    monkeypatch.chdir(tmp_path)

    def call(argv0: str, *path: Path) -> str:
        monkeypatch.setattr(sys, "argv", [argv0])
        monkeypatch.setenv("PATH", os.pathsep.join(map(str, path)))
        return program()

    return call


def test_found_on_the_path_it_has_its_name(called, tmp_path):
    folder = tmp_path / "my venv"
    assert called(str(folder / "trms"), folder) == "trms"


def test_not_on_the_path_it_is_called_again_as_it_was(called):
    assert called("my venv/trms") == "'my venv/trms'"


def test_another_program_of_this_name_on_the_path_is_another(called, tmp_path):
    other = tmp_path / "bin" / "trms"
    other.parent.mkdir()
    other.write_text("#!/bin/sh\n")
    other.chmod(0o755)
    assert called("my venv/trms", other.parent) == "'my venv/trms'"


def test_as_a_module_it_is_called_as_one(called):
    assert called("somewhere/trms_cli/__main__.py").endswith(" -m trms_cli")


def test_called_by_other_programs_it_has_its_name(called):
    assert called("pytest") == "trms"


def test_the_commands_after_a_run_can_be_typed(executable, tmp_path):
    here = os.path.relpath(executable, tmp_path)
    environment = os.environ | {"PATH": "/usr/bin:/bin", "NO_COLOR": "1"}
    words = ["run", "controller=pid", "sim.duration=1", "picture=false", "out=o"]
    run = subprocess.run(
        [here, *words], cwd=tmp_path, env=environment, capture_output=True, text=True, check=True
    )
    line = next(line for line in run.stdout.splitlines() if line.startswith("next "))
    command = shlex.split(line.removeprefix("next"))
    assert command == [here, "score", "o/run.mcap"]
    again = subprocess.run(
        command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True
    )
    assert "\n1 s, completed" in again.stdout  # as long as the run was
    assert "1 s at 50 Hz simulated" in run.stdout


def test_the_first_page_is_typed_alike(executable, tmp_path):
    here = os.path.relpath(executable, tmp_path)
    environment = os.environ | {"PATH": "/usr/bin:/bin"}
    page = subprocess.run(
        [here], cwd=tmp_path, env=environment, capture_output=True, text=True, check=True
    )
    assert f"  {here} run --help" in page.stdout
