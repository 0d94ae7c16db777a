"""A model that competes: the nominal one with some effects, over the same windows as all others."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from weakref import WeakKeyDictionary

import numpy as np
import numpy.typing as npt

from trms_cli.gap.candidates import Suspect, joint
from trms_cli.gap.fitting.evidence import Evidence, evidence
from trms_cli.gap.fitting.metric import Metric
from trms_cli.gap.fitting.objective import InnovationObjective
from trms_cli.identification.dataset import Dataset
from trms_cli.identification.greybox.levenberg_marquardt import Point, minimise
from trms_cli.identification.greybox.windows import Windows
from trms_cli.identification.method import Outcome
from trms_cli.identification.problem import FitProblem, FreeParameter
from trms_cli.models.model import Model
from trms_cli.simulation.rollout import Rollout

FloatArray = npt.NDArray[np.float64]

#: Compiled models by nominal model: many recordings of one model are diagnosed in one process.
_ROLLOUTS: WeakKeyDictionary[Model, dict[tuple[object, ...], Rollout]] = WeakKeyDictionary()


@dataclass(frozen=True)
class Fit:
    """Where a contestant ended."""

    theta: FloatArray  #: (n_f,) array; nominal parameters, then the effects' sizes
    starts: FloatArray  #: (m, n_x) array
    cost: float  #: Nats
    outcome: Outcome
    agreed: bool = True  #: Whether searches from several starts ended at one cost
    evidence: Evidence | None = None  #: Where it was asked for

    @property
    def score(self) -> float:
        """Summed log predictive density of the blocks, nats; −∞ without evidence."""
        return -np.inf if self.evidence is None else float(self.evidence.predictive.sum())


class Contestant:
    """The nominal model with effects, ready to be fitted.

    Parameters
    ----------
    nominal : Model
    free : sequence of FreeParameter
        Of the nominal model.
    effects : sequence of Suspect
    datasets : sequence of Dataset
    block : float
        s.

    Attributes
    ----------
    windows : Windows
    problem : FitProblem
    """

    def __init__(
        self,
        nominal: Model,
        free: Sequence[FreeParameter],
        effects: Sequence[Suspect],
        datasets: Sequence[Dataset],
        block: float,
    ) -> None:
        self.effects = tuple(effects)
        sizes = [size for suspect in effects for size in suspect.free]
        names = tuple(suspect.name for suspect in effects)
        known = _ROLLOUTS.setdefault(nominal, {})
        step = datasets[0].sample_time
        key = (names, tuple(s.effect for s in effects), round(step, 9), tuple(p.name for p in free))
        rollout = known.get(key)
        model = joint(nominal, self.effects) if rollout is None else rollout.model
        order = {name: i for i, name in enumerate(model.parameters.names)}
        every = sorted((*free, *sizes), key=lambda p: order[p.name])
        self.problem = FitProblem(
            model=model, datasets=tuple(datasets), free=tuple(every), window_length=block, jobs=1
        )
        self.windows = Windows(self.problem, rollout=rollout)
        known[key] = self.windows.rollout

    @property
    def names(self) -> tuple[str, ...]:
        """Names of its effects."""
        return tuple(suspect.name for suspect in self.effects)

    def theta(self, values: Mapping[str, float]) -> FloatArray:
        """The free parameters by name as a vector (n_f,); those not named at their starts."""
        return np.array([values.get(p.name, p.start) for p in self.problem.free])

    def values(self, theta: FloatArray) -> dict[str, float]:
        """The vector (n_f,) by name."""
        return dict(zip(self.problem.names, theta.tolist(), strict=True))

    def starts(self, theta: FloatArray, nominal: FloatArray) -> FloatArray:
        """Starts (m, n_x): those of the nominal model's states as given, the rest estimated."""
        n = nominal.shape[1]
        if self.windows.n_x == n:
            return nominal
        estimated = self.windows.starts(self.problem.all_values(theta))
        return np.hstack([nominal, estimated[:, n:]])

    def fit(
        self,
        metric: Metric,
        points: Sequence[tuple[FloatArray, FloatArray]],
        *,
        centres: FloatArray,
        iterations: int = 25,
        tolerance: float = 0.05,
        with_evidence: bool = True,
    ) -> Fit:
        """Search from some points and keep the best.

        Parameters
        ----------
        points : sequence of (theta, starts)
        centres : (m, n_nominal states) array
            Of the starts' priors, the same for all who compete.
        """
        bounds = self.problem.bounds
        searches = []
        for theta, starts in points:
            objective = InnovationObjective(self.windows, metric, self.starts(theta, centres))
            searches.append(
                minimise(
                    objective,  # type: ignore[arg-type]
                    Point(theta, starts, np.inf),
                    bounds=bounds,
                    iterations=iterations,
                    tolerance=tolerance,
                )
            )
        best = min(searches, key=lambda search: search.point.cost)
        found = best.point
        fit = Fit(
            found.theta,
            found.starts,
            found.cost,
            best.outcome,
            sum(search.point.cost < found.cost + 3.0 for search in searches) > 1
            or len(searches) == 1,
        )
        if with_evidence and np.isfinite(found.cost):
            objective = InnovationObjective(self.windows, metric, self.starts(found.theta, centres))
            worth = evidence(objective, found.theta, found.starts, bounds)
            fit = replace(fit, evidence=worth)
        return fit

    def residuals(self, fit: Fit) -> FloatArray:
        """Measured less predicted at a fit, (m, c, n_y)."""
        p = self.problem.all_values(fit.theta)
        return -self.windows.residuals(p, fit.starts).r
