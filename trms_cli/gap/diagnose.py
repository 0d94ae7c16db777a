"""The diagnosis: stages in a row, each of which hands plain data to the next.

    admit and divide → refit → separate → race → model form → where → is there a gap?
        → what it looks like → how sure → how far

See ``docs/diagnose.md`` for what each stage does and why.
"""

import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np

from trms_cli.gap.beginning import begins_at
from trms_cli.gap.belief import ANY_RIG, TWIN_ROTOR, calibration, simulated_part
from trms_cli.gap.competing_model import Refit, about_priors, nominal_parameters, refit
from trms_cli.gap.diagnosis import DiagnosisResult
from trms_cli.gap.diagnosis_result import StageResults, result_of
from trms_cli.gap.flexible import fit_flexible
from trms_cli.gap.model_form import leads, refit_with_free_form
from trms_cli.gap.onset import diagnose_onset
from trms_cli.gap.posterior import Posterior, posterior_of
from trms_cli.gap.problem import (
    CandidateEffect,
    GapProblem,
    applicable_candidates,
    divide,
    finest_step,
)
from trms_cli.gap.race import EFFORTS, Checkpoint, run_race
from trms_cli.gap.residuals import innovation_tests, locate, smoothed_forces
from trms_cli.gap.sensor_marks import with_sensor_marks
from trms_cli.gap.shrinkage import SealedRuns, sealed_comparison
from trms_cli.gap.signatures import EffectTraces, effect_traces, project_traces
from trms_cli.identification.problem import Progress, SilentProgress
from trms_cli.models.scales import longest_run

#: Where on the way each stage begins, as a share of the whole.
_BEGINS = {
    "refit": 0.0,
    "separability": 0.08,
    "race": 0.3,
    "model form": 0.75,
    "where": 0.85,
    "tests": 0.9,
    "how far": 0.92,
    "onset": 0.95,
    "advice": 0.98,
}


#: s. What a quick diagnosis fits at most.
_GLANCE = 60.0


class _Watch:
    """Tells the progress where the diagnosis is, and keeps the time of each stage."""

    def __init__(self, progress: Progress) -> None:
        self._progress = progress
        self.seconds: dict[str, float] = {}
        self._stage, self._start_time = "", time.perf_counter()
        self.checkpoint = Checkpoint(progress.saved(), progress.save)

    def enter(self, stage: str) -> None:
        self.leave()
        self._stage, self._start_time = stage, time.perf_counter()
        self.tell(0.0, "")

    def leave(self) -> None:
        if self._stage:
            seconds = self.seconds.get(self._stage, 0.0) + time.perf_counter() - self._start_time
            self.seconds[self._stage] = seconds

    def rounded(self) -> dict[str, float]:
        """Seconds by stage."""
        return {name: round(value, 3) for name, value in self.seconds.items()}

    def tell_whole(self, share: float, message: str) -> bool:
        """Note how far the diagnosis is; an answer of no ends it as Ctrl-C does."""
        if not self._progress.update(share, float("nan"), message):
            raise KeyboardInterrupt
        return True

    def tell(self, share: float, message: str) -> bool:
        """Note how far the stage is."""
        low = _BEGINS[self._stage]
        high = min((begin for begin in _BEGINS.values() if begin > low), default=1.0)
        text = f"{self._stage}: {message}" if message else self._stage
        return self.tell_whole(low + (high - low) * share, text)


