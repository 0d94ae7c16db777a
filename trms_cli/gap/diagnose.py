"""The diagnosis: nine stages in a row, each of which hands plain data to the next.

    admit → divide → refit → separate → is there a gap? → where → which → how far → how sure

See ``docs/diagnose.md`` for what each stage does and why.
"""

import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import TrmsError
from trms_cli.core.findings import json_data
from trms_cli.core.wording import gap_share, listing, number, quantity, readable, signal, small_unit
from trms_cli.gap import free_runs
from trms_cli.gap.belief import calibration
from trms_cli.gap.competing_model import (
    FittedModel,
    Refit,
    about_priors,
    nominal_parameters,
    refit,
)
from trms_cli.gap.diagnosis import (
    NO_EFFECT,
    Cause,
    Detectable,
    DiagnosisResult,
    FittedParameter,
    GapTest,
    LocationShare,
    MovedParameter,
    NextExperiment,
    NotTestable,
    RaceEntry,
    RegionShare,
    SizeEstimate,
    Traces,
)
from trms_cli.gap.discrepancy import input_channels
from trms_cli.gap.flexible import fit_flexible, node_of, short_law
from trms_cli.gap.force.description import description, regions
from trms_cli.gap.force.laws import ForceRecord
from trms_cli.gap.moved_parameters import moved_parameters
from trms_cli.gap.next_experiment import advise
from trms_cli.gap.onset import diagnose_onset
from trms_cli.gap.posterior import Posterior, posterior_of, simulated_part
from trms_cli.gap.problem import (
    CandidateEffect,
    GapProblem,
    Parts,
    applicable_candidates,
    diagnosed_recordings,
    divide,
)
from trms_cli.gap.race import (
    EFFORTS,
    Checkpoint,
    Race,
    run_race,
)
from trms_cli.gap.rejection import inclusion, rejected_effects
from trms_cli.gap.residuals import Location, innovation_tests, locate, smoothed_forces
from trms_cli.gap.signatures import EffectTraces, Signatures, effect_traces, project_traces
from trms_cli.gap.wording import sizes
from trms_cli.identification.free_runs import simulated_windows
from trms_cli.identification.problem import Progress, SilentProgress

