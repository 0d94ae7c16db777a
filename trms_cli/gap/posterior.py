"""How sure: from scores to probabilities that mean what they say, the verdict, what is confusable.

A nat of a likelihood is not a nat of belief: the real discrepancy is not Gaussian, and of forty
candidates one fits best by chance. With ``x`` the held-out score of a competitor above the refit's
(each in the discrepancy that suits it) and ``R`` the nats that it owes to discrepancies larger than
those of rigs without a gap, probabilities are proportional to the exponentials of

    no effect              −γ log(1 + R₀/ρ)
    effects                β x − γ log(1 + R/ρ) R/(R₀ + ρ) − κ·(effects) − κ′·(further sizes)
    none of these          β x* − κ*                     x* the best competitor's

and that of no effect is divided between "no gap" and "parameters only" by a logistic function of
what the refit gained. The constants are fitted to development rigs whose truth is known, built by
other code than the models (``calibration.json``, with the command that makes it again).
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np

from trms_cli.core.arrays import FloatArray, IntArray
from trms_cli.gap.competing_model import FittedModel
from trms_cli.gap.diagnosis import NO_EFFECT, Verdict
from trms_cli.gap.discrepancy import log_likelihood
from trms_cli.gap.force.exogenous import exogenous
from trms_cli.gap.force.laws import ForceRecord
from trms_cli.gap.problem import CandidateEffect, GapProblem, quantum_of
from trms_cli.gap.race import Race
from trms_cli.gap.residuals import Location


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """Constants of the probabilities."""

    #: Error of each equation of a rig without a gap, as a share of what acts there
    usual_shares: Mapping[str, float] = field(default_factory=dict)
    temperature: float  #: β, belief per nat
    rest_weight: float  #: γ and ρ, nats
    rest_scale: float  #: γ and ρ, nats
    entrance: float  #: κ, for each effect
    shape: float  #: κ′, for each further size: of laws that explain the same, the one with fewer
    unnamed: float  #: κ*, for none of these
    parameters_slope: float  #: Of the logistic function of log(1 + gain of the refit in nats)
    parameters_centre: float  #: Its gain of one half, nats
    command: str = ""  #: That makes the file again

    def usual(self, location: str) -> float:
        """Error of an equation of a rig without a gap."""
        return self.usual_shares.get(location, max(self.usual_shares.values(), default=0.03))


@dataclass(frozen=True, kw_only=True)
class Features:
    """What a diagnosis knows before it believes anything; scores by block add up."""

    gained: float  #: Score of the refit above the model as it was, nats
    behind: float  #: Nats that the refit owes to discrepancies beyond the usual
    names: tuple[tuple[str, ...], ...]  #: Effects of each competitor
    scores: FloatArray  #: (k,) array; held-out score above the refit's, nats
    behinds: FloatArray  #: (k,) array; as ``behind``, of each competitor
    sizes: FloatArray  #: (k,) array; number of sizes that each competitor's effects have


@cache
def calibration() -> Calibration:
    """The package's."""
    text = (files("trms_cli.gap") / "calibration.json").read_text(encoding="utf-8")
    return Calibration(**json.loads(text))


def probabilities_of(features: Features, constants: Calibration) -> dict[tuple[str, ...], float]:
    """Probability of each competitor, and of ``no_gap``, ``parameters_only``, ``none_of_these``."""
    c = constants

    def rest(behind: float | FloatArray) -> Any:
        return c.rest_weight * np.log1p(np.maximum(behind, 0.0) / c.rest_scale)

    scores = np.asarray(features.scores, dtype=float)
    finite = np.isfinite(scores)
    count = np.array([len(n) for n in features.names])
    logits: dict[tuple[str, ...], float] = {("no_effect",): -float(rest(features.behind))}
    left = np.maximum(np.asarray(features.behinds), 0.0)
    # a cause is not blamed for a hundredth of the gap: no law is exactly that of the rig
    share = np.minimum(left / (max(features.behind, 0.0) + c.rest_scale), 1.0)
    of_effects = c.temperature * scores - rest(left) * share - c.entrance * count
    of_effects = of_effects - c.shape * (np.asarray(features.sizes) - count)
    for name, logit, fine in zip(features.names, of_effects, finite, strict=True):
        if fine:
            logits[name] = float(logit)
    best = float(np.max(scores[finite], initial=0.0))
    logits["none_of_these",] = c.temperature * max(best, 0.0) - c.unnamed
    top = max(logits.values())
    weights = {name: float(np.exp(logit - top)) for name, logit in logits.items()}
    total = sum(weights.values())
    found = {name: weight / total for name, weight in weights.items()}
    nothing = found.pop(("no_effect",))
    moved = np.log1p(max(features.gained, 0.0)) - np.log1p(c.parameters_centre)
    of_parameters = float(1 / (1 + np.exp(-c.parameters_slope * 10 * moved)))
    found["no_gap",] = nothing * (1 - of_parameters)
    found["parameters_only",] = nothing * of_parameters
    return dict(sorted(found.items(), key=lambda item: -item[1]))


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
    race: Race, behinds: Sequence[FloatArray], blocks: IntArray | None = None
) -> Features:
    """Scores of all, from some blocks; None: from all. ``behinds`` as of :func:`excesses`."""
    refit = race.refit
    chosen: slice | IntArray = slice(None) if blocks is None else blocks
    own = refit.fit.predictive[chosen].sum()
    raw = refit.raw.predictive[chosen].sum()
    scores = np.array([e.fit.predictive[chosen].sum() for e in race.entries])
    return Features(
        gained=float(own - raw),
        behind=float(behinds[0][chosen].sum()),
        names=tuple(e.names for e in race.entries),
        scores=scores - own,
        behinds=np.array([b[chosen].sum() for b in behinds[1:]]),
        sizes=np.array([sum(len(s.free) for s in e.structure.effects) for e in race.entries]),
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
    for fitted in (refit, *race.entries):
        shares = fitted.metric.shares
        if np.all(discrepancy.effective(shares) <= discrepancy.effective(usual) * 1.001):
            found.append(np.zeros(len(refit.structure.windows)))
            continue
        r = fitted.residuals
        excess = log_likelihood(discrepancy, r, shares)
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
) -> Posterior:
    """Weigh all that raced.

    ``candidates``: all of them, those that noise drives among them. ``forces``: smoothed missing
    force of each equation.
    """
    behinds = excesses(race, constants)
    features = features_of(race, behinds)
    probabilities = probabilities_of(features, constants)
    probabilities, outside = _from_outside(probabilities, candidates, forces, place, problem.seed)
    probabilities = _with_coarse_sensor(probabilities, problem, candidates)
    random = np.random.default_rng(np.random.SeedSequence([problem.seed, 0xB10C]))
    m = len(race.refit.structure.windows)
    resampled = tuple(
        probabilities_of(features_of(race, behinds, random.integers(0, m, m)), constants)
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
