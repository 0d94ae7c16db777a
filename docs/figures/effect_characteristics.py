"""What an effect is, as one panel: its characteristic as the simulation has it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from matplotlib.axes import Axes

from docs.figures.effect_scenes import STEP, SUBSTEPS, FloatArray, Run
from trms_cli.effects.effect import Effect
from trms_cli.reporting.style import GREY, INK, PALETTE, legend_above

NOMINAL, EFFECT = PALETTE["blue"], PALETTE["vermilion"]
LABELS = {
    "alpha_v": "pitch [rad]",
    "alpha_h": "yaw [rad]",
    "omega_v": "main rotor [rad/s]",
    "omega_h": "tail rotor [rad/s]",
}
Characteristic = Callable[[Axes, Run, Effect], None]


def against_rate(angle: str) -> Callable[[Axes, Run, Effect], None]:
    """Torque of the effect against the rate of its axis, as the run has it."""

    def draw(panel: Axes, run: Run, effect: Effect) -> None:
        rate = np.diff(run.states[angle]) / STEP
        panel.plot(rate, _torque(run, angle), ".", color=EFFECT, ms=2.5)
        panel.set_xlabel(LABELS[angle].replace("[rad]", "rate [rad/s]"))
        panel.set_ylabel("torque of the effect [mN m]")

    return draw


def against_angle(angle: str) -> Callable[[Axes, Run, Effect], None]:
    def draw(panel: Axes, run: Run, effect: Effect) -> None:
        torque = _torque(run, angle)
        panel.plot(run.states[angle][1:], torque, ".", color=EFFECT, ms=2.5)
        if np.ptp(torque) < 0.01 * np.abs(torque).max():  # constant, but for rounding
            panel.set_ylim(*sorted((0.0, 1.5 * float(torque.mean()))))
        panel.set_xlabel(LABELS[angle])
        panel.set_ylabel("torque of the effect [mN m]")

    return draw


def _torque(run: Run, angle: str) -> FloatArray:
    """mN m, mean over each step."""
    return 1e3 * run.torque[angle].reshape(-1, SUBSTEPS).mean(axis=1)


def stribeck(panel: Axes, run: Run, effect: Effect) -> None:
    size = _sizes(effect)
    rate = np.diff(run.states["alpha_h"]) / STEP
    reach = np.abs(rate).max()
    law = np.linspace(1e-6, reach, 200)
    torque = 1e3 * size["torque"] * (1 + size["excess"] * np.exp(-((law / size["velocity"]) ** 2)))
    panel.plot(rate, _torque(run, "alpha_h"), ".", color=EFFECT, ms=2.5, label="in the run")
    for sign in (1, -1):
        panel.plot(
            sign * law, -sign * torque, color=INK, ls="--", lw=1.0, label="law" if sign > 0 else ""
        )
    panel.set_xlabel("yaw rate [rad/s]")
    panel.set_ylabel("torque of the effect [mN m]")
    legend_above(panel)


def loop(panel: Axes, run: Run, effect: Effect) -> None:
    memory = next(values for name, values in run.states.items() if name.endswith(".memory"))
    torque = -1e3 * _sizes(effect)["torque"] * memory
    panel.plot(run.states["alpha_h"], torque, color=EFFECT, lw=1.0)
    panel.set_xlabel("yaw [rad]")
    panel.set_ylabel("torque of the effect [mN m]")


def weight(panel: Axes, run: Run, effect: Effect) -> None:
    size = _sizes(effect)
    pitch = run.states["alpha_v"][1:]
    panel.plot(pitch, _torque(run, "alpha_v"), ".", color=EFFECT, ms=2.0, label="in the run")
    at_rest = np.linspace(pitch.min(), pitch.max(), 100)
    arm = size["arm"] * np.cos(at_rest) + size["height"] * np.sin(at_rest)
    weight = 1e3 * size["mass"] * 9.81 * arm
    panel.plot(at_rest, weight, color=INK, ls="--", lw=1.0, label="weight alone")
    panel.set_xlabel("pitch [rad]")
    panel.set_ylabel("torque of the effect [mN m]")
    legend_above(panel)


def phase(panel: Axes, run: Run, effect: Effect) -> None:
    frequency = np.geomspace(0.1, 10, 100)
    (size,) = effect.parameters()
    turns = 2 * np.pi * frequency * size.value
    curves = {"delay": -np.degrees(turns), "lag": -np.degrees(np.arctan(turns))}
    mine = "delay" if size.name == "delay" else "lag"
    for name, values in curves.items():
        colour, line = (EFFECT, "-") if name == mine else (GREY, "--")
        panel.semilogx(frequency, values, color=colour, ls=line, label=name)
    panel.set_xlabel("frequency [Hz]")
    panel.set_ylabel("phase of the drive [°]")
    panel.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    legend_above(panel)


def drive_map(panel: Axes, run: Run, effect: Effect) -> None:
    channel = int(np.argmax(np.abs(run.command).max(axis=0)))
    u = run.command[:, channel]
    order = np.argsort(u)
    panel.plot(u[order], u[order], color=NOMINAL, lw=1.0, ls="--", label="nominal")
    drive = run.arriving[::SUBSTEPS, channel]
    panel.plot(u[order], drive[order], color=EFFECT, label="with the effect")
    panel.set_xlabel("command [V]")
    panel.set_ylabel("drive [V]")
    legend_above(panel)


def gain(panel: Axes, run: Run, effect: Effect) -> None:
    u = np.linspace(0, 2.5, 100)
    panel.plot(u, np.ones_like(u), color=NOMINAL, lw=1.0, ls="--", label="cold")
    warm = 1 - _sizes(effect)["depth"] * (u / 2.5) ** 2
    panel.plot(u, warm, color=EFFECT, label="warm, after a long time")
    panel.set_xlabel("command [V]")
    panel.set_ylabel("gain of the drive [1]")
    legend_above(panel)


def against_speed(speed: str, part: str, of: str = "torque of the effect") -> Characteristic:
    """Torque of the effect on a part of the rig against the speed of a rotor."""

    def draw(panel: Axes, run: Run, effect: Effect) -> None:
        panel.plot(run.states[speed][1:], _torque(run, part), ".", color=EFFECT, ms=2.5)
        panel.set_xlabel(LABELS[speed])
        panel.set_ylabel(f"{of} [mN m]")

    return draw


def against_rate_of(angle: str, part: str) -> Characteristic:
    """Torque on one axis against the rate of the other."""

    def draw(panel: Axes, run: Run, effect: Effect) -> None:
        rate = np.diff(run.states[angle]) / STEP
        panel.plot(rate, _torque(run, part), ".", color=EFFECT, ms=2.5)
        panel.set_xlabel(LABELS[angle].replace("[rad]", "rate [rad/s]"))
        panel.set_ylabel(f"torque on {LABELS[part].split()[0]} [mN m]")

    return draw


def thrust_law(panel: Axes, run: Run, effect: Effect) -> None:
    """Thrust against the speed, without and with the effect."""
    order = np.argsort(run.states["omega_v"][1:])
    speed = run.states["omega_v"][1:][order]
    nominal = run.quantities["thrust_main"][1:][order]
    more = _torque(run, "alpha_v")[order] / 1e3 / run.quantities["arm_main"][1:][order]
    panel.plot(speed, nominal, color=NOMINAL, lw=1.0, ls="--", label="nominal")
    panel.plot(speed, nominal + more, ".", color=EFFECT, ms=2.0, label="with the effect")
    panel.set_xlabel("main rotor [rad/s]")
    panel.set_ylabel("thrust [N]")
    legend_above(panel)


def thrust_share(panel: Axes, run: Run, effect: Effect) -> None:
    """Share of the thrust that the effect adds against the angle."""
    thrust = run.quantities["thrust_main"][1:]
    there = thrust > 0.02  # N
    share = _torque(run, "alpha_v") / 1e3 / run.quantities["arm_main"][1:]
    panel.plot(
        run.states["alpha_v"][1:][there], 100 * (share / thrust)[there], ".", color=EFFECT, ms=2.0
    )
    panel.set_xlabel("pitch [rad]")
    panel.set_ylabel("added thrust [%]")


def sensor_map(angle: str, span: float = np.inf) -> Characteristic:
    """What the sensor shows against what is true, near the middle of the run's range."""

    def draw(panel: Axes, run: Run, effect: Effect) -> None:
        true, shown = run.states[angle], run.readings[angle]
        middle = (true.min() + true.max()) / 2
        near = np.abs(true - middle) < span / 2
        order = np.argsort(true[near])
        true, shown = true[near][order], shown[near][order]
        panel.plot(true, true, color=NOMINAL, lw=1.0, ls="--", label="true")
        panel.plot(true, shown, ".", color=EFFECT, ms=2.5, label="measured")
        panel.set_xlabel(LABELS[angle])
        panel.set_ylabel(f"measured {LABELS[angle]}")
        legend_above(panel)

    return draw


