"""What a step of the loop costs besides the controller: runner and log, rig, observers."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from benchmarks.document import LIMIT, Column, Table
from benchmarks.filters import PEERS, filter_setup
from benchmarks.hollow import HollowController, HollowObserver, HollowPlant
from benchmarks.options import Options
from benchmarks.setups import experiment
from trms_cli.plants.plant import PlantSetup
from trms_cli.simulation.closed_loop import Experiment, Loop
from trms_cli.simulation.history import History

TITLE = "the parts of a step"
#: µs.
LIMIT_RUNNER, LIMIT_PLANT, LIMIT_FILTER = 50.0, 2.0, 100.0
#: What a moving-horizon estimator may take of a sample of 20 ms, µs.
LIMIT_SAMPLE = 2000.0
OBSERVERS = {
    "ukf": "UKF: 8 states, 4 measurements",
    "ekf": "EKF, the same",
    "state_dependent_ekf": "state-dependent EKF, the same",
    "kalman": "linear Kalman filter, the same",
    "mhe": "moving horizon of 15 samples, the same",
}
_STEPS = 20_000
_BATCH = 100


def run(options: Options) -> list[Table]:
    """Runner with and without log, plant step, observers beside filterpy's."""
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
    for name, label in OBSERVERS.items():
        _add_filter(table, name, label, max(steps // 10, 3 * _BATCH))
    held = _filter_at_bound(max(steps // 10, 3 * _BATCH))
    _add(table, f"{OBSERVERS['mhe']}, a torque at its bound", held, LIMIT_SAMPLE)
    return [table]


def _add_filter(table: Table, name: str, label: str, steps: int) -> None:
    """An observer, beside filterpy's of the same kind where it has one; interleaved by batches."""
    setup, observer, y, u = filter_setup(name)
    state = observer.init(setup)
    peer = PEERS[name](setup, y, u) if name in PEERS else None
    ours, theirs = [], []
    for _ in range(max(2, steps // _BATCH)):
        ours.append(_batches(lambda: observer.step(state, u, y, None), _BATCH))
        if peer is not None:
            theirs.append(_batches(peer, _BATCH))
    times = np.concatenate(ours[1:])
    limit = LIMIT_SAMPLE if name == "mhe" else LIMIT_FILTER
    if peer is None:
        _add(table, label, times, limit)
        return
    of_peer = np.concatenate(theirs[1:])
    _add(table, label, times, limit, float(np.median(of_peer) / np.median(times)))
    _add(table, f"{name} of filterpy, same model and noise", of_peer, None)


def _filter_at_bound(steps: int) -> np.ndarray:
    """µs per step of the moving horizon where a bound is active in each sample, noise on all."""
    setup, observer, y, _ = filter_setup("mhe")
    bounded = replace(observer, bounds={"yaw_moment": (0.003, 0.02)})
    state, random, u = bounded.init(setup), np.random.default_rng(0), np.zeros(2)
    return _batches(
        lambda: bounded.step(state, u, y + 1e-3 * random.standard_normal(len(y)), None), steps
    )[1:]


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
    loop_setup = experiment(
        "controller=newton_mpc", "ref=square", "sim.sample_time=0.01", f"sim.duration={steps / 100}"
    )
    loop_setup = replace(
        loop_setup,
        plant=HollowPlant(loop_setup.model),
        observer=HollowObserver(),
        controller=HollowController(),
        prediction_every=0,
    )
    with tempfile.TemporaryDirectory() as folder:
        return _loop_times(loop_setup, Path(folder) / "run.mcap" if logged else None)


def _loop_times(loop_setup: Experiment, log_path: Path | None) -> np.ndarray:
    from trms_cli.library.tasks.experiment import topics_of
    from trms_cli.recordings.run_log import RunLog

    logs: list[RunLog] = []

    def make_history(plant: Any) -> History:
        topics = topics_of(loop_setup, plant)
        if log_path is not None:
            logs.append(RunLog(log_path, topics, {}))
        units = {t.name: {f.name: f.unit for f in t.fields} for t in topics}
        return History(units, logs[0] if logs else None)

    loop = Loop.start(loop_setup, make_history)
    stamps = [perf_counter()]
    loop.run(lambda time, error: stamps.append(perf_counter()))
    for log in logs:
        log.close("completed")
    per_second = round(1.0 / loop_setup.sample_time)
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
    loop_setup = experiment("controller=newton_mpc", "ref=square", "sim.sample_time=0.01")
    rig = loop_setup.plant.init(PlantSetup(0.01, steps + _BATCH, 0))
    command = np.array([1.4, 0.1])
    if integrate_only:
        rig.advance(command)
        return _batches(rig._step, steps)
    return _batches(lambda: rig.advance(command), steps)
