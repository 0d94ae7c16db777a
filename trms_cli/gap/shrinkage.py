"""How far a correction closes the gap on what was kept aside, and how sure that is.

What is told is measured on the sealed part, on which nothing was fitted. Its interval is that of
another recording: a bootstrap of as many blocks as the sealed part has, with errors that differ as
they do between recordings of a rig. A part of few blocks does not tell its own scatter: then the
blocks that were fitted are sealed in turn, each with the parameters that the other blocks alone
would give, and blocks are drawn from all of them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from trms_cli.core.arrays import FloatArray, IntArray
from trms_cli.core.errors import ConfigurationError
from trms_cli.effects.constant_torque import ConstantTorque
from trms_cli.effects.extended_model import extend_model
from trms_cli.gap.beginning import begins_at
from trms_cli.gap.change import StateComparison
from trms_cli.gap.competing_model import FittedModel
from trms_cli.gap.diagnosis import Gap, Shrink, shown_horizon
from trms_cli.gap.differences import NewRecordings, differences
from trms_cli.gap.evidence import ChangeEvidence, DifferenceScore, judge
from trms_cli.gap.free_runs import (
    Errors,
    HorizonErrors,
    expected_errors,
    free_run_errors,
    joined_errors,
)
from trms_cli.gap.problem import GapProblem, Parts, divide, horizons_of
from trms_cli.identification.problem import with_values
from trms_cli.models.model import Model
from trms_cli.simulation.rollout import Rollout

#: Floors. Free runs that err by less are as good as those of a rig without a gap.
_AT_FLOOR = 1.25
#: Times that. A channel that errs by so much, or whose runs diverge, is ruined.
_RUINED = 1000.0
#: Resamples of blocks, and how far a refit has to stand above the floor for a gap to shrink.
_RESAMPLES, LEAST_GAP = 400, 1.05


@dataclass(frozen=True)
class Shrinkage:
    """Fields of a diagnosis that say how far."""

    gap: Mapping[str, Mapping[str, Gap]]  #: By channel and horizon
    shrink: Mapping[str, Mapping[str, Shrink]]  #: By channel, and ``all``, and horizon
    worse: tuple[str, ...]  #: Channels that the correction made worse at :attr:`told_at`

    @property
    def told_at(self) -> str:
        """The horizon at which a channel is judged worse, and that a sentence tells: 2 s."""
        horizons = {h for gaps in self.gap.values() for h in gaps}
        return shown_horizon(horizons | set(self.shrink.get("all", ())))

    @property
    def leaves_more(self) -> bool:
        """Whether the corrected model errs more than the refitted one, over all channels."""
        told = self.shrink["all"].get(self.told_at)
        return told is not None and told.fraction is not None and told.fraction < 0


class SealedRuns:
    """Free runs of models on the sealed part, each model's made once."""

    def __init__(self, problem: GapProblem, parts: Parts) -> None:
        self._problem, self._parts = problem, parts
        self._options: dict[str, Any] = {"block": parts.block, "jobs": problem.jobs}
        self._options["horizons"] = horizons_of(problem.model)
        self._errors: dict[Model, Errors] = {}
        self._floors: dict[Model, Errors] = {}

    def errors(self, model: Model, rollout: Rollout | None = None) -> Errors:
        """By channel and horizon; ``rollout``: of the model's structure, where one is at hand."""
        own = self._parts
        if model not in self._errors:
            self._errors[model] = free_run_errors(
                model, own.whole, own.sealed, rollout=rollout, **self._options
            )
        return self._errors[model]

    def floor(self, model: Model, rollout: Rollout | None = None) -> Errors:
        """What a model leaves of its own simulation, seen through the sensors' noise."""
        own, seed = self._parts, self._problem.seed
        if model not in self._floors:
            self._floors[model] = expected_errors(
                model, own.whole, own.sealed, seed=seed, rollout=rollout, **self._options
            )
        return self._floors[model]


def farthest_errors(errors: Errors, floor: Errors, stray: Mapping[str, float]) -> FloatArray:
    """Error of each channel at the longest horizon, in floors, (c,); NaN where there is no floor.

    ``stray``: by channel, by which free runs of any rig stray at that horizon; it widens the floor.
    """
    ratios = []
    for channel, by_horizon in errors.items():
        longest = max(by_horizon)
        least = float(np.hypot(floor[channel][longest].rms, stray[channel]))
        ratios.append(by_horizon[longest].rms / least if least > 0 else np.nan)
    return np.array(ratios)


