"""How sure: from features of the fits to probabilities that mean what they say.

A nat of a likelihood is not a nat of belief: the real discrepancy is not Gaussian, of forty
candidates one fits best by chance, and what a fit does on data it has not seen tells more than its
score. Each alternative (no gap, other parameters only, each competitor of the race, none of these)
has a few features; probabilities are proportional to the exponentials of their weighted sums
(multinomial logistic regression: McFadden 1974). The weights are fitted to simulated rigs whose
nuisances are drawn and whose truth is known (``calibration.json``, with the command that makes it).
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from importlib.resources import files
from pathlib import Path

import numpy as np
from msgspec import convert
from scipy.special import softmax

from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import ConfigurationError
from trms_cli.gap.diagnosis import NO_EFFECT


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """Weights of the features, and what counts as usual."""

    weights: Mapping[str, float]  #: By feature, see :func:`alternatives`
    #: Error of each equation of a rig without a gap, as a share of what acts there
    usual_shares: Mapping[str, float] = field(default_factory=dict)
    #: What is believed of a change before it is seen, see :func:`change_probabilities`
    change: Mapping[str, float] = field(default_factory=dict)
    command: str = ""  #: That fits the weights again

    def usual(self, location: str) -> float:
        """Error of an equation of a rig without a gap: the place's own, or that of its kind."""
        kind = ACTUATOR if location.endswith(f"_{ACTUATOR}") else EQUATION
        largest = max(self.usual_shares.values(), default=0.03)
        return self.usual_shares.get(location, self.usual_shares.get(kind, largest))


#: Kinds of places, of rigs whose places nobody knows beforehand.
ACTUATOR, EQUATION = "actuator", "equation"
#: Of the package: of the twin rotors, and of any other model.
TWIN_ROTOR, ANY_RIG = "calibration.json", "calibration_any_rig.json"


@cache
def calibration(name: str = TWIN_ROTOR) -> Calibration:
    """One of the package's."""
    text = (files("trms_cli.gap") / name).read_text(encoding="utf-8")
    return Calibration(**json.loads(text))


def calibration_file(path: Path) -> Calibration:
    """One that ``make calibration MODEL=NAME`` has written.

    Raises ConfigurationError for a file that is missing or is none.
    """
    remedy = "name a file that `make calibration MODEL=NAME` wrote, or leave the key out"
    try:
        own = convert(json.loads(path.read_text(encoding="utf-8")), Calibration)
        needed = {name for name in calibration(ANY_RIG).weights if not name.startswith("own.")}
        if missing := sorted(needed - own.weights.keys()):
            raise ValueError(f"it has no weights of {', '.join(missing)}")
        return own
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise ConfigurationError(
            f"{path}: no calibration: {reason}", where="calibration", remedy=remedy
        ) from error


@dataclass(frozen=True, kw_only=True)
class Features:
    """What a diagnosis knows before it believes anything; scores by block add up.

    The error of free runs is the largest of all channels at the longest horizon on the sealed part,
    in floors.
    """

    gained: float  #: Score of the refit above the model as it was, nats
    behind: float  #: Nats that the refit owes to discrepancies beyond the usual
    names: tuple[tuple[str, ...], ...]  #: Effects of each competitor
    scores: FloatArray  #: (k,) array; held-out score above the refit's, nats
    behinds: FloatArray  #: (k,) array; as ``behind``, of each competitor
    sizes: FloatArray  #: (k,) array; number of sizes that each competitor's effects have
    #: (k,) array; how unusual each competitor's sizes are, nats; see ``CandidateEffect.surprise``
    surprises: FloatArray
    #: (k,) array; of free runs of each competitor; those that were not made are the refit's
    errors: FloatArray
    #: (k,) array; logarithm of the factor by which each competitor errs more than the refit, in the
    #: channel that suffers most, on the sealed part; NaN where not measured
    harms: FloatArray = field(default_factory=lambda: np.zeros(0))
    #: (k,) array; one where a competitor's effects begin within the recordings, and one more for
    #: each of them that hardly may; zero where they act throughout
    begins: FloatArray = field(default_factory=lambda: np.zeros(0))
    raw_error: float = np.nan  #: Of free runs of the model as it was
    refit_error: float = np.nan  #: Of free runs of the refit
    #: (k + 1,) arrays by axis; as ``behind`` if a torque from outside acts on it, of the refit and
    #: of each competitor
    outside: Mapping[str, FloatArray] = field(default_factory=dict)
    #: Share of what a torque from outside explains that an error of its axis' sensor explains too
    sensor: Mapping[str, float] = field(default_factory=dict)
    #: Size of a torque from outside over that of what acts on its axis
    force: Mapping[str, float] = field(default_factory=dict)
    #: Correlation time of the missing moment of each axis that a torque may act on, s
    memory: Mapping[str, float] = field(default_factory=dict)
    flexible: float = np.nan  #: Score of the flexible competitor; NaN: it was not fitted
    #: Share of the missing force that it, or a regression on it, foretells on held-out blocks
    foretold: float = np.nan
    samples: float = 2e4  #: Number of measured values that were fitted
    #: (k,) array; standard error of each competitor's score, from its scatter over blocks
    deviations: FloatArray = field(default_factory=lambda: np.zeros(0))
    #: (k, m) array; scores by block
    by_block: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    bench: bool = False  #: Whether pairs are weighed as those of benches were proved


