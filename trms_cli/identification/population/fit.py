"""From a fit problem to a search of the unit box, and from what it found to a result."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import accumulate
from typing import Any

import numpy as np
import numpy.typing as npt

from trms_cli.core.errors import ConfigurationError
from trms_cli.identification.method import FitResult, HistoryPoint, Outcome, Progress
from trms_cli.identification.population.evolution import Evolved, Search, evolve, on_threads
from trms_cli.identification.population.journal import Journal
from trms_cli.identification.population.simulation_cost import SimulationCost
from trms_cli.identification.problem import FitProblem

FloatArray = npt.NDArray[np.float64]


class Box:
    """The unit box, and what its points mean.

    Parameters
    ----------
    problem : FitProblem
    spread : float
        Half the width of the box in prior standard deviations; bounds cut it.

    Raises
    ------
    ConfigurationError
        If no parameter is free.
    """

    def __init__(self, problem: FitProblem, spread: float) -> None:
        if not problem.free:
            raise ConfigurationError(
                "no parameter is free", where="free", remedy="free=[priors], or name some"
            )
        ranges = np.array([parameter.search_range(spread) for parameter in problem.free])
        self.lower, self.upper = ranges[:, 0], ranges[:, 1]
        self._problem = problem

    @property
    def dimension(self) -> int:
        return len(self.lower)

    def values(self, point: FloatArray) -> FloatArray:
        """Parameters at points, (…, n) to (…, n)."""
        values: FloatArray = self.lower + point * (self.upper - self.lower)
        return values

    def point(self, theta: FloatArray) -> FloatArray:
        """The point of parameters, (…, n), moved into the box."""
        inside: FloatArray = np.clip((theta - self.lower) / (self.upper - self.lower), 0.0, 1.0)
        return inside

    def drawn(self, number: int, generator: np.random.Generator) -> FloatArray:
        """Points drawn from the priors, evenly where there is none, shape (number, n).

        The first is the start.
        """
        free = self._problem.free
        normal = generator.standard_normal((number, self.dimension))
        even = generator.uniform(size=(number, self.dimension))
        points = np.empty((number, self.dimension))
        for i, parameter in enumerate(free):
            if parameter.prior_sd is None:
                points[:, i] = even[:, i]
                continue
            value = parameter.prior_mean + parameter.prior_sd * normal[:, i]
            point = (value - self.lower[i]) / (self.upper[i] - self.lower[i])
            # Beyond an edge a draw is made evenly instead: at the edge many would be alike.
            points[:, i] = np.where((point < 0) | (point > 1), even[:, i], point)
        points[0] = self.point(self._problem.starts)
        return points


def search_fit(
    method: str,
    problem: FitProblem,
    progress: Progress,
    search: Callable[[Box, int], Search],
    *,
    box: Box,
    evaluations: int,
    settings: Mapping[str, Any],
    unit: str,
) -> FitResult:
    """Fit by a search, resumed from what ``progress`` has kept.

    Parameters
    ----------
    search : callable
        ``(box, seed)`` to a search.
    evaluations : int
        Budget, simulations of all recordings.
    settings : mapping
        All that the search depends on besides problem and budget, as plain data.
    unit : str
        What a turn of the search is called.
    """
    cost = SimulationCost(problem)
    evaluate = on_threads(lambda point: cost(box.values(point)), problem.jobs)
    journal = Journal(_about(method, problem, box, settings), progress.saved())

    def watch(found: Evolved) -> bool:
        progress.save(journal.state)
        message = f"{unit} {len(found.costs)}, {found.evaluations} simulations"
        return progress.update(found.evaluations / evaluations, found.cost, message)

    found = evolve(
        search(box, problem.seed),
        evaluate,
        evaluations=evaluations,
        dimension=box.dimension,
        journal=journal,
        watch=watch,
    )
    values = box.values(found.best)
    state = journal.state["generations"]
    done = list(accumulate(len(entry["costs"]) for entry in state[: len(found.costs)]))
    history = [
        HistoryPoint(number, entry["seconds"], best)
        for number, entry, (best, _) in zip(done, state, found.costs, strict=False)
    ]
    return FitResult(
        method=method,
        outcome=_outcome(found),
        cost=found.cost,
        values=dict(zip(problem.names, values.tolist(), strict=True)),
        history=history,
        evaluations=found.evaluations,
        seconds=found.seconds,
        details={
            "ended": found.ended or ("stopped" if found.stopped else "the budget was spent"),
            unit + "s": len(found.costs),
            "median_cost": [None if np.isinf(m) else m for _, m in found.costs],
        },
    )


def _outcome(found: Evolved) -> Outcome:
    if not np.isfinite(found.cost):
        return Outcome.FAILED
    if found.stopped:
        return Outcome.INTERRUPTED
    return Outcome.CONVERGED if found.ended else Outcome.BUDGET_SPENT


def _about(
    method: str, problem: FitProblem, box: Box, settings: Mapping[str, Any]
) -> dict[str, Any]:
    """What a journal must agree on to be the beginning of this search."""
    return {
        "method": method,
        **{f"method.{key}": value for key, value in settings.items()},
        "seed": problem.seed,
        "free": list(problem.names),
        "search box": [box.lower.tolist(), box.upper.tolist()],
        "recordings": [[d.sha256, len(d), d.sample_time] for d in problem.datasets],
        "windows (length, stride)": [problem.window_length, problem.window_stride],
        "robust": problem.robust,
        "discrepancy": problem.discrepancy,
        "parameters": problem.model.parameters.values.tolist(),
    }
