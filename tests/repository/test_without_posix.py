"""What the first day needs goes without the modules that only POSIX has (docs/install.md)."""

import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest

from trms_cli.core.errors import ConfigurationError
from trms_cli.plants.link.transport import open_serial
from trms_cli.sweeps.record import Claim, is_alive

PROGRAM = Path(__file__).with_name("without_posix.py")

#: In the order of a first day; the later ones read what the earlier ones left.
COMMANDS = """
--help
list controller
run sim.duration=1 picture=false out=a
run controller=pid sim.duration=1 out=b
run --from b sim.duration=1 picture=false out=c
score a
compare a b
runs --in .
watch a --once
export b
import b/run.csv
report a
stability study=equilibria out=rest
doctor
run -m controller=pid,lqr sim.duration=1 out=s
sweep status s
"""


def typed(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"TRMS_RUNS": str(folder / ".runs"), "NO_COLOR": "1"}
    return subprocess.run(
        [sys.executable, str(PROGRAM), *words],
        cwd=folder, env=environment, capture_output=True, text=True, timeout=120,
    )  # fmt: skip


@pytest.mark.slow
def test_a_first_day_goes_without_them(tmp_path):
    for line in COMMANDS.strip().splitlines():
        done = typed(tmp_path, *line.split())
        assert done.returncode == 0, f"trms {line}\n{done.stdout}{done.stderr}"
    assert (tmp_path / ".runs").is_dir()  # runs told of themselves


def test_a_run_goes_without_them_and_what_cannot_says_so(tmp_path):
    done = typed(tmp_path, "run", "controller=pid", "sim.duration=1", "picture=false", "out=a")
    assert done.returncode == 0, done.stderr
    done = typed(tmp_path, "rig", "serve", "serial=true", "duration=1")
    assert done.returncode == 2 and "no pseudo-terminals" in done.stderr, done.stderr


def test_no_signal_goes_where_it_would_end_a_process(monkeypatch):
    sent = []
    claim = Claim(1, platform.node(), os.getpid(), "")
    with monkeypatch.context() as patch:
        patch.setattr(os, "kill", lambda *words: sent.append(words))
        patch.setattr(os, "name", "nt")
        assert is_alive(claim) is None
    assert not sent and is_alive(claim)


def test_a_serial_line_is_refused_with_what_takes_its_place(monkeypatch):
    with monkeypatch.context() as patch, pytest.raises(ConfigurationError) as refused:
        patch.setattr(os, "name", "nt")
        open_serial("COM3", 115200)
    assert "plant=udp" in str(refused.value.remedy)
