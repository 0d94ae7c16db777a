"""The figures of the study, in the look of the house."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.ticker import MaxNLocator

from experiments.chapter8.domain import Map
from experiments.chapter8.laws import LawResult
from experiments.chapter8.runs import Ran
from experiments.chapter8.study import FloatArray
from trms_cli.reporting.style import (
    GREY,
    INK,
    PALE,
    PALETTE,
    SHADES,
    house_style,
    new_figure,
    save_png,
)

_LOOKS = {
    "sub-polytope": (PALETTE["blue"], 2.0),
    "fixed region": (PALETTE["sky"], 1.2),
    "own Lyapunov": (PALETTE["purple"], 1.2),
    "speed, no thrust": (PALETTE["orange"], 1.2),
    "offline": (PALETTE["green"], 1.4),
    "newton_mpc": (INK, 1.0),
}


def draw_runs(runs: Sequence[Ran], observer: str, path: Path) -> None:
    """Yaw, pitch and both commands from each start, a column each."""
    runs = [r for r in runs if r.case.observer == observer]
    starts = list(dict.fromkeys(r.case.start for r in runs))
    rows = [
        ("angles", "alpha_h", "yaw [rad]"),
        ("angles", "alpha_v", "pitch [rad]"),
        ("commands", "u_v", "main rotor [V]"),
        ("commands", "u_h", "tail rotor [V]"),
    ]
    with house_style():
        page = new_figure(10.0, 7.6)
        grid = page.subplots(4, len(starts), sharex=True, sharey="row", squeeze=False)
        for column, start in enumerate(starts):
            for (kind, name, label), panel in zip(rows, grid[:, column], strict=True):
                panel.axhline(0.0, color=GREY, lw=0.6)
                for r in runs:
                    if r.case.start == start:
                        colour, width = _LOOKS[r.case.controller]
                        values = getattr(r, kind)[name]
                        panel.plot(r.time, values, color=colour, lw=width, label=r.case.controller)
                if column == 0:
                    panel.set_ylabel(label)
            grid[0, column].set_title(f"yaw {start[0]:g}, pitch {start[1]:g} rad", fontsize=9)
            grid[-1, column].set_xlabel("time [s]")
        page.align_ylabels()
        handles, labels = grid[0, 0].get_legend_handles_labels()
        page.legend(handles, labels, loc="outside upper left", ncols=6, fontsize=9, frameon=False)
        save_png(page, path)


def draw_polytope(clouds: Mapping[float, FloatArray], path: Path) -> None:
    """Coefficients of the nonlinear model by the size of the region, in two pairs of entries."""
    pairs = [
        ((1, 2), (1, 0), "yaw rate ← yaw (cable)", "yaw rate ← tail thrust"),
        ((4, 5), (4, 3), "pitch momentum ← pitch (gravity)", "pitch momentum ← main rotor"),
        ((4, 1), (1, 5), "pitch momentum ← yaw rate", "yaw rate ← pitch"),
    ]
    with house_style():
        page = new_figure(10.0, 3.5)
        panels = page.subplots(1, 3)
        for panel, (across, up, xlabel, ylabel) in zip(panels, pairs, strict=True):
            for shade, (size, cloud) in zip(SHADES, clouds.items(), strict=False):
                x, y = cloud[:, across[0], across[1]], cloud[:, up[0], up[1]]
                panel.plot(x, y, ".", ms=2.0, color=shade, label=f"± {size:g}", mew=0)
            panel.set(xlabel=xlabel, ylabel=ylabel)
            panel.xaxis.set_major_locator(MaxNLocator(4))
        handles, labels = panels[0].get_legend_handles_labels()
        page.legend(
            handles, labels, loc="outside upper left", ncols=4, fontsize=9, frameon=False,
            markerscale=4, title="region, in typical sizes", title_fontsize=8, alignment="left",
        )  # fmt: skip
        save_png(page, path)


def draw_switching(laws: Sequence[LawResult], path: Path) -> None:
    """V along the worst and along random switching, from each start."""
    switching_laws = [
        w for w in laws if w.region == "sub" and w.vertices == 4 and w.greedy is not None
    ]
    starts = list(dict.fromkeys(w.start for w in switching_laws))
    with house_style():
        page = new_figure(10.0, 2.9)
        panels = page.subplots(1, max(len(starts), 1), sharey=True, squeeze=False)[0]
        for panel, start in zip(panels, starts, strict=False):
            for w in switching_laws:
                if w.start != start or w.greedy is None or w.random is None:
                    continue
                colour = PALETTE["blue"] if w.kind == "common" else PALETTE["vermilion"]
                time = 0.1 * np.arange(len(w.greedy.values))
                word = w.kind.replace("_", " ")
                panel.semilogy(time, w.greedy.values, color=colour, label=f"{word}, worst")
                panel.semilogy(
                    time, w.random.values, color=colour, lw=0.8, ls="--", label=f"{word}, random"
                )
            panel.set_ylim(1e-6, 2.0)
            panel.set_xlim(0.0, 22.0)
            panel.set_title(f"yaw {start[0]:g}, pitch {start[1]:g} rad", fontsize=9)
            panel.set_xlabel("time [s]")
        panels[0].set_ylabel("V relative to its start")
        handles, labels = panels[0].get_legend_handles_labels()
        page.legend(handles, labels, loc="outside upper left", ncols=4, fontsize=9, frameon=False)
        save_png(page, path)


def draw_domain(domain_map: Map, starts: Sequence[tuple[float, float]], path: Path) -> None:
    """Which starts are held, by controller, the main rotor turning or at rest."""
    names = list(domain_map.domains)
    with house_style():
        page = new_figure(10.0, 4.6)
        grid = page.subplots(2, 3, sharex=True, sharey=True)
        yaw, pitch = np.meshgrid(domain_map.yaw, domain_map.pitch, indexing="ij")
        for panel, name in zip(grid.ravel(), names, strict=True):
            is_held = domain_map.domains[name].astype(bool)
            panel.plot(yaw[~is_held], pitch[~is_held], "o", color=PALE, ms=4)
            panel.plot(yaw[is_held], pitch[is_held], "o", color=PALETTE["blue"], ms=5)
            for start in starts:
                panel.plot(*start, "x", color=PALETTE["vermilion"], ms=6, mew=1.6)
            panel.set_title(f"{name}: {100 * is_held.mean():.0f} %", fontsize=9)
        for panel in grid[-1]:
            panel.set_xlabel("yaw [rad]")
        for panel in grid[:, 0]:
            panel.set_ylabel("pitch [rad]")
        save_png(page, path)
