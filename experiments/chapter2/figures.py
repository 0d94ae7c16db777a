"""The figures of the study, in the look of the house."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from experiments.chapter2.axes import Comparison
from experiments.chapter2.bench_tests import BenchRecords
from experiments.chapter2.friction import PROFILES, FrictionStudy
from experiments.chapter2.interface import InterfaceStudy
from experiments.chapter2.paths import Path as SignalPath
from experiments.chapter2.rotors import RotorStudy
from experiments.chapter2.simulation import FloatArray
from trms_cli.reporting.style import (
    COLOURS,
    GREY,
    INK,
    PALE,
    PALETTE,
    house_style,
    legend_above,
    new_figure,
    save_png,
)

_LAGRANGIAN, _NEWTONIAN = PALETTE["sky"], PALETTE["vermilion"]
_LABELS = {"alpha_v": "pitch [rad]", "alpha_h": "yaw [rad]"}
_ROTOR_OF_AXIS = {"v": "main rotor", "h": "tail rotor"}
#: Hz, of the spectra: the rig hardly moves beyond.
_BAND = (0.02, 2.0)


def draw_rotors(rotors: Sequence[RotorStudy], path: Path) -> None:
    """Static curves, steps and sines of each rotor, a row each."""
    with house_style():
        page = new_figure(10.0, 5.2)
        grid = page.subplots(len(rotors), 4, squeeze=False, width_ratios=[1, 1, 1.7, 1.5])
        for row, rotor in zip(grid, rotors, strict=True):
            name = _ROTOR_OF_AXIS[rotor.axis]
            speed, thrust, steps, sines = row
            speed.plot(rotor.commands, rotor.speeds, color=COLOURS[0])
            speed.set(xlabel="command [V]", ylabel=f"{name} [rad/s]", title="speed held")
            thrust.plot(rotor.speeds, rotor.thrusts, color=COLOURS[0])
            thrust.set(xlabel="speed [rad/s]", ylabel="thrust [N]", title="thrust")
            for panel in (speed, thrust):
                panel.axhline(0.0, color=GREY, lw=0.6)
                panel.axvline(0.0, color=GREY, lw=0.6)
            for k, (size, response) in enumerate(rotor.steps.items()):
                omega = response.outputs[f"omega_{rotor.axis}"]
                colour = COLOURS[k % len(COLOURS)]
                steps.plot(response.time, omega, color=colour, label=f"{size:g} V")
            steps.set(xlabel="time [s]", ylabel="[rad/s]", title="steps")
            steps.legend(loc="upper right")
            for k, (frequency, response) in enumerate(rotor.sines.items()):
                omega = response.outputs[f"omega_{rotor.axis}"]
                periods = response.time * frequency
                window = periods >= 4.0
                sines.plot(
                    periods[window] - 4.0,
                    omega[window],
                    color=COLOURS[k],
                    label=f"{frequency:g} Hz",
                )
            sines.set(xlabel="periods", ylabel="[rad/s]")
            legend_above(sines, 3)
        page.align_ylabels()
        save_png(page, path)


def draw_interfaces(circuits: Sequence[InterfaceStudy], path: Path) -> None:
    """Voltage and steady current of each motor against its command."""
    with house_style():
        page = new_figure(10.0, 2.9)
        panels = page.subplots(1, len(circuits) + 1)
        for k, circuit in enumerate(circuits):
            u, panel, colour = circuit.commands, panels[k], COLOURS[k]
            low, high = circuit.linear - circuit.margin, circuit.linear + circuit.margin
            panel.fill_between(u, low, high, color=PALE, label="two sd of the gain")
            panel.plot(u, circuit.linear, color=GREY, lw=1.0, ls="--", label="gain alone")
            panel.plot(u, circuit.limited, color=colour, label=f"limit {circuit.limit:g} V")
            panel.set(xlabel="command [V]", ylabel=f"{circuit.rotor} motor [V]")
            panels[-1].plot(u, circuit.currents, color=colour, label=circuit.rotor)
            panel.legend(loc="upper left")
        panels[-1].set(xlabel="command [V]", ylabel="steady current [A]")
        panels[-1].legend(loc="upper left")
        for panel in panels:
            for limit in (-2.5, 2.5):
                panel.axvline(limit, color=GREY, lw=0.6, ls=":")
        save_png(page, path)


_PROFILE_COLOURS = dict(zip(PROFILES, COLOURS, strict=False))
_PROFILE_NAMES = {
    "viscous": "viscous",
    "Coulomb": "viscous, Coulomb",
    "stiction": "viscous, Coulomb, stiction",
}


def draw_friction(rigs: Sequence[FrictionStudy], path: Path) -> None:
    """A row for each rig: torque over rate, free swing, a slow drive that sticks."""
    with house_style():
        page = new_figure(10.0, 5.2)
        grid = page.subplots(len(rigs), 3, squeeze=False, width_ratios=[1.0, 1.4, 1.4])
        for row, rig in zip(grid, rigs, strict=True):
            law, swing, drive = row
            for profile in PROFILES:
                look = {"color": _PROFILE_COLOURS[profile], "label": _PROFILE_NAMES[profile]}
                law.plot(rig.rates, 1e3 * (rig.viscous + rig.dry[profile]), **look)
                for panel, response in (
                    (swing, rig.swings[profile]),
                    (drive, rig.drives[profile]),
                ):
                    panel.plot(response.time, response.outputs[rig.angle], lw=1.1, **look)
            axis = _LABELS[rig.angle]
            law.axhline(0.0, color=GREY, lw=0.6)
            law.axvline(0.0, color=GREY, lw=0.6)
            law.set(xlabel=axis.replace("[rad]", "rate [rad/s]"), ylabel="friction [mN m]")
            swing.set(xlabel="time [s]", ylabel=axis)
            drive.set(xlabel="time [s]", ylabel=axis)
            swing.set_title("free swing", fontsize=9, pad=3)
            drive.set_title("slow sine of the command", fontsize=9, pad=3)
        _legend(page, grid[0, 0])
        save_png(page, path)


_PAIR_COLUMNS = (("u_v", "command of the main rotor"), ("u_h", "command of the tail rotor"),
                 ("omega", "rotor speeds"))  # fmt: skip


def draw_paths(paths: Sequence[SignalPath], path: Path) -> None:
    """Gain over the largest one, and what is not linear, of each pair."""
    with house_style():
        page = new_figure(10.0, 5.0)
        grid = page.subplots(2, len(_PAIR_COLUMNS), sharex=True, sharey="row")
        for (source, title), (gain, rest) in zip(_PAIR_COLUMNS, grid.T, strict=True):
            pairs = [p for p in paths if p.source.startswith(source)]
            for colour, pair in zip(COLOURS, pairs, strict=False):
                label = f"${_math(pair.source)} \\to {_math(pair.target)}$"
                gain.loglog(
                    pair.frequency, np.abs(pair.response) / pair.peak, color=colour, label=label
                )
                for coherence, line in ((pair.coherence, "-"), (pair.coherence_large, "--")):
                    missing = np.maximum(1 - coherence, 1e-8)
                    rest.loglog(pair.frequency, missing, color=colour, ls=line, lw=1.1)
            gain.set_ylim(1e-3, 1.6)
            legend_above(gain, 3)
            gain.set_title(title, fontsize=9, pad=16)
            rest.set_xlabel("frequency [Hz]")
            rest.set_ylim(1e-7, 1.0)
        grid[0, 0].set_ylabel("gain over its peak")
        grid[1, 0].set_ylabel("1 − coherence")
        save_png(page, path)


def _math(name: str) -> str:
    symbol, _, side = name.partition("_")
    return f"{symbol if symbol == 'u' else chr(92) + symbol}_{side}"


def draw_responses(cases: Sequence[Comparison], angle: str, path: Path) -> None:
    """An angle over time by both models in each case, their difference beneath."""
    rows = -(-len(cases) // 3)
    with house_style():
        page = new_figure(10.0, 2.55 * rows)
        parts = page.subfigures(rows, 3, squeeze=False).ravel()
        for k, (case, part) in enumerate(zip(cases, parts, strict=False)):
            upper, lower = part.subplots(2, 1, sharex=True, height_ratios=[2.4, 1.0])
            time = case.lagrangian.time
            measure = case.lagrangian.outputs[angle]
            response = case.newtonian.outputs[angle]
            upper.plot(time, measure, color=_LAGRANGIAN, lw=2.4, label="Lagrangian")
            upper.plot(time, response, color=_NEWTONIAN, lw=0.9, label="Newtonian")
            lower.plot(time, 1e3 * (response - measure), color=INK, lw=0.8)
            lower.axhline(0.0, color=GREY, lw=0.6)
            touched = case.lagrangian.stopped or case.newtonian.stopped
            title = case.name.replace("_", " ") + (" (stop)" if touched else "")
            upper.set_title(title, fontsize=9, pad=3)
            lower.set_xlim(0.0, time[-1])
            if k % 3 == 0:
                upper.set_ylabel(_LABELS[angle])
                lower.set_ylabel("[mrad]")
            if k >= len(cases) - 3:
                lower.set_xlabel("time [s]")
            part.align_ylabels([upper, lower])
        _legend(page, upper)
        save_png(page, path)


def draw_spectra(cases: Sequence[Comparison], angle: str, path: Path) -> None:
    """Power spectral density of an angle by both models, and of their difference."""
    rows = -(-len(cases) // 3)
    with house_style():
        page = new_figure(10.0, 2.1 * rows)
        grid = page.subplots(rows, 3, sharex=True, squeeze=False)
        for k, (case, panel) in enumerate(zip(cases, grid.ravel(), strict=False)):
            rate = 1 / (case.lagrangian.time[1] - case.lagrangian.time[0])
            measure, response = (r.outputs[angle] for r in (case.lagrangian, case.newtonian))
            for values, colour, width, label in (
                (measure, _LAGRANGIAN, 2.4, "Lagrangian"),
                (response, _NEWTONIAN, 0.9, "Newtonian"),
                (response - measure, INK, 0.7, "their difference"),
            ):
                frequency, density = spectrum(values, rate)
                panel.loglog(frequency, density, color=colour, lw=width, label=label)
            panel.set_xlim(*_BAND)
            panel.set_title(case.name.replace("_", " "), fontsize=9, pad=3)
            if k % 3 == 0:
                panel.set_ylabel("[rad²/Hz]")
            if k >= len(cases) - 3:
                panel.set_xlabel("frequency [Hz]")
        _legend(page, panel)
        save_png(page, path)


def spectrum(values: FloatArray, rate: float) -> tuple[FloatArray, FloatArray]:
    """Welch's estimate over halves of the record, mean removed: Hz, unit²/Hz in the band shown."""
    from scipy.signal import welch

    length = len(values) // 2
    frequency, density = welch(values, rate, nperseg=length, detrend="constant")
    in_band = (frequency >= _BAND[0]) & (frequency <= _BAND[1])
    return frequency[in_band], np.maximum(density[in_band], 1e-16)


