"""Figures of logs, of publication quality: what ``trms plot`` and notebooks draw.

::

    from trms_cli.recordings.log_reader import read_log
    from trms_cli.reporting.plot import plot

    figure = plot([read_log("run.mcap")], ["tracking", "inputs"], width="89mm")

A figure is a stack of panels over one time, or of pairs of panels; its height follows from how
many there are.
"""

import json
import math
import re
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Protocol

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from trms_cli.core.chart import Bars, Panel
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.wording import named_files
from trms_cli.reporting import plot_kinds
from trms_cli.reporting.chart_picture import Handle, draw_panel
from trms_cli.reporting.plot_kinds import Absent
from trms_cli.reporting.signals import RunReport, limits_in
from trms_cli.reporting.style import VARIANTS, Variant, house_style, letter_size, new_figure
from trms_cli.runs.run_folder import name_of


class PlottedLog(Protocol):
    """What is drawn: :class:`trms_cli.recordings.log_reader.LoggedRun` is one."""

    @property
    def path(self) -> Path:
        """Its file."""

    @property
    def tables(self) -> Mapping[str, Any]:
        """:class:`~trms_cli.scoring.metrics.Columns` by topic."""

    @property
    def config(self) -> str:
        """The resolved configuration as YAML."""

    @property
    def run(self) -> Mapping[str, str]:
        """What the run says of itself."""

    @property
    def score(self) -> Mapping[str, Any]:
        """``trms.score/1``, or empty."""


_Panels = Callable[[Sequence[RunReport]], list[Panel]]
#: The kinds of plots by name; the first line of each one's docstring says what it shows.
KINDS: Mapping[str, _Panels] = MappingProxyType(
    {
        "tracking": plot_kinds.tracking,
        "errors": plot_kinds.errors,
        "inputs": plot_kinds.inputs,
        "rates": plot_kinds.rates,
        "estimate": plot_kinds.estimate,
        "phase": plot_kinds.phase,
        "prediction": plot_kinds.prediction,
        "solver": plot_kinds.solver,
        "torques": plot_kinds.torques,
        "comparison": plot_kinds.comparison,
    }
)
DEFAULT_WHAT = ("tracking", "inputs")
#: More curves than this cannot be told apart in one panel.
MOST_LOGS = 12

_INCH = 25.4  # mm
#: Width of a figure that nobody gave a width (mm), and height of an ordinary panel (mm per point).
_WIDTHS = {"paper": 183.0, "slides": 254.0, "screen": 230.0}
_PANEL_HEIGHT = {"paper": 27.0, "slides": 52.0, "screen": 38.0}
_LARGEST, _SMALLEST = 1200.0, 30.0  # mm
_SIZE = re.compile(
    r"(\d+(?:\.\d+)?)\s*(mm|cm|in|pt)?(?:\s*[x×]\s*(\d+(?:\.\d+)?)\s*(mm|cm|in|pt)?)?"
)
_UNITS = {"mm": 1.0, "cm": 10.0, "in": _INCH, "pt": _INCH / 72}
#: Between two ticks, times a power of ten.
_STEPS = (1, 2, 2.5, 5, 10)
#: Mean width of a letter over the font's size, and letters in a line of a name beside its bar.
_LETTER, _NAME_LETTERS = 0.56, 22
#: Keys of a configuration that say where files go and how much is kept, not what was run.
_ASIDE = ("out", "picture", "sim.prediction_every", "sim.scene_every", "sim.estimate_every")
#: Options that follow from others, as a log's choices have them.
_IMPLIED = ("@", "experiment")


