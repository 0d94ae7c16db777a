"""A search for the best values, by Optuna: tuning of a controller's weights against its scores.

What is searched are the ranges (``controller.state_weights.alpha_v=tag(log,interval(0.1,10))``).
Every trial is run under all conditions: the choices (``ref=square,sine``) crossed with rigs drawn
from the priors (``plant.parameters=prior``). All trials see the same conditions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from msgspec import Meta

from trms_cli.core.errors import ConfigurationError
from trms_cli.sweeps.figures import MERIT, canonical_all, canonical_limits, unit_of
from trms_cli.sweeps.samplers import drawing
from trms_cli.sweeps.samplers.latin_hypercube import hypercube
from trms_cli.sweeps.samplers.objectives import Aims, TrialOutcome, front, hypervolumes
from trms_cli.sweeps.space import Choice, PriorOfKey, Range, RunResult, Space, SweepPoint

if TYPE_CHECKING:
    import optuna

#: Trials that are proposed together where that is not given.
_BATCHES = {"tpe": 4, "nsga2": 20}


@dataclass(frozen=True, kw_only=True)
class Optimise:
    """A search."""

    #: Figures by the names of ``trms runs``; several give a Pareto front. None: the command's own
    #: figure of merit.
    objectives: tuple[str, ...] = ()
    #: Those among them of which more is better; of all others less is
    maximise: tuple[str, ...] = ()
    #: Largest allowed value of some figures, which no condition may exceed
    limits: Mapping[str, float] = field(default_factory=dict)
    #: The first is the configuration as it is, if ``baseline``
    trials: Annotated[int, Meta(ge=2)] = 60
    #: Tree-structured Parzen estimator (few trials), the genetic algorithm NSGA-II (hundreds of
    #: trials, several objectives), or values at random, to compare with
    method: Literal["tpe", "nsga2", "random"] = "tpe"
    #: Trials of a Latin hypercube before ``tpe`` learns
    startup_trials: Annotated[int, Meta(ge=1)] = 12
    #: Trials proposed together, from the results of the batches before: more keep more workers
    #: busy, fewer learn sooner. Of ``nsga2`` the population. None: 4, of ``nsga2`` 20.
    batch: Annotated[int, Meta(ge=1)] | None = None
    seed: Annotated[int, Meta(ge=0)] = 0  #: Of the search; the runs' own ``seed`` is another
    over_conditions: Literal["mean", "worst"] = "mean"  #: What of the conditions an objective is
    #: Rigs drawn from the priors, if there are any, the same for all trials
    draws: Annotated[int, Meta(ge=1)] = 4
    baseline: bool = True  #: Begin with the configuration as it is, so that the gain is told
    #: Fresh conditions under which the best trials, and the first, are run again: the score of the
    #: best of many is better than it will be again
    confirm: Annotated[int, Meta(ge=0)] = 0

    def start(self, space: Space, earlier_points: Sequence[SweepPoint] = ()) -> Trials:
        """Begin, or go on; see :class:`trms_cli.sweeps.plugins.Sampler`."""
        if not any(isinstance(varied, Range) for varied in space.continuous):
            raise ConfigurationError(
                "nothing is searched: no range among what was typed",
                where="sampler",
                remedy="write what may change, as "
                "'controller.state_weights.alpha_v=tag(log,interval(0.1,10))'",
            )
        if self.method == "nsga2" and self.batch_size() < 2:
            raise ConfigurationError(
                f"{self.batch} given", where="sampler.batch", remedy="a population has two or more"
            )
        return Trials(self, space, self._aims(), earlier_points)

    def batches(self) -> list[int]:
        """Trials of each batch in turn."""
        if self.method == "random":
            return [self.trials]
        first = self.batch_size()
        if self.method == "tpe":
            first = self.startup_trials + int(self.baseline)
        sizes = [min(first, self.trials)]
        while sum(sizes) < self.trials:
            sizes.append(min(self.batch_size(), self.trials - sum(sizes)))
        return sizes

    def batch_size(self) -> int:
        """Trials of a batch; of ``nsga2`` the population."""
        return self.batch or _BATCHES.get(self.method, self.trials)

    def _aims(self) -> Aims:
        objectives = canonical_all(self.objectives, "sampler.objectives") or (MERIT,)
        maximised = canonical_all(self.maximise, "sampler.maximise")
        for name in maximised:
            if name not in objectives:
                raise ConfigurationError(
                    f"{name!r} is no objective",
                    where="sampler.maximise",
                    remedy=f"objectives: {', '.join(objectives)}",
                )
        limits = canonical_limits(self.limits, "sampler.limits")
        typed = (*self.objectives, *self.limits)
        return Aims(
            objectives, frozenset(maximised), limits, self.over_conditions == "worst", typed
        )


#: Another stream of random numbers than those of the search.
_STARTUP = 0x53544152
#: Trials by which figures that none of them has are known not to exist.
_ENOUGH = 4
_SEARCH_ALL_THE_SAME = "to search all the same: sampler.baseline=false"


class Trials:
    """See :class:`trms_cli.sweeps.plugins.Proposals`.

    Points are numbered trial after trial, each trial's conditions in the same order; behind all
    trials stand the points of the confirmation. `known` was proposed before an interruption.
    """

    def __init__(
        self, config: Optimise, space: Space, aims: Aims, known: Sequence[SweepPoint] = ()
    ) -> None:
        from trms_cli.sweeps.samplers.search import OptimisationSearch

        self._config, self._space, self.aims = config, space, aims
        self._ranges = [each for each in space.continuous if isinstance(each, Range)]
        self.conditions = conditions_of(space, config.draws, config.seed)
        self._earlier_points = list(known)
        self._proposed_count = len(self._earlier_points)
        self._sizes = config.batches()
        self._search = OptimisationSearch(
            self._ranges,
            aims,
            config.method,
            config.seed,
            config.startup_trials,
            config.batch_size(),
        )
        self._startup = self._latin_hypercube()
        self.parts: list[drawing.Part] = []  #: what each trial sets, of those that are proposed
        self._optuna_trials: list[optuna.Trial | None] = []
        self._points: list[SweepPoint] = []
        self._results: dict[int, RunResult] = {}
        self._batch_number = 0  # of the batch that is to be told next
        self._confirming = False
        self._checked = False  # that the runs have the figures

    @property
    def total(self) -> int | None:
        """Points in all; None as long as nobody knows how many trials will be confirmed."""
        if self._config.confirm and not self._confirming:
            return None
        if self._confirming:
            return len(self._points)
        return self._config.trials * len(self.conditions)

    def more(self, results: Sequence[RunResult], count: int) -> list[SweepPoint]:
        """The next points: the rest of a batch at once, nothing while one is at work."""
        self._results |= {r.number: r for r in results if r.state != "interrupted"}
        self._check_figures()
        while not self._confirming and all(p.number in self._results for p in self._points):
            if self._batch_number < self._batches_proposed():
                self._tell()
            if len(self.parts) < self._config.trials:
                self._propose(self._sizes[self._batches_proposed()])
            else:
                self._confirm()
        fresh = self._points[self._proposed_count :]
        self._proposed_count = max(self._proposed_count, len(self._points))
        return fresh

    def summary(self, results: Mapping[int, RunResult]) -> dict[str, Any]:
        """What the search found, JSON data; see :func:`outcome`."""
        outcomes = self._outcomes(results)
        document = outcome(self.aims, self.parts, outcomes, len(self.conditions), self._space.fixed)
        document |= {
            "method": self._config.method,
            "baseline": 0 if self._config.baseline else None,
        }
        self._add_confirmed(document, results)
        return document

    def _batches_proposed(self) -> int:
        ends = np.cumsum([0, *self._sizes])
        return int(np.searchsorted(ends, len(self.parts)))

    def _propose(self, count: int) -> None:
        for number in range(len(self.parts), len(self.parts) + count):
            part, trial = self._trial(number)
            self.parts.append(part)
            self._optuna_trials.append(trial)
            for condition in self.conditions:
                self._add(drawing.Part(self._space.fixed) + condition + part, number)

    def _trial(self, number: int) -> tuple[drawing.Part, optuna.Trial | None]:
        """What a trial sets, and the trial of the study (None: outside of it)."""
        if number == 0 and self._config.baseline:
            now = {each.key: each.now for each in self._ranges}
            values = {k: v for k, v in now.items() if v is not None}
            inside = all(
                each.now is not None and each.low <= each.now <= each.high for each in self._ranges
            )
            start_values = {
                each.key: drawing.as_data(each, now[each.key] or 0.0) for each in self._ranges
            }
            return drawing.Part((), values), self._search.ask(0, start_values) if inside else None
        given_values = self._known_values(number) or self._startup.get(number)
        trial = self._search.ask(number, given_values)
        row = [trial.params[each.key] for each in self._ranges]
        return drawing.sample_part(self._ranges, row), trial

    def _known_values(self, number: int) -> dict[str, Any] | None:
        """Values that a trial had before the interruption."""
        first = number * len(self.conditions)
        if first >= len(self._earlier_points):
            return None
        values = self._earlier_points[first].values
        return {each.key: values[each.key] for each in self._ranges if each.key in values}

    def _latin_hypercube(self) -> dict[int, dict[str, Any]]:
        """Values of the trials of the first batch, by their numbers; none where all are random."""
        begin = int(self._config.baseline)
        count = self._sizes[0] - begin
        if self._config.method == "random" or count < 1:
            return {}
        shares = hypercube(count, len(self._ranges), [self._config.seed, _STARTUP])
        columns = [drawing.quantiles(each, shares[:, i]) for i, each in enumerate(self._ranges)]
        rows = zip(*columns, strict=True)
        return {
            begin + i: dict(drawing.sample_part(self._ranges, row).values or {})
            for i, row in enumerate(rows)
        }

    def _add(self, part: drawing.Part, trial: int) -> None:
        number = len(self._points)
        point = SweepPoint(number, part.overrides, part.values or {}, trial)
        if (
            number < len(self._earlier_points)
            and self._earlier_points[number].overrides != point.overrides
        ):
            raise drawing.another_point(self._earlier_points[number], "the keys of the sampler")
        self._points.append(point)

    def _check_figures(self) -> None:
        """End a search for what runs do not have before all are made.

        By the first trial where that is the configuration as it is. Otherwise, or if all of its
        runs failed, some trials are waited for: one of random values may lack what others have.
        """
        if self._checked:
            return
        ended = [
            own for n in range(len(self.parts)) if (own := self._trial_results(self._results, n))
        ]
        working = [own for own in ended if any(r.state == "done" for r in own)]
        first = self._trial_results(self._results, 0) if self._config.baseline else []
        if any(r.state == "done" for r in first):
            self.aims.check_figures(first, "the configuration as it is", _SEARCH_ALL_THE_SAME)
        elif len(working) >= min(_ENOUGH, self._config.trials):
            runs = [result for own in working for result in own]
            self.aims.check_figures(runs, f"{len(working)} trials")
        else:
            return
        self._checked = True

    def _tell(self) -> None:
        outcomes = self._outcomes(self._results)
        begin = sum(self._sizes[: self._batch_number])
        batch = range(begin, begin + self._sizes[self._batch_number])
        pairs = [(self._optuna_trials[number], outcomes[number]) for number in batch]
        self._search.tell([(trial, each) for trial, each in pairs if trial is not None and each])
        self._batch_number += 1

    def _outcomes(self, results: Mapping[int, RunResult]) -> list[TrialOutcome | None]:
        """What came of each trial, None of those whose runs have not all ended."""
        ended = [self._trial_results(results, number) for number in range(len(self.parts))]
        return [self.aims.outcome(own) if own else None for own in ended]

    def _trial_results(self, results: Mapping[int, RunResult], trial: int) -> list[RunResult]:
        """Results of a trial's runs; none as long as they have not all ended."""
        width = len(self.conditions)
        own = [results.get(trial * width + i) for i in range(width)]
        ended = [r for r in own if r is not None and r.state != "interrupted"]
        return ended if len(ended) == width else []

    def _confirm(self) -> None:
        """Propose the best trials again, and the first to compare with."""
        self._confirming = True
        if not self._config.confirm:
            return
        fresh = fresh_conditions(self._space, self._config.confirm, self._config.seed)
        first = [0] if self._config.baseline else []
        best = best_trials(self.aims, self._outcomes(self._results))
        for number in dict.fromkeys([*first, *best]):
            for condition in fresh:
                replaced = tuple(f"{key}=" for key in condition.values or {})
                fixed = tuple(t for t in self._space.fixed if not t.startswith(replaced))
                self._add(drawing.Part(fixed) + condition + self.parts[number], number)

    def _add_confirmed(self, document: dict[str, Any], results: Mapping[int, RunResult]) -> None:
        """Figures under fresh conditions, beside those that the trials were chosen by."""
        begin = self._config.trials * len(self.conditions)
        runs: dict[int, list[RunResult]] = {}
        for point in self._points[begin:]:
            assert point.trial is not None
            if point.number in results:
                runs.setdefault(point.trial, []).append(results[point.number])
        for record in document["trials"]:
            own = runs.get(record["trial"])
            if own:
                complete_runs = [result for result in own if result.state == "done"]
                record["confirmed"] = {
                    "runs": len(own),
                    "failed": len(own) - len(complete_runs),
                    "figures": dict(self.aims.outcome(complete_runs).figures)
                    if complete_runs
                    else {},
                }


