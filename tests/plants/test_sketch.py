"""The Arduino sketch of the documentation, compiled with a stand-in of the board, on a serial line.

It is driven through a pseudo-terminal by the same code as a real board. That the board's own
compiler takes it is not tested here.
"""

import os
import shutil
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.program import INSTALLED, wait_for
from trms_cli.plants.link.frames import Frame, Kind, RigStatus, decode
from trms_cli.plants.link.transport import StreamTransport

SKETCH = Path(__file__).resolve().parents[2] / "docs" / "rig" / "trms_rig" / "trms_rig.ino"
BOARD = Path(__file__).with_name("arduino") / "board.cpp"
COMPILER = os.environ.get("CXX") or shutil.which("c++") or ""
pytestmark = [
    pytest.mark.skipif(os.name != "posix", reason="no pseudo-terminals"),
    pytest.mark.skipif(not COMPILER, reason="no C++ compiler"),
]


@pytest.fixture(scope="session")
def firmware(tmp_path_factory: pytest.TempPathFactory) -> Path:
    program = tmp_path_factory.mktemp("board") / "board"
    words = ["-std=c++17", "-O2", "-Wall", "-Wextra", "-Werror", f'-DSKETCH="{SKETCH}"']
    subprocess.run([COMPILER, *words, "-o", str(program), str(BOARD)], check=True)
    return program


@dataclass
class Board:
    """The board, and the computer's end of its line."""

    end: int
    button: Path  #: while this file is there, the stop button is pressed
    prints: Path

    def pins(self) -> list[str]:
        return self.prints.read_text(encoding="utf-8").splitlines()


@pytest.fixture
def board(firmware: Path, tmp_path: Path) -> Iterator[Board]:
    import pty
    import tty

    theirs, ours = pty.openpty()
    tty.setraw(ours)
    prints, button = tmp_path / "pins.txt", tmp_path / "button"
    with prints.open("wb") as stream:
        process = subprocess.Popen(
            [str(firmware), str(theirs), str(button)], pass_fds=[theirs], stdout=stream
        )
    wait_for(lambda: "ready" in prints.read_text(encoding="utf-8"))
    os.set_blocking(ours, False)
    yield Board(ours, button, prints)
    process.kill()
    process.wait()
    os.close(theirs)
    os.close(ours)


def ask(
    line: StreamTransport, kind: int, sequence: int, *numbers: float, noise: bytes = b""
) -> Frame:
    line.send(noise + Frame(kind, sequence, 0xABCD, numbers=numbers).encode())
    data = line.receive(2.0)
    assert data is not None, f"no answer to {Kind(kind).name}"
    answer = decode(data)
    assert (answer.sequence, answer.session) == (sequence, 0xABCD)
    return answer


def test_it_keeps_to_the_contract_also_amid_noise(board):
    line = StreamTransport(board.end)
    welcome = ask(line, Kind.HELLO, 1, 0.02, 0.15, 2.0, 4.0, noise=b"\x00TRM\xffTRMS\x01TRMS")
    assert welcome.kind == Kind.WELCOME and welcome.numbers == pytest.approx((0.15, 2.0, 4.0))
    assert ask(line, Kind.READ, 2).numbers == (0.0, 0.0, 512.0, 511.0)
    line.send(Frame(Kind.COMMAND, 3, 0xABCD, numbers=(1.0, 1.0)).encode())
    assert ask(line, Kind.READ, 4).applied == 1  # not armed
    assert RigStatus(ask(line, Kind.ARM, 5).status) == RigStatus.ARMED
    # two frames at once, after bytes of one that was lost
    commands = [Frame(Kind.COMMAND, k, 0xABCD, numbers=(u, -9.0)).encode() for k, u in
                ((6, 1.0), (7, 1.25))]  # fmt: skip
    line.send(commands[0][7:] + commands[0] + commands[1])
    assert ask(line, Kind.READ, 8).applied == 7
    assert {"pin 9: 102", "pin 9: 127", "pin 10: 255"} <= set(board.pins())
    wait_for(lambda: board.pins()[-2:] == ["pin 9: 0", "pin 10: 0"])  # the watchdog
    status = RigStatus(ask(line, Kind.READ, 9).status)
    assert status == RigStatus.WATCHDOG


def test_the_stop_button_keeps_it_from_being_armed(board):
    line = StreamTransport(board.end)
    ask(line, Kind.HELLO, 1, 0.02, 0.2)
    ask(line, Kind.ARM, 2)
    line.send(Frame(Kind.COMMAND, 3, 0xABCD, numbers=(2.5, 0.0)).encode())
    wait_for(lambda: board.pins()[-1] == "pin 9: 255")
    board.button.touch()
    wait_for(lambda: board.pins()[-1] == "pin 9: 0")
    board.button.unlink()
    assert RigStatus(ask(line, Kind.ARM, 4).status) & RigStatus.EMERGENCY
    assert not ask(line, Kind.READ, 5).status & RigStatus.ARMED


@pytest.mark.slow
def test_a_run_drives_it_over_the_serial_line(board, tmp_path):
    words = ["run", "plant=serial", f"plant.port={os.ttyname(board.end)}", "plant.arm=true"]
    # it hangs at count 0: the wiring says where that is
    words += ["plant.wiring.alpha_v.offset=705", "plant.wiring.alpha_v.scale=0.087890625"]
    words += ["plant.wiring.alpha_v.unit=deg", "plant.wiring.alpha_h.unit=deg"]
    words += ["plant.wiring.omega_v.offset=512", "plant.wiring.omega_h.offset=511"]
    words += ["controller=open_loop", "sim.duration=1", "picture=false", "supervisor=none"]
    words += ["signal@controller.u_v=constant", "controller.u_v.offset=1.25"]
    words += ["signal@controller.u_h=constant", "controller.u_h.offset=-0.5"]
    done = subprocess.run(
        [str(INSTALLED), *words], cwd=tmp_path, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    pins = board.pins()
    assert "pin 9: 127" in pins and "pin 10: 51" in pins
    assert {pin.split(": ")[0]: pin for pin in pins} == {
        "ready": "ready",
        "pin 9": "pin 9: 0",
        "pin 10": "pin 10: 0",
    }
