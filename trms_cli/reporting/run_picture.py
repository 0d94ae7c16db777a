"""One picture of a run: what was asked, what happened, what it took."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from trms_cli.core import wording
from trms_cli.reporting.notebook_figure import NotebookFigure
from trms_cli.reporting.style import (
    ALARM,
    COLOURS,
    DPI,
    GREY,
    INK,
    LABELS,
    PALE,
    house_style,
    legend_above,
    signal_place,
    thinned,
)
from trms_cli.reporting.torques import draw_torques, estimated_torques
from trms_cli.scoring.figures import of_group

Columns = Mapping[str, Any]

#: Inches: of the figure, around the panels, and between two of them.
_WIDTH, _LEFT, _RIGHT, _TOP, _BOTTOM, _GAP = 9.0, 0.84, 0.14, 0.55, 0.45, 0.27
#: Of the title: letters that fit into a line, and inches that each further line takes.
_LINE_LENGTH, _LINE_HEIGHT = 88, 0.19


class Drawable(Protocol):
    """What a picture is drawn from: :class:`trms_cli.simulation.history.History` is one."""

    @property
    def events(self) -> list[tuple[int, str, str, str, float]]:
        """(time_ns, kind, source, message, value)."""
        ...

    def times(self, topic: str) -> Any:
        """Times of a topic (n,), s."""
        ...

    def columns(self, topic: str) -> dict[str, Any]:
        """Columns of a topic by name, each (n,)."""
        ...


def draw_run(
    history: Drawable,
    score: Mapping[str, Any],
    path: Path,
    *,
    title: str = "",
    limits: Mapping[str, tuple[float, float]] | None = None,
) -> None:
    """Draw a run as a PNG.

    Parameters
    ----------
    history : Drawable
    score : dict
        ``trms.score/1`` of the run.
    path : Path
        File to write.
    title : str
    limits : dict of str to (float, float)
        Lower and upper limit by channel and input.
    """
    figure = figure_of_run(history, score, title=title, limits=limits)
    with house_style():
        content = io.BytesIO()
        figure.savefig(content, dpi=DPI, format="png", pil_kwargs={"compress_level": 3})
    path.write_bytes(content.getvalue())  # whole, or an error of the disk


def warm_up() -> None:
    """Do once what the first picture pays for: fonts and the first canvas."""
    figure = Figure(figsize=(1, 1))
    FigureCanvasAgg(figure)
    figure.subplots().set_title("α")
    figure.savefig(io.BytesIO(), format="png")


def figure_of_run(
    history: Drawable,
    score: Mapping[str, Any],
    *,
    title: str = "",
    limits: Mapping[str, tuple[float, float]] | None = None,
) -> NotebookFigure:
    """The picture of a run, not yet on any paper; arguments as of :func:`draw_run`."""
    with house_style():
        return _figure(history, score, title, limits or {})


def _figure(
    history: Drawable,
    score: Mapping[str, Any],
    title: str,
    limits: Mapping[str, tuple[float, float]],
) -> NotebookFigure:
    channels = _channels(history)
    torques = estimated_torques(history.columns("/estimate"))
    lines = _title_lines(title)
    solver = history.columns("/controller").get("solve_time_s", ())
    heights = [2.1] * len(channels) + [1.4]
    heights += [1.0 if place == "axes" else 0.75 for place in torques]
    heights += [0.75] * bool(len(solver))
    figure, panels = _sheet(heights, _TOP + (len(lines) - 1) * _LINE_HEIGHT)
    left = iter(panels)
    for name in channels:
        _draw_channel(next(left), name, history, score["channels"].get(name, {}), limits)
    _draw_commands(next(left), history, limits)
    for place, names in torques.items():
        panel = next(left)
        draw_torques(panel, history.times("/estimate"), history.columns("/estimate"), names)
        panel.set_ylabel(f"torque on\n{place} [mN m]")
    if len(solver):
        _draw_solver(next(left), history, score["solver"])
    panels[-1].set_xlabel("time [s]")
    panels[-1].set_xlim(0.0, max(float(score["duration_s"]), 1e-3))
    figure.text(
        0.01, 1 - 0.12 / figure.get_figheight(), "\n".join(lines), va="top", fontsize=11,
        fontweight="bold", color=INK,
    )  # fmt: skip
    return figure


def _sheet(heights: Sequence[float], top: float) -> tuple[NotebookFigure, list[Axes]]:
    """A figure with panels of the given heights (inches) under each other, `top` free above.

    Placed by hand: to have the places found takes as long as all the drawing.
    """
    whole = top + sum(heights) + _GAP * (len(heights) - 1) + _BOTTOM
    figure = NotebookFigure(figsize=(_WIDTH, whole))
    FigureCanvasAgg(figure)
    panels: list[Axes] = []
    ceiling = whole - top
    for height in heights:
        width = _WIDTH - _LEFT - _RIGHT
        place = (_LEFT / _WIDTH, (ceiling - height) / whole, width / _WIDTH, height / whole)
        panel = figure.add_axes(place, sharex=panels[0] if panels else None)
        panel.yaxis.set_label_coords(-0.48 / width, 0.5)
        panel.tick_params(labelbottom=len(panels) == len(heights) - 1)
        panels.append(panel)
        ceiling -= height + _GAP
    return figure, panels


def _title_lines(title: str) -> list[str]:
    """The title in lines that fit, broken between its parts where that is possible."""
    parts = (
        part.replace(" ", "\N{NO-BREAK SPACE}") if len(part) < _LINE_LENGTH // 2 else part
        for part in title.split(" · ")
    )
    return textwrap.wrap(" · ".join(parts), _LINE_LENGTH, break_on_hyphens=False) or [""]


def _channels(history: Drawable) -> list[str]:
    """What is controlled; without references, the measured angles."""
    wanted = list(history.columns("/reference"))
    return wanted or [n for n in history.columns("/measurement") if n.startswith("alpha")]


def _draw_channel(
    panel: Axes,
    name: str,
    history: Drawable,
    score: Mapping[str, Any],
    limits: Mapping[str, tuple[float, float]],
) -> None:
    truth, measured = history.columns("/plant/state"), history.columns("/measurement")
    reference = history.columns("/reference")
    seen: list[np.ndarray] = []
    if name in truth:
        time, values = thinned(history.times("/plant/state"), truth[name])
        panel.plot(time, values, color=COLOURS[0], lw=2.6, alpha=0.6, label="rig", zorder=4)
        seen.append(values)
    elif name in measured:
        time, values = thinned(history.times("/measurement"), measured[name])
        panel.plot(time, values, color=COLOURS[0], lw=1.2, label="measured", zorder=4)
        seen.append(values)
    if name in reference:
        time, values = thinned(history.times("/reference"), reference[name])
        panel.plot(
            time, values, color=INK, lw=1.0, ls=(0, (4, 2)), label="reference", zorder=3,
            drawstyle="steps-post",
        )  # fmt: skip
        seen.append(values)
    _draw_estimate(panel, name, history)
    _frame(panel, seen)
    for bound in limits.get(name, ()):
        panel.axhline(bound, color=ALARM, lw=0.8, ls=":")
    panel.set_ylabel(f"{LABELS.get(name, name)} [{score.get('unit', 'rad')}]")
    panel.set_title(_score_line(score), loc="right", fontsize=8, color=GREY, pad=3)
    legend_above(panel)


def _draw_estimate(panel: Axes, name: str, history: Drawable) -> None:
    """The estimate with two standard deviations, if it is one: a full-state observer has none."""
    estimate = history.columns("/estimate")
    deviation = estimate.get(f"sd_{name}")
    if name not in estimate or deviation is None or not np.any(deviation > 0):
        return
    time, values = thinned(history.times("/estimate"), estimate[name])
    _, sd = thinned(history.times("/estimate"), deviation)
    panel.fill_between(
        time, values - 2 * sd, values + 2 * sd, color=COLOURS[1], alpha=0.25, lw=0, zorder=1
    )
    panel.plot(time, values, color=COLOURS[1], lw=0.9, label="estimate ± 2 sd", zorder=5)


def _draw_commands(
    panel: Axes, history: Drawable, limits: Mapping[str, tuple[float, float]]
) -> None:
    time, commands = history.times("/command"), history.columns("/command")
    seen = []
    colours = {name: COLOURS[signal_place(name, i) % 4] for i, name in enumerate(commands)}
    for name, values in commands.items():
        drawn, held = thinned(time, values)
        label = f"{LABELS.get(name, name)} {name}"
        panel.plot(drawn, held, color=colours[name], lw=1.0, drawstyle="steps-post", label=label)
        seen.append(held)
    bounds = {abs(b) for name in commands for b in limits.get(name, ()) if np.isfinite(b)}
    reach = max((float(np.nanmax(np.abs(v))) for v in seen if len(v)), default=1.0)
    for bound in bounds:
        if bound < 2.5 * reach:
            panel.axhline(bound, color=ALARM, lw=0.8, ls=":")
            panel.axhline(-bound, color=ALARM, lw=0.8, ls=":")
    for name in commands:
        for begin, end in _saturated(history, name):
            panel.axvspan(begin, end, color=colours[name], alpha=0.18, lw=0, zorder=0)
    panel.set_ylabel("command [V]")
    legend_above(panel)


def _draw_solver(panel: Axes, history: Drawable, solver: Mapping[str, Any]) -> None:
    """Time of each step against its deadline; a mark where a fall-back acted or a fault began."""
    columns, time = history.columns("/controller"), history.times("/controller")
    # A microsecond at least: a law of one line takes less than the clock can tell.
    milliseconds = np.maximum(1e3 * np.asarray(columns["solve_time_s"], dtype=float), 1e-3)
    panel.plot(time, milliseconds, ".", color=GREY, ms=2.0)
    panel.set_yscale("log")
    panel.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    panel.yaxis.set_minor_locator(NullLocator())
    deadline = 1e3 * float(np.median(np.diff(time))) if len(time) > 1 else np.nan
    panel.axhline(deadline, color=ALARM, lw=0.8, ls=":")
    known = milliseconds[np.isfinite(milliseconds)]  # a landed rig has no controller's times
    if known.size:
        top = 3 * max(deadline, float(known.max())) if np.isfinite(deadline) else None
        panel.set_ylim(0.5 * float(known.min()), top)
    for mode, colour in (("degraded", PALE), ("landing", COLOURS[1])):
        for i, (begin, end) in enumerate(_spans(time, columns.get("mode", ()), mode)):
            label = mode if i == 0 else None
            panel.axvspan(begin, end, color=colour, alpha=0.5, lw=0, zorder=0, label=label)
    fallback = np.asarray(columns.get("fallback", np.zeros(len(time))), dtype=float) > 0
    fallback |= np.asarray(columns.get("status", [""] * len(time)), dtype=object) == "failed"
    marks = [
        ("fall-back", COLOURS[1], time[fallback]),
        ("event", ALARM, np.array(list(_faults(history)))),
    ]
    for label, colour, at in marks:
        if len(at):
            panel.plot(
                at, np.full(len(at), 0.9), "v", color=colour, ms=5, label=label,
                transform=panel.get_xaxis_transform(),
            )  # fmt: skip
    panel.set_ylabel("step\ntime [ms]")
    times = solver["time_ms"]
    words = f"median {_digits(times['median'])} ms, deadline {_digits(deadline)} ms"
    if solver.get("deadline_misses"):
        words += f", {solver['deadline_misses']} missed"
    if solver.get("failures"):
        words += f", {solver['failures']} fall-backs"
    panel.set_title(words, loc="right", fontsize=8, color=GREY, pad=3)
    if panel.get_legend_handles_labels()[0]:
        legend_above(panel)


def _saturated(history: Drawable, name: str) -> Iterator[tuple[float, float]]:
    """Spans (s) in which an input was at its limit."""
    begin = None
    for time_ns, kind, source, _, _ in history.events:
        if source == name and kind == "saturation_begin":
            begin = time_ns * 1e-9
        elif source == name and kind == "saturation_end" and begin is not None:
            yield begin, time_ns * 1e-9
            begin = None
    times = history.times("/command")
    if begin is not None and len(times):
        yield begin, float(times[-1])


def _spans(time: np.ndarray, modes: Sequence[str], mode: str) -> Iterator[tuple[float, float]]:
    """Spans (s) of the control samples in a mode."""
    inside = np.concatenate([[False], np.asarray(modes, dtype=object) == mode, [False]])
    edges = np.flatnonzero(np.diff(inside.astype(int)))
    for begin, end in zip(edges[::2], edges[1::2], strict=True):
        yield float(time[begin]), float(time[min(end, len(time) - 1)])


def _faults(history: Drawable) -> Iterator[float]:
    """Times (s) of what neither a saturation, the solver's own marks nor the mode tell."""
    told = ("saturation", "solver", "degraded", "landing", "outlier")
    for time_ns, kind, _, _, _ in history.events:
        if not kind.startswith(told) and not kind.endswith("_end"):
            yield time_ns * 1e-9


def _score_line(score: Mapping[str, Any]) -> str:
    """The figures of a channel that tell most: ``RMSE 0.134 rad · overshoot 4 %``."""
    unit = str(score.get("unit", "rad"))
    return " · ".join(
        f"{figure.label.partition(',')[0]} {wording.quantity(value, figure.unit_of(unit))}"
        for figure in of_group("channels")
        if figure.short and (value := figure.value(score)) is not None
    )


def _digits(value: float | None) -> str:
    if value is None:
        return "–"
    return "0" if abs(value) < 1e-6 else f"{value:.3g}"


def _frame(panel: Axes, seen: Sequence[np.ndarray]) -> None:
    """Limits by what happened: an uncertain start must not flatten the rest."""
    values = np.concatenate([v[np.isfinite(v)] for v in seen]) if seen else np.zeros(0)
    if values.size:
        low, high = float(values.min()), float(values.max())
        margin = 0.08 * (high - low) or 0.05
        panel.set_ylim(low - margin, high + margin)