def best_trials(aims: Aims, outcomes: Sequence[TrialOutcome | None]) -> list[int]:
    """Numbers of the trials that no other allowed trial dominates; of one objective the best."""
    allowed = [i for i, each in enumerate(outcomes) if each is not None and aims.is_feasible(each)]
    if not allowed:
        return []
    losses = np.array([aims.losses(each) for each in outcomes if each and aims.is_feasible(each)])
    if losses.shape[1] == 1:
        return [allowed[int(losses.argmin())]]
    order = front(losses)
    return [allowed[i] for i in order[np.argsort(losses[order, 0], kind="stable")]]


def outcome(
    aims: Aims,
    parts: Sequence[drawing.Part],
    outcomes: Sequence[TrialOutcome | None],
    conditions: int,
    fixed: Sequence[str],
) -> dict[str, Any]:
    """What is known of a search, also of one that was stopped.

    Returns ``objectives``: name, unit and direction of each. ``trials``: of each that has ended its
    number, the values that it set, what to type for them, its figures, whether it was allowed, or
    why it failed. ``pareto``: numbers of the best, along the first objective. ``best``: the number
    of the best for one objective. ``history``: after each trial the best so far, or with several
    objectives the hypervolume, None before there is one.
    """
    ended = [(i, each) for i, each in enumerate(outcomes) if each is not None]
    best = best_trials(aims, outcomes)
    return {
        "kind": "optimisation",
        "objectives": [
            {
                "name": name,
                "unit": unit_of(name, aims.objectives),
                "direction": "maximise" if name in aims.maximised else "minimise",
            }
            for name in aims.objectives
        ],
        "limits": dict(aims.limits),
        "over_conditions": "worst" if aims.worst else "mean",
        "conditions": conditions,
        "fixed": list(fixed),
        "trials": [_record(aims, i, parts[i], each, conditions) for i, each in ended],
        "pareto": best,
        "best": best[0] if best and len(aims.objectives) == 1 else None,
        "history": _history(aims, [each for _, each in ended]),
    }