def harm(before: Errors, after: Errors, floor: Errors, stray: Mapping[str, float]) -> float:
    """Largest factor by which a channel's error at the longest horizon grows, as a logarithm.

    Errors below :data:`_AT_FLOOR` are alike; ``stray`` as of :func:`farthest_errors`. NaN where
    there is none.
    """
    log_factors = []
    for channel, by_horizon in before.items():
        longest = max(by_horizon)
        least = _AT_FLOOR * float(np.hypot(floor[channel][longest].rms, stray[channel]))
        if least > 0:
            one, other = (e[channel][longest].rms / least for e in (before, after))
            log_factors.append(
                float(np.log(np.clip(other, 1.0, _RUINED) / np.clip(one, 1.0, _RUINED)))
            )
    return max(log_factors, default=float("nan"))


def measure_shrinkage(
    problem: GapProblem,
    parts: Parts,
    raw: Model,
    refit: Model,
    corrected: Model,
    rollouts: tuple[Rollout | None, Rollout | None] = (None, None),
    runs: SealedRuns | None = None,
    turns: tuple[Errors, Errors] | None = None,
) -> Shrinkage:
    """Free runs of three models on the sealed part.

    The floor is what the corrected model would leave of its own simulation, seen through the
    declared noise.

    ``rollouts``: of the refitted and of the corrected model's structure, where they are at hand.
    ``runs``: that may have been made. ``turns``: of the refitted and of the corrected model on
    blocks that were sealed in turn, where a sealed part of few blocks does not tell its scatter.
    """
    runs = runs or SealedRuns(problem, parts)
    plain, richer = rollouts
    before = runs.errors(refit, plain)
    after = before if corrected is refit else runs.errors(corrected, richer)
    errors = {"raw": runs.errors(raw, plain), "refit": before, "corrected": after}
    right = runs.floor(corrected, plain if corrected is refit else richer)
    units = {s.name: s.unit for d in parts.whole for s in d.outputs}
    speeds = set(problem.model.rotor_speeds.values())
    gap: dict[str, dict[str, Gap]] = {}
    shrink: dict[str, dict[str, Shrink]] = {}
    pairs: dict[str, dict[str, _Pair]] = {}
    for channel, by_horizon in before.items():
        for horizon, reference in by_horizon.items():
            key = repr(float(horizon))
            floor = right[channel][horizon].rms
            figures = {name: e[channel][horizon].rms for name, e in errors.items()}
            gap.setdefault(channel, {})[key] = Gap(**figures, floor=floor, unit=units[channel])
            own = _Pair.of(reference, after[channel][horizon], floor)
            if turns is not None and horizon in turns[0].get(channel, {}):
                one, other = (turn[channel][horizon] for turn in turns)
                own = own.beside(_Pair.of(one, other, floor))
            pairs.setdefault(key, {})[channel] = own
            shrink.setdefault(channel, {})[key] = _pooled_shrink(
                [own], [channel in speeds], problem.seed
            )
    shrink["all"] = {
        key: _pooled_shrink(list(p.values()), [name in speeds for name in p], problem.seed)
        for key, p in pairs.items()
    }
    shrinkage = Shrinkage(gap, shrink, ())
    at = shrinkage.told_at
    worse = (n for n, table in gap.items() if at in table and table[at].is_worse)
    return replace(shrinkage, worse=tuple(worse))


@dataclass(frozen=True)
class _Pair:
    """Squared errors of a channel at a horizon before and after, in floors squared."""

    squares: FloatArray  #: (2, m) array
    block: IntArray  #: (m,) array of int; from :data:`_IN_TURN` on those that were fitted

    @classmethod
    def of(cls, before: HorizonErrors, after: HorizonErrors, floor: float) -> _Pair:
        squares = np.stack([before.squared, after.squared]) / floor**2
        squares = np.minimum(squares, _DIVERGED**2)  # infinite where a run diverged
        return cls(squares, before.block)

    def beside(self, turns: _Pair) -> _Pair:
        """With blocks that were sealed in turn."""
        return _Pair(
            np.hstack([self.squares, turns.squares]),
            np.concatenate([self.block, turns.block + _IN_TURN]),
        )


#: Floors. Error of a run that diverged.
_DIVERGED = 1e6
#: Number of the first block that was sealed in turn.
_IN_TURN = 1_000_000