def plot(
    logs: PlottedLog | Sequence[PlottedLog],
    what: str | Sequence[str] = DEFAULT_WHAT,
    *,
    width: str | None = None,
    style: Variant = "paper",
    start: float | None = None,
    end: float | None = None,
    title: str = "",
    names: Sequence[str] | None = None,
) -> Figure:
    """Draw logs into one figure.

    Parameters
    ----------
    logs : PlottedLog or sequence of PlottedLog
        As :func:`trms_cli.recordings.log_reader.read_log` reads them; several are laid over each
        other.
    what : str or sequence of str
        Of :data:`KINDS`, drawn under each other in this order.
    width : str, optional
        ``89mm`` (a column), ``183mm`` (a page), or width and height: ``120x80mm``.
    style : {"paper", "slides", "screen"}
        Size of letters and lines.
    start, end : float, optional
        What is drawn of the run, s.
    title : str
    names : sequence of str, optional
        Of the logs; what they differ in by default.

    Returns
    -------
    matplotlib.figure.Figure
        Save it inside ``house_style(style)``, or by
        :func:`trms_cli.reporting.style.figure_bytes` there.

    Raises
    ------
    ConfigurationError
        For an unknown kind, a size that is none, too many logs, or when no log has anything of
        what was asked; :func:`absences` tells what is missing where something is there.
    """
    plotted = _plotted(logs, start, end, names)
    kinds = _kinds(what)
    if style not in VARIANTS:
        raise ConfigurationError(
            f"{style!r} given", where="style", remedy=f"one of {', '.join(VARIANTS)}"
        )
    panels, reasons = _panels(plotted, kinds)
    if not panels:
        raise ConfigurationError(
            "there is nothing to be drawn: " + "; ".join(reasons.values()),
            where=", ".join(kinds),
            remedy=f"other plots are {', '.join(kind for kind in KINDS if kind not in kinds)}",
        )
    across, high = size_of(width, style)
    with house_style(style):
        return _draw(panels, plotted, across, high, style, title)


def absences(
    logs: PlottedLog | Sequence[PlottedLog],
    what: str | Sequence[str],
    *,
    start: float | None = None,
    end: float | None = None,
) -> dict[str, str]:
    """Why kinds of plots cannot be drawn of logs, by kind; empty if all can."""
    return _panels(_plotted(logs, start, end, None), _kinds(what))[1]


def size_of(width: str | None, style: Variant) -> tuple[float, float | None]:
    """Width and height in mm; no height where only a width was given.

    Raises ConfigurationError for what is no size.
    """
    if width is None:
        return _WIDTHS[style], None
    match = _SIZE.fullmatch(width.strip())
    if match is None:
        raise ConfigurationError(
            f"{width!r} is no size", where="width", remedy="89mm, 183mm, 12cm or 120x80mm"
        )
    across, unit, down, unit_down = match.groups()
    size = float(across) * _UNITS[unit or unit_down or "mm"]
    height = None if down is None else float(down) * _UNITS[unit_down or unit or "mm"]
    for length in (size, height):
        if length is not None and not _SMALLEST <= length <= _LARGEST:
            raise ConfigurationError(
                f"{width!r} is {length:.4g} mm",
                where="width",
                remedy=f"from {_SMALLEST:g} to {_LARGEST:g} mm",
            )
    return size, height


def _plotted(
    logs: PlottedLog | Sequence[PlottedLog],
    start: float | None,
    end: float | None,
    names: Sequence[str] | None,
) -> list[RunReport]:
    log_list: list[Any] = list(logs) if isinstance(logs, Sequence) else [logs]
    if not log_list:
        raise ConfigurationError("no log was given", where="logs", remedy="name one or more")
    if len(log_list) > MOST_LOGS:
        raise ConfigurationError(
            f"{len(log_list)} logs cannot be told apart in one figure",
            where="logs",
            remedy=f"at most {MOST_LOGS}; `trms compare` ranks any number",
        )
    low = -math.inf if start is None else start
    high = math.inf if end is None else end
    if not low < high:
        raise ConfigurationError(
            f"the window from {low:g} to {high:g} s is empty",
            where="start, end",
            remedy="the end after the start",
        )
    run_names = list(names) if names is not None else names_of(log_list)
    if len(run_names) != len(log_list):
        raise ConfigurationError(
            f"{len(run_names)} names for {len(log_list)} logs",
            where="names",
            remedy="one name a log",
        )
    runs = [
        RunReport(name=name, tables=log.tables, limits=limits_in(log), score=log.score)
        for log, name in zip(log_list, run_names, strict=True)
    ]
    sampled_runs = [run for run in runs if not run.is_empty]
    if not any(run.begin <= high and low <= run.end for run in sampled_runs):
        first = min((run.begin for run in sampled_runs), default=0.0)
        last = max((run.end for run in sampled_runs), default=0.0)
        extent = f"the logs go from {first:g} to {last:g} s" if first < last else "they are empty"
        raise ConfigurationError(
            "the logs have no sample"
            + ("" if start is end is None else f" from {low:g} to {high:g} s"),
            where="start, end",
            remedy=extent,
        )
    return [replace(run, window=(low, high)) for run in runs]


