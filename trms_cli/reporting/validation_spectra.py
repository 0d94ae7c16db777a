"""Figures of a validation: residual correlations, spectra, coherence, amplitude distributions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from trms_cli.reporting.style import (
    ALARM,
    COLOURS,
    GREY,
    INK,
    PALE,
    house_style,
    legend_above,
    new_figure,
)
from trms_cli.reporting.validation_figures import colour_of, label

_WIDTH = 9.2


@dataclass(frozen=True)
class CorrelationPanel:
    """Correlations over lags, with the band that a right model stays in."""

    title: str
    lags: Any  #: (m,) array; s
    correlations: Any  #: (m,) arrays; The band's half width
    band: Any  #: (m,) arrays; all lags together stay in it with probability 0.95
    failed: bool  #: Whether the test says that the model misses something
    note: str  #: The verdict in a few letters


@dataclass(frozen=True)
class ChannelSpectra:
    """Spectra of one channel."""

    channel: str
    unit: str
    frequencies: Any  #: (f,) array; hz
    measured: Any  #: (f,) array; density, unit² per Hz
    #: ``simulated``, ``error``: dict of str to (f,) arrays; of the free run and its error, by model
    simulated: Mapping[str, Any]
    error: Mapping[str, Any]
    interval: tuple[float, float]  #: Factors from a density to the ends of its 95 % interval
    #: dict of str to (f,) arrays; squared coherence of the first model's error with each input
    coherence: Mapping[str, Any]
    by_chance: float  #: What a coherence of independent signals stays below with probability 0.95


def correlation_figure(rows: Mapping[str, Sequence[CorrelationPanel]]) -> Figure:
    """A row a channel, a panel a test; there is at least one of each."""
    columns = max(len(panels) for panels in rows.values())
    with house_style():
        width, height = max(_WIDTH, 1.5 * columns), 0.5 + 1.5 * len(rows)
        figure = new_figure(width, height)
        # Dozens of panels: to arrange themselves takes longer than to draw them.
        figure.set_layout_engine("none")
        grid = figure.subplots(
            len(rows),
            columns,
            squeeze=False,
            gridspec_kw={
                "left": 0.75 / width,
                "right": 1 - 0.1 / width,
                "bottom": 0.45 / height,
                "top": 1 - 0.25 / height,
                "wspace": 0.42,
                "hspace": 0.4,
            },
        )
        for row, (channel, panels) in zip(grid, rows.items(), strict=True):
            for axes in row[len(panels) :]:
                axes.set_visible(False)
            for axes, panel in zip(row, panels, strict=False):
                colour = ALARM if panel.failed else COLOURS[0]
                lags, r = np.asarray(panel.lags), np.asarray(panel.correlations)
                axes.fill_between(lags, -panel.band, panel.band, color=PALE, lw=0, zorder=1)
                axes.plot(lags, r, "o-", ms=2, lw=0.6, color=colour, zorder=3)
                axes.axhline(0.0, color=GREY, lw=0.5, zorder=2)
                reach = 1.25 * float(np.nanmax(np.abs([*r, *panel.band, 1e-3])))
                axes.set_ylim(-reach, reach)
                axes.set_title(panel.title, fontsize=7.5, color=INK, pad=2)
                axes.text(
                    0.98, 0.03, panel.note, transform=axes.transAxes, ha="right", fontsize=7,
                    color=colour,
                )  # fmt: skip
                axes.tick_params(labelsize=7)
                axes.locator_params(nbins=4)
            row[0].set_ylabel(label(channel))
        for axes in grid[-1]:
            axes.set_xlabel("lag [s]", fontsize=8)
        return figure


def spectra_figure(channels: Sequence[ChannelSpectra]) -> Figure:
    """A row a channel: densities, and the coherence of the error with the inputs."""
    with house_style():
        figure = new_figure(_WIDTH, 0.4 + 2.3 * len(channels))
        grid = figure.subplots(len(channels), 2, squeeze=False, sharex=True, width_ratios=[1.5, 1])
        for (left, right), spectra in zip(grid, channels, strict=True):
            f = spectra.frequencies
            left.fill_between(
                f,
                spectra.measured * spectra.interval[0],
                spectra.measured * spectra.interval[1],
                color=PALE,
                lw=0,
                zorder=1,
            )
            left.loglog(f, spectra.measured, color=GREY, lw=2.0, label="measured", zorder=2)
            for i, model in enumerate(spectra.simulated):
                left.loglog(
                    f, spectra.simulated[model], color=colour_of(i), lw=0.9, label=model, zorder=3
                )
                left.loglog(
                    f,
                    spectra.error[model],
                    color=colour_of(i),
                    lw=0.9,
                    ls=":",
                    label=f"error of {model}",
                    zorder=3,
                )
            unit = f"({spectra.unit})" if "/" in spectra.unit else spectra.unit
            left.set_ylabel(f"{label(spectra.channel)}\n[{unit}²/Hz]")
            # what a model without noise lacks at high frequencies shall not flatten the rest
            left.set_ylim(bottom=0.03 * float(np.nanmin(spectra.measured)))
            left.minorticks_off()  # they cost more than all the rest
            legend_above(left, 3)
            for colour, (name, values) in zip(COLOURS, spectra.coherence.items(), strict=False):
                right.semilogx(f, values, color=colour, lw=0.8, label=name)
            right.axhline(spectra.by_chance, color=ALARM, lw=0.8, ls="--", label="by chance")
            right.set_ylim(0.0, 1.02)
            right.set_ylabel("coherence\nof the error")
            right.minorticks_off()
            legend_above(right, 4)
        for panel in grid[-1]:
            panel.set_xlabel("frequency [Hz]")
        return figure


def signal_figure(signals: Sequence[Any], sample_time: float) -> Figure:
    """Amplitude distribution and autocorrelation of every signal, a column a signal.

    Parameters
    ----------
    signals : sequence
        With ``name``, ``unit``, ``counts``, ``edges``, ``autocorrelation``, ``mean``, ``sd``.
    """
    with house_style():
        figure = new_figure(max(4.0, 1.6 * len(signals)), 3.3)
        grid = figure.subplots(2, len(signals), squeeze=False)
        for (above, below), signal in zip(grid.T, signals, strict=True):
            share = signal.counts / max(1.0, float(np.sum(signal.counts)))
            above.stairs(share, signal.edges, fill=True, color=COLOURS[0], alpha=0.75)
            centre = (signal.edges[1:] + signal.edges[:-1]) / 2
            if signal.sd > 0:
                normal = np.exp(-0.5 * ((centre - signal.mean) / signal.sd) ** 2)
                scale = np.diff(signal.edges) / (signal.sd * np.sqrt(2 * np.pi))
                above.plot(centre, normal * scale, color=GREY, lw=0.9, ls="--")
            of = "command " if signal.name.startswith("u_") else ""
            above.set_title(f"{of}{label(signal.name)}", fontsize=8, color=INK)
            above.set_xlabel(f"[{signal.unit}]", fontsize=8)
            lags = np.arange(len(signal.autocorrelation)) * sample_time
            below.plot(lags, signal.autocorrelation, color=COLOURS[0], lw=1.0)
            below.axhline(0.0, color=GREY, lw=0.5)
            below.set_ylim(-1.05, 1.05)
            below.set_xlabel("lag [s]", fontsize=8)
            for panel in (above, below):
                panel.tick_params(labelsize=7)
        grid[0][0].set_ylabel("share")
        grid[1][0].set_ylabel("autocorrelation")
        return figure
