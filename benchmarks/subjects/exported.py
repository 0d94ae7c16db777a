"""The exported controller and filter in C: how long, growing how, and how near to NumPy's."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from time import perf_counter

import numpy as np

from benchmarks.document import LIMIT, Column, Table, Value
from benchmarks.lockstep import WARM_UP, quantiles
from benchmarks.options import Options
from benchmarks.setups import experiment, iterations_of, newton_horizon, newton_of
from trms_cli.code_generation.export import example_rows, export
from trms_cli.code_generation.measure import FLAGS, PASSES, ExampleMeasurement, measure
from trms_cli.controllers.controller import ControlSample, ControlSetup
from trms_cli.controllers.newton_mpc import NewtonMpc
from trms_cli.core.arrays import FloatArray
from trms_cli.core.compilation import compiler
from trms_cli.core.qp import Daqp
from trms_cli.models.estimate import Estimate
from trms_cli.models.model import names
from trms_cli.observers.observer import ObserverSetup
from trms_cli.plants.plant import PlantSetup
from trms_cli.simulation.closed_loop import Experiment

TITLE = "newton_mpc and ukf exported to C: time of a sample"
#: µs, medians.
LIMIT_ONE_ITERATION, LIMIT_OBSERVER = 60.0, 100.0

#: Time a period of the horizon at N = 80 over that at N = 20: linear is 1.
LIMIT_GROWTH = 1.15

_CASES = {
    "one iteration, N = 20": (LIMIT_ONE_ITERATION, newton_horizon(20), 1),
    "one iteration, N = 40": (None, newton_horizon(40), 1),
    "one iteration, N = 80": (None, newton_horizon(80), 1),
    "converged, N = 20": (None, newton_horizon(20), 50),
    "default": (None, (), None),
}

#: The other implementation's solver, asked for a tenth of what it leaves.
_CLOSER = Daqp(primal_tolerance=0.1 * Daqp().primal_tolerance)
#: What two QP solvers may leave between them, V.
_ROUNDING = 1e-7
#: Overrides by what a loop is about.
_LOOPS: dict[str, tuple[str, ...]] = {
    "squares": (),
    "squares, one iteration": ("controller.max_iterations=1",),
    "sines": ("ref=sine",),
    "sawteeth": ("ref=sawtooth",),
    "squares out of reach": ("ref.alpha_v.amplitude=1.3", "ref.alpha_h.amplitude=3.0"),
    "limits on rates": ("controller.input_rate_limits={u_v: 3.0, u_h: 5.0}",),
    "limit on pitch, preview": (
        "controller.soft_limits={alpha_v: [-0.25, 0.25]}",
        "controller.preview_horizon=8",
    ),
    "no terminal constraint": ("controller.terminal=none",),
    "pitch alone": ("model=newtonian_vertical", "model@plant.model=newtonian_vertical"),
    "limit on a rotor against the end": (
        "controller.soft_limits={omega_h: [-120, 120]}",
        "ref.alpha_h.amplitude=1.2",
    ),
}


def run(options: Options) -> list[Table]:
    """Export, compile and drive through the samples of a closed loop; Python over the same."""
    program = compiler()
    times = _times(options, program)
    return [times, _growth(times), _agreement(options, program)]


def _growth(times: Table) -> Table:
    """Time a period of the horizon, by its length."""
    table = Table(
        "exported_growth",
        "newton_mpc exported to C: one iteration by the length of the horizon",
        [
            Column("periods", "N"),
            Column("median", "median", "µs"),
            Column("growth", "a period, to N = 20"),
            *LIMIT,
        ],
    )
    medians = {
        int(str(row["case"]).rpartition(" ")[2]): float(str(row["median"]))
        for row in times.rows
        if str(row["case"]).startswith("one iteration")
    }
    for n, median in medians.items():
        growth = median / n / (medians[20] / 20)
        limit = LIMIT_GROWTH if n == max(medians) else None
        if limit is None:
            table.add(periods=n, median=median, growth=growth)
        else:
            table.add_limited("growth", growth, limit, periods=n, median=median)
    return table


def _agreement(options: Options, program: str | None) -> Table:
    """How far the commands of C and of NumPy with DAQP are apart, loop by loop."""
    table = Table(
        "exported_agreement",
        "newton_mpc exported to C: largest difference to NumPy's commands with equal inputs",
        [
            Column("loop", "loop"),
            Column("difference", "difference", "V", 2),
            Column("itself", "NumPy to itself", "V", 2),
            Column("closer", "with a closer DAQP", "V", 2),
            Column("samples", "samples"),
            *LIMIT,
        ],
    )
    if program is None:
        return table
    for name, overrides in options.cases(_LOOPS).items():
        loop_setup = experiment(
            "controller=newton_mpc",
            "observer=full_state",
            *([] if any(word.startswith("ref=") for word in overrides) else ["ref=square"]),
            *overrides,
            f"sim.duration={options.duration(120.0)}",
        )
        example = _Example(loop_setup)
        measured = example.measured(program, passes=1)
        itself = rounding_difference(example.controller, example.setup, example.rows)
        closer = replace(example.controller, qp=_CLOSER)
        # What changes NumPy so much in the last bit of an estimate has no nearer neighbour.
        table.add_limited(
            "difference",
            measured.largest_difference,
            max(_ROUNDING, 10 * itself),
            loop=name,
            itself=itself,
            closer=_difference(closer, example.setup, example.rows, lambda x: x),
            samples=measured.samples,
        )
    table.notes.append(
        "“NumPy to itself”: the same loop again with each estimate changed in its last bit. The "
        f"limit is {_ROUNDING:g} V, or ten times that difference. “With a closer DAQP”: with DAQP "
        "asked for a tenth of its tolerance. Where ten iterations do not converge, they amplify "
        "what a solver leaves."
    )
    return table


def _times(options: Options, program: str | None) -> Table:
    """What a sample takes."""
    table = Table(
        "exported",
        TITLE,
        [
            Column("case", "case"),
            Column("median", "median", "µs"),
            Column("p99", "99 %", "µs"),
            Column("slowest", "slowest", "µs"),
            Column("python", "in Python", "µs"),
            Column("times", "in Python / C"),
            Column("difference", "apart", "V", 2),
            Column("context", "memory", "KiB"),
            Column("samples", "samples"),
            *LIMIT,
        ],
    )
    if program is None:
        table.notes.append("no C compiler on this machine: nothing measured")
        return table
    for name, (limit, horizon, iterations) in options.cases(_CASES).items():
        loop_setup = experiment(
            "controller=newton_mpc",
            "ref=square",
            *horizon,
            *iterations_of(iterations),
            f"sim.duration={options.duration(80.0)}",
        )
        example = _Example(loop_setup)
        measured, python = example.measured(program), example.python_median()
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
    return table


class _Example:
    """An export of an experiment's controller and observer, with the samples that go with it."""

    def __init__(self, chosen: Experiment) -> None:
        self._engine = newton_of(chosen)
        #: In NumPy, its programs solved by DAQP: the other implementation.
        self.controller = controller = replace(self._engine, qp=Daqp())
        plant = chosen.plant.init(PlantSetup(chosen.sample_time, 1, chosen.seed))
        self.setup = ControlSetup(chosen.model, controller.sample_time, plant.first_command)
        observing = ObserverSetup(
            chosen.model,
            chosen.sample_time,
            names(plant.outputs),
            plant.noise_sd,
            plant.measure(),
            plant.first_command,
        )
        samples = max(2 * WARM_UP, round(chosen.duration / controller.sample_time))
        self.rows = example_rows(controller, self.setup, chosen.reference, samples)
        self._files = export(
            controller,
            self.setup,
            chosen.reference,
            name="rig",
            samples=samples,
            observer=chosen.observer,
            observing=observing,
        ).files

    def measured(self, program: str, passes: int = PASSES) -> ExampleMeasurement:
        """What the example says."""
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            for file, content in self._files.items():
                (folder / file).write_text(content, encoding="utf-8")
            return measure(folder, "rig", program, passes)

    def python_median(self) -> float:
        """Time of the engine called from Python, µs; for controllers without a preview."""
        state, model = self._engine.init(self.setup), self.setup.model
        ends = np.cumsum([model.n_x, model.n_w, len(model.controlled), model.n_u])
        times = []
        for row in self.rows:
            x, w, r, u, _ = np.split(row, ends)
            sample = ControlSample(0.0, r[None, :], Estimate(x, 0 * x, w, 0 * w), u)
            begin = perf_counter()
            self._engine.step(state, sample, want_prediction=False)
            times.append(perf_counter() - begin)
        return 1e6 * quantiles(np.array(times[WARM_UP:]))[0]


