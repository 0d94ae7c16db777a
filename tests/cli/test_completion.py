"""Tab completion, asked in a real bash."""

import shlex
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.cli.terminal import Screen
from tests.program import INSTALLED
from trms_cli.commands.completion.suggestions import suggest

needs_bash = pytest.mark.skipif(shutil.which("bash") is None, reason="there is no bash here")


@pytest.fixture
def replies(tmp_path: Path):
    """What bash's completion function puts into COMPREPLY for an unfinished line."""

    def ask(line: str) -> list[str]:
        script = (
            f"PATH={INSTALLED.parent}:$PATH\n"
            "source <(trms completion bash)\n"
            f"COMP_LINE={shlex.quote(line)}; COMP_POINT=${{#COMP_LINE}}\n"
            "COMP_WORDS=(trms); _trms_complete\n"
            'for reply in "${COMPREPLY[@]}"; do printf "%s\\n" "$reply"; done\n'
        )
        command = ["bash", "--norc", "-c", script]
        result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=60)
        assert result.stderr == ""
        return result.stdout.splitlines()

    return ask


@needs_bash
class TestBash:
    @pytest.mark.parametrize(
        ("line", "among"),
        [
            ("trms ", "run"),
            ("trms run --c", "--config-dir"),
            ("trms run mod", "model="),
            ("trms run model=newt", "newtonian_full"),
            ("trms list model newt", "newtonian_full"),
        ],
    )
    def test_of_many(self, replies, line, among):
        assert among in replies(line)

    @pytest.mark.parametrize(
        ("line", "all_of_them"),
        [
            ("trms doc", ["doctor"]),
            ("trms list --js", ["--json"]),
            ("trms list mod", ["model"]),
            ("trms run sim.du", ["sim.duration="]),
            ("trms run picture=t", ["true"]),
            ("trms run ref=square signal@ref.alpha_v=si", ["sine"]),
            ("trms export run.mcap --format ", ["csv", "parquet", "mat", "foxglove"]),
            ("trms nope ", []),
            ("trms run --config-dir /nowhere controller=", []),
        ],
    )
    def test_of_few(self, replies, line, all_of_them):
        assert replies(line) == all_of_them

    def test_several_effects(self, replies, lab, tmp_path):
        own = tmp_path / "own"
        lab.rename(own)
        assert set(replies("trms run --config-dir own effect=[")) >= {"[late", "[sticky"}
        assert replies("trms run --config-dir own effect=[late,sti") == ["[late,sticky"]
        assert replies("trms run --config-dir own effect=[late] effect.late.g") == [
            "effect.late.gain="
        ]

    def test_files(self, replies, tmp_path):
        (tmp_path / "recording.csv").touch()
        (tmp_path / "records").mkdir()
        assert set(replies("trms import rec")) == {"recording.csv", "records/"}


@needs_bash
def test_a_press_of_tab_in_an_interactive_bash(tmp_path):
    stand_in = tmp_path / "trms"
    stand_in.write_text(
        f'#!/bin/sh\n[ "$1" = completion ] && exec {INSTALLED} "$@"\nprintf "<%s>" "$@"; echo\n'
    )
    stand_in.chmod(0o755)
    settings = {"PS1": "$ ", "TERM": "dumb", "PATH": f"{tmp_path}:/usr/bin:/bin"}
    shell = Screen(["bash", "--norc", "--noprofile", "-i"], tmp_path, **settings)
    try:
        shell.type(b"source <(trms completion bash); echo loa''ded\n")
        assert shell.read(30.0, b"loaded"), shell.lines
        shell.type(b"trms run ref=square signal@ref.\tv=si\t disturbance@pl\tya\t seed=2\n")
        assert shell.read(30.0, b"seed=2>"), shell.lines
        shell.type(b"trms run sim.dur\t5 model=newtonian_f\t 'effect=[yaw_cou\t] seed=1\n")
        assert shell.read(30.0, b"seed=1>"), shell.lines  # bash closes the quote that was opened
    finally:
        shell.close()
    placed_choices = b"<signal@ref.alpha_v=sine><disturbance@plant.disturbances=yaw_push>"
    assert b"<ref=square>" + placed_choices + b"<seed=2>" in shell.shown
    choices = b"<model=newtonian_full><effect=[yaw_coulomb_friction]>"
    assert b"<run><sim.duration=5>" + choices + b"<seed=1>" in shell.shown


@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_the_other_shells_accept_their_script(trms, shell, tmp_path):
    script = trms("completion", shell).stdout
    assert "trms completion" in script or "completion --query" in script
    if shutil.which(shell):
        file = tmp_path / "script"
        file.write_text(script)
        assert subprocess.run([shell, "-n", str(file)], check=False).returncode == 0


def test_unknown_shell(refused):
    refused("completion", "tcsh", words="bash, zsh, fish")


def test_suggestions_never_raise_on_a_broken_yaml(lab):
    (lab / "controller" / "own.yaml").write_text("a: [1\nb: 2\n")
    folder = str(lab).replace(" ", "\\ ")
    assert suggest(f"trms run --config-dir {folder} controller=own controller.") == []
