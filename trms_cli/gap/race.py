"""Which effect it is: the short list fitted, steps to combinations, all compared alike."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from threading import Lock
from typing import Any, TypeVar

import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.gap.candidates import CandidateEffect
from trms_cli.gap.discrepancy import FLOOR
from trms_cli.gap.fitting import CandidateFit, Metric, ModelStructure, Refit, own_metric
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
class RacedCandidate:
    """One that raced."""

    structure: ModelStructure
    fit: CandidateFit  #: In the metric that is most likely for itself
    metric: Metric

    @property
    def names(self) -> tuple[str, ...]:
        return self.structure.names


@dataclass(frozen=True)
class Race:
    """All that raced, best first."""

    refit: Refit
    entries: tuple[RacedCandidate, ...]  #: With one effect or several
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

    def add(self, key: str, fit: CandidateFit, metric: Metric) -> None:
        """Note where a search ended."""
        with self._lock:
            self._points[key] = {
                "theta": fit.theta.tolist(),
                "starts": fit.starts.tolist(),
                "shares": metric.shares.tolist(),
            }
            self._keep(self._points)


class StructureCache:
    """Makes each structure once.

    ``block``: s.
    """

    def __init__(self, refit: Refit, block: float) -> None:
        self._refit, self._block = refit, block
        self._known: dict[tuple[str, ...], ModelStructure] = {}

    def of(self, *effects: CandidateEffect) -> ModelStructure:
        """The structure with some effects."""
        key = tuple(sorted(e.name for e in effects))
        if key not in self._known:
            nominal = self._refit.structure
            self._known[key] = ModelStructure(
                nominal.problem.model,
                nominal.problem.free,
                sorted(effects, key=lambda e: e.name),
                nominal.problem.datasets,
                self._block,
            )
        return self._known[key]


def run_race(
    refit: Refit,
    candidates: Mapping[str, CandidateEffect],
    traces: EffectTraces,
    structures: StructureCache,
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
    nominal, discrepancy, robust = refit.structure, refit.metric.discrepancy, refit.metric.robust
    shares = np.maximum(FLOOR, refit.metric.shares / _TIGHTER)
    tight = Metric(discrepancy, shares, robust)
    wide_signs = projected(nominal, refit.fit, refit.metric, refit.centres, traces)
    tight_signs = projected(nominal, refit.fit, tight, refit.centres, traces)
    listed = short_list((tight_signs, wide_signs), candidates, effort.listed)
    worth = [n for n in listed if max(s.best(n)[0] for s in (tight_signs, wide_signs)) > _HOPELESS]
    listed = worth or listed[:1]
    middle = Metric(discrepancy, np.sqrt(shares * refit.metric.shares), robust)

    def once(
        key: str, structure: ModelStructure, search: Callable[[], RacedCandidate]
    ) -> RacedCandidate:
        """What a search finds, or where it had ended before the race was interrupted."""
        known = checkpoint.point(key)
        if known is None:
            made = search()
            checkpoint.add(key, made.fit, made.metric)
            return made
        theta, starts, shares = known
        metric = Metric(discrepancy, shares, robust)
        fit = structure.fit(metric, [(theta, starts)], centres=refit.centres, iterations=0)
        return RacedCandidate(structure, fit, metric)

    def single(name: str) -> RacedCandidate:
        candidate = candidates[name]
        structure = structures.of(candidate)

        def search() -> RacedCandidate:
            points = _points(structure, candidate, refit, (tight_signs, wide_signs))
            fit = structure.fit(middle, points, centres=refit.centres, iterations=12, tolerance=0.5)
            return RacedCandidate(structure, fit, middle)

        return once(f"single {name}", structure, search)

    alone = nominal.fit(
        middle, [(refit.fit.theta, refit.fit.starts)], centres=refit.centres, iterations=5
    )
    refit_score = alone.score
    entries = _each(single, listed, jobs, watch, 0.0, 0.55, "fitting {}")
    entries.sort(key=lambda e: -e.fit.score)
    finals = entries[: effort.finalists]

    def final(entry: RacedCandidate) -> RacedCandidate:
        key = "final " + "+".join(entry.names)
        return once(key, entry.structure, lambda: assessed(entry))

    def assessed(entry: RacedCandidate) -> RacedCandidate:
        if entry.fit.score < refit_score + _ENTRANCE / 2:
            # it explains nothing: the discrepancy that it leaves is the refit's
            point = (entry.fit.theta, entry.fit.starts)
            again = entry.structure.fit(
                refit.metric, [point], centres=refit.centres, iterations=4, tolerance=0.5
            )
            return RacedCandidate(entry.structure, again, refit.metric)
        return RacedCandidate(
            entry.structure, *own_metric(entry.structure, entry.fit, entry.metric, refit.centres)
        )

    finals = _each(final, finals, jobs, watch, 0.55, 0.75, "comparing")
    finals.sort(key=lambda e: -e.fit.score)
    joint: list[RacedCandidate] = []
    best = finals[0] if finals else None
    while best is not None and len(best.names) < effort.deepest:
        partners = _partners(best, refit, traces, candidates, effort.pairs)

        def pair(name: str, base: RacedCandidate = best) -> RacedCandidate:
            structure = structures.of(*base.structure.effects, candidates[name])
            return once(
                "joint " + "+".join((*base.names, name)),
                structure,
                lambda: _paired(base, candidates[name], refit, traces, structure),
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
    nominal = refit.structure.values(refit.fit.theta)
    prior = {p.name: p.prior_mean for p in refit.structure.problem.free}
    points = []
    rows = []
    for sign in signs:
        _, row = sign.best(candidate.name)
        by = float(np.clip(sign.towards[row] / max(sign.left[row], 1e-12), 0.3, 2.0))
        sizes = np.array(sign.sizes[row], dtype=float)
        rows.append(_scaled(candidate, sizes, by))
    for values, sizes in ((nominal, rows[0]), (prior, rows[-1])):
        own = {f.name: float(v) for f, v in zip(candidate.free, sizes, strict=True)}
        theta = structure.theta({**values, **own})
        points.append((theta, structure.starts(theta, refit.fit.starts)))
    return points


def _scaled(candidate: CandidateEffect, sizes: FloatArray, by: float) -> FloatArray:
    """The sizes that can make the effect vanish, scaled; within bounds."""
    scaled = sizes.copy()
    for i, free in enumerate(candidate.free):
        if i == 0 or free.prior_mean == 0.0:
            scaled[i] = np.clip(sizes[i] * by, free.lower, free.upper)
    return scaled


def _partners(
    best: RacedCandidate,
    refit: Refit,
    traces: EffectTraces,
    candidates: Mapping[str, CandidateEffect],
    count: int,
) -> list[str]:
    """Effects whose traces point at what the best leaves over."""
    signs = projected(best.structure, best.fit, best.metric, refit.centres, traces)
    others = {n: s for n, s in candidates.items() if n not in best.names}
    listed = short_list((signs,), others, count)
    return [name for name in listed if signs.best(name)[0] > _ENTRANCE]


def _paired(
    best: RacedCandidate,
    partner: CandidateEffect,
    refit: Refit,
    traces: EffectTraces,
    structure: ModelStructure,
) -> RacedCandidate:
    signs = projected(best.structure, best.fit, best.metric, refit.centres, traces)
    _, row = signs.best(partner.name)
    by = float(np.clip(signs.towards[row] / max(signs.left[row], 1e-12), 0.2, 2.0))
    sizes = _scaled(partner, np.array(signs.sizes[row], dtype=float), by)
    own = {f.name: float(v) for f, v in zip(partner.free, sizes, strict=True)}
    theta = structure.theta({**best.structure.values(best.fit.theta), **own})
    starts = structure.starts(theta, best.fit.starts[:, : refit.centres.shape[1]])
    fit = structure.fit(
        best.metric, [(theta, starts)], centres=refit.centres, iterations=12, tolerance=0.5
    )
    return RacedCandidate(structure, *own_metric(structure, fit, best.metric, refit.centres))


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
