"""What the stages of a diagnosis have found, as one diagnosis: verdict, causes, places, tables."""

from collections import ChainMap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import TrmsError
from trms_cli.core.findings import json_data
from trms_cli.core.wording import listing
from trms_cli.gap import free_runs
from trms_cli.gap.beginning import onset_of
from trms_cli.gap.belief import standard_error
from trms_cli.gap.competing_model import FittedModel
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
    Traces,
)
from trms_cli.gap.discrepancy import input_channels
from trms_cli.gap.flexible import node_of, short_law
from trms_cli.gap.force.description import description, regions
from trms_cli.gap.force.laws import ForceRecord
from trms_cli.gap.model_form import departures
from trms_cli.gap.moved_parameters import WORTH_TELLING, moved_parameters
from trms_cli.gap.next_experiment import advise
from trms_cli.gap.posterior import Posterior, proposed_stand_in
from trms_cli.gap.problem import (
    CandidateEffect,
    GapProblem,
    Parts,
    diagnosed_recordings,
    mean_tilt,
    poor_excitation,
)
from trms_cli.gap.race import Race
from trms_cli.gap.rejection import inclusion, rejected_effects
from trms_cli.gap.residuals import Location, smoothed_forces
from trms_cli.gap.sentence import LEAST_ALIKE, sentence
from trms_cli.gap.shrinkage import SealedComparison
from trms_cli.gap.signatures import VISIBLE, Signatures
from trms_cli.gap.wording import place_name
from trms_cli.identification.free_runs import simulated_windows
from trms_cli.models.rig_parts import diagram_rows, parts_of

#: Causes less probable than this are not listed.
_LEAST_PROBABILITY = 0.002
#: Probability from which two causes are to be told apart by the next experiment.
_RIVAL = 0.05
#: Probability from which an answer is not asked after again.
_SURE = 0.95
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
    sealed: SealedComparison
    beside: Signatures  #: Traces about the corrected model, or the refit where nothing is added


def result_of(stages: StageResults) -> DiagnosisResult:
    """The diagnosis, without the times that it took."""
    problem, posterior, refit = stages.problem, stages.posterior, stages.race.refit
    shrinkage = stages.sealed.shrinkage
    where: tuple[LocationShare, ...] = ()
    region: list[RegionShare] = []
    words: tuple[str, ...] = ()
    flexible = posterior.flexible
    if posterior.verdict not in ("no_gap", "parameters_only"):
        where = _where(stages)
        main = [w.location for w in where[:2] if w.location in stages.forces]
        force_shares = {k: v for k, v in stages.place.share().items() if k in stages.forces}
        for location in main or sorted(force_shares, key=lambda k: -force_shares[k])[:1]:
            region += regions(stages.forces[location])
            foretold = flexible.foretold if flexible and flexible.location == location else None
            words = words or description(stages.forces[location], foretold)
    residual, law = _residual(stages)
    words = (*law, *words)
    unseen = _not_testable(stages)
    parameters, causes, moved = _parameters(stages), _causes(stages), _moved_parameters(stages)
    # a model that will do as it is needs no other laws
    form = {} if posterior.verdict == "no_gap" else departures(posterior.corrected or refit)
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
        excitation=poor_excitation(problem.model, problem.datasets),
        moved=moved,
        rejected=rejected_effects(stages.race, posterior, stages.candidates, stages.beside, unseen),
        sentence=sentence(posterior, causes, where, shrinkage, moved, law, other_form=bool(form)),
        tests=stages.tests,
        race=_race(stages),
        description=words,
        warnings=(*problem.warnings, *_remarks(stages)),
        worse=shrinkage.worse,
        effort=problem.effort,
        refit=refit.values_at_mean_gains,
        residual=residual,
        model_form=form,
        evidence={**json_data(posterior.features), "shares": shares},
        traces=_report_traces(stages, [w.location for w in where]),
    )


def _residual(stages: StageResults) -> tuple[dict[str, dict[str, Any]], tuple[str, ...]]:
    """What the corrected model has in place of a named cause, and the short law that is closest."""
    flexible, race = stages.posterior.stand_in, stages.race
    if flexible is None:
        return {}, ()
    nodes = {name: node_of(effect) for name, effect in flexible.effects.items()}
    return nodes, short_law(race.refit, flexible, stages.forces)


