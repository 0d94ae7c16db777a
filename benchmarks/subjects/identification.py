"""Fits: one simulation beside scipy's, a genetic algorithm, multiple shooting."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from benchmarks.document import LIMIT, Column, Table
from benchmarks.options import Options
from trms_cli.core.compilation import BufferedFunction
from trms_cli.identification.dataset import Dataset
from trms_cli.identification.genetic import Genetic
from trms_cli.identification.multiple_shooting import MultipleShooting
from trms_cli.identification.population import SimulationCost
from trms_cli.identification.problem import FitProblem, FitResult, SilentProgress, free_parameters
from trms_cli.models.newtonian import Newtonian
from trms_cli.references.multilevel import Multilevel
from trms_cli.simulation.rollout import Rollout

TITLE = "fits to 120 s of both axes at 50 Hz"
#: s, on two cores.
LIMIT_GENETIC, LIMIT_SHOOTING = 60.0, 15.0
_DURATION, _STEP = 120.0, 0.02
#: What multiple shooting is asked for: fifteen that these commands tell something of.
FREE = (
    *("k_fvp", "k_fhp", "k_fhn", "k_g", "k_m", "k_t", "k_oh", "k_ov", "k_chp", "k_chn"),
    *("J_mr", "J_tr", "k_uh", "k_uv", "l_cb"),
)
#: Tolerances that scipy's integrator is tried with, from loose to tight.
_TOLERANCES = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9)


def run(options: Options) -> list[Table]:
    """Simulations, then fits."""
    duration = 10.0 if options.quick else _DURATION
    recording = _recording(duration)
    return [_simulations(recording, options.quick), _fits(recording, options.quick)]


@dataclass
class _Recording:
    """A recording, the model, where it began."""

    model: Newtonian
    dataset: Dataset
    start: np.ndarray


def _recording(duration: float) -> _Recording:
    model = Newtonian()
    rig = model.parameters.draw(3)
    n = round(duration / _STEP)
    times = _STEP * np.arange(n, dtype=np.float64)
    main = Multilevel(amplitude=0.8, offset=0.9, shortest=1.0, longest=5.0)
    tail = Multilevel(amplitude=0.5, shortest=1.0, longest=5.0, seed=5)
    commands = np.column_stack([main.sample(times), tail.sample(times)])
    rollout = Rollout(model, _STEP)
    start = rollout.initial(model.rest(), np.zeros(2))
    y = rollout.outputs(commands, [0], [n], start[None], rig.values).y
    sd = np.array([4.4e-4, 4.4e-4, 1.6, 1.6])
    measured = y + sd * np.random.default_rng(0).standard_normal(y.shape)
    dataset = Dataset(
        "bench", "bench", "", _STEP, times, model.inputs, model.outputs, commands, measured, sd
    )
    return _Recording(model, dataset, start)


def _simulations(recording: _Recording, quick: bool) -> Table:
    """One simulation of the whole recording: ours, and scipy's of the same accuracy."""
    table = Table(
        "simulation",
        f"one simulation of {recording.dataset.duration:g} s, both axes, 50 Hz",
        [
            Column("how", "how"),
            Column("time", "processor time", "ms"),
            Column("slower", "times ours"),
            Column("error", "largest error of an angle", "rad", 2),
        ],
    )
    fine = _simulated(recording, 32)[0]
    repeats = 1 if quick else 20
    ours, spent = _simulated(recording, 1, repeats)
    error = _angle_error(ours, fine)
    table.add(how="compiled, RK4 at 20 ms", time=1e3 * spent, error=error)
    slopes = _timed(_with_slopes(recording), repeats)
    table.add(
        how=f"compiled, with slopes in 6 states and {len(FREE)} parameters",
        time=1e3 * slopes,
        slower=slopes / spent,
    )
    for tolerance in _TOLERANCES:
        begin = time.process_time()
        theirs = _by_scipy(recording, tolerance)
        seconds = time.process_time() - begin
        scipy_error = _angle_error(theirs, fine)
        if scipy_error <= error or tolerance == _TOLERANCES[-1]:
            table.add(
                how=f"scipy solve_ivp, RK45, rtol {tolerance:.0e}, compiled right-hand side",
                time=1e3 * seconds,
                slower=seconds / spent,
                error=scipy_error,
            )
            break
    table.notes.append(
        "scipy's tolerance is the loosest power of ten that is at least as accurate as RK4 at "
        "20 ms; it integrates from sample to sample, over which the command is constant. The "
        "error is that against RK4 at 0.625 ms."
    )
    return table