#: Standard deviations of the logarithm of a channel's error from one recording of a rig to another:
#: of what both models have in common, and of each one's own where they differ by the factor e^0.6
#: and more, in proportion below; degrees of freedom of Student's t; the share of it that tachos
#: have. Measured on 214 fresh recordings of rigs (docs/blind.md).
_COMMON, _OWN, _APART, _FREEDOM, _OF_TACHOS = 0.3, 0.35, 0.6, 4.0, 0.25


def _pooled_shrink(parts: Sequence[_Pair], is_speed: Sequence[bool], seed: int) -> Shrink:
    """Of channels together, blocks resampled in all at once.

    The share is that of sealed blocks. Its interval is that of another recording of the rig: as
    many blocks are drawn from all, and errors scaled as they differ between recordings, whose
    drives wander otherwise; how the share scatters about that of all is how it will there.
    """
    blocks = np.unique(np.concatenate([part.block for part in parts]))
    sums = np.zeros((len(parts), len(blocks), 2))
    counts = np.zeros((len(parts), len(blocks)))
    for i, part in enumerate(parts):
        at = np.searchsorted(blocks, part.block)
        counts[i] = np.bincount(at, minlength=len(blocks))
        for k in range(2):
            sums[i, :, k] = np.bincount(at, part.squares[k], len(blocks))

    def fraction(weights: FloatArray, factors: FloatArray | float = 1.0) -> float:
        with np.errstate(all="ignore"):
            means = factors * (weights @ sums) / (counts @ weights)[:, None]
            refit, corrected = np.sqrt(np.mean(means, axis=0))
            if not refit > LEAST_GAP:
                return np.nan
            # below the floor by chance is no more than all of the gap
            return float(min(1 - (corrected - 1) / (refit - 1), 1.0))

    is_sealed = blocks < _IN_TURN
    sealed_fraction = fraction(is_sealed.astype(float))
    overall_fraction = fraction(np.ones(len(blocks)))
    if not np.isfinite(sealed_fraction):
        return Shrink(fraction=None, ci95=None)
    random = np.random.default_rng(np.random.SeedSequence([seed, 0x5412]))
    even = np.full(len(blocks), 1 / len(blocks))
    draws = random.multinomial(np.count_nonzero(is_sealed), even, _RESAMPLES)
    with np.errstate(all="ignore"):
        ratio = np.abs(np.log(sums[..., 1].sum(axis=1) / sums[..., 0].sum(axis=1))) / 2
    differ = np.clip(np.nan_to_num(ratio, nan=np.inf) / _APART, 0.0, 1.0)[:, None]
    size = np.where(is_speed, _OF_TACHOS, 1.0)[:, None]
    tails = np.sqrt(_FREEDOM / random.chisquare(_FREEDOM, (_RESAMPLES, len(parts), 1)))
    common, own = (random.standard_normal((_RESAMPLES, len(parts), k)) for k in (1, 2))
    factors = np.exp(2 * size * tails * (_COMMON * common + _OWN * differ * own))
    fractions = np.array(
        [fraction(w.astype(float), f) for w, f in zip(draws, factors, strict=True)]
    )
    fractions = fractions[np.isfinite(fractions)]
    if len(blocks) < 2 or len(fractions) < _RESAMPLES / 2 or not np.isfinite(overall_fraction):
        return Shrink(fraction=sealed_fraction, ci95=None)
    low, high = np.quantile(fractions, [0.025, 0.975]) + sealed_fraction - overall_fraction
    return Shrink(
        fraction=sealed_fraction,
        ci95=(
            float(min(low, sealed_fraction)),
            float(np.clip(high, sealed_fraction, max(sealed_fraction, 1.0))),
        ),
    )


#: Blocks of a sealed part up to which those that were fitted are sealed in turn.
_FEW_BLOCKS = 3


