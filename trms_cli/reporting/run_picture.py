"""One picture of a run or a replay: what was asked, what happened, what it took.

The plotting library takes a third of a second to start. A process that starts when the run starts
(:class:`Painter`) has it ready when the run ends; data go to it through its standard input. Where
that process cannot be had, the picture is drawn in line.
"""

from __future__ import annotations

import io
import pickle
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

if TYPE_CHECKING:
    from trms_cli.core.chart import Panel
    from trms_cli.reporting.style import NotebookFigure
    from trms_cli.scoring.metrics import Columns

#: Topics that a picture shows.
_TOPICS = (
    "/reference",
    "/command",
    "/measurement",
    "/plant/state",
    "/estimate",
    "/controller",
    "/event",
)
#: Of events that other marks tell already.
_TOLD_BY_MARKS = ("saturation", "solver", "degraded", "landing", "outlier")
_WIDTH, _REPLAY_WIDTH = 9.0, 11.0  # inches
#: Heights of panels, inches.
_CHANNEL, _COMMANDS, _TORQUES, _OTHER, _ROW = 2.1, 1.4, 1.0, 0.75, 1.5


class Painter:
    """Who draws the pictures of a run; leave its ``with`` block to let it go.

    `beside`: start the process now; else each picture is drawn in line.
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

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
            self._process = None

    def draw(
        self, tables: Mapping[str, Columns], score: Mapping[str, Any], path: Path, **words: Any
    ) -> None:
        """Draw a run; see :func:`draw_run`."""
        picture_tables = {topic: table for topic, table in tables.items() if topic in _TOPICS}
        if self._process is not None and self._drawn_beside((picture_tables, score, path, words)):
            return
        draw_run(picture_tables, score, path, **words)

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


def draw_run(
    tables: Mapping[str, Columns], score: Mapping[str, Any], path: Path, **words: Any
) -> None:
    """Draw a run as a PNG; arguments as of :func:`figure_of_run`, and the file to write."""
    from trms_cli.reporting.style import DPI, house_style, save_figure

    figure = figure_of_run(tables, score, **words)
    with house_style():
        content = save_figure(figure, dpi=DPI, format="png", pil_kwargs={"compress_level": 3})
    path.write_bytes(content)  # whole, or an error of the disk


def figure_of_run(
    tables: Mapping[str, Columns],
    score: Mapping[str, Any],
    *,
    title: str = "",
    limits: Mapping[str, tuple[float, float]] | None = None,
) -> NotebookFigure:
    """The picture of a run, not yet on any paper.

    `tables`: by topic, as a log or a history has them. `score`: ``trms.score/1`` of the run.
    `limits`: lower and upper limit by channel and input.
    """
    from trms_cli.core.chart import Events
    from trms_cli.reporting import run_panels
    from trms_cli.reporting.signals import RunSignals

    run = RunSignals(tables=tables, limits=limits or {})
    panels = []
    for name in run.channels():
        note = run_panels.score_note(score["channels"].get(name, {}))
        panels.append(replace(run_panels.channel_panel(run, name), row_height=_CHANNEL, note=note))
    commands, steps = run_panels.command_panel(run), run_panels.solver_panel(run)
    panels += [replace(commands, row_height=_COMMANDS)] if commands is not None else []
    for number, panel in enumerate(run_panels.torque_panels(run)):
        panels.append(replace(panel, row_height=_OTHER if number else _TORQUES))
    if steps is not None:
        times = [
            event.time
            for event in run.events
            if not event.kind.startswith(_TOLD_BY_MARKS) and not event.kind.endswith("_end")
        ]
        marks = [*steps.marks, *([Events(times, "event")] if times else [])]
        steps = _labelled(steps, "step\ntime")
        panels.append(replace(steps, row_height=_OTHER, marks=marks))
    return _sheet(panels, title, _WIDTH, (0.0, max(float(score["duration_s"]), 1e-3)))


def draw_replay(
    tables: Mapping[str, Columns], figures: Mapping[str, Any], path: Path, *, title: str = ""
) -> None:
    """Draw a replay as a PNG: a row a channel with its innovations, then commands and torques.

    `tables`: by topic. `figures`: ``trms.innovations/1``. `path`: the file to write.
    """
    from trms_cli.reporting import run_panels
    from trms_cli.reporting.signals import RunSignals
    from trms_cli.reporting.style import house_style, save_png

    run = RunSignals(tables=tables)
    panels = []
    innovations = iter(run_panels.innovation_panels(run, figures["channels"]))
    for name in figures["channels"]:
        panels += [run_panels.channel_panel(run, name), _labelled(next(innovations), "innovation")]
    commands = run_panels.command_panel(run)
    torques = [name for names in run.torques().values() for name in names]
    panels += [_labelled(commands, "recorded command")] if commands is not None else []
    panels += [run_panels.torque_panel(run, "rig", torques)] if torques else []
    span = (run.begin, max(run.end, run.begin + 1e-3))
    figure = _sheet(
        [replace(panel, row_height=_ROW) for panel in panels], title, _REPLAY_WIDTH, span, 2
    )
    with house_style():
        save_png(figure, path)


def _labelled(panel: Panel, label: str) -> Panel:
    return replace(panel, y=replace(panel.y, label=label))


def _sheet(
    panels: list[Panel], title: str, width: float, span: tuple[float, float], columns: int = 1
) -> NotebookFigure:
    from trms_cli.core.chart import Axis, Chart
    from trms_cli.reporting.chart_picture import sheet_of
    from trms_cli.reporting.style import figure_for_notebook, house_style

    time = Axis("time", "s", span)
    panels = [replace(panel, x=time, title="") for panel in panels]
    with house_style():
        return figure_for_notebook(
            sheet_of(Chart("run", panels, columns=columns, width=width), title)
        )


def _serve() -> None:
    """The process beside: get ready, wait for the order, draw."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from trms_cli.reporting import chart_picture, run_panels  # noqa: F401

    # What the first picture pays for: fonts and the first canvas.
    figure = Figure(figsize=(1, 1))
    FigureCanvasAgg(figure)
    figure.subplots().set_title("α")
    figure.savefig(io.BytesIO(), format="png")
    order = sys.stdin.buffer.read()
    if order:
        # From the process that started this one, and from nowhere else.
        tables, score, path, words = pickle.loads(order)
        draw_run(tables, score, path, **words)


if __name__ == "__main__":
    _serve()
