"""Runs of the cases: closed in memory, exactly what ``trms run`` does, and scored."""

from __future__ import annotations

import multiprocessing
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from experiments.chapter7.study import CONFIGS, Job
from trms_cli.simulation.closed_loop import Experiment

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


@dataclass(frozen=True)
class Tables:
    """A run in memory."""

    by_topic: dict[str, Any]  #: :class:`trms_cli.scoring.metrics.Series` by topic
    limits: dict[str, Any]  #: Lower and upper bounds of inputs and angles, by name
    duration: float  #: s


def run_job(job: Job, last: float) -> Outcome:
    """Close the loop; never raises but on Ctrl-C.

    ``last``: s at the end over which the steady state is taken.
    """
    try:
        return outcome_of(job, close_loop(experiment_for(job.overrides)), last)
    except Exception as error:  # a failing run must not hide the others
        return Outcome(job, problem=f"{type(error).__name__}: {error}")


def run_batch(jobs: Sequence[Job], last: float) -> list[Outcome]:
    """Those on rigs of the blind sets side by side, see :mod:`.side_by_side`; never raises."""
    if len(jobs) == 1:
        return [run_job(jobs[0], last)]
    from experiments.chapter7.side_by_side import run_side_by_side

    experiments = [experiment_for(job.overrides) for job in jobs]
    runs = run_side_by_side(experiments, lambda _, experiment: close_loop(experiment))
    return [
        Outcome(job, problem=f"{type(run).__name__}: {run}")
        if isinstance(run, BaseException)
        else outcome_of(job, run, last)
        for job, run in zip(jobs, runs, strict=True)
    ]


def run_all(jobs: Sequence[Job], last: float, processes: int) -> Iterator[Outcome]:
    """Run jobs in worker processes; yields them in their order."""
    blind = [job for job in jobs if job.is_blind]
    batches = [[job] for job in jobs if not job.is_blind] + ([blind] if blind else [])
    work = partial(run_batch, last=last)
    if processes <= 1:
        for outcomes in map(work, batches):
            yield from outcomes
        return
    # A fresh process each, also where forking is usual: casadi's threads do not survive a fork.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(max_workers=processes, mp_context=context) as pool:
        for outcomes in pool.map(work, batches):
            yield from outcomes


def experiment_for(overrides: Sequence[str]) -> Experiment:
    """What ``trms run`` would close, with the study's own folder of options."""
    from trms_cli.composition.composer import compose
    from trms_cli.core import trust
    from trms_cli.library.tasks.experiment import experiment_of

    trust.allow_for_now("experiments")  # the rigs are a plugin of this package
    return experiment_of(compose(list(overrides), config_dirs=(CONFIGS,)).config)


def close_loop(loop_setup: Experiment) -> Tables:
    """A run kept in memory."""
    from trms_cli.library.tasks.experiment import topics_of
    from trms_cli.scoring.metrics import Series
    from trms_cli.simulation.closed_loop import Loop
    from trms_cli.simulation.history import History

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
    return Tables(tables, limits, loop.completed_samples * loop_setup.sample_time)


def outcome_of(job: Job, run: Tables, last: float) -> Outcome:
    """Score a run; ``last``: s at the end over which the steady state is taken."""
    return Outcome(
        job, _figures(run.by_topic, run.limits, run.duration, last), _traces(run.by_topic)
    )


def _figures(
    tables: dict[str, Any], limits: dict[str, Any], duration: float, last: float
) -> dict[str, Any]:
    from trms_cli.scoring.score import score_tables

    score = score_tables(tables, limits=limits, duration_s=duration)
    reference, angles = tables["/reference"], _angles(tables)
    estimate = score["estimate"] or {}
    late = reference.time >= reference.time[-1] - last
    figures: dict[str, Any] = {
        "failures": score["solver"]["failures"],
        "violations": sum(v["samples"] for v in score["constraint_violations"].values()),
        "nees_mean": estimate.get("nees_mean"),
        "nis_mean": estimate.get("nis_mean"),
    }
    for angle in ANGLES:
        channel = score["channels"][angle]
        error = np.asarray(reference.columns[angle] - angles[angle], dtype=float)[late]
        figures[angle] = {
            "rmse": channel["rmse"],
            "overshoot_percent": channel["overshoot_percent"],
            "settling_time_s": channel["settling_time_s"],
            "last_mean_error": float(np.nanmean(error)),
            "last_largest_error": float(np.nanmax(np.abs(error))),
            "estimate_rmse": (estimate.get("rmse") or {}).get(angle),
        }
    for name, values in score["inputs"].items():
        figures[name] = {"total_variation": values["total_variation"]}
    return figures


def _angles(tables: dict[str, Any]) -> dict[str, FloatArray]:
    """The true angles, or, of a rig behind a wire, those that were measured."""
    source = (tables.get("/plant/state") or tables["/measurement"]).columns
    return {angle: np.asarray(source[angle], dtype=float) for angle in ANGLES}


def _traces(tables: dict[str, Any]) -> dict[str, FloatArray]:
    def column(topic: str, name: str) -> FloatArray:
        return np.asarray(tables[topic].columns[name], dtype=float)[::_THINNING]

    traces = {"time": tables["/reference"].time[::_THINNING]}
    for angle in ANGLES:
        traces[f"r_{angle}"] = column("/reference", angle)
        traces[angle] = _angles(tables)[angle][::_THINNING]
    for name in ("u_v", "u_h"):
        traces[name] = column("/command", name)
    for name in ("pitch_moment", "yaw_moment"):
        traces[f"d_{name}"] = column("/estimate", name)
        traces[f"sd_{name}"] = column("/estimate", f"sd_{name}")
    return traces