def _in_turn(
    parts: Parts, refit: FittedModel, corrected: FittedModel, jobs: int
) -> tuple[Errors, Errors] | None:
    """Free runs of both on each fitted block, at the values that the others would give.

    To first order, so that no fit is made anew. None where the sealed part has blocks enough.
    """
    step = parts.whole[0].sample_time
    length = sum((end - begin) * step for _, begin, end in parts.sealed)
    if length >= (_FEW_BLOCKS + 1) * parts.block:
        return None
    windows = refit.structure.windows
    block_errors: list[list[tuple[str, float, HorizonErrors]]] = [[], []]
    acts = begins_at(corrected) or 0  # before, the corrected model is not the rig's
    for j in range(acts, len(windows)):
        begin = int(windows.first_in_recording[j])
        span = (int(windows.recording[j]), begin, begin + int(windows.count[j]))
        for fitted, own_errors in zip((refit, corrected), block_errors, strict=True):
            own = fitted.structure.windows.rollout
            errors = free_run_errors(
                fitted.without(j), parts.whole, [span], block=parts.block, rollout=own, jobs=jobs
            )
            own_errors += [  # as of one block of that number
                (name, horizon, replace(e, block=np.full_like(e.block, j)))
                for name, by_horizon in errors.items()
                for horizon, e in by_horizon.items()
            ]
    before, after = map(joined_errors, block_errors)
    return before, after


@dataclass(frozen=True)
class SealedComparison:
    """The opened seal."""

    shrinkage: Shrinkage
    #: ``raw``, ``refit``, and ``corrected`` where a cause is added, as their free runs were made
    models: Mapping[str, tuple[Model, Rollout]]


def sealed_comparison(
    problem: GapProblem,
    parts: Parts,
    refit: FittedModel,
    corrected: FittedModel | None,
    runs: SealedRuns,
) -> SealedComparison:
    """Free runs of the model as it was, refitted, and corrected where there is a cause."""
    plain = refit.structure.windows.rollout
    last, richer = refit.model, plain
    models = {"raw": (problem.model, plain), "refit": (refit.model, plain)}
    if corrected is not None:
        last, richer = corrected.model, corrected.structure.windows.rollout
        models["corrected"] = (last, richer)
    turns = None
    if corrected is not None and problem.effort != "quick":
        turns = _in_turn(parts, refit, corrected, problem.jobs)
    shrinkage = measure_shrinkage(
        problem, parts, problem.model, refit.model, last, (plain, richer), runs, turns
    )
    return SealedComparison(shrinkage, models)


#: s after an onset that must be left to estimate sizes from.
_LEAST_AFTER = 5.0


def change_shrinkage(
    problem: GapProblem, comparison: StateComparison, correction: DifferenceScore | None
) -> Shrinkage | None:
    """Free runs of the model as it was, of the known state's, and of that with the difference.

    ``correction``: what the corrected model has beyond the known state's; None: nothing. None where
    the recordings are too short to keep a part aside, or the difference begins within that part.
    """
    try:
        parts = divide(problem.datasets, problem.block, problem.sealed_share, problem.model.stops)
    except ConfigurationError:
        return None
    known_model = comparison.questioned.known_state.model
    corrected = known_model if correction is None else _corrected(comparison, parts, correction)
    if corrected is None:
        return None
    return measure_shrinkage(problem, parts, problem.model, known_model, corrected)


def _corrected(
    comparison: StateComparison, parts: Parts, correction: DifferenceScore
) -> Model | None:
    """The known state's model with the difference, of sizes that the sealed part has no say in."""
    known_state = comparison.questioned.known_state
    # nothing foretells what varies at random, and rounding is in no model
    if correction.varies or not correction.difference.families:
        return known_state.model
    if correction.began is not None:
        within = (
            parts.fitted[correction.recording] if correction.recording < len(parts.fitted) else None
        )
        if within is None or within.duration - correction.began.time_s < _LEAST_AFTER:
            return None
    name = correction.difference.name
    evidence = ChangeEvidence(NewRecordings.of(known_state, parts.fitted))
    again = differences(evidence.questioned, comparison.candidates, only={name})
    difference = next(iter(again), None)
    if difference is None:  # it diverges there
        return None
    score = judge(evidence, difference)
    if correction.difference.kind == "parameter":
        value = known_state.model.parameters[name].value + float(score.value[0])
        return with_values(known_state.model, {name: value})
    sizes = dict(zip(score.difference.labels, score.value.tolist(), strict=True))
    effect = stand_in(correction) or comparison.candidates[name].effect
    with_effect = extend_model(known_state.model, {name: effect})
    return with_values(with_effect, {f"{name}.{size}": value for size, value in sizes.items()})


def stand_in(score: DifferenceScore) -> ConstantTorque | None:
    """What a model has in place of a torque from outside; None for any other difference."""
    if score.difference.kind != "torque" or score.varies:
        return None
    axis = score.difference.name.split("_")[0]
    return ConstantTorque(axis=axis, torque=float(score.value[0]))
