"""Why not the others: every suspect that is not the answer, with what speaks against it.

A suspect that was fitted has a score and a size of its own. One that was not is judged by its trace
(:mod:`trms_cli.gap.signatures`): beside the answer, the recordings want so much of it, and no more
than its upper bound.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from trms_cli.core.wording import number, percent
from trms_cli.gap.diagnosis import NO_EFFECT, NotTestable, Rejected
from trms_cli.gap.posterior import Posterior
from trms_cli.gap.problem import CandidateEffect
from trms_cli.gap.race import Race
from trms_cli.gap.signatures import Signatures
from trms_cli.gap.wording import effects_text

#: Nats within which, and traces' cosine from which, two are not told apart.
_NATS, _ALIKE = 3.0, 0.99
#: Quantile of the upper bound.
_LEVEL = 0.95
#: Nats up to which a partner adds nothing beside the answer.
_NOTHING = 6.0
#: Nats below which a trace explains nothing.
_A_NAT = 1.0


def rejected_effects(
    race: Race,
    posterior: Posterior,
    candidates: Mapping[str, CandidateEffect],
    beside: Signatures,
    unseen: Sequence[NotTestable],
) -> tuple[Rejected, ...]:
    """All candidates but those of the answer, the nearest first.

    ``beside``: traces about the corrected model, or the refitted one where nothing is corrected.
    ``unseen``: what these recordings say nothing of.
    """
    likely = next(iter(posterior.probabilities))
    answer = () if likely[0] in NO_EFFECT else likely
    reasons = {row.effect: row.reason for row in unseen}
    own = float(race.refit.fit.predictive.sum())
    # a torque from outside is estimated, not fitted: nothing was judged beside it
    fitted_answer = answer if any(e.names == answer for e in race.entries) else ()
    # of several that hold a suspect, it alone tells most of it
    alone = {e.names[0]: e for e in race.entries if len(e.names) == 1}
    ranking: list[tuple[float, Rejected]] = []
    for name in [*candidates, *(n for n in reasons if n not in candidates)]:
        if name in answer:
            continue
        candidate = candidates.get(name)
        entry = alone.get(name)
        if candidate is None or not candidate.simulated:
            why = reasons.get(name) or _not_from_outside(name, posterior)
            ranking.append((-np.inf, Rejected(effect=name, reason=why)))
            continue
        bound = upper_bound(beside, candidate)
        if entry is None or not np.isfinite(entry.fit.score):
            why = _of_trace(name, fitted_answer, race, beside, reasons)
            unit = candidate.free[0].unit
            row = Rejected(effect=name, upper_bound=bound, reason=why, unit=unit)
            ranking.append((-1e6 + _promise(beside, name), row))
            continue
        score = entry.fit.score - own
        size = replace(entry.sizes[candidate.free[0].name], others=())
        why, alike = _of_fit(name, score, fitted_answer, race, posterior)
        # it may be the answer itself, or beside none
        if bound is None or alike or not fitted_answer:
            alone_at_most = abs(size.value) + 1.645 * size.sd
            bound = alone_at_most if np.isfinite(alone_at_most) else bound
        row = Rejected(
            effect=name, score=score, size=size, upper_bound=bound, reason=why, unit=size.unit
        )
        ranking.append((score, row))
    ranking.sort(key=lambda item: -item[0])
    return tuple(row for _, row in ranking)


def inclusion(probabilities: Mapping[tuple[str, ...], float]) -> dict[str, float]:
    """Probability of each effect to be part of the answer, descending."""
    totals: dict[str, float] = {}
    for effects, probability in probabilities.items():
        for name in effects if effects[0] not in NO_EFFECT else ():
            totals[name] = totals.get(name, 0.0) + probability
    return dict(sorted(totals.items(), key=lambda item: -item[1]))


def upper_bound(signs: Signatures, candidate: CandidateEffect) -> float | None:
    """The first size lies below it with 95 %, in its unit; None where nothing bounds it.

    The trace at one size stands for those near it: of the sizes tried the one that is nearest to
    its own bound.
    """
    from scipy.special import ndtr, ndtri  # scipy.stats takes half a second to import

    free = candidate.free[0]
    least: tuple[float, float] | None = None
    for row in signs.rows(candidate.name):
        size, energy = abs(float(signs.sizes[row][0])), float(signs.projected_energy[row])
        if not (size > 0 and energy > 1e-6):
            continue
        mean, sd = float(signs.towards[row]) / energy, energy**-0.5
        if free.lower < 0:  # of either sign: of its amount
            times = abs(mean) + float(ndtri(_LEVEL)) * sd
        else:  # normal, and not below zero
            times = mean + sd * float(-ndtri((1 - _LEVEL) * ndtr(mean / sd)))
        if not (np.isfinite(times) and times > 0):
            # so far on the other side that the normal law has no tail left
            times = sd**2 / abs(mean) * -np.log(1 - _LEVEL) if mean < 0 else np.inf
        far = abs(float(np.log(times))) if np.isfinite(times) else np.inf
        if least is None or far < least[0]:
            least = (far, size * times)
    if least is None or not np.isfinite(least[1]) or least[1] > max(abs(free.lower), free.upper):
        return None
    return least[1]


def _promise(signs: Signatures, name: str) -> float:
    """Nats that its trace promises; −∞ of one that was never simulated."""
    return signs.best(name)[0] if len(signs.rows(name)) else -np.inf


def _of_fit(
    name: str, score: float, answer: tuple[str, ...], race: Race, posterior: Posterior
) -> tuple[str, bool]:
    """Why one that was fitted is not it; whether it may be all the same."""
    entries = {e.names: e for e in race.entries}
    own = float(race.refit.fit.predictive.sum())
    best = entries.get(answer)
    if best is None:
        if score < _NATS:
            return "explains no more than other parameters alone", False
        text = f"explains {score:.0f} nats more than other parameters alone"
        features = posterior.features
        if (name,) in features.names and features.behind > _NATS:
            remaining_share = (
                float(features.behinds[features.names.index((name,))]) / features.behind
            )
            text += f" and leaves {percent(min(max(remaining_share, 0.0), 1.0))} of the gap"
        return text, False
    behind = best.fit.score - own - score
    group = next((g for g in posterior.confusable if name in g and set(g) & set(answer)), None)
    if group is not None:
        return f"not told apart from {effects_text(answer)}: {_by_how_much(behind)}", True
    together = entries.get(tuple(sorted((*answer, name))))
    if together is not None:
        more = together.fit.score - best.fit.score
        if more > _NOTHING:
            return (
                f"alone it explains {behind:.0f} nats less than {effects_text(answer)}; beside it, "
                f"{more:.0f} nats more"
            ), False
        if behind > _NATS:
            less = f"explains {behind:.0f} nats less than {effects_text(answer)}"
            return f"{less}, and adds nothing beside it", False
    if behind < _NATS:
        p = posterior.probabilities.get((name,), 0.0)
        return (f"{_by_how_much(behind)} as {effects_text(answer)}: probability {percent(p)}", True)
    return f"explains {behind:.0f} nats less than {effects_text(answer)}", False


def _by_how_much(behind: float) -> str:
    if abs(behind) < _NATS:
        return "explains as much"
    way = "less" if behind > 0 else "more, with more to adjust"
    return f"explains {abs(behind):.0f} nats {way}"


def _of_trace(
    name: str, answer: tuple[str, ...], race: Race, beside: Signatures, reasons: Mapping[str, str]
) -> str:
    """Why one that was not fitted is not it."""
    if name in reasons:
        return reasons[name]
    if not len(beside.rows(name)):
        return "no simulation with it stays finite"
    simulated_answers = [other for other in answer if len(race.tight.rows(other))]
    alike = [other for other in simulated_answers if race.tight.alike(name, other) > _ALIKE]
    if alike:
        return f"leaves the same trace as {effects_text(alike)}: not told apart by such recordings"
    before = max(_promise(race.signatures, name), _promise(race.tight, name))
    after = _promise(beside, name)
    remainder = (
        f"what {effects_text(answer)} leaves" if answer else "what the refitted model leaves"
    )
    rows = beside.rows(name)
    if np.all(beside.towards[rows] <= 0):
        return f"its trace points the other way than {remainder}"
    if answer and before > _NOTHING and after < _NOTHING:
        return (
            f"once {effects_text(answer)} is in the model nothing is left for it: "
            f"{number(after, 2)} nats"
        )
    if after < _A_NAT:
        return f"its trace explains nothing of {remainder}"
    return f"its trace explains at most {number(after, 2)} nats of {remainder}"


def _not_from_outside(name: str, posterior: Posterior) -> str:
    """Why a torque from outside is not it."""
    probability = posterior.probabilities.get((name,), 0.0)
    if probability > 0:
        return f"what is missing may come from outside: probability {percent(probability)}"
    if name.endswith("_quantisation"):
        return "the steps of its angle are no coarser than usual"
    return "no torque is missing there that comes and goes without what the rig does"
