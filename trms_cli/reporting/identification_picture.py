"""Figures of a fit: measured against simulated, parameters against priors, the search itself."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from trms_cli.reporting.style import (
    ALARM,
    COLOURS,
    GREY,
    INK,
    LABELS,
    MEASURED,
    PALE,
    house_style,
    legend_above,
    new_figure,
    save_png,
    thinned,
)

FloatArray = npt.NDArray[np.float64]

_WIDTH, _ROW_HEIGHT = 11.0, 1.75
#: Prior standard deviations to either side that the figure of the parameters shows.
_REACH = 4.0


@dataclass(frozen=True)
class FreeRunTrace:
    """One output over one part of a recording."""

    name: str
    unit: str
    time: FloatArray  #: (n,) array; s
    measured: FloatArray  #: (n,) array
    #: (n,) array or None; simulated with the values before the fit; NaN where it was not
    before: FloatArray | None
    after: FloatArray  #: (n,) array; simulated with the fitted values
    starts: FloatArray  #: (m,) array; times at which a window starts anew, s


def free_run_figure(traces: Sequence[FreeRunTrace], title: str) -> Figure:
    """Measured against simulated, a row an output, the errors beside."""
    with house_style():
        rows = len(traces)
        figure = new_figure(_WIDTH, 0.7 + _ROW_HEIGHT * rows)
        panels = figure.subplots(
            rows, 2, sharex=True, squeeze=False, gridspec_kw={"width_ratios": [3, 2]}
        )
        for (left, right), trace in zip(panels, traces, strict=True):
            _draw_run(left, trace)
            _draw_error(right, trace)
        for panel in panels[-1]:
            panel.set_xlabel("time [s]")
            panel.set_xlim(float(traces[0].time[0]), float(traces[0].time[-1]))
        figure.align_ylabels()
        _entitle(figure, title)
        return figure


def parameter_figure(parameters: Mapping[str, Mapping[str, Any]], title: str) -> Figure:
    """Fitted values in prior standard deviations from the prior's centre.

    Parameters
    ----------
    parameters : dict
        ``parameters`` of ``trms.identification/1``.
    """
    with house_style():
        count = len(parameters)
        figure = new_figure(_WIDTH, 1.1 + 0.24 * count)
        panel = figure.subplots()
        places = np.arange(count)[::-1]
        panel.axvspan(-2, 2, color=PALE, alpha=0.45, lw=0, zorder=0)
        panel.axvspan(-1, 1, color=PALE, alpha=0.9, lw=0, zorder=0)
        names = []
        for place, (name, p) in zip(places, parameters.items(), strict=True):
            names.append(name)
            _draw_parameter(panel, float(place), p)
        panel.set_yticks(places, names)
        panel.set_ylim(-0.7, count - 0.3)
        panel.set_xlim(-_REACH, _REACH)
        panel.set_xlabel(
            "from the prior's centre, in prior standard deviations (a share of 30 % without prior)"
        )
        panel.plot([], [], "o", color=COLOURS[0], ms=4, label="fitted ± one standard deviation")
        panel.plot([], [], "|", color=GREY, ms=9, label="start")
        if any(p["at_bound"] for p in parameters.values()):
            panel.plot([], [], ">", color=ALARM, ms=5, label="on a bound")
        legend_above(panel)
        _entitle(figure, title)
        return figure


def convergence_figure(history: Sequence[Sequence[float]], title: str) -> Figure:
    """The search's cost above its least, over simulations and over time.

    Parameters
    ----------
    history : sequence of (evaluations, seconds, cost)
    """
    with house_style():
        table = np.array([list(row) for row in history], dtype=float).reshape(-1, 3)
        figure = new_figure(_WIDTH, 2.6)
        left, right = figure.subplots(1, 2, sharey=True)
        least = np.nanmin(table[:, 2]) if len(table) else 0.0
        above = table[:, 2] - least
        positive = above > 0
        for panel, column, label in ((left, 0, "simulations"), (right, 1, "time [s]")):
            panel.plot(
                table[positive, column], above[positive], color=COLOURS[0], drawstyle="steps-post"
            )
            panel.set_xlabel(label)
            if positive.any():
                panel.set_yscale("log")
        left.set_ylabel("cost above its least")
        left.set_title(f"least cost {least:.6g}", fontsize=8, color=GREY, loc="right")
        _entitle(figure, title)
        return figure


def draw(figure: Figure, path: Path) -> None:
    """Save as a PNG."""
    with house_style():
        save_png(figure, path)


def _draw_run(panel: Axes, trace: FreeRunTrace) -> None:
    time, measured = thinned(trace.time, trace.measured)
    panel.plot(time, measured, color=MEASURED, lw=2.4, label="measured", zorder=3)
    if trace.before is not None:
        low, high = _range(trace)
        _, before = thinned(trace.time, _broken(trace, trace.before))
        panel.plot(
            time,
            before,
            color=COLOURS[1],
            lw=0.8,
            ls=(0, (4, 2)),
            label="simulated before the fit",
            zorder=4,
        )
        panel.set_ylim(low, high)
    _, after = thinned(trace.time, _broken(trace, trace.after))
    panel.plot(time, after, color=COLOURS[0], lw=0.9, label="simulated, fitted", zorder=5)
    for start in trace.starts:
        panel.axvline(start, color=GREY, lw=0.4, ls=":", zorder=1)
    panel.set_ylabel(f"{LABELS.get(trace.name, trace.name)} [{trace.unit}]")
    legend_above(panel)


def _draw_error(panel: Axes, trace: FreeRunTrace) -> None:
    errors = trace.measured - _broken(trace, trace.after)
    if trace.before is not None:
        time, before = thinned(trace.time, trace.measured - _broken(trace, trace.before))
        panel.plot(time, before, color=COLOURS[1], lw=0.7, label="before", zorder=3)
    time, after = thinned(trace.time, errors)
    panel.plot(time, after, color=COLOURS[0], lw=0.8, label="fitted", zorder=4)
    panel.axhline(0.0, color=GREY, lw=0.5)
    here = errors[np.isfinite(errors)]
    if here.size:
        words = f"RMSE {np.sqrt(np.mean(here**2)):.3g} {trace.unit}"
        if trace.before is not None:
            was = (trace.measured - trace.before)[np.isfinite(trace.measured - trace.before)]
            if was.size:
                words = f"RMSE {np.sqrt(np.mean(was**2)):.3g} → {words.removeprefix('RMSE ')}"
        panel.set_title(words, loc="right", fontsize=8, color=GREY, pad=3)
    panel.set_ylabel(f"error [{trace.unit}]")
    legend_above(panel)


def _draw_parameter(panel: Axes, place: float, p: Mapping[str, Any]) -> None:
    scale = p["prior_sd"] or 0.3 * abs(p["prior_mean"] or p["start"]) or 1.0
    at = (p["value"] - p["prior_mean"]) / scale
    shown = float(np.clip(at, -_REACH + 0.1, _REACH - 0.1))
    start = (p["start"] - p["prior_mean"]) / scale
    panel.plot([start], [place], "|", color=GREY, ms=9, zorder=2)
    if p["sd"] is not None:
        panel.plot(
            [shown - p["sd"] / scale, shown + p["sd"] / scale],
            [place, place],
            color=COLOURS[0],
            lw=1.6,
            zorder=3,
        )
    if p["at_bound"]:
        panel.plot(
            [shown], [place], "<" if p["at_bound"] == "lower" else ">", color=ALARM, ms=5, zorder=4
        )
    elif shown != at:
        panel.annotate(
            f"{at:+.0f} sd", (shown, place), color=COLOURS[0], fontsize=7, va="center", ha="center"
        )
    else:
        panel.plot([at], [place], "o", color=COLOURS[0], ms=4, zorder=4)


def _broken(trace: FreeRunTrace, values: FloatArray) -> FloatArray:
    """The values with the last sample of each window missing, so that no line joins two."""
    broken = np.where(np.isfinite(values), values, np.nan)
    for start in trace.starts[1:]:
        last = int(np.searchsorted(trace.time, start - 1e-9)) - 1
        if last >= 0:
            broken[last] = np.nan
    return broken


def _range(trace: FreeRunTrace) -> tuple[float, float]:
    """Of what was measured, with room for a simulation that strays as far again."""
    here = trace.measured[np.isfinite(trace.measured)]
    low, high = (float(here.min()), float(here.max())) if here.size else (-1.0, 1.0)
    room = 0.5 * (high - low) or 1.0
    both = [trace.after] if trace.before is None else [trace.after, trace.before]
    for values in both:
        known = values[np.isfinite(values)]
        if known.size:
            low = max(min(low, float(known.min())), low - room)
            high = min(max(high, float(known.max())), high + room)
    margin = 0.05 * (high - low) or 0.1
    return low - margin, high + margin


def _entitle(figure: Figure, title: str) -> None:
    figure.suptitle(title, x=0.01, ha="left", fontsize=11, fontweight="bold", color=INK)
