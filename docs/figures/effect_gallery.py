"""The figures of the effect library: what each effect is, and what it does to the rig.

``python -m docs.figures.effect_gallery docs/figures/effects`` draws them all. Each shows the
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

from docs.figures.effect_characteristics import (
    EFFECT,
    LABELS,
    NOMINAL,
    Characteristic,
    against_angle,
    against_rate,
    against_rate_of,
    against_speed,
    drive_map,
    gain,
    loop,
    memory_of_noise,
    phase,
    resonance,
    sensor_map,
    stribeck,
    thrust_law,
    thrust_share,
    weight,
)
from docs.figures.effect_scenes import (
    STEP,
    SUBSTEPS,
    FloatArray,
    Run,
    Scene,
    library_effect,
    simulate,
)
from trms_cli.effects.effect import Effect
from trms_cli.reporting.style import INK, house_style, legend_above, new_figure, save_png


@dataclass(frozen=True, kw_only=True)
class EffectFigure:
    """What a figure shows."""

    scene: Scene
    shown: str  #: State of the response, or what is measured of it
    characteristic: Characteristic  #: Draws it on a panel from the run with the effect
    window: tuple[float, float] | None = None  #: Times shown, s; all by default
    measured: bool = False  #: Whether what the sensor shows is drawn, in place of the state


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
        characteristic=against_rate("alpha_h"),
    ),
    "stribeck_friction": EffectFigure(
        scene=Scene(
            effect="yaw_stribeck_friction",
            command=_tail(lambda t: 0.8 * _triangle(t, 80.0)),
            duration=120.0,
            sizes={"torque": 0.004, "excess": 1.0, "velocity": 0.05},
        ),
        shown="alpha_h",
        characteristic=stribeck,
    ),
    "quadratic_damping": EffectFigure(
        scene=Scene(
            effect="pitch_quadratic_damping",
            command=_main(lambda t: np.where(t < 8.0, 0.6 + 0.6 * _square(t / 3.2), 0.0)),
            duration=25.0,
        ),
        shown="alpha_v",
        characteristic=against_rate("alpha_v"),
    ),
    "cable_stiffness": EffectFigure(
        scene=Scene(
            effect="yaw_cable_stiffness",
            command=_tail(_steps([0.4, 0.8, 0.0, -0.6], 15.0)),
            duration=60.0,
            sizes={"cubic": 0.006},
        ),
        shown="alpha_h",
        characteristic=against_angle("alpha_h"),
    ),
    "cable_hysteresis": EffectFigure(
        scene=Scene(
            effect="yaw_cable_hysteresis",
            command=_tail(lambda t: np.where(t > 40, 0.65, 0.3) * np.sin(2 * np.pi * t / 20.0)),
            duration=80.0,
        ),
        shown="alpha_h",
        characteristic=loop,
    ),
    "mass_imbalance": EffectFigure(
        scene=Scene(
            effect="pitch_mass_imbalance",
            command=_main(_steps([0.0, 1.0, 1.4], 20.0)),
            duration=60.0,
        ),
        shown="alpha_v",
        characteristic=weight,
    ),
    "input_delay": EffectFigure(
        scene=Scene(
            effect="tail_input_delay", command=_tail(_square), duration=6.0, sizes={"delay": 0.05}
        ),
        shown="omega_h",
        characteristic=phase,
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
        characteristic=phase,
        window=(4.4, 6.0),
    ),
    "dead_zone": EffectFigure(
        scene=Scene(
            effect="tail_dead_zone",
            command=_tail(lambda t: 0.3 * np.sin(2 * np.pi * t / 10.0)),
            duration=20.0,
        ),
        shown="omega_h",
        characteristic=drive_map,
    ),
    "supply_derating": EffectFigure(
        scene=Scene(
            effect="main_supply_derating",
            command=_main(lambda t: 2.0 * np.minimum(t / 40.0, 1.0)),
            duration=160.0,
        ),
        shown="alpha_v",
        characteristic=gain,
    ),
    "rotor_friction": EffectFigure(
        scene=Scene(
            effect="tail_rotor_friction",
            command=_tail(lambda t: 0.4 * _triangle(t, 16.0)),
            duration=32.0,
        ),
        shown="omega_h",
        characteristic=against_speed("omega_h", "omega_h", "torque on the rotor"),
    ),
    "thrust_curve": EffectFigure(
        scene=Scene(
            effect="main_thrust_curve",
            command=_main(lambda t: 0.7 + 1.1 * _triangle(t, 60.0)),
            duration=90.0,
            sizes={"reverse": -0.3},
        ),
        shown="alpha_v",
        characteristic=thrust_law,
    ),
    "rotor_reaction": EffectFigure(
        scene=Scene(
            effect="main_reaction_on_yaw",
            command=_main(_steps([0.6, 1.4, 0.0], 20.0)),
            duration=60.0,
            sizes={"inertia": 1e-4},
        ),
        shown="alpha_h",
        characteristic=against_speed("omega_v", "alpha_h", "torque on yaw"),
    ),
    "gyroscopic_coupling": EffectFigure(
        scene=Scene(
            effect="gyroscopic_coupling",
            command=lambda t: np.column_stack(
                [np.full_like(t, 0.9), 1.2 * np.sin(2 * np.pi * t / 3.6)]
            ),
            duration=30.0,
        ),
        shown="alpha_v",
        characteristic=against_rate_of("alpha_h", "alpha_v"),
    ),
    "inflow": EffectFigure(
        scene=Scene(
            effect="main_inflow",
            command=_main(lambda t: np.where(t < 8.0, 1.0 + 0.5 * _square(t / 3.2), 1.2)),
            duration=25.0,
        ),
        shown="alpha_v",
        characteristic=against_rate("alpha_v"),
    ),
    "ground_effect": EffectFigure(
        scene=Scene(
            effect="ground_effect",
            command=_main(lambda t: 1.4 * np.minimum(t / 50.0, 1.0)),
            duration=60.0,
        ),
        shown="alpha_v",
        characteristic=thrust_share,
    ),
    "sensor_bias": EffectFigure(
        scene=Scene(
            effect="pitch_sensor_bias",
            command=_main(_steps([0.4, 0.8, 1.2], 15.0)),
            duration=45.0,
            sizes={"bias": 0.035},
        ),
        shown="alpha_v",
        characteristic=sensor_map("alpha_v"),
        measured=True,
    ),
    "sensor_delay": EffectFigure(
        scene=Scene(
            effect="yaw_sensor_delay",
            command=_tail(lambda t: 0.9 * _square(t / 4.0)),
            duration=12.0,
            sizes={"delay": 0.1},
        ),
        shown="alpha_h",
        characteristic=sensor_map("alpha_h"),
        window=(4.0, 10.0),
        measured=True,
    ),
    "quantisation": EffectFigure(
        scene=Scene(
            effect="yaw_quantisation",
            command=_tail(lambda t: 0.25 * np.sin(2 * np.pi * t / 8.0)),
            duration=24.0,
        ),
        shown="alpha_h",
        characteristic=sensor_map("alpha_h", 0.06),
        window=(8.0, 16.0),
        measured=True,
    ),
    "tacho_lag": EffectFigure(
        scene=Scene(
            effect="tail_tacho_lag",
            command=_tail(_square),
            duration=6.0,
            sizes={"time_constant": 0.1},
        ),
        shown="omega_h",
        characteristic=phase,
        window=(4.4, 6.0),
        measured=True,
    ),
    "flexible_mode": EffectFigure(
        scene=Scene(
            effect="pitch_flexible_mode",
            command=_main(lambda t: np.where(t % 4.0 < 0.3, 2.5, 0.9)),
            duration=16.0,
            sizes={"frequency": 2.0},
        ),
        shown="alpha_v",
        characteristic=resonance,
        window=(8.0, 14.0),
        measured=True,
    ),
    "disturbance": EffectFigure(
        scene=Scene(
            effect="yaw_disturbance",
            command=_tail(_steps([0.4, 0.4], 200.0)),
            duration=400.0,
        ),
        shown="alpha_h",
        characteristic=memory_of_noise,
        window=(0.0, 120.0),
    ),
    "constant_torque": EffectFigure(
        scene=Scene(
            effect="pitch_constant_torque",
            command=_main(_steps([0.4, 0.8, 1.2], 15.0)),
            duration=45.0,
        ),
        shown="alpha_v",
        characteristic=against_angle("alpha_v"),
    ),
    "residual_force": EffectFigure(
        scene=Scene(
            effect="yaw_residual_force",
            command=_tail(lambda t: 0.5 * _triangle(t, 60.0)),
            duration=60.0,
        ),
        shown="alpha_h",
        characteristic=against_angle("alpha_h"),
    ),
    "residual_reading": EffectFigure(
        scene=Scene(
            effect="pitch_residual_reading",
            command=_main(_steps([0.4, 0.8, 1.2], 15.0)),
            duration=45.0,
        ),
        shown="alpha_v",
        characteristic=sensor_map("alpha_v"),
        measured=True,
    ),
    "model_form": EffectFigure(
        scene=Scene(
            effect="yaw_model_form",
            command=_tail(lambda t: 0.6 * _square(t / 8.0)),
            duration=40.0,
            sizes={"damping": 0.3},
        ),
        shown="alpha_h",
        characteristic=against_rate("alpha_h"),
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
