"""Draws a run's picture in a process beside the run.

The plotting library takes a third of a second to start. A process that starts when the run starts
has it ready when the run ends; data go to it through its standard input. Where that process
cannot be had, the picture is drawn in line.
"""

from __future__ import annotations

import pickle
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

if TYPE_CHECKING:
    from trms_cli.reporting.run_picture import Drawable

#: Topics that a picture shows.
_TOPICS = ("/reference", "/command", "/measurement", "/plant/state", "/estimate", "/controller")


@dataclass(frozen=True)
class Snapshot:
    """What a picture needs of a history, without the log behind it."""

    seconds: dict[str, Any]  #: dict of str to (n,) array; times by topic, s
    values: dict[str, dict[str, Any]]  #: dict of str to dict of str to (n,) array; columns by topic
    #: list of (time_ns, kind, source, message, value)
    events: list[tuple[int, str, str, str, float]]

    @classmethod
    def of(cls, history: Drawable) -> Self:
        """Take it from a history."""
        values = {topic: dict(history.columns(topic)) for topic in _TOPICS}
        return cls({t: history.times(t) for t in _TOPICS}, values, list(history.events))

    def times(self, topic: str) -> Any:
        """Times of a topic (n,), s."""
        return self.seconds[topic]

    def columns(self, topic: str) -> dict[str, Any]:
        """Columns of a topic."""
        return self.values[topic]


class Painter:
    """Who draws the pictures of a run; leave its ``with`` block to let it go.

    Parameters
    ----------
    beside : bool
        Start the process now; else each picture is drawn in line.
    """

    _PATIENCE = 60.0  # s

    def __init__(self, *, beside: bool) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        if not beside:
            return
        try:
            # A session of its own: Ctrl-C is for the run. -P: no module of the working folder.
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", __name__],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                start_new_session=True,
            )
        except OSError:
            self._process = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
            self._process = None

    def draw(self, history: Drawable, score: dict[str, Any], path: Path, **words: Any) -> None:
        """Draw a run; see :func:`trms_cli.reporting.run_picture.draw_run`."""
        snapshot = Snapshot.of(history)
        if self._process is not None and self._drawn_beside((snapshot, score, path, words)):
            return
        from trms_cli.reporting.run_picture import draw_run

        draw_run(snapshot, score, path, **words)

    def _drawn_beside(self, order: tuple[Any, ...]) -> bool:
        process, self._process = self._process, None
        assert process is not None
        try:
            process.communicate(pickle.dumps(order), timeout=self._PATIENCE)
        except (subprocess.TimeoutExpired, OSError):
            process.kill()
            process.communicate()
            return False
        return process.returncode == 0


def _serve() -> None:
    """The process beside: get ready, wait for the order, draw."""
    from trms_cli.reporting.run_picture import draw_run, warm_up

    warm_up()
    order = sys.stdin.buffer.read()
    if order:
        # From the process that started this one, and from nowhere else.
        snapshot, score, path, words = pickle.loads(order)
        draw_run(snapshot, score, path, **words)


if __name__ == "__main__":
    _serve()
