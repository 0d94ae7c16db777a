"""What is believed once all have raced: probabilities, the verdict, what is not told apart.

The probabilities are those of ``belief.py``. What no simulation shows has marks of its own: a
torque from outside is a discrepancy of one equation that nothing foretells, a sensor that rounds
coarsely has coarse steps.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from trms_cli.core.arrays import FloatArray, IntArray
from trms_cli.effects.places import sensor_place
from trms_cli.gap.beginning import begins_at
from trms_cli.gap.belief import (
    DISTURBANCE,
    Calibration,
    Features,
    probabilities_of,
    simulated_part,
    standard_error,
)
from trms_cli.gap.competing_model import FittedModel, Refit
from trms_cli.gap.diagnosis import NO_EFFECT, Verdict
from trms_cli.gap.discrepancy import input_channels, log_likelihood
from trms_cli.gap.flexible import Flexible
from trms_cli.gap.force.exogenous import exogenous
from trms_cli.gap.force.laws import ForceRecord
from trms_cli.gap.free_runs import Errors
from trms_cli.gap.problem import CandidateEffect, GapProblem
from trms_cli.gap.race import Race
from trms_cli.gap.residuals import Location
from trms_cli.gap.sensor_marks import with_marked_sensors
from trms_cli.gap.shrinkage import SealedRuns, farthest_errors, harm
from trms_cli.models.model import names

#: Probability from which a verdict is given.
_DECIDED = 0.5
#: A cause less probable is not worth telling what it may be confused with.
_MENTIONED = 0.05
#: Competitors within so many nats, or standard errors of the paired difference, of the best are
#: not told apart from it.
_NATS, _ERRORS = 3.0, 1.0
#: Traces alike to this cosine cannot be told apart by a recording of this kind.
_ALIKE = 0.99
#: A force of which the flexible competitor foretells this share is the rig's own doing.
_OWN_DOING = 0.5
#: p-value from which a regression on a missing force is believed.
_CERTAIN = 0.05
_RESAMPLES = 200
#: Competitors of a bench whose free runs on the sealed part are asked for, as its weights have it.
_RUN = 5


@dataclass(frozen=True)
class Posterior:
    """What is believed once all have raced."""

    probabilities: Mapping[tuple[str, ...], float]  #: Descending; effects, or of :data:`NO_EFFECT`
    verdict: Verdict
    best: FittedModel | None  #: The most probable with effects
    corrected: FittedModel | None  #: What goes into the corrected model; None: the refit alone
    confusable: tuple[tuple[str, ...], ...]
    features: Features
    #: The probabilities with blocks drawn anew: how much they hang on single blocks
    resampled: tuple[Mapping[tuple[str, ...], float], ...]
    flexible: Flexible | None = None  #: The competitor without a name; None: it was not fitted

    @property
    def stand_in(self) -> Flexible | None:
        """What the corrected model has in the place of a law; None: nothing."""
        is_in_model = self.flexible is not None and self.corrected is self.flexible.fitted
        return self.flexible if is_in_model else None

    def fitted(self, race: Race, effects: tuple[str, ...]) -> FittedModel | None:
        """What was fitted of a cause: a torque from outside and a coarse sensor are not."""
        return {e.names: e for e in race.entries}.get(simulated_part(effects))


def features_of(
    race: Race,
    behinds: Sequence[FloatArray],
    constants: Calibration,
    runs: SealedRuns,
    flexible: Flexible | None,
) -> Features:
    """Features of all that raced; ``behinds`` as of :func:`excesses`.

    Free runs are those of all competitors, on benches of the first :data:`_RUN`.
    """
    refit, plain = race.refit, race.refit.structure.windows.rollout
    own = float(refit.fit.predictive.sum())
    floor = runs.floor(refit.model, plain)
    discrepancy = refit.metric.discrepancy
    usual = np.array([constants.usual(c.location) for c in discrepancy.channels])
    outputs = names(refit.structure.problem.model.outputs)
    metric = refit.metric
    reach = np.hypot(
        discrepancy.stray(np.minimum(metric.shares, usual)), metric.drift.stray(metric.drift_sizes)
    )
    stray = dict(zip(outputs, reach.tolist(), strict=True))

    def error(errors: Errors) -> float:
        return float(np.fmax.reduce(farthest_errors(errors, floor, stray), initial=np.nan))

    of_none = np.nan if flexible is None else flexible.score - own - _strain(refit, flexible.fitted)
    before = runs.errors(refit.model, plain)
    refit_error = error(before)
    errors = np.full(len(race.entries), refit_error)
    harms = np.full(len(race.entries), np.nan)
    blocks = np.array([e.fit.predictive - refit.fit.predictive for e in race.entries])
    strains = np.array([_strain(refit, e) for e in race.entries])
    for i, entry in enumerate(race.entries[: _RUN if refit.model.bench_sizes else None]):
        rollout = entry.structure.windows.rollout
        after = runs.errors(entry.model, rollout)
        errors[i] = error(after)
        harms[i] = harm(before, after, floor, stray)
    return Features(
        gained=own - float(refit.raw.predictive.sum()),
        behind=float(behinds[0].sum()),
        names=tuple(e.names for e in race.entries),
        scores=np.array([e.fit.score for e in race.entries]) - own - strains,
        behinds=np.array([b.sum() for b in behinds[1:]]),
        sizes=np.array([sum(len(s.free) for s in e.structure.effects) for e in race.entries]),
        surprises=np.array(
            [sum(s.surprise(e.values) for s in e.structure.effects) for e in race.entries]
        ),
        errors=errors,
        harms=harms,
        begins=np.array([_unlikely_beginnings(e) for e in race.entries]),
        raw_error=error(runs.errors(refit.structure.problem.model, plain)),
        refit_error=refit_error,
        outside=outside_behinds(race, constants),
        flexible=of_none,
        foretold=np.nan if flexible is None else flexible.foretold,
        samples=float(refit.structure.windows.measured.sum()),
        deviations=np.array([standard_error(b) for b in blocks]),
        by_block=blocks,
        bench=refit.model.bench_sizes,
    )


def _unlikely_beginnings(fitted: FittedModel) -> float:
    """How often a fit's effects do what is seldom: begin, and begin although they are built in."""
    if begins_at(fitted) is None:
        return 0.0
    return 1.0 + sum(not candidate.effect.may_begin for candidate in fitted.structure.effects)