def resonance(panel: Axes, run: Run, effect: Effect) -> None:
    """Gain from the angle of the axis to the measured one."""
    size = _sizes(effect)
    frequency = np.geomspace(0.3, 30, 400)
    s = 1j * frequency / size["frequency"]
    mode = -(s**2) / (s**2 + 2 * size["damping"] * s + 1)
    panel.loglog(frequency, np.abs(1 + size["share"] * mode), color=EFFECT)
    panel.axhline(1.0, color=NOMINAL, lw=1.0, ls="--")
    panel.set_xlabel("frequency [Hz]")
    panel.set_ylabel("measured over true angle [1]")
    panel.xaxis.set_major_formatter(lambda value, _: f"{value:g}")


def memory_of_noise(panel: Axes, run: Run, effect: Effect) -> None:
    """Autocorrelation of the torque in the run, and the law."""
    size = _sizes(effect)
    torque = next(values for name, values in run.states.items() if name.endswith(".torque"))
    lags = np.arange(0, round(4 * size["time"] / STEP), 5)
    own = [np.mean(torque[k:] * torque[: len(torque) - k]) for k in lags]
    panel.plot(lags * STEP, np.array(own) / own[0], color=EFFECT, label="in the run")
    panel.plot(
        lags * STEP, np.exp(-lags * STEP / size["time"]), color=INK, ls="--", lw=1.0, label="law"
    )
    panel.set_xlabel("lag [s]")
    panel.set_ylabel("autocorrelation [1]")
    legend_above(panel)


def _sizes(effect: Effect) -> dict[str, float]:
    return {parameter.name: parameter.value for parameter in effect.parameters()}