def _kinds(what: str | Sequence[str]) -> list[str]:
    words = what.split(",") if isinstance(what, str) else list(what)
    kinds = [word.strip() for word in words if word.strip()]
    for kind in kinds or [""]:
        if kind not in KINDS:
            raise ConfigurationError(
                f"there is no plot {kind!r}", where="what", remedy=f"there are {', '.join(KINDS)}"
            )
    return list(dict.fromkeys(kinds))


def _panels(logs: Sequence[RunReport], kinds: Sequence[str]) -> tuple[list[Panel], dict[str, str]]:
    """The panels of all kinds, and why some kinds have none."""
    panels: list[Panel] = []
    reasons = {}
    for kind in kinds:
        try:
            panels += KINDS[kind](logs)
        except Absent as absent:
            reasons[kind] = str(absent)
    return panels, reasons


def _rows(panels: Sequence[Panel]) -> list[list[Panel]]:
    """Panels in rows: those of half a width by twos."""
    rows: list[list[Panel]] = []
    for panel in panels:
        if panel.half and rows and len(rows[-1]) == 1 and rows[-1][0].half:
            rows[-1].append(panel)
        else:
            rows.append([panel])
    return rows


def _draw(
    panels: Sequence[Panel],
    logs: Sequence[RunReport],
    width: float,
    height: float | None,
    style: Variant,
    title: str,
) -> Figure:
    panels = [_folded(panel) for panel in panels]
    rows = _rows(panels)
    heights = [max(panel.row_height or 1.0 for panel in row) for row in rows]
    unit = _PANEL_HEIGHT[style]
    words = _wrapped(title, width, style)
    legend_room = 0.26 * unit * (1 + 0.5 * max(len(logs) - 2, 0) * (width < 120))
    if height is None:
        height = unit * sum(heights) + legend_room + 0.3 * unit + 0.15 * unit * len(words)
    figure = new_figure(width / _INCH, height / _INCH)
    pads: Any = figure.get_layout_engine()
    pads.set(w_pad=0.02, h_pad=0.02, hspace=0.01, wspace=0.02)
    grid = figure.add_gridspec(len(rows), 2, height_ratios=heights)
    timed: list[Axes] = []
    handles: dict[str, Handle] = {}
    for i, row in enumerate(rows):
        for j, panel in enumerate(row):
            place = grid[i, j] if panel.half else grid[i, :]
            shared = timed[0] if panel.x.linked and timed else None
            axes = figure.add_subplot(place, sharex=shared)
            for label, handle in draw_panel(axes, panel).items():
                handles.setdefault(label, handle)
            _settle(axes, panel, width, style)
            if panel.x.linked:
                timed.append(axes)
    for axes in timed[:-1]:
        axes.tick_params(labelbottom=False)
        axes.set_xlabel("")
    figure.align_ylabels([axes for axes in figure.axes if axes.get_ylabel()])
    _legend(figure, handles, width, style, "\n".join(words))
    return figure


def _folded(panel: Panel) -> Panel:
    """As it stands on paper: without the heading of a page, the names of bars in short lines."""
    marks = [
        replace(mark, names=[textwrap.fill(name, _NAME_LETTERS) for name in mark.names])
        if isinstance(mark, Bars)
        else mark
        for mark in panel.marks
    ]
    names = [name for mark in marks if isinstance(mark, Bars) for name in mark.names]
    lines = max((name.count("\n") for name in names), default=0)
    height = (panel.row_height or 1.0) * (1 + 0.5 * lines)
    return replace(panel, marks=marks, title="", row_height=height)