def _strain(refit: Refit, fitted: FittedModel) -> float:
    """Nats by which parameters lie farther off their priors than in the refit.

    No block foretells what is known before any; weights of small benches have it in them.
    """
    if refit.model.bench_sizes:
        return 0.0
    moves = [[of.moves[name] for name in refit.moves] for of in (fitted, refit)]
    return float(0.5 * np.subtract(*np.square(moves).sum(axis=1)))


def resampled_features(
    features: Features, race: Race, behinds: Sequence[FloatArray], blocks: IntArray
) -> Features:
    """Features with other blocks, (m,) array of their numbers with repetition."""
    own = race.refit.fit.predictive[blocks].sum()
    by_block = features.by_block[:, blocks] if len(features.by_block) else features.by_block
    return replace(
        features,
        gained=float(own - race.refit.raw.predictive[blocks].sum()),
        behind=float(behinds[0][blocks].sum()),
        scores=features.scores + (by_block.sum(axis=-1) - features.by_block.sum(axis=-1)),
        behinds=np.array([b[blocks].sum() for b in behinds[1:]]),
        by_block=by_block,
    )


def excesses(race: Race, constants: Calibration) -> list[FloatArray]:
    """What the refit and each competitor owe to discrepancies beyond the usual, nats by block."""
    return [_excess(race, fitted, constants) for fitted in (race.refit, *race.entries)]


def outside_behinds(race: Race, constants: Calibration) -> dict[str, FloatArray]:
    """What they still owe if a torque from outside acts on an axis, nats; by axis.

    (k + 1,) arrays: of the refit, then of each competitor; of those beyond :data:`_RUN` it is what
    they owe without one.
    """
    places = {c.location for c in race.refit.metric.discrepancy.channels}
    behinds = {}
    for name, axis in race.refit.model.axes.items():
        if axis.moment in places:
            behinds[name] = np.array(
                [
                    _excess(race, fitted, constants, axis.moment if i <= _RUN else "").sum()
                    for i, fitted in enumerate((race.refit, *race.entries))
                ]
            )
    return behinds


