"""The figures of the study, in the look of the house."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.colors import BoundaryNorm, LinearSegmentedColormap

from experiments.chapter6.cases import Plans, Run
from experiments.chapter6.domain import Arrivals, FeasibleStates, slice_axes
from experiments.chapter6.iterations import Economy
from experiments.chapter6.rig import Record
from experiments.chapter6.study import Domain
from trms_cli.reporting.style import (
    ALARM,
    COLOURS,
    GREY,
    INK,
    LITTLE,
    PALE,
    PALETTE,
    house_style,
    legend_above,
    new_figure,
    save_png,
)

_AXES = {"alpha_v": "pitch [rad]", "alpha_h": "yaw [rad]"}
_OFFSETS = {
    "alpha_v": "pitch [rad]",
    "alpha_h": "yaw [rad]",
    "rate_v": "pitch rate [rad/s]",
    "rate_h": "yaw rate [rad/s]",
}
TERMINALS = {
    "equality": "terminal equality",
    "quasi_infinite": "quasi-infinite",
    "none": "no terminal constraint",
}
_COLOUR_OF = {"equality": COLOURS[0], "quasi_infinite": PALETTE["vermilion"], "none": GREY}
_LIMIT = 2.5  # V


def draw_cases(runs: Sequence[Run], path: Path) -> None:
    """Responses and inputs of each case under the controller as it is."""
    equality_runs = [run for run in runs if run.controller == "equality"]
    rows = -(-len(equality_runs) // 3)
    with house_style():
        page = new_figure(10.0, 3.9 * rows)
        parts = page.subfigures(rows, 3, squeeze=False).ravel()
        for k, (run, part) in enumerate(zip(equality_runs, parts, strict=False)):
            panels = part.subplots(3, 1, sharex=True, height_ratios=[1.2, 1.2, 1.0])
            time = run.traces["time"]
            for panel, angle in zip(panels, _AXES, strict=False):
                panel.plot(time, run.traces[f"r_{angle}"], color=INK, lw=0.8, ls="--")
                panel.plot(time, run.traces[angle], color=COLOURS[0])
                if k % 3 == 0:
                    panel.set_ylabel(_AXES[angle])
            for name, colour, label in (
                ("u_v", PALETTE["green"], "main rotor"),
                ("u_h", PALETTE["purple"], "tail rotor"),
            ):
                panels[2].plot(time, run.traces[name], color=colour, lw=1.0, label=label)
            for bound in (-_LIMIT, _LIMIT):
                panels[2].axhline(bound, color=ALARM, lw=0.6)
            panels[0].set_title(run.case.replace("_", " "), pad=3)
            panels[0].set_xlim(0.0, time[-1])
            if k % 3 == 0:
                panels[2].set_ylabel("input [V]")
            if k >= len(equality_runs) - 3:
                panels[2].set_xlabel("time [s]")
            if k == 0:
                legend_above(panels[2], 2)
            part.align_ylabels(panels)
        save_png(page, path)


def draw_objective(runs: Sequence[Run], path: Path) -> None:
    """Objective and terminal residual over time, a column a case."""
    names = list(dict.fromkeys(run.case for run in runs))
    columns = [name for name in ("square_1", "sine_1", "sawtooth") if name in names]
    with house_style():
        page = new_figure(10.0, 4.2)
        grid = page.subplots(2, len(columns), sharex=True, sharey="row", squeeze=False)
        for (upper, lower), name in zip(grid.T, columns, strict=True):
            for run in runs:
                if run.case != name or run.controller not in _COLOUR_OF:
                    continue
                words = {
                    "color": _COLOUR_OF[run.controller],
                    "label": TERMINALS[run.controller],
                    "lw": 1.1,
                }
                upper.semilogy(run.control_time, np.maximum(run.objective, 1e-7), **words)
                lower.semilogy(
                    run.control_time, np.where(run.residual > 0, run.residual, np.nan), **words
                )
            upper.set_title(name.replace("_", " "))
            lower.axhline(1e-3, color=ALARM, lw=0.6)
            lower.set_xlabel("time [s]")
            upper.set_xlim(0.0, run.control_time[-1])
        grid[0, 0].set_ylabel("objective")
        grid[1, 0].set_ylabel("terminal residual")
        grid[0, min(1, len(columns) - 1)].legend(loc="upper right")
        page.align_ylabels()
        save_png(page, path)


def draw_predictions(plans: Mapping[str, Plans], path: Path) -> None:
    """Plans and predictions of successive samples over what came of them."""
    from trms_cli.models.newtonian import Newtonian

    model = Newtonian()
    colours = (COLOURS[0], PALETTE["vermilion"], PALETTE["green"], PALETTE["purple"])
    with house_style():
        page = new_figure(10.0, 7.6)
        grid = page.subplots(5, len(plans), sharex=True, sharey="row", squeeze=False)
        for column, (name, plan) in zip(grid.T, plans.items(), strict=True):
            period = plan.time[1] - plan.time[0]
            for panel, angle in zip(column[:2], _AXES, strict=False):
                row = model.state_index(angle)
                panel.plot(plan.time, plan.x[:, row], color=PALE, lw=5.0, label="the rig")
                for colour, (k, (time, states, _)) in zip(
                    colours, plan.predictions.items(), strict=False
                ):
                    panel.plot(time, states[:, row], color=colour, lw=1.0,
                               label=f"predicted at {k * period:.1f} s")  # fmt: skip
            for j, panel in enumerate(column[2:4]):
                panel.step(plan.time, plan.u[:, j], where="post", color=PALE, lw=5.0)
                for colour, (_, (time, _, inputs)) in zip(
                    colours, plan.predictions.items(), strict=False
                ):
                    panel.step(time, inputs[:, j], where="post", color=colour, lw=1.0)
                panel.axhline(_LIMIT, color=ALARM, lw=0.6)
            column[4].semilogy(plan.time, plan.objective, color=INK, lw=1.0, marker=".", ms=3)
            column[0].set_title(name)
            column[4].set_xlabel("time after the step [s]")
            column[0].set_xlim(0.0, 5.0)
        labels = ["pitch [rad]", "yaw [rad]", "main rotor [V]", "tail rotor [V]", "objective"]
        for panel, label in zip(grid[:, 0], labels, strict=True):
            panel.set_ylabel(label)
        grid[0, 1].legend(loc="lower right")
        page.align_ylabels()
        save_png(page, path)


def draw_decrease(runs: Mapping[str, Sequence[Record]], period: float, path: Path) -> None:
    """The objective along runs, and how much of the stage cost it falls by."""
    modes = [name for name in runs if name in _SHOWN_MODES]
    with house_style():
        page = new_figure(10.0, 4.6)
        grid = page.subplots(2, len(modes), sharex="row", sharey="row", squeeze=False)
        for (upper, lower), mode in zip(grid.T, modes, strict=True):
            for record in runs[mode][:25]:
                time = np.arange(len(record.objective)) * period
                upper.semilogy(time, record.objective, color=COLOURS[0], lw=0.6, alpha=0.6)
            before = np.concatenate([r.objective[:-1] for r in runs[mode]])
            gap = np.concatenate(
                [r.objective[1:] - r.objective[:-1] + r.stage[:-1] for r in runs[mode]]
            )
            share = gap / np.maximum(before, 1e-12)
            is_met = np.concatenate([r.residual[:-1] <= 1e-4 for r in runs[mode]]) & (before > 1e-9)
            for mask, colour, label in (
                (is_met, COLOURS[0], "constraint met"),
                (~is_met, PALETTE["orange"], "not met"),
            ):
                if mask.any():
                    lower.plot(before[mask], share[mask], ".", color=colour, ms=1.6,
                               alpha=0.6, label=label)  # fmt: skip
            lower.axhline(0.0, color=ALARM, lw=0.8)
            lower.set_xscale("log")
            lower.set_yscale("symlog", linthresh=1e-5)
            upper.set_title(mode)
            upper.set_xlabel("time [s]")
            lower.set_xlabel("J(k)")
        grid[0, 0].set_ylabel("J")
        grid[1, 0].set_ylabel("(J(k+1) − J(k) + ℓ(k)) / J(k)")
        grid[1, 0].set_yticks([-1.0, -1e-2, -1e-4, 0.0, 1e-4, 1e-2])
        grid[1, min(1, len(modes) - 1)].legend(loc="lower left", markerscale=5)
        save_png(page, path)


_SHOWN_MODES = ("equality", "equality, blocked, one iteration", "quasi-infinite", "none, N = 12")


def draw_domain(study: Domain, slices: Mapping[str, FeasibleStates], path: Path) -> None:
    """The shortest horizon from which the terminal constraint can be met, over three slices."""
    horizons = study.horizons
    colours = LinearSegmentedColormap.from_list(
        "horizons", [PALETTE["blue"], PALETTE["sky"], LITTLE]
    ).with_extremes(over="white")
    norm = BoundaryNorm(np.arange(len(horizons) + 1) - 0.5, colours.N)
    with house_style():
        page = new_figure(10.0, 5.6)
        grid = page.subplots(len(study.terminals), len(slices), squeeze=False, sharex="col",
                             sharey="col")  # fmt: skip
        for row, terminal in zip(grid, study.terminals, strict=True):
            for panel, (name, feasible_states) in zip(row, slices.items(), strict=True):
                (first, xs), (second, ys) = slice_axes(study, name)
                shortest = np.full(len(feasible_states.states), len(horizons), dtype=float)
                for rank in reversed(range(len(horizons))):
                    shortest[feasible_states.feasible[terminal, horizons[rank]]] = rank
                values = shortest.reshape(len(ys), len(xs))
                image = panel.pcolormesh(xs, ys, values, cmap=colours, norm=norm, shading="nearest")
                for horizon in study.drawn:
                    inside = feasible_states.feasible[terminal, horizon].reshape(len(ys), len(xs))
                    if inside.any() and not inside.all():
                        panel.contour(xs, ys, inside.astype(float), [0.5], colors=INK,
                                      linewidths=0.7)  # fmt: skip
                panel.plot(0.0, 0.0, "+", color=ALARM, ms=7)
                if terminal == study.terminals[-1]:
                    panel.set_xlabel(f"{_OFFSETS[first]} off the target")
                panel.set_ylabel(_OFFSETS[second])
                panel.set_title(TERMINALS[terminal] if panel is row[0] else "")
                panel.grid(False)
        bar = page.colorbar(image, ax=grid, ticks=np.arange(len(horizons)), extend="max",
                            shrink=0.7, aspect=30)  # fmt: skip
        bar.ax.set_yticklabels([str(horizon) for horizon in horizons])
        bar.set_label("shortest horizon [periods of 0.1 s]")
        save_png(page, path)


def draw_shares(
    study: Domain, box: FeasibleStates, arrivals: Sequence[Arrivals], path: Path
) -> None:
    """Horizon against the feasible share of the box, the share that arrives, and what it costs."""
    with house_style():
        page = new_figure(10.0, 3.0)
        feasible, arrived, cost = page.subplots(1, 3)
        for terminal in study.terminals:
            shares = [100 * box.feasible[terminal, n].mean() for n in study.horizons]
            feasible.plot(study.horizons, shares, marker="o", ms=3.5,
                          color=_COLOUR_OF[terminal], label=TERMINALS[terminal])  # fmt: skip
        feasible.set(ylabel="share of the box [%]", title="feasible at the first sample")
        feasible.legend(loc="lower right")
        for terminal in study.loops.terminals:
            rows = [row for row in arrivals if row.terminal == terminal]
            horizons = [row.horizon for row in rows]
            words = {
                "marker": "o",
                "ms": 6.0 if terminal == "equality" else 3.5,
                "color": _COLOUR_OF[terminal],
                "label": TERMINALS[terminal],
            }
            arrived.plot(horizons, [100 * row.arrived for row in rows], **words)
            cost.plot(horizons, [row.cost for row in rows], **words)
        arrived.set(ylabel="share of the loops [%]", title="closed loop arrives", ylim=(-3, 103))
        cost.set(ylabel="mean cost of a loop", title="closed-loop cost", yscale="log")
        cost.set_yticks([5, 6, 8, 10, 20, 30], ["5", "6", "8", "10", "20", "30"])
        cost.minorticks_off()
        cost.legend(loc="upper right")
        for panel in (feasible, arrived, cost):
            panel.set_xlabel("horizon [periods of 0.1 s]")
        save_png(page, path)


def draw_iterations(rows: Sequence[Economy], path: Path) -> None:
    """Closed-loop cost against time a sample, relative to one iteration."""
    references = list(dict.fromkeys(row.reference for row in rows))
    horizons = list(dict.fromkeys(row.horizon for row in rows))
    with house_style():
        page = new_figure(8.0, 3.1)
        panels = page.subplots(1, len(references), squeeze=False)[0]
        for panel, reference in zip(panels, references, strict=True):
            for colour, horizon in zip(COLOURS, horizons, strict=False):
                group = [r for r in rows if (r.reference, r.horizon) == (reference, horizon)]
                unit = next(r for r in group if r.count == 1)
                times = [r.seconds / unit.seconds for r in group]
                best = min(r.cost for r in group)
                panel.plot(times, [100 * (r.cost / best - 1) for r in group], marker="o", ms=3.5,
                           color=colour, label=horizon)  # fmt: skip
                for time, r in zip(times, group, strict=True):
                    above = 100 * (r.cost / best - 1)
                    words = {"textcoords": "offset points", "fontsize": 7, "color": colour}
                    panel.annotate(str(r.count), (time, above), (3, 3), **words)
            panel.set(title=reference, xlabel="time a sample, one iteration = 1", xscale="log")
            panel.set_xticks([1, 2, 5, 10, 20], ["1", "2", "5", "10", "20"])
            panel.minorticks_off()
        panels[0].set_ylabel("cost above the best [%]")
        panels[0].legend(title="horizon")
        save_png(page, path)
