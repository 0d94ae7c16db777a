"""Which effect it is: the short list fitted, steps to combinations, all compared alike.

The short list comes of the trace that each effect leaves and no refit of the parameters can
(:mod:`trms_cli.gap.signatures`). Combinations come of the same traces: pairs about the refit, then
partners beside the best, and others in the stead of one of its effects, for a strong effect bends
the traces of what acts beside it.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, zip_longest
from threading import Lock
from typing import Any, TypeVar

import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.gap.beginning import (
    at_its_moment,
    beginning_at,
    begins_at,
    calm_metric,
    later_and_better,
    promised_beginnings,
    promised_jumps,
)
from trms_cli.gap.competing_model import FittedModel, Metric, ModelStructure, Refit
from trms_cli.gap.held_force import best_sizes, held_forces, is_constant
from trms_cli.gap.problem import CandidateEffect, is_amplitude
from trms_cli.gap.signatures import EffectTraces, Signatures, project_traces

Item = TypeVar("Item")
Outcome = TypeVar("Outcome")
Fitted = TypeVar("Fitted", bound=FittedModel)

#: A tighter metric than the refit's own: what an effect does is not excused as discrepancy there.
_TIGHTER = 3.0
#: Nats behind the best within which a dry friction is searched on, and steps of that search.
_OUTRUN, _LONG = 200.0, 30
#: Nats. An effect whose trace, at the best of its sizes, promises less is not fitted.
_HOPELESS = 1.5
#: Nats of held-out prediction that another effect must add to be taken in.
_ENTRANCE = 6.0
#: Nats that an effect must promise from some moment on beyond what any does throughout, and that it
#: must add then beyond itself: the moment is one more choice.
_PROMISES_LATER, _LATER = 4.0, 8.0
#: Nats that an effect must promise beside others for rivals to be tried in its stead: what promises
#: such a share of it, or has a trace with such a cosine to its own.
_WORTH_EXCHANGING, _RIVAL, _RIVAL_TRACE = 10.0, 0.5, 0.7


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

    ``points``: what an interrupted diagnosis had kept. ``keep``: told everything whenever something
    is added, as JSON has it.
    """

    def __init__(
        self,
        points: Mapping[str, Any] | None = None,
        keep: Callable[[Mapping[str, Any]], None] = lambda everything: None,
    ) -> None:
        self._points: dict[str, Any] = dict(points or {})
        self._keep, self._prefix = keep, ""
        self._lock = Lock()

    def part(self, prefix: str) -> Checkpoint:
        """The same for a race beside others, whose keys begin with a prefix."""
        part = copy.copy(self)
        part._prefix = self._prefix + prefix
        return part

    def point(self, key: str) -> dict[str, FloatArray] | None:
        """Where a search ended and what it ended in, under a key; None: not there yet."""
        stored_point = self._points.get(self._prefix + key)
        if stored_point is None:
            return None
        return {name: np.array(values) for name, values in stored_point.items()}

    def add(self, key: str, fitted: FittedModel) -> None:
        """Note where a search ended."""
        with self._lock:
            self._points[self._prefix + key] = {
                "theta": fitted.fit.theta.tolist(),
                "starts": fitted.fit.starts.tolist(),
                "gains": fitted.fit.gains.tolist(),
                "shares": fitted.metric.shares.tolist(),
                "drift": fitted.metric.drift_sizes.tolist(),
                "others": fitted.fit.others.tolist(),
            }
            self._keep(self._points)


#: Told the share that is done and what is being done; False stops.
Watch = Callable[[float, str], bool]


