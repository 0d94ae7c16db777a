"""``trms watch --gap``: the alarms of a log as they come, on a terminal as a picture."""

from __future__ import annotations

import json
import sys
import textwrap
import time
from typing import TYPE_CHECKING

from rich.text import Text

from trms_cli.commands.watch.screen import is_interactive, show
from trms_cli.core import wording

if TYPE_CHECKING:
    from trms_cli.library.tasks.gap_watch import GapReplay
    from trms_cli.simulation.gap_watch import GapAlarm

#: s of wall time that the log is read for between two pictures, and waited for between two looks.
_BUDGET, _PAUSE = 0.08, 0.2
_BAR = 40  # characters of the statistic's bar
_INDENT = 12  # characters of a time, beside which an alarm's words are wrapped


def show_gap(replay: GapReplay, *, as_json: bool, plain: bool) -> None:
    """Watch a log to its end, and say what there is."""
    if as_json:
        while not replay.has_ended:
            replay.advance()
            _wait(replay)
        json.dump(replay.document(), sys.stdout, indent=2)
        sys.stdout.write("\n")
    elif is_interactive():
        show(GapScreen(replay, plain=plain))
    else:
        _in_lines(replay)


def _in_lines(replay: GapReplay) -> None:
    while not replay.has_ended:
        for alarm in replay.advance():
            print(line_of(alarm), flush=True)
        _wait(replay)
    print(summary_of(replay))


def _wait(replay: GapReplay) -> None:
    if not replay.has_ended:
        time.sleep(_PAUSE)


def line_of(alarm: GapAlarm) -> str:
    """An alarm in a line."""
    statistic, threshold = wording.number(alarm.statistic), wording.number(alarm.threshold)
    return f"{alarm.time:8.2f} s  {alarm.words}  (statistic {statistic}, threshold {threshold})"


def summary_of(replay: GapReplay) -> str:
    """How it stands, in a line."""
    changes = sum(alarm.kind == "change" for alarm in replay.alarms)
    what = {0: "no change", 1: "1 change"}.get(changes, f"{changes} changes")
    return f"{replay.time:8.2f} s  {what} of the rig against model {replay.model}"


class GapScreen:
    """The picture; see :class:`trms_cli.commands.watch.screen.WatchScreen`."""

    def __init__(self, replay: GapReplay, *, plain: bool) -> None:
        self._replay, self._plain = replay, plain

    def advance(self, seconds: float) -> None:
        self._replay.advance(_BUDGET)

    def press(self, key: str) -> bool:
        return key != "q"

    def is_over(self, *, keys: bool) -> bool:
        return self._replay.has_ended

    def line(self) -> str:
        return summary_of(self._replay)

    def frame(self, width: int, height: int, *, keys: bool) -> list[Text]:
        replay = self._replay
        lines = [Text(f"gap watch · model {replay.model or '…'} · {replay.path}", style="bold")]
        lines += [Text(summary_of(replay)), self._bar(), Text("")]
        room = max(1, height - len(lines) - 1)
        lines += self._alarms(width, room)
        if keys and not replay.has_ended:
            lines.append(Text("q  quit", style="dim"))
        for line in lines:
            line.truncate(width, overflow="ellipsis")
        return lines

    def _alarms(self, width: int, room: int) -> list[Text]:
        """The latest alarms that there is room for, whole: what an alarm says is seldom a line."""
        lines: list[str] = []
        for alarm in reversed(self._replay.alarms):
            wrapped = textwrap.wrap(
                line_of(alarm), max(width, 2 * _INDENT), subsequent_indent=" " * _INDENT
            )
            if lines and len(lines) + len(wrapped) > room:
                break
            lines[:0] = wrapped
        return [Text(line, style="red") for line in lines[:room]]

    def _bar(self) -> Text:
        """The statistic against its threshold."""
        statistic, threshold = self._replay.statistic, self._replay.config.threshold
        if statistic != statistic:
            return Text("learning what is usual")
        share = min(1.0, statistic / threshold)
        full, empty = ("#", "-") if self._plain else ("█", "─")
        filled = round(share * _BAR)
        bar = full * filled + empty * (_BAR - filled)
        words = f"statistic [{bar}] {wording.number(statistic)} of {wording.number(threshold)}"
        return Text(words, style="red" if share >= 1.0 else "")
