"""The dispatcher: what every command has in common, and what is told to be typed next."""

from __future__ import annotations

import ast
import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from tests.program import INSTALLED
from trms_cli import __version__, cli
from trms_cli.core.errors import TrmsError
from trms_cli.core.invocation import program


def test_alone_it_prints_the_picture_the_commands_and_what_to_try(trms):
    result = trms()
    assert "controller ──u──▶ rig (the plant)" in result.stdout
    assert all(f"  {name} " in result.stdout for name in cli.COMMANDS)
    tried = result.stdout.partition("\ntry\n")[2].splitlines()
    assert [line.split()[1] for line in tried] == ["run", "list", "run"]


@pytest.mark.parametrize("flag", ["-h", "--help"])
def test_help(trms, flag):
    result = trms(flag)
    assert "usage: trms COMMAND" in result.stdout
    assert "--debug" in result.stdout


@pytest.mark.parametrize("words", [[str(INSTALLED)], [sys.executable, "-m", "trms_cli"]])
def test_version_of_the_script_and_of_the_module(words):
    result = subprocess.run([*words, "--version"], capture_output=True, text=True)
    assert result.stdout == f"trms {__version__}\n"


@pytest.mark.parametrize("name", cli.COMMANDS)
def test_every_command_has_help_and_the_summary_that_the_table_shows(trms, name):
    module = cli.load_command(name)
    assert cli.COMMANDS[name] == module.SUMMARY
    for argv in ((name, "--help"), ("help", name)):
        result = trms(*argv)
        assert f"trms {name}" in result.stdout
        assert result.stderr == ""
        own = re.split(r"\nchoices ", result.stdout)[0]  # lists fold on a terminal
        assert max(map(len, own.splitlines())) <= 100


def test_every_module_with_a_summary_is_in_the_table():
    folder = Path(cli.__file__).parent / "commands"
    files = {file.stem: file for file in folder.glob("*.py")}
    files |= {file.parent.name: file for file in folder.glob("*/__init__.py")}
    with_summary = {
        name.rstrip("_").replace("_", "-")
        for name, file in files.items()
        for node in ast.parse(file.read_text(encoding="utf-8")).body
        if isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == "SUMMARY"
    }
    assert with_summary == set(cli.COMMANDS)


def test_the_help_of_run_shows_the_choices(trms):
    text = trms("run", "--help").stdout
    assert "* square" in text
    assert "newtonian_full" in text
    assert "sample_time: 0.02" in text


@pytest.mark.parametrize(
    ("typed", "hint"),
    [
        ("rnu", "did you mean `trms run`?"),
        ("zzz", "there are: run, "),
        ("controller=pid", "`trms run controller=pid`"),
        ("--nope", "there are: run, "),
    ],
)
def test_unknown_command(refused, typed, hint):
    refused(typed, words=[repr(typed), hint])


def test_debug_shows_the_trace_of_an_error_that_is_a_message_otherwise(program):
    quiet, loud = program("list", "nope", code=2), program("list", "nope", "--debug")
    assert "Traceback" not in quiet.stderr
    assert "Traceback" in loud.stderr


def test_a_closed_pipe_is_quiet():
    # the reader ends before the writer starts
    result = subprocess.run(
        f"'{INSTALLED}' list --json | true",
        shell=True,
        capture_output=True,
        text=True,
        executable="/bin/bash",
    )
    assert result.stderr == ""


def test_a_terminal_without_greek_gets_question_marks_not_a_traceback(program):
    result = program(PYTHONIOENCODING="ascii", PYTHONUTF8="0", LC_ALL="C")
    assert "controller ??u???" in result.stdout


