"""One run of a case: closed in memory, exactly what ``trms run`` does, and scored."""

from __future__ import annotations

import multiprocessing
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from experiments.chapter7.study import Job

FloatArray = npt.NDArray[np.float64]
ANGLES = ("alpha_v", "alpha_h")
_THINNING = 5  #: every how many samples a figure keeps one


@dataclass
class Outcome:
    """What became of a run."""

    job: Job
    #: By name; angles in rad. Empty if the run failed.
    figures: dict[str, Any] = field(default_factory=dict)
    #: Thinned: ``time`` (s), angles, references ``r_…`` (rad), inputs (V), the estimated torques
    #: ``d_…`` with deviations ``sd_…`` (N m)
    traces: dict[str, FloatArray] = field(default_factory=dict)
    problem: str = ""  #: Why it failed


def run_job(job: Job, last: float) -> Outcome:
    """Close the loop; never raises but on Ctrl-C.

    ``last``: s at the end over which the steady state is taken.
    """
    outcome = Outcome(job)
    try:
        tables, limits, duration = close_loop(job.overrides)
        outcome.figures = _figures(tables, limits, duration, last)
        outcome.traces = _traces(tables)
    except Exception as error:  # a failing run must not hide the others
        outcome.problem = f"{type(error).__name__}: {error}"
    return outcome


def run_all(jobs: Sequence[Job], last: float, processes: int) -> Iterator[Outcome]:
    """Run jobs in worker processes; yields them in their order."""
    work = partial(run_job, last=last)
    if processes <= 1:
        yield from map(work, jobs)
        return
    # A fresh process each, also where forking is usual: casadi's threads do not survive a fork.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(max_workers=processes, mp_context=context) as pool:
        yield from pool.map(work, jobs)


def close_loop(overrides: Sequence[str]) -> tuple[dict[str, Any], dict[str, Any], float]:
    """Tables by topic, limits by name, and the length (s) of a run kept in memory."""
    from trms_cli.composition.composer import compose
    from trms_cli.library.tasks.experiment import experiment_of, topics_of
    from trms_cli.scoring.metrics import Series
    from trms_cli.simulation.closed_loop import Loop
    from trms_cli.simulation.history import History

    loop_setup = experiment_of(compose(list(overrides)).config)

    def make_history(plant: Any) -> History:
        topics = topics_of(loop_setup, plant)
        return History({t.name: {f.name: f.unit for f in t.fields} for t in topics}, None)

    loop = Loop.start(loop_setup, make_history)
    loop.run()
    history = loop.history
    tables = {
        topic: Series(history.times(topic), history.columns(topic), history.units[topic])
        for topic in history.fields
    }
    lower, upper = loop.plant.input_limits
    bounds = zip(loop.plant.inputs, lower.tolist(), upper.tolist(), strict=True)
    limits = {signal.name: (low, high) for signal, low, high in bounds}
    limits |= {name: (-stop, stop) for name, stop in loop_setup.model.stops.items()}
    return tables, limits, loop.completed_samples * loop_setup.sample_time


def _figures(
    tables: dict[str, Any], limits: dict[str, Any], duration: float, last: float
) -> dict[str, Any]:
    from trms_cli.scoring.score import score_tables

    score = score_tables(tables, limits=limits, duration_s=duration)
    reference, state = tables["/reference"], tables["/plant/state"]
    late = reference.time >= reference.time[-1] - last
    figures: dict[str, Any] = {
        "failures": score["solver"]["failures"],
        "violations": sum(v["samples"] for v in score["constraint_violations"].values()),
        "nees_mean": score["estimate"]["nees_mean"],
        "nis_mean": score["estimate"]["nis_mean"],
    }
    for angle in ANGLES:
        channel = score["channels"][angle]
        error = np.asarray(reference.columns[angle] - state.columns[angle], dtype=float)[late]
        figures[angle] = {
            "rmse": channel["rmse"],
            "overshoot_percent": channel["overshoot_percent"],
            "settling_time_s": channel["settling_time_s"],
            "last_mean_error": float(np.mean(error)),
            "last_largest_error": float(np.max(np.abs(error))),
            "estimate_rmse": score["estimate"]["rmse"][angle],
        }
    for name, values in score["inputs"].items():
        figures[name] = {"total_variation": values["total_variation"]}
    return figures


def _traces(tables: dict[str, Any]) -> dict[str, FloatArray]:
    def column(topic: str, name: str) -> FloatArray:
        return np.asarray(tables[topic].columns[name], dtype=float)[::_THINNING]

    traces = {"time": tables["/reference"].time[::_THINNING]}
    for angle in ANGLES:
        traces[f"r_{angle}"] = column("/reference", angle)
        traces[angle] = column("/plant/state", angle)
    for name in ("u_v", "u_h"):
        traces[name] = column("/command", name)
    for name in ("pitch_moment", "yaw_moment"):
        traces[f"d_{name}"] = column("/estimate", name)
        traces[f"sd_{name}"] = column("/estimate", f"sd_{name}")
    return traces
