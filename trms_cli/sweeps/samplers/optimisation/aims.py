"""What a search is after: objectives, limits, and which trials are the best of those tried."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import nearest
from trms_cli.sweeps.figures import figure_of
from trms_cli.sweeps.point import Result

FloatArray = npt.NDArray[np.float64]

#: The reference of a hypervolume lies so far beyond the worst of the front, in its own spans.
_MARGIN = 0.1


@dataclass(frozen=True)
class Tried:
    """What came of a trial.

    Attributes
    ----------
    figures : dict of str to float
        Objectives and limited figures over its conditions; empty for a trial that failed.
    problem : str
        Why it failed.
    """

    figures: Mapping[str, float] = field(default_factory=dict)
    problem: str = ""

    @property
    def failed(self) -> bool:
        """Whether a run of it failed, or had no figure to judge it by."""
        return not self.figures


@dataclass(frozen=True)
class Aims:
    """Objectives and limits.

    Attributes
    ----------
    objectives : tuple of str
        Names as scores have them.
    maximised : frozenset of str
        Those of which more is better.
    limits : dict of str to float
        Largest allowed value of figures, in each condition.
    worst : bool
        An objective is that of the worst condition, not the mean.
    """

    objectives: tuple[str, ...]
    maximised: frozenset[str] = frozenset()
    limits: Mapping[str, float] = field(default_factory=dict)
    worst: bool = False

    def tried(self, results: Sequence[Result]) -> Tried:
        """A trial by the results of its conditions: one that failed makes the trial fail."""
        for result in results:
            if result.state != "done":
                return Tried(problem=result.problem or result.state)
        figures: dict[str, float] = {}
        for name in dict.fromkeys((*self.objectives, *self.limits)):
            values = [figure_of(result, name) for result in results]
            present = [value for value in values if value is not None]
            if len(present) < len(values):
                return Tried(problem=f"a run has no {name}")
            if name in self.objectives:
                figures[name] = self._over_conditions(name, present)
            if name in self.limits:
                figures[_limited(name)] = max(present)
        return Tried(figures)

    def _over_conditions(self, name: str, values: Sequence[float]) -> float:
        if self.worst:
            return min(values) if name in self.maximised else max(values)
        return float(np.mean(values))

    def losses(self, tried: Tried) -> list[float]:
        """Objectives of a trial that did not fail, as what is to be small."""
        signs = (-1.0 if name in self.maximised else 1.0 for name in self.objectives)
        return [sign * tried.figures[n] for sign, n in zip(signs, self.objectives, strict=True)]

    def excess(self, tried: Tried) -> list[float]:
        """By how much limits are exceeded, relative to them; not positive where they are held."""
        return [
            (tried.figures[_limited(name)] - bound) / (abs(bound) or 1.0)
            for name, bound in self.limits.items()
        ]

    def allowed(self, tried: Tried) -> bool:
        """Whether a trial did not fail and holds all limits."""
        return not tried.failed and all(excess <= 0 for excess in self.excess(tried))

    def check_figures(self, results: Iterable[Result]) -> None:
        """Refuse objectives that none of the runs has.

        Raises
        ------
        ConfigurationError
            It tells which figures the runs have.
        """
        done = [result for result in results if result.state == "done"]
        for name in (*self.objectives, *self.limits):
            if done and all(figure_of(result, name) is None for result in done):
                known = {n for result in done for n in result.figures}
                raise ConfigurationError(
                    f"none of {len(done)} runs has a figure {name!r}",
                    where="sampler.limits" if name in self.limits else "sampler.objectives",
                    remedy=nearest(name, known),
                )


def _limited(name: str) -> str:
    """Key of the worst value of a limited figure, which may be an objective by its mean, too."""
    return f"worst {name}"


def front(losses: FloatArray) -> npt.NDArray[np.intp]:
    """Rows that no other row dominates: as small in everything, and smaller in something.

    Parameters
    ----------
    losses : (n, k) array

    Returns
    -------
    (m,) array
        Their positions; of equal rows all.
    """
    if not len(losses):
        return np.zeros(0, dtype=np.intp)
    no_worse = (losses[:, None, :] <= losses[None, :, :]).all(axis=2)
    better = (losses[:, None, :] < losses[None, :, :]).any(axis=2)
    return np.flatnonzero(~(no_worse & better).any(axis=0))


def hypervolumes(losses: FloatArray) -> list[float] | None:
    """Volume that the first 1, 2, … rows dominate, in spans of the front of all of them.

    The reference point lies a tenth of a span beyond the worst of the front: two objectives whose
    front is an ideal corner would have 1.21.

    Returns
    -------
    list of float or None
        None where the front is a single point, which spans nothing.
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
