"""The diagnosis: nine stages in a row, each of which hands plain data to the next.

    admit → divide → refit → separate → is there a gap? → where → which → how far → how sure

See ``docs/diagnose.md`` for what each stage does and why.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from trms_cli.gap.candidates import CandidateEffect, applicable_candidates
from trms_cli.gap.diagnosis import DiagnosisResult
from trms_cli.gap.fitting import Metric, Refit, nominal_parameters, refit
from trms_cli.gap.free_runs import sealed_comparison
from trms_cli.gap.innovation_tests import innovation_tests
from trms_cli.gap.location import locate, smoothed_forces
from trms_cli.gap.posterior import calibration, posterior_of
from trms_cli.gap.problem import GapProblem, Parts, divide
from trms_cli.gap.race import EFFORTS, Checkpoint, Race, run_race
from trms_cli.gap.separability import EffectTraces, effect_traces
from trms_cli.gap.summary import StageResults, result_of
from trms_cli.identification.method import Progress, Unwatched

#: Where on the way each stage begins, as a share of the whole.
_BEGINS = {
    "refit": 0.0,
    "separability": 0.08,
    "race": 0.3,
    "where": 0.85,
    "tests": 0.9,
    "how far": 0.93,
    "advice": 0.98,
}


class _Watch:
    """Tells the progress where the diagnosis is, and keeps the time of each stage."""

    def __init__(self, progress: Progress) -> None:
        self._progress = progress
        self.seconds: dict[str, float] = {}
        self._stage, self._begun = "", time.perf_counter()
        self.checkpoint = Checkpoint(progress.saved(), progress.save)

    def enter(self, stage: str) -> None:
        self.leave()
        self._stage, self._begun = stage, time.perf_counter()
        self.tell(0.0, "")

    def leave(self) -> None:
        if self._stage:
            self.seconds[self._stage] = time.perf_counter() - self._begun

    def tell(self, share: float, message: str) -> bool:
        """Note how far the stage is; an answer of no ends the diagnosis as Ctrl-C does."""
        names = list(_BEGINS)
        at = names.index(self._stage)
        low = _BEGINS[self._stage]
        high = _BEGINS[names[at + 1]] if at + 1 < len(names) else 1.0
        text = f"{self._stage}: {message}" if message else self._stage
        if not self._progress.update(low + (high - low) * share, float("nan"), text):
            raise KeyboardInterrupt
        return True


def diagnose(problem: GapProblem, progress: Progress | None = None) -> DiagnosisResult:
    """Say where the gap lies, which effect causes it, and how far it shrinks.

    Raises ConfigurationError for recordings that are too short, and KeyboardInterrupt if the
    progress asks to stop; what is finished has been saved with it.
    """
    watch = _Watch(progress or Unwatched())
    watch.enter("refit")
    parts = divide(problem.datasets, problem.block, problem.sealed_share, problem.model.stops)
    free = nominal_parameters(problem.model)
    nominal = refit(problem.model, free, parts.fitted, parts.block)
    candidates, left_out = applicable_candidates(problem.model, problem.candidates)
    simulated = {
        name: s
        for name, s in candidates.items()
        if not s.stochastic and not name.endswith("quantisation")
    }
    watch.enter("separability")
    traces = _traces(nominal, simulated, problem.jobs, watch)
    watch.enter("race")
    race = run_race(
        nominal,
        simulated,
        traces,
        EFFORTS[problem.effort],
        checkpoint=watch.checkpoint,
        jobs=problem.jobs,
        watch=watch.tell,
    )
    return _answered(problem, parts, candidates, left_out, race, watch)


def _answered(
    problem: GapProblem,
    parts: Parts,
    candidates: Mapping[str, CandidateEffect],
    left_out: Mapping[str, str],
    race: Race,
    watch: _Watch,
) -> DiagnosisResult:
    constants = calibration()
    nominal = race.refit
    channels = nominal.metric.discrepancy.channels
    usual = {c.location: constants.usual(c.location) for c in channels if c.fixed is None}
    watch.enter("where")
    place = locate(nominal, usual)
    forces = smoothed_forces(nominal, nominal)
    watch.enter("tests")
    # errors that are smaller than usual are no gap either
    limits = np.array([usual.get(c.location, np.inf) for c in channels])
    calm = Metric(nominal.metric.discrepancy, np.minimum(nominal.metric.shares, limits))
    tests = innovation_tests(replace(nominal, metric=calm), seed=problem.seed)
    posterior = posterior_of(problem, race, candidates, forces, place, constants)
    watch.enter("how far")
    sealed = sealed_comparison(problem, parts, race, posterior)
    watch.enter("advice")
    stages = StageResults(
        problem=problem,
        parts=parts,
        candidates=candidates,
        left_out=left_out,
        race=race,
        place=place,
        forces=forces,
        tests=tests,
        posterior=posterior,
        sealed=sealed,
    )
    result = result_of(stages)
    watch.leave()
    seconds = {name: round(value, 3) for name, value in watch.seconds.items()}
    return replace(result, seconds=seconds)


def _traces(
    nominal: Refit,
    simulated: Mapping[str, CandidateEffect],
    jobs: int,
    watch: _Watch,
) -> EffectTraces:
    """Traces of all candidates; their models are compiled side by side, which takes longest."""
    from concurrent.futures import ThreadPoolExecutor

    chosen = list(simulated.values())
    with ThreadPoolExecutor(max(1, jobs)) as pool:
        for k, _ in enumerate(pool.map(nominal.structure.with_effects, chosen)):
            try:
                watch.tell(0.7 * (k + 1) / len(chosen), chosen[k].name)
            except KeyboardInterrupt:
                pool.shutdown(wait=True, cancel_futures=True)
                raise
    return effect_traces(
        nominal,
        chosen,
        watch=lambda k: watch.tell(0.7 + 0.3 * k / max(len(chosen), 1), "traces"),
    )
