"""A picture of a run at one moment, in characters: as wide and as high as the terminal is."""

import math
import os
import signal
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from itertools import groupby
from time import monotonic, sleep
from typing import Any

import numpy as np
import numpy.typing as npt
from rich.cells import set_cell_size
from rich.text import Text

from trms_cli.core.wording import named_files
from trms_cli.runs.follower import AxisMoment, Input, Moment, Punctuality, RunFollower, Solver

FloatArray = npt.NDArray[np.float64]

#: Bits of a braille character by row and column of its dots (U+2800 and on).
_DOTS = np.array([[0x01, 0x08], [0x02, 0x10], [0x04, 0x20], [0x40, 0x80]])
_BLANK = 0x2800
_LEAST_RANGE = 0.1  # of the scale, in the curve's unit: the noise of a rig at rest is not a curve


@dataclass(frozen=True)
class TerminalCurve:
    """A line of a chart."""

    values: FloatArray  #: (n,) array; NaN where there is none
    style: str  #: How it looks, as rich has it
    sign: str  #: What draws it without Unicode


@dataclass(frozen=True)
class TerminalCell:
    """A character of a chart."""

    sign: str  #: The character
    style: str  #: How it looks, as rich has it


def scale(*values: FloatArray) -> tuple[float, float]:
    """Round limits around all that is to be seen, at least a tenth apart."""
    present = np.concatenate([v[np.isfinite(v)] for v in values] or [np.empty(0)])
    low, high = (float(present.min()), float(present.max())) if present.size else (0.0, 0.0)
    if high - low < _LEAST_RANGE:
        middle = (low + high) / 2
        low, high = middle - _LEAST_RANGE / 2, middle + _LEAST_RANGE / 2
    rough = (high - low) / 8
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(m * power for m in (1.0, 2.0, 5.0, 10.0) if m * power >= rough * 0.999)
    return step * math.floor(low / step + 1e-9), step * math.ceil(high / step - 1e-9)


