"""The panels of a plot over time: tracking, errors, inputs, rates, estimates, torques, solver.

Each kind of plot is a function from logs to panels; where no log has what it shows it raises
:class:`Absent` with the reason, in words for the person who asked.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator

from trms_cli.reporting.plot_logs import LogSignal, Plotted, rate_of
from trms_cli.reporting.style import (
    ALARM,
    INK,
    LABELS,
    MEASURED,
    PALETTE,
    curve_look,
    thinned_to_extremes,
)
from trms_cli.reporting.torques import estimated_torques

#: Of the reference: dark and dashed in every figure.
_ASKED: dict[str, Any] = {"color": INK, "linestyle": (0, (4, 2))}
#: Of what an estimate is off by: neither the rig's colour nor the estimate's.
_OFF: dict[str, Any] = {"color": PALETTE["green"], "linestyle": "-", "zorder": 4}
_BAND = 0.22  # opacity of a band of two standard deviations
_BAND_POINTS = 1000


class Absent(Exception):
    """Why something cannot be drawn, as a sentence."""


@dataclass(frozen=True)
class LogPanel:
    """A panel that is yet to be drawn."""

    draw: Callable[[Axes], None]  #: Draws into the axes it is given
    height: float = 1.0  #: Over that of an ordinary panel
    over_time: bool = True  #: Its horizontal axis is the time, shared with all the others'
    half: bool = False  #: It stands beside its neighbour, at half the width


def tracking(logs: Sequence[Plotted]) -> list[LogPanel]:
    """What was asked of each controlled axis, and what the rig did."""
    found = _in_order(name for log in logs for name in [*log.names("/reference"), *log.angles()])
    if not found:
        raise Absent("no log has an angle: a motor or a propeller alone has none")
    return [_over_time(logs, name, _draw_tracked, limits=True) for name in found]


def errors(logs: Sequence[Plotted]) -> list[LogPanel]:
    """Reference minus what the rig did."""
    if not any(log.names("/reference") for log in logs):
        raise Absent("no log has a reference: nothing was to be followed")
    names = _in_order(name for log in logs for name in log.names("/reference"))

    def panel(name: str) -> LogPanel:
        def draw(axes: Axes) -> None:
            for i, log in enumerate(logs):
                asked, done = log.signal("/reference", name), log.truth(name)
                if asked is None or done is None:
                    continue
                held = np.interp(done.time, asked.time, asked.values)
                if len(asked.time) != len(done.time) or np.any(asked.time != done.time):
                    place = np.searchsorted(asked.time, done.time, side="right") - 1
                    held = asked.values[np.maximum(place, 0)]
                _curve(axes, done.time, held - done.values, _of(log, logs), i)
            _zero(axes)
            _label(axes, f"{LABELS.get(name, name)} error", "rad")

        return LogPanel(draw)

    return [panel(name) for name in names]


def inputs(logs: Sequence[Plotted]) -> list[LogPanel]:
    """The commands as they were applied, held from sample to sample."""
    names = _in_order(name for log in logs for name in log.names("/command"))
    if not names:
        raise Absent("no log has a command")

    def panel(name: str) -> LogPanel:
        def draw(axes: Axes) -> None:
            unit = "V"
            for i, log in enumerate(logs):
                signal = log.signal("/command", name)
                if signal is not None:
                    unit = signal.unit
                    _curve(axes, signal.time, signal.values, _of(log, logs), i, steps=True)
            _limits(axes, logs, name)
            _label(axes, f"{LABELS.get(name, name)}\ncommand", unit)

        return LogPanel(draw, 0.8)

    return [panel(name) for name in names]


def rates(logs: Sequence[Plotted]) -> list[LogPanel]:
    """How fast the axes turn, and the rotors."""
    panels = []
    for name in _in_order(name for log in logs for name in log.angles()):
        panels.append(_over_time(logs, name, _draw_rate, 0.8))
    for name in ("omega_v", "omega_h"):
        if any(log.truth(name) is not None for log in logs):
            panels.append(_over_time(logs, name, _draw_speed, 0.8))
    if not panels:
        raise Absent("no log has an angle or a rotor's speed")
    return panels


def estimate(logs: Sequence[Plotted]) -> list[LogPanel]:
    """Estimated minus true, with two standard deviations; without a true state, innovations."""
    uncertain = [log for log in logs if _uncertain(log)]
    if not uncertain:
        if any(log.names("/estimate") for log in logs):
            raise Absent("the observer is handed the true state (full_state): it estimates nothing")
        raise Absent("no log has an estimate: no observer ran")
    names = _in_order(
        name
        for log in uncertain
        for name in _uncertain(log)
        if log.signal("/plant/state", name) is not None
        or f"innovation_{name}" in log.names("/estimate")
    )
    return [_over_time(logs, name, _draw_estimate, 0.8) for name in names]


def torques(logs: Sequence[Plotted]) -> list[LogPanel]:
    """Torques that the observer needs besides its model, with two standard deviations."""
    names = _in_order(
        name
        for log in logs
        if log.names("/estimate")
        for found in estimated_torques(log.log.tables["/estimate"].columns).values()
        for name in found
    )
    if not names:
        raise Absent("no log has an estimated torque: its observer estimates none")
    return [_over_time(logs, name, _draw_torque, 0.8) for name in names]


def solver(logs: Sequence[Plotted]) -> list[LogPanel]:
    """Time of each control step against its deadline, and the solver's iterations."""
    timed = [log for log in logs if log.signal("/controller", "solve_time_s") is not None]
    if not timed:
        raise Absent("no log has a controller's times: no controller ran (a recording has none)")
    panels = [LogPanel(lambda axes: _draw_times(axes, logs))]
    counts = [log.signal("/controller", "iterations") for log in logs]
    if any(count is not None and np.nanmax(count.values) > 1 for count in counts):

        def draw(axes: Axes) -> None:
            for i, (log, count) in enumerate(zip(logs, counts, strict=True)):
                if count is not None:
                    _curve(axes, count.time, count.values, _of(log, logs), i, steps=True)
            axes.yaxis.set_major_locator(MaxNLocator(4, integer=True))
            _label(axes, "iterations", "")

        panels.append(LogPanel(draw, 0.6))
    return panels


