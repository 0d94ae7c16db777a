"""What a search is after: objectives, limits, and which trials are the best of those tried."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from trms_cli.core.errors import ConfigurationError
from trms_cli.sweeps.figures import figure_of, near_figures, objective_name, with_aliases
from trms_cli.sweeps.space import RunResult

FloatArray = npt.NDArray[np.float64]

#: The reference of a hypervolume lies so far beyond the worst of the front, in its own spans.
_MARGIN = 0.1
_UNSETTLED = ", which exists where there are steps and every one settles"


@dataclass(frozen=True)
class TrialOutcome:
    """What came of a trial."""

    #: Objectives and limited figures over its conditions; empty for a trial that failed
    figures: Mapping[str, float] = field(default_factory=dict)
    problem: str = ""  #: Why it failed

    @property
    def failed(self) -> bool:
        """Whether a run of it failed, or had no figure to judge it by."""
        return not self.figures


@dataclass(frozen=True)
class Aims:
    """Objectives and limits."""

    objectives: tuple[str, ...]  #: Names as scores have them
    maximised: frozenset[str] = frozenset()  #: Those of which more is better
    #: Largest allowed value of figures, in each condition
    limits: Mapping[str, float] = field(default_factory=dict)
    worst: bool = False  #: An objective is that of the worst condition, not the mean
    typed: tuple[str, ...] = ()  #: Objectives and limited figures as they were typed, for messages

    def outcome(self, results: Sequence[RunResult]) -> TrialOutcome:
        """A trial by the results of its conditions.

        One that failed makes the trial fail, and so does one without a figure to judge it by (the
        settling time of a step that never settled): either is worse than all that have it.
        """
        for result in results:
            if result.state != "done":
                return TrialOutcome(problem=result.problem or result.state)
        figures: dict[str, float] = {}
        for name in dict.fromkeys((*self.objectives, *self.limits)):
            values = [figure_of(result, name) for result in results]
            present = [value for value in values if value is not None]
            if len(present) < len(values):
                return TrialOutcome(problem=f"a run has no {objective_name(name, self.typed)}")
            if name in self.objectives and not self.worst:
                figures[name] = float(np.mean(present))
            elif name in self.objectives:
                figures[name] = min(present) if name in self.maximised else max(present)
            if name in self.limits:
                figures[_limited(name)] = max(present)
        return TrialOutcome(figures)

    def losses(self, outcome: TrialOutcome) -> list[float]:
        """Objectives of a trial that did not fail, as what is to be small."""
        signs = (-1.0 if name in self.maximised else 1.0 for name in self.objectives)
        return [sign * outcome.figures[n] for sign, n in zip(signs, self.objectives, strict=True)]

    def excess(self, outcome: TrialOutcome) -> list[float]:
        """By how much limits are exceeded, relative to them; not positive where they are held."""
        return [
            (outcome.figures[_limited(name)] - bound) / (abs(bound) or 1.0)
            for name, bound in self.limits.items()
        ]

    def is_feasible(self, outcome: TrialOutcome) -> bool:
        """Whether a trial did not fail and holds all limits."""
        return not outcome.failed and all(excess <= 0 for excess in self.excess(outcome))

    def check_figures(self, results: Iterable[RunResult], of: str, remedy: str = "") -> None:
        """Refuse objectives and limited figures that none of the runs that are done has.

        `of` says whose runs these are, `remedy` what else helps than another figure. Raises
        ConfigurationError: it tells the figure as it was typed, and those of the runs that are
        near.
        """
        complete_results = [result for result in results if result.state == "done"]
        for name in (*self.objectives, *self.limits):
            if complete_results and all(
                figure_of(result, name) is None for result in complete_results
            ):
                said = objective_name(name, self.typed)
                figure_names = with_aliases(
                    {n for result in complete_results for n in result.figures}
                )
                reason = _UNSETTLED if name.startswith("settling_time") else ""
                raise ConfigurationError(
                    f"none of the {len(complete_results)} runs of {of} has a figure "
                    f"{said!r}{reason}",
                    where="sampler.objectives" if name in self.objectives else "sampler.limits",
                    remedy="; ".join(filter(None, (near_figures(said, figure_names), remedy))),
                )


def _limited(name: str) -> str:
    """Key of the worst value of a limited figure, which may be an objective by its mean, too."""
    return f"worst {name}"


def front(losses: FloatArray) -> npt.NDArray[np.intp]:
    """Rows that no other row dominates: as small in everything, and smaller in something.

    ``losses``: (n, k) array. Returns (m,) array; their positions; of equal rows all.
    """
    is_on_front = np.ones(len(losses), dtype=bool)
    for i in np.lexsort(losses.T[::-1]):
        if is_on_front[i]:
            beaten = (losses[i] <= losses).all(axis=1) & (losses[i] < losses).any(axis=1)
            is_on_front &= ~beaten
    return np.flatnonzero(is_on_front)


def hypervolumes(losses: FloatArray) -> list[float] | None:
    """Volume that the first 1, 2, … rows dominate, in spans of the front of all of them.

    The reference point lies a tenth of a span beyond the worst of the front: two objectives whose
    front is an ideal corner would have 1.21.

    Returns None where the front is a single point, which spans nothing.
    """
    from optuna._hypervolume import compute_hypervolume

    best = losses[front(losses)]
    low, high = best.min(axis=0), best.max(axis=0)
    if (high <= low).any():
        return None
    scaled = (losses - low) / (high - low)
    reference = np.full(losses.shape[1], 1.0 + _MARGIN)
    volumes: list[float] = []
    inside = np.zeros((0, losses.shape[1]))
    for row in scaled:
        if (row < reference).all():
            inside = np.vstack([inside, row])
            inside = np.unique(inside[front(inside)], axis=0)
        volumes.append(float(compute_hypervolume(inside, reference)) if len(inside) else 0.0)
    return volumes
