"""The figures of the effect library: what each effect is, and what it does to the rig.

``python -m trms_cli.reporting.effect_figures docs/figures/effects`` draws them all. Each shows the
effect's characteristic as the simulation has it, the command that reveals it, and the response
without and with it.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from trms_cli.effects.effect import Effect
from trms_cli.reporting.effect_scenes import (
    STEP,
    SUBSTEPS,
    FloatArray,
    Run,
    Scene,
    library_effect,
    simulate,
)
from trms_cli.reporting.style import (
    GREY,
    INK,
    PALETTE,
    house_style,
    legend_above,
    new_figure,
    save_png,
)

_NOMINAL, _EFFECT = PALETTE["blue"], PALETTE["vermilion"]
_LABELS = {
    "alpha_v": "pitch [rad]",
    "alpha_h": "yaw [rad]",
    "omega_v": "main rotor [rad/s]",
    "omega_h": "tail rotor [rad/s]",
}


@dataclass(frozen=True, kw_only=True)
class EffectFigure:
    """What a figure shows.

    Attributes
    ----------
    scene : Scene
    shown : str
        State of the response.
    characteristic : callable
        Draws it on a panel from the run with the effect.
    window : (float, float)
        Times shown, s; all by default.
    """

    scene: Scene
    shown: str
    characteristic: Callable[[Axes, Run, Effect], None]
    window: tuple[float, float] | None = None


# Characteristics


def _against_rate(angle: str) -> Callable[[Axes, Run, Effect], None]:
    """Torque of the effect against the rate of its axis, as the run has it."""

    def draw(panel: Axes, run: Run, effect: Effect) -> None:
        rate = np.diff(run.states[angle]) / STEP
        panel.plot(rate, _torque(run, angle), ".", color=_EFFECT, ms=2.5)
        panel.set_xlabel(_LABELS[angle].replace("[rad]", "rate [rad/s]"))
        panel.set_ylabel("torque of the effect [mN m]")

    return draw


def _against_angle(angle: str) -> Callable[[Axes, Run, Effect], None]:
    def draw(panel: Axes, run: Run, effect: Effect) -> None:
        panel.plot(run.states[angle][1:], _torque(run, angle), ".", color=_EFFECT, ms=2.5)
        panel.set_xlabel(_LABELS[angle])
        panel.set_ylabel("torque of the effect [mN m]")

    return draw


def _torque(run: Run, angle: str) -> FloatArray:
    """mN m, mean over each step."""
    return 1e3 * run.torque[angle].reshape(-1, SUBSTEPS).mean(axis=1)


def _stribeck(panel: Axes, run: Run, effect: Effect) -> None:
    size = _sizes(effect)
    rate = np.diff(run.states["alpha_h"]) / STEP
    reach = np.abs(rate).max()
    law = np.linspace(1e-6, reach, 200)
    torque = 1e3 * size["torque"] * (1 + size["excess"] * np.exp(-((law / size["velocity"]) ** 2)))
    panel.plot(rate, _torque(run, "alpha_h"), ".", color=_EFFECT, ms=2.5, label="in the run")
    for sign in (1, -1):
        panel.plot(
            sign * law, -sign * torque, color=INK, ls="--", lw=1.0, label="law" if sign > 0 else ""
        )
    panel.set_xlabel("yaw rate [rad/s]")
    panel.set_ylabel("torque of the effect [mN m]")
    legend_above(panel)


def _loop(panel: Axes, run: Run, effect: Effect) -> None:
    memory = next(values for name, values in run.states.items() if name.endswith(".memory"))
    torque = -1e3 * _sizes(effect)["torque"] * memory
    panel.plot(run.states["alpha_h"], torque, color=_EFFECT, lw=1.0)
    panel.set_xlabel("yaw [rad]")
    panel.set_ylabel("torque of the effect [mN m]")


def _weight(panel: Axes, run: Run, effect: Effect) -> None:
    size = _sizes(effect)
    pitch = run.states["alpha_v"][1:]
    panel.plot(pitch, _torque(run, "alpha_v"), ".", color=_EFFECT, ms=2.0, label="in the run")
    at_rest = np.linspace(pitch.min(), pitch.max(), 100)
    arm = size["arm"] * np.cos(at_rest) + size["height"] * np.sin(at_rest)
    weight = 1e3 * size["mass"] * 9.81 * arm
    panel.plot(at_rest, weight, color=INK, ls="--", lw=1.0, label="weight alone")
    panel.set_xlabel("pitch [rad]")
    panel.set_ylabel("torque of the effect [mN m]")
    legend_above(panel)


def _phase(panel: Axes, run: Run, effect: Effect) -> None:
    frequency = np.geomspace(0.1, 10, 100)
    (size,) = effect.parameters()
    turns = 2 * np.pi * frequency * size.value
    curves = {"delay": -np.degrees(turns), "lag": -np.degrees(np.arctan(turns))}
    mine = "delay" if size.name == "delay" else "lag"
    for name, values in curves.items():
        colour, line = (_EFFECT, "-") if name == mine else (GREY, "--")
        panel.semilogx(frequency, values, color=colour, ls=line, label=name)
    panel.set_xlabel("frequency [Hz]")
    panel.set_ylabel("phase of the drive [°]")
    panel.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    legend_above(panel)


def _map(panel: Axes, run: Run, effect: Effect) -> None:
    channel = int(np.argmax(np.abs(run.command).max(axis=0)))
    u = run.command[:, channel]
    order = np.argsort(u)
    panel.plot(u[order], u[order], color=_NOMINAL, lw=1.0, ls="--", label="nominal")
    drive = run.arriving[::SUBSTEPS, channel]
    panel.plot(u[order], drive[order], color=_EFFECT, label="with the effect")
    panel.set_xlabel("command [V]")
    panel.set_ylabel("drive [V]")
    legend_above(panel)


def _gain(panel: Axes, run: Run, effect: Effect) -> None:
    u = np.linspace(0, 2.5, 100)
    panel.plot(u, np.ones_like(u), color=_NOMINAL, lw=1.0, ls="--", label="cold")
    warm = 1 - _sizes(effect)["depth"] * (u / 2.5) ** 2
    panel.plot(u, warm, color=_EFFECT, label="warm, after a long time")
    panel.set_xlabel("command [V]")
    panel.set_ylabel("gain of the drive [1]")
    legend_above(panel)


def _sizes(effect: Effect) -> dict[str, float]:
    return {parameter.name: parameter.value for parameter in effect.parameters()}


# Commands

Command = Callable[[FloatArray], FloatArray]


def _tail(wave: Command) -> Command:
    return lambda t: np.column_stack([np.zeros_like(t), wave(t)])


def _main(wave: Command) -> Command:
    return lambda t: np.column_stack([wave(t), np.zeros_like(t)])


def _triangle(t: FloatArray, period: float) -> FloatArray:
    return 2 / np.pi * np.arcsin(np.sin(2 * np.pi * t / period))


def _steps(levels: Sequence[float], each: float) -> Command:
    return lambda t: np.asarray(levels)[np.minimum((t / each).astype(int), len(levels) - 1)]


def _square(t: FloatArray) -> FloatArray:
    return np.where(t % 1.0 < 0.5, 1.0, -1.0)


FIGURES = {
    "coulomb_friction": EffectFigure(
        scene=Scene(
            effect="yaw_coulomb_friction",
            command=_tail(_steps([0.6, 0.0, -0.6, 0.0], 10.0)),
            duration=40.0,
        ),
        shown="alpha_h",
        characteristic=_against_rate("alpha_h"),
    ),
    "stribeck_friction": EffectFigure(
        scene=Scene(
            effect="yaw_stribeck_friction",
            command=_tail(lambda t: 0.8 * _triangle(t, 80.0)),
            duration=120.0,
            sizes={"torque": 0.004, "excess": 1.0, "velocity": 0.05},
        ),
        shown="alpha_h",
        characteristic=_stribeck,
    ),
    "quadratic_damping": EffectFigure(
        scene=Scene(
            effect="pitch_quadratic_damping",
            command=_main(lambda t: np.where(t < 8.0, 0.6 + 0.6 * _square(t / 3.2), 0.0)),
            duration=25.0,
        ),
        shown="alpha_v",
        characteristic=_against_rate("alpha_v"),
    ),
    "cable_stiffness": EffectFigure(
        scene=Scene(
            effect="yaw_cable_stiffness",
            command=_tail(_steps([0.4, 0.8, 0.0, -0.6], 15.0)),
            duration=60.0,
            sizes={"cubic": 0.006},
        ),
        shown="alpha_h",
        characteristic=_against_angle("alpha_h"),
    ),
    "cable_hysteresis": EffectFigure(
        scene=Scene(
            effect="yaw_cable_hysteresis",
            command=_tail(lambda t: np.where(t > 40, 0.65, 0.3) * np.sin(2 * np.pi * t / 20.0)),
            duration=80.0,
        ),
        shown="alpha_h",
        characteristic=_loop,
    ),
    "mass_imbalance": EffectFigure(
        scene=Scene(
            effect="pitch_mass_imbalance",
            command=_main(_steps([0.0, 1.0, 1.4], 20.0)),
            duration=60.0,
        ),
        shown="alpha_v",
        characteristic=_weight,
    ),
    "input_delay": EffectFigure(
        scene=Scene(
            effect="tail_input_delay", command=_tail(_square), duration=6.0, sizes={"delay": 0.05}
        ),
        shown="omega_h",
        characteristic=_phase,
        window=(4.4, 6.0),
    ),
    "actuator_lag": EffectFigure(
        scene=Scene(
            effect="tail_actuator_lag",
            command=_tail(_square),
            duration=6.0,
            sizes={"time_constant": 0.05},
        ),
        shown="omega_h",
        characteristic=_phase,
        window=(4.4, 6.0),
    ),
    "dead_zone": EffectFigure(
        scene=Scene(
            effect="tail_dead_zone",
            command=_tail(lambda t: 0.3 * np.sin(2 * np.pi * t / 10.0)),
            duration=20.0,
        ),
        shown="omega_h",
        characteristic=_map,
    ),
    "supply_derating": EffectFigure(
        scene=Scene(
            effect="main_supply_derating",
            command=_main(lambda t: 2.0 * np.minimum(t / 40.0, 1.0)),
            duration=160.0,
        ),
        shown="alpha_v",
        characteristic=_gain,
    ),
}


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
            (nominal, _NOMINAL, "nominal"),
            (run, _EFFECT, "with the effect"),
        ):
            response.plot(each.time, each.states[figure.shown], color=colour, label=label)
        response.set_ylabel(_LABELS[figure.shown])
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
            panel.step(fine, run.arriving[:, k], where="post", color=_EFFECT, label=label)
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
