"""The figures of the effect library: what each effect is, and what it does to the rig.

``python -m trms_cli.reporting.effect_figures docs/figures/effects`` draws them all. Each shows the
effect's characteristic as the simulation has it, the command that reveals it, and the response
without and with it.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from trms_cli.effects.effect import Effect
from trms_cli.reporting.effect_characteristics import EFFECT, LABELS, NOMINAL
from trms_cli.reporting.effect_gallery import FIGURES, EffectFigure
from trms_cli.reporting.effect_scenes import STEP, SUBSTEPS, Run, Scene, library_effect, simulate
from trms_cli.reporting.style import INK, house_style, legend_above, new_figure, save_png


def draw(figure: EffectFigure, path: Path) -> None:
    """Draw a figure as a PNG: characteristic, command, response."""
    scene = figure.scene
    effect = library_effect(scene.effect, scene.sizes)
    nominal = simulate(scene, {})
    run = simulate(scene, {scene.effect: effect})
    with house_style():
        page = new_figure(9.0, 3.3)
        panels = page.subplot_mosaic(
            [["characteristic", "command"], ["characteristic", "response"]],
            width_ratios=[1.0, 1.9],
            height_ratios=[1.0, 1.6],
        )
        characteristic, command, response = panels.values()
        figure.characteristic(characteristic, run, effect)
        if characteristic.get_xscale() == "linear":
            characteristic.xaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
        _draw_command(command, run)
        for each, colour, label in (
            (nominal, NOMINAL, "nominal"),
            (run, EFFECT, "with the effect"),
        ):
            values = (each.readings if figure.measured else each.states)[figure.shown]
            response.plot(each.time, values, color=colour, label=label)
        response.set_ylabel(("measured " if figure.measured else "") + LABELS[figure.shown])
        response.set_xlabel("time [s]")
        legend_above(response)
        for panel in (command, response):
            panel.set_xlim(figure.window or (0.0, scene.duration))
        command.tick_params(labelbottom=False)
        page.align_ylabels([command, response])
        page.suptitle(
            _title(scene, effect), x=0.01, ha="left", fontsize=10, fontweight="bold", color=INK
        )
        save_png(page, path)


def _draw_command(panel: Axes, run: Run) -> None:
    fine = np.arange(len(run.arriving)) * STEP / SUBSTEPS
    for k in np.flatnonzero(np.any(run.command != 0.0, axis=0)):
        label = f"command, {('main', 'tail')[k]} rotor"
        panel.step(run.time[:-1], run.command[:, k], where="post", color=INK, label=label)
        if np.any(run.arriving[:, k] != np.repeat(run.command[:, k], SUBSTEPS)):
            label = "reaches the motor"
            panel.step(fine, run.arriving[:, k], where="post", color=EFFECT, label=label)
    panel.set_ylabel("[V]")
    panel.margins(y=0.12)
    legend_above(panel)


_EXPONENTS = str.maketrans({"*": " ", "^": "", "2": "²", "3": "³"})


def _title(scene: Scene, effect: Effect) -> str:
    sizes = [
        f"{size.name.replace('_', ' ')} {size.value:g}"
        + (f" {size.unit.translate(_EXPONENTS)}" if size.unit != "1" else "")
        for size in effect.parameters()
    ]
    return f"{scene.effect}: {', '.join(sizes)}"


def draw_all(folder: Path, names: Sequence[str] = ()) -> list[Path]:
    """Draw the named figures (all by default) into a folder, each as ``<name>.png``."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for name in names or FIGURES:
        paths.append(folder / f"{name}.png")
        draw(FIGURES[name], paths[-1])
    return paths


def main(argv: Sequence[str] | None = None) -> None:
    """Command line of this module."""
    parser = argparse.ArgumentParser(description="Draw the figures of the effect library.")
    parser.add_argument("folder", type=Path)
    parser.add_argument("names", nargs="*", help=f"of {', '.join(FIGURES)}; all by default")
    arguments = parser.parse_args(argv)
    for path in draw_all(arguments.folder, arguments.names):
        print(path)


if __name__ == "__main__":
    main()