def _simulated(recording: _Recording, substeps: int, repeats: int = 1) -> tuple[np.ndarray, float]:
    rollout = Rollout(recording.model, _STEP, substeps=substeps)
    dataset = recording.dataset
    window = ([0], [len(dataset)], recording.start[None])
    y = rollout.outputs(dataset.commands, *window).y
    spent = _timed(lambda: rollout.outputs(dataset.commands, *window), repeats)
    return y, spent


def _with_slopes(recording: _Recording) -> Callable[[], object]:
    rollout = Rollout(recording.model, _STEP, free=FREE)
    dataset = recording.dataset
    window = ([0], [len(dataset)], recording.start[None])
    return lambda: rollout.sensitivities(dataset.commands, *window)


def _by_scipy(recording: _Recording, tolerance: float) -> np.ndarray:
    """Outputs as of :meth:`Rollout.outputs`."""
    import casadi as ca
    from scipy.integrate import solve_ivp

    model, dataset = recording.model, recording.dataset
    x, u, p, w = model.symbols()
    slope = BufferedFunction(ca.Function("rhs", [x, u, p], [model.dynamics(x, u, p, 0 * w)]))
    slope.inputs[2][:] = model.parameters.values

    def right_hand_side(t: float, state: np.ndarray) -> np.ndarray:
        slope.inputs[0][:] = state
        slope()
        return slope.outputs[0].copy()

    columns = [model.state_index(signal.name) for signal in model.outputs]
    state, y = recording.start.copy(), np.empty((len(dataset), model.n_y))
    for k, command in enumerate(dataset.commands):
        y[k] = state[columns]
        slope.inputs[1][:] = command
        solution = solve_ivp(
            right_hand_side, (0.0, _STEP), state, rtol=tolerance, atol=1e-3 * tolerance
        )
        state = solution.y[:, -1]
    return y


def _angle_error(y: np.ndarray, reference: np.ndarray) -> float:
    return float(np.max(np.abs(y - reference)[:, :2]))


def _timed(work: Callable[[], object], repeats: int) -> float:
    """Median processor time of a call, s; a busy machine hardly changes it."""
    times = []
    for _ in range(repeats):
        begin = time.process_time()
        work()
        times.append(time.process_time() - begin)
    return float(np.median(times))


def _fits(recording: _Recording, quick: bool) -> Table:
    table = Table(
        "fits",
        TITLE,
        [
            Column("fit", "fit"),
            Column("free", "free"),
            Column("time", "time", "s"),
            Column("processor", "CPU", "s"),
            *LIMIT,
            Column("simulations", "runs"),
            Column("rate", "runs", "1/s"),
            Column("cost", "cost", "nats", 5),
        ],
    )
    everything = _problem(recording, ("priors",))
    size = (
        Genetic(individuals=10, generations=2)
        if quick
        else Genetic(individuals=50, generations=100)
    )
    words = f"genetic algorithm, {size.individuals} × {size.generations}"
    _add(table, words, everything, size.fit, LIMIT_GENETIC)
    shooting = MultipleShooting()
    _add(table, "multiple shooting, 2 starts", _problem(recording, FREE), shooting.fit,
         LIMIT_SHOOTING)  # fmt: skip
    _add(table, "multiple shooting, 2 starts", everything, shooting.fit, LIMIT_SHOOTING)
    table.notes.append(
        "two threads; windows of 10 s. A simulation of a point of the genetic algorithm is two of "
        "all windows, one with slopes in their starts; one of multiple shooting has all slopes. "
        "The cost is the genetic algorithm's at what was found."
    )
    return table


def _problem(recording: _Recording, free: tuple[str, ...]) -> FitProblem:
    model = recording.model
    selection = free_parameters(model.parameters, free)
    return FitProblem(model=model, datasets=(recording.dataset,), free=selection, jobs=2)


def _add(
    table: Table,
    words: str,
    problem: FitProblem,
    fit: Callable[[FitProblem, SilentProgress], FitResult],
    limit: float,
) -> None:
    cost = SimulationCost(problem)  # also compiles what the searches use
    Rollout(problem.model, _STEP, free=problem.names)
    begin, used = time.perf_counter(), time.process_time()
    result = fit(problem, SilentProgress())
    spent, processor = time.perf_counter() - begin, time.process_time() - used
    table.add_limited(
        "time",
        spent,
        limit,
        fit=words,
        free=len(problem.free),
        processor=processor,
        simulations=result.evaluations,
        rate=result.evaluations / spent,
        cost=cost(result.theta),
    )