def _where(stages: StageResults) -> tuple[LocationShare, ...]:
    """Each place's share of the gap: by the causes where they are named, else by disturbances."""
    place, posterior, candidates = stages.place, stages.posterior, stages.candidates
    random = np.random.default_rng(np.random.SeedSequence([stages.problem.seed, 1]))
    m = place.together.size
    # where what has no name acts, if the corrected model has it
    residual = () if posterior.stand_in is None else posterior.stand_in.places
    contributions = {n: _contributions(n, stages.race) for n in posterior.probabilities}
    whole = _shares(posterior.probabilities, place.share(), candidates, residual, contributions)
    resampled_shares = [
        _shares(p, place.share(random.integers(0, m, m)), candidates, residual, contributions)
        for p in posterior.resampled
    ]
    rows = []
    for location, share in sorted(whole.items(), key=lambda item: -item[1]):
        if share < _LEAST_SHARE:
            continue
        values = [d.get(location, 0.0) for d in resampled_shares]
        low, high = np.quantile(values, [0.025, 0.975]) if values else (share, share)
        rows.append(
            LocationShare(
                location=location,
                share=share,
                ci95=(float(min(low, share)), float(max(high, share))),
            )
        )
    return tuple(rows)


def _shares(
    probabilities: Mapping[tuple[str, ...], float],
    by_disturbance: Mapping[str, float],
    candidates: Mapping[str, CandidateEffect],
    residual: Sequence[str],
    contributions: Mapping[tuple[str, ...], Sequence[float]],
) -> dict[str, float]:
    """``residual``: where what has no name acts; empty where that is not known.

    ``contributions``: of the effects of each cause, as of :func:`_contributions`.
    """
    unnamed = {k: v for k, v in by_disturbance.items() if not residual or k in residual}
    total = sum(unnamed.values())
    shares: dict[str, float] = {}
    for effects, probability in probabilities.items():
        if effects[0] in NO_EFFECT:
            if effects[0] == "none_of_these" and total > 0:
                for location, share in unnamed.items():
                    shares[location] = shares.get(location, 0.0) + probability * share / total
            continue
        own = contributions.get(effects) or [len(effects)] * len(effects)
        for name, part_of in zip(effects, own, strict=True):
            places = candidates[name].locations
            weights = np.array([by_disturbance.get(p, 0.0) + 1e-3 for p in places])
            for location, weight in zip(places, weights / weights.sum(), strict=True):
                part = probability * weight / part_of
                shares[location] = shares.get(location, 0.0) + float(part)
    return shares


def _contributions(effects: tuple[str, ...], race: Race) -> list[float]:
    """What some effects explain together over what each does: their number on small benches.

    On other rigs by what is lost without it, where the others have raced alone.
    """
    scores = {entry.names: entry.fit.score for entry in race.entries}
    less = [scores.get(tuple(n for n in effects if n != name), np.nan) for name in effects]
    lost = np.maximum(scores.get(effects, np.nan) - np.array(less), 0.0)
    if race.refit.model.bench_sizes or not lost.sum() > 0:
        return [len(effects)] * len(effects)
    return [float(lost.sum() / max(v, 1e-9)) for v in lost]


def _causes(stages: StageResults) -> tuple[Cause, ...]:
    race, posterior = stages.race, stages.posterior
    marks = stages.problem.marks.items()  # of the effects that readings alone show
    causes = [
        Cause(
            effects=effects,
            probability=probability,
            parameters=(fitted.sizes if (fitted := posterior.fitted(race, effects)) else {})
            | {f"{name}.{size}": value for name, (size, value) in marks if name in effects},
            onset=onset_of(fitted) if fitted and probability >= _LEAST_PROBABILITY else None,
        )
        for effects, probability in posterior.probabilities.items()
        if probability >= _LEAST_PROBABILITY or effects[0] in NO_EFFECT
    ]
    total = sum(cause.probability for cause in causes)
    return tuple(replace(cause, probability=cause.probability / total) for cause in causes)


def _parameters(stages: StageResults) -> dict[str, FittedParameter]:
    entry = stages.posterior.corrected or stages.race.refit
    theta, sd, moves = entry.at_mean_gains, entry.fit.sd, entry.moves
    own = set(stages.race.refit.structure.problem.names)
    return {
        free.name: FittedParameter(
            prior=float(stages.problem.model.parameters[free.name].value),
            fitted=float(theta[i]),
            sd=float(sd[i]),
            unit=free.unit,
            moved=moves.get(free.name),
        )
        for i, free in enumerate(entry.structure.problem.free)
        if free.name in own
    }


