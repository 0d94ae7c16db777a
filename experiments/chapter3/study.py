"""All trainings of the study, on as many processes as are allowed."""

from __future__ import annotations

import multiprocessing
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial

from experiments.chapter3.methods import method
from experiments.chapter3.structure_selection import AssessedCandidate, Candidate
from experiments.chapter3.structure_selection import assess as assess_candidate
from experiments.chapter3.trainings import (
    Job,
    TrainingResult,
    make_recording,
    model_of,
    run_job,
    settings,
)
from trms_cli.core.threads import ONE_THREAD
from trms_cli.identification.problem import FitProblem, SilentProgress

#: Where all members are trained; ``systems`` of a member says others.
ONE_AXIS = ("horizontal", "vertical")


@dataclass(frozen=True)
class Study:
    """What came out of a study."""

    tables: dict[str, list[TrainingResult]]  #: The trainings of each system
    members: dict[str, list[TrainingResult]]  #: The members of each system
    activations: dict[str, list[TrainingResult]]  #: Of the hidden units, for each system
    excitations: list[TrainingResult]  #: The same network fitted to two kinds of commands
    structures: list[AssessedCandidate]


def run_study(jobs: int, short: float = 1.0, seeds: Sequence[int] | None = None) -> Study:
    """Run everything; ``short`` is the share of the recordings' durations.

    ``jobs``: processes. ``seeds``: in place of the settings'.
    """
    with _pool(jobs) as run:

        def trained(name: str, work: Sequence[Job]) -> list[TrainingResult]:
            return list(_show_progress(name, run(partial(run_job, short=short), work), len(work)))

        tables = {
            name: trained(name, _table_jobs(name, seeds or own.get("seeds", settings()["seeds"])))
            for name, own in settings()["systems"].items()
        }
        members = {
            name: trained(
                f"{name} members", _member_jobs(name, seeds or settings()["member_seeds"])
            )
            for name in settings()["systems"]
        }
        activations = {
            name: trained(f"{name} activations", _activation_jobs(name, seeds))
            for name in settings()["systems"]
        }
        excitations = trained("excitations", _excitation_jobs(seeds))
        own = settings()["structure"]
        candidates = [Candidate(lags, hidden) for lags in own["lags"] for hidden in own["hidden"]]
        start_seeds = list(seeds or own["seeds"])
        structures = list(
            _show_progress(
                "structure",
                run(partial(_assess, seeds=start_seeds, short=short), candidates),
                len(candidates),
            )
        )
    return Study(tables, members, activations, excitations, structures)


def _table_jobs(system: str, seeds: Sequence[int]) -> list[Job]:
    trainings = settings()["systems"][system]["trainings"]
    return [
        Job(system, training, "narx", training, seed) for training in trainings for seed in seeds
    ]


def _member_jobs(system: str, seeds: Sequence[int]) -> list[Job]:
    return [
        Job(system, name, member["method"], "lm", seed, member["changes"])
        for name, member in settings()["members"].items()
        if system in member.get("systems", ONE_AXIS)
        for seed in seeds
    ]


def _activation_jobs(system: str, seeds: Sequence[int] | None) -> list[Job]:
    own = settings()["activations"]
    return [
        Job(system, activation, "narx", "lm", seed, {"activation": activation})
        for activation in own["of"]
        for seed in seeds or own["seeds"]
    ]


def _excitation_jobs(seeds: Sequence[int] | None) -> list[Job]:
    own = settings()["excitations"]
    return [
        Job(own["system"], label, "narx", "lm", seed, {}, own[label] if label == "prbs" else None)
        for label in ("prbs", "multilevel")
        for seed in seeds or own["seeds"]
    ]


def _assess(candidate: Candidate, seeds: Sequence[int], short: float) -> AssessedCandidate:
    system = settings()["structure"]["system"]
    problem = FitProblem(
        model=model_of(system),
        datasets=(make_recording(system, "fitted", short),),
        validation=(make_recording(system, "validation", short),),
    )
    return assess_candidate(
        candidate, method("narx", "lm", settings()["method"]), problem, seeds, SilentProgress()
    )


@contextmanager
def _pool(jobs: int) -> Iterator[Callable[..., Iterator]]:
    """``map`` over processes, or in this one where one job is asked for."""
    if jobs <= 1:
        yield map
        return
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(ONE_THREAD)
    try:
        with ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn")) as pool:
            yield pool.map
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _show_progress(name: str, results: Iterator, count: int) -> Iterator:
    """Results as they come, with a line on the screen that counts them."""
    for number, result in enumerate(results, start=1):
        if sys.stderr.isatty():
            sys.stderr.write(f"\r{name}: {number} of {count}  ")
            if number == count:
                sys.stderr.write("\n")
        yield result
