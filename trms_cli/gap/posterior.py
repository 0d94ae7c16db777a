"""What is believed once all have raced: probabilities, the verdict, what is not told apart.

The probabilities are those of ``belief.py``; what no simulation shows (a torque from outside, a
sensor that rounds coarsely) is divided from them by its own marks.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from trms_cli.core.arrays import FloatArray, IntArray
from trms_cli.gap.belief import Calibration, Features, probabilities_of
from trms_cli.gap.competing_model import FittedModel
from trms_cli.gap.diagnosis import NO_EFFECT, Verdict
from trms_cli.gap.discrepancy import input_channels, log_likelihood
from trms_cli.gap.force.exogenous import exogenous
from trms_cli.gap.force.laws import ForceRecord
from trms_cli.gap.free_runs import SealedRuns, farthest_error
from trms_cli.gap.problem import CandidateEffect, GapProblem, quantum_of
from trms_cli.gap.race import Race
from trms_cli.gap.residuals import Location
from trms_cli.models.model import Model, names
from trms_cli.simulation.rollout import Rollout

#: Probability from which a verdict is given.
_DECIDED = 0.5
#: A cause less probable is not worth telling what it may be confused with.
_MENTIONED = 0.05
#: Competitors within so many nats, or standard errors of the paired difference, of the best are
#: not told apart from it.
_NATS, _ERRORS = 3.0, 1.0
#: Traces alike to this cosine cannot be told apart by a recording of this kind.
_ALIKE = 0.99
#: A force that the rig's own doings predict to less than this share comes from outside.
_FROM_OUTSIDE = 0.15
#: How far such a judgement is trusted: laws that nobody knows can be hard to predict, too.
_OUTSIDE_SURE, _OUTSIDE_UNSURE = 0.6, 0.4
_RESAMPLES = 200
#: Competitors whose free runs on the sealed part are asked for.
_RUN = 5
#: rad. Step of the encoders that the models' rigs have.
_USUAL_QUANTUM = 2 * np.pi / 4096


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
    outside: str = ""  #: Axis on which a torque from outside acts; empty for none


def features_of(
    race: Race, behinds: Sequence[FloatArray], constants: Calibration, runs: SealedRuns
) -> Features:
    """Features of all that raced; ``behinds`` as of :func:`excesses`.

    Free runs are those of the first :data:`_RUN` competitors; the others lie behind these.
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

    def error(model: Model, rollout: Rollout) -> float:
        return farthest_error(runs.errors(model, rollout), floor, stray)

    refit_error = error(refit.model, plain)
    errors = np.full(len(race.entries), refit_error)
    for i, entry in enumerate(race.entries[:_RUN]):
        errors[i] = error(entry.model, entry.structure.windows.rollout)
    return Features(
        gained=own - float(refit.raw.predictive.sum()),
        behind=float(behinds[0].sum()),
        names=tuple(e.names for e in race.entries),
        scores=np.array([e.fit.score for e in race.entries]) - own,
        behinds=np.array([b.sum() for b in behinds[1:]]),
        sizes=np.array([sum(len(s.free) for s in e.structure.effects) for e in race.entries]),
        surprises=np.array(
            [sum(s.surprise(e.values) for s in e.structure.effects) for e in race.entries]
        ),
        errors=errors,
        raw_error=error(refit.structure.problem.model, plain),
        refit_error=refit_error,
    )


def resampled_features(
    features: Features, race: Race, behinds: Sequence[FloatArray], blocks: IntArray
) -> Features:
    """Features with other blocks, (m,) array of their numbers with repetition."""
    own = race.refit.fit.predictive[blocks].sum()
    return replace(
        features,
        gained=float(own - race.refit.raw.predictive[blocks].sum()),
        behind=float(behinds[0][blocks].sum()),
        scores=np.array([e.fit.predictive[blocks].sum() for e in race.entries]) - own,
        behinds=np.array([b[blocks].sum() for b in behinds[1:]]),
    )


def excesses(race: Race, constants: Calibration) -> list[FloatArray]:
    """What the refit and each competitor owe to discrepancies beyond the usual, nats by block.

    The log likelihood of what they leave, less what it would be if no equation might err by more
    than those of rigs without a gap do.
    """
    refit = race.refit
    discrepancy = refit.metric.discrepancy
    usual = np.array([constants.usual(c.location) for c in discrepancy.channels])
    found = []
    m = len(refit.structure.windows)
    drifts = np.array([constants.usual(c.location) for c in input_channels(refit.model)])
    for fitted in (refit, *race.entries):
        shares, metric = fitted.metric.shares, fitted.metric
        drift = metric.drift.excess(fitted.fit.gains, metric.drift_sizes, drifts)
        excess = np.full(m, drift / m)
        if np.any(shares > usual * 1.001):
            r = fitted.residuals
            excess += log_likelihood(discrepancy, r, shares)
            excess -= log_likelihood(discrepancy, r, np.minimum(shares, usual))
        found.append(np.nan_to_num(excess, nan=1e6))
    return found