def _moved_parameters(stages: StageResults) -> tuple[MovedParameter, ...]:
    """Which parameters moved, where they may be what differs."""
    problem, posterior = stages.problem, stages.posterior
    likely = posterior.probabilities.get(("parameters_only",), 0.0)
    if posterior.verdict != "parameters_only" and likely < WORTH_TELLING:
        return ()
    about = mean_tilt(problem.model, problem.datasets)
    return moved_parameters(stages.race.refit, problem.model, about, problem.seed)


def _race(stages: StageResults) -> tuple[RaceEntry, ...]:
    """Everyone, and those without an effect to compare with."""
    race, features = stages.race, stages.posterior.features
    refit = race.refit
    own, nominal = refit.fit.predictive, set(refit.structure.problem.names)
    finite = features.scores[np.isfinite(features.scores)]
    most = max(features.behind, float(np.max(finite, initial=0.0)), 1e-9)

    def row(
        effects: tuple[str, ...], predictive: FloatArray, moved: float, **more: Any
    ) -> RaceEntry:
        apart = predictive - own
        explained = float(np.clip(apart.sum() / most, 0.0, 1.0))
        gain = {"score": float(apart.sum()), "se": standard_error(apart), "explained": explained}
        return RaceEntry(effects=effects, moved=moved, **{**gain, **more})

    def move(entry: FittedModel) -> float:
        return max((abs(m) for n, m in entry.moves.items() if n in nominal), default=0.0)

    rows = [RaceEntry(effects=(), score=0.0, se=0.0, explained=0.0, moved=move(refit))]
    if refit.raw.evidence is not None:
        rows.append(row(("no_gap",), refit.raw.predictive, 0.0, explained=0.0))
    if (flexible := stages.posterior.flexible) is not None:
        fitted = flexible.fitted
        rows.append(row(("flexible",), fitted.fit.predictive, move(fitted)))
    for entry in race.entries:
        if entry.fit.evidence is not None and np.isfinite(entry.fit.predictive).all():
            rows.append(row(entry.names, entry.fit.predictive, move(entry), parameters=entry.sizes))
    return tuple(sorted(rows, key=lambda row: -row.score))


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
    simulated_names = set(race.signatures.names)
    inclusion_probabilities = inclusion(stages.posterior.probabilities)
    for name, candidate in stages.candidates.items():
        # what the race was decided by was tested, whatever was foreseen of it
        if not candidate.simulated or inclusion_probabilities.get(name, 0.0) >= LEAST_ALIKE:
            continue
        if name not in simulated_names:
            rows.append(NotTestable(effect=name, reason="no simulation with it stays finite"))
        elif race.signatures.least_size(name) is None:
            rows.append(NotTestable(effect=name, reason=why_not_testable(race, candidate)))
    return tuple(rows)


def _remarks(stages: StageResults) -> tuple[str, ...]:
    parts = stages.parts
    remarks = list(dict.fromkeys(r for d in (*parts.whole, *parts.fitted) for r in d.remarks))
    far = {name: abs(m) for name, m in stages.race.refit.moves.items() if abs(m) > 3.0}
    proxies = []
    if far:
        moves = listing([f"{name} by {move:.1f}" for name, move in far.items()])
        proxies.append(
            f"the refit had to move {moves} standard deviations of what was known: rather "
            "proxies of what is missing than an explanation"
        )
    return (*remarks, *proxies, *_withdrawn(stages.posterior, stages.sealed.shrinkage.told_at))


def _withdrawn(posterior: Posterior, horizon: str) -> tuple[str, ...]:
    """Why the corrected model has nothing in the place of a law that has no name."""
    flexible = proposed_stand_in(posterior.verdict, posterior.flexible)
    if flexible is None or posterior.stand_in is not None:
        return ()
    return (
        f"a force that depends on the motion foretells {100 * flexible.foretold:.0f} % of what is "
        f"missing in the {place_name(flexible.location)}, but a model with it errs more over "
        f"{float(horizon):g} s on the data kept aside than one without it: it is left out",
    )