def diagnose(problem: GapProblem, progress: Progress | None = None) -> DiagnosisResult:
    """Say where the gap lies, which effect causes it, and how far it shrinks.

    With recordings of a known state to compare with: what changed since.

    Raises ConfigurationError for recordings that are too short, and KeyboardInterrupt if the
    progress asks to stop; what is finished has been saved with it.
    """
    watch = _Watch(progress or SilentProgress())
    # what falls over is predicted again and again over short times
    problem = replace(problem, block=min(problem.block, longest_run(problem.model)))
    if problem.against:
        from trms_cli.gap.change import compare
        from trms_cli.gap.change_result import change_result

        start_time = time.perf_counter()
        result = change_result(problem, compare(problem, watch.tell_whole))
        return replace(result, seconds={"comparison": round(time.perf_counter() - start_time, 3)})
    watch.enter("refit")
    candidates, left_out = applicable_candidates(problem.model, problem.candidates)
    problem = with_sensor_marks(problem, candidates)
    quick = problem.effort == "quick"
    parts = divide(
        problem.datasets,
        problem.block,
        problem.sealed_share,
        problem.model.stops,
        _GLANCE if quick and not problem.investigates else np.inf,
        of_each=problem.investigates,
        finest=finest_step(problem.model, problem.datasets),
    )
    free = nominal_parameters(problem.model)
    simulated = {name: candidate for name, candidate in candidates.items() if candidate.simulated}
    step = parts.fitted[0].sample_time
    unseen = max((len(c.effect.sensor_memory(step)) for c in simulated.values()), default=0)
    nominal = refit(problem.model, free, parts.fitted, parts.block, unseen, problem.quanta)
    watch.enter("separability")
    traces = _traces(nominal, simulated, problem.jobs, watch)
    unbent = about_priors(nominal)
    about = None
    if unbent is not None:
        about = (unbent, effect_traces(unbent, list(simulated.values())))
    watch.enter("race")
    race = run_race(
        nominal,
        simulated,
        traces,
        EFFORTS[problem.effort],
        prior=about,
        checkpoint=watch.checkpoint,
        jobs=problem.jobs,
        watch=watch.tell,
    )
    original = problem
    if not quick:
        watch.enter("model form")
        free_form = refit_with_free_form(
            race, unseen, candidate_names=simulated, watch=lambda message: watch.tell(0.1, message)
        )
        if free_form is not None:
            # traces about the plain refit serve: what is fitted beside free laws is fitted anew
            beside = run_race(
                free_form.nominal,
                simulated,
                traces,
                EFFORTS[problem.effort],
                checkpoint=watch.checkpoint.part(free_form.key),
                jobs=problem.jobs,
                watch=watch.tell,
            )
            if leads(beside, race):
                nominal, race = free_form.nominal, beside
                problem = replace(problem, model=free_form.model)
    package = TWIN_ROTOR if problem.model.bench_sizes else ANY_RIG
    constants = problem.calibration or calibration(package)
    channels = nominal.metric.discrepancy.channels
    usual = {c.location: constants.usual(c.location) for c in channels}
    watch.enter("where")
    place = locate(nominal, usual)
    forces = smoothed_forces(nominal, nominal)
    watch.tell(0.5, "a force without a name")
    flexible = None if quick else fit_flexible(nominal, place, forces)
    watch.enter("tests")
    # errors that are smaller than usual are no gap either
    limits = np.array([usual.get(c.location, np.inf) for c in channels])
    calm = replace(nominal.metric, shares=np.minimum(nominal.metric.shares, limits))
    tests = innovation_tests(replace(nominal, metric=calm), seed=problem.seed)
    watch.enter("how far")
    runs = SealedRuns(problem, parts)
    posterior = posterior_of(problem, race, candidates, forces, place, constants, runs, flexible)
    if not quick and _is_unexplained(posterior):
        # a cause that acts in a part of the recordings fits none of them from end to end
        watch.enter("onset")
        began = diagnose_onset(original, watch.tell)
        if began is not None:
            watch.leave()
            return replace(began, seconds=watch.rounded())
        watch.enter("how far")
    sealed = sealed_comparison(problem, parts, race.refit, posterior.corrected, runs)
    if posterior.stand_in is not None and sealed.shrinkage.leaves_more:
        posterior = replace(posterior, corrected=None)
        sealed = sealed_comparison(problem, parts, race.refit, None, runs)
    watch.enter("advice")
    remaining_signatures = project_traces(posterior.corrected or nominal, traces)
    stage_results = (race, place, forces, tests, posterior, sealed, remaining_signatures)
    result = result_of(StageResults(problem, parts, candidates, left_out, *stage_results))
    watch.leave()
    return replace(result, seconds=watch.rounded())


#: Nats that the likeliest cause may owe to forces without a name before a part of the recordings is
#: suspected to be unlike the rest; and the share of the gap, for no law is exactly that of the rig.
_MOST_BEHIND, _MOST_BEHIND_SHARE = 30.0, 0.05


def _is_unexplained(posterior: Posterior) -> bool:
    """Whether no cause that acts from end to end explains what the refit leaves."""
    features, top = posterior.features, next(iter(posterior.probabilities))
    begins = posterior.corrected is not None and begins_at(posterior.corrected) is not None
    if features.behind < _MOST_BEHIND or begins:
        return False
    if posterior.verdict in ("none_of_these", "undecided", "parameters_only"):
        return True
    part = simulated_part(top)
    behind = dict(zip(features.names, features.behinds.tolist(), strict=True)).get(part)
    return (
        part != top
        or behind is None
        or behind > max(_MOST_BEHIND, _MOST_BEHIND_SHARE * features.behind)
    )


def _traces(
    nominal: Refit, simulated: Mapping[str, CandidateEffect], jobs: int, watch: _Watch
) -> EffectTraces:
    """Traces of all candidates; their models are compiled side by side, which takes longest."""
    candidates = list(simulated.values())
    with ThreadPoolExecutor(max(1, jobs)) as pool:
        for k, _ in enumerate(pool.map(nominal.structure.with_effects, candidates)):
            try:
                watch.tell(0.7 * (k + 1) / len(candidates), candidates[k].name)
            except KeyboardInterrupt:
                pool.shutdown(wait=True, cancel_futures=True)
                raise
    return effect_traces(
        nominal,
        candidates,
        watch=lambda k: watch.tell(0.7 + 0.3 * k / max(len(candidates), 1), "traces"),
    )
