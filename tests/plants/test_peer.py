"""The other side of the wire: our own, and the one in C of the documentation, held to one contract.

The C program shares no code with this one. Order and landing are judged, no milliseconds.
"""

import math
import os
import re
import shutil
import signal
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.program import INSTALLED, wait_for
from trms_cli.plants.link.frames import Frame, Kind, RigStatus, decode
from trms_cli.recordings.log_reader import read_log

SOURCE = Path(__file__).resolve().parents[2] / "docs" / "rig" / "peer.c"
COMPILER = os.environ.get("CC") or shutil.which("cc") or ""
posix = pytest.mark.skipif(os.name != "posix", reason="the peer speaks POSIX sockets")
compiled = pytest.mark.skipif(not COMPILER, reason="no C compiler")
pytestmark = [posix, compiled]


@pytest.fixture(scope="session")
def peer_program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The program of the documentation, compiled as it says, without a warning."""
    program = tmp_path_factory.mktemp("peer") / "peer"
    words = ["-std=c99", "-O2", "-Wall", "-Wextra", "-pedantic", "-Werror"]
    subprocess.run([COMPILER, *words, "-o", str(program), str(SOURCE), "-lm"], check=True)
    return program


@dataclass
class Rig:
    """A rig's computer that runs in a process of its own."""

    process: subprocess.Popen[bytes]
    port: int
    says: Path  #: What it prints

    def events(self) -> list[str]:
        """What has happened, without the times."""
        lines = self.says.read_text(encoding="utf-8").splitlines()
        return [line.split(" s  ", 1)[1].split(" (")[0] for line in lines if " s  " in line]

    def wait(self, event: str) -> list[str]:
        """All that has happened once something has."""
        return wait_for(lambda: event in self.events() and self.events())


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as line:
        line.bind(("127.0.0.1", 0))
        return int(line.getsockname()[1])


@pytest.fixture
def start(tmp_path: Path, peer_program: Path) -> Iterator[Callable[[str], Rig]]:
    """Start the C program, or ours."""
    rigs: list[Rig] = []

    def started(which: str) -> Rig:
        for attempt in range(5):  # somebody may have taken the port meanwhile
            port, says = free_port(), tmp_path / f"{which}{attempt}.txt"
            words = [str(peer_program), str(port)]
            if which == "serve":
                words = [str(INSTALLED), "rig", "serve", f"port={port}", "watchdog=0.5"]
            with says.open("wb") as stream:
                process = subprocess.Popen(
                    words, stdout=stream, stderr=subprocess.STDOUT, cwd=tmp_path
                )
            rigs.append(Rig(process, port, says))
            if re.search("listening|is served", wait_for(says.read_text)):
                return rigs[-1]
        raise AssertionError("no port was free")

    yield started
    for rig in rigs:
        rig.process.kill()
        rig.process.wait()


class Computer:
    """Speaks to a rig, one frame at a time."""

    def __init__(self, rig: Rig, session: int = 0x1234) -> None:
        self._line = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._line.connect(("127.0.0.1", rig.port))
        self._session = session

    def send(self, kind: int, sequence: int, *numbers: float, spoilt: bool = False) -> None:
        data = bytearray(Frame(kind, sequence, self._session, 7, numbers=numbers).encode())
        if spoilt:
            data[33] ^= 1
        self._line.send(bytes(data))

    def answer(self, patience: float = 2.0) -> Frame | None:
        self._line.settimeout(patience)
        try:
            return decode(self._line.recv(2048))
        except TimeoutError:
            return None

    def ask(self, kind: int, sequence: int, *numbers: float) -> Frame:
        self.send(kind, sequence, *numbers)
        answer = self.answer()
        assert answer is not None, f"no answer to {Kind(kind).name}"
        assert (answer.sequence, answer.session) == (sequence, self._session)
        return answer

    def __enter__(self) -> "Computer":
        return self

    def __exit__(self, *_: object) -> None:
        self._line.close()


both = pytest.mark.parametrize("which", ["peer", "serve"])


