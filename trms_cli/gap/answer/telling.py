"""The fields of a diagnosis from what was found."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from trms_cli.core.errors import TrmsError
from trms_cli.gap.advice import advise
from trms_cli.gap.answer.belief import Believed
from trms_cli.gap.answer.far import Far
from trms_cli.gap.answer.series import series
from trms_cli.gap.answer.wording import sentence, why_not_testable
from trms_cli.gap.blocks import Parts
from trms_cli.gap.candidates import Suspect
from trms_cli.gap.diagnosis import (
    NO_EFFECT,
    Cause,
    Detectable,
    FittedParameter,
    LocationShare,
    NextExperiment,
    NotTestable,
    RaceEntry,
    Recorded,
    RegionShare,
    SizeEstimate,
)
from trms_cli.gap.force.description import description
from trms_cli.gap.force.record import ForceRecord
from trms_cli.gap.force.regions import regions
from trms_cli.gap.location import Location
from trms_cli.gap.problem import GapProblem
from trms_cli.gap.race.contest import Contest, Entry
from trms_cli.models.model import names

FloatArray = npt.NDArray[np.float64]

#: Causes less probable than this are not listed.
_LEAST_PROBABILITY = 0.002
#: Places with less of the gap than this are not listed.
_LEAST_SHARE = 0.02


def told(
    problem: GapProblem,
    parts: Parts,
    raced: Contest,
    believed: Believed,
    far: Far,
    place: Location,
    forces: Mapping[str, ForceRecord],
    found: Mapping[str, Suspect],
    left_out: Mapping[str, str],
) -> dict[str, Any]:
    """Fields by name."""
    nothing = believed.verdict in ("no_gap", "parameters_only")
    where = () if nothing else _where(believed, place, found, raced)
    main = [w.location for w in where[:2] if w.location in forces] or _strongest(place, forces)
    region: list[RegionShare] = []
    words: list[str] = []
    if not nothing:
        for location in main:
            region += regions(forces[location])
        words = [w for location in main[:1] for w in description(forces[location])]
    unseen = _not_testable(raced, found, left_out)
    refit = raced.refit
    parameters = _parameters(problem, raced, believed)
    causes = _causes(believed, raced)
    experiment = _advice(problem, raced, believed, found, unseen)
    return {
        "recordings": tuple(
            Recorded(
                file=d.source,
                sha256=d.sha256,
                duration_s=d.duration,
                sample_time_s=d.sample_time,
                channels=(*names(d.inputs), *names(d.outputs)),
            )
            for d in problem.datasets
        ),
        "model": problem.model_name,
        "seed": problem.seed,
        "versions": {},
        "verdict": believed.verdict,
        "where": where,
        "region": tuple(region),
        "causes": causes,
        "confusable": believed.confusable,
        "not_testable": unseen,
        "detectable": _detectable(raced, found),
        "parameters": parameters,
        "gap": far.measured.gap,
        "shrink": far.measured.shrink,
        "next_experiment": experiment,
        "sentence": sentence(believed, causes, where, far.measured, parameters),
        "race": _race(believed, raced),
        "description": tuple(words),
        "warnings": (*problem.warnings, *_remarks(parts, raced)),
        "worse": far.measured.worse,
        "refit": refit.contestant.values(refit.fit.theta),
        "evidence": {
            **believed.features.as_json(),
            "shares": {
                channel.location: share
                for channel, share in zip(
                    refit.metric.discrepancy.channels, refit.metric.shares.tolist(), strict=True
                )
                if channel.fixed is None
            },
            "outside": believed.outside,
        },
        "traces": series(problem, parts, raced, believed, far, forces, [w.location for w in where]),
    }


def _where(
    believed: Believed, place: Location, found: Mapping[str, Suspect], raced: Contest
) -> tuple[LocationShare, ...]:
    """Each place's share of the gap: by the causes where they are named, else by disturbances."""
    random = np.random.default_rng(np.random.SeedSequence([raced.refit.contestant.problem.seed, 1]))
    m = place.together.size
    whole = _shares(believed.probabilities, place.share(), found)
    drawn = [
        _shares(p, place.share(random.integers(0, m, m)), found) for p in believed.resampled[:100]
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
    found: Mapping[str, Suspect],
) -> dict[str, float]:
    total = sum(by_disturbance.values())
    shares: dict[str, float] = {}
    for effects, probability in probabilities.items():
        if effects[0] in NO_EFFECT:
            if effects[0] == "none_of_these" and total > 0:
                for location, share in by_disturbance.items():
                    shares[location] = shares.get(location, 0.0) + probability * share / total
            continue
        for name in effects:
            places = found[name].locations
            weights = np.array([by_disturbance.get(p, 0.0) + 1e-3 for p in places])
            for location, weight in zip(places, weights / weights.sum(), strict=True):
                part = probability * weight / len(effects)
                shares[location] = shares.get(location, 0.0) + float(part)
    return shares