def _record(
    aims: Aims, number: int, part: drawing.Part, trial_outcome: TrialOutcome, conditions: int
) -> dict[str, Any]:
    record: dict[str, Any] = {
        "trial": number,
        "points": list(range(number * conditions, (number + 1) * conditions)),
        "values": dict(part.values or {}),
        "overrides": list(part.overrides),
        "figures": dict(trial_outcome.figures),
        "allowed": aims.is_feasible(trial_outcome),
    }
    return record | ({"problem": trial_outcome.problem} if trial_outcome.failed else {})


def _history(aims: Aims, outcomes: Sequence[TrialOutcome]) -> list[float | None]:
    """After each trial: the best so far, or the hypervolume of the front so far."""
    allowed = [i for i, each in enumerate(outcomes) if aims.is_feasible(each)]
    steps: dict[int, float] = {}
    if allowed:
        losses = np.array([aims.losses(outcomes[i]) for i in allowed])
        if len(aims.objectives) == 1:
            sign = -1.0 if aims.maximised else 1.0
            so_far = [float(sign * value) for value in np.minimum.accumulate(losses[:, 0])]
        else:
            so_far = hypervolumes(losses) or []
        steps = dict(zip(allowed, so_far, strict=False))
    history: list[float | None] = []
    for i in range(len(outcomes)):
        history.append(steps.get(i, history[-1] if history else None))
    return history