def draw_bench_tests(records: BenchRecords, path: Path) -> None:
    """One repetition of each test with what was fitted to it."""
    with house_style():
        page = new_figure(10.0, 4.6)
        grid = page.subplots(2, 3)
        for colour, (rotor, (omega, torque, force)) in zip(
            COLOURS, records.static.items(), strict=False
        ):
            grid[0, 0].plot(omega, 1e3 * torque, "o", color=colour, ms=3, label=rotor)
            grid[0, 1].plot(omega, force, "o", color=colour, ms=3, label=rotor)
        grid[0, 0].set(xlabel="speed [rad/s]", ylabel="motor torque [mN m]")
        grid[0, 1].set(xlabel="speed [rad/s]", ylabel="thrust [N]")
        for panel, (rotor, (time, omega, fitted)) in zip(
            (grid[0, 2], grid[1, 0]), records.run_down.items(), strict=True
        ):
            _fit(panel, time, omega, fitted)
            panel.set(xlabel="time [s]", ylabel=f"{rotor} rotor [rad/s]")
        yaw, moment = records.cable
        grid[1, 1].plot(yaw, 1e3 * moment, "o", color=COLOURS[0], ms=3, label="held by the cable")
        for side in (yaw > 0, yaw < 0):
            slope = float(yaw[side] @ moment[side] / (yaw[side] @ yaw[side]))
            reach = np.array([0.0, yaw[side][np.argmax(np.abs(yaw[side]))]])
            grid[1, 1].plot(reach, 1e3 * slope * reach, color=_NEWTONIAN, lw=1.0)
        grid[1, 1].set(xlabel="yaw [rad]", ylabel="moment [mN m]")
        _fit(grid[1, 2], *records.swing)
        grid[1, 2].set(xlabel="time [s]", ylabel="pitch [rad]")
        for panel in grid.ravel():
            legend_above(panel)
        save_png(page, path)


def _fit(panel: Axes, time: FloatArray, measured: FloatArray, fitted: FloatArray) -> None:
    panel.plot(time, measured, color=_LAGRANGIAN, lw=2.2, label="measured")
    panel.plot(time, fitted, color=_NEWTONIAN, lw=0.9, label="fitted")


def _legend(page: object, panel: Axes) -> None:
    """One legend above all panels."""
    handles, labels = panel.get_legend_handles_labels()
    page.legend(  # type: ignore[attr-defined]
        handles, labels, loc="outside upper left", ncols=len(labels), fontsize=9, frameon=False
    )
