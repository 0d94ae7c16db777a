"""Which effect it is: the short list fitted, steps to combinations, all compared alike."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from threading import Lock
from typing import Any, TypeVar

import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.gap.candidates import CandidateEffect
from trms_cli.gap.discrepancy import FLOOR
from trms_cli.gap.fitting import FittedModel, ModelStructure, Refit
from trms_cli.gap.separability import EffectTraces, Signatures, projected

Item = TypeVar("Item")
Made = TypeVar("Made")

#: A tighter metric than the refit's own: what an effect does is not excused as discrepancy there.
_TIGHTER = 3.0
#: Nats. An effect whose trace, at the best of its sizes, promises less is not fitted.
_HOPELESS = 1.5
#: Nats of held-out prediction that another effect must add to be taken in.
_ENTRANCE = 6.0


@dataclass(frozen=True)
class Effort:
    """How many are fitted."""

    listed: int  #: singles
    finalists: int  #: fitted in a metric of their own
    pairs: int  #: partners tried beside the best single
    deepest: int  #: effects together at most


EFFORTS = {
    "quick": Effort(5, 3, 2, 2),
    "normal": Effort(9, 5, 4, 2),
    "thorough": Effort(18, 8, 8, 3),
}


@dataclass(frozen=True)
class Race:
    """All that raced, best first."""

    refit: Refit
    #: With one effect or several, each in the metric that is most likely for itself
    entries: tuple[FittedModel, ...]
    signatures: Signatures  #: In the refit's metric
    tight: Signatures  #: In the tighter one


class Checkpoint:
    """Where searches ended, so that an interrupted diagnosis goes on instead of beginning again.

    ``kept``: what an interrupted diagnosis had kept. ``keep``: told everything whenever something
    is added, as JSON has it.
    """

    def __init__(
        self,
        kept: Mapping[str, Any] | None = None,
        keep: Callable[[Mapping[str, Any]], None] = lambda everything: None,
    ) -> None:
        self._points: dict[str, Any] = dict(kept or {})
        self._keep = keep
        self._lock = Lock()

    def point(self, key: str) -> tuple[FloatArray, FloatArray, FloatArray] | None:
        """Parameters, starts and sizes of the discrepancy under a key; None: not there yet."""
        known = self._points.get(key)
        if known is None:
            return None
        return tuple(np.array(known[name]) for name in ("theta", "starts", "shares"))  # type: ignore[return-value]

    def add(self, key: str, fitted: FittedModel) -> None:
        """Note where a search ended."""
        with self._lock:
            self._points[key] = {
                "theta": fitted.fit.theta.tolist(),
                "starts": fitted.fit.starts.tolist(),
                "shares": fitted.metric.shares.tolist(),
            }
            self._keep(self._points)


def run_race(
    refit: Refit,
    candidates: Mapping[str, CandidateEffect],
    traces: EffectTraces,
    effort: Effort,
    *,
    checkpoint: Checkpoint | None = None,
    jobs: int = 1,
    watch: Callable[[float, str], bool] = lambda fraction, message: True,
) -> Race:
    """Run the race.

    ``candidates``: none that noise drives. ``traces``: of all candidates about the refit.
    ``checkpoint``: of fits that an interrupted race had finished. ``jobs``: threads. ``watch``:
    told the share that is done and what is being done; False stops with what there is.
    """
    checkpoint = checkpoint or Checkpoint()
    shares = np.maximum(FLOOR, refit.metric.shares / _TIGHTER)
    wide_signs = projected(refit, traces)
    tight = replace(refit.metric, shares=shares)
    tight_signs = projected(replace(refit, metric=tight), traces)
    listed = short_list((tight_signs, wide_signs), candidates, effort.listed)
    worth = [n for n in listed if max(s.best(n)[0] for s in (tight_signs, wide_signs)) > _HOPELESS]
    listed = worth or listed[:1]
    middle = replace(refit.metric, shares=np.sqrt(shares * refit.metric.shares))

    def once(key: str, structure: ModelStructure, search: Callable[[], FittedModel]) -> FittedModel:
        """What a search finds, or where it had ended before the race was interrupted."""
        known = checkpoint.point(key)
        if known is None:
            made = search()
            checkpoint.add(key, made)
            return made
        theta, starts, shares = known
        metric = replace(refit.metric, shares=shares)
        return structure.fit(metric, [(theta, starts)], centres=refit.centres, iterations=0)

    def single(name: str) -> FittedModel:
        candidate = candidates[name]
        structure = refit.structure.with_effects(candidate)

        def search() -> FittedModel:
            points = _points(structure, candidate, refit, (tight_signs, wide_signs))
            return structure.fit(
                middle, points, centres=refit.centres, iterations=12, tolerance=0.5
            )

        return once(f"single {name}", structure, search)

    refit_score = refit.refitted(middle, iterations=5).fit.score
    entries = _each(single, listed, jobs, watch, 0.0, 0.55, "fitting {}")
    entries.sort(key=lambda e: -e.fit.score)
    finals = entries[: effort.finalists]

    def final(entry: FittedModel) -> FittedModel:
        key = "final " + "+".join(entry.names)
        return once(key, entry.structure, lambda: assessed(entry))

    def assessed(entry: FittedModel) -> FittedModel:
        if entry.fit.score < refit_score + _ENTRANCE / 2:
            # it explains nothing: the discrepancy that it leaves is the refit's
            return entry.refitted(refit.metric, iterations=4, tolerance=0.5)
        return entry.in_own_metric()

    finals = _each(final, finals, jobs, watch, 0.55, 0.75, "comparing")
    finals.sort(key=lambda e: -e.fit.score)
    joint: list[FittedModel] = []
    best = finals[0] if finals else None
    while best is not None and len(best.names) < effort.deepest:
        # effects whose traces point at what the best leaves over
        signs = projected(best, traces)
        others = {n: s for n, s in candidates.items() if n not in best.names}
        listed = short_list((signs,), others, effort.pairs)
        partners = [name for name in listed if signs.best(name)[0] > _ENTRANCE]

        def pair(name: str, base: FittedModel = best, signs: Signatures = signs) -> FittedModel:
            effects = (*base.structure.effects, candidates[name])
            structure = refit.structure.with_effects(*effects)
            return once(
                "joint " + "+".join((*base.names, name)),
                structure,
                lambda: _paired(base, candidates[name], signs, structure),
            )

        made = _each(pair, partners, jobs, watch, 0.75, 0.95, "beside " + "+".join(best.names))
        if not made:
            break
        made.sort(key=lambda e: -e.fit.score)
        joint += made
        if made[0].fit.score < best.fit.score + _ENTRANCE:
            break
        best = made[0]
    everyone = finals + joint
    everyone.sort(key=lambda e: -e.fit.score)
    return Race(refit, tuple(everyone), wide_signs, tight_signs)


def short_list(
    signs: Sequence[Signatures], candidates: Mapping[str, CandidateEffect], count: int
) -> list[str]:
    """The most promising by any of some metrics, in turn, so that each has its say."""
    orders = [
        sorted(
            (name for name in candidates if len(sign.rows(name))),
            key=lambda name, sign=sign: -sign.best(name)[0],  # type: ignore[misc]
        )
        for sign in signs
    ]
    chosen: list[str] = []
    for places in zip(*orders, strict=True):
        for name in places:
            if name not in chosen and len(chosen) < count:
                chosen.append(name)
    return chosen


def _points(
    structure: ModelStructure, candidate: CandidateEffect, refit: Refit, signs: Sequence[Signatures]
) -> list[tuple[FloatArray, FloatArray]]:
    """Where searches begin: the refit's optimum and the priors' centre, sizes as screened."""
    prior = {p.name: p.prior_mean for p in refit.structure.problem.free}
    points = []
    for values, sign in ((refit.values, signs[0]), (prior, signs[-1])):
        theta = structure.theta({**values, **_promising_sizes(candidate, sign, 0.3)})
        points.append((theta, structure.starts(theta, refit.fit.starts)))
    return points


def _promising_sizes(
    candidate: CandidateEffect, sign: Signatures, least: float
) -> dict[str, float]:
    """Sizes at which the trace explains most of what is left over, by name.

    Of the most promising row those that can make the effect vanish are scaled, by ``least`` to two
    times, within their bounds.
    """
    _, row = sign.best(candidate.name)
    by = float(np.clip(sign.towards[row] / max(sign.left[row], 1e-12), least, 2.0))
    sizes = {}
    for i, (free, size) in enumerate(zip(candidate.free, sign.sizes[row], strict=True)):
        scaled = i == 0 or free.prior_mean == 0.0
        sizes[free.name] = float(np.clip(size * by, free.lower, free.upper) if scaled else size)
    return sizes


def _paired(
    best: FittedModel, partner: CandidateEffect, signs: Signatures, structure: ModelStructure
) -> FittedModel:
    sizes = _promising_sizes(partner, signs, 0.2)
    theta = structure.theta({**best.values, **sizes})
    starts = structure.starts(theta, best.fit.starts[:, : best.centres.shape[1]])
    fitted = structure.fit(
        best.metric, [(theta, starts)], centres=best.centres, iterations=12, tolerance=0.5
    )
    return fitted.in_own_metric()


def _each(
    work: Callable[[Item], Made],
    items: Sequence[Item],
    jobs: int,
    watch: Callable[[float, str], bool],
    low: float,
    high: float,
    message: str,
) -> list[Made]:
    """The work on each item, in threads; compiled loops let go of the interpreter's lock."""
    if not watch(low, message.format(items[0] if items else "")):
        return []

    def guarded(item: Item) -> Made | None:
        # A model that can no longer be reckoned with is no competitor, and no reason to stop.
        try:
            return work(item)
        except (FloatingPointError, np.linalg.LinAlgError):
            return None

    with ThreadPoolExecutor(max(1, jobs)) as pool:
        made: list[Made] = []
        for k, result in enumerate(pool.map(guarded, items)):
            if result is not None:
                made.append(result)
            if not watch(low + (high - low) * (k + 1) / len(items), message.format(items[k])):
                pool.shutdown(wait=True, cancel_futures=True)
                break
    return made
