"""A rig in a process of its own, driven over UDP: however the program ends, the rig is at rest.

Order and landing are judged, not milliseconds: the machine that tests is busy.
"""

import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from trms_cli import read_log
from trms_cli.core.compilation import compiler

TRMS = [sys.executable, "-m", "trms_cli"]
#: What keeps a machine that is busy with other tests from landing the rig.
PATIENT = ("plant.watchdog=5", "plant.lost_after=20", "sim.late.land_after=null")


class Served:
    """``trms rig serve``, with what it says."""

    def __init__(self, folder: Path, *words: str) -> None:
        self.said = folder / "served.txt"
        command = [*TRMS, "rig", "serve", "port=0", "watchdog=5", "duration=600", *words]
        with self.said.open("w") as stream:
            self.process = subprocess.Popen(command, stdout=stream, stderr=stream)
        wait_for(lambda: "is served" in self.text or self.process.poll() is not None)
        port = re.search(r"plant\.port=(\d+)", self.text)
        assert port, self.text
        self.port = port[1]

    @property
    def text(self) -> str:
        return self.said.read_text()

    def end(self) -> str:
        """Its last words: which command is in force."""
        self.process.send_signal(signal.SIGINT)
        self.process.wait(60)
        return self.text.splitlines()[-1]


def wait_for(what: Callable[[], bool], seconds: float = 120.0) -> None:
    end = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.05)


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Served]:
    rig = Served(tmp_path)
    yield rig
    if rig.process.poll() is None:
        rig.process.kill()
        rig.process.wait()


def driving(rig: Served, out: Path, *words: str) -> subprocess.Popen[str]:
    """``trms run`` over the wire, once the rig is armed and has moved a little."""
    words = (f"plant.port={rig.port}", "plant.arm=true", *PATIENT, *words)
    command = [*TRMS, "run", "plant=udp", *words, "sim.duration=300", "picture=false"]
    process = subprocess.Popen(
        [*command, f"out={out}"], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    wait_for(lambda: "armed" in rig.text or process.poll() is not None)
    time.sleep(1.0)
    return process


@pytest.mark.slow
@pytest.mark.parametrize(
    ("controller", "number", "code"),
    [
        ("nmpc", signal.SIGINT, 130),  # IPOPT used to swallow it
        ("newton_mpc", signal.SIGINT, 130),
        ("robust_mpc", signal.SIGTERM, 143),
        ("pid", signal.SIGTERM, 143),
    ],
)
def test_a_signal_lands_the_rig(
    controller: str, number: signal.Signals, code: int, served: Served, tmp_path: Path
) -> None:
    if controller == "nmpc" and compiler() is None:
        pytest.skip("without a C compiler it takes too long")
    process = driving(served, tmp_path / "run", f"controller={controller}")
    process.send_signal(number)
    said, _ = process.communicate(timeout=120)
    assert process.returncode == code, said
    assert "interrupted at" in said
    log = read_log(tmp_path / "run")
    assert log.outcome == "interrupted"
    commands = log["/landing"].filter(like="u_")
    assert (commands.iloc[-1] == 0.0).all()
    assert commands.diff().abs().max().max() <= 0.02 + 1e-6  # a ramp of 1 V/s
    assert "watchdog" not in served.text
    assert served.text.splitlines()[-1].endswith("disarmed")
    assert served.end().endswith("u_v 0 V, u_h 0 V")


@pytest.mark.slow
def test_the_rig_lands_itself_where_the_program_is_killed(served: Served, tmp_path: Path) -> None:
    process = driving(served, tmp_path / "run", "controller=pid")
    process.kill()
    process.wait()
    wait_for(lambda: "watchdog: no command" in served.text)
    assert served.end().endswith("u_v 0 V, u_h 0 V")


@pytest.mark.slow
def test_a_cable_that_is_pulled_ends_the_run(tmp_path: Path) -> None:
    rig = Served(tmp_path, "wire.pulled_at=25")
    words = (f"plant.port={rig.port}", "plant.arm=true", "plant.watchdog=5", "controller=pid")
    done = subprocess.run(
        [*TRMS, "run", "plant=udp", *words, "sim.duration=300", f"out={tmp_path / 'run'}"],
        capture_output=True,
        text=True,
        timeout=200,
    )
    assert done.returncode == 1
    assert "has not answered" in done.stderr and "cable" in done.stderr
    wait_for(lambda: "watchdog" in rig.text)
    assert rig.end().endswith("u_v 0 V, u_h 0 V")
    log = read_log(tmp_path / "run")
    assert log.outcome == "failed"