def _advice(stages: StageResults, unseen: tuple[NotTestable, ...]) -> NextExperiment | None:
    """What to record next: what parts those that are not told apart, else what shows the unseen."""
    race, posterior, candidates = stages.race, stages.posterior, stages.candidates
    best = posterior.best
    apart: list[str] = []
    values: Mapping[str, float] = {}
    shares = None
    if best is not None:
        values = ChainMap(*(entry.values for entry in race.entries))
    if best is not None and posterior.confusable:
        apart = list(dict.fromkeys(n for group in posterior.confusable for n in group))
        shares = best.metric.shares
    elif best is not None:
        # the traces differ, and yet no answer is sure: the likeliest are to be told apart
        rivals = [n for n, p in posterior.probabilities.items() if p >= _RIVAL and len(n) == 1]
        apart = [name for (name,) in rivals if name in candidates]
        if len(apart) < 2 and max(posterior.probabilities.values()) < _SURE:
            apart = _kin(best.names[0], candidates)
        apart = apart if len(apart) > 1 else []
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


def _kin(name: str, candidates: Mapping[str, CandidateEffect]) -> list[str]:
    """An effect, then those of which one is a special case of the other."""
    own = candidates.get(name)
    if own is None:
        return []
    simpler = own.special_case(candidates)
    others = candidates.values()
    kin = [c.name for c in others if c is simpler or c.special_case(candidates) is own]
    return [name, *kin]


def why_not_testable(race: Race, candidate: CandidateEffect) -> str:
    """Why recordings say nothing on an effect."""
    raw, projection = race.signatures.most_visible(candidate.name)
    if raw < VISIBLE:
        return (
            "what it does was not excited: at several times its typical size it would change the "
            f"outputs by {raw:.1f} standard deviations of the noise"
        )
    return (
        f"at several times its typical size it would change the outputs by {raw:.0f} standard "
        f"deviations of the noise, but by {projection:.1f} only that the nominal parameters cannot "
        "do as well within their priors"
    )


#: Points of a picture's line at most.
_POINTS = 1500
#: s. Length of the free run that is shown.
_RUN_LENGTH = 10.0


def _report_traces(stages: StageResults, locations: Sequence[str]) -> Traces:
    """Missing forces with what explains them, and free runs before and after."""
    forces, corrected, model = stages.forces, stages.posterior.corrected, stages.problem.model
    force_locations = [name for name in locations if name in forces] or list(forces)[:1]
    explained: dict[str, FloatArray] = {}
    if corrected is not None:
        remaining_forces = smoothed_forces(stages.race.refit, corrected)
        explained = {
            name: forces[name].force - remaining_forces[name].force for name in force_locations
        }
    first = forces[force_locations[0]] if force_locations else None
    rows = slice(None, None, 1 if first is None else max(1, len(first.time) // _POINTS))
    force: dict[str, FloatArray] = {}
    for name in force_locations:
        force[name] = forces[name].force[rows]
        force[f"{name}.sd"] = forces[name].sd[rows]
    time, runs = _runs(stages.parts, stages.sealed)
    return Traces(
        force_time=np.zeros(0) if first is None else first.time[rows],
        force=force,
        force_unit={name: forces[name].unit for name in force_locations},
        explained={name: value[rows] for name, value in explained.items()},
        run_time=time,
        runs=runs,
        run_unit={s.name: s.unit for s in model.outputs},
        rows=diagram_rows(parts_of(model)),
    )


def _runs(
    parts: Parts, sealed: SealedComparison
) -> tuple[FloatArray, dict[str, dict[str, FloatArray]]]:
    """The free run over the sealed part in which most was gained."""
    number, first, last = parts.sealed[0]
    dataset = parts.whole[number]
    step = dataset.sample_time
    before = free_runs.history(step)
    samples = min(round(_RUN_LENGTH / step), last - first - before - 1)
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
        gains = np.nansum((worse - better) / np.maximum(dataset.noise_sd**2, 1e-18), axis=1)
    best = int(np.argmax(gains)) if len(simulated) > 2 else int(np.argmax(worse.sum(axis=1)))
    time = dataset.time[begins[best] : begins[best] + samples]
    runs = {
        signal.name: {
            "measured": measured[best, :, i],
            **{name: y[best, :, i] for name, y in simulated.items()},
        }
        for i, signal in enumerate(dataset.outputs)
    }
    return np.asarray(time), runs
