"""Shows pictures one after another: on a terminal in place, elsewhere a line each second."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable
from time import monotonic
from typing import Protocol

from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from trms_cli.commands.watch_terminal import Keyboard, is_interactive

#: s between two pictures: ten a second are a motion, more are only work.
_FRAME = 0.1
_LINE = 1.0  # s between two lines of plain text


class Shown(Protocol):
    """What is watched."""

    def advance(self, seconds: float) -> None:
        """Let wall time pass."""

    def press(self, key: str) -> bool:
        """Take a key; False to quit."""

    def frame(self, width: int, height: int, *, keys: bool) -> list[Text]:
        """The picture."""

    def line(self) -> str:
        """The picture in a line."""

    def done(self, *, keys: bool) -> bool:
        """Whether there is nothing more to wait for: neither news nor, with keys, a person."""


def show(shown: Shown) -> None:
    """Show until there is nothing more to come, or somebody quits.

    Ctrl-C raises KeyboardInterrupt, with the terminal as it was before.
    """
    if is_interactive():
        _on_terminal(shown)
    else:
        _in_lines(shown)


def show_once(shown: Shown) -> None:
    """Print one picture, of the size of the terminal (80 by 24 without one)."""
    shown.advance(0.0)
    width, height = shutil.get_terminal_size()
    _print(Console(highlight=False, width=width), shown.frame(width, height - 1, keys=False))


def _on_terminal(shown: Shown) -> None:
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
            _draw(shown, keyboard, live, console)
        # The last picture stays, among what was typed before and after.
        width, height = console.size
        _print(console, shown.frame(width, height - 1, keys=False))


def _draw(shown: Shown, keyboard: Keyboard, live: Live, console: Console) -> None:
    drawn: object = None
    before = monotonic()
    while True:
        now = monotonic()
        shown.advance(now - before)
        before = now
        width, height = console.size
        lines = shown.frame(width, height, keys=keyboard.there)
        picture = (width, height, [(line.plain, line.spans) for line in lines])
        if picture != drawn:
            live.update(Group(*lines), refresh=True)
            drawn = picture
        if shown.done(keys=keyboard.there):
            return
        if not all(map(shown.press, keyboard.wait(max(0.01, _FRAME - (monotonic() - now))))):
            return


def _in_lines(shown: Shown, say: Callable[[str], object] = print) -> None:
    said = ""
    before = monotonic()
    with Keyboard() as keyboard:
        while True:
            now = monotonic()
            shown.advance(now - before)
            before = now
            line, done = shown.line(), shown.done(keys=False)
            if line != said:
                say(line)
                sys.stdout.flush()
                said = line
            if done:
                return
            keyboard.wait(max(0.0, _LINE - (monotonic() - now)))


def _print(console: Console, lines: list[Text]) -> None:
    for line in lines:
        console.print(line, soft_wrap=True, end="\n")
