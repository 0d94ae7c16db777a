"""Figures of a validation: free runs, errors over the time ahead and over the operating range."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from trms_cli.reporting.style import (
    COLOURS,
    GREY,
    INK,
    LABELS,
    MEASURED,
    PALE,
    PALETTE,
    house_style,
    legend_above,
    new_figure,
    thinned,
)

_WIDTH = 9.2
#: Colours of models, in order; more than these share the last.
MODEL_COLOURS = (*COLOURS, PALETTE["orange"], PALETTE["sky"])


@dataclass(frozen=True)
class ChannelRun:
    """A channel of one recording, and what models made of it in windows one after another."""

    channel: str
    unit: str
    time: Any  #: (n,) array; s
    measured: Any  #: (n,) array
    simulated: Mapping[str, Any]  #: dict of str to (n,) arrays; by model; NaN where no window lies
    starts: Any  #: (m,) array; s at which windows begin


@dataclass(frozen=True)
class ErrorGrowth:
    """The error of a channel over the time since the last measurement."""

    channel: str
    unit: str
    ahead: Any  #: (k,) array; s
    rms: Mapping[str, Any]  #: dict of str to (k,) arrays; at exactly that time ahead, by model
    unchanged: Any  #: (k,) array; of predicting no change
    noise: float  #: Declared noise of the channel
    #: dict of str to list of (horizon, rms, lower, upper); by model: RMS over the whole windows of
    #: a horizon
    intervals: Mapping[str, Sequence[tuple[float, float, float, float]]] = field(
        default_factory=dict
    )


def label(name: str) -> str:
    """A channel's name on an axis."""
    return LABELS.get(name, name)


def colour_of(i: int) -> str:
    """The colour of the i-th model."""
    return MODEL_COLOURS[min(i, len(MODEL_COLOURS) - 1)]


def free_run_figure(runs: Sequence[ChannelRun]) -> Figure:
    """Measured and simulated, and the error below, a pair of panels a channel."""
    with house_style():
        figure = new_figure(_WIDTH, 0.3 + 2.5 * len(runs))
        panels = figure.subplots(
            2 * len(runs), 1, sharex=True, squeeze=False, height_ratios=[2.0, 1.0] * len(runs)
        )[:, 0]
        for run, above, below in zip(runs, panels[::2], panels[1::2], strict=True):
            for start in np.asarray(run.starts):
                for panel in (above, below):
                    panel.axvline(start, color=PALE, lw=0.8, zorder=1)
            time, measured = thinned(run.time, run.measured)
            above.plot(time, measured, color=MEASURED, lw=2.2, label="measured", zorder=2)
            for i, (model, simulated) in enumerate(run.simulated.items()):
                time, values = thinned(run.time, simulated)
                above.plot(time, values, color=colour_of(i), lw=0.9, label=model, zorder=3)
                _, error = thinned(run.time, np.asarray(run.measured) - np.asarray(simulated))
                below.plot(time, error, color=colour_of(i), lw=0.7, zorder=3)
            _stay_near(above, np.asarray(run.measured))
            above.set_ylabel(f"{label(run.channel)}\n[{run.unit}]")
            below.set_ylabel(f"error\n[{run.unit}]")
            below.axhline(0.0, color=GREY, lw=0.5)
            legend_above(above)
        panels[-1].set_xlabel("time [s]")
        panels[-1].set_xlim(float(runs[0].time[0]), float(runs[0].time[-1]))
        figure.align_ylabels()
        return figure


def _stay_near(panel: Axes, measured: Any) -> None:
    """The measured range and as much again: a model that runs away shall not flatten the rest."""
    low, high = float(np.nanmin(measured)), float(np.nanmax(measured))
    reach = 0.6 * (high - low) or 1.0
    bottom, top = panel.get_ylim()
    panel.set_ylim(max(bottom, low - reach), min(top, high + reach))


