"""What a step of the loop costs besides the controller: runner and log, rig, filter."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from benchmarks.document import LIMIT, Column, Table
from benchmarks.hollow import HollowController, HollowObserver, HollowPlant
from benchmarks.options import Options
from benchmarks.setups import experiment
from trms_cli.observers.observer import ObserverSetup
from trms_cli.plants.plant import PlantSetup
from trms_cli.simulation.closed_loop import Experiment, Loop
from trms_cli.simulation.history import History

TITLE = "the parts of a step"
#: µs.
LIMIT_RUNNER, LIMIT_PLANT, LIMIT_FILTER = 50.0, 2.0, 100.0
_STEPS = 20_000
_BATCH = 100


def run(options: Options) -> list[Table]:
    """Runner with and without log, plant step, UKF beside filterpy's."""
    steps = 500 if options.quick else _STEPS
    table = Table(
        "parts",
        TITLE + " (means over batches of 100 steps; the median batch)",
        [
            Column("part", "part"),
            Column("median", "median", "µs"),
            Column("p99", "99 %", "µs"),
            *LIMIT,
            Column("peer", "filterpy", "× ours"),
        ],
    )
    for name, logged, limit in (
        ("runner: loop and log, all topics", True, LIMIT_RUNNER),
        ("runner: loop alone, kept in memory", False, None),
    ):
        times = runner_times(steps, logged=logged)
        _add(table, name, times, limit)
    _add(table, "rig: integration of 10 ms", _plant_times(steps, integrate_only=True), LIMIT_PLANT)
    _add(table, "rig: integration, torques, checks", _plant_times(steps), None)
    ours, theirs = _filter_times(max(steps // 10, 3 * _BATCH))
    _add(
        table,
        "UKF: 8 states, 4 measurements",
        ours,
        LIMIT_FILTER,
        float(np.median(theirs) / np.median(ours)),
    )
    _add(table, "UKF of filterpy, same model and noise", theirs, None)
    return [table]


def _add(
    table: Table, part: str, times: np.ndarray, limit: float | None, peer: float | None = None
) -> None:
    median, p99 = (float(value) for value in np.percentile(times, [50, 99]))
    if limit is None:
        table.add(part=part, median=median, p99=p99, peer=peer)
    else:
        table.add_limited("median", median, limit, part=part, p99=p99, peer=peer)


def runner_times(steps: int, *, logged: bool) -> np.ndarray:
    """µs per step of the loop with hollow plugins, a figure for each simulated second."""
    chosen = experiment(
        "controller=newton_mpc", "ref=square", "sim.sample_time=0.01", f"sim.duration={steps / 100}"
    )
    chosen = replace(
        chosen,
        plant=HollowPlant(chosen.model),
        observer=HollowObserver(),
        controller=HollowController(),
        prediction_every=0,
    )
    with tempfile.TemporaryDirectory() as folder:
        return _loop_times(chosen, Path(folder) / "run.mcap" if logged else None)


def _loop_times(chosen: Experiment, log_path: Path | None) -> np.ndarray:
    from trms_cli.commands.run_assembly import topics_of
    from trms_cli.recordings.run_log import RunLog

    logs: list[RunLog] = []

    def make_history(plant: Any) -> History:
        topics = topics_of(chosen, plant)
        if log_path is not None:
            logs.append(RunLog(log_path, topics, {}))
        units = {t.name: {f.name: f.unit for f in t.fields} for t in topics}
        return History(units, logs[0] if logs else None)

    loop = Loop.start(chosen, make_history)
    stamps = [perf_counter()]
    loop.run(lambda time, error: stamps.append(perf_counter()))
    for log in logs:
        log.close("completed")
    per_second = round(1.0 / chosen.sample_time)
    return 1e6 * np.diff(stamps) / per_second


def _batches(step: Callable[[], object], steps: int) -> np.ndarray:
    """µs per call, one figure a batch."""
    times = []
    for _ in range(max(1, steps // _BATCH)):
        begin = perf_counter()
        for _ in range(_BATCH):
            step()
        times.append((perf_counter() - begin) / _BATCH)
    return 1e6 * np.array(times)


def _plant_times(steps: int, *, integrate_only: bool = False) -> np.ndarray:
    chosen = experiment("controller=newton_mpc", "ref=square", "sim.sample_time=0.01")
    rig = chosen.plant.init(PlantSetup(0.01, steps + _BATCH, 0))
    command = np.array([1.4, 0.1])
    if integrate_only:
        rig.advance(command)
        return _batches(rig._step, steps)
    return _batches(lambda: rig.advance(command), steps)


def _filter_times(steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Ours and filterpy's on the same augmented model, interleaved by batches."""
    chosen = experiment(
        "controller=newton_mpc", "ref=square", "observer=ukf", "sim.sample_time=0.02"
    )
    plant = chosen.plant.init(PlantSetup(0.02, 2, 0))
    outputs = tuple(signal.name for signal in plant.outputs)
    setup = ObserverSetup(
        chosen.model, 0.02, outputs, plant.noise_sd, plant.measure(), plant.first_command
    )
    y, u = plant.measure().copy(), np.array([1.0, 0.1])
    state = chosen.observer.init(setup)
    theirs = _filterpy(setup, y, u)
    ours_times, their_times = [], []
    for _ in range(steps // _BATCH):
        ours_times.append(_batches(lambda: chosen.observer.step(state, u, y, None), _BATCH))
        their_times.append(_batches(theirs, _BATCH))
    return np.concatenate(ours_times[1:]), np.concatenate(their_times[1:])


def _filterpy(setup: ObserverSetup, y: np.ndarray, u: np.ndarray) -> Callable[[], None]:
    """A step of filterpy's filter; its model functions are the same compiled ones."""
    from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter

    from trms_cli.core.compilation import BufferedFunction
    from trms_cli.models.discretisation import discretise
    from trms_cli.models.model import names

    model = setup.model
    discrete = discretise(model, setup.sample_time, 1)
    advance, sense = BufferedFunction(discrete.step), BufferedFunction(discrete.measurement)
    advance.inputs[2][:] = sense.inputs[2][:] = model.parameters.values
    n_x = model.n_x
    equations = [names(model.disturbances).index(axis.moment) for axis in model.axes.values()]
    n = n_x + len(equations)

    def fx(z: np.ndarray, dt: float) -> np.ndarray:
        advance.inputs[0][:], advance.inputs[1][:] = z[:n_x], u
        advance.inputs[3][equations] = z[n_x:]
        advance()
        return np.concatenate([advance.outputs[0], z[n_x:]])

    def hx(z: np.ndarray) -> np.ndarray:
        sense.inputs[0][:] = z[:n_x]
        sense()
        return sense.outputs[0].copy()

    points = MerweScaledSigmaPoints(n, alpha=1.0, beta=2.0, kappa=0.0)
    peer = UnscentedKalmanFilter(n, len(y), setup.sample_time, hx, fx, points)
    peer.x = np.concatenate([model.rest(), np.zeros(len(equations))])
    peer.P = np.diag(np.full(n, 1e-2))
    peer.Q = np.diag(np.full(n, 1e-4))
    peer.R = np.diag([setup.noise_sd[name] ** 2 for name in setup.outputs])

    def step() -> None:
        peer.predict()
        peer.update(y)

    return step
