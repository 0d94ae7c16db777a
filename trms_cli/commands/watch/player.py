"""Where in a run one is looking: at its latest sample, or somewhere in it at some speed."""

from __future__ import annotations

import math
from time import monotonic

from rich.text import Text

from trms_cli.commands.watch.frame import View, about, plain_line, run_frame
from trms_cli.runs.follower import RunFollower

_STEP = 5.0  # s of an arrow key
_FASTEST, _SLOWEST = 1024.0, 1 / 64
#: s that a picture may wait for reading: a long log is shown as it is read.
_BUDGET = 0.1
LIVE_KEYS = "q quit  space pause  ← → 5 s  home begin  end live"
REPLAY_KEYS = "q quit  space pause  + - speed  ← → 5 s  home begin  end"


class Player:
    """Follows a run, or replays it from `begin` (s) on; the curves show `span` seconds."""

    def __init__(
        self,
        run: RunFollower,
        *,
        live: bool,
        speed: float,
        begin: float,
        span: float,
        plain: bool = False,
    ) -> None:
        self.run = run
        self.live = live  #: Whether the latest sample is followed
        self.speed = speed  #: Of the replay: s of the run per second
        self.paused = False
        self.position = 0.0 if live else begin  #: s of the run
        self._span, self._plain = span, plain

    @property
    def at_end(self) -> bool:
        """Whether all there will be has been shown."""
        return self.run.ended and self.position >= self.run.latest - 1e-9

    def advance(self, seconds: float) -> None:
        """Let wall time pass."""
        run = self.run
        if self.live:
            run.look_until(math.inf, _BUDGET)
            if not self.paused:
                self.position = run.latest
            return
        target = self.position if self.paused else self.position + self.speed * seconds
        # One sample beyond, so that what is shown is held on until the next one.
        run.look_until(math.nextafter(target, math.inf), _BUDGET)
        self.position = min(target, run.latest)

    def press(self, key: str) -> bool:
        """Take a key; False to quit."""
        if key in ("q", "Q", "\x03"):
            return False
        if key == " ":
            self.paused = not self.paused
        elif key in ("+", "="):
            self.speed = min(2 * self.speed, _FASTEST)
        elif key in ("-", "_"):
            self.speed = max(self.speed / 2, _SLOWEST)
        elif key in ("left", "home"):
            self.live = False
            self.position = 0.0 if key == "home" else max(0.0, self.position - _STEP)
        elif key == "right":
            self._go(self.position + _STEP)
        elif key == "end":
            self._go(math.inf)
        return True

    def _go(self, target: float) -> None:
        """Forward; beyond the latest sample of a run that goes on is to follow it."""
        self.run.look_until(target, 20 * _BUDGET)
        if target >= self.run.latest:
            self.live, self.paused = not self.run.ended, False
        self.position = min(target, self.run.latest)

    def view(self, *, keys: bool) -> View:
        """What there is to see now."""
        run = self.run
        replay = ""
        if keys and self.paused:
            replay = "paused"
        elif keys and not self.live and not self.at_end:
            replay = f"replay {self.speed:g}×"
        return View(
            about=about(run.choices, run.run, str(run.path), run.total),
            moment=run.at(self.position, self._span),
            state=run.state,
            replay=replay,
            silent=monotonic() - run.heard,
            span=self._span,
            keys=(LIVE_KEYS if self.live else REPLAY_KEYS) if keys else "",
            problem=run.problems[-1] if run.problems else "",
        )

    def frame(self, width: int, height: int, *, keys: bool) -> list[Text]:
        """The picture."""
        return run_frame(self.view(keys=keys), width, height, plain=self._plain)

    def line(self) -> str:
        """The picture in a line."""
        return plain_line(self.view(keys=False))

    def done(self, *, keys: bool) -> bool:
        """Whether nothing more is to be shown; with keys a person may still look around."""
        return self.at_end and (not keys or (self.live and not self.paused))