#: nats. Discrepancy beyond the usual that hardly counts.
_REST = 8.5
#: nats a measured value. Gain of a refit that hardly counts: errors of one step fall by half a
#: percent. That it is significant says nothing: in a long recording the least gain is.
_GAIN = 0.005
#: Times the square of its signal-to-noise ratio over blocks that a score counts for, in nats, at
#: most. Two is the theory's, for blocks that are excited alike.
_SCATTER = 6.0
#: nats. Scores beyond so many count by their logarithm as well.
_BEND = 10.0
#: Share of the best competitor's score that the flexible one is taken to have where it was not
#: fitted: it reaches a true cause nearly, and leaves a wrong one far behind.
_UNFITTED = 0.5
#: Share of what the refit owes to forces without a name from which on the flexible competitor is
#: an explanation of its own: a beam that a torque moves gains it a hundredth.
_EXPLAINS = 0.1
#: Share of rigs in which features mislead, and by what leads are divided there. Of six pairs, of
#: 0.03 to 0.12 and 5 to 20, whose log loss over folds of the rigs of ``calibration`` is alike
#: (0.803 to 0.815; 0.827 without; all before effects beside a torque were further ones) one of the
#: least with a small calibration error.
LAPSE, LAPSE_TEMPERATURE = 0.08, 10.0
#: s. A torque from outside that forgets itself within is as usual as any.
_SLOW = 4.0
#: Share of what a torque explains that its sensor explains too, and a little more.
_WHOLE = 1.01
#: What the name of a torque from outside ends in.
DISTURBANCE = "_disturbance"
#: What the names of coarse rounding and of lost samples end in, which no simulation shows.
QUANTISATION, DROPOUT = "_quantisation", "_dropout"
#: Logarithms. A right cause may do a channel so much harm on a short sealed part; more than the
#: other is all alike.
_BY_CHANCE, _HARMED = 0.1, 1.5
#: Floors. Free runs worse than this are all alike.
_WORST = 50.0


def simulated_part(effects: tuple[str, ...]) -> tuple[str, ...]:
    """Those effects of a cause that a simulation shows."""
    return tuple(n for n in effects if not n.endswith((DISTURBANCE, QUANTISATION, DROPOUT)))


def own_feature(effect: str) -> str:
    """Name of the feature that alternatives with an effect have.

    Some effects are mimicked by what every rig does (damping whose law is of a slightly other
    form), others by nothing, or they show by a handful of nats at any size.
    """
    return f"own.{effect}"


def own_features(effect: str) -> list[str]:
    """That of an effect, and those of the endings of its name: a law weighs alike at any port."""
    words = effect.split("_")
    return [own_feature("_".join(words[i:])) for i in range(len(words))]