def _strongest(place: Location, forces: Mapping[str, ForceRecord]) -> list[str]:
    shares = {k: v for k, v in place.share().items() if k in forces}
    return sorted(shares, key=lambda k: -shares[k])[:1]


def _causes(believed: Believed, raced: Contest) -> tuple[Cause, ...]:
    entries = {e.names: e for e in raced.entries}
    causes = [
        Cause(
            effects=effects,
            probability=probability,
            parameters=_sizes(entries[effects]) if effects in entries else {},
        )
        for effects, probability in believed.probabilities.items()
        if probability >= _LEAST_PROBABILITY or effects[0] in NO_EFFECT
    ]
    total = sum(cause.probability for cause in causes)
    return tuple(
        Cause(effects=c.effects, probability=c.probability / total, parameters=c.parameters)
        for c in causes
    )


def _sizes(entry: Entry) -> dict[str, SizeEstimate]:
    worth = entry.fit.evidence
    assert worth is not None
    sd = np.sqrt(np.maximum(np.diag(worth.covariance), 0.0))
    return {
        free.name: SizeEstimate(value=float(entry.fit.theta[i]), sd=float(sd[i]), unit=free.unit)
        for i, free in enumerate(entry.contestant.problem.free)
        if "." in free.name and any(free.name.startswith(f"{n}.") for n in entry.names)
    }


def _parameters(
    problem: GapProblem, raced: Contest, believed: Believed
) -> dict[str, FittedParameter]:
    entry = believed.corrected
    contestant = raced.refit.contestant if entry is None else entry.contestant
    fit = raced.refit.fit if entry is None else entry.fit
    worth = fit.evidence
    assert worth is not None
    sd = np.sqrt(np.maximum(np.diag(worth.covariance), 0.0))
    own = set(raced.refit.contestant.problem.names)
    return {
        free.name: FittedParameter(
            prior=float(problem.model.parameters[free.name].value),
            fitted=float(fit.theta[i]),
            sd=float(sd[i]),
            unit=free.unit,
            moved=None
            if not free.prior_sd
            else float((fit.theta[i] - free.prior_mean) / free.prior_sd),
        )
        for i, free in enumerate(contestant.problem.free)
        if free.name in own
    }


def _race(believed: Believed, raced: Contest) -> tuple[RaceEntry, ...]:
    """Everyone, and those without an effect to compare with."""
    refit = raced.refit
    own = refit.fit.evidence
    raw = refit.raw.evidence
    assert own is not None
    finite = believed.features.scores[np.isfinite(believed.features.scores)]
    most = max(believed.features.behind, float(np.max(finite, initial=0.0)), 1e-9)
    rows = [RaceEntry(effects=(), score=0.0, se=0.0, explained=0.0, moved=_moved(refit, refit.fit))]
    if raw is not None:
        apart = raw.predictive - own.predictive
        rows.append(
            RaceEntry(
                effects=("no_gap",),
                score=float(apart.sum()),
                se=_se(apart),
                explained=0.0,
                moved=0.0,
            )
        )
    for entry in raced.entries:
        worth = entry.fit.evidence
        if worth is None or not np.isfinite(worth.predictive).all():
            continue
        apart = worth.predictive - own.predictive
        rows.append(
            RaceEntry(
                effects=entry.names,
                score=float(apart.sum()),
                se=_se(apart),
                explained=float(np.clip(apart.sum() / most, 0.0, 1.0)),
                moved=_moved(refit, entry.fit, entry),
                parameters=_sizes(entry),
            )
        )
    return tuple(sorted(rows, key=lambda row: -row.score))