def chart(
    time: FloatArray,
    curves: tuple[TerminalCurve, ...],
    within: tuple[float, float],
    limits: tuple[float, float],
    size: tuple[int, int],
    *,
    plain: bool = False,
) -> list[list[TerminalCell]]:
    """Draw curves over `time` (s, rising), the later ones over the earlier; the rows from the top.

    `within`: time at the left and at the right edge, s. `limits`: value at the lower and at the
    upper edge. `size`: columns and rows, in characters. `plain`: only ASCII.
    """
    columns, rows = size
    across, down = (1, 1) if plain else (2, 4)
    bits = np.zeros((rows, columns), dtype=int)
    owner = np.full((rows, columns), -1)
    for number, curve in enumerate(curves):
        low, high = _heights(time, curve.values, within, columns * across)
        edge = limits[1] - limits[0]
        tallest = rows * down - 1
        top = np.clip(np.rint((limits[1] - high) / edge * tallest), 0, tallest)
        bottom = np.clip(np.rint((limits[1] - low) / edge * tallest), 0, tallest)
        for x in np.flatnonzero(~np.isnan(high)):
            for y in range(int(top[x]), int(bottom[x]) + 1):
                bits[y // down, x // across] |= _DOTS[y % down, x % across]
                owner[y // down, x // across] = number
    return [
        [_cell(int(b), int(o), curves, plain) for b, o in zip(bits[row], owner[row], strict=True)]
        for row in range(rows)
    ]


def _cell(bits: int, owner: int, curves: tuple[TerminalCurve, ...], plain: bool) -> TerminalCell:
    if owner < 0:
        return TerminalCell(" ", "")
    return TerminalCell(curves[owner].sign if plain else chr(_BLANK + bits), curves[owner].style)


def _heights(
    time: FloatArray, values: FloatArray, within: tuple[float, float], columns: int
) -> tuple[FloatArray, FloatArray]:
    """The lowest and the highest value in each column; NaN where the curve has a gap.

    A column also reaches to where the one before it ended, so that a curve is one line.
    """
    low, high = np.full(columns, np.nan), np.full(columns, np.nan)
    present = np.isfinite(values)
    time, values = time[present], values[present]
    if not len(time):
        return low, high
    width = (within[1] - within[0]) / columns
    along = (time - within[0]) / (within[1] - within[0])
    index = np.clip((along * columns).astype(int), 0, columns - 1)
    np.fmin.at(low, index, values)
    np.fmax.at(high, index, values)
    if len(time) == 1:
        return low, high
    steps = np.diff(time)
    longest = max(3.0 * float(np.median(steps)), 2.0 * width)  # beyond it, samples are missing
    for k in np.flatnonzero(np.diff(index)):
        here, there = index[k], index[k + 1]
        if steps[k] > longest:
            continue
        # The value on the way at each column's edge between two samples.
        between = np.arange(here + 1, there + 1)
        edges = within[0] + between * width
        share = np.clip((edges - time[k]) / steps[k], 0.0, 1.0)
        on_the_way = values[k] + share * (values[k + 1] - values[k])
        for column, value in zip(between, on_the_way, strict=True):
            for place in (column - 1, column):
                low[place] = np.fmin(low[place], value)
                high[place] = np.fmax(high[place], value)
    return low, high


#: What the signals of the twin rotor are called; others go by their own name.
NAMES = {"alpha_v": "pitch", "alpha_h": "yaw", "u_v": "main rotor", "u_h": "tail rotor"}
#: How the states of a run are told, and their colours.
_STATES = {
    "running": ("running", "bold green"),
    "completed": ("completed", "bold cyan"),
    "interrupted": ("interrupted", "bold yellow"),
    "failed": ("failed", "bold red"),
    "died": ("died: its log has no end, and nobody writes it", "bold red"),
    "unfinished": ("its log has no end yet", "bold yellow"),
}
_REFERENCE, _ANGLE = "yellow", "bright_cyan"
_ALARM = "bold red"
_SILENT = 3.0  # s without a sample, after which that is told
_MARGIN = 10  # columns of a chart's scale
_LEAST_CHART = 3  # rows: fewer are no curve
_MOST_EVENTS = 6
#: Braille, blocks and lines, and what stands for them without Unicode.
_PLAIN = str.maketrans({"·": "|", "×": "x", "–": "-", "→": "->", "←": "<-", "…": "~", "┤": "|"})


@dataclass(frozen=True)
class About:
    """What does not change while a run goes on."""

    what: str  #: Controller, reference, observer, plant
    extras: str  #: Effects and faults
    log: str  #: Its path
    total: float | None  #: s that the run is meant to last; None if nobody knows


@dataclass(frozen=True)
class View:
    """What is to be shown."""

    about: About
    moment: Moment
    #: Of the run: ``running``, ``completed``, ``interrupted``, ``failed``, ``died``, ``unfinished``
    state: str
    replay: str = ""  #: How it is being replayed; empty while the latest samples are followed
    silent: float = 0.0  #: s since the log last grew
    span: float = 20.0  #: s that the curves show
    keys: str = ""  #: The keys there are; empty without a keyboard
    problem: str = ""  #: What of the log is damaged


def about(
    choices: Mapping[str, Any], run: Mapping[str, str], log: str, total: float | None
) -> About:
    """What a run is, in words, from its choices (none: a recording) and what its log says."""
    recording = run.get("recording.file") or run.get("file")
    if not choices:
        return About(recording or run.get("command") or "a recording", "", log, total)
    if recording:  # replayed: the recording is its own controller and reference
        parts = [recording, f"observer {choices.get('observer')}", f"model {choices.get('model')}"]
        return About(" · ".join(parts), "", log, total)
    parts = [str(choices.get("controller"))]
    if run.get("loop") != "open":
        parts.append(f"ref {choices.get('ref')}")
    parts.append(f"observer {choices.get('observer')}")
    own = choices.get("model@plant.model")
    rig = f" ({own})" if own else ""
    parts += [f"plant {choices.get('plant')}{rig}", f"model {choices.get('model')}"]
    extras = [
        f"{word} {_join(choices[group])}"
        for group, word in (("effect", "effects"), ("fault", "faults"))
        if choices.get(group)
    ]
    return About(" · ".join(parts), " · ".join(extras), log, total)


def run_frame(view: View, width: int, height: int, *, plain: bool = False) -> list[Text]:
    """The lines of the picture: at most `height` of at most `width` columns each.

    What a small terminal has no room for is left out: curves first, then events.
    """
    moment = view.moment
    head = [*_header(view, width, plain), *_table(moment.axes)]
    body = [_bar(command, width, plain) for command in moment.inputs]
    body += _solver_lines(moment.solver)
    if moment.timing is not None:
        body.append(_timing_line(moment.timing))
    if view.problem:
        body.append(Text(f"damaged  {view.problem}", _ALARM))
    foot = [Text(view.keys, "dim")] if view.keys else []
    events = [
        Text.assemble((f"{event.time:7.2f} s ", "dim"), event.message or event.source)
        for event in moment.events
    ]
    free_height = height - len(head) - len(body) - len(foot)
    room = min(len(events), _MOST_EVENTS, max(1, free_height // 4))
    charts = max(0, free_height - room - 1) // max(1, len(moment.axes)) if moment.axes else 0
    charts = min(charts, 12)
    room = min(len(events), _MOST_EVENTS, max(0, free_height - 1 - charts * len(moment.axes)))
    if charts < _LEAST_CHART:
        charts, room = 0, min(len(events), _MOST_EVENTS, max(0, free_height))
    lines = list(head)
    if charts:
        for axis in moment.axes:
            lines += _strip(axis, view, width, charts, plain)
        lines.append(_time_axis(view, width))
    lines += [*body, *(events[len(events) - room :] if room else []), *foot]
    return [fit_line(line, width, plain) for line in lines[:height]]


def plain_line(view: View) -> str:
    """The picture in one line, for a file or a pipe."""
    moment, total = view.moment, view.about.total
    parts = [f"{moment.time:.1f} s" + (f" of {total:g}" if total else "")]
    if not math.isnan(moment.speed):
        parts.append(f"{_short(moment.speed)}× real time")
    for axis in moment.axes:
        name = NAMES.get(axis.name, axis.name)
        value = axis.measured if math.isnan(axis.state) else axis.state
        if math.isnan(axis.reference):
            parts.append(f"{name} {value:.3f} {axis.unit}")
        else:
            parts.append(
                f"{name} {value:.3f} of {axis.reference:.3f} {axis.unit}, RMSE {_short(axis.rmse)}"
            )
    parts += [
        f"{command.name} {command.value:.2f} {command.unit}"
        + (" at its limit" if command.saturated else "")
        for command in moment.inputs
    ]
    solver = moment.solver
    if solver is not None:
        parts.append(f"solver {_short(solver.now_ms)} ms, {solver.misses} missed")
        if solver.mode not in ("", "normal"):
            parts.append(f"{solver.mode}: {solver.reasons}")
    if view.state != "running":
        parts.append(_STATES.get(view.state, (view.state, ""))[0])
    return " | ".join(parts)


def _header(view: View, width: int, plain: bool) -> list[Text]:
    words, style = _STATES.get(view.state, (view.state, "bold"))
    state = Text(words, style)
    if view.replay:
        state = Text.assemble((view.replay, "bold magenta"), " · ", state)
    elif view.state in ("running", "unfinished") and view.silent > _SILENT:
        state.append(f", no sample for {view.silent:.0f} s", "yellow")
    lines = [between(Text(view.about.what, "bold"), state, width)]
    if state.cell_len > width // 2:  # too long to share a line
        lines = [Text(view.about.what, "bold"), state]
    where = Text(tail_of(view.about.log, max(20, width - len(view.about.extras) - 4)), "dim")
    lines.append(between(Text(view.about.extras), where, width))
    moment, total = view.moment, view.about.total
    begin = f"{moment.time:6.1f}" + (f" / {total:g} s " if total else " s ")
    end = "" if math.isnan(moment.speed) else f"  {_short(moment.speed)}× real time"
    share = min(1.0, moment.time / total) if total else 0.0
    if total:
        end = f" {100 * share:3.0f} %{end}"
    cells = max(0, min(width - len(begin) - len(end), 60)) if total else 0
    full = round(share * cells)
    mark, rest = ("=", "-") if plain else ("━", "─")
    progress = Text.assemble(begin, (mark * full, "green"), (rest * (cells - full), "dim"), end)
    return [*lines, progress]


def _table(axes: tuple[AxisMoment, ...]) -> list[Text]:
    if not axes:
        return [Text("no sample yet", "dim")]
    columns = ("reference", "measured", "state", "estimate", "error", "RMSE")
    rows = [(a.reference, a.measured, a.state, a.estimate, a.error, a.rmse) for a in axes]
    # What no axis has is no column.
    column_indices = [i for i in range(len(columns)) if any(not math.isnan(row[i]) for row in rows)]
    title = Text(" " * 14)
    for i in column_indices:
        style = {"reference": _REFERENCE, "state": _ANGLE}.get(columns[i], "")
        if columns[i] == "measured" and 2 not in column_indices:
            style = _ANGLE
        title.append(f"{columns[i]:>11}", style or "dim")
    lines = [title]
    for axis, row in zip(axes, rows, strict=True):
        line = Text(f"{NAMES.get(axis.name, axis.name)[:8]:<8} {axis.unit[:5]:<5}")
        for i in column_indices:
            line.append(f"{_figure(row[i]):>11}", "bold" if columns[i] in ("error", "RMSE") else "")
        lines.append(line)
    return lines


def _window(view: View, columns: int) -> tuple[float, float]:
    """The time at both edges: moved by whole columns, so that a curve does not flicker."""
    step = view.span / columns
    end = max(view.span, step * math.ceil(view.moment.time / step - 1e-9))
    return end - view.span, end


def _strip(axis: AxisMoment, view: View, width: int, rows: int, plain: bool) -> list[Text]:
    columns = width - _MARGIN
    if columns < 8:
        return []
    limits = scale(axis.references, axis.outputs)
    curves = (
        TerminalCurve(axis.references, _REFERENCE, "-"),
        TerminalCurve(axis.outputs, _ANGLE, "*"),
    )
    cells = chart(axis.time, curves, _window(view, columns), limits, (columns, rows), plain=plain)
    middle = rows // 2
    labels = {0: _tick(limits[1]), middle: NAMES.get(axis.name, axis.name)[: _MARGIN - 2]}
    labels[rows - 1] = _tick(limits[0])
    lines = []
    for number, row in enumerate(cells):
        style = "" if number == middle else "dim"
        line = Text(f"{labels.get(number, ''):>{_MARGIN - 1}}", style).append("┤", "dim")
        for looks, alike in groupby(row, key=lambda cell: cell.style):
            line.append("".join(cell.sign for cell in alike), looks)
        lines.append(line)
    return lines


def _time_axis(view: View, width: int) -> Text:
    columns = width - _MARGIN
    begin, end = _window(view, max(8, columns))
    left, right = f"{begin:.1f} s", f"{end:.1f} s"
    gap = max(1, columns - len(left) - len(right))
    return Text(" " * _MARGIN + left + " " * gap + right, "dim")


def _bar(command: Input, width: int, plain: bool) -> Text:
    """A command between its limits, filled from zero."""
    name = f"{NAMES.get(command.name, command.name)[:10]:<10} {command.name[:4]:<4}"
    value = f"{_figure(command.value):>8} {command.unit}"
    share = "" if math.isnan(command.share) else f"  at a limit {100 * command.share:.1f} %"
    if not (
        math.isfinite(command.lower)
        and math.isfinite(command.upper)
        and command.upper > command.lower
    ):
        return Text(f"{name} {value}")
    low, high = f"{command.lower:g}", f"{command.upper:g}"
    room = width - len(name) - len(value) - len(share) - len(low) - len(high) - 6
    cells = max(8, min(room, 41))
    line = Text(f"{name} {low} ").append("[", "dim")
    reach = command.upper - command.lower
    zero = round(min(1.0, max(0.0, -command.lower / reach)) * (cells - 1))
    at = (
        zero
        if math.isnan(command.value)
        else round((command.value - command.lower) / reach * (cells - 1))
    )
    at = min(cells - 1, max(0, at))
    first, last = sorted((zero, at))
    full, empty, centre = ("#", "-", "|") if plain else ("█", "─", "┼")
    style = _ALARM if command.saturated else "blue"
    for cell in range(cells):
        inside = first <= cell <= last and at != zero
        if inside:
            line.append(full, style)
        else:
            line.append(centre if cell == zero else empty, "dim")
    line.append("]", "dim").append(f" {high} ")
    line.append(value, style if command.saturated else "bold")
    return line.append(share, "dim")


def _solver_lines(solver: Solver | None) -> list[Text]:
    if solver is None:
        return []
    line = Text("solver   ")
    late = solver.now_ms > solver.deadline_ms
    line.append(f"{_short(solver.now_ms)} ms", _ALARM if late else "bold")
    line.append(f" now · {_short(solver.p99_ms)} ms p99")
    if not math.isnan(solver.deadline_ms):
        line.append(f" of {_short(solver.deadline_ms)} ms")
    line.append(" · ").append(f"{solver.misses} missed", _ALARM if solver.misses else "")
    line.append(f" of {solver.steps}")
    if solver.iterations > 0:
        line.append(f" · {solver.iterations:.0f} iterations")
    mode = Text("status   ")
    mode.append(solver.status or "–", "" if solver.status in ("ok", "budget", "") else _ALARM)
    style = {"degraded": "bold yellow", "landing": _ALARM}.get(solver.mode, "")
    mode.append(" · mode ").append(solver.mode or "–", style)
    if solver.reasons:
        mode.append(f" ({solver.reasons})", style)
    mode.append(" · ").append(f"{solver.fallbacks} fall-backs", _ALARM if solver.fallbacks else "")
    if solver.message:
        mode.append(f" · {solver.message}", "dim")
    return [line, mode]


def _timing_line(timing: Punctuality) -> Text:
    line = Text("timing   ")
    line.append(f"{_short(timing.now_ms)} ms", _ALARM if timing.now_ms > 1.0 else "bold")
    line.append(f" late now · {_short(100 * timing.late_share)} % over 1 ms")
    line.append(f" · worst {_short(timing.worst_ms)} ms")
    return line.append(f" · command {_short(timing.command_ms)} ms after the reading")


def between(left: Text, right: Text, width: int) -> Text:
    """One at each end of a line; the left one gives way."""
    room = max(0, width - right.cell_len - 1)
    left = left.copy()
    left.truncate(room, overflow="ellipsis", pad=True)
    return Text.assemble(left, " ", right)


def fit_line(line: Text, width: int, plain: bool) -> Text:
    """No wider than the terminal, on one line, and without signs that steer it."""
    line = line.copy()
    text = "".join(sign if sign.isprintable() else " " for sign in line.plain)
    line.plain = text
    line.truncate(width, overflow="ellipsis")
    if plain:
        text = line.plain.translate(_PLAIN).encode("ascii", "replace").decode()
        line.plain = set_cell_size(text, width) if len(text) > width else text
    line.no_wrap = True
    return line


def tail_of(text: str, width: int) -> str:
    return text if len(text) <= width else "…" + text[len(text) - width + 1 :]


def _join(value: Any) -> str:
    return "+".join(map(str, value)) if isinstance(value, (list, tuple)) else str(value)


def _figure(value: float) -> str:
    """Fixed places, so that figures stand still under one another."""
    if math.isnan(value):
        return "–"
    return f"{value:.4f}" if abs(value) < 100 else f"{value:.4g}"


def _short(value: float) -> str:
    if math.isnan(value):
        return "–"
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"


def _tick(value: float) -> str:
    return f"{np.round(value, 6) + 0.0:g}"[: _MARGIN - 2]


_STEP = 5.0  # s of an arrow key
_FASTEST, _SLOWEST = 1024.0, 1 / 64
_BETWEEN_SIGNALS = 0.05  # s
#: s that a picture may wait for reading: a long log is shown as it is read.
_BUDGET = 0.1
LIVE_KEYS = "q quit  space pause  ← → 5 s  home begin  end live"
RIG_KEYS = "l land  x stop at once  " + LIVE_KEYS
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
        return self.run.has_ended and self.position >= self.run.latest - 1e-9

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
        if key in ("l", "L", "x", "X"):
            self._stop_run(at_once=key in ("x", "X"))
        elif key == " ":
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

    def _stop_run(self, *, at_once: bool) -> None:
        """Ask a run that goes on by the clock to land its rig, as Ctrl-C in its terminal does."""
        process = self.run.process
        # elsewhere than on POSIX a signal would end it, and no rig would be landed
        if process is None or os.name != "posix":
            return
        with suppress(OSError):
            os.kill(process, signal.SIGINT)
            if at_once:
                sleep(_BETWEEN_SIGNALS)  # two at once would count as one
                os.kill(process, signal.SIGINT)

    def _go(self, target: float) -> None:
        """Forward; beyond the latest sample of a run that goes on is to follow it."""
        self.run.look_until(target, 20 * _BUDGET)
        if target >= self.run.latest:
            self.live, self.paused = not self.run.has_ended, False
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
            about=about(
                named_files(run.choices, run.tail.config), run.tail.run, str(run.path), run.total
            ),
            moment=run.at(self.position, self._span),
            state=run.state,
            replay=replay,
            silent=monotonic() - run.last_growth,
            span=self._span,
            keys=self._keys() if keys else "",
            problem=run.tail.problems[-1] if run.tail.problems else "",
        )

    def _keys(self) -> str:
        if self.run.process is not None:
            return RIG_KEYS
        return LIVE_KEYS if self.live else REPLAY_KEYS

    def frame(self, width: int, height: int, *, keys: bool) -> list[Text]:
        """The picture."""
        return run_frame(self.view(keys=keys), width, height, plain=self._plain)

    def line(self) -> str:
        """The picture in a line."""
        return plain_line(self.view(keys=False))

    def is_over(self, *, keys: bool) -> bool:
        """Whether nothing more is to be shown; with keys a person may still look around."""
        return self.at_end and (not keys or (self.live and not self.paused))