#: Where on the way each stage begins, as a share of the whole.
_BEGINS = {
    "refit": 0.0,
    "separability": 0.08,
    "race": 0.3,
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
        self._stage, self._begun = "", time.perf_counter()
        self.checkpoint = Checkpoint(progress.saved(), progress.save)

    def enter(self, stage: str) -> None:
        self.leave()
        self._stage, self._begun = stage, time.perf_counter()
        self.tell(0.0, "")

    def leave(self) -> None:
        if self._stage:
            spent = self.seconds.get(self._stage, 0.0) + time.perf_counter() - self._begun
            self.seconds[self._stage] = spent

    def tell_whole(self, share: float, message: str) -> bool:
        """Note how far the diagnosis is, where it has stages of its own."""
        if not self._progress.update(share, float("nan"), message):
            raise KeyboardInterrupt
        return True

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

    With recordings of a known state to compare with: what changed since.

    Raises ConfigurationError for recordings that are too short, and KeyboardInterrupt if the
    progress asks to stop; what is finished has been saved with it.
    """
    watch = _Watch(progress or SilentProgress())
    if problem.against:
        from trms_cli.gap.change import compare
        from trms_cli.gap.change_result import change_result

        watch.enter("refit")
        return change_result(problem, compare(problem, watch.tell_whole))
    watch.enter("refit")
    quick = problem.effort == "quick"
    parts = divide(
        problem.datasets,
        problem.block,
        problem.sealed_share,
        problem.model.stops,
        _GLANCE if quick else np.inf,
    )
    free = nominal_parameters(problem.model)
    candidates, left_out = applicable_candidates(problem.model, problem.candidates)
    simulated = {name: candidate for name, candidate in candidates.items() if candidate.simulated}
    step = parts.fitted[0].sample_time
    unseen = max((len(c.effect.sensor_memory(step)) for c in simulated.values()), default=0)
    nominal = refit(problem.model, free, parts.fitted, parts.block, unseen)
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
    constants = calibration()
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
    runs = free_runs.SealedRuns(problem, parts)
    posterior = posterior_of(problem, race, candidates, forces, place, constants, runs, flexible)
    if not quick and _unexplained(posterior):
        # a cause that acts in a part of the recordings fits none of them from end to end
        watch.enter("onset")
        began = diagnose_onset(problem, watch.tell)
        if began is not None:
            return began
        watch.enter("how far")
    sealed = free_runs.sealed_comparison(problem, parts, race.refit, posterior.corrected, runs)
    watch.enter("advice")
    beside = project_traces(posterior.corrected or nominal, traces)
    found = (race, place, forces, tests, posterior, sealed, beside)
    result = result_of(StageResults(problem, parts, candidates, left_out, *found))
    watch.leave()
    seconds = {name: round(value, 3) for name, value in watch.seconds.items()}
    return replace(result, seconds=seconds)


#: Nats that the likeliest cause may owe to forces without a name before a part of the recordings is
#: suspected to be unlike the rest.
_OWED = 30.0


def _unexplained(posterior: Posterior) -> bool:
    """Whether no cause that acts from end to end explains what the refit leaves."""
    features, top = posterior.features, next(iter(posterior.probabilities))
    if features.behind < _OWED:
        return False
    if posterior.verdict in ("none_of_these", "undecided", "parameters_only"):
        return True
    part = simulated_part(top)
    owed = dict(zip(features.names, features.behinds.tolist(), strict=True)).get(part)
    return part != top or owed is None or owed > _OWED


def _traces(
    nominal: Refit, simulated: Mapping[str, CandidateEffect], jobs: int, watch: _Watch
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
        nominal, chosen, watch=lambda k: watch.tell(0.7 + 0.3 * k / max(len(chosen), 1), "traces")
    )


#: Causes less probable than this are not listed.
_LEAST_PROBABILITY = 0.002
#: Places with less of the gap than this are not listed.
_LEAST_SHARE = 0.02


@dataclass(frozen=True)
class StageResults:
    """What the stages of a diagnosis have found."""

    problem: GapProblem
    parts: Parts
    candidates: Mapping[str, CandidateEffect]
    left_out: Mapping[str, str]  #: Why other effects cannot be the cause here
    race: Race
    place: Location
    forces: Mapping[str, ForceRecord]  #: Smoothed missing force of each equation
    tests: tuple[GapTest, ...]
    posterior: Posterior
    sealed: free_runs.SealedComparison
    beside: Signatures  #: Traces about the corrected model, or the refit where nothing is added


def result_of(stages: StageResults) -> DiagnosisResult:
    """The diagnosis, without the times that it took."""
    problem, posterior, refit = stages.problem, stages.posterior, stages.race.refit
    shrinkage = stages.sealed.shrinkage
    where: tuple[LocationShare, ...] = ()
    region: list[RegionShare] = []
    words: tuple[str, ...] = ()
    if posterior.verdict not in ("no_gap", "parameters_only"):
        where = _where(stages)
        main = [w.location for w in where[:2] if w.location in stages.forces]
        forced = {k: v for k, v in stages.place.share().items() if k in stages.forces}
        for location in main or sorted(forced, key=lambda k: -forced[k])[:1]:
            region += regions(stages.forces[location])
            words = words or description(stages.forces[location], _foretold(posterior, location))
    residual, law = _residual(stages)
    words = (*law, *words)
    unseen = _not_testable(stages)
    parameters, causes, moved = _parameters(stages), _causes(stages), _moved_parameters(stages)
    metric = refit.metric
    places = [c.location for c in metric.discrepancy.channels]
    shares = dict(zip(places, metric.shares.tolist(), strict=True))
    drives = [c.location for c in input_channels(refit.model)]
    shares |= dict(zip(drives, metric.drift_sizes.tolist(), strict=True))
    return DiagnosisResult(
        recordings=diagnosed_recordings(problem.datasets),
        model=problem.model_name,
        seed=problem.seed,
        versions={},
        verdict=posterior.verdict,
        where=where,
        region=tuple(region),
        causes=causes,
        confusable=posterior.confusable,
        not_testable=unseen,
        detectable=_detectable(stages),
        parameters=parameters,
        gap=shrinkage.gap,
        shrink=shrinkage.shrink,
        next_experiment=_advice(stages, unseen) if problem.advise else None,
        inclusion=inclusion(posterior.probabilities),
        moved=moved,
        rejected=rejected_effects(stages.race, posterior, stages.candidates, stages.beside, unseen),
        sentence=sentence(posterior, causes, where, shrinkage, moved, law),
        tests=stages.tests,
        race=_race(stages),
        description=words,
        warnings=(*problem.warnings, *_remarks(stages)),
        worse=shrinkage.worse,
        effort=problem.effort,
        refit=refit.values,
        residual=residual,
        evidence={
            **json_data(posterior.features),
            "shares": shares,
        },
        traces=_report_traces(stages, [w.location for w in where]),
    )


def _foretold(posterior: Posterior, location: str) -> float | None:
    """Share of an equation's missing force that the residual without a name foretells."""
    flexible = posterior.flexible
    if flexible is None or flexible.location != location:
        return None
    return flexible.foretold


def _residual_places(posterior: Posterior) -> tuple[str, ...]:
    """Where the residual without a name acts, if the corrected model has it."""
    flexible = posterior.flexible
    if flexible is None or posterior.corrected is not flexible.fitted:
        return ()
    return flexible.places


def _residual(stages: StageResults) -> tuple[dict[str, dict[str, Any]], tuple[str, ...]]:
    """What the corrected model has in place of a named cause, and the short law that is closest."""
    flexible, race = stages.posterior.flexible, stages.race
    if flexible is None or not _residual_places(stages.posterior):
        return {}, ()
    nodes = {name: node_of(effect) for name, effect in flexible.effects.items()}
    return nodes, short_law(race.refit, flexible, stages.forces)


def _where(stages: StageResults) -> tuple[LocationShare, ...]:
    """Each place's share of the gap: by the causes where they are named, else by disturbances."""
    place, posterior, candidates = stages.place, stages.posterior, stages.candidates
    seed = stages.race.refit.structure.problem.seed
    random = np.random.default_rng(np.random.SeedSequence([seed, 1]))
    m = place.together.size
    residual = _residual_places(posterior)
    whole = _shares(posterior.probabilities, place.share(), candidates, residual)
    drawn = [
        _shares(p, place.share(random.integers(0, m, m)), candidates, residual)
        for p in posterior.resampled[:100]
    ]
    listed = []
    for location, share in sorted(whole.items(), key=lambda item: -item[1]):
        if share < _LEAST_SHARE:
            continue
        values = [d.get(location, 0.0) for d in drawn]
        low, high = np.quantile(values, [0.025, 0.975]) if values else (share, share)
        listed.append(
            LocationShare(
                location=location,
                share=share,
                ci95=(float(min(low, share)), float(max(high, share))),
            )
        )
    return tuple(listed)


def _shares(
    probabilities: Mapping[tuple[str, ...], float],
    by_disturbance: Mapping[str, float],
    candidates: Mapping[str, CandidateEffect],
    residual: Sequence[str],
) -> dict[str, float]:
    """``residual``: where what has no name acts; empty where that is not known."""
    unnamed = {k: v for k, v in by_disturbance.items() if not residual or k in residual}
    total = sum(unnamed.values())
    shares: dict[str, float] = {}
    for effects, probability in probabilities.items():
        if effects[0] in NO_EFFECT:
            if effects[0] == "none_of_these" and total > 0:
                for location, share in unnamed.items():
                    shares[location] = shares.get(location, 0.0) + probability * share / total
            continue
        for name in effects:
            places = candidates[name].locations
            weights = np.array([by_disturbance.get(p, 0.0) + 1e-3 for p in places])
            for location, weight in zip(places, weights / weights.sum(), strict=True):
                part = probability * weight / len(effects)
                shares[location] = shares.get(location, 0.0) + float(part)
    return shares


def _causes(stages: StageResults) -> tuple[Cause, ...]:
    race, posterior = stages.race, stages.posterior
    causes = [
        Cause(
            effects=effects,
            probability=probability,
            parameters=_sizes(fitted) if (fitted := posterior.fitted(race, effects)) else {},
        )
        for effects, probability in posterior.probabilities.items()
        if probability >= _LEAST_PROBABILITY or effects[0] in NO_EFFECT
    ]
    total = sum(cause.probability for cause in causes)
    return tuple(
        Cause(effects=c.effects, probability=c.probability / total, parameters=c.parameters)
        for c in causes
    )


def _sizes(entry: FittedModel) -> dict[str, SizeEstimate]:
    fit, sd = entry.fit, entry.fit.sd
    return {
        free.name: SizeEstimate(value=float(fit.theta[i]), sd=float(sd[i]), unit=free.unit)
        for i, free in enumerate(entry.structure.problem.free)
        if "." in free.name and any(free.name.startswith(f"{n}.") for n in entry.names)
    }


def _parameters(stages: StageResults) -> dict[str, FittedParameter]:
    entry = stages.posterior.corrected or stages.race.refit
    structure, fit, sd = entry.structure, entry.fit, entry.fit.sd
    own = set(stages.race.refit.structure.problem.names)
    return {
        free.name: FittedParameter(
            prior=float(stages.problem.model.parameters[free.name].value),
            fitted=float(fit.theta[i]),
            sd=float(sd[i]),
            unit=free.unit,
            moved=None
            if not free.prior_sd
            else float((fit.theta[i] - free.prior_mean) / free.prior_sd),
        )
        for i, free in enumerate(structure.problem.free)
        if free.name in own
    }


#: Probability of other parameters from which it is told which.
_WORTH_TELLING = 0.05


def _moved_parameters(stages: StageResults) -> tuple[MovedParameter, ...]:
    """Which parameters moved, where they may be what differs."""
    problem, posterior = stages.problem, stages.posterior
    likely = posterior.probabilities.get(("parameters_only",), 0.0)
    if posterior.verdict != "parameters_only" and likely < _WORTH_TELLING:
        return ()
    pitch = [
        float(np.nanmean(d.measurements[:, i]))
        for d in problem.datasets
        for i, signal in enumerate(d.outputs)
        if signal.name == "alpha_v"
    ]
    about = float(np.mean(pitch)) if pitch else 0.0
    return moved_parameters(stages.race.refit, problem.model, about, problem.seed)


def _race(stages: StageResults) -> tuple[RaceEntry, ...]:
    """Everyone, and those without an effect to compare with."""
    race, features = stages.race, stages.posterior.features
    refit = race.refit
    own = refit.fit.predictive
    finite = features.scores[np.isfinite(features.scores)]
    most = max(features.behind, float(np.max(finite, initial=0.0)), 1e-9)

    def row(
        effects: tuple[str, ...], predictive: FloatArray, moved: float, **more: Any
    ) -> RaceEntry:
        apart = predictive - own
        error = np.std(apart, ddof=1) * np.sqrt(len(apart)) if len(apart) > 1 else 0.0
        given = {"explained": 0.0, **more}
        return RaceEntry(
            effects=effects, score=float(apart.sum()), se=float(error), moved=moved, **given
        )

    moved = _moved(race, refit)
    rows = [RaceEntry(effects=(), score=0.0, se=0.0, explained=0.0, moved=moved)]
    if refit.raw.evidence is not None:
        rows.append(row(("no_gap",), refit.raw.predictive, 0.0))
    if (flexible := stages.posterior.flexible) is not None:
        predictive = flexible.fitted.fit.predictive
        gained = float(np.clip((predictive - own).sum() / most, 0.0, 1.0))
        rows.append(row(("flexible",), predictive, _moved(race, flexible.fitted), explained=gained))
    for entry in race.entries:
        if entry.fit.evidence is None or not np.isfinite(entry.fit.predictive).all():
            continue
        gained = float(np.clip((entry.fit.predictive - own).sum() / most, 0.0, 1.0))
        rows.append(
            row(
                entry.names,
                entry.fit.predictive,
                _moved(race, entry),
                explained=gained,
                parameters=_sizes(entry),
            )
        )
    return tuple(sorted(rows, key=lambda row: -row.score))


def _moves(race: Race, entry: FittedModel) -> dict[str, float]:
    """Size of the move of each nominal parameter that has a prior, in its standard deviations."""
    own = set(race.refit.structure.problem.names)
    return {
        free.name: float(abs(entry.fit.theta[i] - free.prior_mean) / free.prior_sd)
        for i, free in enumerate(entry.structure.problem.free)
        if free.name in own and free.prior_sd
    }


def _moved(race: Race, entry: FittedModel) -> float:
    return max(_moves(race, entry).values(), default=0.0)


def _detectable(stages: StageResults) -> dict[str, Detectable]:
    signs, sizes = stages.race.signatures, {}
    for name in dict.fromkeys(signs.names):
        least = signs.least_size(name)
        if least is not None:
            unit = stages.candidates[name].free[0].unit
            sizes[name] = Detectable(minimum_size=least, unit=unit)
    return sizes


def _not_testable(stages: StageResults) -> tuple[NotTestable, ...]:
    race = stages.race
    rows = [NotTestable(effect=name, reason=why) for name, why in stages.left_out.items()]
    known = set(race.signatures.names)
    believed = inclusion(stages.posterior.probabilities)
    for name, candidate in stages.candidates.items():
        # what the race was decided by was tested, whatever was foreseen of it
        if not candidate.simulated or believed.get(name, 0.0) >= _LEAST_ALIKE:
            continue
        if name not in known:
            rows.append(NotTestable(effect=name, reason="no simulation with it stays finite"))
        elif race.signatures.least_size(name) is None:
            rows.append(NotTestable(effect=name, reason=why_not_testable(race, candidate)))
    return tuple(rows)


def _remarks(stages: StageResults) -> tuple[str, ...]:
    parts, race = stages.parts, stages.race
    remarks = list(dict.fromkeys(r for d in (*parts.whole, *parts.fitted) for r in d.remarks))
    far = {name: move for name, move in _moves(race, race.refit).items() if move > 3.0}
    proxies = []
    if far:
        moves = listing([f"{name} by {move:.1f}" for name, move in far.items()])
        proxies.append(
            f"the refit had to move {moves} standard deviations of what was known: rather "
            "proxies of what is missing than an explanation"
        )
    return (*remarks, *proxies)


def _advice(stages: StageResults, unseen: tuple[NotTestable, ...]) -> NextExperiment | None:
    """What to record next: what parts those that are not told apart, else what shows the unseen."""
    race, posterior, candidates = stages.race, stages.posterior, stages.candidates
    best = posterior.best
    apart: list[str] = []
    values: dict[str, float] = {}
    shares = None
    if best is not None and posterior.confusable and best.names[0] not in NO_EFFECT:
        apart = list(dict.fromkeys(n for group in posterior.confusable for n in group))
        for entry in race.entries:
            values = {**entry.values, **values}
        shares = best.metric.shares
    try:
        return advise(
            refit=race.refit,
            candidates=candidates,
            model_name=stages.problem.model_name,
            apart=apart,
            untested=[row.effect for row in unseen if row.effect in candidates],
            values=values,
            shares=shares,
        )
    except (TrmsError, FloatingPointError, np.linalg.LinAlgError):
        return None  # an experiment that cannot be predicted is no reason to lose a diagnosis


#: Probability from which a cause that is not told apart is worth its name.
_LEAST_ALIKE = 0.01
#: Parameters that a sentence names.
_MOVED_TOLD = 3
#: Times the floor from which on a refitted model is said to leave something unexplained.
_MUCH = 5.0
#: Times the floor up to which a model without a gap is at it.
_LITTLE = 1.2


def sentence(
    posterior: Posterior,
    causes: Sequence[Cause],
    where: Sequence[LocationShare],
    shrinkage: free_runs.Shrinkage,
    moved: Sequence[MovedParameter] = (),
    law: Sequence[str] = (),
) -> str:
    """What a colleague would say; ``law``: of a residual without a name."""
    top = causes[0]
    place = f"the {readable(where[0].location)}" if where else "no single place"
    if posterior.verdict == "no_gap":
        return (
            "No gap was found, with probability "
            f"{_sure(top.probability)}: the model as it is needs neither an effect nor other "
            "parameters to explain these recordings." + _above_floor(shrinkage)
        )
    if posterior.verdict == "parameters_only":
        which = listing([item.words for item in moved[:_MOVED_TOLD]])
        return (
            "No effect is missing: other values of the parameters explain these recordings, with "
            f"probability {_sure(top.probability)}"
            + (f"; what moved is likeliest the {which}." if which else ".")
            + _left_over(shrinkage)
        )
    if posterior.verdict == "none_of_these":
        return (
            f"Something is missing that is none of the effects known here, with probability "
            f"{_sure(top.probability)}; it acts mostly on {place}."
            + "".join(f" {w}" for w in law[:1])
        )
    if posterior.verdict == "undecided":
        listed = ", ".join(
            f"{_effects(c.effects)} ({c.probability:.2f})"
            for c in causes[:3]
            if c.probability > 0.05
        )
        return f"These recordings do not decide what causes the gap: {listed}."
    told = sizes(dict(list(top.parameters.items())[:3]))
    causes_it = "causes it" if len(top.effects) == 1 else "cause it"
    text = (
        f"The gap lies in {place}, and {_effects(top.effects)} {causes_it}, with probability "
        f"{_sure(top.probability)}" + (f" ({told})" if told else "")
    )
    if not top.parameters:  # from outside: it can be allowed for, and nothing can be added
        return text + "; it is estimated, not explained: the corrected model is the refitted one."
    shrink = shrinkage.shrink.get("all", {}).get(free_runs.TOLD_AT)
    if shrink is not None and shrink.fraction is not None:
        if shrink.fraction > 0:
            closed = gap_share(shrink.fraction, shrink.ci95, "of the gap at 2 s")
            text += f"; on data kept aside, adding it closes {closed}"
        else:
            text += "; on data kept aside, adding it closes nothing of the gap at 2 s"
    likely = {n for cause in causes if cause.probability >= _LEAST_ALIKE for n in cause.effects}
    alike = {name for group in posterior.confusable for name in group}
    others = sorted((alike & likely) - set(top.effects))
    if others:
        text += f". These recordings do not tell it from {_effects(others, 'or')}"
    return text + "."


def _sure(probability: float) -> str:
    """A probability that never reads as certain."""
    return "over 0.99" if probability >= 0.995 else f"{probability:.2f}"


def _left_over(shrinkage: free_runs.Shrinkage) -> str:
    """What the refitted model still lacks on the sealed part, where that is much.

    The verdict compares causes on the part that was fitted. A short recording can be fitted by
    parameters that do not hold afterwards; who reads "parameters" has to be told.
    """
    worst, ratio = _farthest(shrinkage, "refit")
    if ratio < _MUCH:
        return ""
    gap = shrinkage.gap[worst][free_runs.TOLD_AT]
    return (
        f" But on the part kept aside they leave {worst} off by {gap.refit:.2g} {gap.unit} at 2 s, "
        f"{ratio:.0f} times what the noise explains: do not rely on this, and record longer."
    )


def _above_floor(shrinkage: free_runs.Shrinkage) -> str:
    """By how much free runs of a model without a gap err beyond the noise, and why it is none.

    The verdict weighs errors of one step, and the floor knows only the sensors' noise.
    """
    worst, ratio = _farthest(shrinkage, "raw")
    if ratio < _LITTLE:
        return ""
    gap = shrinkage.gap[worst][free_runs.TOLD_AT]
    small, scale = small_unit(gap.unit)
    errors = (
        f"{signal(worst)}, {number(scale * gap.raw)} against {quantity(scale * gap.floor, small)}"
    )
    text = f" Over 2 s it errs by up to {ratio:.1f} times what the sensors' noise alone makes"
    if ratio < _MUCH:
        return f"{text} ({errors}): errors of its equations so small are usual and count as no gap."
    return f"{text} ({errors}): do not rely on this, and record longer."


def _farthest(shrinkage: free_runs.Shrinkage, model: str) -> tuple[str, float]:
    """The channel whose free runs of 2 s lie farthest above the floor, and how many times."""
    ratios = {
        channel: getattr(gaps[free_runs.TOLD_AT], model) / gaps[free_runs.TOLD_AT].floor
        for channel, gaps in shrinkage.gap.items()
        if free_runs.TOLD_AT in gaps and gaps[free_runs.TOLD_AT].floor > 0
    }
    worst = max(ratios, key=lambda channel: ratios[channel], default="")
    return worst, ratios.get(worst, 0.0)


def why_not_testable(race: Race, candidate: CandidateEffect) -> str:
    """Why recordings say nothing on an effect."""
    signs = race.signatures
    rows = signs.rows(candidate.name)
    raw = float(np.sqrt(np.max(signs.energy[rows])))
    absorbed = signs.absorbed(candidate.name)
    if raw < 5.0:
        return (
            "what it does was not excited: at several times its typical size it would change the "
            f"outputs by {raw:.1f} standard deviations of the noise"
        )
    return (
        f"the nominal parameters can do {100 * absorbed:.1f} % of what it does within their "
        "priors, and the rest is below the noise"
    )


def _effects(names: Iterable[str], word: str = "and") -> str:
    return listing([readable(name) for name in names], word)


#: Points of a picture's line at most.
_POINTS = 1500
#: s. Length of the free run that is shown.
_SHOWN = 10.0


def _report_traces(stages: StageResults, locations: Sequence[str]) -> Traces:
    """Missing forces with what explains them, and free runs before and after."""
    forces, corrected = stages.forces, stages.posterior.corrected
    shown = [name for name in locations if name in forces] or list(forces)[:1]
    explained: dict[str, FloatArray] = {}
    if corrected is not None:
        left = smoothed_forces(stages.race.refit, corrected)
        explained = {name: forces[name].force - left[name].force for name in shown}
    first = forces[shown[0]] if shown else None
    rows = slice(None, None, 1 if first is None else max(1, len(first.time) // _POINTS))
    force: dict[str, FloatArray] = {}
    for name in shown:
        force[name] = forces[name].force[rows]
        force[f"{name}.sd"] = forces[name].sd[rows]
    time, runs = _runs(stages.parts, stages.sealed)
    return Traces(
        force_time=np.zeros(0) if first is None else first.time[rows],
        force=force,
        force_unit={name: forces[name].unit for name in shown},
        explained={name: value[rows] for name, value in explained.items()},
        run_time=time,
        runs=runs,
    )


def _runs(
    parts: Parts, sealed: free_runs.SealedComparison
) -> tuple[FloatArray, dict[str, dict[str, FloatArray]]]:
    """The free run over the sealed part in which most was gained."""
    number, first, last = parts.sealed[0]
    dataset = parts.whole[number]
    step = dataset.sample_time
    before = free_runs.history(step)
    samples = min(round(_SHOWN / step), last - first - before - 1)
    begins = np.arange(max(first, before), last - samples + 1, max(1, samples // 2))
    if samples < 5 or not len(begins):
        return np.zeros(0), {}
    simulated = {}
    for name, (model, rollout) in sealed.models.items():
        starts = free_runs.start_states(model, rollout, dataset, begins)
        p = model.parameters.values
        simulated[name] = simulated_windows(rollout, dataset, begins, samples, starts, p)
    measured = dataset.measurements[begins[:, None] + np.arange(samples)]
    after = simulated.get("corrected", simulated["refit"])
    with np.errstate(all="ignore"):
        worse = np.nansum((simulated["refit"] - measured) ** 2, axis=1)
        better = np.nansum((after - measured) ** 2, axis=1)
        gained = np.nansum((worse - better) / np.maximum(dataset.noise_sd**2, 1e-18), axis=1)
    best = int(np.argmax(gained)) if len(simulated) > 2 else int(np.argmax(worse.sum(axis=1)))
    time = dataset.time[begins[best] : begins[best] + samples]
    runs = {
        signal.name: {
            "measured": measured[best, :, i],
            **{name: y[best, :, i] for name, y in simulated.items()},
        }
        for i, signal in enumerate(dataset.outputs)
    }
    return np.asarray(time - time[0] + float(time[0])), runs