def _over_time(
    logs: Sequence[Plotted],
    name: str,
    draw_one: Callable[[Axes, Plotted, str, int, bool], str],
    height: float = 1.0,
    limits: bool = False,
) -> LogPanel:
    """A panel into which each log draws; what draws returns the label with its unit."""

    def draw(axes: Axes) -> None:
        label = ""
        for i, log in enumerate(logs):
            label = draw_one(axes, log, name, i, len(logs) == 1) or label
        if limits:
            _limits(axes, logs, name)
        axes.set_ylabel(label or LABELS.get(name, name))

    return LogPanel(draw, height)


def _draw_tracked(axes: Axes, log: Plotted, name: str, place: int, alone: bool) -> str:
    asked, done = log.signal("/reference", name), log.truth(name)
    if asked is not None and (alone or place == 0 or not _same_as_drawn(axes, asked)):
        label = "reference" if alone or place == 0 else f"reference of {log.name}"
        look = _ASKED if place == 0 else _ASKED | {"color": curve_look(place)["color"]}
        _line(axes, asked.time, asked.values, label, look | {"zorder": 3}, steps=True)
    if done is None:
        return ""
    guessed = log.signal("/estimate", name) if done.source != "estimate" else None
    deviation = log.signal("/estimate", f"sd_{name}")
    if alone and guessed is not None and deviation is not None and deviation.values.max() > 0:
        look = curve_look(1) | {"zorder": 5}
        _line(axes, guessed.time, guessed.values, "estimate", look)
    _curve(axes, done.time, done.values, done.source if alone else log.name, place)
    return f"{LABELS.get(name, name)} [{done.unit}]"