def growth_figure(growths: Sequence[ErrorGrowth]) -> Figure:
    """RMS of the error over the time ahead, a panel a channel, both axes logarithmic."""
    with house_style():
        columns = 2 if len(growths) > 1 else 1
        rows = -(-len(growths) // columns)
        figure = new_figure(_WIDTH, 0.3 + 2.7 * rows)
        panels = figure.subplots(rows, columns, sharex=True, squeeze=False).ravel()
        for panel in panels[len(growths) :]:
            panel.set_visible(False)
        for growth, panel in zip(growths, panels, strict=False):
            panel.loglog(
                growth.ahead, growth.unchanged, color=GREY, lw=1.0, ls="--", label="no change"
            )
            panel.axhline(growth.noise, color=GREY, lw=0.9, ls=":", label="noise of the sensor")
            for i, (model, values) in enumerate(growth.rms.items()):
                panel.loglog(growth.ahead, values, color=colour_of(i), lw=1.3, label=model)
                for horizon, rms, lower, upper in growth.intervals.get(model, ()):
                    _point(panel, horizon * 1.015**i, rms, lower, upper, colour_of(i))
            panel.set_title(label(growth.channel), fontsize=9, color=INK)
            panel.set_ylabel(f"RMS of the error [{growth.unit}]")
            panel.grid(which="minor", visible=False)
        for panel in panels[max(0, len(growths) - columns) : len(growths)]:
            panel.set_xlabel("time since the last measurement [s]")
            panel.xaxis.set_tick_params(labelbottom=True)
        panels[0].legend(loc="best", frameon=False, fontsize=8)
        return figure


def _point(panel: Axes, x: float, y: float, lower: float, upper: float, colour: str) -> None:
    if not np.isfinite(y):
        return
    panel.plot([x], [y], "o", ms=4, color=colour, mec="white", mew=0.6, zorder=4)
    if np.isfinite(lower) and np.isfinite(upper):
        panel.plot([x, x], [lower, upper], color=colour, lw=2.2, alpha=0.5, zorder=3)


def region_figure(
    tables: Mapping[str, Sequence[Any]], units: Mapping[str, str], horizon: float
) -> Figure:
    """RMS over each operating variable: a row a channel, a column a variable.

    Parameters
    ----------
    tables : dict of str to sequence
        By model: tables with ``channel``, ``variable``, ``edges`` and ``rms``.
    units : dict of str to str
        Of channels and variables.
    horizon : float
        s.
    """
    every = [table for found in tables.values() for table in found]
    channels = list(dict.fromkeys(table.channel for table in every))
    variables = list(dict.fromkeys(table.variable for table in every))
    with house_style():
        width = max(4.0, min(12.0, 0.9 + 1.75 * len(variables)))
        height = 1.0 + 1.55 * len(channels)
        figure = new_figure(width, height)
        # Dozens of panels: to arrange themselves takes longer than to draw them.
        figure.set_layout_engine("none")
        panels = figure.subplots(
            len(channels),
            len(variables),
            sharex="col",
            sharey="row",
            squeeze=False,
            gridspec_kw={
                "left": 0.95 / width,
                "right": 1 - 0.1 / width,
                "bottom": 0.6 / height,
                "top": 1 - 0.35 / height,
                "wspace": 0.12,
                "hspace": 0.14,
            },
        )
        for i, (model, found) in enumerate(tables.items()):
            for table in found:
                panel = panels[channels.index(table.channel)][variables.index(table.variable)]
                panel.stairs(
                    table.rms,
                    table.edges,
                    baseline=0.0,
                    fill=len(tables) == 1,
                    color=colour_of(i),
                    alpha=0.75 if len(tables) == 1 else 1.0,
                    lw=1.3,
                    label=model,
                )
        for row, channel in zip(panels, channels, strict=True):
            row[0].set_ylabel(f"{label(channel)}\n[{units.get(channel, '')}]")
            row[0].set_ylim(bottom=0.0)
        for panel, variable in zip(panels[-1], variables, strict=True):
            of = "command " if variable.startswith("u_") else ""
            panel.set_xlabel(f"{of}{label(variable)}\n[{units.get(variable, '')}]")
        if len(tables) > 1:
            figure.legend(
                *panels[0][0].get_legend_handles_labels(),
                loc="upper left",
                ncols=6,
                frameon=False,
                fontsize=8,
            )
        else:
            title = f"RMS over the first {horizon:g} s, by where the rig was"
            figure.suptitle(title, x=0.01, ha="left", fontsize=9, color=INK)
        return figure
