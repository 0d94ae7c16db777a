"""A search for the best values, by Optuna: tuning of a controller's weights against its scores.

What is searched are the ranges (``controller.state_weights.alpha_v=tag(log,interval(0.1,10))``).
Every trial is run under all conditions: the choices (``ref=square,sine``) crossed with rigs drawn
from the priors (``plant.parameters=prior``). All trials see the same conditions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Literal

from msgspec import Meta

from trms_cli.core.errors import ConfigurationError
from trms_cli.sweeps.figures import MERIT, canonical_all, canonical_limits
from trms_cli.sweeps.samplers.objectives import Aims
from trms_cli.sweeps.samplers.trials import Trials
from trms_cli.sweeps.space import Range, Space, SweepPoint

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

    def start(self, space: Space, known: Sequence[SweepPoint] = ()) -> Trials:
        """Begin, or go on; see :class:`trms_cli.sweeps.plugins.Sampler`."""
        if not any(isinstance(varied, Range) for varied in space.continuous):
            raise ConfigurationError(
                "nothing is searched: no range among what was typed",
                where="sampler",
                remedy="write what may change, as "
                "'controller.state_weights.alpha_v=tag(log,interval(0.1,10))'",
            )
        if self.method == "nsga2" and self._batch() < 2:
            raise ConfigurationError(
                f"{self.batch} given", where="sampler.batch", remedy="a population has two or more"
            )
        return Trials(self, space, self._aims(), known)

    def batches(self) -> list[int]:
        """Trials of each batch in turn."""
        if self.method == "random":
            return [self.trials]
        first = self._batch()
        if self.method == "tpe":
            first = self.startup_trials + int(self.baseline)
        sizes = [min(first, self.trials)]
        while sum(sizes) < self.trials:
            sizes.append(min(self._batch(), self.trials - sum(sizes)))
        return sizes

    @property
    def population(self) -> int:
        """Of ``nsga2``."""
        return self._batch()

    def _batch(self) -> int:
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
