"""The dispatcher: what every command has in common, and what is told to be typed next."""

import ast
import json
import os
import re
import shlex
import subprocess
import sys
import types
from pathlib import Path
from unittest.mock import Mock

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
    text = trms(flag).stdout
    assert "usage: trms COMMAND" in text and "--debug" in text


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
        own = re.split(r"\nchoices", result.stdout)[0]  # lists fold on a terminal
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
    text = trms("run", "--help-all").stdout
    assert all(words in text for words in ("* square", "newtonian_full", "sample_time: 0.02"))


@pytest.mark.parametrize("name", cli.COMMANDS)
def test_help_fits_a_screen_and_names_the_groups(trms, name):
    text = trms(name, "--help").stdout
    assert len(text.splitlines()) <= 50
    if hasattr(cli.load_command(name), "COMPOSES"):
        assert f"trms {name} --help-all" in text
        assert "model=newtonian" in text or name in ("excite", "sweep")


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

    @pytest.fixture
    @staticmethod
    def said_of(monkeypatch, capsys):
        """The exit code and the message of a command that raises."""

        def run(error: BaseException) -> tuple[int, str]:
            command = types.SimpleNamespace(main=Mock(side_effect=error))
            monkeypatch.setattr(cli, "load_command", lambda name: command)
            return cli.main(["run"]), capsys.readouterr().err

        return run

    def test_our_error(self, said_of):
        error = TrmsError("it was -1", where="controller.horizon", remedy="give 1 or more")
        told = "error  it was -1\n   in  controller.horizon\n   do  give 1 or more\n"
        assert said_of(error) == (2, told)

    def test_interruption(self, said_of):
        code, told = said_of(KeyboardInterrupt())
        assert code == 130 and "interrupted" in told

    def test_bug(self, said_of):
        code, told = said_of(ZeroDivisionError("oops"))
        assert code == cli.EXIT_BUG and "Traceback" not in told
        for words in ("ZeroDivisionError: oops", "bug in trms", "trms --debug run"):
            assert words in told

    def test_colour_only_when_asked_for_and_no_line_beyond_the_screen(self):
        error = TrmsError("word " * 100, where="key", remedy="name, " * 100)
        plain = cli.describe_error(error, colour=False)
        assert "\033[" not in plain and "\033[" in cli.describe_error(error, colour=True)
        assert max(map(len, plain.splitlines())) <= 92


class TestList:
    def test_groups_with_descriptions_also_as_json(self, trms):
        groups = trms("list").stdout
        assert re.search(r"model +\d+  what the controller and the observer believe", groups)
        assert "newtonian_full" not in groups and len(groups.splitlines()) <= 50
        shown = trms("list", "--all").stdout
        assert "model  (what the controller and the observer believe)" in shown
        assert "newtonian_full" in shown
        document = json.loads(trms("list", "--json").stdout)
        assert document["schema"] == "trms.list/1"
        assert all(group["about"] for group in document["groups"].values())
        options = document["groups"]["model"]["options"]
        assert "newtonian" in [option["name"] for option in options]
        assert all(option["summary"] for option in options)

    def test_one_option_with_its_comments(self, trms):
        text = trms("list", "model", "newtonian").stdout
        assert "_target_:" in text and "# " in text

    def test_own_folder(self, trms, lab):
        text = trms("list", "controller", "--config-dir", str(lab)).stdout
        assert "the user's own controller" in text and str(lab) in text

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
    def test_this_machine_is_ready(self, trms):
        assert trms("doctor").stdout.endswith("\nready\n")
        document = json.loads(trms("doctor", "--json").stdout)
        found = {finding["what"] for finding in document["findings"]}
        assert document["usable"] is True and {"Python", "C compiler", "cache", "disk"} <= found
        trms("doctor", "--jsn", code=2)

    @pytest.mark.parametrize(
        ("environment", "words"),
        [
            ({"CC": "/nowhere/cc"}, "install a C compiler"),
            ({"CC": "false"}, "does not build a generated function"),
            ({"TRMS_CACHE": "file/cache"}, "cannot be written"),
        ],
    )
    def test_what_is_missing_is_a_note(self, program, tmp_path, environment, words):
        (tmp_path / "file").touch()
        assert words in program("doctor", **environment).stdout


@pytest.fixture
def called(monkeypatch, tmp_path):
    """Call a made-up program in `tmp_path` as ``argv0``, with these folders on the path."""
    for folder in ("my venv", "bin"):
        script = tmp_path / folder / "trms"
        script.parent.mkdir()
        script.write_text("#!/bin/sh\n")
        script.chmod(0o755)
    monkeypatch.chdir(tmp_path)

    def call(argv0: str, *path: Path) -> str:
        monkeypatch.setattr(sys, "argv", [argv0])
        monkeypatch.setenv("PATH", os.pathsep.join(map(str, path)))
        return program()

    return call


def test_it_is_called_again_as_it_was(called, tmp_path):
    found = tmp_path / "my venv"
    assert called(str(found / "trms"), found) == "trms"
    assert called("my venv/trms") == "'my venv/trms'"
    # another program of this name on the path is another
    assert called("my venv/trms", tmp_path / "bin") == "'my venv/trms'"
    assert called("somewhere/trms_cli/__main__.py").endswith(" -m trms_cli")
    assert called("pytest") == "trms"  # by other programs


def test_the_commands_after_a_run_and_on_the_first_page_can_be_typed(tmp_path):
    here = os.path.relpath(INSTALLED, tmp_path)
    environment = os.environ | {"PATH": "/usr/bin:/bin", "NO_COLOR": "1"}

    def typed(*words: str) -> str:
        return subprocess.run(
            words, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True
        ).stdout

    shown = typed(here, "run", "controller=pid", "sim.duration=1", "picture=false", "out=o")
    assert "1 s at 50 Hz simulated" in shown
    line = next(line for line in shown.splitlines() if line.startswith("next "))
    command = shlex.split(line.removeprefix("next"))
    assert command == [here, "score", "o/run.mcap"]
    assert "\n1 s, completed" in typed(*command)  # as long as the run was
    assert f"  {here} run --help" in typed(here)


def test_a_file_that_is_not_there_is_answered_with_the_nearest(refused, tmp_path):
    (tmp_path / "monday").mkdir()
    (tmp_path / "monday" / "rig.csv").write_text("t[s],u_v[V],alpha_v[rad]\n")
    refused("score", str(tmp_path / "monday" / "rigg.csv"), words="did you mean")
    refused("score", str(tmp_path / "mondai" / "rig.csv"), words=str(Path("monday", "rig.csv")))
    refused("score", str(tmp_path / "xyz"), words="check the path")


def test_a_missing_recording_is_asked_for_with_one_that_lies_here(refused, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    refused("diagnose", words="add real=rig.csv")
    (tmp_path / "monday.mcap").touch()
    refused("diagnose", words="add real=monday.mcap")
