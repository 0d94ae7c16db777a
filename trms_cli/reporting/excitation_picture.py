"""One picture of an excitation: what it is, what it excites, and where the rig goes with it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.gridspec import GridSpec

from trms_cli.reporting.style import (
    ALARM,
    COLOURS,
    GREY,
    INK,
    LABELS,
    PALE,
    house_style,
    legend_above,
    new_figure,
    save_png,
    thinned,
)

FloatArray = npt.NDArray[np.float64]
_WIDTH, _HEIGHT = 11.0, 11.5


@dataclass(frozen=True)
class ExcitationFigures:
    """What is drawn; arrays over time begin with the lead-in."""

    time: FloatArray  #: (n,) array; s
    first: int  #: Sample at which the excitation begins
    commands: dict[str, FloatArray]  #: dict of str to (n,) array
    units: dict[str, str]  #: Of inputs and outputs
    outputs: dict[str, FloatArray]  #: dict of str to (n,) array; of the simulated rig
    bounds: dict[str, float]  #: Of the angles, rad
    #: dict of str to (m,) array; rates of the angles during the excitation, rad/s
    rates: dict[str, FloatArray]
    band: tuple[float, float]  #: Hz
    poles: tuple[float, float]  #: Distances of the slowest and the fastest pole from zero, Hz
    frequencies: FloatArray  #: (k,) array; hz
    #: ``input_densities``, ``output_densities``: dict of str to (k,) array; power spectral
    #: densities
    input_densities: dict[str, FloatArray]
    output_densities: dict[str, FloatArray]
    noise: dict[str, float]  #: The same of each output's noise
    #: dict of (str, str) to (k,) array; magnitude of the linearised response of an output to an
    #: input
    responses: dict[tuple[str, str], FloatArray]


def draw_excitation(figures: ExcitationFigures, path: Path, *, title: str = "") -> None:
    """Draw an excitation as a PNG.

    Parameters
    ----------
    figures : ExcitationFigures
    path : Path
        File to write.
    title : str
    """
    with house_style():
        save_png(_figure(figures, title), path)


def _figure(f: ExcitationFigures, title: str) -> Figure:
    figure = new_figure(_WIDTH, _HEIGHT)
    grid = figure.add_gridspec(5, 6, height_ratios=(1.0, 1.0, 1.35, 1.35, 1.35))
    commands, angles = figure.add_subplot(grid[0, :]), figure.add_subplot(grid[1, :])
    _draw_time(commands, f, f.commands, "command")
    shown = _bounded(f)
    what = "angle" if f.bounds else "speed"
    _draw_time(angles, f, {n: f.outputs[n] for n in shown}, what)
    colours = dict(zip(f.bounds, COLOURS, strict=False))
    for limits in {round(limit, 6) for limit in f.bounds.values()}:
        owner = next(n for n, limit in f.bounds.items() if round(limit, 6) == limits)
        for side in (-limits, limits):
            angles.axhline(side, color=colours[owner], lw=0.8, ls=(0, (4, 2)))
    angles.set_xlabel("time [s], the bounds of the angles dashed" if f.bounds else "time [s]")
    _draw_inputs(figure.add_subplot(grid[2, :3]), f)
    _draw_responses(figure.add_subplot(grid[2, 3:]), f)
    _draw_outputs(figure.add_subplot(grid[3, :3]), f, shown)
    speeds = [n for n in f.outputs if n not in shown]
    if speeds:
        _draw_outputs(figure.add_subplot(grid[3, 3:]), f, speeds)
    _draw_states(figure, grid, f)
    figure.suptitle(title, x=0.01, ha="left", fontsize=11, fontweight="bold", color=INK)
    return figure


def _bounded(f: ExcitationFigures) -> list[str]:
    """Outputs with a bound; of a rotor alone, which has none, those in the unit of the first."""
    unit = f.units[next(iter(f.outputs))]
    alike = [name for name in f.outputs if f.units[name] == unit]
    return [name for name in f.outputs if name in f.bounds] or alike


def _draw_time(
    panel: Axes, f: ExcitationFigures, signals: dict[str, FloatArray], what: str
) -> None:
    for colour, (name, values) in zip(COLOURS, signals.items(), strict=False):
        time, drawn = thinned(f.time, values)
        style = "steps-post" if what == "command" else "default"
        label = LABELS.get(name, name) + (f" {name}" if what == "command" else "")
        panel.plot(time, drawn, color=colour, lw=0.8, drawstyle=style, label=label)
    begin = float(f.time[f.first]) if f.first < len(f.time) else 0.0
    if begin > 0:
        panel.axvspan(0, begin, color=PALE, alpha=0.5, lw=0, zorder=0)
    panel.set_xlim(float(f.time[0]), float(f.time[-1]))
    unit = f.units[next(iter(signals))]
    panel.set_ylabel(f"{what} [{unit}]")
    legend_above(panel)


def _draw_inputs(panel: Axes, f: ExcitationFigures) -> None:
    for colour, (name, density) in zip(COLOURS, f.input_densities.items(), strict=False):
        # Below the resolution of a multisine's lines there is nothing to be shown.
        shown = np.where(density > 1e-6 * density.max(), density, np.nan)
        panel.step(f.frequencies, shown, where="mid", color=colour, label=f"{name}")
    unit = f.units[next(iter(f.input_densities))]
    _dress_spectrum(panel, f, f"input [{unit}²/Hz]" if unit != "1" else "input [1/Hz]")


def _draw_responses(panel: Axes, f: ExcitationFigures) -> None:
    dashes, shown = ("-", (0, (4, 2))), _bounded(f)
    for colour, output in zip(COLOURS, shown, strict=False):
        inputs = [name for out, name in f.responses if out == output]
        for dash, name in zip(dashes, inputs, strict=False):
            response = f.responses[output, name]
            if not np.any(response > 1e-9):
                continue
            label = f"{LABELS.get(output, output)} / {name}"
            panel.plot(f.frequencies, response, color=colour, ls=dash, lw=1.2, label=label)
    units = {f.units[name] for name in f.commands}
    _dress_spectrum(panel, f, f"model's response [{f.units[shown[0]]}/{'/'.join(units)}]")


def _draw_outputs(panel: Axes, f: ExcitationFigures, chosen: list[str]) -> None:
    for colour, name in zip(COLOURS, chosen, strict=False):
        panel.step(
            f.frequencies, f.output_densities[name], where="mid", color=colour,
            label=LABELS.get(name, name),
        )  # fmt: skip
    for colour, name in zip(COLOURS, chosen, strict=False):
        panel.axhline(f.noise[name], color=colour, lw=0.9, ls=(0, (1, 1.5)))
    if chosen:
        panel.plot([], [], color=GREY, lw=0.9, ls=(0, (1, 1.5)), label="noise")
    unit = f.units[chosen[0]] if chosen else ""
    _dress_spectrum(panel, f, f"output [({unit})²/Hz]")


def _dress_spectrum(panel: Axes, f: ExcitationFigures, label: str) -> None:
    panel.set_xscale("log")
    panel.set_xlim(0.9 * float(f.frequencies[0]), 1.1 * float(f.frequencies[-1]))
    panel.set_yscale("log")
    panel.axvspan(*f.band, color=PALE, alpha=0.45, lw=0, zorder=0)
    for pole in f.poles:
        panel.axvline(pole, color=GREY, lw=0.8, ls=(0, (4, 2)), zorder=1)
    panel.set_ylabel(label)
    panel.set_xlabel("frequency [Hz]; the band shaded, the slowest and fastest pole dashed")
    panel.xaxis.label.set_fontsize(8)
    legend_above(panel)


def _draw_states(figure: Figure, grid: GridSpec, f: ExcitationFigures) -> None:
    """Where the rig goes: angle over rotor speed, rates, and rotor speeds."""
    pairs = [
        (angle, speed)
        for angle, speed in (("alpha_v", "omega_v"), ("alpha_h", "omega_h"))
        if angle in f.outputs and speed in f.outputs
    ]
    for i, (angle, speed) in enumerate(pairs):
        panel = figure.add_subplot(grid[4, 2 * i : 2 * i + 2])
        x, y = f.outputs[speed][f.first :], f.outputs[angle][f.first :]
        panel.plot(x, y, color=COLOURS[i], lw=0.5)
        for side in (-1, 1):
            panel.axhline(side * f.bounds[angle], color=ALARM, lw=0.8, ls=(0, (4, 2)))
        panel.set_xlabel(f"{LABELS[speed]} [rad/s]")
        panel.set_ylabel(f"{LABELS[angle]} [rad]")
    if not f.rates:
        return
    panel = figure.add_subplot(grid[4, 2 * len(pairs) :])
    for colour, (name, rate) in zip(COLOURS, f.rates.items(), strict=False):
        panel.hist(
            rate, bins=60, density=True, histtype="step", color=colour,
            label=LABELS.get(name, name),
        )  # fmt: skip
    panel.set_xlabel("rate [rad/s]")
    panel.set_ylabel("share [s/rad]")
    legend_above(panel)
