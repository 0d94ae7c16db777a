"""Many runs as a report sees them: a row of figures each, and what was varied between them."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from trms_cli.core import wording
from trms_cli.sweeps.samplers.objectives import front

#: What a key or figure may be of a run.
Value = str | float | int | bool | None


@dataclass(frozen=True, kw_only=True)
class SweepRun:
    """A run of many."""

    name: str  #: Its folder, from that of all
    entrant: str = ""  #: Who ran: the options and settings that a ranking tells apart
    outcome: str = "completed"  #: ``completed``, ``failed``, ``interrupted``, ``unfinished``, ….
    #: dict of str to value; by key that differs between runs (:attr:`SweepReport.keys`)
    values: Mapping[str, Value] = field(default_factory=dict)
    #: By name (:attr:`SweepReport.figures`); missing for what it does not have
    figures: Mapping[str, float] = field(default_factory=dict)
    problem: str = ""  #: Why it failed
    page: str = ""  #: Address of its own report from the page's folder; "" if it has none
    number: int | None = None  #: Of the sweep's run, as its folder is called

    @property
    def failed(self) -> bool:
        """Whether something went wrong with it."""
        return self.outcome not in ("completed", "unfinished")


@dataclass(frozen=True)
class Objective:
    """What an optimisation seeks."""

    figure: str  #: Name of a figure
    largest: bool = False  #: It seeks the largest, not the least


@dataclass(frozen=True, kw_only=True)
class FailureShare:
    """How often the draws of an entrant failed."""

    who: str
    draws: int
    count: int = 0  #: How many of them failed or did not hold a limit
    share: float | None = None
    low: float | None = None  #: End of the share's interval of 95 %
    high: float | None = None  #: End of the share's interval of 95 %


@dataclass(frozen=True, kw_only=True)
class Correlation:
    """How a figure of an entrant hangs on a drawn value."""

    who: str
    key: str
    figure: str
    rho: float  #: Spearman's rank correlation
    p: float | None = (
        None  #: How likely chance gives as much, adjusted for the number of correlations
    )


@dataclass(frozen=True, kw_only=True)
class Draws:
    """What a sweep over drawn values says."""

    keys: Sequence[str]  #: What was drawn, the most strongly correlated first
    limits: Mapping[str, float] = field(default_factory=dict)  #: Bounds that a figure was to hold
    failures: Sequence[FailureShare] = ()
    correlations: Sequence[Correlation] = ()  #: The strongest first


@dataclass(frozen=True, kw_only=True)
class SweepReport:
    """Many runs."""

    name: str
    runs: Sequence[SweepRun]
    keys: Sequence[str] = ()  #: Keys and options in which runs differ
    #: Names of figures with their units, those that say most first
    figures: Mapping[str, str] = field(default_factory=dict)
    objectives: Sequence[Objective] = ()  #: Of an optimisation; empty for other sweeps
    #: Numbers of the trials, or runs, of which none is better in all objectives; empty: worked out
    #: here
    pareto: Sequence[int] = ()
    #: What an optimisation tried, each under several conditions, with figures over all of them;
    #: empty: each run is a trial
    trials: Sequence[SweepRun] = ()
    #: After each trial the best value so far; of several objectives the volume that the front
    #: dominates
    history: Sequence[float | None] = ()
    planned_count: int | None = None  #: How many runs there were to be; None where nobody said
    draws: Draws | None = None  #: Of a sweep over drawn values
    left_out: Sequence[tuple[str, str]] = ()  #: Files that could not be read, with the reason
    facts: Mapping[str, str] = field(default_factory=dict)

    @cached_property
    def entrants(self) -> list[str]:
        """Who ran, in the order of the runs."""
        return list(dict.fromkeys(run.entrant for run in self.runs))

    @cached_property
    def numeric_keys(self) -> list[str]:
        """Keys whose values are numbers, seeds (which have no order) last."""
        matches = [key for key in self.keys if self._is_numeric(key)]
        return sorted(matches, key=lambda key: key.endswith("seed"))

    @cached_property
    def drawn_keys(self) -> frozenset[str]:
        """Keys whose values were drawn."""
        return frozenset(self.draws.keys if self.draws else ())

    def names_entrants(self, key: str) -> bool:
        """Whether one key alone tells who ran."""
        key_runs = [run for run in self.runs if run.values.get(key) is not None]
        return bool(key_runs) and all(str(run.values[key]) == run.entrant for run in key_runs)

    def title(self, figure: str) -> str:
        """``rmse_yaw [rad]``."""
        return wording.with_unit(figure, self.figures.get(figure, ""))

    def of(self, entrant: str) -> list[SweepRun]:
        """Runs of an entrant that ended well, or go on."""
        return [run for run in self.runs if run.entrant == entrant and not run.failed]

    @property
    def candidates(self) -> Sequence[SweepRun]:
        """What an optimisation chooses between: trials, or runs where each is one."""
        return self.trials or self.runs

    def front(self) -> list[SweepRun]:
        """Trials, or runs, of which no other is as good in all objectives and better in one.

        As the sweep names them, of those that are here; else worked out.
        """
        named = {run.number: run for run in self.candidates if run.number is not None}
        front_runs = [named[number] for number in self.pareto if number in named]
        if front_runs:
            return front_runs
        signs = [-1.0 if objective.largest else 1.0 for objective in self.objectives]
        candidates = [
            run
            for run in self.candidates
            if not run.failed and all(o.figure in run.figures for o in self.objectives)
        ]
        if not candidates or not signs:
            return []
        names = [objective.figure for objective in self.objectives]
        costs = np.array([[run.figures[name] for name in names] for run in candidates]) * signs
        return [candidates[i] for i in front(costs)]

    def _is_numeric(self, key: str) -> bool:
        present = [run.values[key] for run in self.runs if run.values.get(key) is not None]
        return bool(present) and all(
            isinstance(v, (int, float)) and not isinstance(v, bool) and math.isfinite(v)
            for v in present
        )
