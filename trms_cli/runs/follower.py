"""A run that is looked at while it is written, or again later."""

from __future__ import annotations

import contextlib
import json
import math
import re
from pathlib import Path
from time import monotonic
from typing import Any

from trms_cli.core.errors import RecordingError
from trms_cli.recordings.log_head import read_log_head
from trms_cli.recordings.log_tail import LogTail
from trms_cli.runs.moment import Moment, RunSamples

_WHOLE = ("/reference", "/command", "/measurement", "/plant/state", "/event")
_TIMES = ("solve_time_s", "iterations", "fallback", "deadline_missed")
_CONTROLLER = (*_TIMES, "status", "message", "mode", "reasons")
_DERIVED = ("sd_", "predicted_", "innovation_")
_WRITER_EVERY = 0.2  # s between two questions whether the run is still there


class RunFollower:
    """A run's log, followed as it grows.

    Raises RecordingError when the log cannot be read, also from :meth:`look`.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.ended = False  #: Nothing more will come, and all that there is has been read
        self.heard = monotonic()  #: Wall time when the log last grew
        self._tail = LogTail(path, _wanted)
        self._asked = -math.inf
        self._last, outcome = _last_words(path)
        #: ``running``; ``completed``, ``interrupted`` or ``failed``, as the run said at its end;
        #: ``died``: no end, and nobody writes; ``unfinished``: no end, and the system does not
        #: tell whether anybody writes
        self.state = outcome or self._of_writer()
        self._samples = RunSamples()

    @property
    def run(self) -> dict[str, str]:
        """What the run says of itself."""
        return self._tail.run

    @property
    def config(self) -> str:
        """The resolved config as YAML."""
        return self._tail.config

    @property
    def problems(self) -> list[str]:
        """What of the log is damaged, as sentences."""
        return self._tail.problems

    @property
    def choices(self) -> dict[str, Any]:
        """The option of each group; empty for what is no run of the loop."""
        found = _json(self.run.get("choices"))
        return found if isinstance(found, dict) else {}

    @property
    def latest(self) -> float:
        """Time of the last sample so far (s); 0 before the first one."""
        return self._samples.latest

    @property
    def total(self) -> float | None:
        """How long the run is meant to last (s); for a recording, how long it does."""
        if "recording.file" in self.run:  # `sim.duration` does not lengthen it
            return self._last
        duration = re.search(r"^sim:\n(?: .*\n)*? +duration: +([\d.eE+-]+)\s", self.config, re.M)
        with contextlib.suppress(ValueError):
            if duration is not None:
                return float(duration[1])
        return self._last

    @property
    def going_on(self) -> bool:
        """Whether the log is being written, or may be."""
        return self.state in ("running", "unfinished")

    def look(self) -> bool:
        """Take what is new; whether there was anything. The state is right once there is not."""
        if self.ended:
            return False
        piece = self._tail.read()
        if piece is None and not self._tail.finished:
            now = monotonic()
            if now - self._asked < _WRITER_EVERY:
                return False
            self._asked = now
            state = self._of_writer()
            if state != "died":
                self.state = state
                return False
            piece = self._tail.read()  # what came between the two
            if piece is None and not self._tail.finished:
                self.state, self.ended = state, True
                return False
        if piece is not None:
            self._check_origin()
            try:
                self._samples.add(piece, self.run)
            except (TypeError, ValueError, KeyError) as error:  # a stranger's log may hold anything
                raise RecordingError(
                    f"its messages are not as trms writes them ({error})", where=str(self.path)
                ) from error
            self.heard = monotonic()
        if self._tail.finished:
            self.ended, self.state = True, str(self.run.get("outcome") or "completed")
        return piece is not None

    def look_until(self, time: float, budget: float = math.inf) -> bool:
        """Look until samples at `time` (s) are there, or nothing is new, or `budget` s are over.

        Returns whether more may be there to be read at once.
        """
        begin = monotonic()
        while self.latest < time:
            if not self.look():
                return False
            if monotonic() - begin > budget:
                return True
        return True

    def close(self) -> None:
        """Close the log."""
        self._tail.close()

    def at(self, time: float, span: float, events: int = 8) -> Moment:
        """The run at a moment; see :meth:`~trms_cli.runs.moment.RunSamples.at`."""
        return self._samples.at(time, span, events)

    def _check_origin(self) -> None:
        if not self._tail.of_trms:
            raise RecordingError(
                f"this MCAP file is of another program ({self._tail.library or 'unnamed'})",
                where=str(self.path),
                remedy="name a log that trms has written",
            )

    def _of_writer(self) -> str:
        """The state of a log without an end."""
        return {True: "running", False: "died", None: "unfinished"}[self._tail.has_writer()]


def _wanted(topic: str, column: str) -> bool:
    if topic in _WHOLE:
        return True
    if topic == "/controller":
        return column in _CONTROLLER
    return topic == "/estimate" and not column.startswith(_DERIVED)


def _json(text: str | None) -> Any:
    try:
        return json.loads(text or "null")
    except (ValueError, RecursionError):
        return None


def _last_words(path: Path) -> tuple[float | None, str]:
    """Time of a finished log's last sample (s), and its outcome; empty for one without an end."""
    with contextlib.suppress(RecordingError):
        head = read_log_head(path)
        if head.finished:
            outcome = head.run.get("outcome") or "completed"
            with contextlib.suppress(KeyError, ValueError):
                return float(head.run["last_time_s"]), outcome
            return None, outcome
    return None, ""