def run_race(
    refit: Refit,
    candidates: Mapping[str, CandidateEffect],
    traces: EffectTraces,
    effort: Effort,
    *,
    prior: tuple[FittedModel, EffectTraces] | None = None,
    checkpoint: Checkpoint | None = None,
    jobs: int = 1,
    watch: Watch = lambda fraction, message: True,
) -> Race:
    """Run the race.

    ``candidates``: none that noise drives. ``traces``: of all candidates about the refit.
    ``prior``: the same about the centre of the parameters' priors, where the refit had to bend
    them: what an effect would explain there, parameters have explained in the refit already.
    ``checkpoint``: of fits that an interrupted race had finished. ``jobs``: threads. ``watch``:
    told the share that is done and what is being done; False stops with what there is.
    """
    wide = project_traces(refit, traces)
    tight = project_traces(_tightened(refit), traces)
    signs: tuple[Signatures, ...] = (tight, wide)
    if prior is not None:
        signs = (*signs, project_traces(*prior))
    search = _Search(refit, candidates, traces, effort, checkpoint or Checkpoint(), jobs, watch)
    everyone = search.alone(signs)
    if everyone and effort.deepest > 1:
        later = search.later(everyone)
        everyone += search.together(signs, everyone)
        everyone = better_of(everyone, search.with_less(everyone))
        everyone += search.special_cases(everyone)
        everyone = search.searched_on(everyone)
        # from some moment on in place of throughout, where that says clearly more
        everyone = [later.pop(entry.names, entry) for entry in everyone] + [*later.values()]
    everyone.sort(key=lambda e: -e.fit.score)
    return Race(refit, tuple(everyone), wide, tight)


@dataclass(frozen=True)
class _Place:
    """An effect that is to be fitted beside what a fit has."""

    base: FittedModel
    beside: Signatures  #: About that fit
    name: str

    @property
    def names(self) -> frozenset[str]:
        """All effects together."""
        return frozenset((*self.base.names, self.name))

    @property
    def promise(self) -> float:
        """Nats."""
        return self.beside.best(self.name)[0]


