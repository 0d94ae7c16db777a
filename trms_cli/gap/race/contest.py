"""Which effect it is: the short list fitted, steps to combinations, all compared alike."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from threading import Lock
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from trms_cli.gap.candidates import Suspect
from trms_cli.gap.fitting.contestant import Contestant, Fit
from trms_cli.gap.fitting.metric import Metric
from trms_cli.gap.innovations.sizes import FLOOR
from trms_cli.gap.race.nominal import Refit, own_metric
from trms_cli.gap.separability import Signatures, Traces, projected

FloatArray = npt.NDArray[np.float64]

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
class Entry:
    """One that raced."""

    contestant: Contestant
    fit: Fit  #: In the metric that is most likely for itself
    metric: Metric

    @property
    def names(self) -> tuple[str, ...]:
        return self.contestant.names


@dataclass(frozen=True)
class Contest:
    """All that raced, best first."""

    refit: Refit
    entries: tuple[Entry, ...]  #: With one effect or several
    signatures: Signatures  #: In the refit's metric
    tight: Signatures  #: In the tighter one
    #: Those with several effects, as they were tried.
    joint: tuple[Entry, ...] = field(default=())


class Ledger:
    """Where searches ended, so that an interrupted diagnosis goes on instead of beginning again.

    Parameters
    ----------
    kept : mapping or None
        What an interrupted diagnosis had kept.
    keep : callable
        Told everything whenever something is added, as JSON has it.
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

    def add(self, key: str, fit: Fit, metric: Metric) -> None:
        """Note where a search ended."""
        with self._lock:
            self._points[key] = {
                "theta": fit.theta.tolist(),
                "starts": fit.starts.tolist(),
                "shares": metric.shares.tolist(),
            }
            self._keep(self._points)


class Stable:
    """Makes each contestant once.

    Parameters
    ----------
    refit : Refit
    block : float
        s.
    """

    def __init__(self, refit: Refit, block: float) -> None:
        self._refit, self._block = refit, block
        self._known: dict[tuple[str, ...], Contestant] = {}

    def of(self, *effects: Suspect) -> Contestant:
        """The contestant with some effects."""
        key = tuple(sorted(e.name for e in effects))
        if key not in self._known:
            nominal = self._refit.contestant
            self._known[key] = Contestant(
                nominal.problem.model,
                nominal.problem.free,
                sorted(effects, key=lambda e: e.name),
                nominal.problem.datasets,
                self._block,
            )
        return self._known[key]


def contest(
    refit: Refit,
    suspects: Mapping[str, Suspect],
    found: Traces,
    stable: Stable,
    effort: Effort,
    *,
    ledger: Ledger | None = None,
    jobs: int = 1,
    watch: Callable[[float, str], bool] = lambda fraction, message: True,
) -> Contest:
    """Run the race.

    Parameters
    ----------
    refit : Refit
    suspects : dict of str to Suspect
        None that noise drives.
    found : Traces
        Of all suspects about the refit.
    stable : Stable
    effort : Effort
    ledger : Ledger or None
        Of fits that an interrupted race had finished.
    jobs : int
        Threads.
    watch : callable
        Told the share that is done and what is being done; False stops with what there is.
    """
    nominal = refit.contestant
    ledger = ledger or Ledger()
    shares = np.maximum(FLOOR, refit.metric.shares / _TIGHTER)
    tight = Metric(refit.metric.discrepancy, shares, refit.metric.robust)
    wide_signs = projected(nominal, refit.fit, refit.metric, refit.centres, found)
    tight_signs = projected(nominal, refit.fit, tight, refit.centres, found)
    listed = short_list((tight_signs, wide_signs), suspects, effort.listed)
    worth = [n for n in listed if max(s.best(n)[0] for s in (tight_signs, wide_signs)) > _HOPELESS]
    listed = worth or listed[:1]
    middle = Metric(
        refit.metric.discrepancy, np.sqrt(shares * refit.metric.shares), refit.metric.robust
    )

    def single(name: str) -> Entry:
        suspect = suspects[name]
        contestant = stable.of(suspect)
        known = ledger.point(f"single {name}")
        if known is not None:
            return Entry(contestant, _again(contestant, middle, known, refit), middle)
        points = _points(contestant, suspect, refit, (tight_signs, wide_signs))
        fit = contestant.fit(middle, points, centres=refit.centres, iterations=12, tolerance=0.5)
        ledger.add(f"single {name}", fit, middle)
        return Entry(contestant, fit, middle)

    alone = nominal.fit(
        middle, [(refit.fit.theta, refit.fit.starts)], centres=refit.centres, iterations=5
    )
    refit_score = alone.score
    entries = _each(single, listed, jobs, watch, 0.0, 0.55, "fitting {}")
    entries.sort(key=lambda e: -e.fit.score)
    finals = entries[: effort.finalists]

    def final(entry: Entry) -> Entry:
        key = "final " + "+".join(entry.names)
        known = ledger.point(key)
        if known is not None:
            metric = Metric(refit.metric.discrepancy, known[2], refit.metric.robust)
            return Entry(entry.contestant, _again(entry.contestant, metric, known, refit), metric)
        made = assessed(entry)
        ledger.add(key, made.fit, made.metric)
        return made

    def assessed(entry: Entry) -> Entry:
        if entry.fit.score < refit_score + _ENTRANCE / 2:
            # it explains nothing: the discrepancy that it leaves is the refit's
            point = (entry.fit.theta, entry.fit.starts)
            again = entry.contestant.fit(
                refit.metric, [point], centres=refit.centres, iterations=4, tolerance=0.5
            )
            return Entry(entry.contestant, again, refit.metric)
        return Entry(
            entry.contestant, *own_metric(entry.contestant, entry.fit, entry.metric, refit.centres)
        )

    finals = _each(final, finals, jobs, watch, 0.55, 0.75, "comparing")
    finals.sort(key=lambda e: -e.fit.score)
    joint: list[Entry] = []
    best = finals[0] if finals else None
    while best is not None and len(best.names) < effort.deepest:
        partners = _partners(best, refit, found, suspects, effort.pairs)

        def pair(name: str, base: Entry = best) -> Entry:
            key = "joint " + "+".join((*base.names, name))
            known = ledger.point(key)
            if known is not None:
                contestant = stable.of(*base.contestant.effects, suspects[name])
                metric = Metric(refit.metric.discrepancy, known[2], refit.metric.robust)
                return Entry(contestant, _again(contestant, metric, known, refit), metric)
            made = _paired(base, suspects[name], refit, found, stable)
            ledger.add(key, made.fit, made.metric)
            return made

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
    return Contest(refit, tuple(everyone), wide_signs, tight_signs, tuple(joint))