@both
def test_a_rig_keeps_to_the_contract(start, which):
    rig = start(which)
    with Computer(rig) as pc, Computer(rig, session=0x5678) as other:
        welcome = pc.ask(Kind.HELLO, 10, 0.02, 0.4, 2.0, 4.0)
        assert welcome.kind == Kind.WELCOME and len(welcome.numbers) >= 3
        assert welcome.numbers[:3] == pytest.approx((0.4, 2.0, 4.0))
        reading = pc.ask(Kind.READ, 11)
        assert reading.kind == Kind.READING and not reading.status & RigStatus.ARMED
        assert reading.numbers[:2] == pytest.approx((-0.62, 0.0), abs=0.01)
        # commands act once it is armed, each newer than the last, and only whole ones
        pc.send(Kind.COMMAND, 12, 1.0, 0.0)
        assert pc.ask(Kind.READ, 13).applied == 10
        assert RigStatus(pc.ask(Kind.ARM, 14).status) == RigStatus.ARMED
        for sequence, numbers, applied in (
            (20, (1.0, 0.5), 20),
            (19, (0.0, 0.0), 20),
            (20, (0.0, 0.0), 20),
            (22, (math.nan, 0.0), 20),
            (23, (1.0,), 20),
            (24, (99.0, -99.0), 24),
        ):
            pc.send(Kind.COMMAND, sequence, *numbers)
            assert pc.ask(Kind.READ, 30).applied == applied, (sequence, numbers)
        pc.send(Kind.COMMAND, 25, 0.0, 0.0, spoilt=True)
        other.send(Kind.COMMAND, 26, 0.0, 0.0)
        assert pc.ask(Kind.READ, 31).applied == 24
        # somebody else is not welcome while it is driven
        other.send(Kind.HELLO, 1, 0.02, 0.3)
        assert other.answer(0.2) is None
        status = RigStatus(pc.ask(Kind.DISARM, 32).status)
        assert not status & RigStatus.ARMED
        assert other.ask(Kind.HELLO, 2, 0.02, 0.3).kind == Kind.WELCOME
        pc.send(Kind.READ, 33)
        assert pc.answer(0.2) is None
    assert rig.events()[1:] == ["connected", "armed", "disarmed", "connected"]


@both
def test_a_rig_goes_to_its_safe_command_where_none_comes(start, which):
    rig = start(which)
    with Computer(rig) as pc:
        pc.ask(Kind.HELLO, 1, 0.02, 0.2)
        pc.ask(Kind.ARM, 2)
        pc.send(Kind.COMMAND, 3, 2.0, 0.0)
        wait_for(lambda: any("watchdog" in event for event in rig.events()))
        status = RigStatus(pc.ask(Kind.READ, 4).status)  # questions alone do not keep it armed
        assert status & RigStatus.WATCHDOG and not status & RigStatus.ARMED
        speed = pc.ask(Kind.READ, 5).numbers[2]  # of the main rotor, which runs down
        wait_for(lambda: pc.ask(Kind.READ, 6).numbers[2] < 0.3 * speed, seconds=10.0)
        assert RigStatus(pc.ask(Kind.ARM, 7).status) == RigStatus.ARMED  # it may be armed anew


@both
def test_sequence_numbers_begin_anew(start, which):
    rig = start(which)
    with Computer(rig) as pc:
        pc.ask(Kind.HELLO, 2**32 - 2)
        pc.ask(Kind.ARM, 2**32 - 1)
        pc.send(Kind.COMMAND, 1, 0.5, 0.0)
        assert pc.ask(Kind.READ, 2).applied == 1
        pc.send(Kind.COMMAND, 2**32 - 1, 0.5, 0.0)
        assert pc.ask(Kind.READ, 3).applied == 1


RUN = ["plant=udp", "plant.arm=true", "controller=pid", "picture=false"]


def test_a_run_drives_a_foreign_rig_and_lands_it(start, tmp_path):
    rig = start("peer")
    # a machine that is busy with other tests is late by more than a watchdog of 0.1 s
    patient = ("plant.watchdog=2", "plant.lost_after=2", "sim.late.land_after=null")
    words = ["run", *RUN, *patient, f"plant.port={rig.port}", "sim.duration=2", "out=there"]
    done = subprocess.run(
        [str(INSTALLED), *words], cwd=tmp_path, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    assert rig.events() == ["listening", "connected", "armed", "disarmed"]
    log = read_log(tmp_path / "there" / "run.mcap")
    assert log.outcome == "completed" and len(log.table("/command")) == 100
    pitch = log.table("/measurement").columns["alpha_v"]
    assert pitch[0] == pytest.approx(-0.62, abs=0.01) and pitch[-1] > -0.6  # it rose
    landing = log.table("/landing")
    assert landing.columns["u_v"][-1] == landing.columns["u_h"][-1] == 0.0
    steps = abs(landing.columns["u_v"][1:] - landing.columns["u_v"][:-1])
    assert steps.max() == pytest.approx(0.02)  # 1 V/s


def test_kill_9_leaves_a_rig_that_goes_to_its_safe_command_by_itself(start, tmp_path):
    rig = start("peer")
    words = ["run", *RUN, f"plant.port={rig.port}", "sim.duration=60", "out=there"]
    process = subprocess.Popen(
        [str(INSTALLED), *words],
        cwd=tmp_path,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        rig.wait("armed")
        time.sleep(1.0)
        assert rig.events()[-1] == "armed"
        process.send_signal(signal.SIGKILL)
        events = rig.wait("watchdog: safe command")
    finally:
        process.kill()
        process.wait()
    assert events == ["listening", "connected", "armed", "watchdog: safe command"]
    assert read_log(tmp_path / "there" / "run.mcap").outcome == "died"
