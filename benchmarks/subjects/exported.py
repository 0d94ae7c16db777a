"""The exported controller and filter in C beside the same in Python."""

from __future__ import annotations

import tempfile
from pathlib import Path
from time import perf_counter

import numpy as np

from benchmarks.document import LIMIT, Column, Table, Value
from benchmarks.lockstep import WARM_UP, quantiles
from benchmarks.options import Options
from benchmarks.setups import experiment, newton_horizon, newton_of
from trms_cli.controllers.code.example_run import example_rows
from trms_cli.controllers.code.export import export
from trms_cli.controllers.code.measure import FLAGS, Measured, measure
from trms_cli.controllers.controller import ControlSample, ControlSetup
from trms_cli.core.compilation import compiler
from trms_cli.models.model import names
from trms_cli.observers.observer import Estimate, ObserverSetup
from trms_cli.plants.plant import PlantSetup
from trms_cli.simulation.closed_loop import Experiment

TITLE = "newton_mpc and ukf exported to C: time of a sample"
#: µs, medians.
LIMIT_ONE_ITERATION, LIMIT_OBSERVER = 60.0, 100.0

_CASES = {
    "one iteration, N = 20": (LIMIT_ONE_ITERATION, newton_horizon(20), 1),
    "converged, N = 20": (None, newton_horizon(20), 50),
    "default": (None, (), None),
}


def run(options: Options) -> list[Table]:
    """Export, compile and drive through the samples of a closed loop; Python over the same."""
    table = Table(
        "exported",
        TITLE,
        [
            Column("case", "case"),
            Column("median", "median", "µs"),
            Column("p99", "99 %", "µs"),
            Column("slowest", "slowest", "µs"),
            Column("python", "Python", "µs"),
            Column("times", "Python / C"),
            Column("difference", "apart", "V", 2),
            Column("context", "memory", "KiB"),
            Column("samples", "samples"),
            *LIMIT,
        ],
    )
    program = compiler()
    if program is None:
        table.notes.append("no C compiler on this machine: nothing measured")
        return [table]
    for name, (limit, horizon, iterations) in _CASES.items():
        chosen = experiment(
            "controller=newton_mpc",
            "ref=square",
            *horizon,
            *([f"controller.max_iterations={iterations}"] if iterations else []),
            f"sim.duration={options.duration(80.0)}",
        )
        measured, python = _measured(chosen, program)
        cells: dict[str, Value] = {
            "case": name,
            "p99": measured.p99,
            "slowest": measured.slowest,
            "python": python,
            "times": python / measured.median,
            "difference": measured.largest_difference,
            "context": measured.context_bytes / 1024,
            "samples": measured.samples,
        }
        if limit is None:
            table.add(median=measured.median, **cells)
        else:
            table.add_limited("median", measured.median, limit, **cells)
    # The last case's: all of them have the same.
    if measured.observer_median is not None:
        table.add_limited(
            "median",
            measured.observer_median,
            LIMIT_OBSERVER,
            case="ukf",
            p99=measured.observer_p99,
            context=measured.observer_bytes / 1024,
        )
    table.notes.append(
        f"limits in µs on the median; {' '.join(FLAGS)}. Squares with torques that change each "
        "sample, so that each has a steady state to find. “Slowest” is the sample that takes "
        "longest, in the least disturbed of five passes."
    )
    return [table]


def _measured(chosen: Experiment, program: str) -> tuple[Measured, float]:
    """What the example of an export says, and the median of Python over its samples, µs."""
    controller = newton_of(chosen)
    plant = chosen.plant.init(PlantSetup(chosen.sample_time, 1, chosen.seed))
    setup = ControlSetup(chosen.model, controller.sample_time, plant.first_command)
    observing = ObserverSetup(
        chosen.model,
        chosen.sample_time,
        names(plant.outputs),
        plant.noise_sd,
        plant.measure(),
        plant.first_command,
    )
    samples = max(2 * WARM_UP, round(chosen.duration / controller.sample_time))
    found = export(
        controller,
        setup,
        chosen.reference,
        name="rig",
        samples=samples,
        observer=chosen.observer,
        observing=observing,
    )
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for file, content in found.files.items():
            (folder / file).write_text(content, encoding="utf-8")
        measured = measure(folder, "rig", program)
    rows = example_rows(controller, setup, chosen.reference, samples)
    state, model = controller.init(setup), chosen.model
    ends = np.cumsum([model.n_x, model.n_w, len(model.controlled), model.n_u])
    times = []
    for row in rows:
        x, w, r, u, _ = np.split(row, ends)
        sample = ControlSample(0.0, r[None, :], Estimate(x, 0 * x, w, 0 * w), u)
        begin = perf_counter()
        controller.step(state, sample, want_prediction=False)
        times.append(perf_counter() - begin)
    return measured, 1e6 * quantiles(np.array(times[WARM_UP:]))[0]
