"""Beliefs in each cause, the verdict, and what cannot be told apart."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from trms_cli.gap.blocks import quantum_of
from trms_cli.gap.candidates import Suspect
from trms_cli.gap.confidence import Calibration, Features, beliefs
from trms_cli.gap.diagnosis import NO_EFFECT, Verdict
from trms_cli.gap.force.exogenous import exogenous
from trms_cli.gap.force.record import ForceRecord
from trms_cli.gap.innovations.sizes import log_likelihood
from trms_cli.gap.location import Location
from trms_cli.gap.problem import GapProblem
from trms_cli.gap.race.contest import Contest, Entry

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

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
class Believed:
    """What is believed."""

    #: Descending; effects together, or one of :data:`NO_EFFECT`
    probabilities: Mapping[tuple[str, ...], float]
    verdict: Verdict
    best: Entry | None  #: The most probable with effects
    corrected: Entry | None  #: What goes into the corrected model; None: the refit alone
    confusable: tuple[tuple[str, ...], ...]
    features: Features
    #: The probabilities with blocks drawn anew: how much they hang on single blocks
    resampled: tuple[Mapping[tuple[str, ...], float], ...]
    outside: str = ""  #: Axis on which a torque from outside acts; empty for none


def features_of(
    raced: Contest, behinds: Sequence[FloatArray], blocks: IntArray | None = None
) -> Features:
    """Scores of all, from some blocks; None: from all. ``behinds`` as of :func:`excesses`."""
    refit = raced.refit
    chosen: slice | IntArray = slice(None) if blocks is None else blocks
    own = _scores(refit.fit)[chosen].sum()
    raw = _scores(refit.raw)[chosen].sum()
    scores = np.array([_scores(e.fit)[chosen].sum() for e in raced.entries])
    return Features(
        gained=float(own - raw),
        behind=float(behinds[0][chosen].sum()),
        names=tuple(e.names for e in raced.entries),
        scores=scores - own,
        behinds=np.array([b[chosen].sum() for b in behinds[1:]]),
        sizes=np.array([sum(len(s.free) for s in e.contestant.effects) for e in raced.entries]),
    )


def excesses(raced: Contest, constants: Calibration) -> list[FloatArray]:
    """What the refit and each competitor owe to discrepancies beyond the usual, nats by block.

    The log likelihood of what they leave, less what it would be if no equation might err by more
    than those of rigs without a gap do.
    """
    refit = raced.refit
    discrepancy = refit.metric.discrepancy
    usual = np.array([constants.usual(c.location) for c in discrepancy.channels])
    found = []
    for contestant, fit, metric in [
        (refit.contestant, refit.fit, refit.metric),
        *((e.contestant, e.fit, e.metric) for e in raced.entries),
    ]:
        if np.all(discrepancy.effective(metric.shares) <= discrepancy.effective(usual) * 1.001):
            found.append(np.zeros(len(refit.contestant.windows)))
            continue
        r = contestant.residuals(fit)
        calm = np.minimum(metric.shares, usual)
        excess = log_likelihood(discrepancy, r, metric.shares) - log_likelihood(
            discrepancy, r, calm
        )
        found.append(np.nan_to_num(excess, nan=1e6))
    return found


def believe(
    problem: GapProblem,
    raced: Contest,
    found: Mapping[str, Suspect],
    forces: Mapping[str, ForceRecord],
    place: Location,
    constants: Calibration,
) -> Believed:
    """Weigh all that raced.

    Parameters
    ----------
    raced : Contest
    found : dict of str to Suspect
        All suspects, those that noise drives among them.
    forces : dict of str to ForceRecord
        Smoothed missing force of each equation.
    place : Location
    """
    behinds = excesses(raced, constants)
    features = features_of(raced, behinds)
    probabilities = beliefs(features, constants)
    probabilities, outside = _from_outside(probabilities, found, forces, place, problem.seed)
    probabilities = _with_coarse_sensor(probabilities, problem, found)
    random = np.random.default_rng(np.random.SeedSequence([problem.seed, 0xB10C]))
    m = len(raced.refit.contestant.windows)
    resampled = tuple(
        beliefs(features_of(raced, behinds, random.integers(0, m, m)), constants)
        for _ in range(_RESAMPLES)
    )
    entries = {e.names: e for e in raced.entries}
    named = [n for n in probabilities if n in entries]
    best = entries[named[0]] if named else None
    confusable: tuple[tuple[str, ...], ...] = ()
    if best is not None and probabilities[best.names] > _MENTIONED:
        confusable = _confusable(raced, best)
    verdict = _verdict(probabilities, confusable)
    likely = next(iter(probabilities))
    corrected = best if verdict in ("effect", "undecided") and likely in entries else None
    return Believed(
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


def _scores(fit: object) -> FloatArray:
    worth = fit.evidence  # type: ignore[attr-defined]
    assert worth is not None
    predictive: FloatArray = worth.predictive
    return predictive


def _confusable(raced: Contest, best: Entry) -> tuple[tuple[str, ...], ...]:
    """Groups with the best that the scores, or the traces themselves, do not part."""
    own = _scores(best.fit)
    group: list[str] = []
    for entry in raced.entries:
        if entry.names == best.names or len(entry.names) != len(best.names):
            continue
        apart = own - _scores(entry.fit)
        error = float(np.std(apart, ddof=1) * np.sqrt(len(apart))) if len(apart) > 1 else 0.0
        if apart.sum() < max(_NATS, _ERRORS * error) and np.isfinite(apart).all():
            group += [n for n in entry.names if n not in best.names]
    pairs = []
    signs = raced.tight
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
    found: Mapping[str, Suspect],
    forces: Mapping[str, ForceRecord],
    place: Location,
    seed: int,
) -> tuple[dict[tuple[str, ...], float], str]:
    """Divide "none of these" where the missing torque does not depend on what the rig does."""
    beliefs_ = dict(probabilities)
    unnamed = beliefs_.get(("none_of_these",), 0.0)
    shares = place.share()
    moments = {f"{axis}_moment": axis for axis in ("pitch", "yaw")}
    known = {m: shares[m] for m in moments if m in shares and m in forces}
    if unnamed < 0.05 or not known:
        return beliefs_, ""
    location = max(known, key=lambda m: known[m])
    axis = moments[location]
    suspect = found.get(f"{axis}_disturbance")
    if suspect is None or known[location] < 0.5:
        return beliefs_, ""
    judged = exogenous(forces[location], seed)
    if judged.predictable_share > _FROM_OUTSIDE and judged.p_value < 0.05:
        return beliefs_, ""
    share = _OUTSIDE_SURE if judged.predictable_share < _FROM_OUTSIDE else _OUTSIDE_UNSURE
    beliefs_["none_of_these",] = unnamed * (1 - share)
    beliefs_[suspect.name,] = unnamed * share
    return dict(sorted(beliefs_.items(), key=lambda item: -item[1])), axis


def _with_coarse_sensor(
    probabilities: Mapping[tuple[str, ...], float],
    problem: GapProblem,
    found: Mapping[str, Suspect],
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
        if f"{axis}_quantisation" in found
        and quantum > 1.5 * max(_USUAL_QUANTUM, min(quanta.values()))
    ]
    beliefs_ = dict(probabilities)
    if not coarse or len(quanta) < 2:
        return beliefs_
    name = (f"{coarse[0]}_quantisation",)
    nothing = [(n,) for n in ("no_gap", "parameters_only")]
    moved = 0.95 * sum(beliefs_.get(n, 0.0) for n in nothing)
    for n in nothing:
        beliefs_[n] = 0.05 * beliefs_.get(n, 0.0)
    beliefs_[name] = moved
    return dict(sorted(beliefs_.items(), key=lambda item: -item[1]))
