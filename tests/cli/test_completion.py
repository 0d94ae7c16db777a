"""Tab completion, asked in a real bash."""

from __future__ import annotations

import os
import pty
import select
import shutil
import subprocess
import time
from pathlib import Path

import pytest

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
            f"COMP_LINE={_quoted(line)}; COMP_POINT=${{#COMP_LINE}}\n"
            "COMP_WORDS=(trms); _trms_complete\n"
            'for reply in "${COMPREPLY[@]}"; do printf "%s\\n" "$reply"; done\n'
        )
        result = subprocess.run(
            ["bash", "--norc", "-c", script],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            timeout=60,
        )
        assert result.stderr == ""
        return result.stdout.splitlines()

    return ask


def _quoted(text: str) -> str:
    return "'" + text.replace("'", "'\\''") + "'"


@needs_bash
class TestBash:
    """The function that bash calls."""

    def test_commands(self, replies):
        assert "run" in replies("trms ")
        assert replies("trms doc") == ["doctor"]

    def test_options(self, replies):
        assert "--config-dir" in replies("trms run --c")
        assert replies("trms list --js") == ["--json"]

    def test_groups_options_and_keys(self, replies):
        assert "model=" in replies("trms run mod")
        assert "newtonian_full" in replies("trms run model=newt")
        assert replies("trms run sim.du") == ["sim.duration="]
        assert replies("trms run picture=t") == ["true"]

    def test_places_of_nested_choices(self, replies):
        assert replies("trms run ref=square signal@ref.alpha_v=si") == ["sine"]

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

    def test_words_of_an_option(self, replies):
        assert replies("trms export run.mcap --format ") == ["csv", "parquet", "mat", "foxglove"]

    def test_list(self, replies):
        assert replies("trms list mod") == ["model"]
        assert "newtonian_full" in replies("trms list model newt")

    def test_nothing_for_nonsense(self, replies):
        assert replies("trms nope ") == []
        assert replies("trms run --config-dir /nowhere controller=") == []


@needs_bash
def test_a_press_of_tab_in_an_interactive_bash(tmp_path):
    stand_in = tmp_path / "trms"
    stand_in.write_text(
        f'#!/bin/sh\n[ "$1" = completion ] && exec {INSTALLED} "$@"\nprintf "<%s>" "$@"; echo\n'
    )
    stand_in.chmod(0o755)
    master, slave = pty.openpty()
    environment = os.environ | {"PS1": "$ ", "TERM": "dumb", "PATH": f"{tmp_path}:/usr/bin:/bin"}
    shell = subprocess.Popen(
        ["bash", "--norc", "--noprofile", "-i"],
        stdin=slave,
        stdout=slave,
        stderr=slave,
        cwd=tmp_path,
        env=environment,
        start_new_session=True,
    )
    os.close(slave)
    try:
        os.write(master, b"source <(trms completion bash); echo loa''ded\n")
        _read_until(master, "loaded")
        os.write(master, b"trms run ref=square signal@ref.\tv=si\t disturbance@pl\tya\t seed=2\n")
        placed = _read_until(master, "seed=2>")
        os.write(master, b"trms run sim.dur\t5 model=newtonian_f\t 'effect=[yaw_cou\t] seed=1\n")
        output = _read_until(master, "seed=1>")  # bash closes the quote that was opened
    finally:
        shell.kill()
        shell.wait()
        os.close(master)
    placed_choices = "<signal@ref.alpha_v=sine><disturbance@plant.disturbances=yaw_push>"
    assert f"<ref=square>{placed_choices}<seed=2>" in placed
    choices = "<model=newtonian_full><effect=[yaw_coulomb_friction]>"
    assert f"<run><sim.duration=5>{choices}<seed=1>" in output


def _read_until(descriptor: int, words: str, seconds: float = 30.0) -> str:
    seen = ""
    end = time.monotonic() + seconds
    while words not in seen and time.monotonic() < end:
        if select.select([descriptor], [], [], 0.2)[0]:
            seen += os.read(descriptor, 4096).decode("utf-8", "replace")
    assert words in seen, seen
    return seen


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