def rounding_difference(controller: NewtonMpc, setup: ControlSetup, rows: FloatArray) -> float:
    """How far the controller in NumPy is from itself when estimates change in their last bit, V.

    No other implementation can be expected to be nearer.

    ``rows``: (samples, n) array; from :func:`trms_cli.code_generation.export.example_rows`.
    """
    draw = np.random.default_rng(0)
    return _difference(
        controller, setup, rows, lambda x: np.nextafter(x, draw.choice([-np.inf, np.inf], len(x)))
    )


def _difference(
    controller: NewtonMpc,
    setup: ControlSetup,
    rows: FloatArray,
    changed: Callable[[FloatArray], FloatArray],
) -> float:
    """How far commands are from those of the rows, V; ``changed``: the estimate, (n_x,) array."""
    model, state = setup.model, controller.init(setup)
    preview = controller.preview(setup)
    sizes = [model.n_x, model.n_w, len(model.controlled) * (preview + 1), model.n_u]
    largest = 0.0
    for k, row in enumerate(rows):
        x, w, r, u, example_command = np.split(row, np.cumsum(sizes))
        estimate = Estimate(changed(x), 0 * x, w, 0 * w)
        sample = ControlSample(k * setup.sample_time, r.reshape(preview + 1, -1), estimate, u)
        command = controller.step(state, sample, want_prediction=False)
        largest = max(largest, float(np.abs(command.u - example_command).max()))
    return largest