def _se(apart: FloatArray) -> float:
    return float(np.std(apart, ddof=1) * np.sqrt(len(apart))) if len(apart) > 1 else 0.0


def _moved(refit: Any, fit: Any, entry: Entry | None = None) -> float:
    contestant = refit.contestant if entry is None else entry.contestant
    own = set(refit.contestant.problem.names)
    moves = [
        abs(fit.theta[i] - free.prior_mean) / free.prior_sd
        for i, free in enumerate(contestant.problem.free)
        if free.name in own and free.prior_sd
    ]
    return float(max(moves, default=0.0))


def _detectable(raced: Contest, found: Mapping[str, Suspect]) -> dict[str, Detectable]:
    sizes = {}
    for name in dict.fromkeys(raced.signatures.names):
        least = raced.signatures.least_size(name)
        if least is not None:
            sizes[name] = Detectable(minimum_size=least, unit=found[name].free[0].unit)
    return sizes


def _not_testable(
    raced: Contest, found: Mapping[str, Suspect], left_out: Mapping[str, str]
) -> tuple[NotTestable, ...]:
    rows = [NotTestable(effect=name, reason=reason) for name, reason in left_out.items()]
    known = set(raced.signatures.names)
    for name, suspect in found.items():
        if not suspect.simulated:
            continue
        if name not in known:
            rows.append(NotTestable(effect=name, reason="no simulation with it stays finite"))
        elif raced.signatures.least_size(name) is None:
            rows.append(NotTestable(effect=name, reason=why_not_testable(raced, suspect)))
    return tuple(rows)


def _remarks(parts: Parts, raced: Contest) -> tuple[str, ...]:
    remarks = list(dict.fromkeys(r for d in (*parts.whole, *parts.fitted) for r in d.remarks))
    refit = raced.refit
    far = [
        f"{free.name} had to move {move:.1f} standard deviations of its prior in the refit: "
        "rather a proxy of what is missing than an explanation"
        for free, move in (
            (f, abs(refit.fit.theta[i] - f.prior_mean) / f.prior_sd)
            for i, f in enumerate(refit.contestant.problem.free)
            if f.prior_sd
        )
        if move > 3.0
    ]
    return (*remarks, *far)


def _advice(
    problem: GapProblem,
    raced: Contest,
    believed: Believed,
    found: Mapping[str, Suspect],
    unseen: tuple[NotTestable, ...],
) -> NextExperiment | None:
    """What to record next: what parts those that are not told apart, else what shows the unseen."""
    best = believed.best
    apart: list[str] = []
    values: dict[str, float] = {}
    shares = None
    if best is not None and believed.confusable and best.names[0] not in NO_EFFECT:
        apart = list(dict.fromkeys(n for group in believed.confusable for n in group))
        for entry in raced.entries:
            values = {**entry.contestant.values(entry.fit.theta), **values}
        shares = best.metric.shares
    try:
        return advise(
            refit=raced.refit,
            suspects=found,
            model_name=problem.model_name,
            apart=apart,
            untested=[row.effect for row in unseen if row.effect in found],
            values=values,
            shares=shares,
        )
    except (TrmsError, FloatingPointError, np.linalg.LinAlgError):
        return None  # an experiment that cannot be imagined is no reason to lose a diagnosis
