"""How the times grow: with the horizon, with the states of the model, with the length of a run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.document import Column, Table
from benchmarks.lockstep import quantiles, race
from benchmarks.options import Options
from benchmarks.setups import FULL_STATE, experiment, newton_horizon
from benchmarks.subjects.parts import runner_times
from trms_cli.effects.extended_model import extend_model
from trms_cli.effects.input_delay import InputDelay
from trms_cli.models.model import Model
from trms_cli.simulation.closed_loop import Experiment

TITLE = "growth"
FIGURE = "benchmark_growth.png"
_HORIZONS = (10, 20, 40, 60, 80, 100)
_DURATIONS = (10.0, 30.0, 100.0, 300.0, 1000.0)


@dataclass(frozen=True)
class _Case:
    """A model of a size."""

    overrides: tuple[str, ...]
    delayed: bool = False


_MODELS: Mapping[str, _Case] = {
    "6": _Case(()),
    "8, with currents (stiff)": _Case(("model=newtonian_full",)),
    "6 and a delay's memory": _Case((), delayed=True),
}


def run(options: Options) -> list[Table]:
    """Tables of all three, and one figure."""
    horizon, states, length = _horizons(options), _states(options), _lengths(options)
    figure = options.out / FIGURE
    draw([horizon, states, length], figure)
    length.notes.append(f"figure: {FIGURE}, beside the document")
    return [horizon, states, length]


def _time_columns() -> list[Column]:
    return [
        Column("median", "median", "µs"),
        Column("p99", "99 %", "µs"),
        Column("linearise", "linearise", "µs"),
        Column("qp", "QP", "µs"),
        Column("relative", "× the first"),
    ]


def _horizons(options: Options) -> Table:
    table = Table(
        "growth_horizon",
        "newton_mpc, one iteration: with the horizon (6 states, an input a period)",
        [Column("periods", "N"), *_time_columns()],
    )
    for periods in _HORIZONS[:2] if options.quick else _HORIZONS:
        _time(table, {"periods": periods}, _one_iteration(options, *newton_horizon(periods)))
    return table


def _states(options: Options) -> Table:
    table = Table(
        "growth_states",
        "newton_mpc, one iteration: with the states of the model (N = 20)",
        [Column("states", "states"), Column("total", "with memory"), *_time_columns()],
    )
    for name, case in _MODELS.items():
        loop_setup = _one_iteration(options, *newton_horizon(20), *case.overrides)
        if case.delayed:
            loop_setup = replace(loop_setup, model=_delayed(loop_setup.model))
        period = loop_setup.controller.sample_time or loop_setup.sample_time
        total = loop_setup.model.n_x + len(loop_setup.model.memory(period))
        _time(table, {"states": name, "total": total}, loop_setup)
    return table


def _delayed(model: Model) -> Model:
    """A model that knows of a delay of half a control period in both rotors."""
    delays = {
        "main_input_delay": InputDelay(rotor="main", delay=0.05, longest=0.2),
        "tail_input_delay": InputDelay(rotor="tail", delay=0.05, longest=0.2),
    }
    return extend_model(model, delays)


def _one_iteration(options: Options, *overrides: str) -> Experiment:
    return experiment(
        "controller=newton_mpc",
        "ref=square",
        *FULL_STATE,
        "controller.max_iterations=1",
        f"sim.duration={options.duration(40.0)}",
        *overrides,
    )


def _time(table: Table, cells: dict[str, str | int], loop_setup: Experiment) -> None:
    entrant = race(loop_setup, {"newton_mpc": loop_setup.controller})[0]
    median, p99 = quantiles(entrant.counted_times)
    first = float(table.rows[0]["median"]) if table.rows else median  # type: ignore[arg-type]
    table.add(
        **cells,
        median=median,
        p99=p99,
        linearise=entrant.part("linearise_time"),
        qp=entrant.part("qp_time"),
        relative=median / first,
    )


def _lengths(options: Options) -> Table:
    table = Table(
        "growth_length",
        "runner, all topics logged, 100 Hz: with the length of the run",
        [
            Column("duration", "run", "s", 4),
            Column("median", "a step", "µs"),
            Column("p99", "99 %", "µs"),
            Column("last", "last tenth", "µs"),
            Column("relative", "× the first"),
        ],
    )
    for duration in _DURATIONS[:1] if options.quick else _DURATIONS:
        times = runner_times(round(100 * duration), logged=True)
        median, p99 = quantiles(times)
        first = float(table.rows[0]["median"]) if table.rows else median  # type: ignore[arg-type]
        late = float(np.median(times[-max(1, len(times) // 10) :]))
        table.add(duration=duration, median=median, p99=p99, last=late, relative=median / first)
    return table


def draw(tables: list[Table], path: Path) -> None:
    """The three tables as one figure, in the style of the program's reports."""
    from trms_cli.reporting.style import COLOURS, house_style, new_figure, save_png

    horizon, states, length = tables
    with house_style():
        figure = new_figure(9.0, 3.0)
        panels = figure.subplots(1, 3)
        for panel, table, key, label in (
            (panels[0], horizon, "periods", "prediction horizon N"),
            (panels[2], length, "duration", "length of the run, s"),
        ):
            x = [row[key] for row in table.rows]
            for column, name, colour in zip(
                ("median", "p99"), ("median", "99 %"), COLOURS, strict=False
            ):
                values = [row[column] for row in table.rows]
                panel.plot(x, values, color=colour, marker="o", markersize=3, label=name)
            panel.set_xlabel(label)
            panel.legend()
        labels = [str(row["total"]) for row in states.rows]
        panels[1].bar(labels, [row["median"] for row in states.rows], width=0.5, color=COLOURS[0])
        panels[1].set_xlabel("states of the model, memory included")
        panels[2].set_xscale("log")
        for panel, title in zip(
            panels,
            ("newton_mpc, one iteration", "newton_mpc, N = 20", "runner with its log"),
            strict=True,
        ):
            panel.set_title(title)
            panel.set_ylim(bottom=0)
        panels[0].set_ylabel("time of a step, µs")
        path.parent.mkdir(parents=True, exist_ok=True)
        save_png(figure, path)
