"""The figures of chapter 7."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.chapter7.runs import ANGLES, Outcome
from experiments.chapter7.study import Study
from trms_cli.core.wording import SIGNALS
from trms_cli.reporting.style import (
    ALARM,
    COLOURS,
    GREY,
    INK,
    PALETTE,
    house_style,
    legend_above,
    new_figure,
    save_png,
)

#: Curves that lie on each other: the first one wide and pale, the next narrow.
_OVER_EACH_OTHER = ((PALETTE["sky"], 3.2), (PALETTE["vermilion"], 1.1))
_FORCE = "step with force"
INPUTS = {"u_v": "main rotor", "u_h": "tail rotor"}
_LIMIT = 2.5  #: V
#: Of the force, N m and s: `configs/disturbance/yaw_push.yaml`.
_TORQUE, _FROM = 0.01, 30.0


def draw_cases(outcomes: Sequence[Outcome], path: Path) -> None:
    """Pitch and yaw of each case, one row a case, the pairs over each other."""
    cases = list(dict.fromkeys(outcome.job.case for outcome in outcomes))
    with house_style():
        figure = new_figure(9.0, 1.45 * len(cases) + 0.4)
        panels = figure.subplots(len(cases), 2, squeeze=False)
        for row, case in enumerate(cases):
            members = [o for o in outcomes if o.job.case == case and o.traces]
            for panel, angle in zip(panels[row], ANGLES, strict=True):
                for (colour, width), outcome in zip(_OVER_EACH_OTHER, members, strict=False):
                    traces = outcome.traces
                    panel.plot(
                        traces["time"], traces[angle], color=colour, lw=width,
                        label=outcome.job.pair,
                    )  # fmt: skip
                if members:
                    traces = members[0].traces
                    panel.plot(
                        traces["time"], traces[f"r_{angle}"], color=INK, lw=0.9, ls=(0, (4, 2)),
                        label="reference",
                    )  # fmt: skip
                panel.set_title(f"{case}: {SIGNALS[angle]} [rad]")
                panel.margins(x=0)
        for panel in panels[-1]:
            panel.set_xlabel("time [s]")
        handles, labels = panels[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper left", ncols=len(labels))
        save_png(figure, path)


def draw_inputs(outcomes: Sequence[Outcome], path: Path) -> None:
    """The manipulated signals of each case, one row a case, the pairs over each other."""
    cases = list(dict.fromkeys(outcome.job.case for outcome in outcomes))
    with house_style():
        figure = new_figure(9.0, 1.45 * len(cases) + 0.4)
        panels = figure.subplots(len(cases), 2, squeeze=False, sharey=True)
        for row, case in zip(panels, cases, strict=True):
            members = [o for o in outcomes if o.job.case == case and o.traces]
            for panel, name in zip(row, INPUTS, strict=True):
                for (colour, width), outcome in zip(_OVER_EACH_OTHER, members, strict=False):
                    panel.plot(
                        outcome.traces["time"], outcome.traces[name], color=colour,
                        lw=0.7 * width, label=outcome.job.pair,
                    )  # fmt: skip
                for bound in (-_LIMIT, _LIMIT):
                    panel.axhline(bound, color=ALARM, lw=0.6)
                panel.set_title(f"{case}: {INPUTS[name]} [V]")
                panel.set_yticks([-2.0, 0.0, 2.0])
                panel.margins(x=0)
        for panel in panels[-1]:
            panel.set_xlabel("time [s]")
        handles, labels = panels[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper left", ncols=len(labels))
        save_png(figure, path)


def draw_force(study: Study, outcomes: Sequence[Outcome], path: Path) -> None:
    """The force on yaw: error in encoder steps, the torque that is estimated, the command."""
    members = [o for o in outcomes if o.job.case == _FORCE and o.traces]
    with house_style():
        figure = new_figure(9.0, 5.6)
        error, torque, command = figure.subplots(3, 1, sharex=True)
        for colour, outcome in zip(COLOURS, members, strict=False):
            t = outcome.traces
            time = t["time"]
            steps = (t["r_alpha_h"] - t["alpha_h"]) / study.encoder_step
            error.plot(time, steps, color=colour, lw=1.0, label=outcome.job.pair)
            torque.plot(time, 1e3 * t["d_yaw_moment"], color=colour, lw=1.0)
            command.plot(time, t["u_h"], color=colour, lw=0.8)
        torque.plot(
            [0.0, _FROM, _FROM, members[0].traces["time"][-1]],
            [0.0, 0.0, 1e3 * _TORQUE, 1e3 * _TORQUE],
            color=INK, lw=0.9, ls=(0, (4, 2)), label="the force",
        )  # fmt: skip
        error.set_ylim(-30, 30)
        error.set_title("yaw: reference less angle [encoder steps]", pad=16)
        torque.set_title("estimated torque on yaw [mN m]")
        command.set_title("tail rotor's command [V]")
        command.set_xlabel("time [s]")
        for panel in (error, torque, command):
            panel.axvline(_FROM, color=GREY, lw=0.8)
            panel.margins(x=0)
        torque.legend(loc="lower right")
        legend_above(error)
        save_png(figure, path)


def draw_observers(document: Mapping[str, Any], path: Path) -> None:
    """Errors of the state-dependent EKF beside the UKF's: ratio and interval, by condition."""
    states = {
        "alpha_h": "yaw", "alpha_v": "pitch", "omega_h": "tail rotor", "omega_v": "main rotor",
        "S_h": "S_h", "S_v": "S_v",
    }  # fmt: skip
    kinds = {("all", "estimated"): 0, ("angles", "estimated"): 1, ("all", "none"): 2,
             ("angles", "none"): 3}  # fmt: skip
    kind_labels = ("speeds measured", "angles only", "speeds, no torques", "angles, no torques")
    rigs = list(dict.fromkeys(c["rig"] for c in document["conditions"]))
    with house_style():
        figure = new_figure(9.0, 0.52 * len(rigs) + 1.6)
        panels = figure.subplots(1, len(states), sharey=True)
        for panel, (state, label) in zip(panels, states.items(), strict=True):
            for condition in document["conditions"]:
                kind = kinds[condition["channels"], condition["torques"]]
                mean, low, high = condition["ratio"]["state_dependent_ekf"][state]
                y = rigs.index(condition["rig"]) + 0.2 * (kind - 1.5)
                if low is not None and high is not None:
                    panel.plot([low, high], [y, y], color=COLOURS[kind], lw=1.2)
                legend = kind_labels[kind] if condition["rig"] == rigs[0] else None
                panel.plot(mean, y, "o", ms=3.2, color=COLOURS[kind], label=legend)
            panel.axvline(1.0, color=INK, lw=0.8)
            panel.set_xscale("log")
            _ratio_axis(panel)
            panel.set_title(label)
            panel.grid(axis="y", visible=False)
        panels[0].set_yticks(np.arange(len(rigs)), rigs)
        panels[0].invert_yaxis()
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper left", ncols=4)
        figure.supxlabel("error of the state-dependent EKF / error of the UKF", fontsize=9)
        save_png(figure, path)


def _ratio_axis(panel: Any) -> None:
    """Three or so round ratios around 1."""
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullFormatter, NullLocator

    low, high = panel.get_xlim()
    reach = max(np.log(max(high, 1.0 / low)), 0.03)
    candidates = [(1.02,), (1.05,), (1.1,), (1.2,), (1.5,), (2.0,), (4.0,), (8.0,)]
    step = next((c for (c,) in candidates if np.log(c) >= 0.6 * reach), 8.0)
    panel.set_xlim(np.exp(-1.15 * reach), np.exp(1.15 * reach))
    # Beside 1 a ratio and its opposite look alike; far from it, a half would be in the way of 1.
    ticks = [2.0 - step, 1.0, step] if step < 1.5 else [1.0, step]
    panel.xaxis.set_major_locator(FixedLocator(ticks))
    panel.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.3g}"))
    panel.xaxis.set_minor_locator(NullLocator())
    panel.xaxis.set_minor_formatter(NullFormatter())