class TestErrors:
    """What the dispatcher makes of exceptions."""

    @staticmethod
    def run(monkeypatch, error):
        class Command:
            @staticmethod
            def main(argv):
                raise error

        monkeypatch.setattr(cli, "load_command", lambda name: Command)
        return cli.main(["run"])

    def test_our_error(self, monkeypatch, capsys):
        error = TrmsError("it was -1", where="controller.horizon", remedy="give 1 or more")
        assert self.run(monkeypatch, error) == 2
        assert capsys.readouterr().err == (
            "error  it was -1\n   in  controller.horizon\n   do  give 1 or more\n"
        )

    def test_interruption(self, monkeypatch, capsys):
        assert self.run(monkeypatch, KeyboardInterrupt()) == 130
        assert "interrupted" in capsys.readouterr().err

    def test_bug(self, monkeypatch, capsys):
        assert self.run(monkeypatch, ZeroDivisionError("oops")) == cli.EXIT_BUG
        message = capsys.readouterr().err
        assert "ZeroDivisionError: oops" in message
        assert "bug in trms" in message
        assert "trms --debug run" in message
        assert "Traceback" not in message

    def test_colour_only_when_asked_for(self):
        error = TrmsError("wrong", where="here", remedy="that")
        assert "\033[" not in cli.describe_error(error, colour=False)
        assert "\033[" in cli.describe_error(error, colour=True)

    def test_long_texts_stay_on_the_screen(self):
        error = TrmsError("word " * 100, where="key", remedy="name, " * 100)
        assert max(map(len, cli.describe_error(error, colour=False).splitlines())) <= 92


class TestList:
    """``trms list``."""

    def test_groups_with_descriptions(self, trms):
        result = trms("list")
        assert "model  (what the controller and the observer believe)" in result.stdout
        assert "newtonian_full" in result.stdout

    def test_every_group_has_a_heading(self, trms):
        groups = json.loads(trms("list", "--json").stdout)["groups"]
        assert [name for name, group in groups.items() if not group["about"]] == []

    def test_json_says_the_same(self, trms):
        document = json.loads(trms("list", "--json").stdout)
        assert document["schema"] == "trms.list/1"
        options = document["groups"]["model"]["options"]
        assert "newtonian" in [option["name"] for option in options]
        assert all(option["summary"] for option in options)

    def test_one_option_with_its_comments(self, trms):
        text = trms("list", "model", "newtonian").stdout
        assert "_target_:" in text
        assert "# " in text

    def test_own_folder(self, trms, lab):
        text = trms("list", "controller", "--config-dir", str(lab)).stdout
        assert "the user's own controller" in text
        assert str(lab) in text

    @pytest.mark.parametrize(
        ("argv", "hint"),
        [
            (["modle"], "did you mean model?"),
            (["model", "newtonain"], "did you mean newtonian?"),
            (["--jsn"], "usage: trms list"),
            (["model", "newtonian", "again"], "usage: trms list"),
        ],
    )
    def test_what_is_not_there(self, refused, argv, hint):
        refused("list", *argv, words=hint)


class TestDoctor:
    """``trms doctor``."""

    def test_this_machine_is_ready(self, trms):
        result = trms("doctor")
        assert result.stdout.endswith("\nready\n")

    def test_json(self, trms):
        document = json.loads(trms("doctor", "--json").stdout)
        assert document["usable"] is True
        assert {"Python", "C compiler", "cache", "disk"} <= {
            finding["what"] for finding in document["findings"]
        }

    def test_without_a_compiler_it_is_a_note_with_a_remedy(self, program):
        result = program("doctor", CC="/nowhere/cc")
        assert "install a C compiler" in result.stdout

    def test_a_compiler_that_does_not_work(self, program):
        assert "does not build a generated function" in program("doctor", CC="false").stdout

    def test_unwritable_cache(self, program, tmp_path):
        (tmp_path / "file").touch()
        result = program("doctor", TRMS_CACHE=str(tmp_path / "file" / "cache"))
        assert "cannot be written" in result.stdout

    def test_unknown_option(self, trms):
        trms("doctor", "--jsn", code=2)


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


def test_the_commands_after_a_run_can_be_typed(tmp_path):
    here = os.path.relpath(INSTALLED, tmp_path)
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


def test_the_first_page_is_typed_alike(tmp_path):
    here = os.path.relpath(INSTALLED, tmp_path)
    environment = os.environ | {"PATH": "/usr/bin:/bin"}
    page = subprocess.run(
        [here], cwd=tmp_path, env=environment, capture_output=True, text=True, check=True
    )
    assert f"  {here} run --help" in page.stdout