def _excess(
    race: Race, fitted: FittedModel, constants: Calibration, but_for: str = ""
) -> FloatArray:
    """By block, (m,) nats.

    The log likelihood of what a fit leaves, less what it would be if no equation (``but_for`` one)
    might err by more than those of rigs without a gap do, and no drive wander further.
    """
    discrepancy, m = race.refit.metric.discrepancy, len(race.refit.structure.windows)
    shares, metric = fitted.metric.shares, fitted.metric
    drifts = np.array([constants.usual(c.location) for c in input_channels(race.refit.model)])
    excess = np.full(m, metric.drift.excess(fitted.fit.gains, metric.drift_sizes, drifts) / m)
    usual = np.array(
        [
            np.inf if c.location == but_for else constants.usual(c.location)
            for c in discrepancy.channels
        ]
    )
    if np.any(shares > usual * 1.001):
        r = fitted.residuals
        excess += log_likelihood(discrepancy, r, shares)
        excess -= log_likelihood(discrepancy, r, np.minimum(shares, usual))
    return np.nan_to_num(excess, nan=1e6)


def posterior_of(
    problem: GapProblem,
    race: Race,
    candidates: Mapping[str, CandidateEffect],
    forces: Mapping[str, ForceRecord],
    place: Location,
    constants: Calibration,
    runs: SealedRuns,
    flexible: Flexible | None = None,
) -> Posterior:
    """Weigh all that raced.

    ``candidates``: all of them, those that noise drives among them. ``forces``: smoothed missing
    force of each equation. ``flexible``: the competitor without a name; None: it was not fitted. A
    torque from outside is an answer where it explains more than its axis' sensor would.
    """
    behinds = excesses(race, constants)
    features = features_of(race, behinds, constants, runs, flexible)
    shares, model = place.share(), problem.model
    moments = {name: axis.moment for name, axis in model.axes.items()}
    sensors = {name: sensor_place(model, axis.angle) for name, axis in model.axes.items()}
    axes = [
        axis
        for axis in features.outside
        if f"{axis}{DISTURBANCE}" in candidates
        and shares.get(moments[axis], 0.0) >= shares.get(sensors[axis], 0.0)
    ]
    sizes = dict(zip(place.locations, place.sizes.tolist(), strict=True))
    features = replace(
        features,
        outside={axis: features.outside[axis] for axis in axes},
        sensor={
            axis: shares.get(sensors[axis], 0.0) / max(shares[moments[axis]], 1e-9) for axis in axes
        },
        force={axis: sizes[moments[axis]] for axis in axes},
        memory={
            axis: record.correlation_time(record.force)
            for axis in axes
            for record in (forces[moments[axis]],)
        },
    )
    if axes and features.behind > 0:
        axis = max(axes, key=lambda axis: shares[moments[axis]])
        # the regression knows paths and the last moments, which the terms of the flexible do not
        dependence = exogenous(forces[moments[axis]], problem.seed)
        predictable_share = dependence.predictable_share if dependence.p_value < _CERTAIN else 0.0
        features = replace(features, foretold=float(np.fmax(features.foretold, predictable_share)))
    special = special_cases(race.entries, candidates)
    entries = {e.names: e for e in race.entries}

    def probabilities_given(own_features: Features) -> dict[tuple[str, ...], float]:
        by_cause = merged(probabilities_of(own_features, constants.weights), special)
        return with_marked_sensors(by_cause, tuple(problem.marks))

    probabilities = probabilities_given(features)
    random = np.random.default_rng(np.random.SeedSequence([problem.seed, 0xB10C]))
    m = len(race.refit.structure.windows)
    resampled = tuple(
        probabilities_given(resampled_features(features, race, behinds, random.integers(0, m, m)))
        for _ in range(_RESAMPLES)
    )
    parts = [simulated_part(n) for n in probabilities]
    best = next((entries[part] for part in parts if part in entries), None)
    confusable: tuple[tuple[str, ...], ...] = ()
    if best is not None:
        together = sum(p for n, p in probabilities.items() if simulated_part(n) == best.names)
        if together > _MENTIONED:
            confusable = _confusable(race, best)
    # searches that disagree about a size have not found what the recordings say of it
    is_resolved = not (parts[0] in entries and entries[parts[0]].unresolved)
    verdict = _verdict(probabilities, confusable, is_resolved)
    corrected = None
    if verdict in ("effect", "undecided"):
        corrected = entries.get(parts[0])
    elif (proposal := proposed_stand_in(verdict, flexible)) is not None:
        corrected = proposal.fitted
    return Posterior(
        probabilities, verdict, best, corrected, confusable, features, resampled, flexible
    )