#: Choices whose values are random numbers' seeds: fresh ones are conditions that nothing has seen.
_SEEDS = ("seed", "plant.prior_seed")
_FRESH = 0x46524553  # another stream of draws than that of the trials


def conditions_of(space: Space, draws: int, seed: int) -> list[drawing.Part]:
    """All conditions: every combination of choices with every draw.

    ``draws``: draws from the priors; one and the same for all trials. Without priors there is none.
    """
    rigs = _rigs(space, draws, [seed])
    return [rig + choice for rig in rigs for choice in drawing.choice_parts(space.choices)]


def fresh_conditions(space: Space, count: int, seed: int) -> list[drawing.Part]:
    """Conditions that no trial has seen: `count` seeds not used, each with a rig of its own.

    Seeds that were choices (``seed=1,2``, ``plant.prior_seed=range(5)``) are replaced, all other
    choices kept.
    """
    other_choices = tuple(choice for choice in space.choices if choice.key not in _SEEDS)
    seeded = [choice for choice in space.choices if choice.key in _SEEDS]
    if not any(choice.key == "seed" for choice in seeded):
        seeded.append(Choice("seed", ()))
    columns = [_unused(choice, space.fixed, count) for choice in seeded]
    rigs = _rigs(space, count, [seed, _FRESH])
    parts = []
    for i in range(count):
        values = {choice.key: column[i] for choice, column in zip(seeded, columns, strict=True)}
        condition = drawing.Part(tuple(f"{key}={value}" for key, value in values.items()), values)
        parts += [
            rigs[i % len(rigs)] + condition + choice
            for choice in drawing.choice_parts(other_choices)
        ]
    return parts


def _rigs(space: Space, draws: int, seed: Sequence[int]) -> list[drawing.Part]:
    priors = [varied for varied in space.continuous if isinstance(varied, PriorOfKey)]
    if not priors:
        return [drawing.Part()]
    shares = hypercube(draws, len(priors), list(seed))
    columns = [drawing.quantiles(prior, shares[:, i]) for i, prior in enumerate(priors)]
    return [drawing.sample_part(priors, row) for row in zip(*columns, strict=True)]


def _unused(choice: Choice, fixed: Sequence[str], count: int) -> list[str]:
    """Seeds that are neither among the values of a choice nor fixed, nor the default."""
    typed = [text.partition("=") for text in fixed]
    used = {*choice.values, "0", *(value for key, _, value in typed if key == choice.key)}
    return list(islice((str(n) for n in range(1, 10**9) if str(n) not in used), count))