def posterior_of(
    problem: GapProblem,
    race: Race,
    candidates: Mapping[str, CandidateEffect],
    forces: Mapping[str, ForceRecord],
    place: Location,
    constants: Calibration,
    runs: SealedRuns,
) -> Posterior:
    """Weigh all that raced.

    ``candidates``: all of them, those that noise drives among them. ``forces``: smoothed missing
    force of each equation.
    """
    behinds = excesses(race, constants)
    features = features_of(race, behinds, constants, runs)
    probabilities = probabilities_of(features, constants.weights)
    probabilities, outside = _from_outside(probabilities, candidates, forces, place, problem.seed)
    probabilities = _with_coarse_sensor(probabilities, problem, candidates)
    random = np.random.default_rng(np.random.SeedSequence([problem.seed, 0xB10C]))
    m = len(race.refit.structure.windows)
    resampled = tuple(
        probabilities_of(
            resampled_features(features, race, behinds, random.integers(0, m, m)),
            constants.weights,
        )
        for _ in range(_RESAMPLES)
    )
    entries = {e.names: e for e in race.entries}
    named = [n for n in probabilities if n in entries]
    best = entries[named[0]] if named else None
    confusable: tuple[tuple[str, ...], ...] = ()
    if best is not None and probabilities[best.names] > _MENTIONED:
        confusable = _confusable(race, best)
    verdict = _verdict(probabilities, confusable)
    likely = next(iter(probabilities))
    corrected = best if verdict in ("effect", "undecided") and likely in entries else None
    return Posterior(
        probabilities, verdict, best, corrected, confusable, features, resampled, outside
    )


def _verdict(
    probabilities: Mapping[tuple[str, ...], float], confusable: tuple[tuple[str, ...], ...]
) -> Verdict:
    top = next(iter(probabilities))
    if top[0] in NO_EFFECT:
        return top[0] if probabilities[top] >= _DECIDED else "undecided"  # type: ignore[return-value]
    # Which of a group that no data of this kind part is left open, that it is one of them not.
    alike = {name for group in confusable if set(group) & set(top) for name in group} | set(top)
    together = sum(p for names, p in probabilities.items() if set(names) <= alike)
    wider = sum(p for names, p in probabilities.items() if set(names) & set(top))
    return "effect" if max(together, wider) >= _DECIDED else "undecided"


def _confusable(race: Race, best: FittedModel) -> tuple[tuple[str, ...], ...]:
    """Groups with the best that the scores, or the traces themselves, do not part."""
    own = best.fit.predictive
    group: list[str] = []
    for entry in race.entries:
        if entry.names == best.names or len(entry.names) != len(best.names):
            continue
        apart = own - entry.fit.predictive
        error = float(np.std(apart, ddof=1) * np.sqrt(len(apart))) if len(apart) > 1 else 0.0
        if apart.sum() < max(_NATS, _ERRORS * error) and np.isfinite(apart).all():
            group += [n for n in entry.names if n not in best.names]
    pairs = []
    signs = race.tight
    known = sorted(set(signs.names))
    for name in best.names:
        alike = [
            n for n in known if n != name and n in signs.names and signs.alike(name, n) > _ALIKE
        ]
        members = [name, *dict.fromkeys((*(group if len(best.names) == 1 else ()), *alike))]
        if len(members) > 1:
            pairs.append(tuple(members))
    if len(best.names) > 1 and group:
        pairs.append((*best.names, *dict.fromkeys(group)))
    return tuple(pairs)


def _from_outside(
    probabilities: Mapping[tuple[str, ...], float],
    candidates: Mapping[str, CandidateEffect],
    forces: Mapping[str, ForceRecord],
    place: Location,
    seed: int,
) -> tuple[dict[tuple[str, ...], float], str]:
    """Divide "none of these" where the missing torque does not depend on what the rig does."""
    divided = dict(probabilities)
    unnamed = divided.get(("none_of_these",), 0.0)
    shares = place.share()
    moments = {f"{axis}_moment": axis for axis in ("pitch", "yaw")}
    known = {m: shares[m] for m in moments if m in shares and m in forces}
    if unnamed < 0.05 or not known:
        return divided, ""
    location = max(known, key=lambda m: known[m])
    axis = moments[location]
    candidate = candidates.get(f"{axis}_disturbance")
    if candidate is None or known[location] < 0.5:
        return divided, ""
    dependence = exogenous(forces[location], seed)
    if dependence.predictable_share > _FROM_OUTSIDE and dependence.p_value < 0.05:
        return divided, ""
    share = _OUTSIDE_SURE if dependence.predictable_share < _FROM_OUTSIDE else _OUTSIDE_UNSURE
    divided["none_of_these",] = unnamed * (1 - share)
    divided[candidate.name,] = unnamed * share
    return dict(sorted(divided.items(), key=lambda item: -item[1])), axis


def _with_coarse_sensor(
    probabilities: Mapping[tuple[str, ...], float],
    problem: GapProblem,
    candidates: Mapping[str, CandidateEffect],
) -> dict[tuple[str, ...], float]:
    """A sensor that rounds coarser than the other shows in its steps, and in nothing else."""
    quanta = {}
    for axis, described in problem.model.axes.items():
        for dataset in problem.datasets[:1]:
            names_ = [s.name for s in dataset.outputs]
            if described.angle in names_:
                quanta[axis] = quantum_of(dataset.measurements[:, names_.index(described.angle)])
    coarse = [
        axis
        for axis, quantum in quanta.items()
        if f"{axis}_quantisation" in candidates
        and quantum > 1.5 * max(_USUAL_QUANTUM, min(quanta.values()))
    ]
    divided = dict(probabilities)
    if not coarse or len(quanta) < 2:
        return divided
    name = (f"{coarse[0]}_quantisation",)
    nothing = [(n,) for n in ("no_gap", "parameters_only")]
    moved = 0.95 * sum(divided.get(n, 0.0) for n in nothing)
    for n in nothing:
        divided[n] = 0.05 * divided.get(n, 0.0)
    divided[name] = moved
    return dict(sorted(divided.items(), key=lambda item: -item[1]))