def alternatives(features: Features) -> dict[tuple[str, ...], dict[str, float]]:
    """Features of each alternative by name, of the order of one; what is not named is zero."""
    features = _tempered(features)
    gain = max(features.gained, 0.0) / (_GAIN * features.samples)
    rest = float(_rest(features.behind))
    bettered = _of_error(features.raw_error) - _of_error(features.refit_error)
    rows: dict[tuple[str, ...], dict[str, float]] = {
        ("no_gap",): {
            "no_gap.rest": rest,
            "no_gap.gain": float(np.log1p(gain)),
            "no_gap.bettered": max(bettered, 0.0),
            "no_gap.error": _of_error(features.raw_error),
        },
        ("parameters_only",): {
            "parameters.constant": 1.0,
            "parameters.rest": rest,
            "parameters.no_gain": 1 / (1 + gain),
            "parameters.error": _of_error(features.refit_error),
        },
    }
    best = 0.0
    scores = dict(zip(features.names, features.scores.tolist(), strict=True))
    for i, name in enumerate(features.names):
        score = float(features.scores[i])
        if not np.isfinite(score):
            continue
        best = max(best, score)
        rows[name] = {
            **_of_score(score),
            "score.bend": _by_steps(name, scores),
            "effect.rest": _unexplained_gap(features, features.behinds[i]),
            "effect.constant": 1.0,
            "effect.further": float(len(name) - 1),
            "effect.shape": float(features.sizes[i] - len(name)),
            "effect.surprise": float(np.log1p(features.surprises[i])),
            "effect.error": _of_error(features.errors[i]),
            "effect.worse": _worse(features, i),
            "effect.begins": float(features.begins[i]) if i < len(features.begins) else 0.0,
        }
    foretold = 0.0 if np.isnan(features.foretold) else float(np.clip(features.foretold, 0.0, 1.0))
    behind_by_name = dict(zip(features.names, features.behinds, strict=True))
    for axis, behinds in features.outside.items():
        disturbance = f"{axis}{DISTURBANCE}"
        # play in an encoder looks like a torque, but one that is larger than all that acts there; a
        # sensor that drifts and a spring that ages look like one that hardly changes
        doubtful = {
            "disturbance.sensor": -float(np.log(_WHOLE - min(features.sensor.get(axis, 0.0), 1.0))),
            "disturbance.force": float(np.log1p(features.force.get(axis, 0.0))),
            "disturbance.memory": float(np.log(max(features.memory.get(axis, 0.0) / _SLOW, 1.0))),
        }
        # a torque that explains nothing is no answer
        if features.behind - behinds[0] > _REST:
            rows[disturbance,] = {
                **_of_score(_due_to_torque(features)),
                "effect.rest": _unexplained_gap(features, behinds[0]),
                "disturbance": 1.0,
                "disturbance.foretold": foretold,
                **doubtful,
            }
        for name, behind in zip(features.names, behinds[1:], strict=True):
            if name in rows and behind_by_name[name] - behind > _REST:
                joined = tuple(sorted((*name, disturbance)))
                row = {k: v for k, v in rows[name].items() if k != "effect.error"}
                # the torque is the first of them: what overcomes that nothing acts at all, or that
                # other parameters do it, need not be overcome again
                row |= {"effect.constant": 0.0, "effect.further": float(len(name))}
                row |= {"effect.rest": _unexplained_gap(features, behind), "disturbance": 1.0}
                # terms that foretell what the other effect leaves foretell the torque
                share = max(behind_by_name[name], 0.0) / max(features.behind, 1e-9)
                row["disturbance.foretold"] = foretold * min(share, 1.0)
                rows[joined] = row | doubtful
    was_fitted = not np.isnan(features.flexible)
    rows["none_of_these",] = {
        **_of_score(max(features.flexible, 0.0) if was_fitted else _UNFITTED * best),
        "none.constant": 1.0,
        "none.rest": rest,
        "none.foretold": foretold,
        "none.flexible": float(was_fitted),
    }
    for name, row in rows.items():
        if name[0] not in NO_EFFECT:
            row |= {feature: 1.0 for effect in name for feature in own_features(effect)}
    return rows


def _tempered(features: Features) -> Features:
    """Scores count less where they come from a few of the blocks.

    A log likelihood ratio of S nats between right laws has a variance of 2 S, so that S is about
    twice the square of its own signal-to-noise ratio. Where the blocks scatter by much more than
    their excitation explains, the likelihood is no likelihood, and all scores are taken for shares
    of it (quasi-likelihood: McCullagh 1983, Annals of Statistics 11). What a further effect gains
    beside others is judged by the scatter of that gain; leads of what explains more, of the
    flexible competitor as well, are kept.
    """
    finite = np.isfinite(features.scores)
    if not (finite.any() and len(features.deviations)):
        return features
    best = int(np.argmax(np.where(finite, features.scores, -np.inf)))
    score, deviation = float(features.scores[best]), float(features.deviations[best])
    if not (score > 0 and deviation > 0):
        return features
    share = _credible(score, deviation)
    scores, lifts = features.scores, np.zeros(len(features.scores))
    sets = [frozenset(name) for name in features.names]
    by_size = sorted(np.flatnonzero(finite).tolist(), key=lambda i: len(sets[i]))
    for i in by_size if len(features.by_block) else ():
        parts = [j for j in by_size if sets[j] < sets[i] and 0 < scores[j] < scores[i]]
        if not features.bench:  # what both gain over the lesser of them is no merit of that
            parts = sorted(parts, key=scores.__getitem__)[-1:]
        for j in parts:
            # blocks in which the first effect shows more say nothing against a further one
            gain, blocks = scores[i] - scores[j], features.by_block[i] - features.by_block[j]
            own = max(share, _credible(float(gain), standard_error(blocks)))
            lifts[i] = max(lifts[i], lifts[j] + (own - share) * gain)
    # what a set is spared lifts no other, and takes no lead from what explains more
    descending = np.argsort(-scores)[: len(by_size)]
    lifts[descending] = np.minimum.accumulate(lifts[descending])
    lead = np.max(lifts[finite & (scores < features.flexible)], initial=0.0)
    return replace(
        features, scores=share * scores + lifts, flexible=share * features.flexible + float(lead)
    )