def _same_as_drawn(axes: Axes, asked: LogSignal) -> bool:
    """Whether a reference is the one that the first log has drawn."""
    first = next((line for line in axes.lines if line.get_label() == "reference"), None)
    if first is None:
        return False
    values = thinned_to_extremes(asked.time, asked.values)[1]
    drawn = np.asarray(first.get_ydata())
    return drawn.shape == values.shape and bool(np.allclose(drawn, values, atol=1e-9))


def _draw_rate(axes: Axes, log: Plotted, name: str, place: int, alone: bool) -> str:
    signal = log.truth(name)
    if signal is not None and signal.source == "measured":
        # The difference of an encoder's steps is noise: an observer's angle is smooth.
        signal = log.signal("/estimate", name, "estimate") or signal
    if signal is None:
        return ""
    look = _look_of(signal, place, alone)
    _line(axes, signal.time, rate_of(signal), signal.source if alone else log.name, look)
    return f"{LABELS.get(name, name)} rate\n[{signal.unit}/s]"


def _draw_speed(axes: Axes, log: Plotted, name: str, place: int, alone: bool) -> str:
    signal = log.truth(name)
    if signal is None:
        return ""
    look = _look_of(signal, place, alone)
    _line(axes, signal.time, signal.values, signal.source if alone else log.name, look)
    return f"{LABELS.get(name, name)}\n[{signal.unit}]"


def _look_of(signal: LogSignal, place: int, alone: bool) -> dict[str, Any]:
    """Of a log alone an estimate has one look in all panels, and the rig another: one legend."""
    return curve_look(1 if alone and signal.source == "estimate" else place) | {"zorder": 4}


def _uncertain(log: Plotted) -> list[str]:
    """States of which the observer is not certain."""
    names = log.names("/estimate")
    found = []
    for name in names:
        deviation = log.signal("/estimate", f"sd_{name}")
        if deviation is not None and np.nanmax(deviation.values) > 0:
            found.append(name)
    return [name for name in found if not name.endswith(("_moment", "_motor"))]