def _settle(axes: Axes, panel: Panel, width: float, style: Variant) -> None:
    """As many ticks as fit beside each other."""
    room = width * (0.5 if panel.half else 1.0) / (2.2 if style == "slides" else 1.0)
    if axes.get_xscale() == "linear":
        count = max(3, int(room / (18 if panel.half else 13)))
        axes.xaxis.set_major_locator(MaxNLocator(count, steps=_STEPS))
    bars = any(isinstance(mark, Bars) for mark in panel.marks)
    if axes.get_yscale() == "linear" and not bars:
        count = 4 if (panel.row_height or 1.0) < 1.5 else 6
        whole = panel.y.label == "iterations"
        axes.yaxis.set_major_locator(MaxNLocator(count, steps=_STEPS, min_n_ticks=2, integer=whole))


def _legend(
    figure: Figure, handles: Mapping[str, Handle], width: float, style: Variant, title: str
) -> None:
    """One legend for all panels, over them, under the title; each curve once."""
    if not handles:
        if title:
            figure.suptitle(title, x=0.01, ha="left", fontweight="bold")
        return
    size = letter_size(style)
    line = width / _INCH * 72
    wrapped = [textwrap.fill(label, max(int(line / (_LETTER * size)) - 6, 12)) for label in handles]
    widest = max(len(part) for label in wrapped for part in label.split("\n"))
    columns = max(1, int(line // ((widest * _LETTER + 4.2) * size)))
    figure.legend(
        [each.artist for each in handles.values()],
        wrapped,
        loc="outside upper left",
        ncols=min(columns, len(wrapped)),
        handlelength=2.4,
        columnspacing=1.2,
        borderaxespad=0.1,
        borderpad=0.1,
        labelspacing=0.25,
        title=title or None,
        alignment="left",
        title_fontproperties={"weight": "bold"},
    )


def _wrapped(title: str, width: float, style: Variant) -> list[str]:
    """A title in lines that fit the figure's width (mm)."""
    if not title:
        return []
    size = 1.2 * letter_size(style)
    return textwrap.wrap(title, max(int(width / _INCH * 72 / (0.62 * size)), 12))


def names_of(logs: Sequence[PlottedLog]) -> list[str]:
    """What tells logs apart: the options and values in which they differ, else their folders."""
    if len(logs) == 1:
        return [name_of(logs[0].path)]
    settings = [_run_settings(log) for log in logs]
    keys = dict.fromkeys(key for one in settings for key in one)
    differing = [key for key in keys if len({one.get(key) for one in settings}) > 1]
    names = []
    for one in settings:
        parts = [
            str(one.get(key)) if _names_itself(key) else f"{key} {one.get(key)}"
            for key in differing
            if one.get(key) not in (None, "none")
        ]
        names.append(", ".join(parts))
    if len(set(names)) == len(names) and all(names):
        return names
    places = [name_of(log.path) for log in logs]
    if len(set(places)) < len(places):
        places = [str(log.path) for log in logs]
    return places


def _run_settings(log: PlottedLog) -> dict[str, str]:
    """Options and typed values of a run; empty for a log without such words."""
    try:
        choices = named_files(json.loads(log.run.get("choices", "{}")), log.config)
        typed = json.loads(log.run.get("overrides", "[]"))
        settings = {
            key: ", ".join(map(str, value)) if isinstance(value, list) else str(value)
            for key, value in choices.items()
            if value not in (None, []) and not any(sign in key for sign in _IMPLIED)
        }
        for word in typed:
            key, equals, value = str(word).lstrip("+").partition("=")
            if equals and "." in key and key not in _ASIDE and "@" not in key:
                settings[key.rpartition(".")[2]] = value
    except (AttributeError, TypeError, ValueError):
        return {}
    if log.run.get("seed"):
        settings["seed"] = str(log.run["seed"])
    if log.run.get("recording.file"):
        settings["recording"] = Path(log.run["recording.file"]).name
    return settings


def _names_itself(key: str) -> bool:
    """Whether an option is told by its name alone: `lqr` is a controller, `3` may be anything."""
    return key in ("controller", "observer", "model", "effect", "fault", "recording")