def _credible(score: float, deviation: float) -> float:
    """Share of a score that counts, by its standard error over blocks."""
    return min(1.0, _SCATTER * score / deviation**2) if deviation > 0 else 1.0


def standard_error(blocks: FloatArray) -> float:
    """Standard error of a sum over blocks, (m,) array."""
    return float(np.std(blocks, ddof=1) * np.sqrt(len(blocks))) if len(blocks) > 1 else 0.0


def _due_to_torque(features: Features) -> float:
    """Score of the flexible competitor that a torque from outside accounts for, nats.

    A beam that a torque moves shows some dependence on its own angle: what explains hardly any of
    the gap speaks for a torque as much as for a law without a name.
    """
    if np.isnan(features.flexible):
        return 0.0
    score, behind = max(features.flexible, 0.0), max(features.behind, 0.0)
    return score * (1 - min(1.0, score / (_EXPLAINS * behind))) if behind > 0 else 0.0


def _unexplained_gap(features: Features, behind: float) -> float:
    """What a competitor leaves to forces without a name.

    It is not blamed for a hundredth of the gap: no law is exactly that of the rig.
    """
    gap = max(float(behind), 0.0)
    return float(_rest(gap)) * min(gap / (max(features.behind, 0.0) + _REST), 1.0)


def _worse(features: Features, i: int) -> float:
    """By how much a competitor harms a channel, as a logarithm, beyond what may happen."""
    is_measured = i < len(features.harms) and np.isfinite(features.harms[i])
    return float(np.clip(features.harms[i] - _BY_CHANCE, 0.0, _HARMED)) if is_measured else 0.0


def _rest(behind: float | FloatArray) -> FloatArray:
    return np.log1p(np.maximum(behind, 0.0) / _REST)


def _by_steps(name: tuple[str, ...], scores: Mapping[tuple[str, ...], float]) -> float:
    """Logarithms of what its effects gain one after the other, on the best way to all of them.

    The tenth nat counts more than the hundredth, of a second effect as of the first.
    """
    parts = [n for n in scores if set(n) < set(name) and np.isfinite(scores[n])]
    ways = [_flattened_score(scores[name])]
    ways += [_by_steps(p, scores) + _flattened_score(scores[name] - scores[p]) for p in parts]
    return max(ways)


def _flattened_score(score: float) -> float:
    return _BEND * float(np.log1p(max(score, 0.0) / _BEND))


def _of_score(score: float) -> dict[str, float]:
    return {"score": score, "score.bend": _flattened_score(score)}


def _of_error(ratio: float) -> float:
    """Of a run that diverged as of the worst; of one that was not made, nothing."""
    return 0.0 if np.isnan(ratio) else float(np.log(np.clip(ratio, 1.0, _WORST)))


def probabilities_of(
    features: Features, weights: Mapping[str, float]
) -> dict[tuple[str, ...], float]:
    """Probability of each competitor, and of ``no_gap``, ``parameters_only``, ``none_of_these``.

    Descending. ``weights``: by feature; of an effect's own zero where it has none.
    """
    rows = alternatives(features)
    logits = np.array([sum(_weight(weights, k) * v for k, v in r.items()) for r in rows.values()])
    probabilities = dict(zip(rows, shares_of(logits).tolist(), strict=True))
    return dict(sorted(probabilities.items(), key=lambda item: -item[1]))