def _draw_estimate(axes: Axes, log: Plotted, name: str, place: int, alone: bool) -> str:
    guessed, sd = log.signal("/estimate", name), log.signal("/estimate", f"sd_{name}")
    true = log.signal("/plant/state", name)
    what = "estimate − true"
    if guessed is not None and true is not None and len(true.values) == len(guessed.values):
        off: LogSignal | None = LogSignal(guessed.time, guessed.values - true.values, guessed.unit)
    else:
        off, what = log.signal("/estimate", f"innovation_{name}"), "innovation"
        sd = log.signal("/estimate", f"innovation_sd_{name}")
    if off is None:
        return ""
    scale, unit = (1e3, "mrad") if off.unit == "rad" else (1.0, off.unit)
    if sd is not None:
        settled = slice(len(sd.time) // 20, None)  # one that finds its feet hides the rest
        band = 2 * scale * sd.values[settled]
        _band(axes, sd.time[settled], -band, band, place, alone)
    look = _OFF if alone else curve_look(place) | {"zorder": 4}
    _line(axes, off.time, scale * off.values, what if alone else log.name, look)
    _zero(axes)
    return f"{_symbol(name)}\n{'error' if what != 'innovation' else what} [{unit}]"


def _draw_torque(axes: Axes, log: Plotted, name: str, place: int, alone: bool) -> str:
    torque, sd = log.signal("/estimate", name), log.signal("/estimate", f"sd_{name}")
    if torque is None:
        return ""
    if sd is not None:
        settled = slice(len(sd.time) // 20, None)  # one that finds its feet hides the rest
        time, middle, wide = torque.time[settled], 1e3 * torque.values[settled], 2e3 * sd.values
        _band(axes, time, middle - wide[settled], middle + wide[settled], place, alone)
    look = _look_of(replace(torque, source="estimate"), place, alone)
    _line(axes, torque.time, 1e3 * torque.values, "estimate" if alone else log.name, look)
    _zero(axes)
    return f"{name.replace('_', ' ')}\n[mN m]"


def _draw_times(axes: Axes, logs: Sequence[Plotted]) -> None:
    alone = len(logs) == 1
    deadlines: dict[float, list[int]] = {}  # ms, and whose
    for i, log in enumerate(logs):
        spent = log.signal("/controller", "solve_time_s")
        if spent is None:
            continue
        # A microsecond at least: a law of one line takes less than the clock can tell.
        milliseconds = np.maximum(1e3 * spent.values, 1e-3)
        look = curve_look(i)
        time, values = thinned_to_extremes(spent.time, milliseconds)
        marker = "os^Dv<"[i % 6]
        axes.plot(time, values, marker, color=look["color"], markersize=1.4, markeredgewidth=0,
                  label="time of a step" if alone else log.name)  # fmt: skip
        if len(spent.time) > 1:
            period = float(f"{1e3 * float(np.median(np.diff(spent.time))):.4g}")
            deadlines.setdefault(period, []).append(i)
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(numticks=5))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    for deadline, whose in deadlines.items():
        if len(deadlines) == 1:
            axes.axhline(deadline, color=ALARM, linestyle=":", label="deadline")
        else:
            named = ", ".join(logs[i].name for i in whose)
            axes.axhline(
                deadline,
                color=curve_look(whose[0])["color"],
                linestyle=":",
                label=f"deadline of {named}, {deadline:g} ms",
            )
    _label(axes, "step time", "ms")


def _of(log: Plotted, logs: Sequence[Plotted]) -> str | None:
    """What a curve is called where it needs no other word: nothing, if it is the only one."""
    return log.name if len(logs) > 1 else None


def _in_order(names: Any) -> list[str]:
    """Without repetitions; pitch before yaw, angles before speeds."""
    usual = ("alpha_v", "alpha_h", "u_v", "u_h", "S_v", "S_h", "omega_v", "omega_h")
    found = list(dict.fromkeys(names))
    return sorted(found, key=lambda name: usual.index(name) if name in usual else len(usual))


def _symbol(name: str) -> str:
    """A state in words, or by its symbol: ``S_v``."""
    letter, _, of = name.partition("_")
    return LABELS.get(name) or (f"${letter}_{of}$" if len(letter) == len(of) == 1 else name)


def _curve(
    axes: Axes, time: Any, values: Any, label: str | None, place: int, steps: bool = False
) -> None:
    _line(axes, time, values, label, curve_look(place) | {"zorder": 4}, steps=steps)


def _line(
    axes: Axes,
    time: Any,
    values: Any,
    label: str | None,
    look: dict[str, Any],
    *,
    steps: bool = False,
) -> None:
    drawn, kept = thinned_to_extremes(time, values)
    axes.plot(drawn, kept, label=label, drawstyle="steps-post" if steps else "default", **look)


def _band(axes: Axes, time: Any, low: Any, high: Any, place: int, alone: bool) -> None:
    """Two standard deviations; of a long stretch its lowest and highest edge."""
    step = max(1, len(time) // _BAND_POINTS)
    starts = np.arange(0, len(time), step)
    axes.fill_between(
        np.asarray(time)[starts], np.minimum.reduceat(low, starts),
        np.maximum.reduceat(high, starts), linewidth=0, zorder=1,
        color=MEASURED if alone else curve_look(place)["color"],
        alpha=2 * _BAND if alone else 0.7 * _BAND,
        label="±2 standard deviations" if alone else None,
    )  # fmt: skip


def _limits(axes: Axes, logs: Sequence[Plotted], name: str) -> None:
    """Lines at limits that the curves come near; others would only squeeze them."""
    low, high = axes.get_ylim()
    for bound in {bound for log in logs for bound in log.limits().get(name, ())}:
        if low - 0.3 * (high - low) < bound < high + 0.3 * (high - low):
            axes.axhline(bound, color=ALARM, linestyle=":", label="limit")


def _zero(axes: Axes) -> None:
    axes.axhline(0.0, color=PALETTE["sky"], linewidth=0.5, zorder=0)


def _label(axes: Axes, what: str, unit: str) -> None:
    axes.set_ylabel(f"{what} [{unit}]" if unit else what)
