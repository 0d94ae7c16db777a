"""The search itself, by Optuna: a study in memory that is asked for trials and told of results.

A proposal is a function of the configuration and of the results of the batches before, and of
nothing else: not of how many workers there are, nor which of them was faster. So a search that is
repeated, or goes on after an interruption, proposes the same.
"""

import warnings
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from typing import Any, Literal

import numpy as np
import optuna
from optuna.distributions import BaseDistribution, FloatDistribution, IntDistribution

from trms_cli.sweeps.samplers.drawing import as_data, round_within
from trms_cli.sweeps.samplers.objectives import Aims, TrialOutcome
from trms_cli.sweeps.space import Range

Method = Literal["tpe", "nsga2", "random"]
_EXCESS = "excess"
#: What a trial that failed is told to exceed its limits by.
_FAILED_EXCESS = 1.0
#: A trial that failed is told as worse than the worst of the others, by this share of their span.
_WORSE = 0.1


class OptimisationSearch:
    """A study whose first `startup` trials learn from no others; `population`: of ``nsga2``."""

    def __init__(
        self,
        ranges: Sequence[Range],
        aims: Aims,
        method: Method,
        seed: int,
        startup: int,
        population: int,
    ) -> None:
        self._ranges = {each.key: each for each in ranges}
        self._distributions: dict[str, BaseDistribution] = {
            each.key: _distribution(each) for each in ranges
        }
        self._aims = aims
        self._method, self._seed = method, seed
        self._startup, self._population = startup, population
        self._losses: list[list[float]] = []
        with _quiet():
            self._study = optuna.create_study(directions=["minimize"] * len(aims.objectives))

    def ask(self, number: int, values: Mapping[str, Any] | None = None) -> optuna.Trial:
        """A trial.

        ``number``: of the trial, from which its random numbers come. ``values``: its values where
        they are not for the method to choose.
        """
        with _quiet():
            self._study.sampler = _Choosing(self._sampler(number), self._ranges, values or {})
            return self._study.ask(self._distributions)

    def tell(self, batch: Sequence[tuple[optuna.Trial, TrialOutcome]]) -> None:
        """What came of a batch.

        A trial that failed is told as worse in every objective than all that did not; as long as
        none has succeeded, nothing is learnt from it.
        """
        self._losses += [self._aims.losses(outcome) for _, outcome in batch if not outcome.failed]
        with _quiet():
            for trial, outcome in batch:
                if not outcome.failed:
                    trial.set_user_attr(_EXCESS, self._aims.excess(outcome))
                    self._study.tell(trial, self._aims.losses(outcome))
                elif self._losses:
                    trial.set_user_attr(_EXCESS, [_FAILED_EXCESS] * len(self._aims.limits))
                    self._study.tell(trial, self._worse_than_all())
                else:
                    self._study.tell(trial, state=optuna.trial.TrialState.FAIL)

    def _worse_than_all(self) -> list[float]:
        losses = np.array(self._losses)
        span = np.ptp(losses, axis=0)
        return list(losses.max(axis=0) + _WORSE * np.where(span > 0, span, 1.0))

    def _sampler(self, number: int) -> optuna.samplers.BaseSampler:
        seed = int(np.random.SeedSequence([self._seed, number]).generate_state(1)[0])
        constraints = _excess_of if self._aims.limits else None
        if self._method == "random":
            return optuna.samplers.RandomSampler(seed=seed)
        if self._method == "nsga2":
            return optuna.samplers.NSGAIISampler(
                population_size=self._population, seed=seed, constraints_func=constraints
            )
        return optuna.samplers.TPESampler(
            n_startup_trials=self._startup,
            multivariate=True,
            constant_liar=True,
            seed=seed,
            constraints_func=constraints,
        )


class _Choosing(optuna.samplers.BaseSampler):
    """Another sampler whose numbers are given, or have as few digits as are typed for a run.

    What Optuna learns from is thus what was run, also when a search goes on from its files.
    Optuna's own way of giving values (``enqueue_trial``) passes the sampler by, and NSGA-II does
    then not count such a trial to its population.
    """

    def __init__(
        self,
        inner: optuna.samplers.BaseSampler,
        ranges: Mapping[str, Range],
        given: Mapping[str, Any],
    ) -> None:
        self._inner = inner
        self._ranges = ranges
        self._fixed_values = given

    def infer_relative_search_space(
        self, study: optuna.Study, trial: optuna.trial.FrozenTrial
    ) -> dict[str, BaseDistribution]:
        return self._inner.infer_relative_search_space(study, trial)

    def sample_relative(
        self,
        study: optuna.Study,
        trial: optuna.trial.FrozenTrial,
        search_space: dict[str, BaseDistribution],
    ) -> dict[str, Any]:
        sampled = self._inner.sample_relative(study, trial, search_space)
        if self._fixed_values:
            return {key: self._fixed_values[key] for key in search_space}
        return {key: self._rounded(key, value) for key, value in sampled.items()}

    def sample_independent(
        self,
        study: optuna.Study,
        trial: optuna.trial.FrozenTrial,
        param_name: str,
        param_distribution: BaseDistribution,
    ) -> Any:
        if param_name in self._fixed_values:
            return self._fixed_values[param_name]
        value = self._inner.sample_independent(study, trial, param_name, param_distribution)
        return self._rounded(param_name, value)

    def before_trial(self, study: optuna.Study, trial: optuna.trial.FrozenTrial) -> None:
        self._inner.before_trial(study, trial)

    def after_trial(
        self,
        study: optuna.Study,
        trial: optuna.trial.FrozenTrial,
        state: optuna.trial.TrialState,
        values: Sequence[float] | None,
    ) -> None:
        self._inner.after_trial(study, trial, state, values)

    def _rounded(self, key: str, value: Any) -> float | int:
        varied = self._ranges[key]
        return as_data(varied, round_within(varied, float(value)))


def _distribution(varied: Range) -> BaseDistribution:
    if varied.whole:
        return IntDistribution(int(varied.low), int(varied.high), log=varied.logarithmic)
    return FloatDistribution(varied.low, varied.high, log=varied.logarithmic)


def _excess_of(trial: optuna.trial.FrozenTrial) -> Sequence[float]:
    return list(trial.user_attrs[_EXCESS])


def _quiet() -> AbstractContextManager[Any]:
    """Without Optuna's log, and its warnings of what is experimental or to be renamed."""
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    return warnings.catch_warnings(action="ignore")