def _weight(weights: Mapping[str, float], feature: str) -> float:
    return weights.get(feature, 0.0) if feature.startswith("own.") else weights[feature]


def shares_of(logits: FloatArray) -> FloatArray:
    """Probabilities (k,) of alternatives by the logarithms of their odds, (k,) array.

    In some rigs features mislead, by whatever they lead: there a lead counts by a tenth. Without
    that what is told with 0.99 and more is wrong in one of twenty rigs.
    """
    plain, tempered = (softmax(logits / temperature) for temperature in (1.0, LAPSE_TEMPERATURE))
    return np.asarray((1 - LAPSE) * plain + LAPSE * tempered)


#: nats. Largest gain of a change that is thought of: gains are log-uniform up to it.
_LARGEST_GAIN = 1000.0
#: nats by which a change that gains nothing is less likely than one of the least gain.
_NO_GAIN = 3.0


#: What a force without a name gains is among gains under this name.
UNNAMED = "unnamed"
#: Share for which the gain of any other difference between recordings of one state counts.
_OF_OTHERS = 0.25


def usual_gains(
    gains: Mapping[str, float], between: Sequence[Mapping[str, float]]
) -> tuple[float, ...]:
    """nats that the best of some differences gains between recordings of one state.

    Where drives differ from day to day, a friction that never gained anything is not doubted for
    it, or by a share alone: recordings so few have not shown all by which they differ.

    ``gains``: nats of each difference, and of :data:`UNNAMED`, in the recordings in question.
    ``between``: the same where each recording of the known state is questioned; not of each
    difference.
    """
    best = max(gains, key=gains.__getitem__)
    return tuple(
        max(0.0, other_gains.get(best, 0.0), _OF_OTHERS * max(other_gains.values(), default=0.0))
        for other_gains in between
    )


def unnamed_gain(by_equation: FloatArray) -> float:
    """nats that a force without a name gains, on whichever equation, (e,) array of each."""
    return float(np.logaddexp.reduce(by_equation) - np.log(len(by_equation)))


def change_worth(
    kinds: Sequence[str], nats: FloatArray, beliefs: FloatArray, constants: Mapping[str, float]
) -> FloatArray:
    """Logarithm of how likely each of some differences is, up to a constant, (k,).

    ``nats``, (k,) array: log evidence of each. ``beliefs``, (k,) array: logarithm of what is
    believed of each beforehand, besides that of its kind, which is shared among its members.
    """
    priors = [np.log(constants[kind] / kinds.count(kind)) for kind in kinds]
    return np.asarray(constants["nat"] * nats + beliefs + priors)


def change_probabilities(
    kinds: Sequence[str],
    gains: FloatArray,
    beliefs: FloatArray,
    unnamed: float,
    usual: Sequence[float],
    constants: Mapping[str, float],
) -> tuple[FloatArray, float, float]:
    """Probability of each difference (k,), that nothing changed, and of something else.

    Gains between recordings of one state are exponential, of a rate of which as much is believed
    as ``believed`` recordings that gained ``usual_gain`` tell; with those of the recordings at hand
    the best gain of a further one is Lomax distributed. Those of a change are log-uniform.

    ``gains``, (k,) array: nats above that nothing changed. ``beliefs``: as of
    :func:`change_worth`. ``unnamed``: of a force without a name.
    ``usual``: nats that what is best here gains where each recording of the known state is
    questioned (:func:`usual_gains`).
    ``constants``: beliefs ``unchanged``, ``unnamed`` and of each kind; ``nat``, of how much belief
    a nat is worth among differences; ``believed`` and ``usual_gain``.
    """
    size = max(float(np.max(gains, initial=0.0)), unnamed, 0.0)
    shape = constants["believed"] + len(usual)
    scale = constants["believed"] * constants["usual_gain"] + sum(usual)
    none = np.log(shape / scale) - (shape + 1) * np.log1p(size / scale)
    some = -np.log((1 + size) * np.log(_LARGEST_GAIN)) - (0.0 if size > 0 else _NO_GAIN)
    before = np.log(constants["unchanged"] / (1 - constants["unchanged"]))
    unchanged = float(1 / (1 + np.exp(some - none - before)))
    other = constants["nat"] * unnamed + np.log(constants["unnamed"])
    log = np.append(change_worth(kinds, gains, beliefs, constants), other)
    shares = np.exp(log - log.max())
    shares *= (1 - unchanged) / shares.sum()
    return shares[:-1], unchanged, float(shares[-1])
