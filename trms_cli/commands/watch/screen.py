"""Shows pictures one after another: on a terminal in place, elsewhere a line each second."""

from __future__ import annotations

import os
import select
import shutil
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from time import monotonic
from typing import Any, Protocol, Self

from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from trms_cli.reporting.progress import termination

#: s between two pictures: ten a second are a motion, more are only work.
_FRAME = 0.1
_LINE = 1.0  # s between two lines of plain text


class WatchScreen(Protocol):
    """What is watched."""

    def advance(self, seconds: float) -> None:
        """Let wall time pass."""

    def press(self, key: str) -> bool:
        """Take a key; False to quit."""

    def frame(self, width: int, height: int, *, keys: bool) -> list[Text]:
        """The picture."""

    def line(self) -> str:
        """The picture in a line."""

    def is_over(self, *, keys: bool) -> bool:
        """Whether there is nothing more to wait for: neither news nor, with keys, a person."""


def show(player: WatchScreen) -> None:
    """Show until there is nothing more to come, or somebody quits.

    Ctrl-C raises KeyboardInterrupt, with the terminal as it was before.
    """
    if is_interactive():
        _on_terminal(player)
    else:
        _in_lines(player)


def show_once(player: WatchScreen) -> None:
    """Print one picture, of the size of the terminal (80 by 24 without one)."""
    player.advance(0.0)
    width, height = shutil.get_terminal_size()
    _print(Console(highlight=False, width=width), player.frame(width, height - 1, keys=False))


def _on_terminal(player: WatchScreen) -> None:
    console = Console(highlight=False)
    with Keyboard() as keyboard:
        # An alternate screen: what the terminal showed before comes back afterwards.
        with Live(
            console=console,
            screen=True,
            auto_refresh=False,
            redirect_stdout=False,
            redirect_stderr=False,
        ) as live:
            _draw(player, keyboard, live, console)
        # The last picture stays, among what was typed before and after.
        width, height = console.size
        _print(console, player.frame(width, height - 1, keys=False))


def _draw(player: WatchScreen, keyboard: Keyboard, live: Live, console: Console) -> None:
    last_picture: object = None
    before = monotonic()
    while True:
        now = monotonic()
        player.advance(now - before)
        before = now
        width, height = console.size
        lines = player.frame(width, height, keys=keyboard.there)
        picture = (width, height, [(line.plain, line.spans) for line in lines])
        if picture != last_picture:
            live.update(Group(*lines), refresh=True)
            last_picture = picture
        if player.is_over(keys=keyboard.there):
            return
        if not all(map(player.press, keyboard.wait(max(0.01, _FRAME - (monotonic() - now))))):
            return


def _in_lines(player: WatchScreen, say: Callable[[str], object] = print) -> None:
    said = ""
    before = monotonic()
    with Keyboard() as keyboard:
        while True:
            now = monotonic()
            player.advance(now - before)
            before = now
            line, is_over = player.line(), player.is_over(keys=False)
            if line != said:
                say(line)
                sys.stdout.flush()
                said = line
            if is_over:
                return
            keyboard.wait(max(0.0, _LINE - (monotonic() - now)))


def _print(console: Console, lines: list[Text]) -> None:
    for line in lines:
        console.print(line, soft_wrap=True, end="\n")


#: What the keys of a terminal send, by what they are called here.
_SEQUENCES = {
    "\x1b[C": "right",
    "\x1bOC": "right",
    "\x1b[D": "left",
    "\x1bOD": "left",
    "\x1b[H": "home",
    "\x1bOH": "home",
    "\x1b[1~": "home",
    "\x1b[F": "end",
    "\x1bOF": "end",
    "\x1b[4~": "end",
}
_SHOWN = "⣿━─█┼┤·×–…"  # what a picture is made of


class Keyboard:
    """Keys as they are pressed, while the block lasts; none where input is no terminal.

    Whatever ends the block, an error, Ctrl-C or SIGTERM, the terminal is as it was before. Ctrl-Z
    does nothing meanwhile: it would leave a terminal behind that shows no typing.
    """

    def __init__(self) -> None:
        self.there = False
        self._descriptor = -1
        self._before: list[Any] | None = None
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        self._stack.enter_context(termination())
        try:
            import termios
            import tty
        except ImportError:  # a system without such terminals
            return self
        try:
            self._descriptor = sys.stdin.fileno()
            self._before = termios.tcgetattr(self._descriptor)
            tty.setcbreak(self._descriptor)
            modes = termios.tcgetattr(self._descriptor)
            modes[6][termios.VSUSP] = bytes([os.fpathconf(self._descriptor, "PC_VDISABLE") & 0xFF])
            termios.tcsetattr(self._descriptor, termios.TCSANOW, modes)
            self.there = True
        except (OSError, ValueError, AttributeError, termios.error):
            self._restore()  # no terminal, or one that has no such modes
        except BaseException:
            self.__exit__(None, None, None)
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self._restore()
        self._stack.close()

    def wait(self, seconds: float) -> list[str]:
        """The keys that were pressed, waiting up to `seconds` for one; "q" when input has ended."""
        if not self.there:
            time.sleep(seconds)
            return []
        ready, _, _ = select.select([self._descriptor], [], [], seconds)
        if not ready:
            return []
        try:
            text = os.read(self._descriptor, 256).decode(errors="ignore")
        except OSError:
            return ["q"]  # the terminal is gone
        return keys_in(text) if text else ["q"]

    def _restore(self) -> None:
        self.there = False
        if self._before is None:
            return
        import termios

        before, self._before = self._before, None
        try:
            termios.tcsetattr(self._descriptor, termios.TCSAFLUSH, before)
        except termios.error:  # it is gone: nothing to restore
            return


def keys_in(text: str) -> list[str]:
    """The keys that a terminal has sent, by name; what is not known is left out."""
    keys = []
    while text:
        sequence = next((s for s in _SEQUENCES if text.startswith(s)), "")
        if sequence:
            keys.append(_SEQUENCES[sequence])
        elif text[0] != "\x1b":
            sequence = text[0]
            keys.append(sequence)
        else:  # an escape of a key that does nothing here, up to its last letter
            end = next((i for i, c in enumerate(text[1:], 1) if c.isalpha() or c == "~"), 0)
            sequence = text[: end + 1]
        text = text[len(sequence) :]
    return keys


def is_interactive() -> bool:
    """Whether output is a terminal that a picture can be drawn on."""
    return sys.stdout.isatty() and os.environ.get("TERM", "dumb") not in ("dumb", "")


def is_plain() -> bool:
    """Whether the terminal takes ASCII only; the Linux console has no braille."""
    if os.environ.get("TERM") == "linux":
        return True
    try:
        _SHOWN.encode(sys.stdout.encoding or "ascii")
    except (UnicodeEncodeError, LookupError):
        return True
    return False
