"""One picture of a replay: measured against estimated for every channel, and the innovations."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from trms_cli.reporting.run_picture import Drawable
from trms_cli.reporting.style import (
    ALARM,
    COLOURS,
    GREY,
    INK,
    LABELS,
    MEASURED,
    house_style,
    legend_above,
    new_figure,
    save_png,
    signal_place,
    thinned,
)
from trms_cli.reporting.torques import draw_torques, estimated_torques

_WIDTH, _ROW_HEIGHT = 11.0, 1.75
#: The band of the innovations reaches this far beyond itself, unless they stay closer.
_MOST_BANDS = 6.0


def draw_replay(
    history: Drawable, table: Mapping[str, Any], path: Path, *, title: str = ""
) -> None:
    """Draw a replay as a PNG: a row a channel, then commands and estimated torques.

    Parameters
    ----------
    history : Drawable
    table : dict
        ``trms.innovations/1``.
    path : Path
        File to write.
    title : str
    """
    with house_style():
        save_png(_figure(history, table["channels"], title), path)


def _figure(history: Drawable, channels: Mapping[str, Any], title: str) -> Figure:
    torques = estimated_torques(history.columns("/estimate"))
    rows = len(channels) + 1
    figure = new_figure(_WIDTH, 0.6 + _ROW_HEIGHT * rows)
    panels = figure.subplots(rows, 2, sharex=True, squeeze=False)
    for (left, right), (name, figures) in zip(panels, channels.items(), strict=False):
        _draw_channel(left, name, figures["unit"], history)
        _draw_innovation(right, name, figures, history)
    _draw_commands(panels[-1, 0], history)
    names = [name for group in torques.values() for name in group]
    draw_torques(panels[-1, 1], history.times("/estimate"), history.columns("/estimate"), names)
    panels[-1, 1].set_ylabel("estimated torque\n[mN m]")
    time = history.times("/measurement")
    for panel in panels[-1]:
        panel.set_xlabel("time [s]")
        panel.set_xlim(float(time[0]), float(time[-1]))
    figure.align_ylabels()
    figure.suptitle(title, x=0.01, ha="left", fontsize=11, fontweight="bold", color=INK)
    return figure


def _draw_channel(panel: Axes, name: str, unit: str, history: Drawable) -> None:
    estimate = history.columns("/estimate")
    references = history.columns("/reference")
    if name in references:
        time, values = thinned(history.times("/reference"), references[name])
        panel.plot(
            time,
            values,
            color=INK,
            lw=0.8,
            ls=(0, (4, 2)),
            drawstyle="steps-post",
            label="reference",
            zorder=2,
        )
    time, measured = thinned(history.times("/measurement"), history.columns("/measurement")[name])
    panel.plot(time, measured, color=MEASURED, lw=2.4, label="measured", zorder=3)
    if name in estimate:
        time, values = thinned(history.times("/estimate"), estimate[name])
        panel.plot(time, values, color=COLOURS[1], lw=0.7, label="estimate", zorder=4)
    panel.set_ylabel(f"{LABELS.get(name, name)} [{unit}]")
    legend_above(panel)


def _draw_innovation(panel: Axes, name: str, figures: Mapping[str, Any], history: Drawable) -> None:
    estimate, times = history.columns("/estimate"), history.times("/estimate")
    time, innovation = thinned(times, estimate[f"innovation_{name}"])
    _, band = thinned(times, 2 * np.asarray(estimate[f"innovation_sd_{name}"], dtype=float))
    panel.plot(time, innovation, color=COLOURS[0], lw=0.5, label="innovation", zorder=3)
    panel.plot(time, band, color=ALARM, lw=0.9, label="±2σ expected", zorder=4)
    panel.plot(time, -band, color=ALARM, lw=0.9, zorder=4)
    # The uncertain start is no measure of the rest.
    typical = float(np.nanmedian(band))
    worst = np.nanquantile(np.abs(innovation), 0.999) if np.any(~np.isnan(innovation)) else 0.0
    reach = max(1.6 * typical, min(1.2 * float(worst), _MOST_BANDS * typical)) or 1.0
    panel.set_ylim(-reach, reach)
    panel.set_ylabel(f"[{figures['unit']}]")
    words = [f"RMSE {_digits(figures['prediction_rmse'])}"]
    if figures["within_2sd"] is not None:
        words.append(f"{100 * figures['within_2sd']:.0f} % within")
    if figures["whiteness_p"] is not None:
        words.append("white" if figures["whiteness_p"] >= 0.05 else "not white")
    panel.set_title(", ".join(words), loc="right", fontsize=8, color=GREY, pad=3)
    legend_above(panel)


def _draw_commands(panel: Axes, history: Drawable) -> None:
    for number, (name, values) in enumerate(history.columns("/command").items()):
        colour = COLOURS[signal_place(name, number) % len(COLOURS)]
        time, held = thinned(history.times("/command"), values)
        label = f"{LABELS.get(name, name)} {name}"
        panel.plot(time, held, color=colour, lw=0.6, alpha=0.7, drawstyle="steps-post", label=label)
    panel.set_ylabel("recorded command")
    legend_above(panel)


def _digits(value: float | None) -> str:
    return "–" if value is None else f"{value:.3g}"
