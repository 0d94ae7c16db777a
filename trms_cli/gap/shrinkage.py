"""How far a gap shrank on the sealed part, that nothing was chosen on; intervals over blocks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from trms_cli.core.arrays import FloatArray, IntArray
from trms_cli.gap.blocks import Parts
from trms_cli.gap.diagnosis import Gap, Shrink
from trms_cli.gap.free_runs import Errors, expected_errors, free_run_errors
from trms_cli.gap.posterior import Posterior
from trms_cli.gap.problem import GapProblem
from trms_cli.gap.race import Race
from trms_cli.identification.problem import with_values
from trms_cli.models.model import Model
from trms_cli.simulation.rollout import Rollout

#: Resamples of blocks, and how far a refit has to stand above the floor for a gap to shrink.
_RESAMPLES, _LEAST_GAP = 400, 1.05
#: A channel that loses more than this of its error is worse.
_WORSE = 1.02
#: s. The horizon at which a channel is judged worse.
_TOLD_AT = 2.0
ALL = "all"


@dataclass(frozen=True)
class Shrinkage:
    """Fields of a diagnosis that say how far."""

    gap: Mapping[str, Mapping[str, Gap]]  #: By channel and horizon
    shrink: Mapping[str, Mapping[str, Shrink]]  #: By channel, and ``all``, and horizon
    worse: tuple[str, ...]  #: Channels that the correction made worse at 2 s


def measure_shrinkage(
    problem: GapProblem,
    parts: Parts,
    raw: Model,
    refit: Model,
    corrected: Model,
    rollouts: tuple[Rollout | None, Rollout | None] = (None, None),
) -> Shrinkage:
    """Free runs of three models on the sealed part.

    The floor is what the corrected model would leave of its own simulation, seen through the
    declared noise.

    ``rollouts``: of the refitted and of the corrected model's structure, where they are at hand.
    """
    options = {"block": parts.block, "jobs": problem.jobs}
    plain, richer = rollouts

    def runs(model: Model, rollout: Rollout | None) -> Errors:
        return free_run_errors(
            model,
            parts.whole,
            parts.sealed,
            rollout=rollout,
            **options,  # type: ignore[arg-type]
        )

    before = after = runs(refit, plain)
    if corrected is not refit:
        after = runs(corrected, richer)
    errors = {"raw": runs(raw, plain), "refit": before, "corrected": after}
    right = expected_errors(
        corrected,
        parts.whole,
        parts.sealed,
        seed=problem.seed,
        rollout=plain if corrected is refit else richer,
        **options,  # type: ignore[arg-type]
    )
    units = {s.name: s.unit for d in parts.whole for s in d.outputs}
    gap: dict[str, dict[str, Gap]] = {}
    shrink: dict[str, dict[str, Shrink]] = {}
    pooled: dict[str, list[tuple[FloatArray, IntArray]]] = {}
    for channel, by_horizon in before.items():
        for horizon, reference in by_horizon.items():
            key = repr(float(horizon))
            floor = right[channel][horizon].rms
            figures = {name: e[channel][horizon].rms for name, e in errors.items()}
            gap.setdefault(channel, {})[key] = Gap(**figures, floor=floor, unit=units[channel])
            squares = np.stack([reference.squared, after[channel][horizon].squared])
            pooled.setdefault(key, []).append((squares / floor**2, reference.block))
            shrunk = _shrink(squares / floor**2, reference.block, problem.seed)
            shrink.setdefault(channel, {})[key] = shrunk
    shrink[ALL] = {key: _pooled(parts, problem.seed) for key, parts in pooled.items()}
    told = repr(_TOLD_AT)
    worse = tuple(
        channel
        for channel, table in gap.items()
        if told in table and table[told].corrected > _WORSE * table[told].refit
    )
    return Shrinkage(gap, shrink, worse)


def _shrink(squares: FloatArray, block: IntArray, seed: int) -> Shrink:
    """Of one channel; squares (2, m) before and after, in floors squared."""
    return _pooled([(squares, block)], seed)


def _pooled(parts: Sequence[tuple[FloatArray, IntArray]], seed: int) -> Shrink:
    """Of channels together, each in units of its floor, blocks resampled in all at once."""
    blocks = np.unique(np.concatenate([block for _, block in parts]))
    sums = np.zeros((len(parts), len(blocks), 2))
    counts = np.zeros((len(parts), len(blocks)))
    for i, (squares, block) in enumerate(parts):
        at = np.searchsorted(blocks, block)
        counts[i] = np.bincount(at, minlength=len(blocks))
        for k in range(2):
            sums[i, :, k] = np.bincount(at, squares[k], len(blocks))

    def fraction(weights: FloatArray) -> float:
        with np.errstate(all="ignore"):
            means = (weights @ sums) / (counts @ weights)[:, None]
            refit, corrected = np.sqrt(np.mean(means, axis=0))
            return float(1 - (corrected - 1) / (refit - 1)) if refit > _LEAST_GAP else np.nan

    whole = fraction(np.ones(len(blocks)))
    if not np.isfinite(whole):
        return Shrink(fraction=None, ci95=None)
    random = np.random.default_rng(np.random.SeedSequence([seed, 0x5412]))
    drawn = random.multinomial(len(blocks), np.full(len(blocks), 1 / len(blocks)), _RESAMPLES)
    found = np.array([fraction(w.astype(float)) for w in drawn])
    found = found[np.isfinite(found)]
    if len(blocks) < 2 or len(found) < _RESAMPLES / 2:
        return Shrink(fraction=whole, ci95=None)
    low, high = np.quantile(found, [0.025, 0.975])
    return Shrink(fraction=whole, ci95=(float(low), float(high)))


@dataclass(frozen=True)
class SealedComparison:
    """The opened seal."""

    shrinkage: Shrinkage
    raw: Model  #: As their free runs were made
    refit: Model  #: As their free runs were made
    corrected: Model  #: As their free runs were made
    plain: Rollout  #: Of the first two, and of the last
    richer: Rollout  #: Of the first two, and of the last


def sealed_comparison(
    problem: GapProblem, parts: Parts, race: Race, posterior: Posterior
) -> SealedComparison:
    """Free runs of the model as it was, refitted, and corrected."""
    refit = race.refit
    fitted = with_values(problem.model, refit.structure.values(refit.fit.theta))
    corrected = fitted
    plain = richer = refit.structure.windows.rollout
    if posterior.corrected is not None:
        entry = posterior.corrected
        corrected = with_values(
            entry.structure.problem.model, entry.structure.values(entry.fit.theta)
        )
        richer = entry.structure.windows.rollout
    measured = measure_shrinkage(problem, parts, problem.model, fitted, corrected, (plain, richer))
    return SealedComparison(measured, problem.model, fitted, corrected, plain, richer)
