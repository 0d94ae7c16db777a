"""Which effect it is: the short list fitted, steps to combinations, all compared alike.

The short list comes of the trace that each effect leaves and no refit of the parameters can. For
every effect at a few sizes the change of the outputs is simulated along the recorded inputs, made
white, and freed of all that other windows' starts and nominal parameters within their priors could
do as well. What is left says how large an effect must be to be seen, and which effects leave the
same trace: before anything is fitted, and without looking at what the rig answered but for the
trajectory about which the noise is propagated.
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import zip_longest
from threading import Lock
from typing import Any, TypeVar

import numpy as np

from trms_cli.core.arrays import FloatArray, IntArray
from trms_cli.gap.competing_model import FittedModel, Metric, ModelStructure, Refit
from trms_cli.gap.discrepancy import FLOOR, FilterGains, LinearSystem, whiten
from trms_cli.gap.problem import CandidateEffect

#: Windows whose columns are whitened at a time.
_AT_ONCE = 12
#: Standard deviations of its projected trace at which an effect counts as visible.
_VISIBLE = 5.0


#: Traces nearer to each other than this cosine make no pair.
_PARALLEL = 0.98
#: Rows of each effect that are looked at in pairs.
_ROWS = 3


@dataclass(frozen=True)
class Signatures:
    """Projected traces of effects."""

    names: tuple[str, ...]  #: Of the effect of each row
    sizes: tuple[FloatArray, ...]  #: tuple of (n_s,) arrays; at which each row was simulated
    energy: FloatArray  #: (k,) array; squared length of each trace, in noise variances
    left: FloatArray  #: (k,) array; the same after projection
    #: (k,) array; inner product of each projected trace with what the nominal fit left over: the
    #: residual is best explained by ``towards/left`` times the row's change
    towards: FloatArray
    cosine: FloatArray  #: (k, k) array; between projected traces

    @property
    def gain(self) -> FloatArray:
        """Nats by which each row lowers the cost, its change taken up to three times, (k,)."""
        left = np.maximum(self.left, 1e-12)
        by = np.clip(self.towards / left, 0.0, 3.0)
        gain: FloatArray = by * self.towards - 0.5 * by**2 * left
        return np.maximum(gain, 0.0)

    def pairs(self, least: float) -> list[tuple[float, int, int]]:
        """Pairs of rows of two effects, best first, each pair of effects once.

        Each with the nats by which both together lower the cost and their rows; only pairs that
        promise ``least`` nats more than either of them alone. Where one of the two would have to
        act backwards or beyond three times its size they are no pair.
        """
        rows = np.array([r for n in dict.fromkeys(self.names) for r in self._promising(n)])
        length = np.sqrt(self.left[rows])
        towards, cosine = self.towards[rows] / length, self.cosine[np.ix_(rows, rows)]
        with np.errstate(all="ignore"):
            turned = 1 / (1 - cosine**2)
            by = (towards[:, None] - cosine * towards[None, :]) * turned  # (i, j): size of i
            together = 0.5 * (by * towards[:, None] + by.T * towards[None, :])
        multiple = by / length[:, None]
        alone = self.gain[rows]
        fine = (multiple > 0) & (multiple < 3) & (np.abs(cosine) < _PARALLEL)
        fine &= fine.T & (together > np.maximum(alone[:, None], alone[None, :]) + least)
        found: dict[frozenset[str], tuple[float, int, int]] = {}
        for i, j in np.argwhere(np.triu(fine, 1)):
            key = frozenset((self.names[rows[i]], self.names[rows[j]]))
            gain = float(together[i, j])
            if len(key) == 2 and gain > found.get(key, (0.0,))[0]:
                found[key] = (gain, int(rows[i]), int(rows[j]))
        return sorted(found.values(), reverse=True)

    def _promising(self, name: str) -> IntArray:
        """Rows of an effect that are worth a look beside another one."""
        rows = self.rows(name)
        return rows[np.argsort(-self.gain[rows] - 1e-9 * self.towards[rows])][:_ROWS]

    def rows(self, name: str) -> IntArray:
        """Rows of an effect."""
        return np.flatnonzero([other == name for other in self.names])

    def best(self, name: str) -> tuple[float, int]:
        """Largest gain of an effect, nats, and its row."""
        rows = self.rows(name)
        row = int(rows[np.argmax(self.gain[rows])])
        return float(self.gain[row]), row

    def absorbed(self, name: str) -> float:
        """Share of the trace that a refit would take, of the row that is absorbed least."""
        rows = self.rows(name)
        energy = np.maximum(self.energy[rows], 1e-12)
        return float(np.clip(1 - np.max(self.left[rows] / energy), 0.0, 1.0))

    def least_size(self, name: str) -> float | None:
        """Smallest value of the first size that would show, None where none of those tried does.

        Traces are not proportional to sizes (a dead zone, a friction that holds): the smallest
        tried size that is visible is scaled down by what it exceeds the threshold.
        """
        found = []
        for row in self.rows(name):
            size, length = abs(self.sizes[row][0]), np.sqrt(max(self.left[row], 0.0))
            if size > 0 and length > 0:
                found.append((size, length))
        visible = [(size, length) for size, length in found if length >= _VISIBLE]
        if visible:
            size, length = min(visible)
            return float(size * _VISIBLE / length)
        return None

    def alike(self, one: str, other: str) -> float:
        """Largest cosine between traces of two effects, at the sizes that they share best."""
        block = self.cosine[np.ix_(self.rows(one), self.rows(other))]
        return float(np.max(np.abs(block)))


@dataclass(frozen=True)
class EffectTraces:
    """What each effect changes in the outputs when it is added to a fitted model."""

    names: tuple[str, ...]  #: Of the effect of each row
    sizes: tuple[FloatArray, ...]  #: tuple of (n_s,) arrays
    changes: FloatArray  #: (k, m, c, n_y) array


def effect_traces(
    nominal: FittedModel,
    candidates: Sequence[CandidateEffect],
    *,
    watch: Callable[[int], bool] = lambda k: True,
) -> EffectTraces:
    """Simulate every effect at a few sizes, all else as fitted without it.

    ``nominal``: without any of the candidates, none of which noise drives. ``watch``: told how
    many candidates are done; False stops.
    """
    p = nominal.structure.problem.all_values(nominal.fit.theta)
    base = nominal.structure.windows.residuals(p, nominal.fit.starts).r
    theta = nominal.values
    changes: list[FloatArray] = []
    names: list[str] = []
    sizes: list[FloatArray] = []
    for k, candidate in enumerate(candidates):
        if not watch(k):
            break
        structure = nominal.structure.with_effects(candidate)
        for row in candidate.variants:
            own = {f.name: v for f, v in zip(candidate.free, row, strict=True)}
            vector = structure.theta({**theta, **own})
            starts = structure.starts(vector, nominal.fit.starts)
            with np.errstate(all="ignore"):
                r = structure.windows.residuals(structure.problem.all_values(vector), starts).r
            if np.isfinite(r).all():
                changes.append(r - base)
                names.append(candidate.name)
                sizes.append(row)
    return EffectTraces(tuple(names), tuple(sizes), np.array(changes).reshape(-1, *base.shape))


def project_traces(fitted: FittedModel, traces: EffectTraces) -> Signatures:
    """Traces, freed of what the starts and parameters of a fitted model could do as well.

    ``fitted``: the nominal model, or one with an effect: then its sizes are among the parameters.
    """
    fit, objective, windows = fitted.fit, fitted.objective, fitted.structure.windows
    point = fit.point
    residuals = objective.simulated(point, fit.starts, slopes=True)
    base, slopes = residuals.r, objective.slopes(residuals)
    slopes = np.where(np.isfinite(slopes), slopes, 0.0)
    scales = np.concatenate([windows.spread, objective.scales])
    n, n_f, count = windows.n_x, len(point), len(traces.names)
    total = np.zeros((n_f + count + 1, n_f + count + 1))
    raw = np.zeros(count)
    gaps = (fit.starts - objective.centres) / windows.spread
    for j in range(0, len(windows), _AT_ONCE):
        rows = slice(j, j + _AT_ONCE)
        changes = np.moveaxis(traces.changes[:, rows], 0, -1)
        parts = [slopes[rows] * scales, changes, base[rows][..., None]]
        white = _part(fitted.metric, rows, np.concatenate(parts, axis=-1))
        flat = white.reshape(white.shape[0], -1, white.shape[-1])
        gram = np.swapaxes(flat, 1, 2) @ flat
        own = gram[:, :n, :n] + np.eye(n)
        across = gram[:, :n, n:].copy()
        across[..., -1] += gaps[rows]
        inner = gram[:, n:, n:] - np.swapaxes(across, 1, 2) @ np.linalg.solve(own, across)
        total += inner.sum(axis=0)
        raw += np.einsum("mii->i", gram[:, n + n_f : -1, n + n_f : -1])
    root = objective.precisions * objective.scales
    across = total[:n_f, n_f:].copy()
    across[:, -1] += root * (point - objective.means)
    inner = total[:n_f, :n_f] + np.diag(root * objective.scales)
    left = total[n_f:, n_f:] - across.T @ np.linalg.solve(inner, across)
    energy = np.maximum(np.diag(left)[:-1], 1e-12)
    length = np.sqrt(energy)
    return Signatures(
        traces.names,
        traces.sizes,
        raw,
        energy,
        -left[:-1, -1],
        left[:-1, :-1] / np.outer(length, length),
    )


def _part(metric: Metric, rows: slice, columns: FloatArray) -> FloatArray:
    system, filter_ = metric.discrepancy.system, metric.filter_
    part = LinearSystem(system.f[rows], system.h[rows], system.seen[rows], system.r, system.start)
    gains = FilterGains(
        np.ascontiguousarray(filter_.k[rows]),
        np.ascontiguousarray(filter_.root[rows]),
        filter_.logdet[rows],
        None,
    )
    return whiten(part, gains, columns)


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
    "quick": Effort(3, 2, 0, 1),
    "normal": Effort(9, 5, 4, 3),
    "thorough": Effort(18, 8, 8, 4),
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

    def point(self, key: str) -> dict[str, FloatArray] | None:
        """Parameters, starts, gains, sizes of the discrepancy under a key; None: not there yet."""
        known = self._points.get(key)
        if known is None:
            return None
        return {name: np.array(values) for name, values in known.items()}

    def add(self, key: str, fitted: FittedModel) -> None:
        """Note where a search ended."""
        with self._lock:
            self._points[key] = {
                "theta": fitted.fit.theta.tolist(),
                "starts": fitted.fit.starts.tolist(),
                "gains": fitted.fit.gains.tolist(),
                "shares": fitted.metric.shares.tolist(),
                "drift": fitted.metric.drift_sizes.tolist(),
            }
            self._keep(self._points)


def run_race(
    refit: Refit,
    candidates: Mapping[str, CandidateEffect],
    traces: EffectTraces,
    effort: Effort,
    *,
    prior: tuple[FittedModel, EffectTraces] | None = None,
    checkpoint: Checkpoint | None = None,
    jobs: int = 1,
    watch: Callable[[float, str], bool] = lambda fraction, message: True,
) -> Race:
    """Run the race.

    ``candidates``: none that noise drives. ``traces``: of all candidates about the refit.
    ``prior``: the same about the centre of the parameters' priors, where the refit had to bend
    them: what an effect would explain there, parameters have explained in the refit already.
    ``checkpoint``: of fits that an interrupted race had finished. ``jobs``: threads. ``watch``:
    told the share that is done and what is being done; False stops with what there is.
    """
    checkpoint = checkpoint or Checkpoint()
    shares = np.maximum(FLOOR, refit.metric.shares / _TIGHTER)
    wide_signs = project_traces(refit, traces)
    tight = replace(refit.metric, shares=shares)
    tight_signs = project_traces(replace(refit, metric=tight), traces)
    signs: tuple[Signatures, ...] = (tight_signs, wide_signs)
    if prior is not None:
        signs = (*signs, project_traces(*prior))
    listed = short_list(signs, candidates, effort.listed * len(signs) // 2)
    worth = [n for n in listed if max(s.best(n)[0] for s in signs) > _HOPELESS]
    listed = worth or listed[:1]
    middle = replace(refit.metric, shares=np.sqrt(shares * refit.metric.shares))

    def once(key: str, structure: ModelStructure, search: Callable[[], FittedModel]) -> FittedModel:
        """What a search finds, or where it had ended before the race was interrupted."""
        known = checkpoint.point(key)
        if known is None:
            made = search()
            checkpoint.add(key, made)
            return made
        metric = replace(refit.metric, shares=known["shares"], drift_sizes=known["drift"])
        points = [(known["theta"], known["starts"])]
        return structure.fit(
            metric, points, centres=refit.centres, gains=known["gains"], iterations=0
        )

    def single(name: str) -> FittedModel:
        candidate = candidates[name]
        structure = refit.structure.with_effects(candidate)

        def search() -> FittedModel:
            sizes = [_promising_sizes(candidate, sign, 0.3) for sign in (signs[0], signs[-1])]
            return _searched(structure, refit, middle, _points(structure, refit, sizes))

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
    if best is not None and effort.deepest > 1:
        pairs = promising_pairs(signs, candidates, effort.pairs * len(signs) // 2)

        # in one metric a pair whose members say less together than one effect is no competitor
        least = max(entry.fit.score for entry in entries)

        def both(pair: tuple[Signatures, int, int]) -> FittedModel | None:
            sign, *rows = pair
            chosen = [candidates[sign.names[row]] for row in rows]
            structure = refit.structure.with_effects(*chosen)
            sizes: dict[str, float] = {}
            for candidate, row in zip(chosen, rows, strict=True):
                sizes |= _scaled_sizes(candidate, sign, row, 0.3)
            points = _points(structure, refit, [sizes, sizes])
            key = "pair " + "+".join(structure.names)
            searched = once(key, structure, lambda: _searched(structure, refit, middle, points))
            if searched.fit.score < least:
                return None
            return once("final " + key, structure, searched.in_own_metric)

        joint = _each(both, pairs, jobs, watch, 0.75, 0.85, "two at once")
        joint.sort(key=lambda e: -e.fit.score)
        if joint and joint[0].fit.score > best.fit.score + _ENTRANCE:
            best = joint[0]
    while best is not None and len(best.names) < effort.deepest:
        # effects whose traces point at what the best leaves over
        beside = project_traces(best, traces)
        others = {n: s for n, s in candidates.items() if n not in best.names}
        listed = short_list((beside,), others, effort.pairs)
        tried = {frozenset(entry.names) for entry in joint}
        partners = [
            name
            for name in listed
            if beside.best(name)[0] > _ENTRANCE and frozenset((*best.names, name)) not in tried
        ]

        def pair(name: str, base: FittedModel = best, signs: Signatures = beside) -> FittedModel:
            effects = (*base.structure.effects, candidates[name])
            structure = refit.structure.with_effects(*effects)
            return once(
                "joint " + "+".join((*base.names, name)),
                structure,
                lambda: _paired(base, candidates[name], signs, structure),
            )

        made = _each(pair, partners, jobs, watch, 0.85, 0.95, "beside " + "+".join(best.names))
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


def promising_pairs(
    signs: Sequence[Signatures], candidates: Mapping[str, CandidateEffect], count: int
) -> list[tuple[Signatures, int, int]]:
    """The most promising pairs by each metric in turn: the metric's traces, and two of their rows.

    ``candidates``: no other effect is taken.
    """
    chosen: dict[frozenset[str], tuple[Signatures, int, int]] = {}
    orders = [[(sign, i, j) for _, i, j in sign.pairs(_ENTRANCE)] for sign in signs]
    for places in zip_longest(*orders):
        for place in places:
            if place is None or len(chosen) >= count:
                continue
            names = frozenset(place[0].names[row] for row in place[1:])
            if names <= candidates.keys():
                chosen.setdefault(names, place)
    return list(chosen.values())


def _searched(
    structure: ModelStructure,
    base: FittedModel,
    metric: Metric,
    points: Sequence[tuple[FloatArray, FloatArray]],
) -> FittedModel:
    """A few steps from some points, with the centres and gains of a fit that is built on."""
    return structure.fit(
        metric,
        points,
        centres=base.centres,
        gains=base.fit.gains,
        iterations=12,
        tolerance=0.5,
    )


def _points(
    structure: ModelStructure, refit: Refit, sizes: Sequence[Mapping[str, float]]
) -> list[tuple[FloatArray, FloatArray]]:
    """Where searches begin: the refit's optimum and the priors' centre, each with its sizes."""
    prior = {p.name: p.prior_mean for p in refit.structure.problem.free}
    thetas = [
        structure.theta({**values, **own})
        for values, own in zip((refit.values, prior), sizes, strict=True)
    ]
    return [(theta, structure.starts(theta, refit.fit.starts)) for theta in thetas]


def _promising_sizes(
    candidate: CandidateEffect, sign: Signatures, least: float
) -> dict[str, float]:
    """Sizes at which the trace explains most of what is left over, by name.

    Of the most promising row those that can make the effect vanish are scaled, by ``least`` to two
    times, within their bounds.
    """
    return _scaled_sizes(candidate, sign, sign.best(candidate.name)[1], least)


def _scaled_sizes(
    candidate: CandidateEffect, sign: Signatures, row: int, least: float
) -> dict[str, float]:
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
    return _searched(structure, best, best.metric, [(theta, starts)]).in_own_metric()


def _each(
    work: Callable[[Item], Made | None],
    items: Sequence[Item],
    jobs: int,
    watch: Callable[[float, str], bool],
    low: float,
    high: float,
    message: str,
) -> list[Made]:
    """The work on each item, in threads; compiled loops let go of the interpreter's lock.

    What the work makes nothing of is left out.
    """
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