class _Search:
    """The fits of a race."""

    def __init__(
        self,
        refit: Refit,
        candidates: Mapping[str, CandidateEffect],
        traces: EffectTraces,
        effort: Effort,
        checkpoint: Checkpoint,
        jobs: int,
        watch: Watch,
    ) -> None:
        self._refit, self._candidates, self._traces = refit, candidates, traces
        self._effort, self._checkpoint, self._jobs, self._watch = effort, checkpoint, jobs, watch
        self._middle = _between(refit)
        #: Score of the best effect alone, in one metric: a pair that says less is no answer
        self._least = -np.inf

    def alone(self, signs: Sequence[Signatures]) -> list[FittedModel]:
        """Single effects that are promising by any of some metrics, the best in their own."""
        effort = self._effort
        names = short_list(signs, self._candidates, effort.listed * len(signs) // 2)
        worth = [n for n in names if max(s.best(n)[0] for s in signs) > _HOPELESS]
        names = worth or names[:1]
        refit = self._refit.refitted(self._middle, iterations=5).fit.score

        def single(name: str) -> FittedModel:
            candidate = self._candidates[name]
            structure = self._refit.structure.with_effects(candidate)
            own_signs = [sign for sign in (signs[0], signs[-1]) if len(sign.rows(name))]
            sizes = [_scaled_sizes(candidate, sign, 0.3) for sign in own_signs]
            more = _other_frequencies(candidate, signs[0], 0.3) + self._grid(candidate)
            return self._once(
                f"single {name}",
                structure,
                lambda: self._fit_from_sizes(structure, sizes, more=more),
            )

        def final(entry: FittedModel) -> FittedModel:
            key = "final " + "+".join(entry.names)
            return self._once(key, entry.structure, lambda: assess(entry))

        def assess(entry: FittedModel) -> FittedModel:
            if entry.fit.score < refit + _ENTRANCE / 2:
                # it explains nothing: the discrepancy that it leaves is the refit's
                return entry.refitted(self._refit.metric, iterations=4, tolerance=0.5)
            return entry.in_own_metric()

        entries = self._each(single, names, (0.0, 0.55), "fitting {}")
        entries.sort(key=lambda e: -e.fit.score)
        self._least = max((entry.fit.score for entry in entries), default=-np.inf)
        return self._each(final, entries[: effort.finalists], (0.55, 0.75), "comparing")

    def _grid(self, candidate: CandidateEffect) -> list[dict[str, float]]:
        """Dry friction at each size that it is tried at, about the priors' centre.

        On a rig whose friction is a good part of all forces no slope leads there from far away:
        where the model sticks and the rig does not is a matter of its size.
        """
        problem = self._refit.structure.problem
        if problem.model.bench_sizes or not candidate.effect.overrides("impulse"):
            return []
        prior = {p.name: p.prior_mean for p in problem.free}
        return [prior | _sizes_of_row(candidate, row) for row in candidate.variants]

    def later(self, alone: Sequence[FittedModel]) -> dict[tuple[str, ...], FittedModel]:
        """Single effects that begin within the recordings, by their names."""
        refit, least = self._refit, self._refit.fit.score
        gains = promised_beginnings(refit, self._traces)
        beginnings = later_and_better(
            gains, self._traces.names, _PROMISES_LATER, self._effort.finalists
        )
        scores = {entry.names: entry.fit.score for entry in alone}
        jumps = promised_jumps(refit, self._traces)

        def fit_jump(name: str) -> FittedModel:
            candidate, jump = self._candidates[name], jumps[name]
            gated_structure = beginning_at(
                refit.structure.with_effects(candidate), jump.window, jump.sample
            )
            sizes = _sizes_scaled_by(candidate, self._traces.sizes[jump.row], jump.factor)

            def search() -> FittedModel:
                points = _points(gated_structure, refit, [sizes, sizes])
                calm = calm_metric(refit.metric)
                return _fit_from_points(gated_structure, refit, calm, points).in_own_metric()

            return self._once(f"jump {jump.window} {jump.sample} {name}", gated_structure, search)

        def fit_beginning(name: str) -> FittedModel:
            if name in jumps:
                return fit_jump(name)
            candidate, (row, window) = self._candidates[name], beginnings[name]
            structure = refit.structure.with_effects(candidate)
            sizes = _sizes_of_row(candidate, self._traces.sizes[row])

            def search(first: int) -> FittedModel:
                gated_structure = beginning_at(structure, first)
                return self._once(
                    f"from {first} {name}",
                    gated_structure,
                    lambda: self._fit_from_sizes(gated_structure, [sizes, sizes]),
                )

            ends = [search(first) for first in sorted({window, max(window - 1, 1)})]
            best = max(ends, key=lambda e: e.fit.score)
            exact = at_its_moment(best, structure)
            key = f"final from {begins_at(best)} {name}"

            def final() -> FittedModel:
                point = [(best.fit.theta, best.fit.starts)]
                exact_fit = exact.fit(
                    self._middle, point, centres=best.centres, gains=best.fit.gains, iterations=8
                )
                return exact_fit.in_own_metric()

            return self._once(key, exact, final)

        entries = self._each(
            fit_beginning,
            [*jumps, *(n for n in beginnings if n not in jumps)],
            (0.75, 0.8),
            "since when {}",
        )
        return {
            entry.names: entry
            for entry in entries
            if entry.fit.score > max(scores.get(entry.names, least), least) + _LATER
        }

    def together(
        self, signs: Sequence[Signatures], alone: Sequence[FittedModel]
    ) -> list[FittedModel]:
        """Several effects at once."""
        pairs = promising_pairs(signs, self._candidates, self._effort.pairs * len(signs) // 2)
        singles = {entry.names[0]: entry for entry in alone}
        entries = self._each(
            lambda place: self._pair(place, singles), pairs, (0.75, 0.85), "two at once"
        )
        hidden = self._each(
            lambda names: self._friction_with_force(names, singles),
            held_forces(self._refit.structure.problem.model, self._candidates),
            (0.85, 0.85),
            "friction with a constant force",
        )
        entries = better_of(entries, hidden)
        best = max(alone, key=lambda e: e.fit.score)
        first = max(entries, key=lambda e: e.fit.score, default=best)
        if first.fit.score > best.fit.score + _ENTRANCE:
            best = first
        while True:
            if len(best.names) > 1:
                places = self._exchanges(best, (*alone, *entries), signs)
                added = self._fit_places(places, "in the stead of one of " + "+".join(best.names))
                entries += added
                best = max((best, *added), key=lambda e: e.fit.score)
            if len(best.names) >= self._effort.deepest:
                return entries
            places = self._partners(best, entries)
            added = self._fit_places(places, "beside " + "+".join(best.names))
            entries += added
            deeper = max(added, key=lambda e: e.fit.score, default=best)
            if deeper.fit.score < best.fit.score + _ENTRANCE or deeper is best:
                return entries
            best = deeper

    def special_cases(self, entries: Sequence[FittedModel]) -> list[FittedModel]:
        """The simpler laws that the likeliest are at their sizes, where these have not raced."""
        raced_names = {entry.names for entry in entries}
        simpler: dict[tuple[str, ...], tuple[FittedModel, ModelStructure]] = {}
        for entry in sorted(entries, key=lambda e: -e.fit.score)[: self._effort.finalists]:
            effects = [c.at_sizes(entry.values, self._candidates) for c in entry.structure.effects]
            structure = self._refit.structure.with_effects(*{e.name: e for e in effects}.values())
            if structure.names not in raced_names:
                simpler.setdefault(structure.names, (entry, structure))

        def fit(case: tuple[FittedModel, ModelStructure]) -> FittedModel:
            entry, structure = case
            return self._once(
                "special " + "+".join(structure.names),
                structure,
                lambda: self._fit_special_case(entry, structure),
            )

        return self._each(fit, list(simpler.values()), (0.95, 0.99), "simpler laws")

    def with_less(self, entries: Sequence[FittedModel]) -> list[FittedModel]:
        """The best with one of its effects less, and the best of these, from where it had ended.

        What a first effect did in the place of others may be theirs again, and a search for these
        alone may have stopped too early. Of small benches, whose searches hardly do, none.
        """
        scores = {entry.names: entry.fit.score for entry in entries}
        results: list[FittedModel] = []
        best = max(entries, key=lambda e: e.fit.score)
        while len(best.names) > 1 and not best.model.bench_sizes:
            cases = []
            for left_out in best.structure.effects:
                effects = [c for c in best.structure.effects if c is not left_out]
                structure = self._refit.structure.with_effects(*effects)
                if scores.get(structure.names, -np.inf) < best.fit.score - _ENTRANCE:
                    cases.append((best, structure))
            results += self._each(
                lambda case: self._once(
                    f"less {'+'.join(case[0].names)} {'+'.join(case[1].names)}",
                    case[1],
                    lambda: self._fit_special_case(*case),
                ),
                cases,
                (0.94, 0.95),
                "with one effect less",
            )
            size = len(best.names) - 1
            again = [e for e in (*results, *entries) if len(e.names) == size]
            best = max(again, key=lambda e: e.fit.score, default=best)
            if len(best.names) > size:
                break
        return results

    def searched_on(self, entries: Sequence[FittedModel]) -> list[FittedModel]:
        """Dry frictions not far behind the best, if that is one, from where they had ended.

        Where a model sticks and slides steps are short: a friction alone had stopped 130 nats below
        what it reaches, and another effect was told beside it. Benches are weighed as they ended.
        """
        best = max(entries, key=lambda e: e.fit.score)
        least = best.fit.score - _OUTRUN if _is_dry(best) and not best.model.bench_sizes else np.inf

        def on(entry: FittedModel) -> FittedModel:
            key = "on " + "+".join(entry.names)
            search = partial(entry.refitted, entry.metric, iterations=_LONG)
            return self._once(key, entry.structure, search)

        near = [entry for entry in entries if _is_dry(entry) and entry.fit.score > least]
        return better_of(entries, self._each(on, near, (0.99, 0.99), "friction, searched on"))

    def _fit_special_case(self, entry: FittedModel, structure: ModelStructure) -> FittedModel:
        """A fit with simpler laws, from the sizes that both have."""
        values = dict(entry.values)
        for own in entry.structure.effects:
            other = own.at_sizes(entry.values, self._candidates)
            for size in other.free:
                short = size.name.removeprefix(f"{other.name}.")
                values[size.name] = entry.values.get(f"{own.name}.{short}", size.start)
        return _fit_beside(structure, entry, values)

    def _pair(
        self, place: tuple[Signatures, int, int], singles: Mapping[str, FittedModel]
    ) -> FittedModel | None:
        """Two effects fitted at once; None where they say less together than one alone.

        ``singles``: what was fitted of each alone, from which the search begins, too.
        """
        sign, *rows = place
        candidates = [self._candidates[sign.names[row]] for row in rows]
        structure = self._refit.structure.with_effects(*candidates)
        sizes: dict[str, float] = {}
        for candidate, row in zip(candidates, rows, strict=True):
            sizes |= _scaled_sizes(candidate, sign, 0.3, row)
        key = "pair " + "+".join(structure.names)
        best_single = max(
            (singles[name] for name in structure.names if name in singles),
            key=lambda e: e.fit.score,
            default=None,
        )
        entry = self._once(
            key, structure, lambda: self._fit_from_sizes(structure, [sizes, sizes], best_single)
        )
        if entry.fit.score < self._least:
            return None
        return self._once("final " + key, structure, entry.in_own_metric)

    def _partners(self, best: FittedModel, entries: Sequence[FittedModel]) -> list[_Place]:
        """Effects whose traces point at what the best leaves over."""
        raced_names = {frozenset(entry.names) for entry in entries}
        places = self._beside(best, best.names)
        is_dry = _is_dry(best)

        def is_worth_it(place: _Place) -> bool:
            return place.promise > _ENTRANCE or (
                is_dry and is_constant(self._candidates[place.name])
            )

        return [p for p in places if is_worth_it(p) and p.names not in raced_names]

    def _friction_with_force(
        self, names: tuple[str, str], singles: Mapping[str, FittedModel]
    ) -> FittedModel | None:
        """From the best of many sizes, and from the fit of the friction alone."""
        friction, force = (self._candidates[name] for name in names)
        structure = self._refit.structure.with_effects(friction, force)

        def search() -> FittedModel:
            others = self._grid(friction)[0]
            best = best_sizes(structure, self._refit, self._middle, (friction, force), others)
            if alone := singles.get(names[0]):
                starts = alone.fit.starts[:, : self._refit.centres.shape[1]]
                best.append(structure.point({**alone.values, force.free[0].name: 0.0}, starts))
            return _fit_from_points(structure, self._refit, self._middle, best)

        key = "friction " + "+".join(structure.names)
        entry = self._once(key, structure, search)
        if entry.fit.score < self._least:
            return None
        return self._once("final " + key, structure, entry.in_own_metric)

    def _exchanges(
        self, best: FittedModel, entries: Sequence[FittedModel], signs: Sequence[Signatures]
    ) -> list[_Place]:
        """Others in the stead of one of the best's effects: rivals for what it explains.

        They promise about as much about what the rest leaves, or have a trace like its own about
        the refit: a strong effect beside them bends what traces promise.
        """
        entries_by_names = {frozenset(entry.names): entry for entry in entries}
        rivals: list[tuple[float, _Place]] = []
        for name in best.names:
            base = entries_by_names.get(frozenset(best.names) - {name})
            if base is None:
                continue
            beside = project_traces(base, self._traces)
            own = beside.best(name)[0]
            if own < _WORTH_EXCHANGING:
                continue
            for other in self._candidates:
                place = _Place(base, beside, other)
                if (
                    other in best.names
                    or place.names in entries_by_names
                    or not len(beside.rows(other))
                ):
                    continue
                alike = max(sign.alike(name, other) for sign in signs)
                if place.promise > _RIVAL * own or alike > _RIVAL_TRACE:
                    rivals.append((max(place.promise / own, alike), place))
        rivals.sort(key=lambda item: -item[0])
        return [place for _, place in rivals[: self._effort.pairs]]

    def _beside(self, base: FittedModel, but_for: Sequence[str]) -> list[_Place]:
        """The most promising, in the fit's own metric and in a tighter one.

        What a partner would explain, the fit takes for discrepancy as long as it lacks it. A
        constant force beside dry friction hardly has a trace, for friction holds against it: it is
        always tried.
        """
        signs = [project_traces(base, self._traces), project_traces(_tightened(base), self._traces)]
        others = {n: c for n, c in self._candidates.items() if n not in but_for}
        names = short_list(signs, others, self._effort.pairs)
        if _is_dry(base):
            names = list(dict.fromkeys((*names, *(n for n, c in others.items() if is_constant(c)))))
        return [
            _Place(base, max(signs, key=lambda sign: sign.best(name)[0]), name) for name in names
        ]

    def _fit_places(self, places: Sequence[_Place], message: str) -> list[FittedModel]:
        def fit_place(place: _Place) -> FittedModel:
            base, partner = place.base, self._candidates[place.name]
            structure = self._refit.structure.with_effects(*base.structure.effects, partner)
            values = {**base.values, **_scaled_sizes(partner, place.beside, 0.2)}
            return self._once(
                "joint " + "+".join((*base.names, place.name)),
                structure,
                lambda: _fit_beside(structure, base, values),
            )

        return self._each(fit_place, places, (0.85, 0.95), message)

    def _fit_from_sizes(
        self,
        structure: ModelStructure,
        sizes: Sequence[Mapping[str, float]],
        partial_fit: FittedModel | None = None,
        more: Sequence[Mapping[str, float]] = (),
    ) -> FittedModel:
        """Also from ``partial_fit``, a fit with a part of the effects, and at ``more`` sizes."""
        refit = self._refit
        points = _points(structure, refit, sizes)
        points += [structure.point({**refit.values, **own}, refit.fit.starts) for own in more]
        if partial_fit is not None:
            starts = partial_fit.fit.starts[:, : refit.centres.shape[1]]
            points.append(structure.point({**sizes[0], **partial_fit.values}, starts))
        return _fit_from_points(structure, refit, self._middle, points)

    def _once(
        self, key: str, structure: ModelStructure, search: Callable[[], FittedModel]
    ) -> FittedModel:
        """What a search finds, or where it had ended before the race was interrupted."""
        stored_point, refit = self._checkpoint.point(key), self._refit
        if stored_point is None:
            entry = search()
            self._checkpoint.add(key, entry)
            return entry
        metric = replace(
            refit.metric, shares=stored_point["shares"], drift_sizes=stored_point["drift"]
        )
        points = [(stored_point["theta"], stored_point["starts"])]
        entry = structure.fit(
            metric, points, centres=refit.centres, gains=stored_point["gains"], iterations=0
        )
        others = np.reshape(stored_point["others"], (-1, len(entry.fit.theta)))
        return replace(entry, fit=replace(entry.fit, others=others))

    def _each(
        self,
        work: Callable[[Item], Outcome | None],
        items: Sequence[Item],
        share: tuple[float, float],
        message: str,
    ) -> list[Outcome]:
        """The work on each item, in threads; compiled loops let go of the interpreter's lock.

        What the work makes nothing of is left out.
        """
        low, high = share
        if not items or not self._watch(low, message.format(items[0])):
            return []

        def attempt(item: Item) -> Outcome | None:
            # A model that can no longer be reckoned with is no competitor, and no reason to stop.
            try:
                return work(item)
            except (FloatingPointError, np.linalg.LinAlgError):
                return None

        with ThreadPoolExecutor(max(1, self._jobs)) as pool:
            results: list[Outcome] = []
            for k, result in enumerate(pool.map(attempt, items)):
                if result is not None:
                    results.append(result)
                progress = low + (high - low) * (k + 1) / len(items)
                if not self._watch(progress, message.format(items[k])):
                    pool.shutdown(wait=True, cancel_futures=True)
                    break
        return results


def better_of(entries: Sequence[FittedModel], again: Sequence[FittedModel]) -> list[FittedModel]:
    """Entries, and fits made anew where they are new or say more, one of each effects."""
    best = {entry.names: entry for entry in entries}
    for entry in again:
        if entry.names not in best or entry.fit.score > best[entry.names].fit.score:
            best[entry.names] = entry
    return list(best.values())


def _tightened(fitted: Fitted) -> Fitted:
    """The same fit, whose discrepancy is a part of what it found."""
    shares = np.maximum(fitted.metric.discrepancy.floor, fitted.metric.shares / _TIGHTER)
    return replace(fitted, metric=replace(fitted.metric, shares=shares))


def _between(fitted: FittedModel) -> Metric:
    """The metric between a fit's own and the tighter one, in which more effects are fitted."""
    shares = np.sqrt(fitted.metric.shares * _tightened(fitted).metric.shares)
    return replace(fitted.metric, shares=shares)


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
    in_turn = dict.fromkeys(chain.from_iterable(zip_longest(*orders)))
    return [name for name in in_turn if name is not None][:count]


def promising_pairs(
    signs: Sequence[Signatures], candidates: Mapping[str, CandidateEffect], count: int
) -> list[tuple[Signatures, int, int]]:
    """The most promising pairs by each metric in turn: the metric's traces, and two of their rows.

    ``candidates``: no other effect is taken.
    """
    pairs: dict[frozenset[str], tuple[Signatures, int, int]] = {}
    orders = [[(sign, i, j) for _, i, j in sign.pairs(_ENTRANCE)] for sign in signs]
    for place in chain.from_iterable(zip_longest(*orders)):
        if place is None or len(pairs) >= count:
            continue
        names = frozenset(place[0].names[row] for row in place[1:])
        if names <= candidates.keys():
            pairs.setdefault(names, place)
    return list(pairs.values())


def _fit_from_points(
    structure: ModelStructure,
    base: FittedModel,
    metric: Metric,
    points: Sequence[tuple[FloatArray, FloatArray]],
) -> FittedModel:
    """A few steps from some points, with the centres and gains of a fit that is built on."""
    return structure.fit(
        metric, points, centres=base.centres, gains=base.fit.gains, iterations=12, tolerance=0.5
    )


def _is_dry(entry: FittedModel) -> bool:
    """Whether an effect of a fit is dry friction."""
    return any(candidate.effect.overrides("impulse") for candidate in entry.structure.effects)


def _fit_beside(
    structure: ModelStructure, base: FittedModel, values: Mapping[str, float]
) -> FittedModel:
    """A fit with more effects than another has, or fewer, from where that ended."""
    point = structure.point(values, base.fit.starts[:, : base.centres.shape[1]])
    return _fit_from_points(structure, base, _between(base), [point]).in_own_metric()


def _points(
    structure: ModelStructure, refit: Refit, sizes: Sequence[Mapping[str, float]]
) -> list[tuple[FloatArray, FloatArray]]:
    """Where searches begin: the refit's optimum and the priors' centre, each with its sizes."""
    prior = {p.name: p.prior_mean for p in refit.structure.problem.free}
    return [
        structure.point({**values, **own}, refit.fit.starts)
        for values, own in zip((refit.values, prior), sizes, strict=True)
    ]


#: How many frequencies a search for a mode begins at, besides the most promising one.
_FREQUENCIES = 2


def _other_frequencies(
    candidate: CandidateEffect, sign: Signatures, least: float
) -> list[dict[str, float]]:
    """Sizes at further promising frequencies of an effect that has one: no slope leads there."""
    at = next((i for i, f in enumerate(candidate.free) if f.name.endswith(".frequency")), None)
    if at is None:
        return []
    rows = sign.rows(candidate.name)
    best = rows[np.argsort(-sign.gain[rows])]
    row_by_frequency: dict[float, int] = {}
    for row in best.tolist():
        row_by_frequency.setdefault(float(sign.sizes[row][at]), row)
    others = list(row_by_frequency.values())[1 : 1 + _FREQUENCIES]
    return [_scaled_sizes(candidate, sign, least, row) for row in others]


def _sizes_of_row(candidate: CandidateEffect, values: FloatArray) -> dict[str, float]:
    return {free.name: float(v) for free, v in zip(candidate.free, values, strict=True)}


def _scaled_sizes(
    candidate: CandidateEffect, sign: Signatures, least: float, row: int | None = None
) -> dict[str, float]:
    """Sizes at which a row's trace explains most of what is left over, by name.

    Those that can make the effect vanish are scaled, by ``least`` to two times. ``row``: None for
    the most promising one.
    """
    row = sign.best(candidate.name)[1] if row is None else row
    by = float(np.clip(sign.towards[row] / max(sign.projected_energy[row], 1e-12), least, 2.0))
    return _sizes_scaled_by(candidate, sign.sizes[row], by)


def _sizes_scaled_by(
    candidate: CandidateEffect, values: FloatArray, factor: float
) -> dict[str, float]:
    """Sizes by name, those that can make the effect vanish scaled, within their bounds."""
    sizes = {}
    for i, (free, size) in enumerate(zip(candidate.free, values, strict=True)):
        is_scaled = is_amplitude(candidate.effect.parameters(), i)
        sizes[free.name] = float(
            np.clip(size * factor, free.lower, free.upper) if is_scaled else size
        )
    return sizes