def _verdict(
    probabilities: Mapping[tuple[str, ...], float],
    confusable: tuple[tuple[str, ...], ...],
    is_resolved: bool,
) -> Verdict:
    top = next(iter(probabilities))
    if top[0] in NO_EFFECT:
        return top[0] if probabilities[top] >= _DECIDED else "undecided"  # type: ignore[return-value]
    # Which of a group that no data of this kind part is left open, that it is one of them not.
    alike = {name for group in confusable if set(group) & set(top) for name in group} | set(top)
    together = sum(p for names, p in probabilities.items() if set(names) <= alike)
    wider = sum(p for names, p in probabilities.items() if set(names) & set(top))
    return "effect" if is_resolved and max(together, wider) >= _DECIDED else "undecided"


def _confusable(race: Race, best: FittedModel) -> tuple[tuple[str, ...], ...]:
    """Groups with the best that the scores, or the traces themselves, do not part."""
    own = best.fit.predictive
    group: list[str] = []
    for entry in race.entries:
        if entry.names == best.names or len(entry.names) != len(best.names):
            continue
        apart = own - entry.fit.predictive
        if apart.sum() < max(_NATS, _ERRORS * standard_error(apart)) and np.isfinite(apart).all():
            group += [n for n in entry.names if n not in best.names]
    pairs = []
    signs = race.tight
    effects = sorted(set(signs.names))
    for name in best.names:
        alike = [n for n in effects if n != name and signs.alike(name, n) > _ALIKE]
        members = [name, *dict.fromkeys((*(group if len(best.names) == 1 else ()), *alike))]
        if len(members) > 1:
            pairs.append(tuple(members))
    if len(best.names) > 1 and group:
        pairs.append((*best.names, *dict.fromkeys(group)))
    return tuple(pairs)


def proposed_stand_in(verdict: Verdict, flexible: Flexible | None) -> Flexible | None:
    """A force that may take the place of a law without a name; None: nothing foretells the rig."""
    if verdict != "none_of_these" or flexible is None or flexible.foretold <= _OWN_DOING:
        return None
    return flexible


#: Of a cause, what it is with which probability, by names of effects.
SpecialCases = Mapping[tuple[str, ...], Mapping[tuple[str, ...], float]]


def special_cases(
    entries: Sequence[FittedModel], candidates: Mapping[str, CandidateEffect]
) -> SpecialCases:
    """Causes that others are, how probably, at the sizes that were fitted.

    Stribeck friction with hardly an excess at rest is Coulomb friction, which then has to be among
    what was fitted.
    """
    fitted_names = {entry.names for entry in entries}
    cases = {}
    for entry in entries:
        shares: dict[tuple[str, ...], float] = {(): 1.0}
        for candidate in entry.structure.effects:
            simpler = candidate.special_case(candidates)
            special = candidate.special_share(entry.values, entry.sds) if simpler else 0.0
            extended: dict[tuple[str, ...], float] = {}
            for before, share in shares.items():
                for one, own in ((candidate, 1 - special), (simpler, special)):
                    if one is not None and own > 0:
                        after = tuple(sorted({*before, one.name}))
                        extended[after] = extended.get(after, 0.0) + share * own
            shares = extended
        other = {n: p for n, p in shares.items() if n != entry.names and n in fitted_names}
        if other:
            cases[entry.names] = {**other, entry.names: 1 - sum(other.values())}
    return cases


def merged(
    probabilities: Mapping[tuple[str, ...], float], special: SpecialCases
) -> dict[tuple[str, ...], float]:
    """Each cause's probability given to those that it is a special case of, descending."""
    totals: dict[tuple[str, ...], float] = {}
    for names_, probability in probabilities.items():
        part = simulated_part(names_)
        beside = [n for n in names_ if n not in part]
        for instead, share in special.get(part, {part: 1.0}).items():
            own = tuple(sorted((*instead, *beside)))
            if share > 0:
                totals[own] = totals.get(own, 0.0) + share * probability
    return dict(sorted(totals.items(), key=lambda item: -item[1]))
