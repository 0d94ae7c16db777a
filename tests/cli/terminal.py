"""A program in a terminal of its own, as a person sees it."""

import fcntl
import os
import pty
import re
import select
import struct
import subprocess
import termios
import time
from collections.abc import Sequence
from pathlib import Path

ALTERNATE, NORMAL = b"\x1b[?1049h", b"\x1b[?1049l"


class Screen:
    """What a program shows there, and what is typed to it."""

    def __init__(
        self,
        argv: Sequence[str],
        folder: Path,
        size: tuple[int, int] = (24, 80),
        **environment: str,
    ) -> None:
        self.master, self.slave = pty.openpty()
        fcntl.ioctl(self.slave, termios.TIOCSWINSZ, struct.pack("HHHH", *size, 0, 0))
        self.before = termios.tcgetattr(self.slave)
        self.shown = b""
        slave = self.slave
        given = {k: v for k, v in os.environ.items() if k not in ("LINES", "COLUMNS")}
        self.process = subprocess.Popen(
            argv,
            stdin=slave,
            stdout=slave,
            stderr=slave,
            cwd=folder,
            env=given | {"TERM": "xterm-256color", "TRMS_RUNS": "off"} | environment,
            start_new_session=True,
            preexec_fn=lambda: fcntl.ioctl(slave, termios.TIOCSCTTY, 0),
        )

    def read(self, seconds: float, until: bytes = b"\0") -> bool:
        """Read what is shown; whether `until` was among it."""
        end = time.monotonic() + seconds
        while time.monotonic() < end and until not in self.shown:
            if select.select([self.master], [], [], 0.05)[0]:
                self.shown += os.read(self.master, 65536)
            elif self.process.poll() is not None:
                break
        return until in self.shown

    @property
    def lines(self) -> list[str]:
        """What has been shown, without colours."""
        text = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", self.shown.decode(errors="replace"))
        return [line.rstrip() for line in text.replace("\r", "").rstrip("\n").split("\n")]

    def type(self, keys: bytes) -> None:
        os.write(self.master, keys)

    def end(self, seconds: float = 20.0) -> int:
        """Read to the program's end, and give its code."""
        self.read(seconds)
        return self.process.wait(5)

    def is_as_it_was(self) -> bool:
        left = self.shown.rfind(NORMAL) > self.shown.rfind(ALTERNATE)
        cursor = self.shown.rfind(b"\x1b[?25h") > self.shown.rfind(b"\x1b[?25l")
        return left and cursor and termios.tcgetattr(self.slave) == self.before

    def close(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()
        os.close(self.master)
        os.close(self.slave)