def _again(
    contestant: Contestant,
    metric: Metric,
    known: tuple[FloatArray, FloatArray, FloatArray],
    refit: Refit,
) -> Fit:
    """A fit that had been made, without searching again."""
    return contestant.fit(metric, [known[:2]], centres=refit.centres, iterations=0)


def short_list(
    signs: Sequence[Signatures], suspects: Mapping[str, Suspect], count: int
) -> list[str]:
    """The most promising by any of some metrics, in turn, so that each has its say."""
    orders = [
        sorted(
            (name for name in suspects if len(sign.rows(name))),
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
    contestant: Contestant, suspect: Suspect, refit: Refit, signs: Sequence[Signatures]
) -> list[tuple[FloatArray, FloatArray]]:
    """Where searches begin: the refit's optimum and the priors' centre, sizes as screened."""
    nominal = refit.contestant.values(refit.fit.theta)
    prior = {p.name: p.prior_mean for p in refit.contestant.problem.free}
    points = []
    rows = []
    for sign in signs:
        _, row = sign.best(suspect.name)
        by = float(np.clip(sign.towards[row] / max(sign.left[row], 1e-12), 0.3, 2.0))
        sizes = np.array(sign.sizes[row], dtype=float)
        rows.append(_scaled(suspect, sizes, by))
    for values, sizes in ((nominal, rows[0]), (prior, rows[-1])):
        own = {f.name: float(v) for f, v in zip(suspect.free, sizes, strict=True)}
        theta = contestant.theta({**values, **own})
        points.append((theta, contestant.starts(theta, refit.fit.starts)))
    return points


def _scaled(suspect: Suspect, sizes: FloatArray, by: float) -> FloatArray:
    """The sizes that can make the effect vanish, scaled; within bounds."""
    scaled = sizes.copy()
    for i, free in enumerate(suspect.free):
        if i == 0 or free.prior_mean == 0.0:
            scaled[i] = np.clip(sizes[i] * by, free.lower, free.upper)
    return scaled


def _partners(
    best: Entry, refit: Refit, found: Traces, suspects: Mapping[str, Suspect], count: int
) -> list[str]:
    """Effects whose traces point at what the best leaves over."""
    signs = projected(best.contestant, best.fit, best.metric, refit.centres, found)
    others = {n: s for n, s in suspects.items() if n not in best.names}
    listed = short_list((signs,), others, count)
    return [name for name in listed if signs.best(name)[0] > _ENTRANCE]


def _paired(best: Entry, partner: Suspect, refit: Refit, found: Traces, stable: Stable) -> Entry:
    contestant = stable.of(*best.contestant.effects, partner)
    signs = projected(best.contestant, best.fit, best.metric, refit.centres, found)
    _, row = signs.best(partner.name)
    by = float(np.clip(signs.towards[row] / max(signs.left[row], 1e-12), 0.2, 2.0))
    sizes = _scaled(partner, np.array(signs.sizes[row], dtype=float), by)
    own = {f.name: float(v) for f, v in zip(partner.free, sizes, strict=True)}
    theta = contestant.theta({**best.contestant.values(best.fit.theta), **own})
    starts = contestant.starts(theta, best.fit.starts[:, : refit.centres.shape[1]])
    fit = contestant.fit(
        best.metric, [(theta, starts)], centres=refit.centres, iterations=12, tolerance=0.5
    )
    return Entry(contestant, *own_metric(contestant, fit, best.metric, refit.centres))


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
